"""What speaks against two parts being of one device and one recording, and what they count twice."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from colmap_inertial.core.geometry import so3_log
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.join.links import FEWEST_SHARED
from colmap_inertial.inertial.join.values import Link, Part, SharedImages, pair_of
from colmap_inertial.inertial.scale import posterior as post

#: Parts contradict each other where chance makes what they differ by no oftener than so many standard deviations ...
_SURE_SIGMA = 4.0
#: ... of squares that are this many times larger in real recordings than noise makes them.
_ALLOWANCE = 2.0
#: Models that share more of the smaller one's images than this are not pieces of one.
_MOST_SHARED = 0.8
#: Numbers that say how the camera is mounted.
_OF_MOUNT = 6
#: Stamps are no better than this.
LEAST_STAMP_S = 1e-5


def plainly_apart(parts: Sequence[Part], shared: Sequence[SharedImages]) -> dict[tuple[int, int], str]:
    """Why pairs of parts cannot be one model whatever the IMU says, in words."""
    agree, out = {pair_of(one) for one in shared}, {}
    for (a, one), (b, other) in combinations(enumerate(parts), 2):
        both = len(set(one.trajectory.names) & set(other.trajectory.names))
        if one.cameras and other.cameras and not one.cameras & other.cameras:
            out[a, b] = "other cameras took the pictures of one than those of the other"
        elif both > _MOST_SHARED * min(len(one.trajectory.names), len(other.trajectory.names)):
            out[a, b] = f"{both} images are in both: they are two models of one piece, not two pieces"
        elif both >= FEWEST_SHARED and (a, b) not in agree:
            out[a, b] = f"the {both} images that both have lie otherwise in one than in the other"
    return out


def unlike(one: Part, other: Part) -> str:
    """Why two parts are not of one device, in words: how the camera is mounted to the IMU; empty where they may be."""
    (a, b), at = (part.path.at(np.array([0])) for part in (one, other)), np.r_[-6:0]
    away = np.concatenate([so3_log(a.cam_from_imu @ b.cam_from_imu.T), a.imu_in_cam_m - b.imu_in_cam_m])
    cov = a.cov[np.ix_(at, at)] + b.cov[np.ix_(at, at)]
    if float(away @ np.linalg.solve(cov, away)) <= at_most(_OF_MOUNT):
        return ""
    return "the camera of one is mounted to the IMU otherwise than that of the other"


def clocks_differ(parts: Sequence[Part], link: Link) -> bool:
    """Whether the IMU's clock runs on between two nodes as the camera's does no better than by chance."""
    stamps_s, times_s, variance = [], [], 0.0
    for k, node in ((link.first, link.from_node), (link.second, link.to_node)):
        known = parts[k].path.at(np.array([node]))
        own = post.NODE + np.array([post.DELAY, post.CLOCK_RATE])
        by = np.array([1.0, float(known.since_middle_s[0])])
        variance += float(by @ known.cov[np.ix_(own, own)] @ by)
        stamps_s.append(float(known.stamp_s[0]))
        times_s.append(float(known.t_s[0]))
    dt_s = times_s[1] - times_s[0]
    variance += (PRIORS.clock_rate * dt_s) ** 2 + LEAST_STAMP_S**2
    away_s = stamps_s[1] - stamps_s[0] - dt_s
    return away_s**2 / variance > at_most(1)


def times_counted(parts: Sequence[Part]) -> float:
    """How often readings are counted: parts that overlap in time each have those of the overlap in their own fits."""
    spans = sorted((float(part.path.nodes_s[0]), float(part.path.nodes_s[-1])) for part in parts)
    covered_s, reached_s = 0.0, -np.inf
    for begin_s, end_s in spans:
        covered_s += max(0.0, end_s - max(begin_s, reached_s))
        reached_s = max(reached_s, end_s)
    return sum(end_s - begin_s for begin_s, end_s in spans) / covered_s


def most(dof: int) -> float:
    """What chance hardly makes of a sum of squares over variances: as far out as so many standard deviations.

    By Wilson and Hilferty's root: the third root of chi-square is next to normal.
    """
    share = 2 / (9 * dof)
    return float(dof * (1 - share + _SURE_SIGMA * share**0.5) ** 3)


def at_most(dof: int) -> float:
    """The same of real recordings."""
    return _ALLOWANCE * most(dof)
