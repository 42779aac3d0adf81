"""DeepGyro: motion blur that a gyroscope knows, undone by a network.

After Mustaniemi et al., "Gyroscope-Aided Motion Deblurring with Deep Networks" (2019), with one more input: what
Wiener's filter along the path makes of the image. Where the path is right, the filter's result is sharp already; where
it is not, the network sees both and need not believe it.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.imaging._bilinear import bilinear
from colmap_inertial.imaging._cells import CELL_PX, Cells
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import DeblurOptions, path_wiener
from colmap_inertial.imaging.restoration.network import Network

Code = TypeVar("Code", np.uint8, np.uint16)

#: Trained on blurs of up to 40 px, the network is better than the filter up to some 70 px. Of blurs longer than the
#: second the filter's result stays, of those shorter than the first the network's; between them, blended.
LONGEST_PX = (60.0, 80.0)


def deblur(image: NDArray[Code], path: BlurPath, *, network: Network) -> NDArray[Code]:
    """Undo the motion blur of an image.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), uint8 or uint16, sRGB.
    path
        Along which every pixel smears; of the image's size.
    network
        ``load_network("deepgyro")``.

    Returns
    -------
    A new image of the same shape and type. Pixels whose blur is below half a pixel are the input's, bit for bit, and
    those whose blur is longer than the network knows (`LONGEST_PX`) the filter's.

    Raises
    ------
    ValueError
        For another network, and for what `imaging.path_filters.path_wiener` refuses.
    """
    if network.name != "deepgyro":
        raise ValueError(f"network: deepgyro, not {network.name}")
    filtered = path_wiener(image, path, DeblurOptions(threads=network.threads))
    chords = path.field()
    known = _share_of_network(chords)
    if known.max() == 0:
        return filtered
    restored = network.restore(image, filtered, path)
    _blend(restored, filtered, known)
    # where there is no blur to speak of, as the filter does
    _blend(restored, image, Cells.of(chords).fade)
    return restored


def _share_of_network(blur: BlurField) -> Float32Array:
    """(Ny + 1, Nx + 1) share of the network's result at the corners of the cells, by the length of blur."""
    rows, columns = (np.minimum(np.arange(0, n + CELL_PX, CELL_PX), n - 1) for n in (blur.height, blur.width))
    x, y = np.moveaxis(blur.at(rows, columns), -1, 0)
    low, high = LONGEST_PX
    return np.asarray(np.clip((high - np.hypot(x, y)) / (high - low), 0, 1), dtype=np.float32)


def _blend(restored: NDArray[Code], other: NDArray[Code], share: Float32Array) -> None:
    """Put another image's pixels for what is not the share of the restored one, given at the corners of cells."""
    if share.min() == 1:
        return
    columns = np.arange(other.shape[1]) / CELL_PX
    for i in range(len(share) - 1):
        if share[i : i + 2].min() == 1:
            continue
        band = slice(CELL_PX * i, min(CELL_PX * (i + 1), len(other)))
        part = bilinear(share, np.arange(band.start, band.stop) / CELL_PX, columns)
        if other.ndim == 3:
            part = part[..., None]
        own = other[band].astype(np.float32)
        restored[band] = np.rint(own + part * (restored[band] - own)).astype(other.dtype)
