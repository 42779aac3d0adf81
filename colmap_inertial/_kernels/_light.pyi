"""Linear light as an image: colours joined, blended with the image that was filtered, written in its codes."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import BoolArray, Float32Array, UInt8Array

Code = TypeVar("Code", np.uint8, np.uint16)

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
) -> None:
    """Write the codes of `light`, which a filter made of the (H, W, C) image, into `result`."""

def find_spoilt(
    image: NDArray[Code],
    spoilt: UInt8Array,
    *,
    extent_px: Float32Array,
    slope: Float32Array,
    along_y: BoolArray,
    decode: Float32Array,
    saturated: int,
    threads: int = 0,
) -> bool:
    """Set (H, W) `spoilt` to one where `blend` keeps the image because light was clipped; False where nothing was."""

def join(
    luma: Float32Array,
    lines: Float32Array,
    result: Float32Array,
    *,
    red: float,
    blue: float,
    threads: int = 0,
) -> None:
    """Write (H, W, 3) RGB into `result`; lines are (4, ceil(H / 2), ceil(W / 2)) slopes and offsets over luma."""

def encode(light: Float32Array, result: UInt8Array, *, encode: Float32Array) -> None:
    """Write the nearest codes of (N,) linear light into `result`."""
