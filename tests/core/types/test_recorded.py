"""Recorded times and positions."""

import numpy as np
import pytest

from colmap_inertial.core.types import FrameTiming, PositionFixes


def test_what_is_not_one_for_each_is_refused():
    with pytest.raises(ValueError, match="unique, one for each time"):
        FrameTiming(names=("a", "b", "a"), t_s=np.arange(3.0))
    known = {"latitude_deg": np.zeros(2), "longitude_deg": np.zeros(2), "names": ("a", "b")}
    with pytest.raises(ValueError, match="height_m: must be"):
        PositionFixes(**known, height_m=np.array([0.0, np.inf]), sigma_m=np.ones(2))
