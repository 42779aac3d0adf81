"""Values between the nodes of a grid."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array


def bilinear(grid: AnyArray, rows: Array, columns: Array) -> AnyArray:
    """(R, C, ...) a (Gy, Gx, ...) grid at the crossings of rows and columns, given in distances between nodes.

    In the grid's precision. What lies beyond the last node has its value; nothing may lie before the first.
    """
    for axis, at in enumerate((rows, columns)):
        first = np.minimum(np.asarray(at).astype(np.intp), grid.shape[axis] - 1)
        following = np.minimum(first + 1, grid.shape[axis] - 1)
        part = np.minimum(at - first, 1).astype(grid.dtype)
        part = part.reshape((-1,) + (1,) * (grid.ndim - axis - 1))
        here = grid.take(first, axis=axis)
        grid = here + part * (grid.take(following, axis=axis) - here)
    return grid


def interpolate_nodes(nodes: AnyArray, at: Array) -> Array:
    """Bilinear values at (..., 2) fractional columns and rows of a (Gy, Gx, C) grid; beyond it, the edge's."""
    rows, columns = nodes.shape[:2]
    x, y = np.clip(at[..., 0], 0, columns - 1), np.clip(at[..., 1], 0, rows - 1)
    j, i = np.minimum(x.astype(np.intp), columns - 2), np.minimum(y.astype(np.intp), rows - 2)
    t, s = (x - j)[..., None], (y - i)[..., None]
    upper = nodes[i, j] * (1 - t) + nodes[i, j + 1] * t
    lower = nodes[i + 1, j] * (1 - t) + nodes[i + 1, j + 1] * t
    return np.asarray(upper * (1 - s) + lower * s)
