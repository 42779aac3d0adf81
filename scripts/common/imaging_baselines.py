"""The usual ways to undo motion blur, for the imaging benchmark.

Each takes a grey 8-bit frame and its blur field, works in linear light as ours does, and treats the frame in blocks
with the blur of their centre. Making point spread functions and kernels is a function of its own, so that it need not
be timed.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear

BLOCK_PX = 64
#: Blocks of the iterative method, and what surrounds a block when it is transformed.
LARGE_BLOCK_PX, AROUND_PX = 192, 32
#: Best of 0.01, 0.03, 0.1 for both Wiener filters, by PSNR at 10 and 20 px and 1 % noise; so is the window.
NOISE_TO_SIGNAL = 0.03
ITERATIONS = 10
#: Vectors are rounded to this, so that kernels can be kept.
STEP_PX = 0.25
#: A block is kept as it was where it is steeper than blur allows: see `spatial_wiener`.
STEEPEST = 2.0

_TO_CODE = np.round(255 * srgb_from_linear(np.arange(16385) / 16384)).astype(np.uint8)


def light_of(image: UInt8Array) -> Float32Array:
    """Linear light of 8-bit codes."""
    return np.asarray(cv2.LUT(image, decode_table(np.dtype(np.uint8))))


def encoded(light: Float32Array) -> UInt8Array:
    """8-bit codes, through a table of 14 bits."""
    index = cv2.multiply(np.clip(light, 0, 1), 16384.0).astype(np.uint16)
    return np.asarray(_TO_CODE[index])


def line(vector_px: tuple[float, float]) -> Float32Array:
    """The point spread function on whole pixels, of odd size."""
    radius = int(np.ceil(np.hypot(*vector_px) / 2)) + 1
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    along = (np.linspace(-0.5, 0.5, 400)[:, None] * vector_px).T[:, :, None, None]
    spread = (np.clip(1 - np.abs(x - along[0]), 0, 1) * np.clip(1 - np.abs(y - along[1]), 0, 1)).sum(axis=0)
    return np.asarray(spread / spread.sum(), dtype=np.float32)


@lru_cache(maxsize=4096)
def wiener_kernel(vector_px: tuple[float, float]) -> Float32Array:
    """The 2-D Wiener filter of the published schemes, cut by a window to three times the point spread function."""
    spread = line(vector_px)
    n, reach = scipy.fft.next_fast_len(8 * spread.shape[0]) | 1, 3 * spread.shape[0] // 2
    spectrum = np.fft.fft2(np.fft.ifftshift(np.pad(spread, (n - spread.shape[0]) // 2)))
    inverse = np.fft.fftshift(np.fft.ifft2(np.conj(spectrum) / (np.abs(spectrum) ** 2 + NOISE_TO_SIGNAL)).real)
    kernel = inverse[n // 2 - reach : n // 2 + reach + 1, n // 2 - reach : n // 2 + reach + 1]
    window = np.hanning(2 * reach + 3)[1:-1]
    kernel = kernel * window * window[:, None]
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def block_vectors(blur: BlurField, block_px: int) -> list[tuple[int, int, tuple[float, float]]]:
    """Top, left and blur of every block."""
    found = []
    for top in range(0, blur.height, block_px):
        for left in range(0, blur.width, block_px):
            row = min(round((top + block_px / 2) / blur.step_px), blur.vector_px.shape[0] - 1)
            column = min(round((left + block_px / 2) / blur.step_px), blur.vector_px.shape[1] - 1)
            x, y = np.round(blur.vector_px[row, column] / STEP_PX) * STEP_PX
            found.append((top, left, (float(x), float(y))))
    return found


def spatial_wiener(image: UInt8Array, blur: BlurField) -> UInt8Array:
    """Blocks filtered by 2-D kernels in space, with a validation by gradients.

    A block keeps its pixels where its brightness, smoothed against noise, changes from pixel to pixel along the blur by
    more than twice its range over the blur's length: blur of that length would have made it flatter.
    """
    blocks = block_vectors(blur, BLOCK_PX)
    kernels = [wiener_kernel(vector) for _, _, vector in blocks]
    reach = max(kernel.shape[0] // 2 for kernel in kernels)
    light = light_of(image)
    smooth = cv2.GaussianBlur(light, (0, 0), 1.0)
    slope_x, slope_y = cv2.Scharr(smooth, -1, 1, 0, scale=1 / 32), cv2.Scharr(smooth, -1, 0, 1, scale=1 / 32)
    padded = cv2.copyMakeBorder(light, reach, reach, reach, reach, cv2.BORDER_REFLECT_101)
    result = light.copy()
    for (top, left, (x, y)), kernel in zip(blocks, kernels, strict=True):
        here = (slice(top, top + BLOCK_PX), slice(left, left + BLOCK_PX))
        steepest = np.abs(x * slope_x[here] + y * slope_y[here]).max()  # times the length of the blur
        span = smooth[here].max() - smooth[here].min()
        if steepest <= STEEPEST * span and np.hypot(x, y) >= 1:
            part = padded[top : top + BLOCK_PX + 2 * reach, left : left + BLOCK_PX + 2 * reach]
            filtered = cv2.filter2D(part, -1, kernel, borderType=cv2.BORDER_ISOLATED)
            result[here] = filtered[reach:-reach, reach:-reach]
    return encoded(result)


@lru_cache(maxsize=4096)
def transfer(vector_px: tuple[float, float], size: int) -> NDArray[np.complex64]:
    """Spectrum of the point spread function, for `scipy.fft.rfft2` of this size."""
    spread = line(vector_px)
    whole = np.zeros((size, size), dtype=np.float32)
    whole[: spread.shape[0], : spread.shape[1]] = spread
    return np.asarray(scipy.fft.rfft2(np.roll(whole, [-(s // 2) for s in spread.shape], axis=(0, 1))))


def fourier_wiener(image: UInt8Array, blur: BlurField) -> UInt8Array:
    """Blocks filtered in the frequency domain, each with its surroundings."""
    light = light_of(image)
    size = BLOCK_PX + 2 * AROUND_PX
    padded = _surrounded(light, BLOCK_PX)
    result = np.empty_like(padded)
    for top, left, vector in block_vectors(blur, BLOCK_PX):
        spread = transfer(vector, size)
        spectrum = scipy.fft.rfft2(padded[top : top + size, left : left + size])
        spectrum *= np.conj(spread) / (np.abs(spread) ** 2 + NOISE_TO_SIGNAL)
        _put(result, top, left, scipy.fft.irfft2(spectrum, s=(size, size)), BLOCK_PX)
    return encoded(result[: light.shape[0], : light.shape[1]])


def richardson_lucy_blocks(image: UInt8Array, blur: BlurField) -> UInt8Array:
    """Richardson-Lucy with a point spread function for each block, from a flat start."""
    light = light_of(image)
    size = LARGE_BLOCK_PX + 2 * AROUND_PX
    padded = _surrounded(light, LARGE_BLOCK_PX)
    result = np.empty_like(padded)
    for top, left, vector in block_vectors(blur, LARGE_BLOCK_PX):
        spread = transfer(vector, size)
        seen = padded[top : top + size, left : left + size]
        estimate = np.full_like(seen, 0.5)
        for _ in range(ITERATIONS):
            again = scipy.fft.irfft2(scipy.fft.rfft2(estimate) * spread, s=(size, size))
            ratio = scipy.fft.rfft2(seen / np.maximum(again, 1e-6))
            estimate *= np.maximum(scipy.fft.irfft2(ratio * np.conj(spread), s=(size, size)), 0)
        _put(result, top, left, estimate, LARGE_BLOCK_PX)
    return encoded(result[: light.shape[0], : light.shape[1]])


def richardson_lucy(image: UInt8Array, spread: Float32Array) -> UInt8Array:
    """The whole frame with one point spread function, operation for operation as scikit-image has it."""
    light = light_of(image)
    estimate = np.full_like(light, 0.5)
    mirrored = spread[::-1, ::-1]
    for _ in range(ITERATIONS):
        ratio = light / (fftconvolve(estimate, spread, mode="same") + np.float32(1e-12))
        estimate *= fftconvolve(ratio, mirrored, mode="same")
    return encoded(estimate)


def _surrounded(light: Float32Array, block_px: int) -> Float32Array:
    """The frame, filled up to whole blocks, with what surrounds them."""
    height, width = light.shape
    below, right = -height % block_px + AROUND_PX, -width % block_px + AROUND_PX
    return np.asarray(cv2.copyMakeBorder(light, AROUND_PX, below, AROUND_PX, right, cv2.BORDER_REFLECT_101))


def _put(result: Float32Array, top: int, left: int, window: Array | Float32Array, block_px: int) -> None:
    inside = slice(AROUND_PX, AROUND_PX + block_px)
    part = window[inside, inside]
    target = result[top : top + block_px, left : left + block_px]
    target[:] = part[: target.shape[0], : target.shape[1]]
