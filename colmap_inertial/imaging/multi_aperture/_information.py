"""Mutual information as a matching cost: how the brightness of two views goes together."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.imaging.multi_aperture._geometry import Rectified
from colmap_inertial.imaging.multi_aperture._sampling import warp_view

#: Standard deviation of the Gaussian that stands for the unknown noise of codes (Parzen estimate, 7 x 7 codes).
_SPREAD_CODES = 1.0


def cost_tables(
    reference: UInt8Array, others: UInt8Array, canvas: Rectified, disparity_px: Float32Array, most: int
) -> UInt8Array:
    """(N - 1, 256, 256) costs by the codes of the reference and of each view, from 0 to ``most``.

    ``-mi(i, k)`` with ``mi = h_1(i) + h_2(k) - h_12(i, k)`` and ``h = -1/n log(P * g) * g``, ``P`` the codes that lie
    on each other by the disparities so far (Hirschmueller 2008, equations 5 to 8), scaled so that the usual codes span
    the range.

    Parameters
    ----------
    reference, others
        (H, W), (N - 1, H, W).
    disparity_px
        (H, W).
    """
    tables = []
    for k, view in enumerate(others, start=1):
        warped, inside = warp_view(view, canvas, k, disparity_px)
        codes = np.clip(np.rint(warped[inside]), 0, 255).astype(np.intp)
        joint = np.bincount(256 * reference[inside].astype(np.intp) + codes, minlength=65536).reshape(256, 256)
        tables.append(_make_table(joint / max(1, joint.sum()), most))
    return np.stack(tables)


def _make_table(joint: Array, most: int) -> UInt8Array:
    def information(probability: Array) -> Array:
        """``-log(P * g) * g``: per correspondence, but for the constant 1/n."""
        smooth = _smooth(probability)
        return _smooth(-np.log(np.maximum(smooth, 1e-9)))

    mutual = information(joint.sum(axis=1))[:, None] + information(joint.sum(axis=0)) - information(joint)
    used = _smooth(joint) > 1e-7
    low, high = np.percentile(mutual[used], (2, 98)) if used.any() else (0.0, 0.0)
    if high <= low:
        return np.zeros((256, 256), dtype=np.uint8)
    scaled = most * (high - mutual) / (high - low)
    return np.asarray(np.clip(np.rint(scaled), 0, most), dtype=np.uint8)


def _smooth(values: Array) -> Array:
    """Gaussian along every axis, ends mirrored."""
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / _SPREAD_CODES) ** 2)
    kernel /= kernel.sum()
    for axis in range(values.ndim):
        padded = np.pad(values, [(3, 3) if a == axis else (0, 0) for a in range(values.ndim)], mode="symmetric")
        values = sum(
            weight * np.take(padded, np.arange(i, i + values.shape[axis]), axis=axis) for i, weight in enumerate(kernel)
        )
    return np.asarray(values)
