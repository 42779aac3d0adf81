"""Columns of IMU tables."""

import numpy as np

from colmap_inertial.io import imu_text


def test_a_column_that_falls_once_holds_no_times():
    t_s = np.arange(0.0, 1.0, 0.01)
    assert imu_text._time(np.stack([t_s, np.sin(t_s)], axis=1)) == (0, "s")
    t_s[50] -= 0.02
    assert imu_text._time(np.stack([t_s, np.sin(t_s)], axis=1))[0] is None
