"""Choose partner images and depth ranges from the sparse points that images share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.imaging.plane_sweep.pinhole import Pinhole


@dataclass(frozen=True, kw_only=True)
class PartnerLimits:
    """Limits for partner views and their depth ranges."""

    #: The best angle between two rays to a point: small angles measure no depth, at large ones things look different
    #: and hide each other.
    best_deg: float = 8.0
    #: Below it a point counts less by this width,
    below_deg: float = 4.0
    #: above it by this one.
    above_deg: float = 8.0
    #: Points that images must at least have in common.
    least_shared: int = 20
    #: How far apart their optical axes may be.
    most_turn_deg: float = 50.0
    #: The range of depths leaves out this share of the points at the near end,
    near_share: float = 0.005
    #: and those beyond this share: they are likeliest to be wrong;
    far_share: float = 0.995
    #: it is widened by this factor at the near end,
    nearer: float = 0.75
    #: and by this one at the far end.
    farther: float = 1.3


_LIMITS = PartnerLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Sights:
    """Observations of sparse points by views.

    Attributes
    ----------
    views
        All pictures' cameras.
    points
        (P, 3) in the world.
    of_view
        For each view its points' numbers, each once.
    of_point
        (M,) views that observe point 0, then those of point 1, and so on;
    first
        (P + 1,) where each point's begin.
    """

    views: tuple[Pinhole, ...]
    points: Array
    of_view: tuple[Int64Array, ...]
    of_point: Int64Array
    first: Int64Array

    @classmethod
    def of(cls, views: Sequence[Pinhole], points: Array, observed: Sequence[Int64Array]) -> Sights:
        """Observations from views and the numbers of the points that each of them sees."""
        each = tuple(np.unique(numbers) for numbers in observed)
        number = np.concatenate([np.zeros(0, dtype=np.int64), *each])
        view = np.repeat(np.arange(len(each)), [len(numbers) for numbers in each])
        first = np.searchsorted(np.sort(number), np.arange(len(points) + 1))
        by_point = view[np.argsort(number, kind="stable")]
        return cls(views=tuple(views), points=points, of_view=each, of_point=by_point, first=first)


def depth_range(sights: Sights, view: int) -> tuple[float, float] | None:
    """Nearest and farthest depth to try, by the points that a view observes; ``None`` where it has none before it."""
    camera = sights.views[view]
    rays = sights.points[sights.of_view[view]] - camera.cam_in_world
    depths = rays @ camera.cam_from_world[2]
    depths = depths[depths > 0]
    if not len(depths):
        return None
    low, high = np.quantile(depths, (_LIMITS.near_share, _LIMITS.far_share))
    return float(_LIMITS.nearer * low), float(_LIMITS.farther * high)


def score_partners(sights: Sights, view: int) -> Array:
    """(V,) how well each view is placed to measure what ``view`` sees; 0 where it is not.

    The sum over shared points of a weight of the angle under which the two see the point, as MVSNet weighs
    (Yao et al., ECCV 2018); it falls more slowly above the best angle than below.
    """
    camera, count = sights.views[view], len(sights.views)
    numbers = sights.of_view[view]
    lengths = sights.first[numbers + 1] - sights.first[numbers]
    # each shared point with each view that observes it
    point = np.repeat(numbers, lengths)
    start = np.repeat(sights.first[numbers] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    other = sights.of_point[start + np.arange(len(point))]
    centres = np.array([v.cam_in_world for v in sights.views])
    here, there = camera.cam_in_world - sights.points[point], centres[other] - sights.points[point]
    across = np.linalg.norm(np.cross(here, there), axis=1)
    angle_deg = np.degrees(np.arctan2(across, np.sum(here * there, axis=1)))
    width = np.where(angle_deg < _LIMITS.best_deg, _LIMITS.below_deg, _LIMITS.above_deg)
    weight = np.exp(-0.5 * ((angle_deg - _LIMITS.best_deg) / width) ** 2)
    score = np.bincount(other, weight, count)
    shared = np.bincount(other, minlength=count)
    axes = np.array([v.cam_from_world[2] for v in sights.views])
    near = axes @ camera.cam_from_world[2] >= np.cos(np.radians(_LIMITS.most_turn_deg))
    apart = np.linalg.norm(centres - camera.cam_in_world, axis=1) > 0
    return np.where((shared >= _LIMITS.least_shared) & near & apart, score, 0.0)


def choose_partners(sights: Sights, view: int, scores: Array, count: int) -> tuple[int, ...]:
    """The views to compare with: well placed, and on different sides.

    One after the other, the best; a view in the direction of a chosen one counts less, by half where it is the same.
    """
    centres = np.array([v.cam_in_world for v in sights.views])
    direction = centres - sights.views[view].cam_in_world
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = np.divide(direction, length, out=np.zeros_like(direction), where=length > 0)
    left = scores.copy()
    chosen: list[int] = []
    while len(chosen) < count and left.max(initial=0.0) > 0:
        best = int(np.argmax(left))
        chosen.append(best)
        left[best] = 0
        left = left * (1 - 0.5 * (direction @ direction[best]) ** 2)
    return tuple(chosen)
