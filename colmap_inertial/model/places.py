"""Where a model lies, and in which frame the points of a file are: the model's own, or that of a ``transforms.json``.

A model that was georeferenced before may lie thousands of kilometres from the origin. A turn and a scale about that
origin would throw it out of place, and single precision cannot hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, skew
from colmap_inertial.core.types import Similarity

#: A model is far from the origin at so many times its own size: single precision then keeps fewer than 1e-5 of it.
FAR = 100.0
#: Points of a file are those of the model's frame where, in the median, one of the model is so near, by its size.
_NEAR_SHARE = 0.05
#: A share of points that says how far a cloud reaches, per cent left out on each side.
_OUTSIDE_PCT = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """Middle and size of what a model shows, in its units."""

    middle: Array
    size: float

    @classmethod
    def of(cls, xyz: Array) -> Place | None:
        """Place of (N, 3) cameras and points; ``None`` without any."""
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
        if not len(xyz):
            return None
        low, high = np.percentile(xyz, [_OUTSIDE_PCT, 100 - _OUTSIDE_PCT], axis=0)
        return cls(middle=0.5 * (low + high), size=float(np.linalg.norm(high - low)))

    @property
    def is_far(self) -> bool:
        """Whether it lies so far from the origin that a turn or a scale about that moves it out of place."""
        return float(np.abs(self.middle).max()) > FAR * self.size > 0

    def moved(self, similarity: Similarity) -> Place:
        """Where it is afterwards."""
        turn = matrix_from_quat(similarity.rotation_xyzw)
        middle = similarity.scale * turn @ self.middle + similarity.translation_m
        return Place(middle=middle, size=similarity.scale * self.size)

    def pivot(self) -> Array:
        """(3,) a point with few digits in its middle, about which it is turned and scaled."""
        step = 10.0 ** np.floor(np.log10(self.size))
        return np.asarray(step * np.round(self.middle / step))


def find_pivot(shown: Array) -> Array | None:
    """A point in the middle of (N, 3) what a model shows, where that lies far from the origin; else ``None``."""
    place = Place.of(shown)
    return None if place is None or not place.is_far else place.pivot()


def about(similarity: Similarity, pivot: Array) -> Similarity:
    """The same turn and scale about another point than the origin: ``x' = s R (x - p) + p``."""
    return between(similarity, pivot, pivot)


def between(similarity: Similarity, before: Array, after: Array) -> Similarity:
    """A similarity of coordinates that count from points ``before`` and ``after`` it, of those from the origin.

    Its errors stay those about these points.
    """
    arm = similarity.scale * matrix_from_quat(similarity.rotation_xyzw) @ before
    by_errors = np.eye(7)
    by_errors[4:, 0], by_errors[4:, 1:4] = -arm, skew(arm)
    return replace(
        similarity,
        translation_m=similarity.translation_m + after - arm,
        cov=by_errors @ similarity.cov @ by_errors.T,
    )


def express_in_world(similarity: Similarity, applied: Array) -> Similarity | None:
    """What a similarity of the model's world is in a world that (4, 4) ``applied`` leads to; ``None`` of no similarity.

    Sizes and turns stay those of the similarity up to that.
    """
    scale = float(np.cbrt(np.linalg.det(applied[:3, :3])))
    if not scale > 0 or not np.allclose(
        applied[:3, :3] @ applied[:3, :3].T, scale**2 * np.eye(3), atol=1e-6 * scale**2
    ):
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = similarity.scale * matrix_from_quat(similarity.rotation_xyzw)
    matrix[:3, 3] = similarity.translation_m
    moved = applied @ matrix @ np.linalg.inv(applied)
    return replace(
        similarity,
        rotation_xyzw=quat_from_matrix(moved[:3, :3] / similarity.scale),
        translation_m=moved[:3, 3],
        cov=np.zeros((7, 7)),
    )


def find_world(points: Array, model: Array, worlds: Sequence[Array]) -> tuple[int, float]:
    """Which of some worlds, (4, 4) from the model's each, (N, 3) points of a file are in.

    Returns
    -------
    int, float
        Its number, the first where it cannot be told; and how far the points are from the model's there, as a share of
        its size (nan where nothing can be said).
    """
    points = points[np.isfinite(points).all(axis=1)]
    place = Place.of(model)
    if len(points) < 3 or len(model) < 3 or place is None or not place.size > 0:
        return 0, float("nan")
    distances = []
    for world in worlds:
        inverse = np.linalg.inv(world)
        distances.append(_distance(points @ inverse[:3, :3].T + inverse[:3, 3], model) / place.size)
    best = int(np.argmin(distances))
    # of worlds that do not differ much, the first
    return (best if distances[best] < 0.5 * distances[0] else 0), float(distances[best])


def is_elsewhere(distance: float) -> bool:
    """Whether points at such a distance are hardly of the model's frame."""
    return bool(distance > _NEAR_SHARE)


def _distance(points: Array, model: Array) -> float:
    """Median distance from points to the model's, or from these to the points: a part is near the whole."""
    from scipy.spatial import cKDTree

    there, _ = cKDTree(model).query(points)
    back, _ = cKDTree(points).query(model)
    return float(min(np.median(there), np.median(back)))


def translation(by: Array) -> Similarity:
    """A shift by (3,), exactly."""
    return Similarity(
        scale=1.0,
        rotation_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        translation_m=by,
        cov=np.zeros((7, 7)),
        provenance="shift",
    )
