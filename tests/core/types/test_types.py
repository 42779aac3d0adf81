"""Values are valid by construction and cannot be changed afterwards."""

import dataclasses

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat, quat_rotate
from colmap_inertial.core.types import (
    CAL,
    CALIBRATION_PARAMETERS,
    CameraImuCalibration,
    CameraModel,
    CameraTrajectory,
    FrameTiming,
    ImuRecording,
    ScaleEstimate,
    Similarity,
)
from tests.helpers.cases import loop_over


def recording(**changes):
    t = np.arange(10) * 0.01
    values = dict(gyro_t_s=t, gyro_rad_s=np.zeros((10, 3)), accel_t_s=t + 0.003, accel_m_s2=np.full((10, 3), 5.0))
    return ImuRecording(**{**values, **changes})


@loop_over(
    ("changes", "words"),
    [
        ({"gyro_t_s": np.arange(10)[::-1]}, "gyro_t_s: times must increase"),
        ({"gyro_t_s": np.zeros(10)}, "increase strictly"),
        ({"accel_m_s2": np.full((10, 3), np.nan)}, "accel_m_s2: contains values that are not finite"),
        ({"gyro_rad_s": np.zeros((9, 3))}, r"gyro_rad_s: shape \(9, 3\), expected \(10, 3\)"),
        ({"gyro_t_s": [0.0], "gyro_rad_s": [[0.0, 0, 0]]}, "at least two samples"),
        ({"accel_t_s": [0.0], "accel_m_s2": [[0.0, 0, 9.8]]}, "at least two samples"),
    ],
)
def test_a_recording_that_makes_no_sense_cannot_be_built(changes, words):
    with pytest.raises(ValueError, match=words):
        recording(**changes)


@loop_over("changes", [{"width": 0}, {"height": -1}, {"params": (100.0, np.nan, 32.0, 24.0)}])
def test_a_camera_that_makes_no_sense_cannot_be_built(changes):
    with pytest.raises(ValueError, match=r"must be (positive|finite)"):
        CameraModel(**{"model": "PINHOLE", "width": 64, "height": 48, "params": (100.0, 100.0, 32.0, 24.0), **changes})


def test_a_gyroscope_alone_is_a_recording():
    assert recording().has_accel
    assert not recording(accel_t_s=[], accel_m_s2=np.zeros((0, 3))).has_accel


def test_arrays_are_copies_and_read_only():
    samples = np.full((10, 3), 5.0)
    built = recording(accel_m_s2=samples)
    samples[:] = 0
    assert built.accel_m_s2.min() == 5
    with pytest.raises(ValueError, match="read-only"):
        built.accel_m_s2[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        built.epoch_ns = 3


def test_poses_hold_at_mid_exposure_of_the_middle_row():
    timing = FrameTiming(names=("a", "b"), t_s=[0, 1], exposure_s=[0.02, 0.04], readout_s=0.01)
    np.testing.assert_allclose(timing.pose_t_s(), [0.015, 1.025])


def test_select_keeps_names_and_poses_together():
    q = np.tile([0, 0, 0, 1.0], (4, 1))
    track = CameraTrajectory(names=tuple("abcd"), t_s=np.arange(4), cam_from_world_xyzw=q, cam_in_world=np.eye(4, 3))
    picked = track.select(np.array([True, False, True, False]))
    assert picked.names == ("a", "c")
    np.testing.assert_array_equal(picked.cam_in_world, np.eye(4, 3)[[0, 2]])


def test_a_refusal_has_no_number_and_a_number_is_no_refusal():
    with pytest.raises(ValueError, match="no number"):
        ScaleEstimate(
            metres_per_unit=1.0, sigma_log=0.1, ci95=(0.8, 1.2), verdict="refused", method="joint", reasons=("x",)
        )
    with pytest.raises(ValueError, match="no number"):
        ScaleEstimate(metres_per_unit=None, sigma_log=None, ci95=None, verdict="weak", method="joint")
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="must be positive"):
            ScaleEstimate(metres_per_unit=scale, sigma_log=0.1, ci95=(0.8, 1.2), verdict="weak", method="joint")
    with pytest.raises(ValueError, match="needs a reason"):
        ScaleEstimate(metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="joint")


def estimate(gravity, cov=None):
    return ScaleEstimate(
        metres_per_unit=2.0,
        sigma_log=0.01,
        ci95=(1.96, 2.04),
        verdict="trusted",
        method="joint",
        gravity_in_world_m_s2=gravity,
        cov=cov,
    )


def test_the_similarity_turns_gravity_down(subtests):
    for world, down in (("z-up", [0, 0, -1]), ("y-down", [0, 1, 0])):
        with subtests.test(world=world, down=down):
            gravity = np.array([3.0, -2.0, 9.0])
            similarity = Similarity.from_scale(estimate(gravity), world=world)
            assert similarity.scale == 2.0
            turned = quat_rotate(similarity.rotation_xyzw, gravity / np.linalg.norm(gravity))
            np.testing.assert_allclose(turned, down, atol=1e-12)


def test_the_covariance_of_gravity_becomes_a_tilt_covariance():
    rng = np.random.default_rng(0)
    gravity, sigma = np.array([1.0, 2.0, -9.4]), 0.01
    cov = np.diag([1e-4, sigma**2, sigma**2, sigma**2, 0, 0, 0])
    nominal = Similarity.from_scale(estimate(gravity, cov))
    true_down = rng.normal(gravity, sigma, (20000, 3))
    # the tilt of the target frame that a wrong gravity causes, sampled: angle between -z and the turned true gravity
    turned = quat_rotate(nominal.rotation_xyzw, true_down)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    np.testing.assert_allclose(
        np.var(np.cross(turned, [0, 0, -1]), axis=0), np.diag(nominal.cov)[1:4], rtol=0.05, atol=1e-12
    )
    assert nominal.cov[0, 0] == 1e-4
    # and with the right sign: a scale that grows with gravity's x turns the frame this way
    coupled = cov.copy()
    coupled[0, 1] = coupled[1, 0] = 0.5 * 1e-2 * sigma
    step = np.array([1e-5, 0, 0])
    tilt = np.cross(quat_rotate(nominal.rotation_xyzw, (gravity + step) / np.linalg.norm(gravity + step)), [0, 0, -1.0])
    expected = coupled[0, 1] * tilt / 1e-5
    found = Similarity.from_scale(estimate(gravity, coupled)).cov[0, 1:4]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)
    assert np.linalg.det(matrix_from_quat(nominal.rotation_xyzw)) == pytest.approx(1)


def test_a_refused_scale_cannot_become_a_similarity():
    refused = ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="joint", reasons=("tripod",)
    )
    with pytest.raises(NotObservableError, match="tripod"):
        Similarity.from_scale(refused)
    assert refused.as_json()["metres_per_unit"] is None
    assert refused.as_json()["reasons"] == ["tripod"]


def test_places_in_a_calibration_are_those_of_its_parameters():
    names = np.array(CALIBRATION_PARAMETERS)
    assert len(names) == CAL.COUNT
    assert names[CAL.ROTATION].tolist() == [f"rotation_{axis}_rad" for axis in "xyz"]
    assert names[[CAL.GYRO_TIME_OFFSET, CAL.ACCEL_TIME_OFFSET]].tolist() == names[CAL.TIME_OFFSETS].tolist()
    assert names[CAL.TIME_OFFSETS].tolist() == ["gyro_time_offset_s", "accel_time_offset_s"]
    assert names[CAL.GYRO_BIAS].tolist() == [f"gyro_bias_{axis}_rad_s" for axis in "xyz"]
    assert names[CAL.LEVER_ARM].tolist() == [f"imu_in_cam_{axis}_m" for axis in "xyz"]
    assert names[CAL.READOUT] == "readout_s"


def test_calibration_sigmas_are_found_by_name():
    n = len(CALIBRATION_PARAMETERS)
    calibration = CameraImuCalibration(
        cam_from_imu_xyzw=[0, 0, 0, 1],
        gyro_time_offset_s=0.0,
        accel_time_offset_s=0.0,
        gyro_bias_rad_s=np.zeros(3),
        imu_in_cam_m=np.zeros(3),
        readout_s=0.0,
        cov=np.diag(np.arange(n) ** 2.0),
    )
    assert calibration.sigma("accel_time_offset_s") == 4
    assert calibration.rotation_sigma_rad == 2
    with pytest.raises(ValueError, match="clock_rate"):
        dataclasses.replace(calibration, clock_rate=float("nan"))
    with pytest.raises(ValueError, match="not a covariance"):
        dataclasses.replace(calibration, cov=-np.eye(n))
