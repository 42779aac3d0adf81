"""Units and axes of inertial samples: converted once, at the reader, from what a file or a user declares."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from math import pi
from pathlib import Path
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact

Quantity = Literal["gyro", "accel"]

#: Standard gravity, the definition of the unit g (m/s2; CGPM 1901).
STANDARD_GRAVITY_M_S2 = 9.80665
#: Nanoseconds in each unit of time.
TIME_UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
#: SI value of each unit, by quantity. The first of each is the SI unit itself.
SENSOR_UNITS: dict[Quantity, dict[str, float]] = {
    "gyro": {"rad/s": 1.0, "deg/s": pi / 180},
    "accel": {"m/s2": 1.0, "g": STANDARD_GRAVITY_M_S2},
}
SENSOR_NAMES: dict[Quantity, str] = {"gyro": "gyroscope", "accel": "accelerometer"}

# Other spellings, after blanks, underscores and "^" are taken out and letters made small.
_ALIASES = {
    **dict.fromkeys(("rad/s", "rads-1", "rads", "rad/sec", "radians/s"), "rad/s"),
    **dict.fromkeys(("deg/s", "degs-1", "degs", "dps", "°/s", "deg/sec", "degrees/s"), "deg/s"),
    **dict.fromkeys(("º/s", "°/sec", "d/s", "degree/s", "degree/sec", "degrees/sec", "°s-1", "degpersec"), "deg/s"),
    **dict.fromkeys(("rad/second", "radpersec", "radian/s", "radians/sec", "radps", "radianspersecond"), "rad/s"),
    **dict.fromkeys(("degreespersecond", "degpersecond", "deg/second", "degrees/second"), "deg/s"),
    **dict.fromkeys(("m/s2", "ms-2", "ms2", "m/s²", "m/s/s", "mps2", "m/sec2"), "m/s2"),
    **dict.fromkeys(("m/(s2)", "m/sec²", "m/s2.", "ms−2", "mps²", "m/second2", "m/s−2"), "m/s2"),
    **dict.fromkeys(("g", "g0"), "g"),
    **dict.fromkeys(("s", "sec", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millisec", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsec", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanosec", "nanoseconds"), "ns"),
}
# Units of which many make one of ours: as they are spelled, ours, and how many.
_SCALED = {
    **dict.fromkeys(("mg", "millig", "milli-g", "milligs"), ("g", 1000.0)),
    **dict.fromkeys(("gs", "g-force", "gforce", "gee", "gn"), ("g", 1.0)),
    **dict.fromkeys(("mdps", "mdeg/s", "millideg/s"), ("deg/s", 1000.0)),
    **dict.fromkeys(("mrad/s",), ("rad/s", 1000.0)),
    **dict.fromkeys(("cm/s2", "cm/s²", "gal"), ("m/s2", 100.0)),
    **dict.fromkeys(("mm/s2", "mm/s²"), ("m/s2", 1000.0)),
    **dict.fromkeys(("millis", "millisecond"), ("ms", 1.0)),
    **dict.fromkeys(("micros", "microsecond"), ("us", 1.0)),
    **dict.fromkeys(("nanos", "nanosecond"), ("ns", 1.0)),
    **dict.fromkeys(("secs",), ("s", 1.0)),
}
# Differences of two stamps must fit 64 bits as well.
_LARGEST_STAMP_NS = 4_500_000_000_000_000_000


def unit_of(text: str) -> str | None:
    """The unit that ``text`` spells, in the spelling of this module; ``None`` where it is none of them."""
    return _ALIASES.get(re.sub(r"[\s_^*·]", "", text).lower())


def unit_and_scale(text: str) -> tuple[str, float] | None:
    """:func:`unit_of`, and how many of what ``text`` spells make one: ``"mg"`` gives ``("g", 1000)``."""
    unit = unit_of(text)
    return (unit, 1.0) if unit is not None else _SCALED.get(re.sub(r"[\s_^*·]", "", text).lower())


@dataclass(frozen=True, kw_only=True)
class DeclaredUnits:
    """What the user states in place of what a file or format says; ``None`` leaves the file's.

    Attributes
    ----------
    gyro, accel
        Units.
    stamps
        Of a bag: ``"header"``, or ``"arrival"``.
    topic
        Of a bag that has several.
    """

    gyro: str | None = None
    accel: str | None = None
    stamps: str | None = None
    topic: str | None = None


def convert_to_si(values: Array, quantity: Quantity, unit: str) -> Array:
    """Samples in rad/s or m/s2 from samples in ``unit`` (a key of ``SENSOR_UNITS[quantity]``)."""
    factor = SENSOR_UNITS[quantity][unit]
    return values if factor == 1.0 else values * factor


def seconds(t_ns: Int64Array, epoch_ns: int) -> Array:
    """Seconds since ``epoch_ns``: the difference is taken in whole nanoseconds, so nothing is lost."""
    return np.asarray((t_ns - epoch_ns) / 1e9, dtype=np.float64)


def stamps_ns(
    path: Path, tokens: Sequence[str], unit: str, line_numbers: Sequence[int] | Int64Array | None = None
) -> Int64Array:
    """Exact integer nanoseconds of time stamps written as text.

    Parameters
    ----------
    path, line_numbers
        Where the stamps come from, for messages.
    tokens
        (N,) decimal numbers, with or without fraction or exponent. Digits below a nanosecond are rounded.
    unit
        Key of ``TIME_UNITS_NS``.

    Raises
    ------
    FormatError
        For a token that is not a decimal number.
    TimingError
        For a stamp beyond what differences in 64-bit nanoseconds can hold (142 years from the clock's zero).
    """
    factor = TIME_UNITS_NS[unit]
    joined = "".join(tokens)
    if joined.isdecimal() and joined.isascii() and all(tokens) and max(map(len, tokens)) <= 20:
        values = [int(token) * factor for token in tokens]
    else:
        values = []
        for i, token in enumerate(tokens):
            try:
                if len(token) > 64 or "_" in token:
                    raise ValueError(token)
                exact = Decimal(token) * factor
                if not exact.is_finite():
                    raise ValueError(token)
                values.append(int(exact.to_integral_value()) if abs(exact) < _LARGEST_STAMP_NS else _LARGEST_STAMP_NS)
            except (DecimalException, ValueError):
                line = None if line_numbers is None else int(line_numbers[i])
                raise FormatError(path, Fact("stamp-not-a-number", stamp=token[:40]), line=line) from None
    if values and not -_LARGEST_STAMP_NS < min(values) <= max(values) < _LARGEST_STAMP_NS:
        bad = next(i for i, value in enumerate(values) if not -_LARGEST_STAMP_NS < value < _LARGEST_STAMP_NS)
        line = None if line_numbers is None else int(line_numbers[bad])
        raise TimingError(Fact("stamp-too-far", path=str(path), line=line, stamp=tokens[bad][:40], unit=unit))
    return np.array(values, dtype=np.int64)
