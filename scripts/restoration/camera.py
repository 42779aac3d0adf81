"""What a camera makes of light: clipping, noise, sRGB, sharpening, JPEG. On the device where the light is."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

#: JPEG's example tables of quantisation (ITU-T T.81, annex K), brightness and colour.
_BRIGHTNESS = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
_COLOUR = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *(((99,) * 8,) * 4),
)


def srgb(light: Tensor) -> Tensor:
    """Codes 0 to 1 of linear light, clipped."""
    light = light.clamp(0, 1)
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(1e-8) ** (1 / 2.4) - 0.055)


def light_of(code: Tensor) -> Tensor:
    """Linear light of codes 0 to 1."""
    return torch.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def noisy(light: Tensor, read: Tensor, shot: Tensor, grain: Tensor, generator: torch.Generator) -> Tensor:
    """Light with noise of variance ``read^2 + shot light``.

    Parameters
    ----------
    light
        (B, 3, H, W)
    read, shot
        (B, 3) of full scale, for each channel.
    grain
        (B,) share of the noise that is spread over neighbouring pixels, as demosaicing does; its strength stays.
    """
    white = torch.randn(light.shape, generator=generator, device=light.device)
    kernel = torch.tensor([0.25, 0.5, 0.25], device=light.device)
    spread = (kernel[:, None] * kernel[None])[None, None].expand(3, 1, 3, 3)
    coarse = functional.conv2d(white, spread, padding=1, groups=3) / float(spread[0].square().sum().sqrt())
    g = grain[:, None, None, None]
    mixed = (1 - g) * white + g * coarse
    mixed = mixed / (((1 - g) + g * 0.25 / 0.375) ** 2 + g * g * (1 - (0.25 / 0.375) ** 2)).sqrt()
    sigma = (read.square()[..., None, None] + shot[..., None, None] * light.clamp_min(0)).sqrt()
    return light + sigma * mixed


def sharpened(code: Tensor, amount: Tensor) -> Tensor:
    """Codes with the finest detail raised, (B,) amounts, as cameras do."""
    kernel = torch.tensor([0.25, 0.5, 0.25], device=code.device)
    spread = (kernel[:, None] * kernel[None])[None, None].expand(3, 1, 3, 3)
    smooth = functional.conv2d(functional.pad(code, (1, 1, 1, 1), mode="replicate"), spread, groups=3)
    return (code + amount[:, None, None, None] * (code - smooth)).clamp(0, 1)


def jpeg(code: Tensor, quality: Tensor, halved: Tensor) -> Tensor:
    """Codes as they come back from JPEG, sides multiples of 16.

    Parameters
    ----------
    code
        (B, 3, H, W) 0 to 1.
    quality
        (B,) 1 to 100, as libjpeg counts it.
    halved
        (B,) bool, colours at half the size (4:2:0).
    """
    r, g, b = (255 * code).unbind(1)
    y = 0.299 * r + 0.587 * g + 0.114 * b
    colours = torch.stack([0.564 * (b - y), 0.713 * (r - y)], dim=1)
    scale = torch.where(quality < 50, 5000 / quality, 200 - 2 * quality)[:, None, None, None, None] / 100
    y = _coded((y - 128)[:, None], _table(_BRIGHTNESS, code.device), scale)[:, 0] + 128
    small = functional.interpolate(
        _coded(functional.avg_pool2d(colours, 2), _table(_COLOUR, code.device), scale),
        scale_factor=2.0,
        mode="bilinear",
        align_corners=False,
    )
    full = _coded(colours, _table(_COLOUR, code.device), scale)
    cb, cr = torch.where(halved[:, None, None, None], small, full).unbind(1)
    out = torch.stack([y + cr / 0.713, torch.zeros_like(y), y + cb / 0.564], dim=1)
    out[:, 1] = (y - 0.299 * out[:, 0] - 0.114 * out[:, 2]) / 0.587
    return (out / 255).clamp(0, 1)


def _coded(plane: Tensor, table: Tensor, scale: Tensor) -> Tensor:
    """(B, C, H, W) after the transform of 8 x 8 blocks, quantisation, and back."""
    count, channels, height, width = plane.shape
    if height % 8 or width % 8:
        raise ValueError("sides must be multiples of 8 (of 16 with colours at half the size)")
    cosines = _cosines(plane.device)
    blocks = plane.reshape(count, channels, height // 8, 8, width // 8, 8).permute(0, 1, 2, 4, 3, 5)
    steps = (table * scale).round().clamp_min(1)[:, :, None]
    kept = (cosines @ blocks @ cosines.T / steps).round() * steps
    back = cosines.T @ kept @ cosines
    return back.permute(0, 1, 2, 4, 3, 5).reshape(count, channels, height, width)


@lru_cache(maxsize=4)
def _table(rows: tuple[tuple[int, ...], ...], device: torch.device) -> Tensor:
    return torch.tensor(rows, dtype=torch.float32, device=device)


@lru_cache(maxsize=2)
def _cosines(device: torch.device) -> Tensor:
    """(8, 8) the orthonormal discrete cosine transform."""
    k, x = torch.arange(8.0)[:, None], torch.arange(8.0)[None]
    rows = torch.cos(torch.pi * (2 * x + 1) * k / 16) * torch.where(k == 0, 0.125, 0.25).sqrt()
    return rows.to(device)
