"""Standard deviations of swept depths, and the depths that are certain enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.imaging.plane_sweep.agreement import Agreement
from colmap_inertial.imaging.plane_sweep.pinhole import ROWS_AT_ONCE, Pinhole


@dataclass(frozen=True, kw_only=True)
class SigmaModel:
    """Logarithm of twice the standard deviation in pixels of the partners: a sum of factors times measures.

    ``scripts/studies/fit_depth_sigma.py`` fits the factors on photographic worlds, as the 95 % quantile of
    errors. Beside these measures, texture along the epipolar lines (its factor is 0.001), the share of views that agree
    closely and the spread of their depths told nothing more; in all classes of texture 92 to 96 % of errors are within.
    """

    constant: float = 0.883
    #: Times the share of views that see something behind the point;
    beyond: float = 0.856
    #: times logarithms: of the weight of the depths around that agree with others,
    weight: float = -0.499
    #: of their scatter about a plane, in px,
    scatter: float = 0.772
    #: and of the depth's own distance from that plane, in px.
    away: float = 0.239


@dataclass(frozen=True, kw_only=True)
class ConfidenceLimits:
    """Windows of the measures, and the depths that are kept."""

    #: Planes are fitted to 9 x 9 pixels.
    plane_radius_px: int = 4
    #: Coordinates are counted in so many pixels, so that products of them are near 1,
    unit_px: float = 100.0
    #: and their standard deviation is at least this: a line of depths leaves the slope across it at zero.
    least_spread_px: float = 0.1
    #: Added to measures before the logarithm is taken: smaller values tell nothing.
    weight_floor: float = 0.02
    floor_px: float = 0.05
    #: A distance from the plane counts as at most this one.
    most_away_px: float = 10.0
    #: Depths with a larger standard deviation, as a share of the depth, are left out. On a photographic world
    #: (``python -m scripts.benchmarks.dense FOLDER --world photo --seeds 0``) 81 % of the near pixels keep a depth,
    #: 90.8 % of these within 1 %; with 0.04, a hundredth fewer and 0.4 % more.
    most_share: float = 0.045


SIGMA, _LIMITS = SigmaModel(), ConfidenceLimits()
#: Names of the measures, in the order of their factors.
MEASURES = tuple(field.name for field in fields(SigmaModel))


def estimate_sigma(agreement: Agreement, camera: Pinhole, partners: Sequence[Pinhole]) -> Float32Array:
    """Estimate standard deviations of depths.

    Parameters
    ----------
    agreement
        Of the depths of one image with those of others.
    camera
        What took it.
    partners
        Cameras of the images that it was matched with.

    Returns
    -------
    (H, W) in the model's unit; 0 where depth is unknown.
    """
    measures, motion_px = measure_pixels(agreement, camera, partners)
    twice_px = np.exp(np.tensordot(np.array(astuple(SIGMA), dtype=np.float32), measures, axes=1))
    # depth is the inverse of what moves a pixel by motion_px
    sigma = 0.5 * twice_px / motion_px * agreement.depth**2
    return np.asarray(np.where(agreement.depth > 0, sigma, 0), dtype=np.float32)


def keep_certain(depth: Float32Array, sigma: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Depths and standard deviations, (H, W) each; 0 where the standard deviation is a large share of the depth."""
    kept = (depth > 0) & (sigma <= np.float32(_LIMITS.most_share) * depth)
    return np.where(kept, depth, np.float32(0)), np.where(kept, sigma, np.float32(0))


def measure_pixels(
    agreement: Agreement, camera: Pinhole, partners: Sequence[Pinhole]
) -> tuple[Float32Array, Float32Array]:
    """Measure what tells how certain depths are.

    Parameters are those of :func:`estimate_sigma`.

    Returns
    -------
    measures
        (5, H, W) in the order of :class:`SigmaModel`.
    motion_px
        (H, W) by how many pixels a change of inverse depth moves a pixel in the partners, root mean square.
    """
    motion_px = measure_motion(camera, partners)
    known = agreement.depth > 0
    inverse = np.divide(1, agreement.depth, out=np.zeros_like(agreement.depth), where=known)
    weight, scatter, away = _measure_planes(inverse, np.where(known, agreement.agreeing, 0))
    floor_px = np.float32(_LIMITS.floor_px)
    measures = np.stack(
        [
            np.ones_like(inverse),
            agreement.beyond,
            np.log(weight + np.float32(_LIMITS.weight_floor)),
            np.log(scatter * motion_px + floor_px),
            np.log(np.minimum(away * motion_px, np.float32(_LIMITS.most_away_px)) + floor_px),
        ]
    )
    return measures, motion_px


def measure_motion(camera: Pinhole, partners: Sequence[Pinhole]) -> Float32Array:
    """(H, W) motion of pixels in the partners for a change of inverse depth, root mean square."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    squared = np.zeros((camera.height, camera.width))
    for partner in partners:
        bx, by, bz = camera.cam_from_world @ (partner.cam_in_world - camera.cam_in_world)
        u = fx * bx - (np.arange(camera.width) - cx) * bz
        v = fy * by - (np.arange(camera.height)[:, None] - cy) * bz
        squared += u * u + v * v
    return np.sqrt(np.maximum(squared, np.finfo(np.float32).tiny) / max(1, len(partners))).astype(np.float32)


def _measure_planes(inverse: Float32Array, weight: Float32Array) -> Float32Array:
    """(3, H, W): mean weight around pixels, scatter about the weighted plane there, and distance from it."""
    out = np.empty((3, *inverse.shape), dtype=np.float32)
    radius, height = _LIMITS.plane_radius_px, len(inverse)
    for begin in range(0, height, ROWS_AT_ONCE):
        end = min(height, begin + ROWS_AT_ONCE)
        first = max(0, begin - radius)
        rows = slice(first, min(height, end + radius))
        out[:, begin:end] = _measure_planes_of_rows(inverse[rows], weight[rows])[:, begin - first : end - first]
    return out


def _measure_planes_of_rows(inverse: Float32Array, weight: Float32Array) -> Array:
    import cv2

    side = 2 * _LIMITS.plane_radius_px + 1

    def average(values: Array) -> Array:
        return np.asarray(cv2.boxFilter(values, -1, (side, side), borderType=cv2.BORDER_CONSTANT))

    height, width = inverse.shape
    # a weight everywhere: sums in float64 stay above their rounding
    q, w = inverse.astype(np.float64), weight.astype(np.float64) + 1e-9
    y, x = np.indices(inverse.shape, dtype=np.float64)
    x, y = (x - width / 2) / _LIMITS.unit_px, (y - height / 2) / _LIMITS.unit_px
    total, spread = average(w), (_LIMITS.least_spread_px / _LIMITS.unit_px) ** 2
    mx, my, mq, xx, xy, yy, xq, yq, qq = (
        average(w * values) / total for values in (x, y, q, x * x, x * y, y * y, x * q, y * q, q * q)
    )
    xx, xy, yy = xx - mx * mx + spread, xy - mx * my, yy - my * my + spread
    xq, yq, qq = xq - mx * mq, yq - my * mq, qq - mq * mq
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
    scatter = np.sqrt(np.maximum(qq - slope_x * xq - slope_y * yq, 0))
    return np.stack([total, scatter, np.abs(q - mq - slope_x * (x - mx) - slope_y * (y - my))])
