"""Lengths in a scene: which point was clicked, how far two are apart, and how to write it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import LengthUnit

#: A click means a point within this angle of it, rad; of several closer than the smaller angle, the one in front.
_WIDEST_RAD, _SAME_RAD = 0.03, 0.004
#: Nothing that can be clicked is smaller than this angle.
_LEAST_RAD = 0.008


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A distance between two points.

    Attributes
    ----------
    length
        In ``unit``.
    ci95
        What the scale's 95 % interval makes of it, in metres; ``None`` where the scale has no interval. The points'
        own errors come on top.
    unit
        ``model`` where there is no scale.
    """

    length: float
    ci95: tuple[float, float] | None
    unit: LengthUnit

    @property
    def text(self) -> str:
        """Length and half the interval's width, in fitting units."""
        if self.unit != "m":
            return f"{self.length:.4g} units (no scale)"
        if self.ci95 is None:
            return length_text(self.length, digits=4)
        return _with_uncertainty(self.length, 0.5 * (self.ci95[1] - self.ci95[0]))


def measured(a: Array, b: Array, unit: LengthUnit, relative_ci95: tuple[float, float] | None) -> Measured:
    """The distance between two points.

    Parameters
    ----------
    a, b
        (3,) points in ``unit``.
    relative_ci95
        The scale's 95 % interval divided by the scale; ``None`` where unknown.
    """
    length = float(np.linalg.norm(np.asarray(a) - np.asarray(b)))
    known = unit == "m" and relative_ci95 is not None
    ci95 = (length * relative_ci95[0], length * relative_ci95[1]) if known and relative_ci95 is not None else None
    return Measured(length=length, ci95=ci95, unit=unit)


def nearest_to_ray(points: Array, origin: Array, direction: Array) -> int | None:
    """The point that a click means.

    Parameters
    ----------
    points
        (N, 3).
    origin, direction
        (3,) of the ray through the clicked pixel.

    Returns
    -------
    The index of the point closest to the ray by angle, of several about as close the one in front; ``None`` where none
    is near.
    """
    away = np.asarray(points, dtype=np.float64) - origin
    depth = away @ (np.asarray(direction) / np.linalg.norm(direction))
    ahead = np.flatnonzero(depth > 0)
    if len(ahead) == 0:
        return None
    depth = depth[ahead]
    beside = np.sqrt(np.maximum(np.sum(away[ahead] ** 2, axis=1) - depth**2, 0))
    angle = np.arctan2(beside, depth)
    smallest = float(angle.min())
    if smallest > _WIDEST_RAD:
        return None
    meant = np.flatnonzero(angle <= max(smallest, _SAME_RAD))
    return int(ahead[meant[np.argmin(depth[meant])]])


def ball_at_ray(middles: Array, radius: float, origin: Array, direction: Array) -> int | None:
    """The foremost of equally large balls (N, 3) that a ray meets, far ones a little larger; ``None`` where none."""
    away = np.asarray(middles, dtype=np.float64) - origin
    depth = away @ (np.asarray(direction) / np.linalg.norm(direction))
    beside = np.sqrt(np.maximum(np.sum(away**2, axis=1) - depth**2, 0))
    met = np.flatnonzero((depth > 0) & (beside < np.maximum(radius, _LEAST_RAD * depth)))
    return int(met[np.argmin(depth[met])]) if len(met) else None


def round_length(about: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above ``about``."""
    if not (np.isfinite(about) and about > 0):
        raise ValueError(f"a length must be positive, not {about}")
    power = 10.0 ** np.floor(np.log10(about))
    # 1e-9: what was meant to be 0.2 may be a rounding error less
    return float(max(m * power for m in (1, 2, 5, 10) if m * power <= about * (1 + 1e-9)))


def length_text(length_m: float, digits: int = 6) -> str:
    """A length in km, m, cm or mm."""
    for unit, size in (("km", 1e3), ("m", 1.0), ("cm", 1e-2)):
        if length_m >= size * (1 - 1e-9):
            return f"{length_m / size:.{digits}g} {unit}"
    return f"{length_m * 1e3:.{digits}g} mm"


def _with_uncertainty(length_m: float, half_m: float) -> str:
    """Two digits of the uncertainty, and the length to the same place."""
    unit, size = ("m", 1.0) if length_m >= 1 else ("mm", 1e-3)
    value, half = length_m / size, half_m / size
    if not half > 0:
        return length_text(length_m, digits=4)
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 9))
    return f"{value:.{decimals}f} ± {half:.{decimals}f} {unit}"
