"""Values between the nodes of a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.types import Array


def bilinear(grid: NDArray[Any], rows: Array, columns: Array) -> NDArray[Any]:
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
