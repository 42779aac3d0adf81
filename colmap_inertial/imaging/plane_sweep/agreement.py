"""Depths that other views' depths confirm, there and back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.imaging.plane_sweep.pinhole import ROWS_AT_ONCE, Pinhole

#: Matrix and offset from a pixel and its depth to another view.
Transfer = tuple[Array, Array]


@dataclass(frozen=True, kw_only=True)
class AgreementLimits:
    """Limits for depths of two images that agree."""

    #: How far from itself a pixel may come back, and by which share its depth may have changed.
    within_px: float = 1.0
    within_share: float = 0.02


_LIMITS = AgreementLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthView:
    """A picture's depths, (H, W), and the camera that took it."""

    depth: Float32Array
    camera: Pinhole


def confirm_depth(reference: DepthView, others: Iterable[DepthView]) -> Float32Array:
    """Keep the depths that at least one other view agrees with.

    A pixel is taken to the other view by its depth, and back by the depth that was found there.

    Parameters
    ----------
    reference
        Whose depths are judged.
    others
        Views that see some of the same; read one after the other.

    Returns
    -------
    (H, W) means of the depths that agree, the reference's own among them; 0 where none does.
    """
    depth = reference.depth
    total, count = depth.copy(), np.ones(depth.shape, dtype=np.float32)
    for other in others:
        there, back = other.camera.seen_from(reference.camera), reference.camera.seen_from(other.camera)
        for begin in range(0, len(depth), ROWS_AT_ONCE):
            rows = slice(begin, begin + ROWS_AT_ONCE)
            depth_back = _transfer_there_and_back(depth[rows], begin, other.depth, there, back)
            agrees = np.abs(depth_back - depth[rows]) <= _LIMITS.within_share * depth[rows]
            total[rows] += np.where(agrees, depth_back, 0)
            count[rows] += agrees
    return np.where((count > 1) & (depth > 0), total / count, 0).astype(np.float32)


def _transfer_there_and_back(
    depth: Float32Array, begin: int, other: Float32Array, there: Transfer, back: Transfer
) -> Float32Array:
    """The depths that rows ``begin ...`` come back with, by another view's depths; nan where they do not."""
    rows, columns = np.indices(depth.shape)
    y, x = (np.asarray(axis, dtype=np.float32) for axis in (rows + begin, columns))
    u, v, w = _transfer_pixels(*there, x, y, depth)
    high, wide = other.shape
    column, row = np.rint(u), np.rint(v)
    inside = (depth > 0) & (w > 0) & (column >= 0) & (row >= 0) & (column < wide) & (row < high)
    at = np.where(inside, row, 0).astype(np.intp) * wide + np.where(inside, column, 0).astype(np.intp)
    found = other.ravel()[at]
    x_back, y_back, depth_back = _transfer_pixels(*back, np.where(inside, u, 0), np.where(inside, v, 0), found)
    near = (x_back - x) ** 2 + (y_back - y) ** 2 <= _LIMITS.within_px**2
    return np.where(inside & (found > 0) & near, depth_back, np.float32(np.nan))


def _transfer_pixels(
    matrix: Array, offset: Array, x: Float32Array, y: Float32Array, depth: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Pixels and depths in another view, (H, W) each; not finite where they lie in the plane of its centre."""
    m, b = matrix.astype(np.float32), offset.astype(np.float32)
    u, v, w = ((m[i, 0] * x + m[i, 1] * y + m[i, 2]) * depth + b[i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return u / w, v / w, w
