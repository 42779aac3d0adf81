"""Filters along curved paths of blur, in tiles. The arguments are those of `colmap_inertial.imaging.path_filters`."""

from colmap_inertial.core.arrays import Float32Array

def filter(
    light: Float32Array,
    result: Float32Array,
    *,
    paths: Float32Array,
    spread: Float32Array,
    window_in: Float32Array,
    window_out: Float32Array,
    hop: int,
    before: int,
    noise: Float32Array,
    least_noise: float,
    noise_factor: float,
    flat_below: float,
    fitted_from: float,
    fitted_to: float,
    least_signal: float,
    data_weight: float,
    splitting: Float32Array,
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write the (H, W, C) light without blur into `result`; no splitting is Wiener's filter."""

def noise(
    light: Float32Array,
    *,
    paths: Float32Array,
    window_in: Float32Array,
    hop: int,
    before: int,
    above: float,
    share: float,
    every: int,
    threads: int = 0,
    instruction_set: str = "",
) -> list[float]:
    """Of each channel and each of the tiles looked at: mean light, variance of the noise, frequencies that show it."""

def transform(tile: Float32Array, spectrum: Float32Array, back: Float32Array, instruction_set: str = "") -> None:
    """Write the real transform of a (T, T) tile, (T, T // 2 + 1, 2), and what comes back, times T^2. For tests."""

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
