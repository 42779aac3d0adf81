"""Places that a long capture comes back to: sought among frames a second apart, and believed only together.

What looks the same may be a copy of it. So a loop must fit the gyroscope's heading and the way (``way.py``) between
both frames, as sure as these are after so long; its neighbours must show the same; and of loops that contradict each
other (J. G. Mangelson et al., *Pairwise consistent measurement set maximization*, ICRA 2018), only those with by far
the most matches behind them stay.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.covisibility import Covisibility
from colmap_inertial.colmap.gyro_orientations import GyroOrientations
from colmap_inertial.colmap.relative_track import DRIFT, RelativeTrack
from colmap_inertial.colmap.two_views import Return, compare, forget, returns
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray

Pair = tuple[int, int]

#: Frames among which loops are sought are about so far apart, and so many at most.
_SPACING_S, _MOST_FRAMES = 1.0, 1000
#: Candidates have at least so many votes, and are among the best so many of one of their frames.
_LEAST_VOTES, _BEST = 6, 3
#: A loop's matches cover this share of what both pictures show.
_LEAST_COVERED = 0.5
#: Places of a loop's frames and lengths by its matches are as sure as this share of how far away its points are.
_PLACE_SIGMA, _LENGTH_SIGMA = 0.1, 0.1
#: Frames farther apart than this many times how far away things are show nothing in common.
_REACH, _SURE_SIGMAS = 2.0, 3.0
#: Three numbers whose squares add up to more, each over its variance, disagree; one number likewise.
_AGREE_3, _AGREE_1 = 16.3, 10.8
#: Of loops that contradict each other, one must have so many times the matches behind it.
_BY_FAR = 2.0
#: So many of the pairs of frames beside a candidate must show the same loop.
_LEAST_WITNESSES = 2


@dataclass(frozen=True, kw_only=True)
class Loops:
    """What became of candidates.

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
    """

    compared: int
    candidates: int
    refused: int
    closed: tuple[Pair, ...]


def key_frames(t_s: Array) -> IndexArray:
    """Frames about a second apart, or farther in a capture that is very long."""
    spacing_s = max(_SPACING_S, float(t_s[-1] - t_s[0]) / _MOST_FRAMES)
    kept = [0]
    for i, at_s in enumerate(t_s.tolist()):
        if at_s - t_s[kept[-1]] >= 0.95 * spacing_s:
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def candidates(votes: IndexArray, i: IndexArray, j: IndexArray) -> BoolArray:
    """(M,) which pairs of frames i, j, (M,) each, have votes enough and are among the best of one of their frames."""
    chosen = np.zeros(len(votes), dtype=np.bool_)
    for frame in np.unique(np.concatenate([i, j])):
        mine = np.flatnonzero((i == frame) | (j == frame))
        best = mine[np.argsort(-votes[mine], kind="stable")[:_BEST]]
        chosen[best] = True
    return chosen & (votes >= _LEAST_VOTES)


def close_loops(
    database: Path,
    names: Sequence[str],
    headings: GyroOrientations,
    way: RelativeTrack,
    voters: Covisibility,
    nearest: int,
    *,
    doubtful: Sequence[Pair],
    neighbours: Sequence[Pair],
    match: Callable[[Sequence[Pair]], None],
) -> Loops:
    """Match pairs that show places which the camera came back to; what is not believed leaves the database again.

    Parameters
    ----------
    names
        (N,) in order of time.
    headings, way, voters
        Of these.
    nearest
        Frames fewer places apart than this are no loop.
    doubtful
        Pairs that are candidates, too, if they have votes enough; those beside them are not.
    neighbours
        Pairs that are matched and not judged; in one go with candidates, as COLMAP indexes the features of all images
        anew each time.
    match
        Matches and verifies pairs in the database.
    """
    keys = key_frames(headings.t_s)
    a, b = np.triu_indices(len(keys), 1)
    i, j = keys[a], keys[b]
    far = j - i >= nearest
    i, j = i[far], j[far]
    maybe = ~_away(headings, way, i, j)
    i, j = i[maybe], j[maybe]
    chosen = candidates(voters.count(i, j), i, j)
    voted = {(int(x), int(y)) for x, y in zip(i[chosen], j[chosen], strict=True)}
    a, b = np.array(doubtful, dtype=np.intp).reshape(-1, 2).T
    alike = ~_away(headings, way, a, b)
    alike[alike] = voters.count(a[alike], b[alike]) >= _LEAST_VOTES
    first = sorted(voted.union(itertools.compress(doubtful, alike)))
    match([*neighbours, *first])
    verified, found = _judged(database, names, headings, way, first)
    likely = sorted(found)
    step = max(1, int(np.median(np.diff(keys))) // 2) if len(keys) > 1 else 1
    beside = {pair: _beside(pair, step, len(names), nearest) for pair in likely}
    more = sorted(set().union(*(beside[pair] for pair in likely if pair in voted)) - set(first))
    match(more)
    verified_too, found_too = _judged(database, names, headings, way, more)
    believed = without_contradictions({**found, **found_too}, headings, way, nearest)
    closed = {pair for pair in believed & set(likely) if len(beside[pair] & believed) >= _LEAST_WITNESSES}
    closed |= set().union(*(beside[pair] & believed for pair in closed))
    forget(database, _named(names, [pair for pair in [*first, *more] if pair not in closed]))
    return Loops(
        compared=len(i),
        candidates=len(first) + len(more),
        refused=len((verified | verified_too) - closed),
        closed=tuple(sorted(closed)),
    )


def without_contradictions(
    found: dict[Pair, Return], headings: GyroOrientations, way: RelativeTrack, nearest: int
) -> set[Pair]:
    """Of loops, those that no other contradicts, or none with half as many matches behind it.

    A loop says where one of its frames is, seen from the other. The way from there to the frames of another loop nearby
    is short, and so is surely known; what that loop says must be the same.

    Parameters
    ----------
    nearest
        The ways between two loops are no longer than this many frames, or they have nothing to say about each other.
    """
    pairs = sorted(found)
    if not pairs:
        return set()
    i, j = np.array(pairs, dtype=np.intp).T
    step = np.array([found[pair].step for pair in pairs])
    ratio = np.array([found[pair].ratio for pair in pairs])
    depth = np.array([found[pair].depth for pair in pairs])
    matches = np.array([found[pair].matches for pair in pairs], dtype=np.float64)
    near = (np.abs(i[:, None] - i) <= nearest) & (np.abs(j[:, None] - j) <= nearest)
    a, b = np.nonzero(np.triu(near, 1))
    early, late = _between(way, headings, i[a], i[b]), _between(way, headings, j[a], j[b])
    off = step[a] + ratio[a, None] * late[0] - early[0] - step[b]
    noise = (_PLACE_SIGMA * np.hypot(depth[a], depth[b])) ** 2 + (_LENGTH_SIGMA * np.linalg.norm(late[0], axis=1)) ** 2
    covariance = early[1] + ratio[a, None, None] ** 2 * late[1] + noise[:, None, None] * np.eye(3)
    apart = _squared(off, covariance) > _AGREE_3
    against = np.zeros((len(pairs), len(pairs)), dtype=np.bool_)
    against[a[apart], b[apart]] = against[b[apart], a[apart]] = True
    behind = (near & ~against) @ matches
    rival = np.max(np.where(against, behind, 0.0), axis=1)
    return {pair for pair, kept in zip(pairs, (behind >= _BY_FAR * rival).tolist(), strict=True) if kept}


def _between(way: RelativeTrack, headings: GyroOrientations, i: IndexArray, j: IndexArray) -> tuple[Array, Array]:
    """(M, 3) the ways from frames i to frames j, in any order, and (M, 3, 3) their covariances."""
    first, last = np.minimum(i, j), np.maximum(i, j)
    return way.centre[j] - way.centre[i], way.covariance(first, last, headings.sigma_rad(first, last))


def _squared(off: Array, covariance: Array) -> Array:
    """(M,) squares of (M, 3) vectors over their covariances (M, 3, 3)."""
    return np.asarray(np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=1))


def _away(headings: GyroOrientations, way: RelativeTrack, i: IndexArray, j: IndexArray) -> BoolArray:
    """(M,) whether frames i and j surely show nothing in common; a part at a time: there may be half a million."""
    depth = np.array([way.depth(k) for k in range(len(way.part))])
    parts = np.array_split(np.arange(len(i)), max(1, len(i) // 50_000))
    return np.concatenate([_away_part(headings, way, depth, i[part], j[part]) for part in parts])


def _away_part(headings: GyroOrientations, way: RelativeTrack, depth: Array, i: IndexArray, j: IndexArray) -> BoolArray:
    away = headings.see_nothing_in_common(i, j)
    known = np.flatnonzero(~away & way.known(i, j) & np.isfinite(depth[i]))
    passed, covariance = _between(way, headings, i[known], j[known])
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    away[known] = np.linalg.norm(passed, axis=1) > _REACH * depth[i[known]] + _SURE_SIGMAS * sigma
    return away


def _judged(
    database: Path, names: Sequence[str], headings: GyroOrientations, way: RelativeTrack, pairs: Sequence[Pair]
) -> tuple[set[Pair], dict[Pair, Return]]:
    """Pairs with matches that are verified; and of these, pairs that may close a loop, with what they say.

    Their matches cover enough of both pictures, turn the camera as the gyroscope does, and bring it where the way does.
    """
    views = compare(database, _named(names, pairs))
    verified = np.isfinite(views.first_from_second).all(axis=(1, 2))
    i, j = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    likely = verified & (views.covered >= _LEAST_COVERED) & way.known(i, j)
    likely[likely] = headings.agree(i[likely], j[likely], views.first_from_second[likely])
    some = [pairs[k] for k in np.flatnonzero(likely).tolist()]
    said = returns(database, names, some, way) if some else []
    found = {pair: told for pair, told in zip(some, said, strict=True) if told is not None}
    if found:
        i, j = np.array(list(found), dtype=np.intp).T
        told = list(found.values())
        turned = headings.start_from_cam[i].swapaxes(1, 2) @ np.array([one.start_from_second for one in told])
        passed, covariance = _between(way, headings, i, j)
        off = passed - np.array([one.step for one in told])
        noise = (_PLACE_SIGMA * np.array([one.depth for one in told])) ** 2
        longer = np.log([one.ratio for one in told]) ** 2 / (DRIFT**2 * (j - i) + _LENGTH_SIGMA**2)
        fits = _squared(off, covariance + noise[:, None, None] * np.eye(3)) < _AGREE_3
        fits &= (longer < _AGREE_1) & headings.agree(i, j, turned)
        found = {pair: one for (pair, one), good in zip(found.items(), fits.tolist(), strict=True) if good}
    return {pairs[k] for k in np.flatnonzero(verified).tolist()}, found


def _beside(pair: Pair, step: int, count: int, nearest: int) -> set[Pair]:
    """Pairs of frames a little before or after one or both of a pair."""
    i, j = pair
    moved = {(i + a * step, j + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)} - {pair}
    return {(a, b) for a, b in moved if a >= 0 and b < count and b - a >= nearest}


def _named(names: Sequence[str], pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    return [(names[a], names[b]) for a, b in pairs]
