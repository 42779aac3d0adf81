"""Time stamps of a table in all forms that loggers write: numbers, several columns, dates, counters, a stated rate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.units import TIME_UNITS_NS

if TYPE_CHECKING:
    from colmap_inertial.io.tables import Table

DateOrder = Literal["ymd", "dmy", "mdy"]
DATE_ORDERS: tuple[DateOrder, ...] = ("ymd", "dmy", "mdy")
#: Where counters begin anew, in counts: those of 16, 24 and 32 bits; in microseconds or thousandths of them.
_COUNTS = (1 << 16, 1 << 24, 1 << 32)
_DAY_NS, _WEEK_NS = 86_400_000_000_000, 604_800_000_000_000
#: A counter that began anew ends and begins within this many usual steps of its ends.
_STEPS_FROM_THE_END = 20

_DATE_AND_TIME = re.compile(
    r"""(?:(?P<first>\d{1,4})[-/.](?P<second>\d{1,2})[-/.](?P<third>\d{1,4})[T\s_,]*)?
    (?:(?P<hour>\d{1,2})[:.hH-](?P<minute>\d{1,2})(?:[:.m-](?P<second_>\d{1,2})(?:(?P<dot>[.:,_])(?P<part>\d{1,9}))?)?)?
    \s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|(?:UTC|GMT)?[-+]\d{2}:?\d{2})?""",
    re.VERBOSE,
)


@dataclass(frozen=True, kw_only=True)
class TimeColumns:
    """Where the time of a row stands.

    Attributes
    ----------
    columns
        Names, or numbers counted from 1; their values are added up, the texts of dates put together. None where the
        rate is stated.
    units
        Of each column: ``s``, ``ms``, ``us``, ``ns``; or ``("date",)``.
    counts_per_second
        Of a counter, in place of units.
    date_order
        Of dates that do not begin with the year; ``None`` finds it where it matters.
    rate_hz
        Samples in a second, where there are no stamps.
    """

    columns: tuple[str | int, ...] = ()
    units: tuple[str, ...] = ()
    counts_per_second: float | None = None
    date_order: DateOrder | None = None
    rate_hz: float | None = None


def is_date(cell: str) -> bool:
    """Whether a cell holds a date, a time of day, or both."""
    match = _DATE_AND_TIME.fullmatch(cell.strip()) if 3 < len(cell) < 48 else None
    return match is not None and (match["first"] is not None or match["hour"] is not None)


def read_stamps(table: Table, time: TimeColumns) -> tuple[Int64Array, tuple[Fact, ...]]:
    """(N,) nanoseconds of the rows, and what was mended.

    Raises
    ------
    FormatError, TimingError
        For a stamp that cannot be read, or dates whose order nothing tells.
    """
    if time.rate_hz is not None:
        return np.rint(np.arange(len(table)) * (1e9 / time.rate_hz)).astype(np.int64), ()
    places = [table.column(column) for column in time.columns]
    if time.units == ("date",):
        t_ns = _dates_ns(table, places, time.date_order)
        periods = [_DAY_NS]
    elif time.counts_per_second is not None:
        counts = table.numbers(places[:1])[:, 0]
        if not (np.abs(counts) < 2**53).all():
            raise FormatError(table.path, Fact("no-counts", column=time.columns[0]))
        t_ns = np.rint(counts * (1e9 / time.counts_per_second)).astype(np.int64)
        periods = [round(period * (1e9 / time.counts_per_second)) for period in _COUNTS]
    else:
        t_ns = np.sum([table.stamps_ns(p, unit) for p, unit in zip(places, time.units, strict=True)], axis=0)
        unit_ns = TIME_UNITS_NS[time.units[0]]
        periods = [period * unit_ns // part for period in _COUNTS for part in (1, 1000, 1_000_000)]
        periods += [_DAY_NS, _WEEK_NS]
    turns, t_ns = unwrap(t_ns, periods)
    return t_ns, (Fact("clock-began-anew", file=table.path.name, times=turns),) if turns else ()


def unwrap(t_ns: Int64Array, periods_ns: Sequence[int]) -> tuple[int, Int64Array]:
    """How often a counter of one of the periods began anew, and stamps that go on there."""
    steps = np.diff(t_ns)
    back = np.flatnonzero(steps < 0)
    if not len(back) or 2 * len(back) > len(steps):
        return 0, t_ns
    usual = max(int(np.median(steps[steps > 0])), 1) if (steps > 0).any() else 1
    near = _STEPS_FROM_THE_END * usual
    for period in periods_ns:
        if near >= period // 4:
            continue
        first = t_ns[back + 1]
        ends = (period - t_ns[back] <= near) & (t_ns[back] < period) & (first >= 0) & (first <= near)
        if ends.all():
            turned = np.zeros(len(t_ns), dtype=np.int64)
            turned[back + 1] = period
            return len(back), t_ns + np.cumsum(turned)
    return 0, t_ns


# --- dates ------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4096)
def _day_ns(year: int, month: int, day: int) -> int:
    return (date(year, month, day).toordinal() - date(1970, 1, 1).toordinal()) * _DAY_NS


def _dates_ns(table: Table, places: Sequence[int], stated: DateOrder | None) -> Int64Array:
    texts = [" ".join(cells) for cells in zip(*(table.text(place) for place in places), strict=True)]
    matches = [_DATE_AND_TIME.fullmatch(text.strip()) if len(text) < 64 else None for text in texts]
    wrong = next((i for i, match in enumerate(matches) if match is None or match["hour"] is None), None)
    if wrong is not None:
        line = int(table.line_numbers[wrong])
        raise FormatError(table.path, Fact("no-date-with-time", text=texts[wrong][:40]), line=line)
    known = [match for match in matches if match is not None]
    order = stated or _order(table, known)
    out = np.empty(len(known), dtype=np.int64)
    for i, match in enumerate(known):
        try:
            out[i] = _stamp_ns(match, order)
        except ValueError as error:
            line = int(table.line_numbers[i])
            raise FormatError(
                table.path, Fact("not-a-date", text=texts[i][:40], detail=str(error)), line=line
            ) from None
    return out


def _order(table: Table, matches: Sequence[re.Match[str]]) -> DateOrder:
    """The order of day, month and year that the dates tell; any where they are all of one day."""
    days = {(m["first"], m["second"], m["third"]) for m in matches}
    if any(first is not None and len(first) == 4 for first, _, _ in days) or days == {(None, None, None)}:
        return "ymd"
    if any(int(first or 0) > 12 for first, _, _ in days):
        return "dmy"
    if len(days) == 1 or any(int(second or 0) > 12 for _, second, _ in days):
        return "mdy"
    raise TimingError(Fact("date-order-unknown", path=str(table.path), example="/".join(map(str, next(iter(days))))))


def _stamp_ns(match: re.Match[str], order: DateOrder) -> int:
    total = 0
    if match["first"] is not None:
        numbers = dict(zip(order, (int(match[name]) for name in ("first", "second", "third")), strict=True))
        year = numbers["y"] + (2000 if numbers["y"] < 100 else 0)
        total = _day_ns(year, numbers["m"], numbers["d"])
    hour = int(match["hour"])
    if match["half"]:
        hour = hour % 12 + (12 if match["half"][0] in "Pp" else 0)
    second = int(match["second_"] or 0)
    if hour > 24 or int(match["minute"]) > 59 or second > 60:
        raise ValueError(Fact("no-time-of-day"))
    part = match["part"] or ""
    if match["dot"] in (":", "_") and len(part) <= 3:
        below = int(part or 0) * 1_000_000  # milliseconds, which some do not fill up with zeros
    else:
        below = int(part.ljust(9, "0")) if part else 0
    total += (hour * 3600 + int(match["minute"]) * 60 + second) * 1_000_000_000 + below
    zone = re.search(r"([-+])(\d{2}):?(\d{2})", match["zone"] or "")
    if zone:
        away = (int(zone[2]) * 60 + int(zone[3])) * 60_000_000_000
        total -= away if zone[1] == "+" else -away
    return total
