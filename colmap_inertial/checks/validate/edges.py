"""Corners of single square markers from all black-white edges of their code.

The corner of a lone black square has white on three sides: a blurred image recorded with a gamma curve shifts both of
its edges outwards or inwards, and the marker measures up to a few per cent too small or too large. The code inside
holds the cure: its edges run the other way too (white inside black), so the shift and the marker's size can be told
apart. One homography and one common shift of all edges towards white are fitted to the edges of all cells.
"""

from __future__ import annotations

import numpy as np

from colmap_inertial.checks.validate.limits import DETECTION
from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, UInt8Array

_ALONG = np.array([0.2, 0.35, 0.5, 0.65, 0.8])


def refine_marker(image: UInt8Array, corners_px: Array, bits: BoolArray) -> Array | None:
    """The four outer corners of a marker.

    Parameters
    ----------
    image
        (H, W) grey values.
    corners_px
        (4, 2) first guess, OpenCV's pixels, clockwise from the marker's upper left, within about half a cell.
    bits
        (n, n) the marker's cells, black border included; true is white.

    Returns
    -------
    (4, 2) corners, OpenCV's pixels; ``None`` where cells are smaller than 3 pixels or edges too weak.
    """
    import cv2

    n = len(bits)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float64)
    start, white = _sample_cell_edges(bits)
    homography = cv2.getPerspectiveTransform(square.astype(np.float32), corners_px.astype(np.float32))
    homography = np.asarray(homography, dtype=np.float64)
    grey = image.astype(np.float32)
    for _ in range(DETECTION.edge_iterations):
        at = _project(homography, start)
        ahead = _project(homography, start + 0.5 * white) - _project(homography, start - 0.5 * white)
        along = np.stack([white[:, 1], -white[:, 0]], axis=1)
        tangent = _project(homography, start + 0.05 * along) - _project(homography, start - 0.05 * along)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal *= np.sign(np.sum(normal * ahead, axis=1, keepdims=True))
        cell_px = np.abs(np.sum(normal * ahead, axis=1))
        if np.median(cell_px) < DETECTION.least_cell_px:
            return None
        reach = float(np.clip(0.5 * np.median(cell_px), 1.5, 4.0))
        offset, contrast = _measure_offsets(grey, at, normal, reach)
        good = contrast > max(0.3 * float(np.median(contrast)), DETECTION.least_contrast)
        if good.sum() < 8 * 5:
            return None
        step = _fit_homography(homography, start, normal, offset, good)
        if step is None:
            return None
        homography = homography + step
    return _project(homography, square)


def _project(homography: Array, xy: Array) -> Array:
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ homography.T
    return p[:, :2] / p[:, 2:]


def _sample_cell_edges(bits: BoolArray) -> tuple[Array, Array]:
    """Sample points (m, 2) on the borders between unlike cells, and unit directions (m, 2) towards white."""
    padded = np.pad(bits, 1, constant_values=True).astype(int)
    points, towards = [], []
    for axis in (0, 1):  # 0: neighbours above and below, edges run along x
        step = np.diff(padded, axis=axis)
        for i, j in np.argwhere(step != 0):
            sign = float(step[i, j])
            for t in _ALONG:
                points.append((j - 1 + t, i) if axis == 0 else (j, i - 1 + t))
                towards.append((0.0, sign) if axis == 0 else (sign, 0.0))
    return np.array(points, dtype=np.float64), np.array(towards)


def _measure_offsets(image: Float32Array, at: Array, normal: Array, reach: float) -> tuple[Array, Array]:
    """Distance (m,) from each point along its normal to the centre of the brightening there, and its height (m,)."""
    import cv2

    along = np.arange(-reach, reach + 0.5 * DETECTION.profile_step_px, DETECTION.profile_step_px)
    xy = at[:, None, :] + along[:, None] * normal[:, None, :]
    profile = cv2.remap(
        image,
        xy[..., 0].astype(np.float32),
        xy[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    rise = np.maximum(np.diff(profile, axis=1), 0.0)
    height = rise.sum(axis=1)
    middle = 0.5 * (along[1:] + along[:-1])
    return (rise @ middle) / np.maximum(height, 1e-9), height


def _fit_homography(homography: Array, xy: Array, normal: Array, offset: Array, good: BoolArray) -> Array | None:
    """Change (3, 3) of the homography that takes the edges to where they were seen, up to one common shift."""
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    q = p @ homography.T
    u = q[:, :2] / q[:, 2:]
    rows = np.zeros((len(xy), 9))
    rows[:, :3] = normal[:, :1] * p / q[:, 2:]
    rows[:, 3:6] = normal[:, 1:] * p / q[:, 2:]
    rows[:, 6:8] = -np.sum(normal * u, axis=1, keepdims=True) * p[:, :2] / q[:, 2:]
    rows[:, 8] = 1.0  # the common shift towards white; the homography's last entry stays as it is
    for _ in range(2):
        solution, _, rank, _ = np.linalg.lstsq(rows[good], offset[good], rcond=1e-12)
        if rank < 9:
            return None
        residual = np.abs(offset - rows @ solution)
        good = good & (residual < 4 * max(1.4826 * float(np.median(residual[good])), 0.02))
        if good.sum() < 20:
            return None
    return np.append(solution[:8], 0.0).reshape(3, 3)
