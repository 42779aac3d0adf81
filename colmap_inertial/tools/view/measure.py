"""Lengths in a scene: which point was clicked, how far two are apart, and how to write it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.types import LengthUnit


@dataclass(frozen=True, kw_only=True)
class ClickAngles:
    """Largest angles of a click from its target."""

    widest_rad: float = 0.03
    """A click means a point within this angle of it."""
    same_rad: float = 0.004
    """Of several points within this angle, the one in front."""
    smallest_rad: float = 0.008
    """Nothing that can be clicked is smaller."""


ANGLES = ClickAngles()


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
        return _format_interval(self.length, 0.5 * (self.ci95[1] - self.ci95[0]))


def measure_distance(a: Array, b: Array, unit: LengthUnit, relative_ci95: tuple[float, float] | None) -> Measured:
    """The distance between two points.

    Parameters
    ----------
    a, b
        (3,) points in ``unit``.
    relative_ci95
        The scale's 95 % interval divided by the scale; ``None`` where unknown.
    """
    length = float(np.linalg.norm(np.asarray(a) - np.asarray(b)))
    ci95 = None
    if unit == "m" and relative_ci95 is not None:
        ci95 = length * relative_ci95[0], length * relative_ci95[1]
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
    depth, beside = _project_on_ray(points, origin, direction)
    angle = np.where(depth > 0, np.arctan2(beside, depth), np.inf)
    smallest = float(angle.min(initial=np.inf))
    return None if smallest > ANGLES.widest_rad else _foremost(depth, angle <= max(smallest, ANGLES.same_rad))


def ball_at_ray(middles: Array, radius: float, origin: Array, direction: Array) -> int | None:
    """The foremost of equally large balls (N, 3) that a ray meets, far ones a little larger; ``None`` where none."""
    depth, beside = _project_on_ray(middles, origin, direction)
    return _foremost(depth, (depth > 0) & (beside < np.maximum(radius, ANGLES.smallest_rad * depth)))


def _project_on_ray(points: Array, origin: Array, direction: Array) -> tuple[Array, Array]:
    """(N,) how far along a ray points (N, 3) lie, and how far beside it."""
    away = np.asarray(points, dtype=np.float64) - origin
    depth = away @ (np.asarray(direction) / np.linalg.norm(direction))
    return depth, np.sqrt(np.maximum(np.sum(away**2, axis=1) - depth**2, 0))


def _foremost(depth: Array, chosen: BoolArray) -> int | None:
    """The index of the least depth among the chosen ones."""
    return int(np.argmin(np.where(chosen, depth, np.inf))) if chosen.any() else None


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


def _format_interval(length_m: float, half_m: float) -> str:
    """Two digits of the uncertainty, and the length to the same place."""
    unit, size = ("m", 1.0) if length_m >= 1 else ("mm", 1e-3)
    value, half = length_m / size, half_m / size
    if not half > 0:
        return length_text(length_m, digits=4)
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 9))
    return f"{value:.{decimals}f} ± {half:.{decimals}f} {unit}"
