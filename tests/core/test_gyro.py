"""Gravity directions against a simulated recording whose attitude is known."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.core.gyro import estimate_up_in_imu, gravity_in_cam
from colmap_inertial.core.types import FrameTiming, ImuRecording
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.tools.simulate import RecordingOptions, simulate_recording


def timed(imu, calibration, timing):
    return CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns)


def true_down_in_cam(recording):
    """From the simulated poses (milliradians of noise) and the model's true gravity."""
    truth = recording.truth
    down_in_world = np.array([0, 0, -1.0])
    down_in_model = quat_rotate(truth.model_from_world_xyzw, down_in_world)
    return quat_rotate(recording.trajectory.cam_from_world_xyzw, down_in_model)


def test_gravity_in_the_camera_is_right_but_for_the_accelerometer_s_bias(subtests):
    for seed in (1, 2, 3):
        with subtests.test(seed=seed):
            recording = simulate_recording(RecordingOptions(), seed=seed)
            trajectory = recording.trajectory
            timing = FrameTiming(names=trajectory.names, t_s=trajectory.t_s, epoch_ns=trajectory.epoch_ns)
            found = gravity_in_cam(timed(recording.imu, recording.truth.calibration, timing), timing)
            assert len(found) == len(trajectory)
            down = np.array([found[name] for name in trajectory.names])
            cosine = np.sum(down * true_down_in_cam(recording), axis=1)
            error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            bias_deg = np.degrees(np.arcsin(np.linalg.norm(recording.truth.imu.errors.accel_bias_m_s2) / 9.8))
            assert np.sqrt(np.mean(error_deg**2)) < bias_deg + 0.5
            assert error_deg.max() < bias_deg + 2.0
            assert bias_deg < 4


def test_frames_that_the_imu_does_not_cover_get_none():
    recording = simulate_recording(RecordingOptions(), seed=4)
    trajectory = recording.trajectory
    late = FrameTiming(names=trajectory.names, t_s=trajectory.t_s + 1e4, epoch_ns=trajectory.epoch_ns)
    assert gravity_in_cam(timed(recording.imu, recording.truth.calibration, late), late) == {}


def test_a_still_device_shows_the_mean_of_its_accelerometer():

    t = np.arange(400) * 0.01
    rng = np.random.default_rng(0)
    still = ImuRecording(
        gyro_t_s=t,
        gyro_rad_s=np.full((400, 3), 0.02),
        accel_t_s=t + 0.004,
        accel_m_s2=[1.0, -2.0, 9.5] + 0.05 * rng.normal(size=(400, 3)),
    )
    up = estimate_up_in_imu(still, np.full(3, 0.02), np.array([0.5, 3.0]))
    expected = np.array([1.0, -2.0, 9.5]) / np.linalg.norm([1.0, -2.0, 9.5])
    np.testing.assert_allclose(up, [expected, expected], atol=2e-3)


def test_sensors_with_time_offsets_of_their_own_are_brought_together(subtests):
    """A device that turns steadily about a horizontal axis: where gravity is has a closed form."""
    for delay_s in (-0.15, 0.15):
        with subtests.test(delay_s=delay_s):
            rate = np.array([1.0, 0.0, 0.0])

            def up(t_s):
                return np.stack([np.zeros_like(t_s), np.cos(t_s), -np.sin(t_s)], axis=1)

            t_cam_s = np.arange(0, 40, 0.01)
            imu = ImuRecording(
                gyro_t_s=t_cam_s - 5.0,
                gyro_rad_s=np.tile(rate, (len(t_cam_s), 1)),
                accel_t_s=t_cam_s - (5.0 + delay_s),
                accel_m_s2=9.8 * up(t_cam_s),
            )
            calibration = replace(calibration_prior(), gyro_time_offset_s=5.0, accel_time_offset_s=5.0 + delay_s)
            asked_s = np.arange(10.0, 30.0, 0.5)
            timing = FrameTiming(names=tuple(map(str, range(len(asked_s)))), t_s=asked_s)
            found = np.array(list(gravity_in_cam(timed(imu, calibration, timing), timing).values()))
            np.testing.assert_allclose(found, -up(asked_s), atol=1e-3)


def test_a_gyroscope_alone_knows_no_gravity():
    t = np.arange(100) * 0.01
    imu = ImuRecording(gyro_t_s=t, gyro_rad_s=np.ones((100, 3)), accel_t_s=[], accel_m_s2=np.zeros((0, 3)))
    with pytest.raises(NotObservableError, match="no accelerometer"):
        estimate_up_in_imu(imu, np.zeros(3), t)
    timing = FrameTiming(names=("a",), t_s=[0.5])
    assert gravity_in_cam(timed(imu, calibration_prior(), timing), timing) == {}
