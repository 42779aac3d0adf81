"""Means of samples over any intervals."""

from __future__ import annotations

import numpy as np

from colmap_inertial.types import Array


def integral_at(t_s: Array, values: Array, query_s: Array) -> Array:
    """(..., 3) the integral of (N, 3) samples from the first one to query times of any shape, by trapezoids."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    return np.stack([np.interp(query_s, t_s, column) for column in integral.T], axis=-1)
