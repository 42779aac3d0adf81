"""Loops of a long capture: sought among frames a second apart, and accepted only where they agree with each other.

What looks the same may be a copy of it. So a loop must agree with the gyroscope's rotation and with the relative track
(``relative_track.py``) between both frames, within their uncertainty after so long; its neighbours must show the same;
and it must agree with the track as other loops correct it (``loop_graph.py``).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.loops.pose_graph import select_likely_loops, select_loops
from colmap_inertial.colmap.views.gyro_orientations import GyroOrientations
from colmap_inertial.colmap.views.relative_track import FramePair, LoopPose, RelativeTrack
from colmap_inertial.colmap.views.two_views import (
    Covisibility,
    compare,
    delete_matches,
    localise_frames,
)
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray


@dataclass(frozen=True, kw_only=True)
class LoopSearchLimits:
    """Limits of the search for loops."""

    #: Frames among which loops are sought are about so far apart.
    spacing_s: float = 1.0
    #: Pairs of them that are looked at together: a capture of an hour has millions.
    pairs_at_once: int = 50_000
    #: Candidates have at least so many quick matches, and are among the best so many of one of their frames.
    least_quick_matches: int = 6
    best: int = 3
    #: A loop's matches cover this share of what both images show.
    least_covered: float = 0.5
    #: Frames farther apart than this many times how far away things are show nothing in common.
    reach: float = 2.0
    sure_sigmas: float = 3.0
    #: So many of the pairs of frames beside a candidate must show the same loop.
    least_witnesses: int = 2


_LIMITS = LoopSearchLimits()


@dataclass(frozen=True, kw_only=True)
class Loops:
    """Loops that were sought, and those that were closed.

    Attributes
    ----------
    compared
        Pairs of frames that were compared by their largest features.
    candidates
        Pairs that were matched for it, those beside candidates included.
    refused
        Of these, pairs that COLMAP verified and that were not believed.
    closed
        Pairs of frames that show the same place.
    returns
        Pairs that stay though no more is known of them than that they turned as the gyroscope did.
    """

    compared: int
    candidates: int
    refused: int
    closed: tuple[FramePair, ...]
    returns: tuple[FramePair, ...] = ()

    def counts(self) -> dict[str, int]:
        """The numbers of pairs, by their names in a record of matching."""
        numbers = (self.compared, self.candidates, self.refused, len(self.closed), len(self.returns))
        names = ("loops_compared", "loop_candidates", "loops_refused", "loops_closed", "returns")
        return dict(zip(names, numbers, strict=True))


def key_frames(t_s: Array) -> IndexArray:
    """Frames about a second apart."""
    kept = [0]
    for i, at_s in enumerate(t_s.tolist()):
        if at_s - t_s[kept[-1]] >= 0.95 * _LIMITS.spacing_s:
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def candidates(matches: IndexArray, i: IndexArray, j: IndexArray) -> BoolArray:
    """(M,) which pairs of frames i, j, (M,) each, have matches enough and are among the best of one of their frames."""
    frames, pair = np.concatenate([i, j]), np.tile(np.arange(len(matches)), 2)
    # by frame, then by matches, the most first; of equal ones, the earlier pair
    order = np.lexsort((pair, -matches[pair], frames))
    ranked = frames[order]
    rank = np.arange(len(ranked)) - np.searchsorted(ranked, ranked)
    chosen = np.zeros(len(matches), dtype=np.bool_)
    chosen[pair[order[rank < _LIMITS.best]]] = True
    return chosen & (matches >= _LIMITS.least_quick_matches)


def split_pairs(pairs: Sequence[FramePair]) -> IndexArray:
    """(2, M) the first and the second frames of pairs."""
    return np.array(pairs, dtype=np.intp).reshape(-1, 2).T


def name_pairs(names: Sequence[str], pairs: Sequence[FramePair]) -> list[tuple[str, str]]:
    """The names of pairs of frames."""
    return [(names[a], names[b]) for a, b in pairs]


def find_returns(covisibility: Covisibility, t_s: Array, nearest: int) -> list[FramePair]:
    """Pairs of frames about a second apart, at least so many places from each other, that look most alike."""
    keys = key_frames(t_s)
    i, j = (keys[places] for places in np.triu_indices(len(keys), 1))
    far = j - i >= nearest
    i, j = i[far], j[far]
    chosen = candidates(covisibility.count(i, j), i, j)
    return list(zip(i[chosen].tolist(), j[chosen].tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """A capture whose loops are sought.

    Attributes
    ----------
    database
        With features and matches.
    names
        (N,) of images, in order of time.
    orientations, track, covisibility
        Of these.
    nearest
        Frames fewer places apart than this are no loop.
    lenient
        Whether what agrees with the gyroscope's rotation stays: of a capture so short that every pair might be matched.
    """

    database: Path
    names: Sequence[str]
    orientations: GyroOrientations
    track: RelativeTrack
    covisibility: Covisibility
    nearest: int
    lenient: bool = False

    def close_loops(
        self,
        match: Callable[[Sequence[FramePair]], None],
        *,
        doubtful: Sequence[FramePair],
        given: Sequence[FramePair] = (),
    ) -> Loops:
        """Match pairs that may close a loop; the matches of those that are not accepted leave the database again.

        Parameters
        ----------
        match
            Matches and verifies pairs in the database.
        doubtful
            Pairs that are candidates, too, if they have quick matches enough; those beside them are not.
        given
            Pairs that somebody else matched as loops: candidates without quick matches, which bear each other out.
        """
        keys = key_frames(self.orientations.t_s)
        i, j = self._possible_loops(keys)
        chosen = candidates(self.covisibility.count(i, j), i, j)
        possible = set(itertools.compress(given, ~self._surely_apart(*split_pairs(given))))
        voted = possible.union(zip(i[chosen].tolist(), j[chosen].tolist(), strict=True))
        a, b = split_pairs(doubtful)
        alike = ~self._surely_apart(a, b)
        alike[alike] = self.covisibility.count(a[alike], b[alike]) >= _LIMITS.least_quick_matches
        first = sorted(voted.union(itertools.compress(doubtful, alike)))
        match(first)
        verified, turned, poses = self._judge(first)
        likely = sorted(poses)
        step = max(1, int(np.median(np.diff(keys))) // 2) if len(keys) > 1 else 1
        around = turned.union(likely) if self.lenient else likely
        beside = {pair: self._pairs_beside(pair, step) | _within(step, pair, possible) for pair in around}
        more = sorted(set().union(*(beside[pair] for pair in around if pair in voted)) - set(first))
        match(more)
        verified_beside, turned_beside, poses_beside = self._judge(more)
        consistent = select_loops(self.track, self.orientations, {**poses, **poses_beside})
        enough = _LIMITS.least_witnesses
        closed = {pair for pair in consistent & set(likely) if len(beside[pair] & consistent) >= enough}
        closed |= set().union(*(beside[pair] & consistent for pair in closed))
        returns = (turned | turned_beside) - closed if self.lenient else set()
        kept = closed | returns
        delete_matches(
            self.database, name_pairs(self.names, [pair for pair in [*first, *more, *given] if pair not in kept])
        )
        return Loops(
            compared=len(i),
            candidates=len(first) + len(more),
            refused=len((verified | verified_beside) - kept),
            closed=tuple(sorted(closed)),
            returns=tuple(sorted(returns)),
        )

    def _displacements(self, i: IndexArray, j: IndexArray) -> tuple[Array, Array]:
        """(M, 3) displacements from frames i to frames j, in any order, and (M, 3, 3) their covariances."""
        first, last = np.minimum(i, j), np.maximum(i, j)
        covariance = self.track.covariance(first, last, self.orientations.sigma_rad(first, last))
        return self.track.centre[j] - self.track.centre[i], covariance

    def _possible_loops(self, keys: IndexArray) -> IndexArray:
        """(2, M) pairs of key frames that are no neighbours, and do not surely show nothing in common."""
        last = np.searchsorted(keys, keys + self.nearest)
        possible = [np.zeros((2, 0), dtype=np.intp)]
        rows = max(1, _LIMITS.pairs_at_once // len(keys))
        for begin in range(0, len(keys), rows):
            own = range(begin, min(begin + rows, len(keys)))
            i = np.concatenate([np.full(len(keys) - last[k], keys[k]) for k in own])
            j = np.concatenate([keys[last[k] :] for k in own])
            possible.append(np.stack([i, j])[:, ~self._surely_apart(i, j)])
        return np.concatenate(possible, axis=1)

    def _surely_apart(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether frames i and j surely show nothing in common."""
        apart = self.orientations.see_nothing_in_common(i, j)
        some = np.flatnonzero(~apart & self.track.known(i, j) & np.isfinite(self._depths[i]))
        displacement, covariance = self._displacements(i[some], j[some])
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        far = _LIMITS.reach * self._depths[i[some]] + _LIMITS.sure_sigmas * sigma
        apart[some] = np.linalg.norm(displacement, axis=1) > far
        return apart

    @cached_property
    def _depths(self) -> Array:
        return np.array([self.track.depth(k) for k in range(len(self.track.part))])

    def _judge(self, pairs: Sequence[FramePair]) -> tuple[set[FramePair], set[FramePair], dict[FramePair, LoopPose]]:
        """Pairs with verified matches; those that turned as the gyroscope did; and the poses of those of them that may
        close a loop.

        Their matches cover enough of both images, agree with the gyroscope's rotation, and with the relative track.
        """
        views = compare(self.database, name_pairs(self.names, pairs))
        verified = np.asarray(np.isfinite(views.first_from_second).all(axis=(1, 2)), dtype=np.bool_)
        i, j = split_pairs(pairs)
        turned = verified.copy()
        turned[turned] = self.orientations.agree(i[turned], j[turned], views.first_from_second[turned])
        likely = turned & (views.covered >= _LIMITS.least_covered) & self.track.known(i, j)
        some = list(itertools.compress(pairs, likely))
        localised = localise_frames(self.database, self.names, some, self.track) if some else []
        poses = {pair: pose for pair, pose in zip(some, localised, strict=True) if pose is not None}
        agree = select_likely_loops(self.track, self.orientations, poses)
        poses = {pair: pose for pair, pose in poses.items() if pair in agree}
        return set(itertools.compress(pairs, verified)), set(itertools.compress(pairs, turned)), poses

    def _pairs_beside(self, pair: FramePair, step: int) -> set[FramePair]:
        """Pairs of frames a little before or after one or both of a pair."""
        i, j = pair
        moved = {(i + a * step, j + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)} - {pair}
        return {(a, b) for a, b in moved if a >= 0 and b < len(self.names) and b - a >= self.nearest}


def _within(step: int, pair: FramePair, others: Set[FramePair]) -> set[FramePair]:
    """Those of other pairs whose frames lie no farther than ``step`` from a pair's."""
    return {near for near in others - {pair} if max(abs(near[0] - pair[0]), abs(near[1] - pair[1])) <= step}
