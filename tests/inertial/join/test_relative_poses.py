"""Covariances across a gap, against derivatives of how two submodels lie, by finite differences."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_exp, so3_log
from colmap_inertial.inertial.join import joined_model
from colmap_inertial.inertial.join.placement import ImuLink, Placed
from colmap_inertial.inertial.join.relative_poses import end_images, relative_cov, tie_cov, worst_sigmas
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.model.similarities import compose
from colmap_inertial.model.submodels.graph import Placements, SimilarityConstraint

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
    link = ImuLink(first=2, second=0, from_node=1, to_node=0)
    before, after = (submodels[k].trajectory.t_s[i] for k, i in zip(PAIR, end_images(submodels, link), strict=True))
    # the last image before the middle of the gap, and the first one behind it
    assert (before, after) == (pytest.approx(1.17), pytest.approx(1.27))
    cov = expected(placed, points)
    for side in range(2):

        def moved(error, side=side):
            both = np.zeros((2, 6))
            both[side] = error
            return seen_from_first(placed, points, np.zeros(21), both[:, :3], both[:, 3:])

        by = slopes(moved, 6)
        cov += by @ roots[side] @ roots[side].T @ by.T
    assert tie_cov(submodels, placed, link) == pytest.approx(cov, rel=1e-6, abs=1e-12)
    # the same two images as the first that a constraint was measured by: the nodes are those next to them
    images = np.array([end_images(submodels, link), (0, 0)])
    shared = object.__new__(SimilarityConstraint)
    for name, value in (("first", 2), ("second", 0), ("images", images)):
        object.__setattr__(shared, name, value)
    for k, node in ((2, link.from_node), (0, link.to_node)):
        there = submodels[k].path.seen_cov(node)
        submodels[k].path.seen_cov = {node: there, 1 - node: np.eye(6)}.get
    assert tie_cov(submodels, placed, shared) == pytest.approx(cov, rel=1e-6, abs=1e-12)


def test_a_visual_pose_errs_by_its_rotation_and_by_what_that_carries_along():
    rng = np.random.default_rng(4)
    world_from_imu, cam_from_imu = so3_exp(rng.uniform(-1, 1, (2, 3)))
    camera, coupling, learned = world_from_imu @ cam_from_imu.T, *rng.standard_normal((2, 3, 3))
    # square roots of the information, of a standard deviation of one
    shapes = np.linalg.inv(np.eye(3) + 0.3 * rng.standard_normal((2, 3, 3)))
    noise = SimpleNamespace(rotation_rad=2e-3, rotation_excess=1.5, centre_m=5e-3, drift_m2=1e-6)
    x = SimpleNamespace(
        world_from_imu=world_from_imu[None], cam_from_imu=cam_from_imu, coupling_m=learned, metres_per_unit=0.4
    )
    data = SimpleNamespace(rotation_shape=shapes[:1], centre_shape=shapes[1:], coupling=coupling[None])
    path = FittedPath(
        origin=np.zeros(3), floor_log=0.0, _data=data, _fit=SimpleNamespace(estimate=x, noise=noise), _aligned=None,
        _stamps_s=np.zeros((2, 2)), _widened=1.0, _shift_log=0.0,
    )  # fmt: skip
    # whitened errors: of the rotation in the camera, which turns the camera the other way, of the centre, and a drift
    turned, moved = 2e-3 * np.linalg.inv(shapes[0]), 5e-3 * np.linalg.inv(shapes[1])
    carried = camera @ (learned + 0.4 * coupling) @ turned
    root = np.block([[-camera @ turned, np.zeros((3, 6))], [carried, moved, 1e-3 * np.eye(3)]])
    assert path.seen_cov(0) == pytest.approx(root @ root.T, rel=1e-9, abs=1e-15)
    # many of them, each as one of a chain that errs alike
    assert path.seen_variances == pytest.approx((9e-6, 2.6e-5))


def test_the_worst_direction_is_the_largest_of_many():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 6))
    cov = root @ root.T
    directions = rng.standard_normal((20_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for found, part in zip(worst_sigmas(cov), (slice(3, 6), slice(0, 3)), strict=True):
        most = np.sqrt(np.einsum("ni,ij,nj->n", directions, cov[part, part], directions).max())
        assert most <= found * (1 + 1e-12) and found == pytest.approx(most, rel=2e-3)


def changed(placed, change):
    """The same submodels, moved a little."""
    before, steps = placed.places, change.reshape(3, 7)
    places = Placements.at_origin(before.scale * np.exp(steps[:, 0]), 21)
    places.rotation[:] = so3_exp(steps[:, 1:4]) @ before.rotation
    places.translation[:] = before.translation + steps[:, 4:]
    return replace(placed, places=places)


def parameters(similarity, reference):
    """(7,) from one similarity to another: logarithm of scale, rotation, translation."""
    turn = matrix_from_quat(similarity.rotation_xyzw) @ matrix_from_quat(reference.rotation_xyzw).T
    log_scale = np.log(similarity.scale / reference.scale)
    return np.concatenate([[log_scale], so3_log(turn), similarity.translation_m - reference.translation_m])


def apply(similarity, points):
    return similarity.scale * points @ matrix_from_quat(similarity.rotation_xyzw).T + similarity.translation_m


def test_the_similarity_of_a_submodel_moves_its_points_and_is_as_sure_as_where_it_lies(subtests):
    for world in ("y-down", "z-up"):
        with subtests.test(world=world):
            placed, points, _ = placements()
            placed = replace(placed, gravity_m_s2=np.array([3.0, -7.0, 6.0]))
            moves = [joined_model._metric_move(placed, k, world) for k in range(3)]
            # the world is turned upright, and what was the first one's origin stays
            apart = np.array([apply(moves[k], points) for k in range(3)])
            before = np.array([placed.points(k, points) for k in range(3)])
            up = matrix_from_quat(moves[0].rotation_xyzw) @ placed.places.rotation[0].T
            np.testing.assert_allclose(apart, before @ up.T + placed.origins[0], atol=1e-9)
            down = up @ placed.gravity_m_s2 / np.linalg.norm(placed.gravity_m_s2)
            np.testing.assert_allclose(down, [0, 1, 0] if world == "y-down" else [0, 0, -1], atol=1e-9)
            for k in range(3):
                by = np.zeros((7, 7))
                for column in range(7):
                    ends = []
                    for sign in (1, -1):
                        change = np.zeros(21)
                        change[7 * k + column] = sign * 1e-6
                        ends.append(parameters(joined_model._metric_move(changed(placed, change), k, world), moves[k]))
                    by[:, column] = (ends[0] - ends[1]) / 2e-6
                own = slice(7 * k, 7 * k + 7)
                expected_cov = placed.inflation * by @ placed.cov[own, own] @ by.T
                found = joined_model._similarity_cov(placed, k, moves[k])
                assert found == pytest.approx(expected_cov, rel=1e-6, abs=1e-12)


def test_a_similarity_after_another_is_both_in_turn():
    placed, points, _ = placements()
    placed = replace(placed, gravity_m_s2=np.array([3.0, -7.0, 6.0]))
    first, then = (joined_model._metric_move(placed, k, "z-up") for k in (1, 2))
    both = compose(then, first)
    np.testing.assert_allclose(apply(both, points), apply(then, apply(first, points)), atol=1e-9)


def test_a_longer_metre_and_a_turned_world_move_a_similarity():
    """Of a similarity, after the whole world was scaled and turned about its origin."""
    placed, _, _ = placements()
    placed = replace(placed, gravity_m_s2=np.array([3.0, -7.0, 6.0]))
    move = joined_model._metric_move(placed, 1, "z-up")

    def of(change):
        scale, turn = np.exp(change[0]), so3_exp(change[1:])
        whole = replace(
            move,
            scale=scale * move.scale,
            rotation_xyzw=quat_from_matrix(turn @ matrix_from_quat(move.rotation_xyzw)),
            translation_m=scale * turn @ move.translation_m,
        )
        return parameters(whole, move)

    assert joined_model._world_jacobian(move.translation_m) == pytest.approx(slopes(of, 4), abs=1e-7)


def test_a_scale_s_standard_deviation_becomes_what_is_known_and_never_larger():
    root = np.random.default_rng(5).standard_normal((7, 7))
    cov = root @ root.T
    before = np.sqrt(np.diagonal(cov))
    narrower = joined_model._reduce_scale_sigma(cov, 0.5 * before[0])
    np.testing.assert_allclose(np.sqrt(np.diagonal(narrower)), before * [0.5, 1, 1, 1, 1, 1, 1])
    # correlations stay
    np.testing.assert_allclose(
        narrower / np.sqrt(np.outer(np.diagonal(narrower), np.diagonal(narrower))), cov / np.outer(before, before)
    )
    np.testing.assert_array_equal(joined_model._reduce_scale_sigma(cov, 2 * before[0]), cov)
    assert not joined_model._reduce_scale_sigma(np.zeros((7, 7)), 1.0).any()


def test_what_the_fit_does_not_say_of_a_scale_stays_when_it_is_joined():
    placed, _, _ = placements()
    of_fit, whole = 4e-4, 9e-4
    model = SimpleNamespace(scale=SimpleNamespace(sigma_log=whole**0.5))
    submodel = SimpleNamespace(path=SimpleNamespace(scale=(1.0, of_fit)))
    for variance, left in ((1e-4, 1.7e-4), (3e-4, of_fit)):
        cov = placed.cov.copy()
        cov[7, 7] = variance
        sigma = joined_model._sigma_log(model, submodel, replace(placed, cov=cov), 1)
        assert sigma**2 == pytest.approx(left + whole - of_fit)
    assert joined_model._scale_variance_beside(model, SimpleNamespace(path=SimpleNamespace(scale=(1.0, 1e-3)))) == 0
