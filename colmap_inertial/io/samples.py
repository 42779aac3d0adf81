"""Putting stamped samples in order: what is harmless is repaired and listed, what is not is an error."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError, TimingError
from colmap_inertial.types import Array

#: A sample this far behind the newest one before it means that the clock was set back, not that rows changed places.
LATEST_ARRIVAL_NS = 500_000_000
#: Share of samples that may be missing (NaN) or stamped twice with different values before the file is refused.
HARMLESS_SHARE = 0.05
#: Sampling rates outside these bounds mean a wrong time unit: no phone, camera or drone IMU is slower or faster.
RATE_BOUNDS_HZ = (4.0, 20_000.0)
#: No unit makes a reading of a working sensor larger; what is larger is no number but damage.
LARGEST_READING = 1e9
#: A pause this long within one recording means a broken stamp.
LONGEST_GAP_NS = 3_600_000_000_000


class Repair(str):
    """A sentence on what was repaired, with a stable name of it."""

    code: str

    def __new__(cls, text: str, code: str = "repaired") -> Repair:
        self = super().__new__(cls, text)
        self.code = code
        return self


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Samples of one sensor, in order.

    Attributes
    ----------
    t_ns
        (N,) strictly increasing.
    values
        (N, 3) finite.
    repairs
        What was sorted, merged or dropped.
    """

    t_ns: NDArray[np.int64]
    values: Array
    repairs: tuple[str, ...]


def order_samples(
    path: Path, what: str, t_ns: NDArray[np.int64], values: Array, line_numbers: NDArray[np.int64] | None = None
) -> Samples:
    """Sort, merge and drop what is harmless.

    Rows without a sample, and a few with missing values, are dropped; rows up to half a second late are sorted in; rows
    that repeat a stamp are merged (equal values) or averaged (different ones). Each is listed.

    Parameters
    ----------
    path, what
        For messages: the file, and the sensor's name.
    t_ns, values, line_numbers
        (N,), (N, 3), (N,) rows as they stand in the file; without line numbers, samples are counted.

    Raises
    ------
    FormatError
        For too many missing values or fewer than two samples.
    TimingError
        For stamps that run backwards, jump back, repeat often, or cannot be in the stated unit.
    """
    unit = "line"
    if line_numbers is None:
        unit, line_numbers = "sample", np.arange(1, len(t_ns) + 1)
    repairs: list[str] = []
    # Loggers that write sensors of different rates to one table leave the cells of the others empty.
    absent = np.asarray(np.isnan(values).all(axis=1))
    if absent.any():
        repairs.append(
            Repair(f"{path.name}: {int(absent.sum())} of {len(absent)} rows hold no {what} sample", code="empty-cells")
        )
        t_ns, values, line_numbers = t_ns[~absent], values[~absent], line_numbers[~absent]
    finite = np.asarray((np.abs(values) < LARGEST_READING).all(axis=1))
    if not finite.all():
        missing, first = int((~finite).sum()), int(line_numbers[np.argmin(finite)])
        if missing > HARMLESS_SHARE * len(finite):
            lacking = f"{missing} of {len(finite)} {what} rows lack a value (NaN or empty)"
            raise FormatError(path, lacking, line=first if unit == "line" else None)
        repairs.append(
            Repair(
                f"{path.name}: dropped {missing} {what} rows without a value (first: {unit} {first})",
                code="samples-missing",
            )
        )
        t_ns, values, line_numbers = t_ns[finite], values[finite], line_numbers[finite]
    if len(t_ns) < 2:
        raise FormatError(path, f"holds {len(t_ns)} {what} samples; at least two are needed")

    newest = np.maximum.accumulate(t_ns)
    late_ns = newest - t_ns
    if late_ns.any():
        worst = int(np.argmax(late_ns))
        if (np.diff(t_ns) < 0).mean() > 0.5:
            raise TimingError(
                f"{path}: {what} stamps run backwards; is the file written in reverse order?", code="stamps-reversed"
            )
        if late_ns[worst] > LATEST_ARRIVAL_NS:
            first = int(np.argmax(late_ns > LATEST_ARRIVAL_NS))
            raise TimingError(
                f"{path}, {unit} {line_numbers[first]}: the {what} stamp is {late_ns[first] * 1e-9:.3f} s behind one "
                "before it; the clock was set back or a stamp is damaged: split or correct the file there",
                code="stamps-jump-back",
            )
        repairs.append(
            Repair(
                f"{path.name}: sorted {int((late_ns > 0).sum())} {what} rows that came late", code="stamps-reordered"
            )
        )
        order = np.argsort(t_ns, kind="stable")
        t_ns, values, line_numbers = t_ns[order], values[order], line_numbers[order]

    same = np.diff(t_ns) == 0
    if same.any():
        t_ns, values = _merge(path, what, t_ns, values, line_numbers, same, repairs, unit)
        if len(t_ns) < 2:
            raise TimingError(f"{path}: all {what} samples have one stamp; this is not the time column")
    check_rate(path, what, t_ns)
    return Samples(t_ns=t_ns, values=values, repairs=tuple(repairs))


def _merge(
    path: Path,
    what: str,
    t_ns: NDArray[np.int64],
    values: Array,
    line_numbers: NDArray[np.int64],
    same: NDArray[np.bool_],
    repairs: list[str],
    unit: str,
) -> tuple[NDArray[np.int64], Array]:
    group = np.concatenate([[0], np.cumsum(~same)])
    first = np.concatenate([[0], np.flatnonzero(~same) + 1])
    differs = same & (values[1:] != values[:-1]).any(axis=1)
    n_equal, n_different = int((same & ~differs).sum()), int(differs.sum())
    if n_different > HARMLESS_SHARE * len(t_ns):
        line = int(line_numbers[1 + np.argmax(differs)])
        raise TimingError(
            f"{path}, {unit} {line}: {n_different} of {len(t_ns)} {what} samples repeat the stamp before them with "
            "other values; the stamps are too coarse, or this is not the time column",
            code="stamps-too-coarse",
        )
    if n_equal:
        repairs.append(Repair(f"{path.name}: merged {n_equal} repeated {what} rows", code="stamps-repeated"))
    if n_different:
        repairs.append(
            Repair(
                f"{path.name}: averaged {n_different} {what} rows that repeat a stamp with other values",
                code="stamps-repeated",
            )
        )
    merged = values[first]
    mixed = np.unique(group[1:][differs])
    if len(mixed):
        sums = np.zeros_like(merged)
        np.add.at(sums, group, values)
        merged[mixed] = sums[mixed] / np.bincount(group)[mixed, None]
    return t_ns[first], merged


def check_rate(path: Path, what: str, t_ns: NDArray[np.int64]) -> None:
    """Refuse stamps that cannot be in the unit they were read with.

    Raises
    ------
    TimingError
        Where the median interval gives an impossible sampling rate, or a gap is longer than an hour.
    """
    steps = np.diff(t_ns)
    median_s = float(np.median(steps)) * 1e-9
    low, high = RATE_BOUNDS_HZ
    if not 1 / high <= median_s <= 1 / low:
        direction = "smaller" if median_s > 1 / low else "larger"
        raise TimingError(
            f"{path}: {what} samples lie {median_s:.3g} s apart, which no IMU does; the stamps are probably in a "
            f"{direction} unit: set time_unit in capture.toml",
            code="time-unit",
        )
    longest = int(np.argmax(steps))
    if steps[longest] > LONGEST_GAP_NS:
        raise TimingError(
            f"{path}: the {what} pauses for {steps[longest] * 1e-9:.0f} s after {(t_ns[longest] - t_ns[0]) * 1e-9:.3f} "
            "s; a stamp is damaged, or this is more than one recording",
            code="stamps-damaged",
        )
