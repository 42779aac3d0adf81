"""Optical flow: options, and quick rotation."""

import numpy as np
import pytest

from colmap_inertial.motion.flow import FlowOptions, _measure_quick_rotation


def test_quick_rotation_is_what_is_faster_than_the_running_mean():
    t_s = np.arange(0, 20, 1 / 30)
    slow, quick = 2.0 * np.sin(0.4 * t_s), 0.3 * np.sin(2 * np.pi * 5 * t_s + 0.2)
    rate = np.stack([quick, slow, np.zeros_like(t_s)], axis=1)
    # one that was measured wrongly
    rate[300, 2] = 20.0
    assert _measure_quick_rotation(rate, 6) == pytest.approx(0.3 / np.sqrt(2), rel=0.1)


def test_options_of_the_flow_may_be_as_small_as_it_is_said():
    smallest = {"min_support": 8, "corners": 8}
    FlowOptions(**smallest)
    for name in smallest:
        with pytest.raises(ValueError, match="min_support must be 8 or more"):
            FlowOptions(**{**smallest, name: smallest[name] - 1})
