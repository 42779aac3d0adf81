"""Blur paths and their uncertainty."""

import numpy as np

from colmap_inertial.imaging.blur_path import BlurPath


def test_a_longer_blur_path_errs_by_as_much_more():
    path = BlurPath(width=32, height=32, step_px=32, path_px=np.ones((3, 2, 2, 2)), cov_px2=np.array([1.0, 2.0, 0.5]))
    longer = path.times(3.0)
    np.testing.assert_allclose(longer.path_px, 3 * path.path_px)
    np.testing.assert_allclose(longer.cov_px2, 9 * path.cov_px2)
