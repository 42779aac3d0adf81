"""Normals of a depth map's surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import BoolArray, Float32Array
from colmap_inertial.imaging.plane_sweep.pinhole import ROWS_AT_ONCE, Pinhole


@dataclass(frozen=True, kw_only=True)
class NormalLimits:
    """Limits of the fit of planes."""

    #: Pixels from the centre of the window.
    radius_px: int = 3
    #: Neighbours are of the same surface where their inverse depth is within this share of the middle's.
    same_share: float = 0.03
    #: Fewer neighbours than these make no plane.
    least_neighbours: int = 6


_LIMITS = NormalLimits()


def estimate_normals(depth: Float32Array, camera: Pinhole) -> Float32Array:
    """Fit a plane around each pixel.

    On a plane ``n X = d``, inverse depth ``1/z = n (x, y, 1) / d`` is linear in the pixel's coordinates: least squares
    over 7 x 7 pixels, those of other surfaces left out.

    Parameters
    ----------
    depth
        (H, W), 0 where unknown.
    camera
        Whose depths they are.

    Returns
    -------
    (H, W, 3) unit vectors in the camera's frame, towards the camera; 0 where depth is unknown. Where there are too few
    neighbours, straight against the ray.
    """
    import cv2

    height, width = depth.shape
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    middle = np.asarray(cv2.medianBlur(inverse, 5))
    middle = np.where(np.abs(middle - inverse) > _LIMITS.same_share * inverse, inverse, middle)
    room = np.pad(inverse, _LIMITS.radius_px)
    out = np.empty((height, width, 3), dtype=np.float32)
    for begin in range(0, height, ROWS_AT_ONCE):
        end = min(height, begin + ROWS_AT_ONCE)
        rows = slice(begin, end)
        out[rows] = _fit_rows(known[rows], middle[rows], room[begin : end + 2 * _LIMITS.radius_px], begin, camera)
    return out


def _fit_rows(known: BoolArray, middle: Float32Array, room: Float32Array, begin: int, camera: Pinhole) -> Float32Array:
    """Fit rows ``begin ...``; ``room`` is their inverse depth with the neighbours around."""
    height, width = known.shape
    tolerance = _LIMITS.same_share * middle
    count, sx, sy, sxx, sxy, syy, sq, sxq, syq = (np.zeros(known.shape, dtype=np.float32) for _ in range(9))
    for dy in range(-_LIMITS.radius_px, _LIMITS.radius_px + 1):
        for dx in range(-_LIMITS.radius_px, _LIMITS.radius_px + 1):
            away = (
                room[
                    _LIMITS.radius_px + dy : _LIMITS.radius_px + dy + height,
                    _LIMITS.radius_px + dx : _LIMITS.radius_px + dx + width,
                ]
                - middle
            )
            same = np.abs(away) <= tolerance
            away *= same
            same_bytes = same.view(np.uint8)
            for total, factor in ((count, 1), (sx, dx), (sy, dy), (sxx, dx * dx), (sxy, dx * dy), (syy, dy * dy)):
                if factor:
                    total += np.float32(factor) * same_bytes
            for total, factor in ((sq, 1), (sxq, dx), (syq, dy)):
                if factor:
                    total += np.float32(factor) * away
    # the normal equations without the constant
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 1 / np.maximum(count, 1)
        vxx, vxy, vyy = sxx - sx * sx * share, sxy - sx * sy * share, syy - sy * sy * share
        vxq, vyq = sxq - sx * sq * share, syq - sy * sq * share
        determinant = vxx * vyy - vxy * vxy
        slope_x, slope_y = (vyy * vxq - vxy * vyq) / determinant, (vxx * vyq - vxy * vxq) / determinant
    flat = known & (count >= _LIMITS.least_neighbours) & (determinant > 1e-3)
    slope_x, slope_y = np.where(flat, slope_x, 0), np.where(flat, slope_y, 0)
    level = middle + (sq - slope_x * sx - slope_y * sy) * share
    (fx, fy), (cx, cy) = camera.focal_px.astype(np.float32), camera.centre_px.astype(np.float32)
    y, x = (axis.astype(np.float32) for axis in np.indices(known.shape))
    y += np.float32(begin)
    normal = np.stack([slope_x * fx, slope_y * fy, level + slope_x * (cx - x) + slope_y * (cy - y)], axis=-1)
    ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    normal = np.where(flat[..., None], normal, ray)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.where(known[..., None], -normal / np.maximum(length, 1e-12), 0), dtype=np.float32)
