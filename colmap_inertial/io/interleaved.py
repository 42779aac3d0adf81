"""Tables in which each row is one sensor's, by what a column says: names such as ``GYRO``, or numbers."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io import vocabulary as words
from colmap_inertial.io.columns import Cell, find_sensor, read_name
from colmap_inertial.io.dialect import decode, split_cells
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.sensor_columns import OPEN, Columns, SensorColumns
from colmap_inertial.io.stamps import TimeColumns
from colmap_inertial.io.tables import Table, parse_table, read_table, split_unit
from colmap_inertial.io.units import Quantity

#: Where the column of sensors is looked for, in how many lines, and how many sensors a phone has at most.
_COLUMNS, _LINES, _SENSORS = 4, 4000, 40
#: Sensors that have numbers.
_NUMBERS = 12


def read_rows(path: Path, column: str | int, value: str) -> Table:
    """The rows of one sensor.

    Parameters
    ----------
    column, value
        Name of the column, or its number counted from 1, and what it says in these rows.

    Raises
    ------
    FormatError
        Where no row does.
    """
    try:
        table = read_table(path)
    except FormatError:
        if not isinstance(column, int):
            raise
        return _rows_of_text(path, decode(read_bytes(path))[0], column, value)
    kept = np.array([cell == value for cell in table.text(table.column(column))])
    if not kept.any():
        raise FormatError(path, Fact("no-row-of-sensor", value=value, column=str(column)))
    lines = tuple(line for line, keep in zip(table.lines, kept, strict=True) if keep)
    return replace(table, lines=lines, line_numbers=table.line_numbers[kept])


def _rows_of_text(path: Path, text: str, column: int, value: str) -> Table:
    """:func:`read_rows` where rows of several sensors have several lengths."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    delimiter = _delimiter(lines)
    kept = [_cell(line, delimiter, column) == value for line in lines]
    if not any(kept):
        raise FormatError(path, Fact("no-row-of-sensor", value=value, column=str(column)))
    header = _header_of(lines, delimiter, value)
    body = [line.rstrip() if keep else "" for line, keep in zip(lines, kept, strict=True)]
    width = Counter(line.count(delimiter) for line in body if line).most_common(1)[0][0]
    body = [line.removesuffix(delimiter) if line.count(delimiter) > width else line for line in body]
    first = next(i for i, keep in enumerate(kept) if keep)
    if header is not None and first > 0:
        names = [*header, *(f"column_{i + 1}" for i in range(len(header), width + 1))][: width + 1]
        body[first - 1] = delimiter.join(name.replace(delimiter, " ") for name in names)
    return parse_table(path, "\n".join(body) + "\n", delimiter)


def _header_of(lines: Sequence[str], delimiter: str, value: str) -> list[str] | None:
    """The names that a comment gives: ``# UncalGyro,utcTimeMillis,...``."""
    start = re.compile(rf"[#%/;].*?\b{re.escape(value)}\s*{re.escape(delimiter)}")
    for line in lines[:_LINES]:
        match = start.match(line.lstrip())
        if match:
            begin = line.lstrip().index(value, match.end() - len(match[0]))
            at = line.lstrip()[match.end() - len(value) - 1 :] if begin < 0 else line.lstrip()[begin:]
            at = line.lstrip()[match.end() :]
            names = re.split(r"['\"]", at)[0]
            return [value, *split_cells(names.rstrip(delimiter), delimiter)]
    return None


def _delimiter(lines: Sequence[str]) -> str:
    counts = {candidate: sum(candidate in line for line in lines[:_LINES]) for candidate in ";\t,"}
    return max(counts, key=lambda candidate: (counts[candidate], candidate == ";"))


def _cell(line: str, delimiter: str, column: int) -> str:
    cells = line.split(delimiter, column)
    return cells[column - 1].strip().strip('"').strip() if len(cells) > column else ""


def find_rows_of_sensors(path: Path) -> Columns | None:
    """What the columns of such a table hold; ``None`` where no column names sensors."""
    text = decode(read_bytes(path))[0]
    lines = [line for line in text[: 1 << 20].splitlines()[:_LINES] if line.strip() and line.lstrip()[:1] not in "#%/"]
    delimiter = _delimiter(lines)
    for column in range(1, _COLUMNS + 1):
        said = Counter(_cell(line, delimiter, column) for line in lines)
        said.pop("", None)
        if len(said) > _SENSORS:
            continue
        named = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in said if said[name] > 2}
        gyro = _best(named, words.GYRO_ROWS) or _find_named_sensor(named, "gyro")
        accel = _best(named, words.ACCEL_ROWS) or _find_named_sensor(named, "accel")
        if gyro is not None and accel is not None:
            parts = [_sensor(path, column, gyro, "gyro"), _sensor(path, column, accel, "accel")]
            sure = all(part.is_complete for part in parts)
            why = (f"column {column} names the sensor of each row: {gyro}, {accel}",)
            return Columns(gyro=parts[0], accel=parts[1], is_sure=sure, why=why)
    return None


def find_numbered_rows(table: Table) -> Columns | None:
    """Columns of a table whose rows are of sensors that have numbers; which is which is open."""
    for column in range(min(_COLUMNS, table.width)):
        cells = table.text(column)[:_LINES]
        counts = Counter(cells)
        changes = sum(a != b for a, b in itertools.pairwise(cells))
        few = 2 <= len(counts) <= _NUMBERS and all(re.fullmatch(r"\d{1,3}", value) for value in counts)
        if few and 5 * changes > len(cells) and (part := _find_numbered_columns(table, column, counts)) is not None:
            return Columns(gyro=part, accel=part, why=(f"column {column + 1} numbers the sensor of each row",))
    return None


def _find_numbered_columns(table: Table, column: int, counts: Counter[str]) -> SensorColumns | None:
    """Three columns of values, and what they are by number of the sensor."""
    time = None
    if table.header is None:
        places = [i for i in range(table.width) if i != column]
        if len(places) < 4:
            return None
        time = TimeColumns(columns=(places[0] + 1,))
        columns = (places[1], places[2], places[3])
    else:
        part = find_sensor(table, [read_name(name) for name in table.header], "gyro", ("axis",))
        if part.columns is None:
            return None
        time, columns = part.time, part.columns
    try:
        lengths = np.linalg.norm(table.numbers(columns)[:_LINES], axis=1)
    except FormatError:
        return None
    said = np.array(table.text(column)[:_LINES])
    each = []
    for value, count in counts.items():
        each.append(f"{value} ({count} rows, mean length {lengths[said == value].mean():.3g})")
    return SensorColumns(columns=columns, time=time, where=(column + 1, OPEN), about=f"sensors: {', '.join(each)}")


def finds_instances(table: Table, taken: Iterable[int]) -> bool:
    """Whether rows of several devices come in turn; ``taken`` are the columns of sensors and time."""
    return _instances(table, taken) is not None


def leave_instance_open(table: Table, found: Columns) -> Columns:
    """The same, with the choice of a device left open, where rows of several come in turn."""
    parts = (found.gyro, found.accel)
    instances = _instances(table, [index for part in parts for index in part.columns or ()])
    if instances is None or found.gyro.where is not None:
        return found
    name, counts = instances
    about = ", ".join(f"{value} ({count} rows)" for value, count in counts.items())
    gyro, accel = (replace(part, where=(name, OPEN), about=about) for part in parts)
    why = (*found.why, f"{name} tells the rows of {len(counts)} devices apart")
    return replace(found, gyro=gyro, accel=accel, is_sure=False, why=why)


def _instances(table: Table, taken: Iterable[int]) -> tuple[str, Counter[str]] | None:
    """The column that tells devices apart, and how many rows each has."""
    for column, name in enumerate(table.header or ()):
        if column in taken or re.sub(r"[\W_]", "", name.lower()) not in words.INSTANCES:
            continue
        cells = table.text(column)
        counts = Counter(cells)
        changes = sum(a != b for a, b in itertools.pairwise(cells))
        if 1 < len(counts) <= _NUMBERS and changes > 4 * len(counts) and min(counts.values()) > 2:
            return name, counts
    return None


def _best(named: dict[str, str], known: set[str]) -> str | None:
    found = [name for name, flat in named.items() if flat in known]
    return min(found, key=lambda name: ("uncal" in named[name], name)) if found else None


def _find_named_sensor(names: Iterable[str], quantity: Quantity) -> str | None:
    """The one name that says a sensor and its unit: ``gyro_dps``."""
    found = [name for name in names if (cell := _read_row_name(name)).kind == quantity and cell.unit is not None]
    return found[0] if len(found) == 1 else None


def _read_row_name(name: str) -> Cell:
    """What a name of rows says, as if it stood over one of their columns."""
    bare, unit = split_unit(name)
    return read_name(f"{bare} x" if unit is None else f"{bare} x [{unit}]")


def _sensor(path: Path, column: int, value: str, quantity: Quantity) -> SensorColumns:
    table = read_rows(path, column, value)
    if table.header is None:
        return SensorColumns(where=(column, value))
    cells = [read_name(name) for name in table.header]
    part = find_sensor(table, cells, quantity)
    if part.columns is None:
        part = find_sensor(table, cells, quantity, (quantity, "axis"))
    said = _read_row_name(value)
    if part.unit is None and said.kind == quantity and said.unit is not None:
        part = replace(part, unit=said.unit, counts_per_unit=said.scale)
    return replace(part, where=(column, value))
