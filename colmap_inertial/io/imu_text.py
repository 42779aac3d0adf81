"""Inertial recordings in text files: ASL/EuRoC folders, InertialScale folders, CSV with a header, described tables.

A table that nobody described is read where its header, or the definition of the export that it is, leaves nothing open.
For others, messages hold the lines of a capture.toml.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ImuNoise, ImuRecording
from colmap_inertial.io.columns import find_sensor, name_words, read_name, recognise_columns
from colmap_inertial.io.descriptions import describe
from colmap_inertial.io.files import first_line, read_bytes
from colmap_inertial.io.interleaved import (
    find_numbered_rows,
    find_rows_of_sensors,
    finds_instances,
    leave_instance_open,
    read_rows,
)
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.sensor_columns import Columns, SensorColumns
from colmap_inertial.io.sensor_yaml import read_imu_noise
from colmap_inertial.io.stamps import TimeColumns, read_stamps
from colmap_inertial.io.tables import Table, parse_bytes, read_table, recognise
from colmap_inertial.io.units import SENSOR_NAMES, SENSOR_UNITS, TIME_UNITS_NS, DeclaredUnits, Quantity, seconds

#: What names of tables end with.
TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".json", ".jsonl", ".ndjson", ".log", ".dat", ".asc")

#: Beginnings of words in names of tables that hold no specific force, or an uncalibrated one beside another.
_OTHER_TABLES = ("linear", "linacc", "grav", "uncal", "user")
#: Tables of a folder that are looked into.
MOST_TABLES = 40


@dataclass(frozen=True, kw_only=True)
class SensorTable:
    """Columns of one sensor in a text table.

    Attributes
    ----------
    file
        The table.
    time
        Where the time stands.
    columns
        Of x, y, z: names in the header, or numbers counted from 1.
    unit
        Of the samples.
    zero, counts_per_unit
        Of raw counts: what the table says for nothing, and how many make one ``unit``.
    where
        Column and value of the rows that are this sensor's; ``None`` for all.
    """

    file: Path
    time: TimeColumns
    columns: tuple[str | int, str | int, str | int]
    unit: str
    zero: float = 0.0
    counts_per_unit: float = 1.0
    where: tuple[str | int, str] | None = None


def read_tables(gyro: SensorTable, accel: SensorTable | None, *, layout: str | None = None) -> ImuRecording:
    """Read an IMU, or a gyroscope alone, from described tables (units converted, axes as in the file).

    Parameters
    ----------
    gyro, accel
        The tables; ``None`` without an accelerometer.
    layout
        Names of all columns, in words, where tables must have as many.

    Raises
    ------
    FormatError, TimingError
        Where a table cannot be read, or lacks a column.
    """
    samples = _read_described(gyro, "gyro", layout)
    return build_recording(samples, None if accel is None else _read_described(accel, "accel", layout))


def is_inertial_scale(path: Path) -> bool:
    """Whether ``path`` is a folder with gyroscope.txt and accelerometer.txt, and no names of columns in them."""
    files = [path / f"{name}.txt" for name in ("gyroscope", "accelerometer")]
    return all(file.is_file() for file in files) and not any(_names_columns(file) for file in files)


def _names_columns(path: Path) -> bool:
    """Whether the first lines name axes, or another unit of time than ours: they state another layout."""
    head = read_bytes(path, 1000).decode("utf-8-sig", errors="replace").splitlines()[:5]
    cells = [read_name(cell.strip(' "')) for line in head for cell in re.split(r"[,;\t]", line.lstrip("# "))]
    if any(cell.kind == "time" and cell.unit in TIME_UNITS_NS and cell.unit != "ns" for cell in cells):
        return True
    return any(re.search(r"\b([agwr]_?|acc\w*|gyr\w*)x\b", line, re.IGNORECASE) for line in head)


def read_inertial_scale_imu(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read ``gyroscope.txt`` and ``accelerometer.txt``: rows ``t_ns x y z``, rad/s and m/s2."""
    if not is_inertial_scale(path):
        raise FormatError(path, Fact("inertial-scale-files-missing"))
    time = TimeColumns(columns=(1,), units=("ns",))
    gyro, accel = (
        SensorTable(file=path / f"{name}.txt", time=time, columns=(2, 3, 4), unit=unit)
        for name, unit in (("gyroscope", units.gyro or "rad/s"), ("accelerometer", units.accel or "m/s2"))
    )
    return read_tables(gyro, accel, layout="t_ns x y z")


def is_euroc(path: Path) -> bool:
    """Whether ``path`` is an ASL dataset root, its mav0, an imu folder, or an imu folder's data.csv."""
    if path.is_file():
        return path.name == "data.csv" and _is_imu_table(path)
    return bool(_imu_tables(path))


def read_euroc(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read an ASL/EuRoC IMU: ``data.csv``, and the noise in ``sensor.yaml`` where there is one.

    Raises
    ------
    FormatError
        Also where a dataset has several IMUs: give the folder of the one that is meant.
    """
    tables = [path] if path.is_file() else _imu_tables(path)
    if not tables:
        raise FormatError(path, Fact("euroc-files-missing"))
    if len(tables) > 1:
        folders = tuple(str(table.parent.relative_to(path)) for table in tables)
        raise FormatError(path, Fact("several-imus", folders=folders))
    sheet = tables[0].with_name("sensor.yaml")
    return _read_csv(tables[0], units, read_imu_noise(sheet) if sheet.is_file() else None)


def is_csv(path: Path) -> bool:
    """Whether ``path`` is a text table with a header; :func:`read_csv` says what is wrong with the header."""
    return path.is_file() and path.suffix.lower() in TABLE_SUFFIXES


def read_csv(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read one CSV whose header names time, gyroscope and accelerometer columns with their units.

    Raises
    ------
    FormatError
        Where a column or unit is missing or unknown; the message shows the header and what to write in capture.toml.
    """
    return _read_csv(path, units, None)


def _imu_tables(folder: Path) -> list[Path]:
    own = folder / "data.csv"
    if own.is_file() and _is_imu_table(own):
        return [own]
    return sorted(path for base in ("mav0", ".") for path in (folder / base).glob("imu*/data.csv") if path.is_file())


def _is_imu_table(path: Path) -> bool:
    """Whether a data.csv is an IMU's (a camera's has file names instead of axes)."""
    return "w_RS_S_x" in first_line(path)


def _read_csv(path: Path, units: DeclaredUnits, noise: ImuNoise | None) -> ImuRecording:
    try:
        table = read_table(path)
    except FormatError as fault:
        rows = find_rows_of_sensors(path)
        if rows is None:
            raise fault
        return _read_columns(path, rows, units, noise, Fact("rows-of-several-sensors"))
    if table.header is None:
        found = find_columns(path, table)
        why = None if found.source else Fact("no-header-of-columns")
        return _read_columns(path, found, units, noise, why, table)
    place, why = _places(table, units)
    if why is not None or len(place) < 7 or finds_instances(table, place.values()):
        return _read_columns(path, find_columns(path, table), units, noise, why, table)

    def unit(kind: str, declared: str | None) -> str:
        found = recognise(table.header[place[kind, 0]])  # type: ignore[index]
        return declared or str(found.unit if found else None)

    gyro_unit, accel_unit = unit("gyro", units.gyro), unit("accel", units.accel)
    time = TimeColumns(columns=(place["time", 0] + 1,), units=(unit("time", None),))
    t_ns, mended = read_stamps(table, time)
    table = replace(table, repairs=(*table.repairs, *mended))
    numbers = table.numbers([place[sensor, axis] for sensor in ("gyro", "accel") for axis in range(3)])
    gyro = order_rows(table, "gyro", gyro_unit, t_ns, numbers[:, :3])
    return build_recording(gyro, order_rows(table, "accel", accel_unit, t_ns, numbers[:, 3:]), noise=noise)


def find_columns(path: Path, table: Table) -> Columns:
    """What a table's columns hold, whether or not its rows are of several sensors or devices."""
    columns = find_rows_of_sensors(path) or recognise_columns(table)
    if columns.gyro.columns is None and columns.accel.columns is None:
        return find_numbered_rows(table) or columns
    return leave_instance_open(table, columns)


def _places(table: Table, units: DeclaredUnits) -> tuple[dict[tuple[str, int], int], Fact | None]:
    """The columns that a plain header names, and what is wrong with what it says of them."""
    assert table.header is not None
    place: dict[tuple[str, int], int] = {}
    try:
        columns = [recognise(cell) for cell in table.header]
    except ValueError as error:
        return place, Fact("invalid-values", detail=str(error))
    for index, column in enumerate(columns):
        if column is None:
            continue
        key = (column.kind, column.axis)
        if key in place:
            return place, Fact("columns-alike", first=table.header[place[key]], second=table.header[index])
        place[key] = index
    wanted = [("time", 0), *((sensor, axis) for sensor in ("gyro", "accel") for axis in range(3))]
    if any(key not in place for key in wanted):
        return place, None
    for kind, axes, declared in (("gyro", 3, units.gyro), ("accel", 3, units.accel), ("time", 1, None)):
        stated = {columns[place[kind, axis]].unit for axis in range(axes)}  # type: ignore[union-attr]
        if declared is None and (None in stated or len(stated) > 1):
            return place, Fact("no-single-unit", columns=[table.header[place[kind, axis]] for axis in range(axes)])
    return place, None


def _read_columns(
    path: Path,
    found: Columns,
    units: DeclaredUnits,
    noise: ImuNoise | None,
    why: Fact | None,
    table: Table | None = None,
) -> ImuRecording:
    """Read what columns were taken for, where nothing is open.

    Raises
    ------
    FormatError
        Where something is; it says what, and how to describe the table.
    """
    gyro, accel = (
        part if declared is None else replace(part, unit=declared, counts_per_unit=1.0)
        for part, declared in ((found.gyro, units.gyro), (found.accel, units.accel))
    )
    found = replace(found, gyro=gyro, accel=accel)
    if not (gyro.is_complete and accel.is_complete and (found.is_sure or not found.source)):
        found = add_other_table(path, found)
        header = None if table is None or table.header is None else table.header_text[:300]
        hint = describe(path, found, table)
        if why is not None:
            raise FormatError(path, Fact("table-unclear", why=why, header=header, hint=hint))
        raise FormatError(
            path, Fact("table-open", source=found.source, open=found.open_points, header=header, hint=hint)
        )
    recording = read_tables(make_sensor_table(path, gyro), make_sensor_table(path, accel))
    gyro_rad_s, accel_m_s2 = (
        Axes.parse(part.axes).apply(values) if part.axes else values
        for part, values in ((gyro, recording.gyro_rad_s), (accel, recording.accel_m_s2))
    )
    device = recording.device or found.source
    return replace(recording, noise=noise, device=device, gyro_rad_s=gyro_rad_s, accel_m_s2=accel_m_s2)


def add_other_table(path: Path, found: Columns) -> Columns:
    """The columns of one sensor, with those of the other in the one table beside it that has them."""
    sensors: tuple[tuple[Quantity, SensorColumns, SensorColumns], ...] = (
        ("gyro", found.gyro, found.accel),
        ("accel", found.accel, found.gyro),
    )
    for name, part, other in sensors:
        if part.columns is None and other.is_complete and other.where is None:
            beside = [file for file in _tables_in(path.parent) if file != path]
            parts = [(file, own) for file in beside if (own := _one_sensor(file, name)) is not None]
            parts = [(file, own) for file, own in parts if own.is_complete]
            if len(parts) == 1:
                file, own = parts[0]
                own = replace(own, file=file.name)
                return replace(found, gyro=own) if name == "gyro" else replace(found, accel=own)
    return found


def _tables_in(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.suffix.lower() in TABLE_SUFFIXES and file.is_file()]
    return sorted(files) if len(files) <= MOST_TABLES else []


def _one_sensor(path: Path, wanted: Quantity) -> SensorColumns | None:
    """The columns of a sensor in a table that has nothing of the other; where its header names no sensor, the name of
    the table does.
    """
    name = name_words(path.stem)
    if any(word.startswith(_OTHER_TABLES) or word == "lin" for word in name):
        return None
    try:
        table = parse_bytes(path, _head(path))
        columns = recognise_columns(table)
    except FormatError:
        return None
    own, other = (columns.gyro, columns.accel) if wanted == "gyro" else (columns.accel, columns.gyro)
    if other.columns is not None:
        return None
    if own.columns is None and table.header is not None and read_name(f"{path.stem} x").kind == wanted:
        own = find_sensor(table, [read_name(cell) for cell in table.header], wanted, ("axis",))
    if own.columns is None:
        return None
    x, y, z = (_header_name(table, column) for column in own.columns)
    return replace(own, names=(x, y, z))


def _header_name(table: Table, column: int) -> str | int:
    name = "" if table.header is None else table.header[column]
    return name if name and (table.header or ()).count(name) == 1 else column + 1


def _head(path: Path) -> bytes:
    """The first rows."""
    head = read_bytes(path, 1 << 16)
    return head if len(head) < 1 << 16 else head[: head.rfind(b"\n") + 1]


def has_separate_tables(path: Path) -> bool:
    """Whether a folder has one table of a gyroscope and one of an accelerometer."""
    return find_separate_tables(path) is not None


def read_separate_tables(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read a folder in which each sensor has a table of its own.

    Raises
    ------
    FormatError
        Where there are not just two, or their headers leave something open.
    """
    found = find_separate_tables(path)
    if found is None:
        raise FormatError(path, Fact("no-separate-tables"))
    gyro, accel = (
        part if unit is None else replace(part, unit=unit)
        for part, unit in ((found.gyro, units.gyro), (found.accel, units.accel))
    )
    found = replace(found, gyro=gyro, accel=accel)
    if found.open_points:
        hint = describe(path, found)
        raise FormatError(path, Fact("table-open", source="", open=found.open_points, header=None, hint=hint))
    return read_tables(make_sensor_table(path / gyro.file, gyro), make_sensor_table(path / accel.file, accel))


def find_separate_tables(folder: Path) -> Columns | None:
    """The columns of the one table of a gyroscope and the one of an accelerometer in a folder; those that say all
    before others.
    """
    if not folder.is_dir():
        return None
    found: dict[Quantity, SensorColumns] = {}
    quantities: tuple[Quantity, ...] = ("gyro", "accel")
    for quantity in quantities:
        parts = [(file, part) for file in _tables_in(folder) if (part := _one_sensor(file, quantity)) is not None]
        whole = [(file, part) for file, part in parts if part.is_complete]
        parts = whole or parts
        if len(parts) != 1:
            return None
        file, part = parts[0]
        found[quantity] = replace(part, file=file.name)
    return Columns(gyro=found["gyro"], accel=found["accel"])


def make_sensor_table(path: Path, part: SensorColumns) -> SensorTable:
    """The description of a sensor whose columns are known."""
    assert part.columns is not None and part.time is not None and part.unit is not None
    x, y, z = (column + 1 for column in part.columns)
    return SensorTable(
        file=path,
        time=part.time,
        columns=(x, y, z),
        unit=part.unit,
        counts_per_unit=part.counts_per_unit or 1.0,
        where=part.where,
    )


def _read_described(source: SensorTable, quantity: Quantity, layout: str | None) -> Samples:
    if source.unit not in SENSOR_UNITS[quantity]:
        raise ValueError(f"{source.unit} is not a unit of the {SENSOR_NAMES[quantity]}")
    table = read_table(source.file) if source.where is None else read_rows(source.file, *source.where)
    if layout is not None:
        table.require_width(layout)
    values = table.numbers([table.column(column) for column in source.columns])
    if source.zero != 0 or source.counts_per_unit != 1:
        values = (values - source.zero) / source.counts_per_unit
    t_ns, mended = read_stamps(table, source.time)
    table = replace(table, repairs=(*table.repairs, *mended))
    return order_rows(table, quantity, source.unit, t_ns, values)


def order_rows(table: Table, quantity: Quantity, unit: str, t_ns: Int64Array, values: Array) -> Samples:
    """:func:`order_samples` of a table's rows."""
    samples = order_samples(table.path, quantity, unit, t_ns, values, table.line_numbers)
    return replace(samples, repairs=table.repairs + samples.repairs)


def build_recording(
    gyro: Samples, accel: Samples | None, *, noise: ImuNoise | None = None, device: str = ""
) -> ImuRecording:
    """An :class:`ImuRecording` of ordered samples, its epoch at the first of them."""
    sensors = (gyro,) if accel is None else (gyro, accel)
    epoch_ns = min(int(sensor.t_ns.min()) for sensor in sensors)
    return ImuRecording(
        gyro_t_s=seconds(gyro.t_ns, epoch_ns),
        gyro_rad_s=gyro.values,
        accel_t_s=np.zeros(0) if accel is None else seconds(accel.t_ns, epoch_ns),
        accel_m_s2=np.zeros((0, 3)) if accel is None else accel.values,
        epoch_ns=epoch_ns,
        repairs=tuple(dict.fromkeys(repair for sensor in sensors for repair in sensor.repairs)),
        device=device,
        noise=noise,
    )
