"""How far a lens model is one: beyond the first fold of its distortion, a pixel has two rays, and both are wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray

if TYPE_CHECKING:
    import pycolmap

#: Angles from the optical axis at which a lens is looked at, in so many directions around it.
_ANGLES = np.radians(np.linspace(0.0, 89.5, 1791))
_AROUND = np.arange(16) * (2 * np.pi / 16)


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Where a lens folds: tangent of the angle from the axis, and distance of the pixel from the principal point."""

    tangent: float
    radius_px: float


def sees_all_around(camera: pycolmap.Camera) -> bool:
    """Whether a camera sees all around it, as panoramas do: by its name, as pycolmap before 4.1 has no such camera."""
    return bool(camera.model_name == "EQUIRECTANGULAR")


def find_fold(camera: pycolmap.Camera) -> Fold | None:
    """The first fold of a lens in front of it; ``None`` where its radius grows as far as pinholes see."""
    if sees_all_around(camera):
        return None
    tangent = np.tan(_ANGLES)
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    first, radius = len(tangent), np.inf
    for around in _AROUND:
        x, y = tangent * np.cos(around), tangent * np.sin(around)
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        distance = np.linalg.norm(np.asarray(camera.img_from_cam(rays), dtype=np.float64) - middle, axis=1)
        growing = np.diff(distance) > 0  # not where one of them is nan
        if not growing.all():
            at = int(np.argmin(growing))
            if at < first:
                first, radius = at, float(distance[at])
    if first == len(tangent):
        return None
    return Fold(tangent=float(tangent[first]), radius_px=radius)


def farthest_corner_px(camera: pycolmap.Camera) -> float:
    """Distance of the farthest corner of the image from the principal point."""
    x = max(camera.principal_point_x, camera.width - camera.principal_point_x)
    y = max(camera.principal_point_y, camera.height - camera.principal_point_y)
    return float(np.hypot(x, y))


def is_beyond_fold(rays: Array, fold: Fold | None) -> BoolArray:
    """(N,) whether rays (N, 2) at z = 1 lie where a lens has folded."""
    if fold is None:
        return np.zeros(len(rays), bool)
    return np.asarray(~(np.hypot(rays[:, 0], rays[:, 1]) <= fold.tangent))
