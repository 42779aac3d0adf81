"""A guard for fused pairs: the short exposure itself where the fused image departs from it by more than its noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.imaging.exposure_pairs.pair import average_channels


@dataclass(frozen=True, kw_only=True)
class DepartureLimits:
    """Limits of the departure of a fused image from its short exposure.

    By pairs of ``scripts/benchmarks/exposures.py``, seeds 101 and 102, 480 px wide: the worst one of 101 rises
    from 2.2 dB below its short exposure to level with it, and none loses more than 0.01 dB.
    """

    #: Side of the squares over which the mean squares are taken, px.
    window_px: int = 25
    #: The fused image stays while the mean square of its difference is at most so many times the noise's variance;
    stays: float = 2.0
    #: from so much above that on, the short exposure takes its place.
    fades_over: float = 1.0
    #: Least variance of noise, of sRGB 0 to 1 squared: rounding to 8 bits.
    least_variance: float = (1 / 255) ** 2 / 12


_LIMITS = DepartureLimits()


def replace_departures(fused: Float32Array, short: Float32Array) -> Float32Array:
    """Take the short exposure where the fused image departs from it by more than noise explains.

    A fused image without error differs from the short exposure by that one's noise. Where the mean square of the
    difference is a multiple of the noise's variance, a wrong alignment or ringing has made more error than it has taken
    away noise. The noise is measured around each pixel from second differences; texture counts as noise there, so that
    the fused image stays in doubt.

    Parameters
    ----------
    fused
        (H, W) or (H, W, 3) float32, sRGB 0 to 1.
    short
        Likewise: the short exposure at the brightness of ``fused``, in the same geometry.

    Returns
    -------
    A new image of the same shape, float32.
    """
    import cv2

    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    window = (_LIMITS.window_px, _LIMITS.window_px)
    grey = average_channels(short)
    difference = grey - average_channels(np.clip(fused, 0, 1))
    # a dark exposure has few codes, and none below black: a common offset is no sign of a wrong alignment
    departure = cv2.blur(np.square(difference), window) - np.square(cv2.blur(difference, window))
    noise = cv2.blur(np.square(cv2.filter2D(grey, cv2.CV_32F, mask)), window) / float((mask**2).sum())
    excess = departure / np.maximum(noise, _LIMITS.least_variance) - _LIMITS.stays
    share = np.clip(excess / _LIMITS.fades_over, 0, 1)
    if fused.ndim == 3:
        share = share[..., None]
    return np.asarray(fused + share * (short - fused), dtype=np.float32)
