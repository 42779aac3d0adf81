"""Putting stamped samples in order: what is harmless is repaired and listed, what is not is an error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, IndexArray, Int64Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.units import SENSOR_NAMES, Quantity, convert_to_si


@dataclass(frozen=True, kw_only=True)
class SampleLimits:
    """Limits for repairing or refusing a recording."""

    #: A sample this far behind the newest one before it means that the clock was set back, not that rows changed
    #: places.
    latest_arrival_ns: int = 500_000_000
    #: Share of samples that may be missing (NaN) or stamped twice with different values.
    harmless_share: float = 0.05
    #: Other sampling rates mean a wrong time unit: no phone, camera or drone IMU is slower or faster.
    lowest_rate_hz: float = 4.0
    #: Other sampling rates mean a wrong time unit: no phone, camera or drone IMU is slower or faster.
    highest_rate_hz: float = 20_000.0
    #: No unit makes a reading of a working sensor larger; a larger one is damage.
    largest_reading: float = 1e9
    #: A pause this long within one recording means a broken stamp.
    longest_gap_ns: int = 3_600_000_000_000


LIMITS = SampleLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Samples of one sensor, and how messages name them.

    Attributes
    ----------
    path, sensor
        The file and the sensor.
    counted, numbers
        ``"line"`` of the file or ``"sample"``, and (N,) which one each is.
    t_ns
        (N,) stamps; strictly increasing once they are ordered.
    values
        (N, 3) readings; finite once they are ordered.
    repairs
        What was sorted, merged or dropped.
    """

    path: Path
    sensor: str
    counted: str
    numbers: Int64Array
    t_ns: Int64Array
    values: Array
    repairs: tuple[Fact, ...] = ()

    def select(self, chosen: NDArray[np.bool_ | np.intp]) -> Samples:
        """Some of the samples, or all in another order."""
        return replace(self, numbers=self.numbers[chosen], t_ns=self.t_ns[chosen], values=self.values[chosen])

    def add_repair(self, code: str, **values: object) -> Samples:
        """The samples with a repair of theirs, whose other values are the file and the sensor."""
        repair = Fact(code, file=self.path.name, sensor=self.sensor, **values)
        return replace(self, repairs=(*self.repairs, repair))

    def timing_error(self, code: str, at: int | None = None, **values: object) -> TimingError:
        """The error for stamps that cannot be repaired, at a sample where there is one to look at."""
        place = {} if at is None else {"counted": self.counted, "number": self.numbers[at]}
        return refuse_stamps(Fact(code, path=str(self.path), sensor=self.sensor, **place, **values))


def order_samples(
    path: Path,
    quantity: Quantity,
    unit: str,
    t_ns: Int64Array,
    values: Array,
    line_numbers: Int64Array | None = None,
) -> Samples:
    """Samples in SI units; sort, merge and drop what is harmless.

    Rows without a sample, and a few with missing values, are dropped; rows up to half a second late are sorted in; rows
    that repeat a stamp are merged (equal values) or averaged (different ones). Each is listed.

    Parameters
    ----------
    path
        The file, for messages.
    quantity, unit
        The sensor, and the unit of the values.
    t_ns, values, line_numbers
        (N,), (N, 3), (N,) rows as they stand in the file; without line numbers, samples are counted.

    Raises
    ------
    FormatError
        For too many missing values or fewer than two samples.
    TimingError
        For stamps that run backwards, jump back, repeat often, or cannot be in the stated unit.
    """
    samples = Samples(
        path=path,
        sensor=SENSOR_NAMES[quantity],
        counted="sample" if line_numbers is None else "line",
        numbers=np.arange(1, len(t_ns) + 1) if line_numbers is None else line_numbers,
        t_ns=t_ns,
        values=convert_to_si(values, quantity, unit),
    )
    samples = _drop_incomplete(samples)
    samples = _sort(samples)
    samples = _merge_repeated(samples)
    check_rate(path, samples.sensor, samples.t_ns)
    return samples


def refuse_stamps(fact: Fact) -> TimingError:
    """The error for stamps, whose sentence says by itself what to do."""
    return TimingError(fact, shown=str(fact))


def _drop_incomplete(samples: Samples) -> Samples:
    """The rows that hold a sample."""
    # Loggers that write sensors of different rates to one table leave the cells of the others empty.
    absent = np.asarray(np.isnan(samples.values).all(axis=1))
    if absent.any():
        samples = samples.select(~absent).add_repair("rows-without-sample", count=absent.sum(), rows=len(absent))
    finite = np.asarray((np.abs(samples.values) < LIMITS.largest_reading).all(axis=1))
    if not finite.all():
        missing, first = int((~finite).sum()), int(samples.numbers[np.argmin(finite)])
        if missing > LIMITS.harmless_share * len(finite):
            lacking = Fact("rows-lack-values", count=missing, rows=len(finite), sensor=samples.sensor)
            raise FormatError(samples.path, lacking, line=first if samples.counted == "line" else None)
        samples = samples.select(finite)
        samples = samples.add_repair("rows-without-value", count=missing, counted=samples.counted, first=first)
    if len(samples.t_ns) < 2:
        raise FormatError(samples.path, Fact("too-few-samples", count=len(samples.t_ns), sensor=samples.sensor))
    return samples


def _sort(samples: Samples) -> Samples:
    """The samples in order of time."""
    late_ns = np.maximum.accumulate(samples.t_ns) - samples.t_ns
    if not late_ns.any():
        return samples
    if (np.diff(samples.t_ns) < 0).mean() > 0.5:
        raise samples.timing_error("stamps-reversed")
    if late_ns.max() > LIMITS.latest_arrival_ns:
        first = int(np.argmax(late_ns > LIMITS.latest_arrival_ns))
        raise samples.timing_error("stamps-jump-back", first, behind_s=late_ns[first] * 1e-9)
    return samples.select(np.argsort(samples.t_ns, kind="stable")).add_repair("rows-sorted", count=np.sum(late_ns > 0))


def _merge_repeated(samples: Samples) -> Samples:
    """One sample for each stamp: the average of those that have it."""
    same = np.diff(samples.t_ns) == 0
    if not same.any():
        return samples
    differs = same & (samples.values[1:] != samples.values[:-1]).any(axis=1)
    n_equal, n_different = int((same & ~differs).sum()), int(differs.sum())
    if n_different > LIMITS.harmless_share * len(samples.t_ns):
        first_off = 1 + int(np.argmax(differs))
        raise samples.timing_error("stamps-too-coarse", first_off, repeated=n_different, samples=len(samples.t_ns))
    group = np.concatenate([[0], np.cumsum(~same)])
    first = np.concatenate([[0], np.flatnonzero(~same) + 1])
    if len(first) < 2:
        raise TimingError(Fact("one-stamp-for-all", path=str(samples.path), sensor=samples.sensor))
    values = samples.values[first]
    mixed = np.unique(group[1:][differs])
    if len(mixed):
        sums = np.zeros_like(values)
        np.add.at(sums, group, samples.values)
        values[mixed] = sums[mixed] / np.bincount(group)[mixed, None]
    samples = replace(samples, numbers=samples.numbers[first], t_ns=samples.t_ns[first], values=values)
    for code, count in (("rows-merged", n_equal), ("rows-averaged", n_different)):
        if count:
            samples = samples.add_repair(code, count=count)
    return samples


def nearest(t_ns: Int64Array, at_ns: Int64Array) -> IndexArray:
    """(M,) which of the increasing times (N,) is nearest to each of (M,) others."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, len(t_ns) - 1)
    return np.where(at_ns - t_ns[after - 1] < t_ns[after] - at_ns, after - 1, after)


def check_rate(path: Path, what: str, t_ns: Int64Array) -> None:
    """Refuse stamps that cannot be in the unit they were read with.

    Raises
    ------
    TimingError
        Where the median interval gives an impossible sampling rate, or a gap is longer than an hour.
    """
    steps = np.diff(t_ns)
    median_s = float(np.median(steps)) * 1e-9
    if not 1 / LIMITS.highest_rate_hz <= median_s <= 1 / LIMITS.lowest_rate_hz:
        slowest_s = 1 / LIMITS.lowest_rate_hz
        raise refuse_stamps(Fact("time-unit", path=str(path), sensor=what, step_s=median_s, slowest_s=slowest_s))
    longest = int(np.argmax(steps))
    if steps[longest] > LIMITS.longest_gap_ns:
        after_s = (t_ns[longest] - t_ns[0]) * 1e-9
        pause_s = steps[longest] * 1e-9
        raise refuse_stamps(Fact("stamps-damaged", path=str(path), sensor=what, pause_s=pause_s, after_s=after_s))
