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
    """An image's depths, (H, W), and the camera that took it."""

    depth: Float32Array
    camera: Pinhole


@dataclass(frozen=True, eq=False, kw_only=True)
class Agreement:
    """Comparison of an image's depths with those of other views, (H, W) each.

    Attributes
    ----------
    depth
        Means of the depths that agree, the reference's own among them; 0 where none does.
    agreeing, beyond
        Shares of the views whose depth agrees, and of those whose depth lies behind the point that they should see.
    """

    depth: Float32Array
    agreeing: Float32Array
    beyond: Float32Array


def confirm_depth(reference: DepthView, others: Iterable[DepthView]) -> Agreement:
    """Keep the depths that at least one other view agrees with.

    A pixel is taken to the other view by its depth, and back by the depth that was found there.

    Parameters
    ----------
    reference
        Whose depths are judged.
    others
        Views that see some of the same; read one after the other.
    """
    depth = reference.depth
    total = depth.copy()
    agreeing, beyond = (np.zeros(depth.shape, dtype=np.float32) for _ in range(2))
    asked = 0
    for other in others:
        asked += 1
        there, back = other.camera.seen_from(reference.camera), reference.camera.seen_from(other.camera)
        for begin in range(0, len(depth), ROWS_AT_ONCE):
            rows = slice(begin, begin + ROWS_AT_ONCE)
            depth_back, ratio = _transfer_there_and_back(depth[rows], begin, other.depth, there, back)
            agrees = np.abs(depth_back - depth[rows]) <= _LIMITS.within_share * depth[rows]
            total[rows] += np.where(agrees, depth_back, 0)
            agreeing[rows] += agrees
            beyond[rows] += ~agrees & (ratio > 1 + _LIMITS.within_share)
    mean = np.where((agreeing > 0) & (depth > 0), total / (agreeing + 1), 0).astype(np.float32)
    for count in (agreeing, beyond):
        count /= max(1, asked)
    return Agreement(depth=mean, agreeing=agreeing, beyond=beyond)


def _transfer_there_and_back(
    depth: Float32Array, begin: int, other: Float32Array, there: Transfer, back: Transfer
) -> tuple[Float32Array, Float32Array]:
    """Depths with which rows ``begin ...`` come back, nan where they do not, and ratios of the depths there.

    The ratio is of the depth that was found there and the one that was expected, 0 where none was found.
    """
    rows, columns = np.indices(depth.shape)
    y, x = (np.asarray(axis, dtype=np.float32) for axis in (rows + begin, columns))
    u, v, w = _transfer_pixels(*there, x, y, depth)
    high, wide = other.shape
    column, row = np.rint(u), np.rint(v)
    inside = (depth > 0) & (w > 0) & (column >= 0) & (row >= 0) & (column < wide) & (row < high)
    at = np.where(inside, row, 0).astype(np.intp) * wide + np.where(inside, column, 0).astype(np.intp)
    sampled = other.ravel()[at]
    x_back, y_back, depth_back = _transfer_pixels(*back, np.where(inside, u, 0), np.where(inside, v, 0), sampled)
    near = (x_back - x) ** 2 + (y_back - y) ** 2 <= _LIMITS.within_px**2
    met = inside & (sampled > 0)
    ratio = np.divide(sampled, w, out=np.zeros_like(w), where=met)
    return np.where(met & near, depth_back, np.float32(np.nan)), ratio


def _transfer_pixels(
    matrix: Array, offset: Array, x: Float32Array, y: Float32Array, depth: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Pixels and depths in another view, (H, W) each; not finite where they lie in the plane of its centre."""
    m, b = matrix.astype(np.float32), offset.astype(np.float32)
    u, v, w = ((m[i, 0] * x + m[i, 1] * y + m[i, 2]) * depth + b[i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return u / w, v / w, w
