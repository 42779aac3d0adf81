"""The ``[imu]`` table of a capture.toml for a text table, as far as the table says: open values are ``"?"``, with what
they may be beside them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.columns import read_name
from colmap_inertial.io.plausible import PLAUSIBLE
from colmap_inertial.io.sensor_columns import OPEN, ROWS, Columns, SensorColumns
from colmap_inertial.io.stamps import TimeColumns
from colmap_inertial.io.units import SENSOR_UNITS, STANDARD_GRAVITY_M_S2, TIME_UNITS_NS, Quantity

if TYPE_CHECKING:
    from colmap_inertial.io.tables import Table

#: Steps between readings of an IMU, in seconds.
_STEP_S = (2.5e-4, 0.2)


def describe(path: Path, found: Columns, table: Table | None = None, name: str = "") -> str:
    """The lines of a capture.toml: ``[imu.gyro]`` and ``[imu.accel]``.

    Parameters
    ----------
    name
        Of the table, seen from the folder of the capture.toml; by default that beside it.
    """
    name = name or path.name
    gyro, accel, guessed = found.gyro, found.accel, False
    if table is not None and table.header is None and gyro.columns is None and gyro.where is None:
        gyro, accel = _propose_columns(table)
        guessed = True
    elif table is not None and (gyro.time is None or accel.time is None) and gyro.where is None:
        gyro, accel = _add_time(table, gyro), _add_time(table, accel)
    lines = [] if not found.source else [f"# by the definition of {found.source}"]
    if guessed:
        lines.append("# columns as their numbers look: check them")
    parts: tuple[tuple[Quantity, SensorColumns], ...] = (("gyro", gyro), ("accel", accel))
    for quantity, part in parts:
        lines += _section(name, quantity, part, table)
    return "\n".join(lines)


def _section(name: str, quantity: Quantity, part: SensorColumns, table: Table | None) -> list[str]:
    lines = [
        f"[imu.{quantity}]",
        f"file = {_text(part.file or name)}",
        *_time_lines(part.time, None if part.file else table),
    ]
    if part.where is not None:
        which = f"  # {part.about}" if part.where[1] == OPEN else ""
        lines.append(f"where = [{_column(part.where[0])}, {_text(part.where[1])}]{which}")
    if part.columns is None:
        about = f"; {part.about}" if part.about else ""
        lines.append(f'columns = ["{OPEN}", "{OPEN}", "{OPEN}"]  # names, or numbers from 1, of x, y, z{about}')
    else:
        names = ", ".join(map(_column, part.names or [_name(table, column) for column in part.columns]))
        other = f"  # or {', '.join(part.others)}" if part.others else ""
        lines.append(f"columns = [{names}]{other}")
    units = " or ".join(SENSOR_UNITS[quantity])
    about = (
        f": {part.about}"
        if part.about and part.where is None and part.columns is not None
        else ": the file does not say"
    )
    lines.append(f"unit = {_text(part.unit)}" if part.unit else f'unit = "{OPEN}"  # {units}{about}')
    if part.counts_per_unit is None:
        lines.append(f'counts_per_unit = "{OPEN}"  # {part.about or "the file does not say"}')
    elif part.counts_per_unit != 1:
        lines.append(f"counts_per_unit = {part.counts_per_unit:g}")
    if part.axes == OPEN:
        lines.append(f'axes = "{OPEN}"  # {part.about}')
    elif part.axes:
        lines.append(f"axes = {_text(part.axes)}")
        if Axes.parse(part.axes).is_mirrored:
            lines.append("mirrored = true")
    return lines


def _time_lines(time: TimeColumns | None, table: Table | None) -> list[str]:
    if time is None:
        return [
            f'time = "{OPEN}"  # name or number of a column; or rate_hz = ... in place of time and time_unit',
            f'time_unit = "{OPEN}"  # {", ".join(TIME_UNITS_NS)}, or date',
        ]
    if time.rate_hz is not None:
        return [f"rate_hz = {time.rate_hz:g}"]
    columns = ", ".join(map(_column, time.columns))
    lines = [f"time = {columns if len(time.columns) == 1 else f'[{columns}]'}"]
    if time.counts_per_second is not None:
        return [*lines, f"time_counts_per_s = {time.counts_per_second:g}"]
    if not time.units:
        return [*lines, f'time_unit = "{OPEN}"  # {_likely_units(time, table)}']
    units = ", ".join(map(_text, time.units))
    return [*lines, f"time_unit = {units if len(time.units) == 1 else f'[{units}]'}"]


def _likely_units(time: TimeColumns, table: Table | None) -> str:
    """Units in which the steps are those of an IMU."""
    every = f"{', '.join(TIME_UNITS_NS)}, or time_counts_per_s = ... in its place"
    if table is None:
        return f"{every}: the file does not say"
    try:
        values = table.numbers([table.column(time.columns[0])])[:ROWS, 0]
    except FormatError:
        return f"{every}: the file does not say"
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    likely = [unit for unit, ns in TIME_UNITS_NS.items() if _STEP_S[0] <= step * ns * 1e-9 <= _STEP_S[1]]
    rates = [f"{unit} would be {1e9 / (step * TIME_UNITS_NS[unit]):.4g} Hz" for unit in likely]
    return f"{every}: the file does not say" + (f"; {', '.join(rates)}" if rates else "")


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _column(value: str | int) -> str:
    return str(value) if isinstance(value, int) else _text(value)


def _name(table: Table | None, index: int) -> str | int:
    header = None if table is None else table.header
    if header is None or not header[index] or header.count(header[index]) > 1:
        return index + 1
    return header[index]


# --- by numbers: places alone, never units ----------------------------------------------------------------------------


def _values(table: Table) -> Array:
    out = np.full((min(len(table), ROWS), table.width), np.nan)
    for column in range(table.width):
        try:
            out[:, column] = table.numbers([column])[:ROWS, 0]
        except FormatError:
            continue
    return out


def _add_time(table: Table, part: SensorColumns) -> SensorColumns:
    if part.time is not None:
        return part
    place = _time(_values(table))
    if place is None:
        return part
    said = read_name(table.header[place]).unit if table.header is not None else None
    return replace(
        part, time=TimeColumns(columns=(_name(table, place),), units=(said,) if said in TIME_UNITS_NS else ())
    )


def _propose_columns(table: Table) -> tuple[SensorColumns, SensorColumns]:
    values = _values(table)
    place = _time(values)
    time = None if place is None else TimeColumns(columns=(place + 1,))
    accel = _accel(values, place)
    gyro = _gyro(values, place, accel)

    def part(first: int | None) -> SensorColumns:
        return SensorColumns(columns=None if first is None else (first, first + 1, first + 2), time=time)

    return part(gyro), part(accel)


def _time(values: Array) -> int | None:
    """The first column that never falls, of steps that are those of an IMU in some unit."""
    if len(values) < 3:
        return None
    for i, column in enumerate(values.T):
        steps = np.diff(column)
        if not (np.isfinite(steps).all() and (steps >= 0).all() and (steps > 0).any()) or (steps == 1).all():
            continue  # the last is a column that counts the rows
        step = float(np.median(steps[steps > 0]))
        if any(_STEP_S[0] <= step * ns * 1e-9 <= _STEP_S[1] for ns in TIME_UNITS_NS.values()):
            return i
    return None


def _triples(values: Array, without: Sequence[int | None]) -> list[int]:
    """First columns of three neighbours that hold numbers which change."""
    changes = np.isfinite(values).all(axis=0) & (np.ptp(values, axis=0) > 0) if len(values) else np.zeros(0, bool)
    usable = [bool(change) and i not in without for i, change in enumerate(changes)]
    return [i for i in range(len(usable) - 2) if all(usable[i : i + 3])]


def _accel(values: Array, time: int | None) -> int | None:
    """Three columns whose length stays near gravity, and which leave three for the gyroscope where they can."""
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    readings: list[tuple[bool, float, int]] = []
    for i in _triples(values, (time,)):
        few, median = (float(v) for v in np.percentile(np.linalg.norm(values[:, i : i + 3], axis=1), [5, 50]))
        if few > PLAUSIBLE.steady_share * median:
            others = bool(_triples(values, (time, i, i + 1, i + 2)))
            near = any(low <= median * factor <= high for factor in (1.0, STANDARD_GRAVITY_M_S2))
            readings += [(others, few / median, i)] if near else []
    return max(readings)[2] if readings else None


def _gyro(values: Array, time: int | None, accel: int | None) -> int | None:
    """The first three other columns."""
    if accel is None:
        return None
    triples = _triples(values, (time, accel, accel + 1, accel + 2))
    return triples[0] if triples else None
