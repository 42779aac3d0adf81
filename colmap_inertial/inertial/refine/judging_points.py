"""Some of a model's points, which judge a refinement, and all of them again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import BoolArray
from colmap_inertial.inertial.refine.values import Estimate, Observations, Problem


@dataclass(frozen=True, kw_only=True)
class JudgingLimits:
    """Observations that judge: so many, and at least so many a frame.

    ``scripts.studies.refine --points-per-m 2000 --metres 60``, and ``250``: 0.24 and 0.31 of the time of COLMAP's
    adjustment, and the errors that all observations give.
    """

    observations: int = 50_000
    each: int = 60

    def of_frame(self, frames: int) -> int:
        """How many each of so many frames has."""
        return max(self.observations // frames, self.each)


JUDGING = JudgingLimits()


def draw_points(observations: Observations, frames: int) -> BoolArray | None:
    """(P,) points that judge; ``None`` where all do.

    Of each frame's points, in an order drawn at random, the first ones are taken.
    """
    count, each = len(observations.frame), JUDGING.of_frame(frames)
    if count <= each * frames:
        return None
    order = np.random.default_rng(0).permutation(len(observations.first) - 1)
    by_frame = np.lexsort((order[observations.point], observations.frame))
    frame = observations.frame[by_frame]
    place = np.arange(count) - np.searchsorted(frame, frame)
    out = np.zeros(len(order), dtype=np.bool_)
    out[observations.point[by_frame[place < each]]] = True
    return out


def select_points(problem: Problem, points: BoolArray) -> Problem:
    """The problem of a mask of points."""
    distances = None if problem.distances is None else problem.distances.select_points(points)
    return replace(problem, observations=problem.observations.select_points(points), distances=distances)


def restore_points(whole: Problem, judging: Problem) -> Problem:
    """All observations again, with what the judging ones say of the IMU's noise, and of whether there is a readout."""
    observations = whole.observations
    if not np.any(judging.observations.line):
        observations = replace(observations, line=np.zeros_like(observations.line))
    return replace(judging, observations=observations, distances=whole.distances)


def carry_points(observations: Observations, before: Estimate, found: Estimate) -> Estimate:
    """An estimate with all points of the one before, each carried along by the middle one of the frames that see it."""
    frame = observations.frame[(observations.first[:-1] + observations.first[1:]) // 2]
    seen = np.einsum("nji,nj->ni", before.world_from_imu[frame], before.points_m - before.imu_in_world_m[frame])
    return replace(
        found, points_m=found.imu_in_world_m[frame] + np.einsum("nij,nj->ni", found.world_from_imu[frame], seen)
    )
