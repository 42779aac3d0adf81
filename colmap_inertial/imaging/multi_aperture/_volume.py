"""Candidate disparities of a canvas, and their matching costs."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt16Array
from colmap_inertial.imaging.multi_aperture._geometry import Rectified
from colmap_inertial.imaging.semi_global import Views, match_candidates


def candidates(low_px: float, high_px: float, step_px: float) -> Array:
    """(D,) disparities to try, one beyond each end, so that a parabola has neighbours."""
    first, last = np.floor(low_px / step_px) - 1, np.ceil(high_px / step_px) + 1
    return np.asarray(step_px * np.arange(first, last + 1))


def match(views: Views, canvas: Rectified, disparities_px: Array, *, threads: int) -> tuple[Float32Array, UInt16Array]:
    """Match all views at once.

    Parameters
    ----------
    views
        On the canvas.
    disparities_px
        (D,) equally spaced candidates.

    Returns
    -------
    (H, W) disparities with the least sum of costs, and that sum.
    """
    columns, rows = canvas.sample_positions(disparities_px)
    best, sums = match_candidates(views, columns, rows, threads=threads)
    step_px = disparities_px[1] - disparities_px[0]
    return (disparities_px[0] + step_px * best).astype(np.float32), sums
