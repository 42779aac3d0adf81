"""Rotations against the matches of two views."""

import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.motion.epipolar import RayMoments, refine_poses


def see(noise_rad, moved=(0.3, 0.1, -0.2)):
    """Unit rays of two views of a cloud of points, and the rotation between them."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-2, -2, 3], [2, 2, 7], (4000, 3))
    first_from_second = so3_exp(np.array([0.05, -0.1, 0.02]))
    rays = []
    for there in (points, (points - moved) @ first_from_second):
        ray = there / np.linalg.norm(there, axis=1, keepdims=True) + noise_rad * rng.standard_normal(there.shape)
        rays.append((ray / np.linalg.norm(ray, axis=1, keepdims=True))[None])
    return rays, first_from_second


@pytest.mark.parametrize("moved", [(0.3, 0.1, -0.2), (0.0, 0.0, 0.4)])
def test_matches_spread_about_the_true_rotation_s_planes_by_their_noise(moved):
    rays, true = see(1e-3, moved)
    spread = RayMoments.of(*rays).measure_spread(true[None])
    assert np.sqrt(spread) == pytest.approx([1e-3], rel=0.1)


def test_another_rotation_suits_exact_matches_less():
    rays, true = see(0.0)
    moments = RayMoments.of(*rays)
    turned = true @ so3_exp(np.radians(1) * np.eye(3))
    assert moments.measure_spread(true[None])[0] < 1e-10
    assert all(moments.measure_spread(other[None])[0] > 1e-7 for other in turned)
    # rays that are all alike say nothing, and are no error
    alike = RayMoments.of(rays[0][:, [0] * 40], rays[0][:, [0] * 40])
    assert alike.measure_spread(np.eye(3)[None])[0] < 1e-10


@pytest.mark.parametrize("moved", [(0.3, 0.1, -0.2), (0.0, 0.0, 0.4), (0.01, 0.0, 0.0)])
def test_poses_are_refined_whatever_some_matches_say(moved):
    """A tenth of the matches is wrong by ten times the noise; of a camera that hardly moved, only the turn is asked."""
    (first, second), first_from_second = see(1e-4, moved)
    rng = np.random.default_rng(3)
    wrong = rng.random(first.shape[1]) < 0.1
    second[0, wrong] += 1e-3 * rng.standard_normal((int(wrong.sum()), 3))
    second /= np.linalg.norm(second, axis=2, keepdims=True)
    true, direction = first_from_second.T, -(first_from_second.T @ np.array(moved)) / np.linalg.norm(moved)
    start = direction + 0.2 * rng.standard_normal(3)
    found = refine_poses(
        (so3_exp(np.radians([0.5, -1.0, 0.7])) @ true)[None], (start / np.linalg.norm(start))[None], first, second
    )
    off_deg = np.degrees(np.linalg.norm(so3_log(true.T @ found.second_from_first[0])))
    assert off_deg < 0.01
    assert found.usual_rad[0] == pytest.approx(1e-4, rel=0.25)
    if np.linalg.norm(moved) > 0.1:
        assert found.translation[0] @ direction == pytest.approx(1, abs=1e-4)
