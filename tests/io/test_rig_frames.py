"""Frames of the cameras of a rig."""

import numpy as np
import pytest

from colmap_inertial.core.types import FrameTiming
from colmap_inertial.io.rig_frames import _find_nearest


def test_images_of_another_camera_are_the_nearest_in_time():
    rng = np.random.default_rng(8)
    own_s, frames_s = np.sort(rng.uniform(0, 10, 60)), np.sort(rng.uniform(-1, 11, 80))
    own = FrameTiming(names=tuple(f"o{k}" for k in range(60)), t_s=own_s - 3, epoch_ns=10**18 + 3 * 10**9)
    timing = FrameTiming(names=tuple(f"f{k}" for k in range(80)), t_s=frames_s + 2, epoch_ns=10**18 - 2 * 10**9)
    nearest, apart_ns = _find_nearest(own, timing)
    away = np.abs(own_s - frames_s[:, None])
    assert np.array_equal(nearest, away.argmin(axis=1))
    assert apart_ns == pytest.approx(1e9 * away.min(axis=1), abs=3)
