"""Small rules of several rooms, each against a closed form or a count by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from colmap_inertial.checks.diagnose.frames import _readout
from colmap_inertial.checks.diagnose.imu import acceleration_rms_m_s2
from colmap_inertial.checks.validate.overlays import _ticks
from colmap_inertial.checks.validate.views import load_views
from colmap_inertial.colmap.loops import key_frames
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_rotate
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.inertial.core.factors import lasting_group, state_group, walk_group
from colmap_inertial.inertial.core.parameters import DRIFT
from colmap_inertial.io.gopro import _stabilisation
from colmap_inertial.motion.align._fit import _noise_of
from colmap_inertial.motion.align.conventions import quick_accelerations
from colmap_inertial.reconstruction.drivers.paths import only_model
from colmap_inertial.reconstruction.preparation.plan import _most_turned_rad
from colmap_inertial.reconstruction.preparation.selection import _slots
from colmap_inertial.tools.simulate import RecordingOptions, simulate_recording
from colmap_inertial.tools.simulate.rests import RestOptions, _Turn


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(), seed=3)


@pytest.mark.parametrize(("pose_rad", "rate_rad_rts"), [(2e-3, 4e-3), (1e-3, 2e-3), (4e-4, 8e-3)])
def test_noise_of_poses_and_gyroscope_is_told_apart(pose_rad, rate_rad_rts):
    rng, dt_s = np.random.default_rng(1), np.full(3000, 0.2)
    poses = pose_rad * rng.standard_normal((3001, 3))
    residual = np.diff(poses, axis=0) + rate_rad_rts * np.sqrt(dt_s)[:, None] * rng.standard_normal((3000, 3))
    pose, rate = _noise_of(residual, dt_s, np.ones(3000), 1e-12)
    assert np.sqrt(pose) == pytest.approx(pose_rad, rel=0.15)
    assert np.sqrt(rate) == pytest.approx(rate_rad_rts, rel=0.1)


def test_steady_gravity_is_steady(recording):
    trajectory, imu = recording.trajectory, recording.imu
    found = quick_accelerations(trajectory, imu, recording.truth.calibration)
    assert found is not None and 0.98 < found.steadiness <= 1


def test_key_frames_begin_with_the_first_and_are_a_second_apart():
    assert key_frames(np.arange(0, 5.01, 0.25)).tolist() == [0, 4, 8, 12, 16, 20]
    assert key_frames(np.array([0.0, 0.5, 3.0, 3.4, 3.97])).tolist() == [0, 2, 4]


def test_of_a_quick_video_the_least_blurred_frame_of_each_slot_counts():
    t_s = np.arange(12) / 120  # four frames to a slot, which is about its middle
    blur = np.array([3, 2, 9, 1, 5, np.nan, 7, 8, 0.5, np.nan, np.nan, 4.0])
    assert _slots(t_s, blur).tolist() == [1, 3, 8, 11]
    assert _slots(np.arange(3) / 30, blur[:3]).tolist() == [0, 1, 2]


@pytest.mark.parametrize("times", [{"exposure_s": -0.001}, {"readout_s": -0.001}, {"readout_s": np.nan}])
def test_no_shutter_takes_less_than_no_time(times):
    with pytest.raises(ValueError, match="must not be negative"):
        FrameShutter(**{"width": 64, "height": 48, "t_s": 0.0, "exposure_s": 0.01, **times})


def test_what_a_gyroscope_felt_just_before_an_uncertain_exposure_counts(recording):
    epoch_ns, prior = recording.trajectory.epoch_ns, replace(recording.truth.calibration, cov=1e-6 * np.eye(12))
    stamps_s = CameraTimedImu.from_recording(recording.imu, prior, epoch_ns).gyro_t_s
    rate = np.zeros_like(recording.imu.gyro_rad_s)
    at = len(stamps_s) // 2
    rate[at, 2] = 2.0
    imu = replace(recording.imu, gyro_rad_s=rate)
    uncertain_s = 3 * prior.clock_sigma_s
    step_s = float(np.median(np.diff(stamps_s)))
    for after_s, felt in ((uncertain_s + 4 * step_s, 0.0), (uncertain_s + 0.5 * step_s, 0.02)):
        timing = SimpleNamespace(t_s=stamps_s[[at]] + after_s, readout_s=0.0, epoch_ns=epoch_ns)
        case = SimpleNamespace(timing=timing, prior=prior, imu=imu)
        assert _most_turned_rad(case, np.array([0.01])) == pytest.approx(felt)


def test_a_picture_that_turns_seldom_but_far_was_stabilised():
    # rms .006 rad, mean .002
    turn = np.zeros((900, 3))
    turn[::9, 0] = 0.018
    assert _stabilisation({}, quat_exp(turn)[:, [3, 0, 1, 2]]) == (True, "IORI")
    assert _stabilisation({}, quat_exp(0.7 * turn)[:, [3, 0, 1, 2]]) == (False, "")


def test_ticks_are_the_round_numbers_nearest_to_six():
    assert _ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10]
    assert _ticks(-0.25, 0.31) == [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3]


def test_a_hand_knocks_where_it_takes_and_leaves():
    rng = np.random.default_rng(4)
    options = RestOptions(hand_m_s2=0.0, knock_m_s2=5.0)
    turn = _Turn.draw(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), options, rng)
    since_s = np.linspace(0, turn.duration_s, 4000)
    felt = np.linalg.norm(turn.handled_m_s2(since_s, rng), axis=1)
    middle = np.abs(since_s - turn.duration_s / 2) < 0.2 * turn.duration_s
    assert np.sqrt(np.mean(felt[middle] ** 2)) == pytest.approx(0.3 * np.sqrt(3), rel=0.1)
    assert felt[:20].mean() > 5 and felt[-20:].mean() > 5


def test_models_without_poses_and_folders_of_several_are_refused(tmp_path):
    with pytest.raises(FormatError, match="holds no image with a pose"):
        load_views(pycolmap.Reconstruction(), tmp_path)
    for name in "01":
        (tmp_path / name).mkdir()
        pycolmap.Reconstruction().write_binary(str(tmp_path / name))
    with pytest.raises(FormatError, match="holds 2 models; give one of them"):
        only_model(tmp_path)


def test_pictures_far_apart_tell_no_readout():
    with pytest.raises(NotObservableError, match="far apart"):
        _readout(SimpleNamespace(rotation=object(), aligned=None, imu=None, is_dense=False))


@pytest.mark.parametrize(
    ("amplitude_m_s2", "rms_m_s2"), [(0.0, 0.0), (0.4, 0.4 / np.sqrt(2))], ids=["turning in place", "shaken"]
)
def test_acceleration_is_what_turning_drift_bias_and_lever_arm_leave(amplitude_m_s2, rms_m_s2):
    t_s = np.arange(0, 12, 1 / 400)
    # turns to and fro about the upright, with a bias, and with the IMU half a metre beside that axis
    angle, spin = 0.8 * np.cos(np.pi * t_s), -0.8 * np.pi**2 * np.cos(np.pi * t_s)
    rate = -0.8 * np.pi * np.sin(np.pi * t_s)
    zero, lever_m = np.zeros_like(t_s), np.array([0.5, 0.0, 0.1])
    world_from_imu = quat_exp(np.stack([zero, zero, angle], axis=1))
    # gravity changes ever faster, as through a gyroscope that drifts
    world = np.stack([zero, amplitude_m_s2 * np.sin(3 * np.pi * t_s), 9.8 + 0.3 * t_s**2], axis=1)
    off_axis = np.stack([-(rate**2) * lever_m[0], spin * lever_m[0], zero], axis=1)
    accel = quat_rotate(quat_conjugate(world_from_imu), world) + off_axis + [0.1, -0.2, 0.3]
    gyro = np.stack([zero, zero, rate], axis=1)
    found = acceleration_rms_m_s2(ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel))
    assert found == pytest.approx(rms_m_s2, rel=0.05, abs=0.01)


@pytest.mark.parametrize("kind", ["lasting", "walk", "lasting, broken", "each by itself"])
def test_errors_that_last_weigh_as_by_the_whole_covariance(kind):
    rng, sigma, lasting_s = np.random.default_rng(11), 0.3, 0.6
    t_s = np.cumsum([0.1, 0.05, 0.4, 2.0, 0.2, 0.9])
    values, dt_s = rng.standard_normal((len(t_s), 3)), np.diff(t_s)
    apart_s, first_s = np.abs(t_s[:, None] - t_s), np.minimum(t_s[:, None], t_s)
    variance = 0.5 * lasting_s * sigma**2
    whole = np.ones(len(dt_s), dtype=bool)
    if kind == "lasting":
        cov, group = (
            variance * np.exp(-apart_s / lasting_s),
            lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole),
        )
    elif kind == "each by itself":
        cov, group = variance * np.eye(len(t_s)), state_group(values, DRIFT, variance**0.5)
    elif kind == "walk":
        cov, group = sigma**2 * first_s, walk_group(values, DRIFT, sigma, dt_s)
    else:
        whole[2] = False
        cov, group = sigma**2 * first_s, lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole)
        # either side of the break is a walk of its own
        cov[:3, 3:] = cov[3:, :3] = 0.0
    squares = np.sum(values * np.linalg.solve(cov, values))
    starts = {"each by itself": [], "lasting, broken": [0, 3]}.get(kind, [0])
    first = sum(np.sum(values[i] ** 2) / cov[i, i] for i in starts)
    assert np.sum(group.residual**2) + first == pytest.approx(squares, rel=1e-4)
