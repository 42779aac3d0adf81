"""The way of a camera before there is a model: by its gyroscope's orientations and what neighbouring frames see.

With orientations known, a frame's place among points is linear, and so is a point's among frames. Frames are placed
one after another by points that earlier ones saw, and points by the frames that see them. Its length is arbitrary and
drifts from frame to frame, which is reckoned with: it is no reconstruction, but tells a place that was come back to
from one that only looks the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.threads import one_blas_thread

#: A point is known once rays to it are so far apart.
_PARALLAX_RAD = 0.02
#: Errors of orientations and matches, as an angle: what is farther off counts less.
_OFF_RAD = 0.004
#: A frame is placed by so many points at least, and by this share of those it knows, or the way breaks.
_LEAST_POINTS, _LEAST_SHARE = 8, 0.25
#: A frame sees this many points on average at most.
_MOST_SIGHTINGS = 800
#: How far the logarithm of its length walks from frame to frame.
DRIFT = 0.02
#: Rounds of weighting.
_ROUNDS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """What N frames saw of points.

    Attributes
    ----------
    frame, point
        (M,) which frame saw which point, frame by frame.
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
    """Where frames were, up to a length, and the points by which they were placed.

    Attributes
    ----------
    part
        (N,) frames of one part have places relative to each other; -1 where there is none.
    centre
        (N, 3) in the frame of the orientations.
    points
        (P, 3) as the way knew them last; NaN where it did not.
    sightings
        Of these.
    """

    part: IndexArray
    centre: Array
    points: Array
    sightings: Sightings

    def known(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether there is a way from frames i to frames j, (M,) each."""
        return np.asarray((self.part[i] == self.part[j]) & (self.part[i] >= 0))

    def covariance(self, i: IndexArray, j: IndexArray, heading_rad: Array) -> Array:
        """(M, 3, 3) of the ways from frames i to frames j >= i, (M,) each.

        Each step's length is off by a factor that walks; headings are off by ``heading_rad`` (M,) at the end.
        """
        count = (j - i + 1).astype(np.float64)[:, None, None]
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self.centre, axis=0)])
        squares = np.concatenate(
            [np.zeros((1, 3, 3)), np.cumsum(self.centre[:, :, None] * self.centre[:, None, :], axis=0)]
        )
        end, between = self.centre[j], sums[j + 1] - sums[i]
        mixed = end[:, :, None] * between[:, None, :]
        # of what was left of the way at each frame of it
        left = (
            count * end[:, :, None] * end[:, None, :] - mixed - np.swapaxes(mixed, 1, 2) + squares[j + 1] - squares[i]
        )
        mean = np.trace(left, axis1=1, axis2=2)[:, None, None] / count
        return np.asarray(DRIFT**2 * left + (heading_rad[:, None, None] ** 2 * mean) * np.eye(3))

    def depth(self, frame: int) -> float:
        """How far away what a frame sees usually is; NaN where nothing is known."""
        at = self.seen(frame)[1]
        return float(np.median(np.linalg.norm(at - self.centre[frame], axis=1))) if len(at) else float("nan")

    def seen(self, frame: int) -> tuple[IndexArray, Array]:
        """Features (K,) of a frame whose points are known, and these (K, 3)."""
        mine = slice(*np.searchsorted(self.sightings.frame, [frame, frame + 1]))
        feature, at = self.sightings.feature[mine], self.points[self.sightings.point[mine]]
        known = np.isfinite(at).all(axis=1)
        return feature[known], at[known]


def joined(
    features: Sequence[int], matches: Sequence[tuple[int, int, IndexArray]]
) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Points that matches of pairs of frames are of: frame, feature and point (M,) of all sightings, frame by frame.

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
    shifted = [np.asarray(found, dtype=np.intp) + begin[[i, j]] for i, j, found in matches]
    both = np.concatenate([none, *shifted])
    graph = coo_matrix((np.ones(len(both), dtype=np.int8), (both[:, 0], both[:, 1])), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    node = np.flatnonzero(np.bincount(label)[label] >= 3)
    frame = np.searchsorted(begin, node, side="right") - 1
    # what is twice in one frame are two things
    key = label[node] * len(features) + frame
    _, place, often = np.unique(key, return_inverse=True, return_counts=True)
    twice = np.unique(label[node][often[place] > 1])
    kept = ~np.isin(label[node], twice)
    frame, feature = frame[kept], (node - begin[frame])[kept]
    _, point = np.unique(label[node][kept], return_inverse=True)
    some = point % max(1, -(-len(point) // (_MOST_SIGHTINGS * len(features)))) == 0
    _, point = np.unique(point[some], return_inverse=True)
    return frame[some], feature[some], point


@one_blas_thread()
def estimate_relative_track(sightings: Sightings, frames: int) -> RelativeTrack:
    """Place frames one after another; where too little hangs together, a new part begins.

    Parameters
    ----------
    frames
        How many there are.
    """
    count = int(sightings.point.max(initial=-1)) + 1
    centre, part = np.zeros((frames, 3)), np.full(frames, -1, dtype=np.intp)
    points = np.full((count, 3), np.nan)
    square, moment = np.zeros((count, 3, 3)), np.zeros((count, 3))
    first, wide = np.full((count, 3), np.nan), np.zeros(count)
    bounds = np.searchsorted(sightings.frame, np.arange(frames + 1))

    def add(k: int, trusted: BoolArray) -> None:
        """Let a placed frame's rays tell of points."""
        mine = np.arange(bounds[k], bounds[k + 1])[trusted]
        which, rays = sightings.point[mine], sightings.rays[mine]
        through = _across(rays)
        square[which] += through
        moment[which] += through @ centre[k]
        new = np.isnan(first[which, 0])
        first[which[new]] = rays[new]
        wide[which] = np.maximum(wide[which], np.linalg.norm(np.cross(first[which], rays), axis=1))
        ready = which[wide[which] > _PARALLAX_RAD]
        points[ready] = np.linalg.solve(square[ready], moment[ready][..., None])[..., 0]

    begun, now = 0, 0
    while begun < frames - 1:
        ahead = _beginning(sightings, bounds, begun)
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
                which = sightings.point[mine]
                step = centre[k - 1] - centre[k - 2] if k - 2 >= begun else step
                placed = _placed(points[which], sightings.rays[mine], centre[k - 1] + step, step)
                if placed is None:
                    break
                centre[k], trusted = placed
                part[k] = now
                add(k, trusted)
            k += 1
        begun, now = max(k, begun + 1), now + 1
    return RelativeTrack(part=part, centre=centre, points=points, sightings=sightings)


def _beginning(sightings: Sightings, bounds: IndexArray, i: int) -> tuple[int, Array] | None:
    """A frame soon after frame i from which much looks different, and the direction to it; ``None`` without one."""
    for j in range(i + 1, min(i + 9, len(bounds) - 1)):
        a, b = slice(bounds[i], bounds[i + 1]), slice(bounds[j], bounds[j + 1])
        _, at_a, at_b = np.intersect1d(sightings.point[a], sightings.point[b], return_indices=True)
        if len(at_a) < 2 * _LEAST_POINTS:
            return None
        one, two = sightings.rays[a][at_a], sightings.rays[b][at_b]
        normal = np.cross(one, two)
        if np.median(np.linalg.norm(normal, axis=1)) < 2 * _PARALLAX_RAD:
            continue
        weight = np.ones(len(normal))
        for _ in range(_ROUNDS):
            direction = np.linalg.eigh((normal * weight[:, None]).T @ normal)[1][:, 0]
            weight = 1 / (1 + (normal @ direction / _OFF_RAD) ** 2) ** 2
        # points lie before both
        sign = np.sign(np.sum(weight * np.sum(np.cross(np.tile(direction, (len(one), 1)), two) * normal, axis=1)))
        return j, np.asarray(direction * (sign or 1.0))
    return None


def _across(rays: Array) -> Array:
    """(K, 3, 3) what is left of a vector across each of (K, 3) unit rays."""
    return np.asarray(np.eye(3) - rays[:, :, None] * rays[:, None, :])


def _placed(points: Array, rays: Array, guess: Array, step: Array) -> tuple[Array, BoolArray] | None:
    """(3,) where a frame is by the points it sees, and (K,) which of its rays may tell of points.

    It is sought near the guess: what hangs twice may have more points that agree on a place elsewhere.
    """
    known = np.isfinite(points[:, 0])
    if known.sum() < _LEAST_POINTS:
        return None
    at, through, seen = points[known], _across(rays[known]), rays[known]
    centre = guess
    about = max(_OFF_RAD, float(np.linalg.norm(step) / np.median(np.linalg.norm(at - guess, axis=1))) / 2)
    for scale in np.geomspace(about, _OFF_RAD, _ROUNDS + 1):
        away = at - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        off = np.linalg.norm(np.cross(away / distance[:, None], seen), axis=1)
        off = np.where(np.sum(away * seen, axis=1) > 0, off, 1.0)
        weight = 1 / (1 + (off / scale) ** 2) ** 2 / distance**2
        information = np.einsum("k,kab->ab", weight, through)
        centre = np.linalg.solve(information, np.einsum("k,kab,kb->a", weight, through, at))
    good = off < 3 * _OFF_RAD
    if good.sum() < _LEAST_POINTS or good.mean() < _LEAST_SHARE:
        return None
    trusted = np.ones(len(points), dtype=np.bool_)
    trusted[known] = good
    return centre, trusted
