"""Directional Wiener filter. The arguments of `deblur` are those of `colmap_inertial.imaging.wiener`, spelled out."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import BoolArray, Float32Array, Int32Array, UInt8Array

Code = TypeVar("Code", np.uint8, np.uint16, np.float32)

def deblur(
    image: NDArray[Code],
    result: NDArray[Code],
    *,
    extent_px: Float32Array,
    slope: Float32Array,
    along_y: BoolArray,
    fade: Float32Array,
    weights: Float32Array,
    reach: Int32Array,
    first: float,
    steps: float,
    smoothing: Float32Array,
    decode: Float32Array,
    encode: Float32Array,
    saturated: int,
    threads: int = 0,
    instruction_set: str = "",
) -> tuple[float, float]:
    """Write the deblurred (H, W, C) image into `result`; returns the processor time of decoding and of filtering, s."""

def blend(
    image: NDArray[Code],
    light: Float32Array,
    result: NDArray[Code],
    *,
    extent_px: Float32Array,
    slope: Float32Array,
    along_y: BoolArray,
    fade: Float32Array,
    decode: Float32Array,
    encode: Float32Array,
    saturated: int,
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write the codes of `light`, which another filter made of the (H, W, C) image, into `result`."""

def join(
    luma: Float32Array,
    lines: Float32Array,
    result: Float32Array,
    *,
    red: float,
    blue: float,
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write (H, W, 3) RGB into `result`; lines are (4, ceil(H / 2), ceil(W / 2)) slopes and offsets over luma."""

def encode(light: Float32Array, result: UInt8Array, *, encode: Float32Array, instruction_set: str = "") -> None:
    """Write the nearest codes of (N,) linear light into `result`."""

def peak_multiply_adds(instruction_set: str = "", seconds: float = 0.2) -> float:
    """Fused multiply-adds a second that one core reaches in registers, each lane counted."""

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
