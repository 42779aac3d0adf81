"""Points followed from one reduced image to another."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, BoolArray, Float32Array, UInt8Array


def convert_to_grey(image: AnyArray) -> AnyArray:
    """(H, W) brightness of an RGB image, in its own type; a grey one as it is."""
    import cv2

    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def reduce_image(image: AnyArray, long_side_px: int) -> AnyArray:
    """An image, shrunk by area where its longer side is longer than this."""
    import cv2

    scale = long_side_px / max(image.shape[:2])
    if scale >= 1:
        return image
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def track_points(
    before: UInt8Array, now: UInt8Array, points: Float32Array, *, window_px: int, round_trip_px: float
) -> tuple[Float32Array, BoolArray]:
    """Follow points by pyramidal Lucas-Kanade to another image and back.

    Parameters
    ----------
    before, now
        (H, W) images of one size.
    points
        (N, 2) in ``before``.
    window_px
        Side of the window that is compared.
    round_trip_px
        How far from where they began points may come back.

    Returns
    -------
    (N, 2) points in ``now``, and (N,) which of them came back.
    """
    import cv2

    start, size = points.reshape(-1, 1, 2), (window_px, window_px)
    there, ok_there, _ = cv2.calcOpticalFlowPyrLK(before, now, start, None, winSize=size, maxLevel=4)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, winSize=size, maxLevel=4)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    tracked = (ok_there.ravel() == 1) & (ok_back.ravel() == 1) & (off < round_trip_px)
    return np.asarray(there.reshape(-1, 2), dtype=np.float32), tracked
