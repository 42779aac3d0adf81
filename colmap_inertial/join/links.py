"""Where parts of a recording meet: neighbours in time, and images that two of them have."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from colmap_inertial.geometry import so3_log
from colmap_inertial.join.values import Link, Part, SharedImages
from colmap_inertial.scale._parameters import DRIFT_S

#: Links between the same two parts: the shortest ones; more say little beyond.
_MOST_LINKS = 4
#: So many shared images are believed, of which more than half agree to so many times their median error.
FEWEST_SHARED, _AGREE = 3, 5.0
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
        turns = one.world_from_cam[mine] @ other.world_from_cam[theirs].transpose(0, 2, 1)
        middle = turns[int(np.argmin([_median_angle(turns, turn) for turn in turns]))]
        angles = np.linalg.norm(so3_log(middle.T @ turns), axis=1)
        away = one.trajectory.cam_in_world[mine] - other.trajectory.cam_in_world[theirs] @ middle.T
        offsets = np.linalg.norm(away - np.median(away, axis=0), axis=1)
        agree = (angles < _AGREE * max(float(np.median(angles)), _LEAST_RAD)) & (
            offsets < _AGREE * max(float(np.median(offsets)), _LEAST_M)
        )
        if agree.sum() < max(FEWEST_SHARED, len(both) / 2 + 1e-9):
            continue
        mine, theirs = mine[agree], theirs[agree]
        span_s = float(np.ptp(one.trajectory.t_s[mine]))
        independent = min(len(mine), 1 + span_s / DRIFT_S)
        out.append(
            SharedImages(first=a, second=b, in_first=mine, in_second=theirs, weight=float(independent / len(mine)))
        )
    return out


def _median_angle(turns: np.ndarray, turn: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(so3_log(turn.T @ turns), axis=1)))
