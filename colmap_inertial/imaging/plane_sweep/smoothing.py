"""Depths of planes through a pixel's surroundings, as far as these look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.imaging.plane_sweep.confidence import measure_motion
from colmap_inertial.imaging.plane_sweep.pinhole import ROWS_AT_ONCE, Pinhole


@dataclass(frozen=True, kw_only=True)
class PlaneModel:
    """Logarithm of twice the standard deviation in pixels of a plane's depth; as `SigmaModel`."""

    constant: float = 0.548
    #: Times logarithms: of the weight of the depths that the plane is fitted to,
    support: float = -0.657
    #: of their scatter about it, in px,
    scatter: float = 0.664
    #: and of the squared distance from their middle, in their own spread.
    leverage: float = 0.039


@dataclass(frozen=True, kw_only=True)
class SmoothingLimits:
    """Surroundings that a plane is fitted to, and weights in them."""

    #: A change of so many codes is as far away as so many pixels.
    sigma_px: float = 4.0
    sigma_codes: float = 30.0
    passes: int = 3
    #: Noise of single pixels is no edge.
    blur_px: float = 0.8
    #: A depth counts in full up to this standard deviation.
    certain_px: float = 0.75
    #: The smaller one of two standard deviations is too small by so much (``scripts/studies/fit_depth_sigma.py``, last
    #: table).
    chosen: float = 1.2
    #: Coordinates are counted in so many pixels, and their standard deviation is at least this.
    unit_px: float = 100.0
    least_spread_px: float = 0.3
    #: With less weight around, a pixel is far from all depths, and there is no plane.
    least_support: float = 0.01
    #: Added to measures before the logarithm is taken: smaller values tell nothing.
    support_floor: float = 0.003
    floor_px: float = 0.05
    leverage_floor: float = 0.1
    #: Rows that are worked on at once, and those beyond them: hardly anything of farther ones is felt.
    rows: int = 4 * ROWS_AT_ONCE
    margin_rows: int = 32


PLANE, _LIMITS = PlaneModel(), SmoothingLimits()
#: Names of the measures, in the order of their factors.
PLANE_MEASURES = tuple(field.name for field in fields(PlaneModel))


def smooth_depth(
    depth: Float32Array, sigma: Float32Array, picture: UInt8Array, camera: Pinhole, partners: Sequence[Pinhole]
) -> tuple[Float32Array, Float32Array]:
    """Take the depth of the plane through a pixel's surroundings where that is more certain than its own.

    Parameters
    ----------
    depth, sigma
        (H, W) depths and their standard deviations, in the model's unit; 0 where unknown.
    picture
        (H, W) or (H, W, 3) codes.
    camera
        What took it.
    partners
        Cameras of the images that it was matched with.

    Returns
    -------
    Depths and standard deviations, (H, W) each; also of pixels that had none.
    """
    measures, inverse, motion_px = measure_planes(depth, sigma, picture, camera, partners)
    twice_px = np.exp(np.tensordot(np.array(astuple(PLANE), dtype=np.float32), measures, axes=1))
    there = inverse > 0
    plane = np.divide(1, inverse, out=np.zeros_like(inverse), where=there)
    # compared as standard deviations of the inverse depth, which are those of matches
    plane_sigma = _LIMITS.chosen * 0.5 * twice_px / motion_px
    own_sigma = np.divide(sigma, depth**2, out=np.full_like(depth, 1e30), where=depth > 0)
    own_sigma *= np.float32(_LIMITS.chosen)
    better = there & (plane_sigma < own_sigma)
    chosen = np.where(better, plane, depth)
    return chosen, np.where(chosen > 0, np.where(better, plane_sigma, own_sigma) * chosen**2, 0).astype(np.float32)


def measure_planes(
    depth: Float32Array, sigma: Float32Array, picture: UInt8Array, camera: Pinhole, partners: Sequence[Pinhole]
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Fit planes of inverse depth, and measure what tells how certain they are.

    Parameters are those of :func:`smooth_depth`.

    Returns
    -------
    measures
        (4, H, W) in the order of :class:`PlaneModel`.
    inverse
        (H, W) inverse depths of the planes; 0 where there is none.
    motion_px
        (H, W) by how many pixels a change of inverse depth moves a pixel in the partners, root mean square.

    Notes
    -----
    Weighted moments are filtered by the domain transform (Gastal and Oliveira, SIGGRAPH 2011), to which an edge in the
    image is a distance.
    """
    import cv2

    motion_px = measure_motion(camera, partners)
    guide = cv2.GaussianBlur(picture, (0, 0), _LIMITS.blur_px)
    if guide.ndim == 2:  # edges are sums over three channels
        guide = cv2.merge([guide] * 3)
    known = depth > 0
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known)
    sigma_px = np.maximum(sigma * inverse**2 * motion_px, 1e-9)
    weight = np.where(known, np.minimum(1, (_LIMITS.certain_px / sigma_px) ** 2), 0).astype(np.float32)
    planes = np.empty((4, *depth.shape), dtype=np.float32)
    for begin in range(0, len(depth), _LIMITS.rows):
        end = min(len(depth), begin + _LIMITS.rows)
        first = max(0, begin - _LIMITS.margin_rows)
        rows = slice(first, min(len(depth), end + _LIMITS.margin_rows))
        fitted = _fit_planes(inverse[rows], weight[rows], np.ascontiguousarray(guide[rows]))
        planes[:, begin:end] = fitted[:, begin - first : end - first]
    value, support, scatter, leverage = planes
    if known.any():
        # a plane is never nearer or farther than all depths
        near, far = (inverse[known].max(), inverse[known].min())
        value = np.where((support >= _LIMITS.least_support) & (value >= far) & (value <= near), value, np.float32(0))
    measures = np.stack(
        [
            np.ones_like(value),
            np.log(support + np.float32(_LIMITS.support_floor)),
            np.log(scatter * motion_px + np.float32(_LIMITS.floor_px)),
            np.log(leverage + np.float32(_LIMITS.leverage_floor)),
        ]
    )
    return measures, value, motion_px


def _fit_planes(inverse: Float32Array, weight: Float32Array, guide: UInt8Array) -> Array:
    """(4, H, W) value of the plane at each pixel, weight of its depths, their scatter, squared distance from them."""
    import cv2

    if not weight.any():
        return np.zeros((4, *inverse.shape), dtype=np.float32)
    height, width = inverse.shape
    y, x = np.indices(inverse.shape, dtype=np.float32)
    x, y = ((axis - np.float32(size / 2)) / np.float32(_LIMITS.unit_px) for axis, size in ((x, width), (y, height)))
    middle = float(inverse[weight > 0].mean())
    q = (inverse / middle - 1).astype(np.float32)
    moments = (weight * part for part in (np.float32(1), x, y, q, x * x, x * y, y * y, x * q, y * q, q * q))
    edges = cv2.ximgproc.createDTFilter(
        guide, _LIMITS.sigma_px, _LIMITS.sigma_codes, cv2.ximgproc.DTF_RF, _LIMITS.passes
    )
    # four at a time are filtered in half the time
    stacked = [*moments, weight, weight]
    filtered = [edges.filter(cv2.merge(stacked[k : k + 4])) for k in (0, 4, 8)]
    total, *sums = (part for four in filtered for part in cv2.split(four))
    share = 1 / (total + np.float32(1e-6))
    mx, my, mq, xx, xy, yy, xq, yq, qq = (part * share for part in sums[:9])
    spread = np.float32((_LIMITS.least_spread_px / _LIMITS.unit_px) ** 2)
    # rounding must not make a spread negative
    xx, xy, yy = np.maximum(xx - mx * mx, 0) + spread, xy - mx * my, np.maximum(yy - my * my, 0) + spread
    xq, yq, qq = xq - mx * mq, yq - my * mq, qq - mq * mq
    determinant = np.maximum(xx * yy - xy * xy, spread * spread)
    slope_x, slope_y = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
    dx, dy = x - mx, y - my
    value = middle * (1 + mq + slope_x * dx + slope_y * dy)
    scatter = middle * np.sqrt(np.maximum(qq - slope_x * xq - slope_y * yq, 0))
    leverage = np.maximum(yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy, 0) / determinant
    return np.stack([value, total, scatter, leverage]).astype(np.float32)
