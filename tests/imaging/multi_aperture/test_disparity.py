"""Disparities of the background."""

import numpy as np

from colmap_inertial.imaging.multi_aperture.disparity import background


def test_gaps_of_disparities_are_filled_from_the_border_s_own_column_too():
    known = np.zeros((3, 5), dtype=bool)
    known[:, 0] = known[:, 4] = True
    disparity_px = np.where(known, np.array([[2.0, 0, 0, 0, 5.0]]), np.nan).astype(np.float32)
    np.testing.assert_array_equal(background(disparity_px, known), np.tile([2.0, 5.0, 5.0, 5.0, 5.0], (3, 1)))
    known[:, 4] = False
    np.testing.assert_array_equal(background(disparity_px, known), np.full((3, 5), 2.0))
