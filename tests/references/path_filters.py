"""The filters along paths of blur in numpy: slow, plain, and the truth that the compiled ones are tested against."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, ComplexArray, Float32Array, Int32Array
from colmap_inertial.imaging._tiles import Tiling
from colmap_inertial.imaging.path_filters import (
    FILTER_MODEL,
    Noise,
)


def filter_reference(
    light: Float32Array,
    tiling: Tiling,
    paths: Float32Array,
    spreads: Float32Array,
    noise: Noise,
    splitting: tuple[float, ...],
) -> Array:
    """(H, W) linear light without blur, each tile by itself."""
    rows, columns = tiling.count
    shares = [
        np.outer(shares_of(tiling, i, rows), shares_of(tiling, j, columns)) for i in range(rows) for j in range(columns)
    ]
    total = np.zeros(tuple(map(len, sources_of(tiling))))
    for (tile, mean, path, frequencies, window, place), spread, share in zip(
        tiles(light, tiling, paths), spreads.reshape(-1, 3), shares, strict=True
    ):
        variance = max(noise.dark + noise.by_light * mean, FILTER_MODEL.least_noise**2)
        total[place] += share * (filter_tile(tile, path, spread, frequencies, window, variance, splitting) + mean)
    begin = tiling.before
    return total[begin : begin + tiling.height, begin : begin + tiling.width]


def noise_reference(light: Float32Array, tiling: Tiling, paths: Float32Array) -> Array:
    """(N, 3) mean light of each tile, the variance of its noise, and how many frequencies show it."""
    found = []
    for tile, mean, path, frequencies, window, _ in tiles(light, tiling, paths):
        shows = frequencies.square > FILTER_MODEL.noise_above_per_px**2
        shows &= np.abs(transfer_of(path, frequencies)) < FILTER_MODEL.noise_share
        power = np.abs(np.fft.rfft2(tile)) ** 2 / np.sum(window**2)
        count = (frequencies.times * shows).sum()
        found.append((mean, (frequencies.times * power)[shows].sum() / max(count, 1), count))
    return np.array(found)


def shares_of(tiling: Tiling, place: int, count: int) -> Float32Array:
    """(side,) shares of one of several tiles in a row: beyond both ends there is nothing to blend with."""
    out = tiling.window_out()
    if place == 0:
        out[: tiling.side // 2] = 1
    if place == count - 1:
        out[tiling.side // 2 :] = 1
    return out


def sources_of(tiling: Tiling) -> tuple[Int32Array, Int32Array]:
    """Rows and columns of the image that those of the tiled area show: mirrored about its border pixels."""
    out = []
    for n, size in zip(tiling.count, (tiling.height, tiling.width), strict=True):
        at = np.abs(np.arange((n - 1) * tiling.hop + tiling.side) - tiling.before)
        period = max(1, 2 * (size - 1))
        at = at % period
        out.append(np.minimum(at, period - at).astype(np.int32) if size > 1 else np.zeros(len(at), np.int32))
    return out[0], out[1]


def tiles(light: Float32Array, tiling: Tiling, paths: Float32Array) -> Iterator[tuple[Any, ...]]:
    """Each tile without its mean and windowed, the mean, the path, what is the same for all, and its place."""
    rows, columns = sources_of(tiling)
    window = np.outer(tiling.window_in(), tiling.window_in()).astype(np.float64)
    frequencies = Frequencies.of(tiling.side)
    for i in range(paths.shape[0]):
        for j in range(paths.shape[1]):
            place = tuple(slice(k * tiling.hop, k * tiling.hop + tiling.side) for k in (i, j))
            tile = light[rows[place[0]]][:, columns[place[1]]].astype(np.float64)
            mean = tile.mean()
            yield (tile - mean) * window, mean, paths[i, j], frequencies, window, place


@dataclass(frozen=True, eq=False, kw_only=True)
class Frequencies:
    """Of a square's real transform.

    Attributes
    ----------
    x, y
        (T // 2 + 1,) and (T,) cycles per pixel.
    square
        (T, T // 2 + 1) sum of their squares.
    gradient
        (T, T // 2 + 1) power that the differences to the next pixel along x and y have of each.
    fitted
        (T, T // 2 + 1) which of them the spectrum of natural images is fitted to.
    times
        (T // 2 + 1,) how often the whole transform has them.
    """

    x: Array
    y: Array
    square: Array
    gradient: Array
    fitted: BoolArray
    times: Array

    @classmethod
    def of(cls, side: int) -> Frequencies:
        x, y = np.asarray(np.fft.rfftfreq(side)), np.asarray(np.fft.fftfreq(side))
        square = x**2 + y[:, None] ** 2
        gradient = 4 * (np.sin(np.pi * x) ** 2 + np.sin(np.pi * y[:, None]) ** 2)
        low, high = FILTER_MODEL.fitted_per_px
        fitted = (square > low**2) & (square < high**2)
        times = np.where(np.arange(len(x)) % (side // 2), 2.0, 1.0)
        return cls(x=x, y=y, square=square, gradient=gradient, fitted=fitted, times=times)


def filter_tile(
    tile: Array,
    path: AnyArray,
    spread: AnyArray,
    frequencies: Frequencies,
    window: Array,
    noise: float,
    splitting: tuple[float, ...],
) -> Array:
    """A (T, T) tile without mean, already windowed, deblurred along an (S, 2) path; noise as a variance.

    ``spread`` is the covariance xx, xy, yy of the path's chord.
    """
    spectrum = np.fft.rfft2(tile)
    transfer = transfer_of(path, frequencies)
    doubt = doubt_of(path, spread, frequencies)
    power = np.abs(transfer) ** 2 + doubt
    signal = signal_at_one(np.abs(spectrum) ** 2 / np.sum(window**2), power, frequencies, noise)
    prior = signal / (frequencies.square + FILTER_MODEL.flat_below_per_px**2)
    wiener = np.conj(transfer) * prior / (power * prior + FILTER_MODEL.noise_factor * noise) * spectrum
    sharp = np.fft.irfft2(wiener, tile.shape)
    weight = FILTER_MODEL.data_weight * 1e-4 / noise
    # what the path is not known to do to the sharp picture adds to the noise of a frequency
    certain = FILTER_MODEL.noise_factor * noise / (FILTER_MODEL.noise_factor * noise + doubt * prior)
    data = weight * certain * np.conj(transfer) * spectrum
    for b in splitting:
        kept = [shrunk(np.roll(sharp, -1, axis) - sharp, b) for axis in (0, 1)]
        back = sum(np.roll(w, 1, axis) - w for axis, w in enumerate(kept))
        found = (data + b * np.fft.rfft2(back)) / (
            weight * certain * (power - doubt) + b * (frequencies.gradient + 1e-12)
        )
        sharp = np.fft.irfft2(found, tile.shape)
    return sharp


def transfer_of(path: AnyArray, frequencies: Frequencies) -> ComplexArray:
    """(T, T // 2 + 1) by what blur along an (S, 2) path multiplies each frequency: mean of ``exp(2 pi i f q)``.

    Zero at the highest frequencies, which have no sign.
    """
    along_x, along_y = (
        np.exp(2j * np.pi * f[:, None] * path[:, k]) for k, f in enumerate((frequencies.x, frequencies.y))
    )
    along_x[-1] = along_y[len(along_y) // 2] = 0
    return along_y @ along_x.T / len(path)


def doubt_of(path: AnyArray, spread: AnyArray, frequencies: Frequencies) -> Array:
    """(T, T // 2 + 1) variance of the transfer of a path whose chord has the covariance xx, xy, yy, px^2.

    An error w of the chord moves the path by ``s w``, s from -1/2 to 1/2 over the exposure, and the transfer by
    ``2 pi i (f . w) mean(s exp(2 pi i f q))``.
    """
    since = (np.arange(len(path)) + 0.5) / len(path) - 0.5
    along_x, along_y = (
        np.exp(2j * np.pi * f[:, None] * path[:, k]) for k, f in enumerate((frequencies.x, frequencies.y))
    )
    along_x[-1] = along_y[len(along_y) // 2] = 0
    lean = along_y @ (since * along_x).T / len(path)
    x, y = frequencies.x, frequencies.y[:, None]
    return 4 * np.pi**2 * (spread[0] * x**2 + 2 * spread[1] * x * y + spread[2] * y**2) * np.abs(lean) ** 2


def signal_at_one(power_seen: Array, transfer: Array, frequencies: Frequencies, noise: float) -> float:
    """Power of the sharp tile at one cycle per pixel, where it falls as ``1 / f^2``: by least squares of the excess."""
    band = frequencies.fitted * frequencies.times
    excess = (band * frequencies.square * transfer * (power_seen - noise)).sum()
    return max(float(excess / (band * transfer**2).sum()), FILTER_MODEL.least_signal * noise)


def shrunk(gradient: Array, splitting: float) -> Array:
    """What minimises ``|w|^(2/3) + splitting / 2 (w - gradient)^2``, by three rounds; 0 where that is less."""
    size = np.abs(gradient)
    w = size
    for _ in range(3):
        w = np.maximum(size - 2 / 3 / splitting * np.maximum(w, 1e-9) ** (-1 / 3), 0)
    return np.where(size < 2 * (2 / 3 / splitting) ** 0.75, 0, np.sign(gradient) * w)
