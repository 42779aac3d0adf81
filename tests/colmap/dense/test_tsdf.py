"""Typical depths."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.dense import tsdf


def test_a_quarter_of_the_known_depths_is_near():
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 64, 48)
    depth = np.arange(10, dtype=np.float32)[None]
    assert tsdf._measure_typical(depth, camera) == pytest.approx((3.0, 0.03))
    assert tsdf._measure_typical(0 * depth, camera) == (0.0, 0.0)
