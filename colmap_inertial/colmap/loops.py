"""Places that a long capture comes back to: sought among frames a second apart, and believed only together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.colmap.headings import Headings
from colmap_inertial.colmap.two_views import compare, forget
from colmap_inertial.colmap.votes import Voters
from colmap_inertial.types import Array

Int = NDArray[np.intp]
Bool = NDArray[np.bool_]
Pair = tuple[int, int]

#: Frames among which loops are sought are about so far apart, and so many at most.
_SPACING_S, _MOST_FRAMES = 1.0, 1000
#: Candidates have at least so many votes, and are among the best so many of one of their frames.
_LEAST_VOTES, _BEST = 6, 3
#: A loop's matches cover this share of what both pictures show.
_LEAST_COVERED = 0.5
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


def key_frames(t_s: Array) -> Int:
    """Frames about a second apart, or farther in a capture that is very long."""
    spacing_s = max(_SPACING_S, float(t_s[-1] - t_s[0]) / _MOST_FRAMES)
    kept = [0]
    for i, at_s in enumerate(t_s.tolist()):
        if at_s - t_s[kept[-1]] >= 0.95 * spacing_s:
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def candidates(votes: Int, i: Int, j: Int) -> Bool:
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
    headings: Headings,
    voters: Voters,
    nearest: int,
    match: Callable[[Sequence[tuple[str, str]]], None],
) -> Loops:
    """Match pairs that show places which the camera came back to; what is not believed leaves the database again.

    Parameters
    ----------
    names
        (N,) in order of time.
    headings, voters
        Of these.
    nearest
        Frames fewer places apart than this are no loop.
    match
        Matches and verifies pairs in the database.
    """
    keys = key_frames(headings.t_s)
    a, b = np.triu_indices(len(keys), 1)
    i, j = keys[a], keys[b]
    far = j - i >= nearest
    i, j = i[far], j[far]
    maybe = ~_away(headings, i, j)
    i, j = i[maybe], j[maybe]
    chosen = candidates(voters.count(i, j), i, j)
    first = [(int(x), int(y)) for x, y in zip(i[chosen], j[chosen], strict=True)]
    match(_named(names, first))
    verified, believed = _judged(database, names, headings, first)
    likely = sorted(believed)
    step = max(1, int(np.median(np.diff(keys))) // 2) if len(keys) > 1 else 1
    beside = {pair: _beside(pair, step, len(names), nearest) for pair in likely}
    more = sorted(set().union(*beside.values()) - set(first))
    match(_named(names, more))
    for known, new in zip((verified, believed), _judged(database, names, headings, more), strict=True):
        known |= new
    closed = {pair for pair in likely if len(beside[pair] & believed) >= _LEAST_WITNESSES}
    closed |= set().union(*(beside[pair] & believed for pair in closed))
    forget(database, _named(names, [pair for pair in [*first, *more] if pair not in closed]))
    return Loops(
        compared=len(i),
        candidates=len(first) + len(more),
        refused=len(verified - closed),
        closed=tuple(sorted(closed)),
    )


def _away(headings: Headings, i: Int, j: Int) -> Bool:
    """As ``see_nothing_in_common``, a part at a time: there may be half a million of them."""
    parts = np.array_split(np.arange(len(i)), max(1, len(i) // 50_000))
    return np.concatenate([headings.see_nothing_in_common(i[part], j[part]) for part in parts])


def _judged(
    database: Path, names: Sequence[str], headings: Headings, pairs: Sequence[Pair]
) -> tuple[set[Pair], set[Pair]]:
    """Pairs with matches that are verified; and of these, pairs that may close a loop.

    Their matches cover enough of both pictures, and turn the camera as the gyroscope does.
    """
    views = compare(database, _named(names, pairs))
    verified = np.isfinite(views.first_from_second).all(axis=(1, 2))
    i, j = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    believed = verified & (views.covered >= _LEAST_COVERED)
    believed[believed] = headings.agree(i[believed], j[believed], views.first_from_second[believed])
    good, better = np.flatnonzero(verified).tolist(), np.flatnonzero(believed).tolist()
    return {pairs[k] for k in good}, {pairs[k] for k in better}


def _beside(pair: Pair, step: int, count: int, nearest: int) -> set[Pair]:
    """Pairs of frames a little before or after one or both of a pair."""
    i, j = pair
    moved = {(i + a * step, j + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)} - {pair}
    return {(a, b) for a, b in moved if a >= 0 and b < count and b - a >= nearest}


def _named(names: Sequence[str], pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    return [(names[a], names[b]) for a, b in pairs]
