"""Rotation between two views."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.motion.two_view_rotation import _estimate_rotation, _Features, _fit_pure_rotation


def test_rays_that_do_not_turn_along_hardly_pull():
    rng, reach = np.random.default_rng(13), 1e-3
    rays = np.concatenate([rng.uniform(-0.5, 0.5, (300, 2)), np.ones((300, 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    a_from_b = Rotation.from_rotvec([0.02, -0.03, 0.05])
    # two fifths of them moved sideways, all alike
    turned = a_from_b.apply(rays)
    turned[:120] += [30 * reach, 0, 0]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    found = _fit_pure_rotation(turned, rays, reach)
    assert (Rotation.from_matrix(found).inv() * a_from_b).magnitude() < 0.02 * reach


@pytest.mark.parametrize("move_m", [[0, 0, 0], [0.02, 0, 0.1], [0.3, 0.1, 0.2]])
def test_a_camera_that_moves_turns_as_it_does(move_m):
    """Past a floor and a wall; a rotation alone would take its parallax for turning."""
    rng, pixel_rad = np.random.default_rng(5), 1 / 280
    floor = np.column_stack([rng.uniform(-2, 2, 200), np.full(200, 1.2), rng.uniform(2, 6, 200)])
    wall = np.column_stack([np.full(200, -1.5), rng.uniform(-1, 1, 200), rng.uniform(2, 6, 200)])
    points = np.concatenate([floor, wall])
    first_from_second = Rotation.from_rotvec(np.radians([0.6, -0.5, 0.4]))
    seen = points, first_from_second.inv().apply(points - move_m)
    descriptors = rng.integers(0, 255, (400, 128)).astype(np.float32)
    first, second = (
        _Features(
            rays=there[:, :2] / there[:, 2:] + 0.3 * pixel_rad * rng.standard_normal((400, 2)),
            descriptors=descriptors,
            pixel_rad=pixel_rad,
        )
        for there in seen
    )
    found, count = _estimate_rotation(first, second)
    off_rad = (Rotation.from_matrix(found).inv() * first_from_second).magnitude()
    assert off_rad < np.radians(0.25) and count > 200
