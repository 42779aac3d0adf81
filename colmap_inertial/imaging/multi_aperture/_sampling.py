"""Images onto the canvas, and views by disparity."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, BoolArray, Float32Array, UInt8Array
from colmap_inertial.imaging.multi_aperture._geometry import Rectified


def convert_to_codes(image: AnyArray) -> UInt8Array:
    """(H, W) codes of 8 bit, brighter for brighter; 16 bit go over the square root of what is in use."""
    if image.dtype == np.uint8:
        return image
    top = max(1.0, float(np.percentile(image, 99.9)))
    return np.asarray(np.clip(np.rint(255 * np.sqrt(image / np.float32(top))), 0, 255), dtype=np.uint8)


def warp_to_canvas(codes: UInt8Array, canvas: Rectified, index: int) -> UInt8Array:
    """An aperture's codes on the canvas; beyond the image its border goes on."""
    import cv2

    at = canvas.image_from_canvas[index]
    if at is None:
        return np.ascontiguousarray(codes)
    return np.asarray(cv2.remap(codes, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def shrunk(codes: UInt8Array, by: int) -> UInt8Array:
    """Means of squares of ``by`` pixels, for ``Rectified.shrunk``."""
    import cv2

    if by == 1:
        return codes
    height, width = (n // by for n in codes.shape)
    return np.asarray(cv2.resize(codes[: height * by, : width * by], (width, height), interpolation=cv2.INTER_AREA))


def places(
    canvas: Rectified, index: int, disparity_px: Float32Array, x: Float32Array, y: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Positions of canvas points (x, y) with these disparities on the canvas of another aperture."""
    r = canvas.ratios[index - 1]
    cx, cy = (np.float32(c) for c in canvas.centre_px)
    size = 1 - disparity_px * np.float32(r[2])
    u = (x - cx - disparity_px * np.float32(r[0])) / size + cx
    v = (y - cy - disparity_px * np.float32(r[1])) / size + cy
    return np.asarray(u, dtype=np.float32), np.asarray(v, dtype=np.float32)


def warp_view(
    view: AnyArray, canvas: Rectified, index: int, disparity_px: Float32Array, every: int = 1
) -> tuple[Float32Array, BoolArray]:
    """Warp another aperture's view to the canvas of the reference, with a mask of the pixels that it shows.

    Parameters
    ----------
    view
        (H, W) of aperture ``index`` on the canvas.
    every
        Only every so many rows and columns of the canvas.
    """
    import cv2

    x, y = np.meshgrid(*(np.arange(0, n, every, dtype=np.float32) for n in (canvas.width, canvas.height)))
    u, v = places(canvas, index, disparity_px[::every, ::every], x, y)
    left, right, top, bottom = canvas.covered[index]
    inside = (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    warped = cv2.remap(view.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped), np.asarray(inside)
