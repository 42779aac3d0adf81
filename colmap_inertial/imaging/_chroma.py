"""Colour images as luma in full and chroma at half the size, for filters: in linear light.

Chroma is R - G and B - G, zero of greys. It has less detail than luma, and what it has of its own follows luma's edges:
at full size it is a line over luma in each small window, as in K. He, J. Sun, X. Tang, "Guided image filtering" (2013).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Float32Array
from colmap_inertial.core.threads import map_in_order
from colmap_inertial.imaging.transfer import linearise


@dataclass(frozen=True, kw_only=True)
class ChromaModel:
    """Settings of the reduction and enlargement of chroma."""

    #: Luma's shares of R - G and B - G beside G: ITU-R BT.709.
    red: float = 0.2126
    blue: float = 0.0722
    #: Side of the windows, px of the half size, in which chroma is a line over luma.
    window_px: int = 5
    #: Where luma's variance (linear light, full scale = 1) in a window is below this, chroma is constant there. A
    #: tenth of it, or ten times as much, changes the PSNR by less than 0.03 dB.
    flat_variance: float = 1e-5
    #: Rows that are worked on at once, which then stay in the processor's cache; even.
    band_rows: int = 64


CHROMA_MODEL = ChromaModel()


def split_colours(image: AnyArray, threads: int) -> tuple[Float32Array, Float32Array]:
    """Luma and chroma of an (H, W, 3) RGB image of codes.

    Returns
    -------
    luma
        (H, W).
    chroma
        (2, ceil(H / 2), ceil(W / 2)) R - G and B - G, each the mean over two by two pixels.
    """
    import cv2

    height, width = image.shape[:2]
    red, blue = CHROMA_MODEL.red, CHROMA_MODEL.blue
    to_luma = np.array([[red, 1 - red - blue, blue]], dtype=np.float32)
    luma = np.empty((height, width), dtype=np.float32)

    def convert(rows: slice) -> None:
        cv2.transform(linearise(image[rows]), to_luma, dst=luma[rows])

    _process_bands(convert, height, threads)
    even = _pad_to_even(image)
    small = cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)
    of_red, of_green, of_blue = cv2.split(linearise(small))
    return luma, np.stack([of_red - of_green, of_blue - of_green])


def join_colours(luma: Float32Array, chroma: Float32Array, threads: int) -> Float32Array:
    """(H, W, 3) RGB from luma and chroma as :func:`split_colours` gives them; detail of chroma follows that of luma."""
    from colmap_inertial._kernels import _light

    result = np.empty((*luma.shape, 3), dtype=np.float32)
    red, blue = CHROMA_MODEL.red, CHROMA_MODEL.blue
    _light.join(luma, _fit_lines(luma, chroma), result, red=red, blue=blue, threads=threads)
    return result


def _fit_lines(luma: Float32Array, chroma: Float32Array) -> Float32Array:
    """(4, h, w) slope and offset of each chroma over luma around each pixel of the half size."""
    import cv2

    def mean(values: AnyArray) -> Float32Array:
        return np.asarray(cv2.blur(values, (CHROMA_MODEL.window_px, CHROMA_MODEL.window_px)))

    small = np.asarray(cv2.resize(_pad_to_even(luma), chroma.shape[:0:-1], interpolation=cv2.INTER_AREA))
    luma_mean = mean(small)
    spread = mean(small * small) - luma_mean * luma_mean + np.float32(CHROMA_MODEL.flat_variance)
    lines = np.empty((4, *small.shape), dtype=np.float32)
    for i, plane in enumerate(chroma):
        slope, offset = lines[2 * i : 2 * i + 2]
        slope[:] = mean((mean(plane * small) - mean(plane) * luma_mean) / spread)
        np.subtract(plane, slope * small, out=offset)
    return lines


def _pad_to_even(values: AnyArray) -> AnyArray:
    """Repeat the last row and column where there is an odd number of them."""
    import cv2

    rows, columns = (n % 2 for n in values.shape[:2])
    padded = cv2.copyMakeBorder(values, 0, rows, 0, columns, cv2.BORDER_REPLICATE) if rows or columns else values
    return np.asarray(padded)


def _process_bands(work: Callable[[slice], None], height: int, threads: int) -> None:
    """Call work on bands of rows, which begin at even rows."""
    bands = [slice(i, min(i + CHROMA_MODEL.band_rows, height)) for i in range(0, height, CHROMA_MODEL.band_rows)]
    if threads == 1:
        for band in bands:
            work(band)
    else:
        for _ in map_in_order(work, bands, workers=threads):
            pass
