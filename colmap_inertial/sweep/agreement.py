"""Depths that other views' depths confirm, there and back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.sweep.pinhole import Pinhole

Real = NDArray[np.float32]

#: How far from itself a pixel may come back, and by which share its depth may have changed.
_WITHIN_PX, _WITHIN_SHARE = 1.0, 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthView:
    """A picture's depths, (H, W), and the camera that took it."""

    depth: Real
    camera: Pinhole


def agreed_depth(reference: DepthView, others: Iterable[DepthView]) -> Real:
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
    height, width = depth.shape
    y, x = (axis.astype(np.float32) for axis in np.indices((height, width)))
    total, count = depth.copy(), np.ones(depth.shape, dtype=np.float32)
    for other in others:
        there, offset = other.camera.seen_from(reference.camera)
        u, v, w = _carried(there, offset, x, y, depth)
        back, back_offset = reference.camera.seen_from(other.camera)
        high, wide = other.depth.shape
        column, row = np.rint(u), np.rint(v)
        inside = (depth > 0) & (w > 0) & (column >= 0) & (row >= 0) & (column < wide) & (row < high)
        at = np.where(inside, row, 0).astype(np.intp) * wide + np.where(inside, column, 0).astype(np.intp)
        found = other.depth.ravel()[at]
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        x_back, y_back, depth_back = _carried(back, back_offset, u, v, found)
        near = (x_back - x) ** 2 + (y_back - y) ** 2 <= _WITHIN_PX**2
        agrees = inside & (found > 0) & near & (np.abs(depth_back - depth) <= _WITHIN_SHARE * depth)
        total += np.where(agrees, depth_back, 0)
        count += agrees
    return np.where((count > 1) & (depth > 0), total / count, 0).astype(np.float32)


def _carried(
    matrix: NDArray[np.float64], offset: NDArray[np.float64], x: Real, y: Real, depth: Real
) -> tuple[Real, Real, Real]:
    """Pixels and depths in another view, (H, W) each; not finite where they lie in the plane of its centre."""
    m, b = matrix.astype(np.float32), offset.astype(np.float32)
    u, v, w = ((m[i, 0] * x + m[i, 1] * y + m[i, 2]) * depth + b[i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return u / w, v / w, w
