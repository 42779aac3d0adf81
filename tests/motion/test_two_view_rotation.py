"""Rotation between two views."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.motion.two_view_rotation import _fit_pure_rotation


def test_rays_that_do_not_turn_along_hardly_pull():
    rng, reach = np.random.default_rng(13), 1e-3
    b = rng.uniform(-0.5, 0.5, (300, 2))
    rays = np.concatenate([b, np.ones((300, 1))], axis=1)
    a_from_b = Rotation.from_rotvec([0.02, -0.03, 0.05])
    # two fifths of them moved sideways, all alike
    further = np.where(np.arange(300) < 120, 30 * reach, 0.0)[:, None] * [1.0, 0, 0]
    turned = a_from_b.apply(rays) + further
    found, share = _fit_pure_rotation(turned[:, :2] / turned[:, 2:], b, reach)
    assert (Rotation.from_matrix(found).inv() * a_from_b).magnitude() < 0.02 * reach
    assert share == pytest.approx(0.6)
