"""Taps of the one-dimensional Wiener filter against a linear blur."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, IndexArray, Int32Array

#: The table of taps holds one filter for every quarter of a pixel of blur; between them it is interpolated.
STEPS_PER_PX = 4
#: The filter reaches this many blur lengths to either side. With one length, 20 px of blur cost half the time and lose
#: about 1 dB; three gain less than 0.1 dB.
REACH = 2.0


#: Standard deviation of the smoothing for 10 px of blur at 1 % of noise; it grows with the root of either, up to the
#: second. PSNR is best there, and so is the accuracy of small reconstructions; correct matches would like 1.2.
SMOOTHING_PX, LARGEST_SMOOTHING_PX = 0.7, 1.5


def smoothing_px(sigma: float, extent_px: float) -> float:
    """Standard deviation of the Gaussian that smooths an image, by its noise and its typical blur.

    The filter works along a line, and nothing in it holds back the noise across; the longer the blur, the less of the
    finest detail comes back.
    """
    return float(min(SMOOTHING_PX * (sigma / 0.01 * extent_px / 10) ** 0.5, LARGEST_SMOOTHING_PX))


def gaussian_weights(sigma_px: float) -> Float32Array:
    """(R + 1,) weights of a Gaussian at the distances 0, 1, ... px, up to three standard deviations."""
    at = np.arange(int(np.ceil(3 * sigma_px)) + 1)
    weights = np.exp(-0.5 * (at / max(sigma_px, 1e-3)) ** 2)
    return np.asarray(weights / (2 * weights.sum() - weights[0]), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Prior of the sharp image, relative to the noise: ``1 / (eps + alpha 4 sin^2(pi f))``."""

    alpha: float
    eps: float

    @classmethod
    def for_noise(cls, sigma: float) -> Prior:
        """The prior that serves images with noise of this standard deviation, full scale = 1 in linear light."""
        alpha = min(max(300.0 * sigma**2, 0.01), 0.1)
        return cls(alpha=alpha, eps=max(alpha / 10, 0.003))


def blur_spectrum(extent_px: float, frequency: Array) -> Array:
    """Transfer function of a linear blur of ``extent_px``; frequency in cycles per pixel."""
    return np.sinc(extent_px * frequency)


@lru_cache(maxsize=4096)
def optimal_taps(extent_px: float, prior: Prior, reach: float = REACH) -> Array:
    """Weights of the best filter that reaches ``ceil(reach extent_px) + 1`` pixels to either side.

    Parameters
    ----------
    extent_px
        Length of the blur along the major axis.
    prior
        Of the sharp image.
    reach
        In blur lengths.

    Returns
    -------
    (T + 1,) weights at the distances 0, 1, ... T; the filter is symmetric and sums to one.

    Notes
    -----
    The minimum mean square error under the prior, restricted to these taps: the normal equations
    ``Toeplitz(r + delta) w = p`` with ``r`` the autocorrelation of the blurred prior, ``p`` its correlation with the
    sharp one, and white noise of variance one. Cutting off the unlimited filter instead leaves 10 dB on the table.
    """
    from scipy.linalg import solve_toeplitz

    length = int(np.ceil(reach * extent_px)) + 1
    samples = max(1024, 1 << int(np.ceil(np.log2(8 * length))))
    frequency = np.arange(samples // 2 + 1) / samples
    power = 1 / (prior.eps + prior.alpha * 4 * np.sin(np.pi * frequency) ** 2)
    transfer = blur_spectrum(extent_px, frequency)
    autocorrelation = np.fft.irfft(power * transfer**2, samples)[: 2 * length + 1]
    autocorrelation[0] += 1
    correlation = np.fft.irfft(power * transfer, samples)[: length + 1]
    weights = solve_toeplitz(autocorrelation, np.concatenate([correlation[:0:-1], correlation]), check_finite=False)
    half = np.asarray(weights[length:] / weights.sum())
    half.setflags(write=False)
    return half


@dataclass(frozen=True, eq=False, kw_only=True)
class TapTable:
    """Filters for a range of blur lengths.

    Attributes
    ----------
    first
        Row ``i`` is for a blur of ``(first + i) / STEPS_PER_PX`` px.
    weights
        (N, T + 1) float32, zero beyond each filter's reach.
    reach
        (N,) int32 last distance with a weight.
    smoothing
        (R + 1,) float32 weights at the distances 0, 1, ... R px, by which rows and columns are smoothed beforehand.
    """

    first: int
    weights: Float32Array
    reach: Int32Array
    smoothing: Float32Array = field(default_factory=lambda: np.ones(1, dtype=np.float32))

    @classmethod
    def covering(cls, shortest_px: float, longest_px: float, prior: Prior, smoothing_px: float = 0.0) -> TapTable:
        """The table for blurs from ``shortest_px`` to ``longest_px``."""
        first, last = int(np.floor(shortest_px * STEPS_PER_PX)), int(np.floor(longest_px * STEPS_PER_PX)) + 1
        filters = [optimal_taps(i / STEPS_PER_PX, prior) for i in range(first, last + 1)]
        weights = np.zeros((len(filters), len(filters[-1])), dtype=np.float32)
        for row, taps in zip(weights, filters, strict=True):
            row[: len(taps)] = taps
        reach = np.array([len(taps) - 1 for taps in filters], dtype=np.int32)
        return cls(first=first, weights=weights, reach=reach, smoothing=gaussian_weights(smoothing_px))

    def at(self, extent_px: Array) -> tuple[IndexArray, Array]:
        """Row below each blur length and the fraction of the way to the next row."""
        position = np.asarray(extent_px, dtype=np.float64) * STEPS_PER_PX - self.first
        row = np.clip(np.floor(position), 0, len(self.weights) - 2).astype(np.intp)
        return row, position - row
