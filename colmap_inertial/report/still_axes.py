"""Axes of still plots: ranges as plotly.js chooses them, round ticks, and places in the picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from colmap_inertial.report.figures import Figure
from colmap_inertial.report.series import nice_length

Values = Sequence[Any]


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis: ``low`` lies at ``begin``, ``high`` at ``end`` of the picture (px); logarithms where ``log``."""

    low: float
    high: float
    begin: float
    end: float
    log: bool = False
    names: tuple[str, ...] = ()

    def place(self, value: Any) -> float | None:
        """Position of a value (px); ``None`` for gaps and for what a logarithmic axis cannot show."""
        if self.names:
            value = self.names.index(value)
        elif value is None or (self.log and value <= 0):
            return None
        at = math.log10(value) if self.log else float(value)
        return self.begin + (at - self.low) / (self.high - self.low) * (self.end - self.begin)

    @property
    def px_per_unit(self) -> float:
        """Pixels a unit."""
        return abs(self.end - self.begin) / (self.high - self.low)

    def ticks(self, apart_px: float) -> list[tuple[float, str]]:
        """Places (px) and texts of the ticks, about so far apart."""
        if self.names:
            return [(self._at(i), name) for i, name in enumerate(self.names)]
        if self.log:
            many = self.high - self.low > 2
            parts = (1,) if many else (1, 2, 5)
            exponents = range(math.floor(self.low), math.ceil(self.high) + 1)
            shown = [m * 10.0**k for k in exponents for m in parts if self.low <= k + math.log10(m) <= self.high]
            return [(self._at(math.log10(value)), f"{value:g}") for value in shown]
        step = nice_length((self.high - self.low) * apart_px / abs(self.end - self.begin))
        decimals = max(0, -math.floor(math.log10(step)))
        count = math.floor(self.high / step + 1e-6) - (first := math.ceil(self.low / step - 1e-6)) + 1
        values = [round((first + i) * step, decimals) + 0.0 for i in range(count)]
        return [(self._at(value), f"{value:.{decimals}f}".replace("-", "−")) for value in values]

    def _at(self, value: float) -> float:
        return self.begin + (value - self.low) / (self.high - self.low) * (self.end - self.begin)


def choose_axis(spec: Figure, columns: Iterable[Values], begin: float, end: float, *, pad: float) -> Axis:
    """An axis by its specification; without a range there, that of the values, with ``pad`` of it on both sides."""
    log = spec.get("type") == "log"
    columns = list(columns)
    if spec.get("type") == "category":
        names = tuple(dict.fromkeys(str(value) for column in columns for value in column))
        return Axis(low=-0.5, high=len(names) - 0.5, begin=begin, end=end, names=names)
    low, high = spec.get("range") or _reach(columns, log, pad, tozero=spec.get("rangemode") == "tozero")
    if spec.get("autorange") == "reversed":
        low, high = high, low
    if low > high:
        low, high, begin, end = high, low, end, begin
    return Axis(low=low, high=high, begin=begin, end=end, log=log)


def _reach(columns: Iterable[Values], log: bool, pad: float, *, tozero: bool) -> tuple[float, float]:
    known = [value for column in columns for value in column if value is not None and (value > 0 or not log)]
    if log:
        known = [math.log10(value) for value in known]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if high - low < 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    more = pad * (high - low)
    return (0.0 if tozero else low - more), high + more


def equalise(x: Axis, y: Axis) -> tuple[Axis, Axis]:
    """Give both axes the same pixels per unit: the wider one is shortened about its middle."""
    scale = min(x.px_per_unit, y.px_per_unit)

    def shortened(axis: Axis) -> Axis:
        middle, half = 0.5 * (axis.begin + axis.end), 0.5 * scale * (axis.high - axis.low)
        sign = 1 if axis.end > axis.begin else -1
        return Axis(low=axis.low, high=axis.high, begin=middle - sign * half, end=middle + sign * half)

    return shortened(x), shortened(y)
