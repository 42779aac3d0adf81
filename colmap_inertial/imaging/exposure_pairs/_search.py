"""Global search for one reduced image in another: weighted correlation over all shifts.

Of images of which parts tell nothing, and that overlap in part, the correlation at all shifts is a few Fourier
transforms (D. Padfield, Masked object registration in the Fourier domain, 2012), here of detail whose mean is about 0.
A few turns about the view's axis are tried, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, ComplexArray, Float32Array


@dataclass(frozen=True, kw_only=True)
class SearchLimits:
    """Limits of the search for one image in another."""

    #: The images must share so much of their area: with less, chance correlates, too.
    least_shared: float = 0.3
    #: What a shift by the longer side takes off the score.
    nearer: float = 0.1
    #: So many places are worth a closer look;
    places: int = 8
    #: they lie so far apart, in the reduced image's px.
    apart_px: float = 4.0


_LIMITS = SearchLimits()

#: Turns about the view's axis, degrees, of steady hands, and others: between them detail of an image's tenth still
#: agrees.
USUAL_TURNS_DEG = (0.0, -5.0, 5.0, -10.0, 10.0)
OTHER_TURNS_DEG = tuple(sign * degrees for degrees in range(15, 65, 5) for sign in (-1.0, 1.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """A place where the second image may lie on the first.

    Attributes
    ----------
    mapping
        (3, 3) from OpenCV's pixels of the first to those of the second.
    score
        Correlation times the root of the shared area: what chance reaches is about the same at every shift.
    """

    mapping: Array
    score: float


def places(
    first: Float32Array,
    first_tells: Float32Array,
    second: Float32Array,
    second_tells: Float32Array,
    *,
    farthest: float,
    turns_deg: Sequence[float],
) -> list[Place]:
    """The best few places, the best one first.

    Parameters
    ----------
    first, second
        (H, W) detail, about 0 in the mean.
    first_tells, second_tells
        (H, W) 0 to 1: how much each pixel tells.
    farthest
        Shifts are as long at most, in the longer side.
    turns_deg
        About the view's axis, that are tried.
    """
    import cv2

    height, width = first.shape
    peaks: list[Place] = []
    for degrees in turns_deg:
        turn = np.eye(3)
        turn[:2] = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), degrees, 1.0)
        turned, tells = (
            cv2.warpAffine(image, turn[:2], (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            for image in (second, np.asarray(second_tells, dtype=np.float32))
        )
        scores, shifts = _correlate_shifts(first, first_tells, np.asarray(turned), np.asarray(tells))
        length = np.hypot(shifts[0][:, None], shifts[1]) / max(height, width)
        # of a pattern's repetitions, the nearest
        scores = np.where(length <= farthest, scores - _LIMITS.nearer * length, -1.0)
        for _ in range(_LIMITS.places):
            row, column = np.unravel_index(np.argmax(scores), scores.shape)
            dy, dx = shifts[0][row], shifts[1][column]
            shift = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])
            peaks.append(Place(mapping=turn @ shift, score=float(scores[row, column])))
            near = (np.abs(shifts[0] - dy) < _LIMITS.apart_px)[:, None] & (np.abs(shifts[1] - dx) < _LIMITS.apart_px)
            scores[near] = -1.0
    chosen: list[Place] = []
    middle = np.array([0.5 * width, 0.5 * height, 1.0])
    for place in sorted(peaks, key=lambda peak: -peak.score):
        there = (place.mapping @ middle)[:2]
        if all(np.linalg.norm(there - (other.mapping @ middle)[:2]) >= _LIMITS.apart_px for other in chosen):
            chosen.append(place)
        if len(chosen) == _LIMITS.places:
            break
    return chosen


def _correlate_shifts(
    first: Float32Array, first_tells: Float32Array, second: Float32Array, second_tells: Float32Array
) -> tuple[Array, tuple[Array, Array]]:
    """Scores at all shifts (what to add to a pixel of the first), and the shifts of their rows and columns."""
    height, width = first.shape
    size = (2 * height, 2 * width)

    def transformed(image: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft2(image, size))

    a, b = np.asarray(first_tells, dtype=np.float64), np.asarray(second_tells, dtype=np.float64)
    x, y = a * first, b * second
    fa, fx, fxx = (np.conj(transformed(image)) for image in (a, x, x * first))
    fb, fy, fyy = (transformed(image) for image in (b, y, y * second))
    both, power_x, power_y, shared = (
        np.fft.irfft2(product, size) for product in (fx * fy, fxx * fb, fa * fyy, fa * fb)
    )
    share = shared / (height * width)
    power = np.sqrt(np.clip(power_x, 1e-12, None) * np.clip(power_y, 1e-12, None))
    enough = share >= min(_LIMITS.least_shared, 0.9 * float(share.max()))
    scores = np.where(enough, both / power * np.sqrt(np.clip(share, 0, 1)), -1.0)
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in size)
    return scores, (rows, columns)
