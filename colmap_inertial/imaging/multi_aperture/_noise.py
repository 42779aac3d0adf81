"""The noise of an image, and what is done about it before pixels are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array, UInt8Array


@dataclass(frozen=True, kw_only=True)
class NoiseLimits:
    """Limits of the measurement and smoothing of noise."""

    #: Side of the blocks in which noise is measured.
    block_px: int = 16
    #: Blocks of this share are even enough to show nothing but noise.
    even_share: float = 0.1
    #: Noise of so many codes
    noise_codes: float = 1.3
    #: is smoothed over this standard deviation of a Gaussian, more noise with its square root;
    width_px: float = 0.7
    #: below this, nothing is.
    least_px: float = 0.5
    #: Texture of so many times the noise, in windows of 5 x 5 pixels, stands out of it.
    stands_out: float = 1.5
    #: In what was smoothed, differences below so many standard deviations do not tell which of two pixels is brighter.
    telling_sigmas: float = 1.5


_LIMITS = NoiseLimits()


def measure_noise(plane: AnyArray) -> float:
    """Standard deviation of the noise of an image, in its own codes.

    By what is left of it after the Laplacian's square (Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996), in
    the blocks that have least of it, without black and clipped ones. 0 where there are none.
    """
    import cv2

    top = float(np.iinfo(plane.dtype).max) if plane.dtype.kind == "u" else 255.0
    image = plane.astype(np.float32)
    height, width = (n // _LIMITS.block_px for n in image.shape)
    if height == 0 or width == 0:
        return 0.0
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    residual = np.abs(cv2.filter2D(image, -1, kernel))

    def blocks(values: Float32Array) -> Array:
        cut = values[: height * _LIMITS.block_px, : width * _LIMITS.block_px]
        return cut.reshape(height, _LIMITS.block_px, width, _LIMITS.block_px).mean(axis=(1, 3), dtype=np.float64)

    mean = blocks(image)
    level = blocks(residual)[(mean > 0.03 * top) & (mean < 0.97 * top)]
    return float(np.quantile(level, _LIMITS.even_share) * np.sqrt(np.pi / 2) / 6) if level.size else 0.0


def smoothing(codes: UInt8Array, noise_codes: float) -> tuple[float, int]:
    """Over how many pixels (standard deviation) to smooth before comparing, and the least difference that tells.

    Nothing is smoothed where at least half of the image has texture that stands out of the noise: there it would cost
    more detail than it gains.
    """
    import cv2

    width_px = _LIMITS.width_px * float(np.sqrt(noise_codes / _LIMITS.noise_codes))
    if width_px < _LIMITS.least_px:
        return 0.0, round(noise_codes)
    image = codes.astype(np.float32)
    mean = cv2.blur(image, (5, 5))
    variance = cv2.blur(image * image, (5, 5)) - mean * mean
    if float(np.median(variance)) * 25 / 24 - noise_codes**2 > (_LIMITS.stands_out * noise_codes) ** 2:
        return 0.0, round(noise_codes)
    remaining = noise_codes / (2 * np.sqrt(np.pi) * width_px)
    return width_px, round(_LIMITS.telling_sigmas * np.sqrt(2) * remaining)
