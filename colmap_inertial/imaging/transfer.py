"""Between the codes of an image and linear light (sRGB, IEC 61966-2-1)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array

#: Resolution of the tables back to codes. sRGB is steepest in the dark, 12.92: there one 8-bit code spans five entries.
ENCODE_STEPS = 16384


def linear_from_srgb(srgb: Array) -> Array:
    """Linear light from sRGB, both 0 to 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Array) -> Array:
    """sRGB from linear light, both 0 to 1; what lies outside is clipped."""
    light = np.clip(linear, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@lru_cache(maxsize=4)
def decode_table(dtype: np.dtype[Any]) -> Float32Array:
    """Linear light of every code of an image type."""
    top = int(np.iinfo(dtype).max)
    table = linear_from_srgb(np.arange(top + 1) / top).astype(np.float32)
    table.setflags(write=False)
    return table


@lru_cache(maxsize=4)
def encode_table(dtype: np.dtype[Any]) -> Float32Array:
    """(ENCODE_STEPS + 2,) codes, not yet rounded, of evenly spaced linear light; the last entry repeats."""
    light = np.minimum(np.arange(ENCODE_STEPS + 2) / ENCODE_STEPS, 1)
    table = (np.iinfo(dtype).max * srgb_from_linear(light)).astype(np.float32)
    table.setflags(write=False)
    return table


def linearise(image: AnyArray) -> Float32Array:
    """Linear light of codes."""
    if image.dtype == np.uint8:
        import cv2

        return np.asarray(cv2.LUT(image, decode_table(image.dtype)), dtype=np.float32)
    return decode_table(image.dtype)[image]
