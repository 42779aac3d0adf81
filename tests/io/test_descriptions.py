"""Hints on columns of tables that say nothing of themselves."""

import numpy as np

from colmap_inertial.io import descriptions


def test_a_column_that_falls_once_holds_no_times():
    t_s = np.arange(0.0, 1.0, 0.01)
    assert descriptions._time(np.stack([t_s, np.sin(t_s)], axis=1)) == 0
    t_s[50] -= 0.02
    assert descriptions._time(np.stack([t_s, np.sin(t_s)], axis=1)) is None
