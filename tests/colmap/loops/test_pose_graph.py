"""Loops on tracks that drift as known: covariances are those of the errors, copies are refused, the rest is kept."""

from dataclasses import replace

import numpy as np

from colmap_inertial.colmap.loops import pose_graph as loop_graph
from colmap_inertial.colmap.loops.pose_graph import select_likely_loops, select_loops
from colmap_inertial.colmap.views.relative_track import DRIFT, LoopPose
from colmap_inertial.core.geometry import so3_exp, so3_log
from tests.colmap.matching.test_pairing import circle, headings_of, way_along

RATE_HZ, DEPTH_M = 8.0, 2.0


class DriftingWalk:
    """A walk, and the track of it that drifts in length and orientation; what matches of two frames would say."""

    def __init__(self, place_m, heading_deg, rng, *, drift=DRIFT, bias_sigma=1e-3):
        count = len(place_m)
        self.rng, self.place_m = rng, place_m
        self.orientations = headings_of(heading_deg, np.arange(count) / RATE_HZ, bias_sigma=bias_sigma)
        self.log_length = np.concatenate([[0], np.cumsum(drift * rng.standard_normal(count - 1))])
        # a bias that is wrong turns all frames about one axis, the later the more
        sigma_rad = self.orientations.sigma_rad(np.zeros(count, dtype=np.intp), np.arange(count))
        self.true_from_start = so3_exp(sigma_rad[:, None] * rng.standard_normal(3))
        steps = np.diff(place_m, axis=0)[:, None, :] @ self.true_from_start[:-1]
        steps = np.exp(-self.log_length[:-1, None]) * steps[:, 0]
        self.track = way_along(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))

    def loop(self, i, j, off_m=(0, 0, 0), *, noise=0.3, matches=100):
        """The pose of a loop whose second frame seems to be so far off; noise as a share of what is allowed for."""
        start_from_true = self.true_from_start[i].T
        unit = np.exp(-self.log_length[i])
        draw = noise * self.rng.standard_normal(7)
        turned = start_from_true @ self.true_from_start[j] @ self.orientations.start_from_cam[j]
        step = unit * start_from_true @ (self.place_m[j] + off_m - self.place_m[i])
        return LoopPose(
            step=step + 0.1 * DEPTH_M * unit * draw[:3],
            start_from_second=so3_exp(np.radians(1.5) * draw[3:6]) @ turned,
            ratio=float(np.exp(self.log_length[j] - self.log_length[i] + 0.1 * draw[6])),
            depth=DEPTH_M * unit,
            matches=matches,
        )


def laps(count, each):
    """Around a block of 12 by 8 m, so many frames each time, and where one looks."""
    corners = np.array([[0, 0, 0], [12, 0, 0], [12, 8, 0], [0, 8, 0], [0, 0, 0]], dtype=float)
    ends = np.cumsum([0, 12, 8, 12, 8])
    along = 40 * np.arange(count) / each
    place = np.stack([np.interp(along % 40, ends, column) for column in corners.T], axis=1)
    heading = np.interp(along % 40, [0, 11, 13, 19, 21, 31, 33, 39, 40], [0, 0, 90, 90, 180, 180, 270, 270, 315])
    return place, heading + 360 * (along // 40)


def walked_laps(seed, *, groups=6):
    """Three laps with loops between them, and groups of false ones: by pair, and which are false."""
    rng, each = np.random.default_rng([seed, 4]), 240
    walk = DriftingWalk(*laps(3 * each, each), rng)
    true = {(i, i + each) for i in range(0, 2 * each, 6)} | {(i, i + 2 * each) for i in range(3, each, 12)}
    loops = {pair: walk.loop(*pair) for pair in sorted(true)}
    false = set()
    while len(false) < 10 * groups:
        i, j = int(rng.integers(0, each - 12)), int(rng.integers(2 * each, 3 * each - 12))
        off_m = walk.place_m[i] - walk.place_m[j]
        if np.linalg.norm(off_m) > 3:
            # a copy of the place, and all that is beside it
            copies = {(i + k, j + k): walk.loop(i + k, j + k, off_m, matches=120) for k in range(10)}
            false |= copies.keys() - loops.keys()
            loops |= {pair: pose for pair, pose in copies.items() if pair not in true}
    return walk, loops, false


def test_copies_are_refused_where_the_track_alone_excludes_few_of_them():
    copies = passed = 0
    for seed in range(8):
        walk, loops, false = walked_laps(seed)
        true = loops.keys() - false
        likely = select_likely_loops(walk.track, walk.orientations, loops)
        copies, passed = copies + len(false), passed + len(likely & false)
        assert len(likely & true) > 0.98 * len(true)
        selected = select_loops(walk.track, walk.orientations, loops)
        assert not selected & false
        assert len(selected & true) > 0.98 * len(true)
    assert passed > 0.3 * copies


def test_selection_does_not_depend_on_the_order_of_loops():
    walk, loops, _ = walked_laps(7)
    shuffled = dict(sorted(loops.items(), key=lambda item: hash(item[0]) % 101))
    assert select_loops(walk.track, walk.orientations, shuffled) == select_loops(walk.track, walk.orientations, loops)


def test_the_only_loop_of_a_long_walk_is_closed_and_one_beside_it_with_as_many_matches_closes_neither():
    rng = np.random.default_rng(3)
    walk = DriftingWalk(*laps(250, 240), rng)
    true = {(i, i + 240): walk.loop(i, i + 240) for i in range(6)}
    assert select_loops(walk.track, walk.orientations, true) == true.keys()
    copies = {(i + 16, i + 240): walk.loop(i + 16, i + 240, (3.0, 0, 0)) for i in range(6)}
    assert select_loops(walk.track, walk.orientations, true | copies) == set()
    few = {(i + 16, i + 240): walk.loop(i + 16, i + 240, (3.0, 0, 0), matches=45) for i in range(6)}
    assert select_loops(walk.track, walk.orientations, true | few) == true.keys()
    # what is farther away is no surer
    far = {pair: replace(pose, depth=1.6 * pose.depth) for pair, pose in few.items()}
    assert select_loops(walk.track, walk.orientations, true | far) == true.keys()
    far = {pair: replace(pose, depth=1.6 * pose.depth) for pair, pose in copies.items()}
    assert select_loops(walk.track, walk.orientations, true | far) == set()


def test_loops_are_found_where_the_orientation_has_turned_far():
    rng = np.random.default_rng(0)
    walk = DriftingWalk(*laps(4000, 240), rng)
    assert np.linalg.norm(so3_log(walk.true_from_start[-1])) > 0.8
    loops = {(i, 3600 + i): walk.loop(i, 3600 + i) for i in range(0, 240, 30)}
    assert select_loops(walk.track, walk.orientations, loops) == loops.keys()


def test_a_gain_that_is_off_costs_no_loop_after_turning_back():
    """An eight: the variance of the heading falls when the camera turns back, that of each turn does not."""
    heading = np.concatenate([np.zeros(40), np.linspace(0, 360, 200), np.full(40, 360.0), np.linspace(360, 0, 200)])
    heading = np.concatenate([heading, np.zeros(40)])
    step = 0.15 * np.stack([np.cos(np.radians(heading)), 0 * heading, -np.sin(np.radians(heading))], axis=1)
    place = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)[:-1]])
    walk = DriftingWalk(place, heading, np.random.default_rng(1), drift=0.005, bias_sigma=1e-4)
    off = so3_exp(np.stack([0 * heading, 0.02 * np.radians(heading), 0 * heading], axis=1))
    steps = np.exp(-walk.log_length[:-1, None]) * (np.diff(place, axis=0)[:, None, :] @ off[:-1])[:, 0]
    walk.true_from_start = off
    walk.track = way_along(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))
    second, third = np.arange(240, 280), np.arange(480, 520, 2)
    near = [int(second[np.argmin(np.linalg.norm(place[second] - place[k], axis=1))]) for k in third]
    loops = {(i, int(j)): walk.loop(i, int(j)) for i, j in zip(near, third, strict=True)}
    assert select_likely_loops(walk.track, walk.orientations, loops) == loops.keys()


def test_orientations_are_as_unsure_as_the_bias_makes_them():
    """Nobody turns, all steps are alike: the bias is all there is, and turns frame after frame the same way."""
    along = np.linspace(0, 20, 401)
    walk = DriftingWalk(np.stack([along, 0 * along, 0 * along], axis=1), 0 * along, np.random.default_rng(1))
    nodes = np.arange(0, 401, 8)
    graph = loop_graph._Graph.of(walk.track, walk.orientations, nodes)
    ends = replace(graph.odometry.only([0]), a=np.array([0]), b=np.array([50]))
    (covariance,) = graph.adjusted(graph.odometry.only(slice(0))).covariances(ends)
    # the rotation between the sensors is the same at both ends
    still_rad, whole_rad = walk.orientations.sigma_rad(np.array([0, 0]), np.array([0, 400]))
    grown_rad = np.sqrt(whole_rad**2 - still_rad**2)
    assert 0.93 < np.sqrt(np.diagonal(covariance)[4:]).mean() / grown_rad < 1.05  # a bias that walks is left out
    assert grown_rad > np.radians(2)


def test_rotations_across_a_gap_of_the_gyroscope_are_not_believed():
    walk = DriftingWalk(*laps(300, 240), np.random.default_rng(2), drift=0.003)
    turned = so3_exp(np.array([0, 0, 0.5]))
    walk.true_from_start[150:] = turned @ walk.true_from_start[150:]
    steps = (np.diff(walk.place_m, axis=0)[:, None, :] @ walk.true_from_start[:-1])[:, 0]
    walk.track = way_along(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))
    walk.log_length[:] = 0
    loops = {(i, i + 240): walk.loop(i, i + 240) for i in range(0, 60, 6)}
    assert not select_likely_loops(walk.track, walk.orientations, loops)
    parts = replace(walk.orientations, part=(np.arange(300) >= 150).astype(np.intp))
    assert select_likely_loops(walk.track, parts, loops) == loops.keys()


def test_loops_that_pull_apart_are_not_both_in_the_graph():
    walk = DriftingWalk(*laps(300, 240), np.random.default_rng(6), drift=0.0, bias_sigma=1e-6)
    (part,) = loop_graph._split_by_part(walk.track, {(i, i + 240): walk.loop(i, i + 240, noise=0) for i in (0, 2)})
    loops, depth, matches = loop_graph._attach_loops(walk.track, walk.orientations, part)
    graph = loop_graph._Graph.of(walk.track, walk.orientations, part.nodes)
    loops.step[:] += np.array([[0.8, 0, 0], [-0.8, 0, 0]])
    surer = replace(loops, sigma=loops.sigma * np.array([0.05, 0.05, 0.05, 1, 1, 1, 1]))
    closed, accepted = loop_graph._accept_loops(graph, surer, 1e3 * depth, matches)
    np.testing.assert_allclose(closed.place, graph.adjusted(surer.only(accepted)).place, atol=1e-4)
    assert accepted.sum() < 2


def test_poses_that_are_no_numbers_end_the_grouping():
    _, edges = a_graph()
    off = np.full((len(edges.a), 7), np.nan)
    best, group = loop_graph._group_agreeing(off, edges, np.ones(len(edges.a)))
    assert len(best) == len(group) == 3


def test_loops_of_each_part_of_a_track_are_judged_by_that_part():
    rng = np.random.default_rng(5)
    walk = DriftingWalk(*laps(500, 120), rng, drift=0.002)
    track = replace(walk.track, part=(np.arange(500) > 249).astype(np.intp))
    good = {(i, i + 120): walk.loop(i, i + 120) for i in [*range(0, 100, 5), *range(260, 370, 5)]}
    bad = {(i + 2, i + 122): walk.loop(i + 2, i + 122, (2.5, 0, 0), matches=20) for i in [10, 40, 300, 330]}
    assert select_loops(track, walk.orientations, good | bad) == good.keys()
    assert select_loops(track, walk.orientations, {}) == set() == select_likely_loops(track, walk.orientations, {})


def test_errors_of_loops_are_as_large_as_their_covariances():
    """Drift and noise as they are allowed for, across the ground and in length; rotations err by less."""
    shares, squares = [], []
    for seed in range(200):
        walk = DriftingWalk(*laps(170, 120), np.random.default_rng([seed, 8]), bias_sigma=3e-4)
        (part,) = loop_graph._split_by_part(walk.track, {(20, 141): walk.loop(20, 141, noise=1.0)})
        edge, _, _ = loop_graph._attach_loops(walk.track, walk.orientations, part)
        graph = loop_graph._Graph.of(walk.track, walk.orientations, part.nodes).adjusted(edge.only(slice(0)))
        off, covariance = graph.residuals(edge)[0][0], (graph.covariances(edge) + edge.covariance)[0]
        shares.append(off**2 / np.diag(covariance))
        squares.append(off @ np.linalg.solve(covariance, off))
    mean = np.mean(shares, axis=0)
    assert (mean[[0, 1, 3]] > 0.65).all() and (mean[[0, 1, 3]] < 1.2).all() and (mean < 1.2).all()
    assert np.mean(np.array(squares) < 24.3) > 0.98


def a_graph():
    rng = np.random.default_rng(9)
    walk = DriftingWalk(circle(60), np.linspace(0, 360, 60), rng)
    (part,) = loop_graph._split_by_part(walk.track, {pair: walk.loop(*pair) for pair in [(0, 57), (2, 49), (17, 40)]})
    edges, _, _ = loop_graph._attach_loops(walk.track, walk.orientations, part)
    return loop_graph._Graph.of(walk.track, walk.orientations, part.nodes), edges


def moved(graph, change):
    by = change.reshape(-1, 7)
    return replace(
        graph,
        place=graph.place + by[:, :3],
        log_length=graph.log_length + by[:, 3],
        turn=so3_exp(by[:, 4:]) @ graph.turn,
    )


def differences(graph, edges):
    """(7 M, 7 K) derivatives of all residuals by all unknowns, by differences."""
    size, step = 7 * len(graph.place), 1e-6
    columns = []
    for change in step * np.eye(size):
        ahead, behind = (moved(graph, sign * change).residuals(edges)[0] for sign in (1, -1))
        columns.append(((ahead - behind) / (2 * step)).ravel())
    return np.array(columns).T


def test_derivatives_are_those_of_the_residuals():
    graph, edges = a_graph()
    rng = np.random.default_rng(2)
    graph = moved(graph, 0.3 * rng.standard_normal((len(graph.place), 7)))
    # what remains is small, as where a graph is adjusted
    turned = np.swapaxes(graph.turn[edges.a], 1, 2) @ graph.turn[edges.b] @ graph.start_from_cam[edges.b]
    edges = replace(edges, start_from_b=so3_exp(0.02 * rng.standard_normal((len(edges.a), 3))) @ turned)
    full = np.zeros((7 * len(edges.a), 7 * len(graph.place)))
    for k, (rows, columns) in enumerate(zip(graph.residuals(edges)[1], edges.columns, strict=True)):
        full[7 * k : 7 * k + 7, columns] = rows
    np.testing.assert_allclose(full, differences(graph, edges), atol=2e-6)


def test_covariances_are_those_of_the_whole_inverse():
    graph, loops = a_graph()
    graph = graph.adjusted(loops.only([0]))
    every = graph.odometry.followed_by(loops.only([0]))
    by = (differences(graph, every) / every.sigma.reshape(-1, 1))[:, 7:]
    inverse = np.linalg.inv(by.T @ by)
    of_loops = differences(graph, loops)[:, 7:]
    expected = (of_loops @ inverse @ of_loops.T).reshape(3, 7, 3, 7).swapaxes(1, 2)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(graph.covariances(loops), expected[range(3), range(3)], atol=0.05 * scale)
    np.testing.assert_allclose(graph.covariances(loops.only([0, 2]), loops), expected[:, [0, 2]], atol=0.05 * scale)
    # a loop that is in the graph is surer than its measurement alone
    assert (np.diagonal(graph.covariances(loops)[0]) < loops.sigma[0] ** 2).all()


def test_an_adjusted_graph_has_the_least_squares(monkeypatch):
    graph, loops = a_graph()
    found = graph.adjusted(loops)
    every = graph.odometry.followed_by(loops)

    def squares(of):
        return float(np.sum((of.residuals(every)[0] / every.sigma) ** 2))

    assert squares(found) < 0.8 * squares(graph)
    assert not found.place[0].any() and found.log_length[0] == 0
    rng = np.random.default_rng(4)
    for _ in range(20):
        change = 0.02 * rng.standard_normal((len(graph.place), 7))
        change[0] = 0
        assert squares(moved(found, change)) > squares(found)
