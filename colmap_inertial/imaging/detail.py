"""Whether an image shows anything at all."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import UInt8Array, UInt16Array
from colmap_inertial.imaging.tracking import convert_to_grey

#: Images are looked at in this size, which averages noise, in blocks of so many pixels; of these, so many in a
#: hundred have less detail than what counts.
_LONG_SIDE_PX, _BLOCK_PX, _PERCENT = 320, 20, 98.0
#: Brightness range of a block, of full scale, below which there is nothing to match and nothing to deblur: a wall out
#: of focus, a lens that was covered, a frame that was lost.
LEAST_DETAIL = 0.03


def measure_detail(image: UInt8Array | UInt16Array) -> float:
    """Brightness range of the most detailed blocks of an image, of full scale; 0 of a black one.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3).
    """
    import cv2

    grey = convert_to_grey(image)
    shrink = min(1.0, _LONG_SIDE_PX / max(grey.shape))
    size = tuple(max(1, round(shrink * side)) for side in grey.shape[::-1])
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.iinfo(grey.dtype).max
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    rows, columns = (max(1, side // _BLOCK_PX) for side in small.shape)
    ranges = [
        np.ptp(block)
        for strip in np.array_split(small, rows, axis=0)
        for block in np.array_split(strip, columns, axis=1)
    ]
    return float(np.percentile(ranges, _PERCENT))


def is_blank(image: UInt8Array | UInt16Array) -> bool:
    """Whether an image is black or without any feature."""
    return measure_detail(image) < LEAST_DETAIL
