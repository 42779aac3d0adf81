"""DeepGyro: motion blur that a gyroscope knows, undone by a network.

After Mustaniemi et al., "Gyroscope-Aided Motion Deblurring with Deep Networks" (2019), with one more input: what the
directional Wiener filter makes of the picture. Where the blur field is right, the filter's result is sharp already;
where it is not, the network sees both and need not believe it.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.imaging import wiener
from colmap_inertial.imaging._bilinear import bilinear
from colmap_inertial.imaging._cells import CELL_PX, Cells
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.restoration.network import Network

Code = TypeVar("Code", np.uint8, np.uint16)


def deblur(image: NDArray[Code], blur: BlurField, *, network: Network) -> NDArray[Code]:
    """Undo the motion blur of an image.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), uint8 or uint16, sRGB.
    blur
        Along which line every pixel smears; of the image's size.
    network
        ``load_network("deepgyro")``.

    Returns
    -------
    A new image of the same shape and type. Pixels whose blur is below half a pixel are the input's, bit for bit.

    Raises
    ------
    ValueError
        For another network, and for what `imaging.wiener.deblur` refuses.
    """
    if network.name != "deepgyro":
        raise ValueError(f"network: deepgyro, not {network.name}")
    filtered = wiener.deblur(image, blur, wiener.DeblurOptions(threads=network.threads))
    restored = network.restore(image, filtered, blur)
    _fade_in(restored, image, blur)
    return restored


def _fade_in(restored: NDArray[Code], image: NDArray[Code], blur: BlurField) -> None:
    """Put the image's pixels where there is no blur to speak of, as the Wiener filter does."""
    fade = Cells.of(blur).fade
    if fade.min() == 1:
        return
    columns = np.arange(image.shape[1]) / CELL_PX
    for i in range(len(fade) - 1):
        if fade[i : i + 2].min() == 1:
            continue
        band = slice(CELL_PX * i, min(CELL_PX * (i + 1), len(image)))
        share = bilinear(fade, np.arange(band.start, band.stop) / CELL_PX, columns)
        if image.ndim == 3:
            share = share[..., None]
        original = image[band].astype(np.float32)
        restored[band] = np.rint(original + share * (restored[band] - original)).astype(image.dtype)
