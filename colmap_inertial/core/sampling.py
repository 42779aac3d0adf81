"""Samples of a sensor over time: where they have gaps or end at a ceiling, and their integrals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray

#: A longer pause between samples of an IMU is a gap: nothing is known about the motion in it.
GAP_S = 0.1
#: A pause that is worth a word, even where it is shorter than that: so many times the usual step between samples.
PAUSE_STEPS = 3.5

#: Spans of two clocks that were recorded along may differ by this factor: one was started earlier or stopped later.
UNIT_SPREAD = 5.0


@dataclass(frozen=True, kw_only=True)
class ClippingLimits:
    """Limits for readings at the end of a sensor's range."""

    #: A reading is cut off where its very largest value comes so often, and so many times as often as any value near it
    #: (in parts of the usual range).
    cut_samples: int = 6
    cut_times: int = 3
    cut_near: float = 0.1


_LIMITS = ClippingLimits()

#: Over this share of readings at the end of the range, the motion was lost and not only a knock.
MUCH_CUT = 0.001


def is_gap(t_s: Array, longer_than_s: float = GAP_S, *, steps: float = 0.0) -> BoolArray:
    """(N-1,) which steps between samples at (N,) times are gaps.

    Parameters
    ----------
    longer_than_s
        No shorter pause is one.
    steps
        Nor is one of fewer than so many usual steps.
    """
    step_s = np.diff(t_s)
    return np.asarray(step_s > max(longer_than_s, steps * float(np.median(step_s)) if steps else 0.0))


def time_unit_factor(span_s: float, other_s: float) -> float | None:
    """Power of 1000 by which a span is too long (or short) beside that of another clock; ``None`` for none.

    Stamps in milliseconds that are read as seconds span a thousand times what the other clock's do.
    """
    ratio = span_s / other_s
    power = round(float(np.log10(ratio)) / 3)
    if power == 0 or not 1 / UNIT_SPREAD < ratio / 1000.0**power < UNIT_SPREAD:
        return None
    return 1000.0**power


def find_clipped(values: Array) -> BoolArray:
    """(N, k) which samples (N, k) stand at their column's largest or smallest value, where these are far too many.

    An end of a natural distribution is rare; one that is cut off is a common reading.
    """
    return np.stack([_column_at_ceiling(column) for column in values.T], axis=1)


def _column_at_ceiling(values: Array) -> BoolArray:
    out = np.zeros(len(values), dtype=bool)
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return out
    reach = _LIMITS.cut_near * float(np.ptp(np.percentile(values, [1, 99])))
    for level in (levels[0], levels[-1]):
        # a rounded reading may stand in the last digit
        slack = 1e-6 * max(abs(float(level)), 1e-9)
        at_end = np.abs(levels - level) <= slack
        near = (np.abs(levels - level) <= reach) & ~at_end
        usual = max(int(counts[near].max(initial=0)), int(counts[[1, -2]][int(level > levels[0])]))
        if counts[at_end].sum() >= max(_LIMITS.cut_samples, _LIMITS.cut_times * usual):
            out |= np.abs(values - level) <= slack
    return out


class Coverage:
    """Intervals without a gap of samples at (N,) times ``t_s``."""

    def __init__(self, t_s: Array) -> None:
        self._t_s = t_s
        self._gaps = np.concatenate([[0], np.cumsum(is_gap(t_s))])

    def covers(self, begin_s: Array, end_s: Array) -> BoolArray:
        """Whether each interval lies inside the recording and contains no gap."""
        top = len(self._t_s) - 1
        first = np.searchsorted(self._t_s, begin_s, side="right") - 1
        last = np.searchsorted(self._t_s, end_s, side="left")
        gapless = self._gaps[np.clip(first, 0, top)] == self._gaps[np.clip(last, 0, top)]
        return np.asarray((first >= 0) & (last <= top) & gapless)


def integral_at(t_s: Array, values: Array, query_s: Array) -> Array:
    """(..., 3) the integral of (N, 3) samples from the first one to query times of any shape, by trapezoids."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    return np.stack([np.interp(query_s, t_s, column) for column in integral.T], axis=-1)


def subtract_running_mean(values: Array, width: int) -> Array:
    """High-pass samples (N, k) by subtracting their running mean over ``width`` samples: (N - width + 1, k)."""
    kernel = np.ones(width) / width
    slow = np.stack([np.convolve(column, kernel, mode="valid") for column in values.T], axis=1)
    start = (width - 1) // 2
    return np.asarray(values[start : start + len(slow)] - slow)


def fit_robust_slope(x: Array, y: Array) -> float:
    """``y`` per ``x`` of (N,) samples, some of which may be wrong.

    By least absolute deviations (a weighted median), then by least squares of what agrees to three standard deviations.
    """
    order = np.argsort(y / np.where(x == 0, np.inf, x))
    weight = np.cumsum(np.abs(x[order]))
    middle = order[np.searchsorted(weight, 0.5 * weight[-1])]
    residual = np.abs(y - y[middle] / x[middle] * x)
    agree = residual <= 3 * float(np.median(residual)) / 0.6745
    return float(y[agree] @ x[agree] / (x[agree] @ x[agree]))
