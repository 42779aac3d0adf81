"""Selection of loops by a pose graph: the relative track as odometry, with the loops that are accepted so far.

Where a track of minutes ends is so unsure that it excludes no copy of a place. Loops that are accepted make it sure
again, and the rest are judged by it: sequential compatibility (J. Neira, J. D. Tardos, *Data association in stochastic
mapping using the joint compatibility test*, IEEE T-RO 2001). Where it is still unsure, loops that contradict each
other compete (J. G. Mangelson et al., *Pairwise consistent measurement set maximization*, ICRA 2018).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np

from colmap_inertial.colmap.views.relative_track import DRIFT, FramePair, LoopPose, RelativeTrack
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.geometry import skew, so3_exp, so3_log
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.model.submodels.graph import PLACEMENT


class Orientations(Protocol):
    """Orientations of N frames, as ``GyroOrientations`` has them."""

    @property
    def start_from_cam(self) -> Array:
        """(N, 3, 3)."""
        ...

    def sigma_rad(self, i: IndexArray, j: IndexArray) -> Array:
        """(M,) standard deviations of the rotations between frames i and j."""
        ...

    def known(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether the rotations between frames i and j were measured."""
        ...


@dataclass(frozen=True, kw_only=True)
class LoopNoise:
    """Standard deviations of a loop's pose, and limits of its acceptance."""

    #: Places of a loop's frames, as a share of how far away its points are; logarithms of lengths; rotations.
    place_sigma: float = 0.1
    length_sigma: float = 0.1
    rotation_sigma_rad: float = math.radians(1.5)
    #: Seven numbers whose squares add up to more, over their covariance, disagree: one in a thousand.
    agree_7: float = 24.3
    #: A loop whose place the graph predicts as well as this share of its depth has no rivals.
    sure: float = 0.1
    #: Of others, those compete that are predicted no worse than so many times the best one, and no more at once.
    alike: float = 1.5
    rivals: int = 30
    #: Of loops that contradict each other, one must have so many times the matches behind it.
    by_far: float = 2.0


@dataclass(frozen=True, kw_only=True)
class GraphLimits:
    """Limits of the pose graph."""

    #: From one frame that is a node to the next.
    every: int = 8
    #: A step of the track is as sure as this share of its path, and of how far away things are.
    of_path: float = 0.02
    of_depth: float = 1e-3
    least_rotation_rad: float = 1e-4
    #: Of a rotation that the gyroscope did not measure.
    gap_rad: float = 1.0
    #: Gauss-Newton: rounds, and the largest step at rest.
    rounds: int = 10
    step: float = 1e-3
    #: Predictions that are solved for at once.
    at_once: int = 64


_NOISE, _LIMITS = LoopNoise(), GraphLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class _Edges:
    """M measured poses of nodes b from nodes a, as :class:`LoopPose` has them.

    Attributes
    ----------
    a, b
        (M,) nodes.
    step, longer, start_from_b
        (M, 3), (M,) logarithms of the ratio of lengths, (M, 3, 3).
    sigma
        (M, 7) standard deviations of all three.
    """

    a: IndexArray
    b: IndexArray
    step: Array
    longer: Array
    start_from_b: Array
    sigma: Array

    def only(self, which: Any) -> _Edges:
        return _Edges(**{name: values[which] for name, values in vars(self).items()})

    def followed_by(self, other: _Edges) -> _Edges:
        return _Edges(**{name: np.concatenate([mine, vars(other)[name]]) for name, mine in vars(self).items()})

    @property
    def covariance(self) -> Array:
        """(M, 7, 7) of what was measured."""
        return self.sigma[:, :, None] ** 2 * np.eye(PLACEMENT)

    @property
    def columns(self) -> IndexArray:
        """(M, 14) unknowns of both nodes."""
        own = np.arange(PLACEMENT)
        return np.concatenate([PLACEMENT * self.a[:, None] + own, PLACEMENT * self.b[:, None] + own], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Graph:
    """K nodes of one part of a track; the first one is held.

    Attributes
    ----------
    place, log_length, turn
        (K, 3), (K,) and (K, 3, 3): where a node is, how much longer the track is there, and the rotation by which its
        orientation is off.
    start_from_cam
        (K, 3, 3) orientations by the gyroscope.
    odometry
        From each node to the next.
    factor
        Of the information about the unknowns of all nodes but the first: of each the place, length and rotation.
    """

    place: Array
    log_length: Array
    turn: Array
    start_from_cam: Array
    odometry: _Edges
    factor: Any = None

    @classmethod
    def of(cls, track: RelativeTrack, orientations: Orientations, nodes: IndexArray) -> Self:
        place, count = track.centre[nodes] - track.centre[nodes[0]], np.diff(nodes)
        walked = np.cumsum(np.linalg.norm(np.diff(track.centre, axis=0, prepend=track.centre[:1]), axis=1))
        path = np.diff(walked[nodes])
        # a bias turns all steps the same way, and the variance of the sum is the square of the sum
        # but for what does not grow from frame to frame: the rotation between the sensors, and their clocks' offset
        still = orientations.sigma_rad(nodes, nodes) ** 2
        grown = orientations.sigma_rad(nodes[:-1], nodes[1:]) ** 2 - (still[:-1] + still[1:]) / 2
        summed = np.concatenate([[0.0], np.cumsum(np.sqrt(np.maximum(grown, 0.0)))])
        turn = np.sqrt(np.diff(summed**2) + _LIMITS.least_rotation_rad**2)
        turn = np.where(orientations.known(nodes[:-1], nodes[1:]), turn, _LIMITS.gap_rad)
        depth = np.nan_to_num(np.array([track.depth(k) for k in nodes[1:]]), nan=1.0)  # the first step's length
        drift = DRIFT**2 * count
        off = np.sqrt((drift / 3 + turn**2 / 3 + _LIMITS.of_path**2) * path**2 + (_LIMITS.of_depth * depth) ** 2)
        odometry = _Edges(
            a=np.arange(len(count)),
            b=np.arange(1, len(nodes)),
            step=np.diff(place, axis=0),
            longer=np.zeros(len(count)),
            start_from_b=orientations.start_from_cam[nodes[1:]],
            sigma=np.column_stack([off, off, off, np.sqrt(drift), turn, turn, turn]),
        )
        return cls(
            place=place,
            log_length=np.zeros(len(nodes)),
            turn=np.tile(np.eye(3), (len(nodes), 1, 1)),
            start_from_cam=orientations.start_from_cam[nodes],
            odometry=odometry,
        )

    def residuals(self, edges: _Edges) -> tuple[Array, Array]:
        """(M, 7) by how much edges are off, and (M, 7, 14) derivatives by both nodes."""
        a, b = edges.a, edges.b
        a_from_start, shorter = np.swapaxes(self.turn[a], 1, 2), np.exp(-self.log_length[a])
        apart = self.place[b] - self.place[a]
        scaled = shorter[:, None, None] * a_from_start
        step = np.einsum("mij,mj->mi", scaled, apart)
        orientation = a_from_start @ self.turn[b] @ self.start_from_cam[b]
        twist = so3_log(orientation @ np.swapaxes(edges.start_from_b, 1, 2))
        longer = self.log_length[b] - self.log_length[a] - edges.longer
        by = np.zeros((len(a), PLACEMENT, 2 * PLACEMENT))
        by[:, :3, :3], by[:, :3, 7:10], by[:, :3, 3], by[:, :3, 4:7] = -scaled, scaled, -step, scaled @ skew(apart)
        by[:, 3, 3], by[:, 3, 10] = -1, 1
        # derivative of the logarithm by a rotation on the left, to second order
        across = skew(twist)
        by[:, 4:, 11:] = (np.eye(3) - 0.5 * across + across @ across / 12) @ a_from_start
        by[:, 4:, 4:7] = -by[:, 4:, 11:]
        return np.column_stack([step - edges.step, longer, twist]), by

    def adjusted(self, loops: _Edges) -> _Graph:
        """The graph with these loops."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.linalg import splu

        graph, edges = self, self.odometry.followed_by(loops)
        columns, size = edges.columns, PLACEMENT * len(self.place)
        rows = np.broadcast_to(columns[:, :, None], (len(columns), 14, 14)).ravel()
        others = np.broadcast_to(columns[:, None, :], (len(columns), 14, 14)).ravel()
        for _ in range(_LIMITS.rounds):
            off, by = graph.residuals(edges)
            off, by = off / edges.sigma, by / edges.sigma[:, :, None]
            information = coo_matrix(((np.swapaxes(by, 1, 2) @ by).ravel(), (rows, others)), shape=(size, size)).tocsc()
            gradient = np.bincount(columns.ravel(), np.einsum("mra,mr->ma", by, off).ravel(), size)
            options = {"SymmetricMode": True}
            factor = splu(information[PLACEMENT:, PLACEMENT:], "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
            step = np.concatenate([np.zeros(PLACEMENT), -factor.solve(gradient[PLACEMENT:])]).reshape(-1, PLACEMENT)
            graph = replace(
                graph,
                place=graph.place + step[:, :3],
                log_length=graph.log_length + step[:, 3],
                turn=so3_exp(step[:, 4:]) @ graph.turn,
                factor=factor,
            )
            if np.abs(step).max() < _LIMITS.step:
                break
        return graph

    def covariances(self, edges: _Edges, others: _Edges | None = None) -> Array:
        """(M, 7, 7) covariances of edges as nodes predict them, or (L, M, 7, 7) of ``others`` with them."""
        from scipy.sparse import csr_matrix

        def derivatives(of: _Edges) -> csr_matrix:
            rows = np.broadcast_to(
                np.arange(PLACEMENT * len(of.a)).reshape(-1, PLACEMENT, 1), (len(of.a), PLACEMENT, 14)
            )
            columns = np.broadcast_to(of.columns[:, None, :], rows.shape)
            shape = (PLACEMENT * len(of.a), PLACEMENT * len(self.place))
            return csr_matrix((self.residuals(of)[1].ravel(), (rows.ravel(), columns.ravel())), shape=shape)[
                :, PLACEMENT:
            ]

        chosen = []
        for begin in range(0, len(edges.a), _LIMITS.at_once):
            some = edges.only(slice(begin, begin + _LIMITS.at_once))
            other, count = some if others is None else others, len(some.a)
            product = derivatives(other) @ self.factor.solve(np.ascontiguousarray(derivatives(some).toarray().T))
            blocks = product.reshape(len(other.a), PLACEMENT, count, PLACEMENT).swapaxes(1, 2)
            chosen.append(blocks[np.arange(count), np.arange(count)] if others is None else blocks)
        return np.concatenate(chosen, axis=0 if others is None else 1)


@one_blas_thread()
def select_loops(
    track: RelativeTrack, orientations: Orientations, poses: Mapping[FramePair, LoopPose]
) -> set[FramePair]:
    """Select loops that agree with the track and each other; of contradictory ones, those with by far the most matches.

    Of loops between the same nodes of the graph that agree, one is judged for all, before each is by itself.

    Parameters
    ----------
    track, orientations
        Of all frames; those of a loop lie in one part of the track.
    poses
        By loops.
    """
    selected: set[FramePair] = set()
    for part in _split_by_part(track, poses):
        loops, depth, matches = _attach_loops(track, orientations, part)
        graph = _Graph.of(track, orientations, part.nodes)
        best, group = _group_agreeing(graph.residuals(loops)[0], loops, matches)
        groups, behind = loops.only(best), np.asarray(np.bincount(group, matches), dtype=np.float64)
        graph, accepted = _accept_loops(graph, groups, depth[best], behind)
        covariance = graph.covariances(groups)[group]
        # what is neither accepted nor predicted well has rivals
        decided = accepted[group] | (_place_sigma(covariance) < _NOISE.sure * depth)
        selected |= part.where(decided & _agree(graph.residuals(loops)[0], covariance + loops.covariance))
    return selected


@one_blas_thread()
def select_likely_loops(
    track: RelativeTrack, orientations: Orientations, poses: Mapping[FramePair, LoopPose]
) -> set[FramePair]:
    """Select loops that agree with the track, each by itself; parameters as of :func:`select_loops`."""
    selected: set[FramePair] = set()
    for part in _split_by_part(track, poses):
        loops, _, _ = _attach_loops(track, orientations, part)
        graph = _Graph.of(track, orientations, part.nodes).adjusted(loops.only(slice(0)))
        selected |= part.where(_agree(graph.residuals(loops)[0], graph.covariances(loops) + loops.covariance))
    return selected


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Loops within one part of a track, and the frames (K,) of its nodes."""

    nodes: IndexArray
    poses: Mapping[FramePair, LoopPose]

    def where(self, which: BoolArray) -> set[FramePair]:
        return set(itertools.compress(self.poses, which.tolist()))


def _split_by_part(track: RelativeTrack, poses: Mapping[FramePair, LoopPose]) -> Iterator[_Part]:
    for part in sorted({int(track.part[i]) for i, _ in poses}):
        own = np.flatnonzero(track.part == part)
        yield _Part(
            nodes=np.union1d(own[:: _LIMITS.every], own[-1:]),
            poses={pair: poses[pair] for pair in sorted(poses) if track.part[pair[0]] == part},
        )


def _attach_loops(track: RelativeTrack, orientations: Orientations, part: _Part) -> tuple[_Edges, Array, Array]:
    """Loops as edges between the nodes nearest to their frames, (M,) depths and (M,) numbers of matches."""
    frames, several = np.array(list(part.poses), dtype=np.intp), list(part.poses.values())
    place = np.searchsorted((part.nodes[1:] + part.nodes[:-1]) / 2, frames)
    (i, j), (a, b) = frames.T, part.nodes[place].T
    depth = np.array([pose.depth for pose in several])
    ratio = np.array([pose.ratio for pose in several])
    start_from_cam = orientations.start_from_cam
    turn = np.array([pose.start_from_second for pose in several]) @ np.swapaxes(start_from_cam[j], 1, 2)
    beyond = ratio[:, None] * np.einsum("mij,mj->mi", turn, track.centre[b] - track.centre[j])
    sigma = np.tile([_NOISE.length_sigma, *[_NOISE.rotation_sigma_rad] * 3], (len(depth), 1))
    edges = _Edges(
        a=place[:, 0],
        b=place[:, 1],
        step=track.centre[i] - track.centre[a] + np.array([pose.step for pose in several]) + beyond,
        longer=np.log(ratio),
        start_from_b=turn @ start_from_cam[b],
        sigma=np.column_stack([_NOISE.place_sigma * np.tile(depth[:, None], 3), sigma]),
    )
    return edges, depth, np.array([pose.matches for pose in several], dtype=np.float64)


def _group_agreeing(off: Array, loops: _Edges, matches: Array) -> tuple[IndexArray, IndexArray]:
    """Group M loops between the same nodes that agree: (G,) those with the most matches of each, and (M,) groups."""
    best, group = np.zeros(0, dtype=np.intp), np.zeros(len(matches), dtype=np.intp)
    left = np.argsort(-matches, kind="stable")
    nodes = np.stack([loops.a, loops.b], axis=1)
    while len(left):
        _, first, member = np.unique(nodes[left], axis=0, return_index=True, return_inverse=True)
        of_member = left[first][member.ravel()]
        agree = _agree(off[left] - off[of_member], loops.covariance[left] + loops.covariance[of_member])
        agree |= left == of_member
        group[left[agree]] = len(best) + member.ravel()[agree]
        best, left = np.concatenate([best, left[first]]), left[~agree]
    return best, group


def _accept_loops(graph: _Graph, loops: _Edges, depth: Array, matches: Array) -> tuple[_Graph, BoolArray]:
    """Accept loops, the surest ones first, as long as there are any that agree; the graph with them, and which."""
    accepted, dropped = np.zeros((2, len(depth)), dtype=np.bool_)
    graph = graph.adjusted(loops.only(accepted))
    for _ in range(2 * len(depth)):
        off, _ = graph.residuals(loops)
        worst = np.argmax(np.where(accepted, _squared_mahalanobis(off, loops.covariance), 0.0))
        if accepted[worst] and not _agree(off[worst], loops.covariance[worst]):
            # others moved it too far away; it stays out, so that the rounds end
            accepted[worst], dropped[worst] = False, True
        else:
            left = np.flatnonzero(~accepted & ~dropped)
            chosen = left[_choose_loops(graph, loops.only(left), off[left], depth[left], matches[left])]
            if not len(chosen):
                break
            accepted[chosen] = True
        graph = graph.adjusted(loops.only(accepted))
    return graph, accepted


def _choose_loops(graph: _Graph, loops: _Edges, off: Array, depth: Array, matches: Array) -> IndexArray:
    """Which of M loops to accept next: all whose place the graph predicts well, else the best without a rival."""
    if not len(depth):
        return np.zeros(0, dtype=np.intp)
    predicted = graph.covariances(loops)
    agree = np.flatnonzero(_agree(off, predicted + loops.covariance))
    sigma = _place_sigma(predicted[agree])
    sure = agree[sigma < _NOISE.sure * depth[agree]]
    if len(sure) or not len(agree):
        return sure
    sigma = sigma * np.exp(graph.log_length[loops.a[agree]])  # all in one length
    surest = np.argsort(sigma, kind="stable")[: _NOISE.rivals]
    surest = surest[sigma[surest] <= _NOISE.alike * sigma[surest[0]]]
    rest = loops.only(agree)
    expected = off[agree], predicted[agree] + rest.covariance
    return agree[surest[_select_unrivalled(graph, rest, expected, surest, matches[agree])]]


def _place_sigma(covariance: Array) -> Array:
    """(M,) standard deviations of places, of (M, 7, 7)."""
    return np.asarray(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)))


def _select_unrivalled(
    graph: _Graph, loops: _Edges, predicted: tuple[Array, Array], candidates: IndexArray, matches: Array
) -> BoolArray:
    """(S,) which of the candidates among M loops no other contradicts, or none with half as many matches behind it.

    ``predicted``: how far each loop (M, 7) is off what the graph says, and the covariance (M, 7, 7) of that.
    """
    off, covariance = predicted
    # what is left of each loop's difference (S, M, 7) once a candidate is accepted: a Kalman update
    joint = graph.covariances(loops.only(candidates), loops).swapaxes(0, 1)
    gain = joint @ np.linalg.inv(covariance[candidates])[:, None]
    off_after = off - np.einsum("slij,sj->sli", gain, off[candidates])
    agree = _agree(off_after, covariance - gain @ np.swapaxes(joint, 2, 3))
    agree[np.arange(len(candidates)), candidates] = True
    matches_behind = agree @ matches
    # a loop that is no candidate has its own matches alone
    strength = matches.copy()
    strength[candidates] = matches_behind
    strongest_rival = np.max(np.where(agree, 0.0, strength), axis=1)
    return np.asarray(matches_behind >= _NOISE.by_far * strongest_rival)


def _agree(off: Array, covariance: Array) -> BoolArray:
    """(...,) whether vectors (..., 7) are as small as their covariances (..., 7, 7) say."""
    return np.asarray(_squared_mahalanobis(off, covariance) < _NOISE.agree_7)


def _squared_mahalanobis(off: Array, covariance: Array) -> Array:
    """(...,) squares of vectors (..., 7) over their covariances (..., 7, 7)."""
    return np.asarray(np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=-1))
