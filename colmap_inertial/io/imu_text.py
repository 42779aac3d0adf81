"""Inertial recordings in text files: ASL/EuRoC folders, InertialScale folders, CSV with a header, described tables.

For a table that nobody described, messages suggest lines of a capture.toml by its numbers; it is never read by them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import ImuNoise, ImuRecording
from colmap_inertial.io.files import first_line
from colmap_inertial.io.plausible import PLAUSIBLE
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.sensor_yaml import read_imu_noise
from colmap_inertial.io.tables import Table, read_table, recognise
from colmap_inertial.io.units import (
    SENSOR_NAMES,
    SENSOR_UNITS,
    STANDARD_GRAVITY_M_S2,
    TIME_UNITS_NS,
    DeclaredUnits,
    Quantity,
    seconds,
)

#: Steps between readings of an IMU, in seconds; rows that are looked at.
_STEP_S, _ROWS = (2.5e-4, 0.2), 2000


def how_to_describe(table: Table) -> str:
    """The lines of a capture.toml for a table, as its numbers look; "..." stands for what they do not tell."""
    try:
        values = table.numbers(range(table.width))[:_ROWS]
    except FormatError:
        values = np.full((0, table.width), np.nan)
    time, time_unit = _time(values)
    accel, accel_unit = _accel(values, time)
    gyro, gyro_unit = _gyro(values, time, accel)

    def column(i: int | None) -> str:
        if i is None:
            return "..."
        return str(i + 1) if table.header is None else f'"{table.header[i]}"'

    def sensor(first: int | None, unit: str) -> str:
        columns = "..." if first is None else ", ".join(column(first + k) for k in range(3))
        return f'columns = [{columns}], unit = "{unit}"'

    own = f'file = "{table.path.name}", time = {column(time)}, time_unit = "{time_unit}", '
    return (
        f"describe the file in a capture.toml, as its numbers look (check them): [imu.gyro] {own}"
        f"{sensor(gyro, gyro_unit)}; [imu.accel] {own}{sensor(accel, accel_unit)} (each key on a line of its own; "
        "columns by name, or by number from 1; time_unit s, ms, us or ns; unit rad/s or deg/s, m/s2 or g)"
    )


def _time(values: Array) -> tuple[int | None, str]:
    """The first column that never falls, and the unit in which its steps are those of an IMU."""
    if len(values) < 3:
        return None, "..."
    for i, column in enumerate(values.T):
        steps = np.diff(column)
        if not (np.isfinite(steps).all() and (steps >= 0).all() and (steps > 0).any()) or (steps == 1).all():
            continue  # the last is a column that counts the rows
        step = float(np.median(steps[steps > 0]))
        units = [unit for unit, ns in TIME_UNITS_NS.items() if _STEP_S[0] <= step * ns * 1e-9 <= _STEP_S[1]]
        if len(units) == 1:
            return i, units[0]
    return None, "..."


def _triples(values: Array, without: set[int | None]) -> list[int]:
    """First columns of three neighbours that hold numbers which change."""
    changes = np.isfinite(values).all(axis=0) & (np.ptp(values, axis=0) > 0) if len(values) else np.zeros(0, bool)
    usable = [bool(change) and i not in without for i, change in enumerate(changes)]
    return [i for i in range(len(usable) - 2) if all(usable[i : i + 3])]


def _accel(values: Array, time: int | None) -> tuple[int | None, str]:
    """Three columns whose length stays near gravity, and which leave three for the gyroscope where they can."""
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    readings: list[tuple[bool, float, int, str]] = []
    for i in _triples(values, {time}):
        few, median = (float(v) for v in np.percentile(np.linalg.norm(values[:, i : i + 3], axis=1), [5, 50]))
        if few > PLAUSIBLE.steady_share * median:
            others = bool(_triples(values, {time, i, i + 1, i + 2}))
            units = (("m/s2", 1.0), ("g", STANDARD_GRAVITY_M_S2))
            readings += [(others, few / median, i, unit) for unit, factor in units if low <= median * factor <= high]
    if not readings:
        return None, "..."
    _, _, first, unit = max(readings)
    return first, unit


def _gyro(values: Array, time: int | None, accel: int | None) -> tuple[int | None, str]:
    """The first three other columns; in deg/s where they are too large for rad/s."""
    taken = {time} if accel is None else {time, accel, accel + 1, accel + 2}
    triples = _triples(values, taken)
    if accel is None or not triples:
        return None, "..."
    median = float(np.median(np.linalg.norm(values[:, triples[0] : triples[0] + 3], axis=1)))
    return triples[0], "rad/s" if median <= PLAUSIBLE.largest_median_rate_rad_s else "deg/s"


@dataclass(frozen=True, kw_only=True)
class SensorTable:
    """Columns of one sensor in a text table.

    Attributes
    ----------
    file
        The table.
    time, columns
        Columns of the stamps and of x, y, z: names in the header, or numbers counted from 1.
    time_unit, unit
        Of the stamps, and of the samples.
    zero, counts_per_unit
        Of raw counts: what the table says for nothing, and how many make one ``unit``.
    """

    file: Path
    time: str | int
    time_unit: str
    columns: tuple[str | int, str | int, str | int]
    unit: str
    zero: float = 0.0
    counts_per_unit: float = 1.0


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
    """Whether ``path`` is a folder with gyroscope.txt and accelerometer.txt."""
    return (path / "gyroscope.txt").is_file() and (path / "accelerometer.txt").is_file()


def read_inertial_scale_imu(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read ``gyroscope.txt`` and ``accelerometer.txt``: rows ``t_ns x y z``, rad/s and m/s2."""
    if not is_inertial_scale(path):
        raise FormatError(path, "holds no gyroscope.txt and accelerometer.txt")
    gyro, accel = (
        SensorTable(file=path / f"{name}.txt", time=1, time_unit="ns", columns=(2, 3, 4), unit=unit)
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
        raise FormatError(path, "holds no mav0/imu0/data.csv, imu0/data.csv or data.csv")
    if len(tables) > 1:
        folders = ", ".join(str(table.parent.relative_to(path)) for table in tables)
        raise FormatError(path, f"holds several IMUs ({folders}); give the folder of one")
    sheet = tables[0].with_name("sensor.yaml")
    return _read_csv(tables[0], units, read_imu_noise(sheet) if sheet.is_file() else None)


def is_csv(path: Path) -> bool:
    """Whether ``path`` is a text table with a header; :func:`read_csv` says what is wrong with the header."""
    return path.is_file() and path.suffix.lower() in (".csv", ".txt", ".tsv")


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
    table = read_table(path)
    how = how_to_describe(table)
    if table.header is None:
        raise FormatError(path, f"has no header that names its columns; {how}", line=int(table.line_numbers[0]))
    try:
        columns = [recognise(cell) for cell in table.header]
    except ValueError as error:
        raise FormatError(path, f"{error}; {how}") from None
    shown = f"the header is: {table.header_text[:300]}; {how}"
    place: dict[tuple[str, int], int] = {}
    for index, column in enumerate(columns):
        if column is None:
            continue
        key = (column.kind, column.axis)
        if key in place:
            twice = f'"{table.header[place[key]]}" and "{table.header[index]}"'
            raise FormatError(path, f"two columns mean the same: {twice}; {shown}")
        place[key] = index
    wanted = [("time", 0), *((sensor, axis) for sensor in ("gyro", "accel") for axis in range(3))]
    missing = [
        kind if kind == "time" else f"{kind}_{'xyz'[axis]}" for kind, axis in wanted if (kind, axis) not in place
    ]
    if missing:
        raise FormatError(path, f"no column for {', '.join(missing)} was recognised; {shown}")

    def unit(kind: str, axes: int, declared: str | None) -> str:
        stated_units = {columns[place[kind, axis]].unit for axis in range(axes)}  # type: ignore[union-attr]
        if declared is not None:
            return declared
        if len(stated_units) != 1 or None in stated_units:
            names = ", ".join(f'"{table.header[place[kind, axis]]}"' for axis in range(axes))  # type: ignore[index]
            raise FormatError(path, f"no single unit is given for {names}; {shown}")
        return str(stated_units.pop())

    gyro_unit, accel_unit = unit("gyro", 3, units.gyro), unit("accel", 3, units.accel)
    t_ns = table.stamps_ns(place["time", 0], unit("time", 1, None))
    numbers = table.numbers([place[sensor, axis] for sensor in ("gyro", "accel") for axis in range(3)])
    gyro = order_rows(table, "gyro", gyro_unit, t_ns, numbers[:, :3])
    return build_recording(gyro, order_rows(table, "accel", accel_unit, t_ns, numbers[:, 3:]), noise=noise)


def _read_described(source: SensorTable, quantity: Quantity, layout: str | None) -> Samples:
    if source.unit not in SENSOR_UNITS[quantity]:
        raise ValueError(f"{source.unit} is not a unit of the {SENSOR_NAMES[quantity]}")
    table = read_table(source.file)
    if layout is not None:
        table.require_width(layout)
    values = table.numbers([table.column(column) for column in source.columns])
    if source.zero != 0 or source.counts_per_unit != 1:
        values = (values - source.zero) / source.counts_per_unit
    t_ns = table.stamps_ns(table.column(source.time), source.time_unit)
    return order_rows(table, quantity, source.unit, t_ns, values)


def order_rows(table: Table, quantity: Quantity, unit: str, t_ns: Int64Array, values: Array) -> Samples:
    """:func:`order_samples` of a table's rows."""
    samples = order_samples(table.path, quantity, unit, t_ns, values, table.line_numbers)
    return replace(samples, repairs=table.repairs + samples.repairs)


def build_recording(
    gyro: Samples, accel: Samples | None, *, noise: ImuNoise | None = None, device: str = ""
) -> ImuRecording:
    """An :class:`ImuRecording` of ordered samples, its epoch at the first of them."""
    if accel is None:
        accel = Samples(t_ns=np.zeros(0, dtype=np.int64), values=np.zeros((0, 3)), repairs=())
    epoch_ns = int(np.concatenate([gyro.t_ns, accel.t_ns]).min())
    return ImuRecording(
        gyro_t_s=seconds(gyro.t_ns, epoch_ns),
        gyro_rad_s=gyro.values,
        accel_t_s=seconds(accel.t_ns, epoch_ns),
        accel_m_s2=accel.values,
        epoch_ns=epoch_ns,
        repairs=tuple(dict.fromkeys(gyro.repairs + accel.repairs)),
        device=device,
        noise=noise,
    )
