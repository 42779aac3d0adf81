"""Checks of the IMU recording."""

import numpy as np
import pytest

from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_rotate
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.diagnose.imu import acceleration_rms_m_s2, scatter_of


def test_acceleration_is_what_turning_drift_bias_and_lever_arm_leave(subtests):
    for label, amplitude_m_s2, rms_m_s2 in (("turning in place", 0.0, 0.0), ("shaken", 0.4, 0.4 / np.sqrt(2))):
        with subtests.test(label):
            t_s = np.arange(0, 12, 1 / 400)
            # turns back and forth about the upright, with a bias, and with the IMU half a metre beside that axis
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


def test_the_scatter_of_readings_is_that_of_their_white_noise():
    t_s, rng = np.arange(0, 20, 0.01), np.random.default_rng(17)
    sizes = np.array([0.5, 0.02, 0.001])
    values = sizes * rng.standard_normal((len(t_s), 3)) + np.sin(2 * t_s)[:, None]
    # of the axis in the middle, whatever a few readings say
    values[::50] += 3.0
    assert scatter_of(values) == pytest.approx(0.02, rel=0.15)
