"""Matches of two images."""

import numpy as np

from colmap_inertial.colmap.views.two_views import match_quickly


def test_single_descriptors_are_no_matches():
    one, many = np.full((1, 128), 45, np.uint8), np.eye(128, dtype=np.uint8)[:40] * 255
    assert [len(match_quickly(*pair)[0]) for pair in ((one, many), (many, one), (many[:0], many))] == [0, 0, 0]
