"""What a table was taken for: each column with its mean, scatter and rate, and the capture.toml that says so."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.io.columns import read_name
from colmap_inertial.io.descriptions import describe
from colmap_inertial.io.imu_formats import find_imu_format
from colmap_inertial.io.imu_text import TABLE_SUFFIXES, add_other_table, find_columns, find_separate_tables, is_csv
from colmap_inertial.io.interleaved import find_rows_of_sensors, read_rows
from colmap_inertial.io.sensor_columns import OPEN, Columns, SensorColumns
from colmap_inertial.io.stamps import TimeColumns, read_stamps
from colmap_inertial.io.tables import Table, read_table


@dataclass(frozen=True, kw_only=True)
class ColumnReport:
    """One column.

    Attributes
    ----------
    number, name
        From 1; empty without a header.
    kind
        What it was taken for: ``time``, ``gyro``, ``accel``, ``linear``, ``gravity``, ``axis``, ``other``.
    unit
        As the header or the export's definition says; empty where neither does.
    mean, scatter
        Mean and standard deviation as they stand in the file; ``None`` of words.
    rate_hz
        Values in a second, of the columns of a sensor whose time is known.
    """

    number: int
    name: str
    kind: str
    unit: str
    mean: float | None
    scatter: float | None
    rate_hz: float | None


@dataclass(frozen=True, kw_only=True)
class TableReport:
    """What a table was taken for.

    Attributes
    ----------
    path
        The table.
    found
        What is unusual about the way in which it is written.
    columns
        All of its columns.
    why
        What this rests on.
    is_open
        Whether something has to be filled in before it can be read.
    toml
        The lines of a capture.toml.
    """

    path: Path
    found: tuple[str, ...]
    columns: tuple[ColumnReport, ...]
    why: tuple[str, ...]
    is_open: bool
    toml: str


def report_table(path: Path, folder: Path | None = None) -> TableReport | None:
    """What a table was taken for; ``None`` for what is no table of numbers, or a recorder's own.

    Parameters
    ----------
    folder
        Where the capture.toml is to lie; beside the table if not given.
    """
    if path.is_dir():
        return _report_folder(path, folder)
    if not path.is_file() or path.suffix.lower() not in TABLE_SUFFIXES:
        return None
    try:
        if not is_csv(path) or find_imu_format(path).name != "csv":
            return None
        table: Table | None = read_table(path)
    except InertialError:
        table = None
    try:
        found = find_rows_of_sensors(path) if table is None else find_columns(path, table)
        if found is None:
            return None
        columns = tuple(_columns(path, found, table))
    except (FormatError, TimingError):
        return None
    described = _seen_from(folder, path, add_other_table(path, found))
    named = path.name if folder is None else os.path.relpath(path, folder)
    plain = table if found.gyro.where is None else None
    return TableReport(
        path=path,
        found=() if table is None else table.found,
        columns=columns,
        why=found.why,
        is_open=bool(described.open_points),
        toml=describe(path, described, plain, named) + "\n",
    )


def _report_folder(path: Path, folder: Path | None) -> TableReport | None:
    """The report of a folder in which each sensor has a table of its own, where these leave something open."""
    try:
        if find_imu_format(path).name != "tables":
            return None
    except FormatError:
        return None
    found = find_separate_tables(path)
    if found is None:
        return None
    columns: list[ColumnReport] = []
    try:
        for part, alone in (
            (found.gyro, replace(found, accel=SensorColumns())),
            (found.accel, replace(found, gyro=SensorColumns())),
        ):
            table = read_table(path / part.file)
            kinds = tuple(read_name(name).kind for name in table.header or ())
            columns += _report_columns(replace(alone, kinds=kinds), table)
    except (FormatError, TimingError):
        return None
    described = _seen_from(folder or path, path / found.gyro.file, found)
    return TableReport(
        path=path,
        found=(),
        columns=tuple(columns),
        why=(),
        is_open=bool(found.open_points),
        toml=describe(path, described) + "\n",
    )


def _seen_from(folder: Path | None, path: Path, found: Columns) -> Columns:
    """The same, with the other table's path from the folder of the capture.toml."""
    if folder is None:
        return found
    gyro, accel = (
        replace(part, file=os.path.relpath(path.parent / part.file, folder)) if part.file else part
        for part in (found.gyro, found.accel)
    )
    return replace(found, gyro=gyro, accel=accel)


def _columns(path: Path, found: Columns, table: Table | None) -> Iterator[ColumnReport]:
    open_rows = found.gyro.where is not None and found.gyro.where[1] == OPEN
    if (found.gyro.where is None or open_rows) and table is not None:
        yield from _report_columns(found, table)
        return
    for kind, part in (("gyro", found.gyro), ("accel", found.accel)):
        if part.where is None:
            continue
        rows = read_rows(path, *part.where)
        kinds = [read_name(name).kind for name in rows.header or ()] or ["other"] * rows.width
        for index in part.columns or ():
            kinds[index] = kind
        alone = Columns(
            gyro=part if kind == "gyro" else SensorColumns(),
            accel=part if kind == "accel" else SensorColumns(),
            kinds=tuple(kinds),
        )
        yield from _report_columns(alone, rows)


def _report_columns(found: Columns, table: Table) -> Iterator[ColumnReport]:
    kinds = [f"{kind} (not taken)" if kind in ("time", "gyro", "accel") else kind for kind in found.kinds]
    kinds = kinds or ["other"] * table.width
    units = ["" if table.header is None else read_name(name).unit or "" for name in table.header or [""] * table.width]
    rates: list[float | None] = [None] * table.width
    for quantity, part in (("gyro", found.gyro), ("accel", found.accel)):
        for column in () if part.time is None or part.columns is None else part.time.columns:
            index = table.column(column)
            kinds[index], units[index] = "time", _unit_of_stamp(table, part.time, index)
        for index in part.columns or ():
            counts = "" if part.counts_per_unit in (None, 1.0) else f"1/{part.counts_per_unit:g} "
            kinds[index], units[index] = quantity, f"{counts}{part.unit}" if part.unit else ""
            rates[index] = _rate(table, part)
    for index in range(table.width):
        mean, scatter = _statistics(table, index)
        yield ColumnReport(
            number=index + 1,
            name="" if table.header is None else table.header[index],
            kind=kinds[index],
            unit=units[index],
            mean=mean,
            scatter=scatter,
            rate_hz=rates[index],
        )


def _unit_of_stamp(table: Table, time: TimeColumns | None, index: int) -> str:
    if time is None:
        return ""
    if time.counts_per_second is not None:
        return f"1/{time.counts_per_second:g} s"
    units = time.units if len(time.units) == len(time.columns) else time.units * len(time.columns)
    return next((u for c, u in zip(time.columns, units, strict=False) if table.column(c) == index), "")


def _statistics(table: Table, index: int) -> tuple[float | None, float | None]:
    try:
        values = table.numbers([index])[:, 0]
    except FormatError:
        return None, None
    values = values[np.isfinite(values)]
    return (float(values.mean()), float(values.std())) if len(values) else (None, None)


def _rate(table: Table, part: SensorColumns) -> float | None:
    """Rows in a second."""
    if part.time is None or not (part.time.units or part.time.rate_hz or part.time.counts_per_second):
        return None
    try:
        t_ns, _ = read_stamps(table, part.time)
    except (FormatError, TimingError):
        return None
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return 1e9 / float(np.median(steps)) if len(steps) else None
