"""LSD2: one clean and sharp image of a short, noisy exposure and a long, blurred one, made by a network.

After Mustaniemi et al., "LSD2 - Joint Denoising and Deblurring of Short and Long Exposure Images with Convolutional
Neural Networks" (2018).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import AnyArray
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.restoration.network import Network

Sample = TypeVar("Sample", np.uint8, np.uint16, np.float32)


def fuse(short: NDArray[Sample], long: AnyArray, *, blur: BlurField | None = None, network: Network) -> NDArray[Sample]:
    """Make one image of two exposures.

    Parameters
    ----------
    short
        (H, W) or (H, W, 3) sRGB, the short exposure, brought to the brightness of the long one in linear light: codes
        of uint8 or uint16, or float32 from 0 to 1, which keeps what a dark image has between two codes.
    long
        Likewise, of the same shape: the long exposure, every pixel where the short one has it.
    blur
        Of the long exposure, at the pixels of the short one; ``None`` where there is no gyroscope.
    network
        ``load_network("lsd2")``.

    Returns
    -------
    A new image of the shape and type of ``short``, with its geometry, and the brightness of ``long``.

    Raises
    ------
    ValueError
        For another network, and for images that do not go together.
    """
    if network.name != "lsd2":
        raise ValueError(f"network: lsd2, not {network.name}")
    return network.restore(short, long, blur)
