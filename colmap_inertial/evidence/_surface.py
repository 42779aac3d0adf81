"""Depth maps as surfaces: where they are smooth, and how they lie there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.types.depth import DepthMap

#: Planes are fitted in windows of so many pixels to each side.
_HALF_PX = 3
#: Sum of squared distances of a full window's pixels from its middle: a slope's variance is the noise's over it.
SPREAD_PX2 = (2 * _HALF_PX + 1) * _HALF_PX * (_HALF_PX + 1) * (2 * _HALF_PX + 1) / 3
#: Of which at least so many must be measured.
_FILLED = 0.8
#: Pixels whose window is that much rougher than the map's median are edges.
_ROUGHER = 3.0
#: Roughness below this (m, standard deviation) is no edge, however smooth the rest of the map is.
_LEAST_M = 0.003


@dataclass(frozen=True, kw_only=True)
class DepthRange:
    """Depths that phones' sensors measure: nearer ones blend, farther ones are no echoes.

    Apple states 5 m for its LiDAR; the nearest depth that its maps give is about .2 m.
    """

    nearest_m: float = 0.25
    farthest_m: float = 4.5


_RANGE = DepthRange()


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Inverse depth, which is a plane's in pixels too.

    Attributes
    ----------
    inverse
        (H, W) 1/m, of the plane around each pixel.
    slope
        (H, W, 2) its derivative by x and y, 1/m per pixel.
    noise
        (H, W) standard deviation about that plane, 1/m.
    smooth
        (H, W) where it is one.
    source
        The map.
    """

    inverse: Array
    slope: Array
    noise: Array
    smooth: BoolArray
    source: DepthMap


def fit_surface(depth: DepthMap, within: DepthRange = _RANGE) -> Surface:
    """Fit a plane around each pixel of a depth map; edges and what is out of range are left out."""
    depth_m = depth.depth_m
    known = (depth_m > within.nearest_m) & (depth_m < within.farthest_m)
    inverse = np.where(known, 1 / np.where(known, depth_m, 1.0), 0.0)
    weight = known.astype(np.float64)
    offsets = np.arange(-_HALF_PX, _HALF_PX + 1, dtype=np.float64)
    flat, ramp, bowl = np.ones_like(offsets), offsets, offsets**2
    n, sum_w = _windowed(weight, flat, flat), _windowed(inverse, flat, flat)
    n_x, n_y = _windowed(weight, flat, ramp), _windowed(weight, ramp, flat)
    n_xx, n_yy, n_xy = _windowed(weight, flat, bowl), _windowed(weight, bowl, flat), _windowed(weight, ramp, ramp)
    w_x, w_y = _windowed(inverse, flat, ramp), _windowed(inverse, ramp, flat)
    square = _windowed(inverse**2, flat, flat)
    enough = known & (n >= _FILLED * len(offsets) ** 2)
    normal = np.stack([n, n_x, n_y, n_x, n_xx, n_xy, n_y, n_xy, n_yy], axis=-1).reshape(*n.shape, 3, 3)
    right = np.stack([sum_w, w_x, w_y], axis=-1)
    plane = np.zeros_like(right)
    plane[enough] = np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]
    left = np.maximum(square - np.einsum("hwk,hwk->hw", plane, right), 0.0) / np.maximum(n - 3, 1)
    noise = np.sqrt(left)
    rough_m = np.where(enough, noise * np.where(known, depth_m, 1.0) ** 2, np.inf)
    usual_m = float(np.median(rough_m[enough])) if enough.any() else 0.0
    smooth = enough & (rough_m < max(_ROUGHER * usual_m, _LEAST_M)) & (plane[..., 0] > 0)
    return Surface(inverse=plane[..., 0], slope=plane[..., 1:], noise=noise, smooth=smooth, source=depth)


def _windowed(values: Array, down: Array, across: Array) -> Array:
    """Sums of values times weights by row and by column, over the window around each pixel; nothing lies outside."""
    from scipy.ndimage import correlate1d

    rows = correlate1d(values, down, axis=0, mode="constant")
    return np.asarray(correlate1d(rows, across, axis=1, mode="constant"))
