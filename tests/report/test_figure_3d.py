"""The figure of a scene."""

import numpy as np

from colmap_inertial.report import figure_3d


def test_a_scene_s_box_holds_nearly_all_points_and_the_whole_path():
    xyz = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 5000))
    xyz[:, :3] = 1000.0  # a few far ones
    low, high = figure_3d._box(xyz, np.array([[0.0, 5.0], [0.0, 0.0], [0.0, 0.0]]))
    # with a margin of 6 % of the longest side
    np.testing.assert_allclose(low, [-1.34, -1.34, -1.34], atol=0.04)
    np.testing.assert_allclose(high, [5.38, 1.34, 1.34], atol=0.04)
