"""The relative track of a camera before there is a model, by gyroscope orientations and matches of neighbours.

With orientations known, a frame's place among points is linear, and so is a point's among frames. Frames are placed
one after another by points that earlier ones saw, and points by the frames that see them. Its length is arbitrary and
drifts from frame to frame, which the covariance allows for: it is no reconstruction, but tells a revisited place from
one that only looks the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.threads import one_blas_thread


@dataclass(frozen=True, kw_only=True)
class TrackLimits:
    """Limits for estimating the distance to a third image from two others."""

    #: A point is known once rays to it are so far apart.
    parallax_rad: float = 0.02
    #: Errors of orientations and matches, as an angle: what is farther off counts less.
    off_rad: float = 0.004
    #: A frame is placed by so many points at least, and by this share of those it knows, or the track breaks.
    least_points: int = 8
    least_share: float = 0.25
    #: A frame sees this many points on average at most.
    most_observations: int = 800
    #: Rounds of weighting.
    rounds: int = 4


_LIMITS = TrackLimits()

#: Places of two frames in time, the earlier one first.
FramePair = tuple[int, int]

#: How far the logarithm of its length walks from frame to frame.
DRIFT = 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class Observations:
    """Observations of points by N frames.

    Attributes
    ----------
    frame, point
        (M,) which frame observed which point, frame by frame.
    feature
        (M,) which of the frame's features it was.
    rays
        (M, 3) unit vectors to it, in the frame that all orientations are in.
    """

    frame: IndexArray
    point: IndexArray
    feature: IndexArray
    rays: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class RelativeTrack:
    """Positions of frames up to scale, and the points that determined them.

    Attributes
    ----------
    part
        (N,) frames of one part have places relative to each other; -1 where there is none.
    centre
        (N, 3) in the frame of the orientations.
    points
        (P, 3) as last triangulated; NaN where they were not.
    observations
        Of these.
    """

    part: IndexArray
    centre: Array
    points: Array
    observations: Observations

    def known(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether one part of the track has frames i and j, (M,) each."""
        return np.asarray((self.part[i] == self.part[j]) & (self.part[i] >= 0))

    def covariance(self, i: IndexArray, j: IndexArray, orientation_rad: Array) -> Array:
        """(M, 3, 3) of the displacements from frames i to frames j >= i, (M,) each.

        Each step's length is off by a factor that walks; orientations are off by ``orientation_rad`` (M,) at the end.
        """
        count = (j - i + 1).astype(np.float64)[:, None, None]
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self.centre, axis=0)])
        squares = np.concatenate(
            [np.zeros((1, 3, 3)), np.cumsum(self.centre[:, :, None] * self.centre[:, None, :], axis=0)]
        )
        end, between = self.centre[j], sums[j + 1] - sums[i]
        mixed = end[:, :, None] * between[:, None, :]
        # of the displacements from each frame on the track to its end
        remaining = (
            count * end[:, :, None] * end[:, None, :] - mixed - np.swapaxes(mixed, 1, 2) + squares[j + 1] - squares[i]
        )
        mean = np.trace(remaining, axis1=1, axis2=2)[:, None, None] / count
        return np.asarray(DRIFT**2 * remaining + (orientation_rad[:, None, None] ** 2 * mean) * np.eye(3))

    def depth(self, frame: int) -> float:
        """Median distance of the points that a frame sees; NaN where it sees none."""
        at = self.seen(frame)[1]
        return float(np.median(np.linalg.norm(at - self.centre[frame], axis=1))) if len(at) else float("nan")

    def seen(self, frame: int) -> tuple[IndexArray, Array]:
        """Features (K,) of a frame whose points are known, and these (K, 3)."""
        mine = slice(*np.searchsorted(self.observations.frame, [frame, frame + 1]))
        feature, at = self.observations.feature[mine], self.points[self.observations.point[mine]]
        known = np.isfinite(at).all(axis=1)
        return feature[known], at[known]


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopPose:
    """The pose of a frame by points that another one, long before or after, had seen.

    Attributes
    ----------
    step
        (3,) from the first frame to the second, in the length of the track at the first.
    start_from_second
        (3, 3) orientation of the second.
    ratio
        Length of the track at the first frame over that at the second.
    depth
        How far away the points are.
    matches
        How many points there are.
    """

    step: Array
    start_from_second: Array
    ratio: float
    depth: float
    matches: int


def link_observations(
    features: Sequence[int], matches: Sequence[tuple[int, int, IndexArray]]
) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Link matches of pairs of frames to points: frame, feature and point (M,) of all observations, frame by frame.

    Of very many points, some are enough.

    Parameters
    ----------
    features
        Of each frame, how many.
    matches
        Frames i and j, and (K, 2) features of them.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    begin = np.concatenate([[0], np.cumsum(features)])
    total = int(begin[-1])
    none = np.zeros((0, 2), dtype=np.intp)
    shifted = [np.asarray(matched, dtype=np.intp) + begin[[i, j]] for i, j, matched in matches]
    both = np.concatenate([none, *shifted])
    graph = coo_matrix((np.ones(len(both), dtype=np.int8), (both[:, 0], both[:, 1])), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    node = np.flatnonzero(np.bincount(label)[label] >= 3)
    frame = np.searchsorted(begin, node, side="right") - 1
    # a point that is twice in one frame is two things
    key = label[node] * len(features) + frame
    _, place, often = np.unique(key, return_inverse=True, return_counts=True)
    twice = np.unique(label[node][often[place] > 1])
    kept = ~np.isin(label[node], twice)
    frame, feature = frame[kept], (node - begin[frame])[kept]
    _, point = np.unique(label[node][kept], return_inverse=True)
    some = point % max(1, -(-len(point) // (_LIMITS.most_observations * len(features)))) == 0
    _, point = np.unique(point[some], return_inverse=True)
    return frame[some], feature[some], point


@one_blas_thread()
def estimate_relative_track(observations: Observations, frames: int) -> RelativeTrack:
    """Place frames one after another; where too little hangs together, a new part begins.

    Parameters
    ----------
    frames
        How many there are.
    """
    count = int(observations.point.max(initial=-1)) + 1
    centre, part = np.zeros((frames, 3)), np.full(frames, -1, dtype=np.intp)
    points = np.full((count, 3), np.nan)
    square, moment = np.zeros((count, 3, 3)), np.zeros((count, 3))
    first, wide = np.full((count, 3), np.nan), np.zeros(count)
    bounds = np.searchsorted(observations.frame, np.arange(frames + 1))

    def add(k: int, trusted: BoolArray) -> None:
        """Triangulate points by a placed frame's rays."""
        mine = np.arange(bounds[k], bounds[k + 1])[trusted]
        which, rays = observations.point[mine], observations.rays[mine]
        through = _project_across(rays)
        square[which] += through
        moment[which] += through @ centre[k]
        new = np.isnan(first[which, 0])
        first[which[new]] = rays[new]
        wide[which] = np.maximum(wide[which], np.linalg.norm(np.cross(first[which], rays), axis=1))
        ready = which[wide[which] > _LIMITS.parallax_rad]
        points[ready] = np.linalg.solve(square[ready], moment[ready][..., None])[..., 0]

    begun, now = 0, 0
    while begun < frames - 1:
        ahead = _find_beginning(observations, bounds, begun)
        if ahead is None:
            begun += 1
            continue
        other, step = ahead
        # points of another part have another length
        points[:], square[:], moment[:], first[:], wide[:] = np.nan, 0, 0, np.nan, 0
        centre[begun], centre[other] = 0, step
        part[[begun, other]] = now
        for k in (begun, other):
            add(k, np.ones(bounds[k + 1] - bounds[k], dtype=np.bool_))
        k = begun + 1
        while k < frames:
            if k != other:
                mine = slice(bounds[k], bounds[k + 1])
                which = observations.point[mine]
                step = centre[k - 1] - centre[k - 2] if k - 2 >= begun else step
                located = _locate_frame(points[which], observations.rays[mine], centre[k - 1] + step, step)
                if located is None:
                    break
                centre[k], trusted = located
                part[k] = now
                add(k, trusted)
            k += 1
        begun, now = max(k, begun + 1), now + 1
    return RelativeTrack(part=part, centre=centre, points=points, observations=observations)


def _find_beginning(observations: Observations, bounds: IndexArray, i: int) -> tuple[int, Array] | None:
    """A frame soon after frame i from which much looks different, and the direction to it; ``None`` without one."""
    for j in range(i + 1, min(i + 9, len(bounds) - 1)):
        a, b = slice(bounds[i], bounds[i + 1]), slice(bounds[j], bounds[j + 1])
        _, at_a, at_b = np.intersect1d(observations.point[a], observations.point[b], return_indices=True)
        if len(at_a) < 2 * _LIMITS.least_points:
            return None
        first, second = observations.rays[a][at_a], observations.rays[b][at_b]
        normal = np.cross(first, second)
        if np.median(np.linalg.norm(normal, axis=1)) < 2 * _LIMITS.parallax_rad:
            continue
        weight = np.ones(len(normal))
        for _ in range(_LIMITS.rounds):
            direction = np.linalg.eigh((normal * weight[:, None]).T @ normal)[1][:, 0]
            weight = 1 / (1 + (normal @ direction / _LIMITS.off_rad) ** 2) ** 2
        # points lie before both
        sign = np.sign(np.sum(weight * np.sum(np.cross(np.tile(direction, (len(first), 1)), second) * normal, axis=1)))
        return j, np.asarray(direction * (sign or 1.0))
    return None


def _project_across(rays: Array) -> Array:
    """(K, 3, 3) projections of a vector across each of (K, 3) unit rays."""
    return np.asarray(np.eye(3) - rays[:, :, None] * rays[:, None, :])


def _locate_frame(points: Array, rays: Array, guess: Array, step: Array) -> tuple[Array, BoolArray] | None:
    """(3,) where a frame is by the points it sees, and (K,) which of its rays may triangulate points.

    It is sought near the guess: what hangs twice may have more points that agree on a place elsewhere.
    """
    known = np.isfinite(points[:, 0])
    if known.sum() < _LIMITS.least_points:
        return None
    at, through, seen = points[known], _project_across(rays[known]), rays[known]
    centre = guess
    about = max(_LIMITS.off_rad, float(np.linalg.norm(step) / np.median(np.linalg.norm(at - guess, axis=1))) / 2)
    for scale in np.geomspace(about, _LIMITS.off_rad, _LIMITS.rounds + 1):
        away = at - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        off = np.linalg.norm(np.cross(away / distance[:, None], seen), axis=1)
        off = np.where(np.sum(away * seen, axis=1) > 0, off, 1.0)
        weight = 1 / (1 + (off / scale) ** 2) ** 2 / distance**2
        information = np.einsum("k,kab->ab", weight, through)
        centre = np.linalg.solve(information, np.einsum("k,kab,kb->a", weight, through, at))
    good = off < 3 * _LIMITS.off_rad
    if good.sum() < _LIMITS.least_points or good.mean() < _LIMITS.least_share:
        return None
    trusted = np.ones(len(points), dtype=np.bool_)
    trusted[known] = good
    return centre, trusted
