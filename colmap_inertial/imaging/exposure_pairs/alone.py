"""The better one of two exposures that cannot be brought together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array
from colmap_inertial.imaging.exposure_pairs.pair import BRIGHTNESS_LIMITS, Brightness, average_channels, brightened
from colmap_inertial.imaging.transfer import decode_table


@dataclass(frozen=True, kw_only=True)
class AloneLimits:
    """Limits of the choice of the better of two exposures."""

    #: Detail is compared in bands: octaves from this standard deviation on,
    finest_px: float = 0.7
    #: so many of them.
    bands: int = 5
    #: What blur costs: so many times the power that detail lacks,
    missing: float = 3.0
    #: and this share of what is left, for it lies elsewhere. By 42 simulated pairs, of which the worse one is taken of
    #: 5, and is then worse by 6 dB at most.
    displaced: float = 0.5
    #: An image with more pixels black or clipped shows nothing.
    most_lost: float = 0.5
    #: Where nothing tells the gain, a short exposure is made so bright that this share of its pixels lies below white.
    below_white: float = 0.995
    #: Squares in which noise is measured; the median over them holds where texture fills fewer than half.
    noise_cell_px: int = 24


_LIMITS = AloneLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Alone:
    """One exposure of a pair.

    Attributes
    ----------
    used
        Which.
    image
        float32 sRGB 0 to 1, as bright as the long one, of the short one's shape.
    gain
        By what its light was multiplied.
    """

    used: Literal["short", "long"]
    image: Float32Array
    gain: float


def better_alone(short: AnyArray, long: AnyArray, brightness: Brightness | None) -> Alone:
    """The short exposure, brightened, or the long one, as it is: by which has the smaller error as far as it shows.

    The short one's error is its noise; the long one's is the detail that the short one has beyond its noise, and the
    long one has not. The two need not show the same: bands of detail are compared as wholes.

    Parameters
    ----------
    short, long
        (H, W) or (H, W, 3) sRGB codes, uint8 or uint16, of one shape.
    brightness
        Of the pair; ``None`` where nothing tells it: the short one is then made as bright as it can be.
    """
    light = decode_table(short.dtype)[short]
    if brightness is None:
        white = float(np.quantile(light, _LIMITS.below_white))
        gain = float(np.clip(1 / max(white, 1 / BRIGHTNESS_LIMITS.most_gain), 1.0, BRIGHTNESS_LIMITS.most_gain))
        colours = (1.0,) * (1 if short.ndim == 2 else short.shape[2])
        brightness = Brightness(gain=gain, colours=colours, measured=None, stated=None)
    bright = brightened(short, brightness)
    top = np.iinfo(long.dtype).max
    as_it_is = np.asarray(long.astype(np.float32) / np.float32(top))
    lost = [
        (short <= top // 256).mean(),
        max((long <= top // 256).mean(), (long >= np.ceil(BRIGHTNESS_LIMITS.clipped * top)).mean()),
    ]
    shown = [share <= _LIMITS.most_lost for share in lost]
    noise, blurred = _estimate_errors(average_channels(bright), average_channels(as_it_is))
    take_long = blurred < noise if shown[0] and shown[1] else not shown[0]
    if take_long:
        return Alone(used="long", image=as_it_is, gain=1.0)
    return Alone(used="short", image=bright, gain=brightness.gain)


def _estimate_errors(short: Float32Array, long: Float32Array) -> tuple[float, float]:
    """Mean squares: noise of the short one, and what blur makes of detail in the long one."""
    noise = _estimate_noise_variance(short)
    blurred = 0.0
    for (a, share), (b, _) in zip(_split_bands(short), _split_bands(long), strict=True):
        detail = max(a - noise * share, 0.0)
        blurred += _LIMITS.missing * max(detail - b, 0.0) + _LIMITS.displaced * detail
    return noise, blurred


def _split_bands(image: Float32Array) -> list[tuple[float, float]]:
    """Variance of each band of detail, and the share of white noise's that the band lets through."""
    import cv2

    point = np.zeros((129, 129), dtype=np.float32)
    point[64, 64] = 1.0
    bands, before, spread = [], image, point
    for k in range(_LIMITS.bands):
        sigma = _LIMITS.finest_px * 2**k
        after, wider = (cv2.GaussianBlur(picture, (0, 0), sigma) for picture in (image, point))
        bands.append((float(np.var(before - after)), float(np.sum((spread - wider) ** 2))))
        before, spread = after, wider
    return bands


def _estimate_noise_variance(image: Float32Array) -> float:
    """Variance of white noise, from a second difference without planes and straight edges, over most squares (J.
    Immerkaer, Fast noise variance estimation, 1996).
    """
    import cv2

    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    power: Array = np.square(cv2.filter2D(image, cv2.CV_32F, mask)[1:-1, 1:-1], dtype=np.float64)
    size = tuple(max(1, n // _LIMITS.noise_cell_px) for n in power.shape[::-1])
    cells = cv2.resize(power, size, interpolation=cv2.INTER_AREA)
    return float(np.median(cells)) / float((mask**2).sum())
