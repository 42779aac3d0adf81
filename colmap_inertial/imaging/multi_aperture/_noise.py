"""The noise of an image, and what is done about it before pixels are compared."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array, UInt8Array

_BLOCK_PX = 16
#: Blocks of this share are even enough to show nothing but noise.
_EVEN = 0.1
#: Noise of so many codes is smoothed over ``_WIDTH_PX`` (standard deviation of a Gaussian), more noise with its square
#: root; below half a pixel nothing is.
_NOISE_CODES, _WIDTH_PX, _LEAST_PX = 1.3, 0.7, 0.5
#: Texture of so many times the noise, in windows of 5 x 5 pixels, stands out of it.
_STANDS_OUT = 1.5
#: In what was smoothed, differences below so many standard deviations do not tell which of two pixels is brighter.
_TELLING = 1.5


def noise_of(plane: AnyArray) -> float:
    """Standard deviation of the noise of an image, in its own codes.

    By what is left of it after the Laplacian's square (Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996), in
    the blocks that have least of it, without black and clipped ones. 0 where there are none.
    """
    import cv2

    top = float(np.iinfo(plane.dtype).max) if plane.dtype.kind == "u" else 255.0
    image = plane.astype(np.float32)
    height, width = (n // _BLOCK_PX for n in image.shape)
    if height == 0 or width == 0:
        return 0.0
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    residual = np.abs(cv2.filter2D(image, -1, kernel))

    def blocks(values: Float32Array) -> Array:
        cut = values[: height * _BLOCK_PX, : width * _BLOCK_PX]
        return cut.reshape(height, _BLOCK_PX, width, _BLOCK_PX).mean(axis=(1, 3), dtype=np.float64)

    mean = blocks(image)
    level = blocks(residual)[(mean > 0.03 * top) & (mean < 0.97 * top)]
    return float(np.quantile(level, _EVEN) * np.sqrt(np.pi / 2) / 6) if level.size else 0.0


def smoothing(codes: UInt8Array, noise_codes: float) -> tuple[float, int]:
    """Over how many pixels (standard deviation) to smooth before comparing, and the least difference that tells.

    Nothing is smoothed where at least half of the image has texture that stands out of the noise: there it would cost
    more detail than it gains.
    """
    import cv2

    width_px = _WIDTH_PX * float(np.sqrt(noise_codes / _NOISE_CODES))
    if width_px < _LEAST_PX:
        return 0.0, round(noise_codes)
    image = codes.astype(np.float32)
    mean = cv2.blur(image, (5, 5))
    variance = cv2.blur(image * image, (5, 5)) - mean * mean
    if float(np.median(variance)) * 25 / 24 - noise_codes**2 > (_STANDS_OUT * noise_codes) ** 2:
        return 0.0, round(noise_codes)
    left = noise_codes / (2 * np.sqrt(np.pi) * width_px)
    return width_px, round(_TELLING * np.sqrt(2) * left)
