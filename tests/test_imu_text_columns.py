"""Columns of a table without a header: which are the accelerometer's, and which the gyroscope's."""

import numpy as np
import pytest

from colmap_inertial.io import imu_text


def table(*groups):
    return np.column_stack([np.arange(400) / 100.0, *groups])


@pytest.fixture
def readings():
    """A gyroscope, and an accelerometer whose length changes more than that of its first two axes."""
    rng = np.random.default_rng(5)
    gyro = 0.3 * rng.standard_normal((400, 3))
    gyro[:, 2] *= 0.01
    accel = np.column_stack([np.full(400, 6.9), np.full(400, 6.9), np.zeros(400)])
    accel[:, :2] += 0.005 * rng.standard_normal((400, 2))
    accel[:, 2] = 2.5 * rng.standard_normal(400)
    return gyro, accel


def test_the_accelerometer_leaves_three_columns_for_the_gyroscope(readings):
    """Though a column of the gyroscope and two of the accelerometer have a steadier length."""
    gyro, accel = readings
    steadier = np.column_stack([gyro[:, 2], accel[:, :2]])
    assert np.ptp(np.linalg.norm(steadier, axis=1)) < 0.1 * np.ptp(np.linalg.norm(accel, axis=1))
    assert imu_text._accel(table(gyro, accel), 0) == (4, "m/s2")
    assert imu_text._accel(table(gyro, accel / 9.80665), 0) == (4, "g")
    assert imu_text._accel(table(accel, gyro), 0) == (1, "m/s2")
