"""Where parts of a recording meet: neighbours in time, and images that two of them have."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.geometry import so3_log
from colmap_inertial.inertial.core.parameters import DRIFT_S
from colmap_inertial.inertial.join.values import Found, Link, MatchedImages, Part, SharedImages, pair_of

#: Links between the same two parts: the shortest ones; more say little beyond.
_MOST_LINKS = 4
#: So many shared images are believed, of which more than half agree to so many times their median error.
FEWEST_SHARED, _AGREE = 3, 5.0
#: Images that matches place far from where the parts meet have the bends of both models between, which last for
#: seconds: as far apart as shared images may be, one bend would count dozens of times.
_MATCHED_ALIKE_S = 4.0
#: Errors that pictures hardly fall below (rad, m): what agrees to less agrees.
_LEAST_RAD, _LEAST_M = 1e-3, 5e-3


def find_links(parts: Sequence[Part]) -> list[Link]:
    """What the IMU felt from any node to the next one in time, where that belongs to another part."""
    t_s = np.concatenate([part.path.nodes_s for part in parts])
    part_of = np.concatenate([np.full(len(part.path.nodes_s), i) for i, part in enumerate(parts)])
    node_of = np.concatenate([np.arange(len(part.path.nodes_s)) for part in parts])
    order = np.argsort(t_s, kind="stable").tolist()
    found: dict[tuple[int, int], list[tuple[float, Link]]] = {}
    for i, j in pairwise(order):
        a, b = int(part_of[i]), int(part_of[j])
        if a != b and t_s[j] > t_s[i]:
            link = Link(first=a, second=b, from_node=int(node_of[i]), to_node=int(node_of[j]))
            found.setdefault((min(a, b), max(a, b)), []).append((float(t_s[j] - t_s[i]), link))
    out = []
    for links in found.values():
        out += [link for _, link in sorted(links, key=lambda one: one[0])[:_MOST_LINKS]]
    return out


def find_shared(parts: Sequence[Part]) -> list[SharedImages]:
    """Images that two parts have both, without those that contradict most of the others."""
    out = []
    for (a, one), (b, other) in combinations(enumerate(parts), 2):
        place = {name: i for i, name in enumerate(other.trajectory.names)}
        both = [(i, place[name]) for i, name in enumerate(one.trajectory.names) if name in place]
        if len(both) < FEWEST_SHARED:
            continue
        mine, theirs = np.array(both, dtype=np.int64).T
        agree = _agreeing(
            one.world_from_cam[mine],
            other.world_from_cam[theirs],
            one.trajectory.cam_in_world[mine],
            other.trajectory.cam_in_world[theirs],
        )
        if agree.sum() < max(FEWEST_SHARED, len(both) / 2 + 1e-9):
            continue
        mine, theirs = mine[agree], theirs[agree]
        weight = _independent(one.trajectory.t_s[mine])
        out.append(SharedImages(first=a, second=b, in_first=mine, in_second=theirs, weight=weight))
    return out


def find_matched(parts: Sequence[Part], found: Sequence[Found]) -> list[MatchedImages]:
    """Images of one part that matches place in another, without those that contradict most of the others."""
    place_of, out = {part.number: k for k, part in enumerate(parts)}, []
    for one in found:
        if one.first not in place_of or one.second not in place_of:
            continue
        k, own = place_of[one.first], place_of[one.second]
        places = [{name: i for i, name in enumerate(parts[i].trajectory.names)} for i in (k, own)]
        there = [i for i, name in enumerate(one.names) if name in places[1] and one.beside[i] in places[0]]
        if len(there) < FEWEST_SHARED:
            continue
        theirs = np.array([places[0][one.beside[i]] for i in there], dtype=np.int64)
        mine = np.array([places[1][one.names[i]] for i in there], dtype=np.int64)
        world_from_cam, centres = one.world_from_cam[there], one.cam_in_world[there]
        agree = _agreeing(
            world_from_cam, parts[own].world_from_cam[mine], centres, parts[own].trajectory.cam_in_world[mine]
        )
        if agree.sum() < max(FEWEST_SHARED, len(there) / 2 + 1e-9):
            continue
        theirs, mine = theirs[agree], mine[agree]
        first, second = sorted((k, own))
        out.append(
            MatchedImages(
                first=first,
                second=second,
                in_first=theirs if k == first else mine,
                in_second=mine if k == first else theirs,
                weight=_independent(parts[own].trajectory.t_s[mine], _MATCHED_ALIKE_S),
                other=k,
                world_from_cam=world_from_cam[agree],
                cam_in_world=centres[agree],
            )
        )
    # one's images in the other and the other's in it are the same matches, read twice
    times = Counter(pair_of(one) for one in out)
    return [replace(one, weight=one.weight / times[pair_of(one)]) for one in out]


def _agreeing(turned: Array, own: Array, centres: Array, own_centres: Array) -> BoolArray:
    """(n,) which of n images lie in two parts as most of them do; rotations world_from_cam and centres in either."""
    turns = turned @ own.transpose(0, 2, 1)
    middle = turns[int(np.argmin([_median_angle(turns, turn) for turn in turns]))]
    angles = np.linalg.norm(so3_log(middle.T @ turns), axis=1)
    away = centres - own_centres @ middle.T
    offsets = np.linalg.norm(away - np.median(away, axis=0), axis=1)
    return np.asarray(
        (angles < _AGREE * max(float(np.median(angles)), _LEAST_RAD))
        & (offsets < _AGREE * max(float(np.median(offsets)), _LEAST_M))
    )


def _independent(t_s: Array, alike_s: float = DRIFT_S) -> float:
    """How much each of some images counts: errors of those so near in time are alike."""
    return float(min(len(t_s), 1 + float(np.ptp(t_s)) / alike_s) / len(t_s))


def _median_angle(turns: np.ndarray, turn: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(so3_log(turn.T @ turns), axis=1)))
