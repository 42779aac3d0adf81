"""Filters along curved paths of blur, in tiles. The arguments are those of `colmap_inertial.imaging.path_filters`."""

import numpy as np
from numpy.typing import NDArray

def filter(
    light: NDArray[np.float32],
    result: NDArray[np.float32],
    *,
    paths: NDArray[np.float32],
    spread: NDArray[np.float32],
    window_in: NDArray[np.float32],
    window_out: NDArray[np.float32],
    hop: int,
    before: int,
    noise: NDArray[np.float32],
    least_noise: float,
    noise_factor: float,
    flat_below: float,
    fitted_from: float,
    fitted_to: float,
    least_signal: float,
    data_weight: float,
    splitting: NDArray[np.float32],
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write the (H, W, C) light without blur into `result`; no splitting is Wiener's filter."""

def noise(
    light: NDArray[np.float32],
    *,
    paths: NDArray[np.float32],
    window_in: NDArray[np.float32],
    hop: int,
    before: int,
    above: float,
    share: float,
    every: int,
    threads: int = 0,
    instruction_set: str = "",
) -> list[float]:
    """Of each channel and each of the tiles looked at: mean light, variance of the noise, frequencies that show it."""

def transform(
    tile: NDArray[np.float32], spectrum: NDArray[np.float32], back: NDArray[np.float32], instruction_set: str = ""
) -> None:
    """Write the real transform of a (T, T) tile, (T, T // 2 + 1, 2), and what comes back, times T^2. For tests."""

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
