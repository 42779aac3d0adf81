"""What a metric path says of itself: its covariance with drift, and the motion during each frame."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, so3_exp
from colmap_inertial.core.types import CAL, CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.inertial.refine.motion import ImageDrift
from colmap_inertial.inertial.refine.shutter import SHUTTER_LIMITS
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.run.stages import metric
from colmap_inertial.run.stages.metric import MetricStage, _add_drift, _motion, calibration_of_rectified
from tests.helpers.turning_cameras import CAM_FROM_IMU

GRAVITY = np.array([0.0, 0.0, -9.81])
COUNT = 4


def spread(rng, size, sigma):
    """A covariance that is not diagonal."""
    root = rng.standard_normal((size, size))
    return sigma**2 / size * root @ root.T


def drifted_path(patch):
    """A model's path of four images with a drift that pictures left, and what the smoother says of it."""
    rng = np.random.default_rng(2)
    names = tuple(f"{k}.jpg" for k in range(COUNT))
    centre, velocity = 2 * rng.standard_normal((COUNT, 3)), rng.standard_normal((COUNT, 3))
    cov = np.array([spread(rng, 6, 2e-3) for _ in names])
    smoothed = SimpleNamespace(
        t_s=np.arange(4.0), velocity_in_world=velocity, cov=np.array([spread(rng, 9, 3e-3) for _ in names])
    )
    seen = SimpleNamespace(names=names, t_s=smoothed.t_s, cam_in_world=centre)
    model = SimpleNamespace(
        reconstruction=None,
        timing=None,
        parts=(),
        similarity=SimpleNamespace(cov=spread(rng, 7, 4e-3)),
        joined_covs=dict(zip(names, cov, strict=True)),
    )
    drift = ImageDrift(names=names, cam_in_world=centre, cov=cov)
    patch.setattr(metric, "read_seen", lambda *_: seen)
    patch.setattr(metric, "has_rigs", lambda _: False)
    patch.setattr(metric, "find_path_drift", lambda *_: drift)
    return SimpleNamespace(model=model, smoothed=smoothed, drift=drift, seen=seen)


@pytest.fixture
def path(monkeypatch):
    return drifted_path(monkeypatch)


@pytest.mark.parametrize("joined", [False, True])
def test_a_path_s_covariance_is_the_scatter_of_paths_that_drifted_and_have_another_scale_and_gravity(path, joined):
    """A joined path has its parts' scales in its positions' covariance already."""
    rng, draws = np.random.default_rng(3), 15_000
    path.model.parts = ("two",) if joined else ()
    cov, rotation = _add_drift(path.model, path.smoothed, GRAVITY)
    similar = rng.multivariate_normal(np.zeros(7), path.model.similarity.cov, draws)
    if joined:
        # the length of what is measured from the first image is as its part's; velocities have it anew
        similar[:, 1:4] = rng.multivariate_normal(np.zeros(3), path.model.similarity.cov[1:4, 1:4], draws)
    for k in range(COUNT):
        drifted = rng.multivariate_normal(np.zeros(6), path.drift.cov[k], draws)
        local = rng.multivariate_normal(np.zeros(3), path.smoothed.cov[k, 3:6, 3:6], draws)
        turn = so3_exp(similar[:, 1:4])
        longer = np.exp(similar[:, :1])
        away = path.seen.cam_in_world[k] - path.seen.cam_in_world[0]
        place = turn @ away * (1.0 if joined else longer) + drifted[:, :3]
        speed = longer * (so3_exp(drifted[:, 3:]) @ turn @ path.smoothed.velocity_in_world[k][:, None])[..., 0] + local
        for told, values in (
            (cov[k, :6, :6], np.concatenate([place, speed], axis=1)),
            (rotation[k], drifted[:, 3:] + similar[:, 1:4]),
        ):
            scatter = np.cov(values.T)
            sigma = np.sqrt(np.diagonal(scatter))
            assert (np.abs(told - scatter) < 0.06 * np.outer(sigma, sigma) + 1e-12).all()
        assert np.array_equal(cov[k, 6:, 6:], path.smoothed.cov[k, 6:, 6:])


def test_where_drift_is_not_known_the_smoother_s_covariance_is_left(subtests):
    for why in ("no drift", "rigs", "an image without a time", "a part that is not placed"):
        with subtests.test(why), pytest.MonkeyPatch.context() as patch:
            path = drifted_path(patch)
            if why == "no drift":
                patch.setattr(metric, "find_path_drift", lambda *_: None)
            elif why == "rigs":
                patch.setattr(metric, "has_rigs", lambda _: True)
            elif why == "an image without a time":
                path.seen.t_s = np.array([0.0, 1.0, np.nan, 3.0])
            else:
                path.model.parts = ("two",)
                del path.model.joined_covs["2.jpg"]
            cov, rotation = _add_drift(path.model, path.smoothed, GRAVITY)
            assert cov is path.smoothed.cov and rotation is None


def test_frames_have_the_turn_and_the_velocity_of_their_instants_where_the_gyroscope_ran():
    """A camera that turns ever quicker about its own axes; the IMU is mounted askew, on a clock of its own."""
    names = tuple(f"{k}.jpg" for k in range(6))
    timing = FrameTiming(names=names, t_s=0.5 * np.arange(6) + 1, exposure_s=0.001 * np.arange(1, 7), readout_s=0.02)
    axis = np.array([0.3, -0.2, 0.5])
    t_s = np.arange(0, 2.9, 0.005)
    imu = ImuRecording(
        gyro_t_s=t_s,
        gyro_rad_s=np.outer(t_s, axis) @ matrix_from_quat(CAM_FROM_IMU),
        accel_t_s=[],
        accel_m_s2=np.zeros((0, 3)),
    )
    calibration = calibration_prior(Declared(cam_from_imu_xyzw=CAM_FROM_IMU, gyro_time_offset_s=0.25))
    kept = [0, 2, 3, 4, 5]
    trajectory = CameraTrajectory(
        names=tuple(names[k] for k in kept),
        t_s=timing.pose_t_s()[kept],
        cam_in_world=np.zeros((5, 3)),
        cam_from_world_xyzw=np.tile(quat_exp(np.zeros(3)), (5, 1)),
    )
    velocity = np.arange(15.0).reshape(5, 3)
    velocity[1] = np.nan
    model = SimpleNamespace(timing=timing, motion=None)
    found = _motion(model, trajectory, velocity, imu, calibration)
    # the gyroscope ended before the last frame
    assert found.names == ("0.jpg", "3.jpg", "4.jpg")
    assert np.array_equal(found.velocity_in_world_m_s, velocity[[0, 2, 3]])
    rate = np.outer(found.t_s - 0.25, axis)
    assert found.angular_velocity_in_cam_rad_s == pytest.approx(rate, abs=2e-3)
    assert found.exposure_s == pytest.approx(timing.exposure_s[[0, 3, 4]]) and found.readout_s == 0.02
    model.motion = SimpleNamespace(readout_s=0.013)
    assert _motion(model, trajectory, velocity, imu, calibration).readout_s == 0.013


def test_of_a_rectified_readout_a_tenth_stays_uncertain():
    known = calibration_prior(Declared(cam_from_imu_xyzw=CAM_FROM_IMU, gyro_time_offset_s=0.0, readout_s=0.03))
    left = calibration_of_rectified(known)
    assert left.readout_s == 0 and known.readout_s == 0.03
    assert np.sqrt(left.cov[CAL.READOUT, CAL.READOUT]) == pytest.approx(0.003)
    others = np.arange(CAL.COUNT) != CAL.READOUT
    assert np.array_equal(left.cov[np.ix_(others, others)], known.cov[np.ix_(others, others)])
    assert not left.cov[CAL.READOUT, others].any() and not left.cov[others, CAL.READOUT].any()


@dataclass(frozen=True, kw_only=True)
class Known:
    prior: object


def test_a_readout_is_sought_in_the_middle_images_whatever_was_declared(monkeypatch):
    most, sought = SHUTTER_LIMITS.most_images, {}
    names = [f"{k:04}" for k in range(most + 10)]
    timing = FrameTiming(names=tuple(names), t_s=np.arange(len(names)) / 4, readout_s=0.0)
    # numbered backwards; one without a time, and one of another camera of a rig
    images = {
        len(names) - k: SimpleNamespace(image_id=len(names) - k, name=name, is_ref_in_frame=lambda: True)
        for k, name in enumerate(names)
    }
    images[9001] = SimpleNamespace(image_id=9001, name="other", is_ref_in_frame=lambda: True)
    images[9002] = SimpleNamespace(image_id=9002, name=names[5], is_ref_in_frame=lambda: False)
    model = SimpleNamespace(
        reconstruction=SimpleNamespace(image=images.get, reg_image_ids=lambda: list(images)), timing=timing
    )
    root = 1e-3 * np.random.default_rng(3).standard_normal((CAL.COUNT, CAL.COUNT))
    declared = calibration_prior(Declared(readout_s=0.03))
    declared = replace(declared, cov=root @ root.T)
    stage = SimpleNamespace(
        imu="imu", shutter=None, keeps_intrinsics=False, known_of=lambda model, refine_intrinsics: Known(prior=declared)
    )

    def found(seen, timing, imu, known, exposed_px, find_lens):
        assert not find_lens
        sought.update(seen=seen, cov=known.prior.cov)
        return "readout"

    monkeypatch.setattr(metric, "read_seen", lambda reconstruction, timing, chosen: chosen)
    monkeypatch.setattr(metric, "find_readout", found)
    assert MetricStage._find_readout(stage, model) == "readout"
    assert sought["seen"] == [len(names) - k for k in range(5, 5 + most)]
    others = np.arange(CAL.COUNT) != CAL.READOUT
    assert np.array_equal(sought["cov"][np.ix_(others, others)], declared.cov[np.ix_(others, others)])
    # as of one that nobody knows: twenty milliseconds
    assert sought["cov"][CAL.READOUT, CAL.READOUT] == pytest.approx(0.02**2)
    assert not sought["cov"][CAL.READOUT, others].any() and not sought["cov"][others, CAL.READOUT].any()
    images.clear()
    assert MetricStage._find_readout(stage, model) is None
