"""Transforms of an export."""

import numpy as np

from colmap_inertial.tools.export import transforms


def test_a_box_of_cameras_alone_holds_them_all():
    box = transforms._box(np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 1.0]]), np.zeros((0, 3)))
    assert np.allclose(np.array(box["offset"]) + box["scale"] * np.array([2.0, 1.0, 0.5]), 0.5)
    assert 0 < box["scale"] * 4.0 <= box["aabb_scale"]
