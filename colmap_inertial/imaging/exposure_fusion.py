"""Exposure fusion: of pictures that were exposed differently, each part from where it shows most.

After T. Mertens, J. Kautz, F. Van Reeth, Exposure Fusion (Pacific Graphics 2007), as OpenCV has it: contrast,
saturation and a medium brightness give weights, by which the pictures are blended band by band.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Light = NDArray[np.float32]


def fuse_mertens(pictures: Sequence[Light]) -> Light:
    """Blend pictures of the same view.

    Parameters
    ----------
    pictures
        Two or more, all (H, W) or (H, W, 3) float32, sRGB 0 to 1.

    Returns
    -------
    Likewise; no light is guessed, so a lamp that clips in one picture looks as it does in the other.
    """
    import cv2

    if len(pictures) < 2 or any(picture.shape != pictures[0].shape for picture in pictures):
        raise ValueError(f"two or more pictures of one shape, not {[picture.shape for picture in pictures]}")
    if pictures[0].ndim not in (2, 3) or (pictures[0].ndim == 3 and pictures[0].shape[2] != 3):
        raise ValueError(f"pictures: (H, W) or (H, W, 3), not {pictures[0].shape}")
    # OpenCV divides by 255, whatever the type; of one channel it takes no saturation
    scaled = [np.ascontiguousarray(255 * picture, dtype=np.float32) for picture in pictures]
    merge = cv2.createMergeMertens(1.0, 1.0, 1.0)
    return np.asarray(np.clip(merge.process(scaled), 0, 1), dtype=np.float32)


__all__ = ["fuse_mertens"]
