"""Exposure fusion: of images that were exposed differently, each part from where it shows most.

After T. Mertens, J. Kautz, F. Van Reeth, Exposure Fusion (Pacific Graphics 2007), as OpenCV has it: contrast,
saturation and a medium brightness give weights, by which the images are blended band by band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import BoolArray, Float32Array
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear


@dataclass(frozen=True, kw_only=True)
class MertensLimits:
    """Limits of exposure fusion."""

    #: Standard deviation by which the border of what is clipped is softened, px.
    feather_px: float = 3.0


_LIMITS = MertensLimits()


def fuse_mertens(images: Sequence[Float32Array]) -> Float32Array:
    """Blend images of the same view.

    Parameters
    ----------
    images
        Two or more, all (H, W) or (H, W, 3) float32, sRGB 0 to 1.

    Returns
    -------
    Likewise; no light is guessed, so a lamp that clips in one image looks as it does in the other.
    """
    import cv2

    if len(images) < 2 or any(image.shape != images[0].shape for image in images):
        raise ValueError(f"two or more images of one shape, not {[image.shape for image in images]}")
    if images[0].ndim not in (2, 3) or (images[0].ndim == 3 and images[0].shape[2] != 3):
        raise ValueError(f"images: (H, W) or (H, W, 3), not {images[0].shape}")
    # OpenCV divides by 255, whatever the type; of one channel it takes no saturation
    scaled = [np.ascontiguousarray(255 * image, dtype=np.float32) for image in images]
    merge = cv2.createMergeMertens(1.0, 1.0, 1.0)
    return np.asarray(np.clip(merge.process(scaled), 0, 1), dtype=np.float32)


def darken_fused(fused: Float32Array, dark: Float32Array, clipped: BoolArray, gain: float) -> Float32Array:
    """Short exposure without its noise: the fused image, as dark; the short one itself where the long one clipped.

    Parameters
    ----------
    fused
        (H, W) or (H, W, 3) float32, sRGB 0 to 1, as bright as the long exposure.
    dark
        Likewise: the short exposure as dark as it is, with the long one's colours.
    clipped
        (H, W) where the long exposure may have clipped.
    gain
        By what the short one's light is multiplied to be as bright as the long one's.
    """
    import cv2

    reach = 2 * round(3 * _LIMITS.feather_px) + 1
    grown = cv2.dilate(clipped.astype(np.float32), np.ones((reach, reach), np.uint8))
    share = np.asarray(cv2.GaussianBlur(grown, (0, 0), _LIMITS.feather_px))
    if fused.ndim == 3:
        share = share[..., None]
    light = srgb_from_linear(linear_from_srgb(np.clip(fused, 0, 1)) / gain)
    return np.asarray(share * dark + (1 - share) * light, dtype=np.float32)
