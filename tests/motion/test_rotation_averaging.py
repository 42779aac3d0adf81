"""Rotations of frames by those of pairs of them, some of which are wrong."""

import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.motion.rotation_averaging import average_rotations


def pairs_of(count, steps=(1, 2, 4)):
    first = np.concatenate([np.arange(count - step) for step in steps])
    return first, first + np.repeat(steps, [count - step for step in steps])


def turning(count, seed):
    rng = np.random.default_rng(seed)
    turn = 0.05 * np.sin(np.arange(count)[:, None] * [0.31, 0.17, 0.23] + [0, 1, 2]) + 0.01 * rng.standard_normal(
        (count, 3)
    )
    world_from_cam = [np.eye(3)]
    for step in so3_exp(turn[:-1]):
        world_from_cam.append(world_from_cam[-1] @ step)
    return np.array(world_from_cam)


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.25])
def test_wrong_pairs_are_outvoted(wrong):
    poses, rng = turning(120, 3), np.random.default_rng(5)
    first, second = pairs_of(120)
    noise = np.radians(0.1) * rng.standard_normal((len(first), 3))
    bad = rng.random(len(first)) < wrong
    noise[bad] += np.radians(8) * rng.standard_normal((int(bad.sum()), 3))
    measured = np.swapaxes(poses[first], 1, 2) @ poses[second] @ so3_exp(noise)
    found = average_rotations(120, first, second, measured)
    true = so3_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:])
    off = np.degrees(np.linalg.norm(found - true, axis=1))
    assert np.median(off) < 0.15 and np.mean(off > 1) < 0.03
    if not wrong:  # better than one pair by itself, whose usual error is .154
        assert np.median(off) < 0.14


def test_frames_that_nothing_connects_are_not_known():
    poses = turning(20, 1)
    first, second = pairs_of(20)
    apart = (first < 10) == (second < 10)
    first, second = first[apart], second[apart]
    found = average_rotations(20, first, second, np.swapaxes(poses[first], 1, 2) @ poses[second])
    assert np.flatnonzero(~np.isfinite(found).all(axis=1)).tolist() == [9]
    true = so3_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:])
    assert np.delete(found, 9, axis=0) == pytest.approx(np.delete(true, 9, axis=0), abs=1e-6)
    nothing = average_rotations(5, first[:0], second[:0], np.zeros((0, 3, 3)))
    assert nothing.shape == (4, 3) and not np.isfinite(nothing).any()


def test_a_frame_that_its_neighbour_does_not_see_is_reached_by_others():
    poses = turning(30, 2)
    first, second = pairs_of(30)
    kept = (second - first > 1) | (first % 5 != 0)
    first, second = first[kept], second[kept]
    found = average_rotations(30, first, second, np.swapaxes(poses[first], 1, 2) @ poses[second])
    assert found == pytest.approx(so3_log(np.swapaxes(poses[:-1], 1, 2) @ poses[1:]), abs=1e-6)
