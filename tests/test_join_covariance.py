"""Covariances across a gap, against derivatives of how two submodels lie, by finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.inertial.join.judge import Ends, relative_cov, worst
from colmap_inertial.inertial.join.placement import Placed
from colmap_inertial.inertial.join.values import ImuLink
from colmap_inertial.model.submodels.graph import Placements

PAIR = (2, 0)
FLOORS = (3e-3, 1e-3, 2e-3)


def placements():
    """Three submodels anywhere, and a covariance of where they lie."""
    rng = np.random.default_rng(7)
    places = Placements.at_origin(np.array([0.9, 1.1, 1.2]), 21)
    places.rotation[:] = so3_exp(rng.uniform(-1, 1, (3, 3)))
    places.translation[:] = rng.uniform(-3, 3, (3, 3))
    root = 1e-3 * rng.standard_normal((21, 21))
    placed = Placed(
        places=places, origins=rng.standard_normal((3, 3)), cov=root @ root.T, gravity_m_s2=np.zeros(3), squares=0.0,
        misfits=np.zeros((0, 6)), inflation=1.7,
    )  # fmt: skip
    return placed, rng.uniform(-4, 4, (2, 3)), rng


def seen_from_first(placed, points, change, turned=None, moved=None):
    """(6,) rotation and position of a point of one submodel as seen from one of another, along the world's axes.

    ``change`` (21,) logarithms of scales, rotations and translations; ``turned``, ``moved`` (2, 3): errors of the two
    poses themselves, along their submodels' axes.
    """
    at, turns = [], []
    for k, (place, point) in enumerate(zip(PAIR, points, strict=True)):
        step = change[7 * place : 7 * place + 7]
        scale, turn = placed.places.scale[place] * np.exp(step[0]), so3_exp(step[1:4])
        rotation = turn @ placed.places.rotation[place]
        own = np.zeros((2, 3)) if moved is None else moved
        error = placed.places.rotation[place] @ own[k]
        at.append(
            scale * rotation @ (point - placed.origins[place]) + placed.places.translation[place] + step[4:7] + error
        )
        error = np.zeros(3) if turned is None else placed.places.rotation[place] @ turned[k]
        turns.append(so3_exp(error) @ turn)
    return np.concatenate([so3_log(turns[0].T @ turns[1]), turns[0].T @ (at[1] - at[0])])


def slopes(function, size, step=1e-6):
    """(6, size) derivatives by central differences."""
    ends = [np.array([function(sign * step * row) for row in np.eye(size)]) for sign in (1, -1)]
    return (ends[0] - ends[1]).T / (2 * step)


def expected(placed, points):
    by = slopes(lambda change: seen_from_first(placed, points, change), 21)
    cov = placed.inflation * by @ placed.cov @ by.T
    between = seen_from_first(placed, points, np.zeros(21))[3:]
    # what lens and accelerometer leave is a share of the length
    cov[3:, 3:] += np.outer(between, between) * max(FLOORS[k] for k in PAIR) ** 2
    return cov


def test_how_sure_one_submodel_s_point_is_as_seen_from_another():
    placed, points, _ = placements()
    submodels = [SimpleNamespace(path=SimpleNamespace(floor_log=floor)) for floor in FLOORS]
    found = relative_cov(submodels, placed, points, PAIR)
    assert found == pytest.approx(expected(placed, points), rel=1e-6, abs=1e-12)


def test_the_poses_on_both_sides_of_a_gap_add_their_own_errors():
    placed, points, rng = placements()
    roots = 1e-2 * rng.standard_normal((2, 6, 6))
    nodes_s = {2: np.array([0.0, 1.0]), 0: np.array([1.5, 2.5])}
    submodels = []
    for k in range(3):
        own = PAIR.index(k) if k in PAIR else 0
        path = SimpleNamespace(
            floor_log=FLOORS[k], nodes_s=nodes_s.get(k), seen_cov=lambda node, own=own: roots[own] @ roots[own].T
        )
        t_s = np.arange(-0.93, 4.0, 0.1)
        centres = np.tile(points[own], (len(t_s), 1))
        # only the images beside the gap lie there
        centres[t_s < 1.2 if own else t_s > 1.2] += 9.0
        submodels.append(SimpleNamespace(path=path, trajectory=SimpleNamespace(t_s=t_s, cam_in_world=centres)))
    ends = Ends.of(submodels, ImuLink(first=2, second=0, from_node=1, to_node=0))
    before, after = (submodels[k].trajectory.t_s[i] for k, i in zip(PAIR, ends.images, strict=True))
    # the last image before the middle of the gap, and the first one behind it
    assert (before, after) == (pytest.approx(1.17), pytest.approx(1.27))
    assert ends.nodes == (1, 0)
    cov = expected(placed, points)
    for side in range(2):

        def moved(error, side=side):
            both = np.zeros((2, 6))
            both[side] = error
            return seen_from_first(placed, points, np.zeros(21), both[:, :3], both[:, 3:])

        by = slopes(moved, 6)
        cov += by @ roots[side] @ roots[side].T @ by.T
    assert ends.cov(submodels, placed) == pytest.approx(cov, rel=1e-6, abs=1e-12)


def test_the_worst_direction_is_the_largest_of_many():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 6))
    cov = root @ root.T
    directions = rng.standard_normal((20_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for found, part in zip(worst(cov), (slice(3, 6), slice(0, 3)), strict=True):
        most = np.sqrt(np.einsum("ni,ij,nj->n", directions, cov[part, part], directions).max())
        assert most <= found * (1 + 1e-12) and found == pytest.approx(most, rel=2e-3)
