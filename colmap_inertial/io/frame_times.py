"""Exposure times of frames from file names, CSV files, or a recorder's log; never from an index and a frame rate."""

from __future__ import annotations

import datetime
import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, FrameTiming
from colmap_inertial.io.files import reader
from colmap_inertial.io.images import SUFFIXES
from colmap_inertial.io.tables import Table, read_table, recognise, split_unit
from colmap_inertial.io.units import TIME_UNITS_NS, seconds, stamps_ns, unit_of

_NAME_COLUMNS = {"name", "filename", "file", "image", "imagename", "frame"}
_EXPOSURE_COLUMNS = {"exposure", "exposuretime"}
#: Images of a rig are of one moment up to here: at 1 m/s and 1 rad/s, 1 mm and 1 mrad.
SAME_MOMENT_NS = 1_000_000
#: No image stands for others.
NO_RIGS: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameStamps:
    """Names and exact times of frames, in order of time.

    Attributes
    ----------
    t_ns
        (F,) start of exposure of row 0.
    exposure_s
        (F,) where known.
    source
        Where they come from.
    """

    names: tuple[str, ...]
    t_ns: Int64Array
    exposure_s: Array | None = None
    source: Path | None = None

    def timing(self, *, exposure_s: float | None = None, readout_s: float | None = None) -> FrameTiming:
        """As a :class:`FrameTiming`; ``exposure_s`` is used where the stamps have none.

        Raises
        ------
        TimingError
            Where two frames have one time.
        """
        same = np.flatnonzero(np.diff(self.t_ns) == 0)
        if len(same):
            raise TimingError(
                Fact(
                    "frames-at-one-time",
                    source=str(self.source),
                    first=self.names[same[0]],
                    second=self.names[same[0] + 1],
                )
            )
        exposures = self.exposure_s
        if exposures is None and exposure_s is not None:
            exposures = np.full(len(self.names), exposure_s)
        epoch_ns = int(self.t_ns[0])
        return FrameTiming(
            names=self.names,
            t_s=seconds(self.t_ns, epoch_ns),
            exposure_s=exposures,
            readout_s=readout_s,
            epoch_ns=epoch_ns,
        )

    def one_per_frame(self, first_of: Mapping[str, str]) -> FrameStamps:
        """The table with one image for each frame of a rig.

        Parameters
        ----------
        first_of
            By image name, the image that stands for its frame; other images are left out. Empty where there is no rig.

        Raises
        ------
        TimingError
            Where images of a frame were taken at different times.
        """
        if not first_of:
            return self
        places: dict[str, list[int]] = {}
        for place, name in enumerate(self.names):
            if name in first_of:
                places.setdefault(first_of[name], []).append(place)
        for own in places.values():
            apart_ns = int(self.t_ns[own[-1]] - self.t_ns[own[0]])
            if apart_ns > SAME_MOMENT_NS:
                raise TimingError(
                    Fact(
                        "rig-images-apart",
                        source=str(self.source),
                        first=self.names[own[0]],
                        last=self.names[own[-1]],
                        apart_ms=apart_ns / 1e6,
                    )
                )
        kept = sorted(next((p for p in own if self.names[p] == first), own[0]) for first, own in places.items())
        return FrameStamps(
            names=tuple(self.names[place] for place in kept),
            t_ns=self.t_ns[kept],
            exposure_s=None if self.exposure_s is None else self.exposure_s[kept],
            source=self.source,
        )


@reader("frame times")
def stamps_of_csv(path: Path, time_unit: str | None = None) -> FrameStamps:
    """Read ``name,t_s`` (or ``t_ns``, or EuRoC's ``#timestamp [ns],filename``), optionally with ``exposure_s``.

    Parameters
    ----------
    time_unit
        Used where the header does not say; a header that says otherwise is an error.

    Raises
    ------
    FormatError, TimingError
        Where columns or the unit are missing, or a name comes twice.
    """
    table = read_table(path)
    if table.header is None:
        raise TimingError(Fact("times-without-header", path=str(path)))
    flat = [re.sub(r"[\s_]", "", split_unit(cell)[0]).lower() for cell in table.header]
    name_column = next((i for i, name in enumerate(flat) if name in _NAME_COLUMNS), None)
    if name_column is None:
        raise TimingError(Fact("times-without-names", path=str(path), header=table.header_text[:200]))
    t_ns = _time_column(table, time_unit)
    exposure_column = next((i for i, name in enumerate(flat) if name in _EXPOSURE_COLUMNS), None)
    exposure_s = None if exposure_column is None else _exposures(table, exposure_column)
    return stamps_in_order(path, table.text(name_column), t_ns, table.line_numbers, exposure_s)


@reader("pictures named by their times")
def stamps_of_names(folder: Path, names: Sequence[str], unit: str) -> FrameStamps:
    """Take each frame's time from the number in its file name.

    Parameters
    ----------
    names
        File names; the longest number in each (without folder and ending) is its time. A decimal point is allowed.
    unit
        Of the numbers.

    Raises
    ------
    TimingError
        For a name without a number, or with two that could be it.
    """
    tokens = []
    for name in names:
        numbers = re.findall(r"\d+(?:\.\d+)?", Path(name).stem)
        longest = [token for token in numbers if len(token) == max(map(len, numbers))]
        if len(longest) != 1:
            raise TimingError(Fact("name-without-one-time", path=str(folder / name), numbers=longest))
        tokens.append(longest[0])
    return stamps_in_order(folder, list(names), stamps_ns(folder, tokens, unit))


def stamps_of_pattern(folder: Path, names: Sequence[str], pattern: str) -> FrameStamps:
    """Take each frame's time from its file name, as a pattern describes it.

    Parameters
    ----------
    names
        File names; the ending does not count.
    pattern
        A unit (s, ms, us, ns): the longest number is the time. Or a name with the unit in braces where the number
        stands and ``*`` where anything may, as ``cam0_{ns}_*``. Or a date as ``strptime`` has it, with a fraction of
        the second, as ``PXL_%Y%m%d_%H%M%S%f``. With a folder, as in ``cam0/{ns}``, images elsewhere get no time.

    Raises
    ------
    TimingError
        For a pattern that is none of these, and a name that does not fit it.
    """
    within, _, pattern = pattern.rpartition("/")
    if within:
        names = [name for name in names if fnmatch.fnmatchcase(Path(name).parent.as_posix(), within)]
        if not names:
            raise TimingError(Fact("no-image-in-folder", path=str(folder), folder=within))
    if Path(pattern).suffix.lower() in SUFFIXES:
        pattern = pattern[: pattern.rindex(".")]
    if pattern in TIME_UNITS_NS:
        return stamps_of_names(folder, names, pattern)
    units = re.findall(r"\{(\w+)\}", pattern)
    if len(units) == 1 and units[0] in TIME_UNITS_NS and "%" not in pattern:
        before, after = (".*".join(map(re.escape, part.split("*"))) for part in pattern.split(f"{{{units[0]}}}"))
        tokens = []
        for name in names:
            match = re.fullmatch(rf"{before}(\d+(?:\.\d+)?){after}", Path(name).stem)
            if match is None:
                raise TimingError(Fact("name-fits-no-pattern", path=str(folder / name), pattern=pattern))
            tokens.append(match[1])
        return stamps_in_order(folder, list(names), stamps_ns(folder, tokens, units[0]))
    if "%f" in pattern and ("%d" in pattern or "%j" in pattern):
        return stamps_in_order(folder, list(names), np.array([_date_ns(folder / n, pattern) for n in names]))
    raise TimingError(Fact("pattern-without-time", pattern=pattern, units=tuple(TIME_UNITS_NS)))


def _date_ns(path: Path, pattern: str) -> int:
    try:
        date = datetime.datetime.strptime(path.stem, pattern)
    except ValueError:
        raise TimingError(Fact("name-fits-no-pattern", path=str(path), pattern=pattern)) from None
    since = date.replace(tzinfo=datetime.UTC) - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return since // datetime.timedelta(microseconds=1) * 1000


@reader("frame times")
def stamps_of_log(path: Path, time_unit: str | None = None) -> Int64Array:
    """Read a recorder's frame times, one row for each frame of its video, in order.

    A header names the time column and its unit; without one the file must have one column, in ``time_unit``.
    """
    table = read_table(path)
    if table.header is not None:
        return _time_column(table, time_unit)
    if table.width != 1:
        raise TimingError(Fact("frame-times-without-header", path=str(path), width=table.width))
    return table.stamps_ns(0, _require_unit(path, None, time_unit))


def frame_log(path: Path, frame_ns: Int64Array, **noted: Any) -> FrameLog:
    """The log of frames with these times, on the IMU's clock; ``noted`` are its other fields.

    Raises
    ------
    FormatError
        Where the times do not increase.
    """
    bad = np.flatnonzero(np.diff(frame_ns) <= 0)
    if len(bad):
        raise FormatError(path, Fact("frame-time-not-after", frame=int(bad[0] + 2)))
    epoch_ns = int(frame_ns[0])
    return FrameLog(t_s=seconds(frame_ns, epoch_ns), epoch_ns=epoch_ns, shared_clock=True, **noted)


def _time_column(table: Table, declared: str | None) -> Int64Array:
    assert table.header is not None
    try:
        columns = [recognise(cell) for cell in table.header]
    except ValueError as error:
        raise FormatError(table.path, Fact("invalid-values", detail=str(error))) from None
    times = [i for i, column in enumerate(columns) if column is not None and column.kind == "time"]
    if len(times) != 1:
        header = table.header_text[:200]
        raise TimingError(Fact("not-one-time-column", path=str(table.path), count=len(times), header=header))
    column = columns[times[0]]
    assert column is not None
    return table.stamps_ns(times[0], _require_unit(table.path, column.unit, declared))


def _require_unit(path: Path, written: str | None, declared: str | None) -> str:
    if written is not None and declared is not None and written != declared:
        raise TimingError(Fact("time-units-contradict", path=str(path), written=written, declared=declared))
    unit = written or declared
    if unit is None:
        raise TimingError(Fact("time-unit-missing", path=str(path)))
    return unit


def _exposures(table: Table, column: int) -> Array:
    assert table.header is not None
    unit = unit_of(split_unit(table.header[column])[1] or "")
    if unit not in TIME_UNITS_NS:
        raise FormatError(table.path, Fact("exposure-without-unit", column=table.header[column]))
    values = table.numbers([column])[:, 0] * (TIME_UNITS_NS[unit] / 1e9)
    bad = np.flatnonzero(~((values >= 0) & (values < 10)))
    if len(bad):
        raise FormatError(table.path, Fact("exposure-not-in-range"), line=int(table.line_numbers[bad[0]]))
    return values


def stamps_in_order(
    path: Path,
    names: list[str],
    t_ns: Int64Array,
    line_numbers: Int64Array | None = None,
    exposure_s: Array | None = None,
) -> FrameStamps:
    """Stamps sorted by time; a name that comes twice is an error of ``path``."""
    seen: dict[str, int] = {}
    for i, name in enumerate(names):
        line = None if line_numbers is None else int(line_numbers[i])
        if not name:
            raise FormatError(path, Fact("row-without-name"), line=line)
        if name in seen:
            raise FormatError(path, Fact("frame-twice", frame=name[:80]), line=line)
        seen[name] = i
    order = np.argsort(t_ns, kind="stable")
    t_ns = t_ns[order]
    names = [names[i] for i in order]
    exposures = None if exposure_s is None else exposure_s[order]
    return FrameStamps(names=tuple(names), t_ns=t_ns, exposure_s=exposures, source=path)
