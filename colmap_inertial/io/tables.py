"""Text tables of numbers in files, folders and zip archives, and what the cells of their headers name.

Tables are parsed fast, and checked line by line only where something is wrong.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import IO, Literal

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.dialect import decode, plain_text
from colmap_inertial.io.files import first_line, read_bytes, read_limits, reading
from colmap_inertial.io.json_rows import is_json, rows_of_json
from colmap_inertial.io.units import SENSOR_UNITS, TIME_UNITS_NS, Quantity, stamps_ns, unit_of

#: A delimiter that stands for any white space.
_BLANKS = " "
_BLANK_OR_COMMENT = re.compile(r"\n\s*(\n|#|\Z)")


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """The rows of a text table, still as text.

    Attributes
    ----------
    header
        Cells of the header line, stripped of ``#`` and quotes; ``None`` where the first line holds numbers.
    header_text
        The header line as it stands in the file.
    lines, line_numbers
        The data lines and their one-based numbers in the file.
    delimiter
        ``None`` means any white space.
    width
        Cells in each line.
    repairs
        What was dropped to make the table whole.
    preamble
        Lines of the file before the header, where they are no part of the table.
    found
        What is unusual about the way in which it is written, in words.
    """

    path: Path
    header: tuple[str, ...] | None
    header_text: str
    lines: tuple[str, ...]
    line_numbers: Int64Array
    delimiter: str | None
    width: int
    repairs: tuple[Fact, ...] = ()
    preamble: tuple[str, ...] = ()
    found: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)

    def require_width(self, layout: str) -> None:
        """Raise :class:`FormatError` unless there are as many columns as the layout has words."""
        if self.width != len(layout.split()):
            raise FormatError(
                self.path, Fact("other-columns", width=self.width, layout=layout), line=int(self.line_numbers[0])
            )

    def column(self, name: str | int) -> int:
        """The zero-based index of a column, by its name in the header or its number counted from 1.

        Raises
        ------
        FormatError
            Where there is no such column.
        """
        if isinstance(name, int):
            if not 1 <= name <= self.width:
                raise FormatError(self.path, Fact("no-column-number", number=name, width=self.width))
            return name - 1
        if self.header is None:
            raise FormatError(self.path, Fact("no-header-for-column", name=name))
        if name not in self.header:
            raise FormatError(self.path, Fact("no-column", name=name, header=self.header_text[:300]))
        return self.header.index(name)

    def text(self, column: int) -> list[str]:
        """The cells of one zero-based column."""
        cells = (line.split(self.delimiter, column + 1)[column] for line in self.lines)
        return [cell.strip().strip('"') for cell in cells]

    def numbers(self, columns: Sequence[int]) -> Array:
        """(N, len(columns)) values of zero-based columns; an empty cell is NaN.

        Raises
        ------
        FormatError
            With the line of the first cell that is not a number.
        """
        if not self.lines:
            return np.empty((0, len(columns)))
        try:
            return np.loadtxt(
                self.lines, delimiter=self.delimiter, usecols=columns, comments=None, ndmin=2, dtype=np.float64
            )
        except ValueError:
            return self._numbers_cell_by_cell(columns)

    def stamps_ns(self, column: int, unit: str) -> Int64Array:
        """(N,) exact nanoseconds of a zero-based column of time stamps in ``unit``."""
        return stamps_ns(self.path, self.text(column), unit, self.line_numbers)

    def _numbers_cell_by_cell(self, columns: Sequence[int]) -> Array:
        out = np.empty((len(self.lines), len(columns)))
        for row, line in enumerate(self.lines):
            cells = line.split(self.delimiter)
            for i, column in enumerate(columns):
                cell = cells[column].strip().strip('"')
                out[row, i] = number = _number(cell)
                if number is None:
                    raise FormatError(
                        self.path,
                        Fact("cell-not-a-number", cell=cell[:40], column=column + 1),
                        line=int(self.line_numbers[row]),
                    )
        return out


def _number(cell: str) -> float | None:
    if not cell:
        return float("nan")
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def read_table(path: Path) -> Table:
    """Read a table of numbers: comma, semicolon, tab or white space between cells.

    Encoding, decimal commas, lines before the header and further rows of it are found by :mod:`.dialect`.

    Blank lines are passed over, as are lines that start with ``#`` (the last one before the data is the header where
    it has as many cells as the data). A last line that is cut off (no line end, and cells missing or broken) is
    dropped and listed in ``repairs``.

    Raises
    ------
    FormatError
        Where the file is missing or holds no rows, or a line has another number of cells than the first.
    """
    return parse_bytes(path, read_bytes(path))


def parse_bytes(path: Path, data: bytes) -> Table:
    """:func:`read_table` of bytes that lie elsewhere than in a file of their own; ``path`` is for messages."""
    text, encoding = decode(data)
    table = parse_text(path, text)
    return table if encoding == "utf-8" else replace(table, found=(encoding.upper(), *table.found))


def parse_text(path: Path, text: str) -> Table:
    """:func:`parse_bytes` of what was decoded."""
    rows = rows_of_json(text)
    if rows is not None:
        return replace(parse_table(path, rows, ","), found=("JSON",))
    if is_json(text):
        raise FormatError(path, Fact("json-without-rows"))
    plain = plain_text(text)
    table = parse_table(path, plain.text, plain.delimiter)
    return replace(table, preamble=plain.preamble or table.preamble, found=plain.found)


def parse_table(path: Path, text: str, delimiter: str = "") -> Table:
    """:func:`read_table` of the text of a plain table: one header line at most, and decimal points.

    Parameters
    ----------
    delimiter
        A blank is any white space; without one it is found in the second line.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines, numbers, comments, repairs = _split_lines(path, text.rstrip("\n"))
    between = (
        _delimiter(lines[min(1, len(lines) - 1)]) if not delimiter else None if delimiter == _BLANKS else delimiter
    )
    most = read_limits().table_columns
    if any(_width(line, between, most) > most for line in lines[:2]):
        raise too_wide(path, int(numbers[0]))
    has_header = _is_header(lines[0], between)
    candidates = [lines[0]] if has_header else comments[::-1]
    lines, numbers = lines[has_header:], numbers[has_header:]
    if not lines:
        raise FormatError(path, Fact("header-alone"))
    width = len(lines[0].split(between))
    candidates = [line.strip() for line in candidates if _width(line, between, most) <= most]
    header_text = next((line for line in candidates if len(_header_cells(line, between)) == width), None)
    if has_header and header_text is None:
        cells = len(_header_cells(candidates[0], between))
        other = Fact("cells-unlike-header", count=width, header_count=cells, header=candidates[0][:200])
        raise FormatError(path, other, line=int(numbers[0]))
    if not text.endswith("\n") and len(lines) > 1 and _is_cut_off(lines[-1], lines[-2], between, width):
        repairs.append(Fact("last-line-cut-off", file=path.name, line=numbers[-1]))
        lines, numbers = lines[:-1], numbers[:-1]
    _require_one_width(path, lines, numbers, between, width)
    return Table(
        path=path,
        header=None if header_text is None else _header_cells(header_text, between),
        header_text=header_text or "",
        lines=tuple(lines),
        line_numbers=numbers,
        delimiter=between,
        width=width,
        repairs=tuple(repairs),
        preamble=tuple(comments),
    )


def _split_lines(path: Path, body: str) -> tuple[list[str], Int64Array, list[str], list[Fact]]:
    """Lines that hold cells, their numbers in the file, the comments before them, and what was passed over."""
    raw = body.split("\n")
    first = next((i for i, line in enumerate(raw) if line.strip() and not _is_comment(line)), None)
    if first is None:
        raise FormatError(path, Fact("no-rows-of-numbers"))
    comments = [line for line in raw[:first] if _is_comment(line)]
    lines, numbers = raw[first:], np.arange(first + 1, len(raw) + 1)
    repairs = list[Fact]()
    if _BLANK_OR_COMMENT.search(body):
        keep = [bool(line.strip()) and not _is_comment(line) for line in lines]
        inside = sum(map(_is_comment, lines))
        if inside:
            repairs.append(Fact("comments-passed-over", file=path.name, count=inside))
        lines, numbers = [line for line, kept in zip(lines, keep, strict=True) if kept], numbers[keep]
    return lines, numbers, comments, repairs


def _require_one_width(path: Path, lines: list[str], numbers: Int64Array, delimiter: str | None, width: int) -> None:
    most = read_limits().table_columns
    widths = [_width(line, delimiter, most) for line in lines]
    if widths.count(width) != len(widths):
        wrong = next(i for i, width_i in enumerate(widths) if width_i != width)
        raise FormatError(
            path, Fact("cells-unlike-others", count=widths[wrong], others=width), line=int(numbers[wrong])
        )


def too_wide(path: Path, line: int) -> FormatError:
    """The error for a table of more columns than the limits allow."""
    most = read_limits().table_columns
    return FormatError(path, Fact("too-many-columns", most=most), line=line)


def _width(line: str, delimiter: str | None, most: int) -> int:
    """Number of cells, counted up to one more than are allowed."""
    return len(line.split(None, most)) if delimiter is None else line.count(delimiter) + 1


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _delimiter(line: str) -> str | None:
    return next((candidate for candidate in ";,\t" if candidate in line), None)


def _is_header(line: str, delimiter: str | None) -> bool:
    """No cell but empty ones is a number, and there is at least one word."""
    cells = [cell.strip().strip('"') for cell in line.split(delimiter)]
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(_number(cell) is None for cell in filled)


def _header_cells(line: str, delimiter: str | None) -> tuple[str, ...]:
    return tuple(cell.strip().strip('"').strip() for cell in line.strip().lstrip("#").strip().split(delimiter))


def _is_cut_off(line: str, previous: str, delimiter: str | None, width: int) -> bool:
    cells, before = line.split(delimiter), previous.split(delimiter)[-1].strip()
    if len(cells) != width:
        return len(cells) < width
    return bool(before) and _number(before) is not None and (not cells[-1].strip() or _number(cells[-1]) is None)


_TIME_NAMES = {"t", "time", "timestamp", "stamp", "ts", "timestamps", "frametimestamp"}
_GYRO_NAMES = {"g", "w", "gyr", "gyro", "gyroscope", "omega", "angularvelocity", "angvel", "wrss"}
_ACCEL_NAMES = {"a", "acc", "acce", "accel", "accelerometer", "acceleration", "arss"}
# A unit at the end of a name without brackets: "t_ns", "gyro_x_rad_s", "acc_x_m_s2".
_UNIT_SUFFIX = re.compile(r"[_ ](rad_s|deg_s|dps|m_s2|mps2|g|s|ms|us|ns)$", re.IGNORECASE)
_BRACKETS = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")


@dataclass(frozen=True, kw_only=True)
class Column:
    """One recognised column.

    Attributes
    ----------
    kind
        ``"time"``, ``"gyro"`` or ``"accel"``.
    axis
        0, 1, 2 of a sensor column; 0 for time.
    unit
        As in :mod:`colmap_inertial.io.units`; ``None`` where the header does not say.
    """

    kind: Literal["time", "gyro", "accel"]
    axis: int
    unit: str | None


def split_unit(cell: str) -> tuple[str, str | None]:
    """The name and the unit text of a header cell: ``"gx [rad/s]"`` and ``"gx_rad_s"`` give ``("gx", "rad/s")``."""
    match = _BRACKETS.search(cell)
    if match:
        return cell[: match.start()].strip(), match[1].strip()
    match = _UNIT_SUFFIX.search(cell)
    if match:
        return cell[: match.start()].strip(), match[1]
    return cell.strip(), None


def recognise(cell: str) -> Column | None:
    """Quantity of a header cell, or ``None``.

    Raises
    ------
    ValueError
        Where the name is clear and its unit is not one for that quantity.
    """
    name, unit_text = split_unit(cell)
    flat = re.sub(r"[\s_.\-/]", "", name).lower()
    if flat in _TIME_NAMES:
        return Column(kind="time", axis=0, unit=_unit(cell, unit_text, tuple(TIME_UNITS_NS)))
    if not flat or flat[-1] not in "xyz":
        return None
    axis, stem = "xyz".index(flat[-1]), flat[:-1]
    quantity: Quantity
    if stem in _GYRO_NAMES:
        quantity = "gyro"
    elif stem in _ACCEL_NAMES:
        quantity = "accel"
    else:
        return None
    return Column(kind=quantity, axis=axis, unit=_unit(cell, unit_text, tuple(SENSOR_UNITS[quantity])))


def _unit(cell: str, text: str | None, allowed: tuple[str, ...]) -> str | None:
    if text is None:
        return None
    unit = unit_of(text)
    if unit not in allowed:
        raise ValueError(Fact("column-of-unknown-unit", column=cell, unit=text, known=allowed))
    return unit


@dataclass(frozen=True, kw_only=True)
class _Packing:
    """Limits on the unpacked size of a table, in bytes; real ones take a tenth."""

    #: Of memory for each line beside its text.
    line: int = 100
    #: Of memory for each packed byte, and for any table.
    memory: int = 60
    memory_anyway: int = 64 << 20
    #: How much is unpacked at a time.
    step: int = 1 << 20


_PACKING = _Packing()
#: How recorders pack. Others can ask for gigabytes before the first byte.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def members_of(path: Path) -> dict[str, str]:
    """The tables of a recording: file name to where it lies. A zip may hold them in one folder."""
    if path.is_dir():
        return {file.name: file.name for file in path.glob("*.csv")}
    names: list[str] = []
    with suppress(FormatError), reading(path):
        if path.is_file() and zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                names = [info.filename for info in archive.infolist() if info.filename.endswith(".csv")]
    return {PurePosixPath(name).name: name for name in names if len(PurePosixPath(name).parts) <= 2}


def head_of(path: Path, member: str) -> str:
    """The first line of a table, or as much of it as a thousand bytes hold; empty where it is damaged."""
    if path.is_dir():
        return first_line(path / member)
    with suppress(FormatError), _unpacking(path, member) as (file, _):
        return file.read(1000).decode("utf-8-sig", errors="replace").partition("\n")[0]
    return ""


def text_of(path: Path, member: str) -> str:
    """The text of a table.

    Raises
    ------
    FormatError
        Where it is damaged, too large, or larger than its packed bytes can honestly make it.
    """
    if path.is_dir():
        return decode(read_bytes(path / member))[0]
    largest_gib = read_limits().file_gib
    with _unpacking(path, member) as (file, packed):
        parts, size, memory = list[bytes](), 0, 0
        while part := file.read(_PACKING.step):
            parts.append(part)
            size += len(part)
            memory += len(part) + _PACKING.line * part.count(b"\n")
            if size > largest_gib * (1 << 30):
                raise FormatError(path, Fact("member-too-large", member=member, largest_gib=largest_gib))
            if memory > _PACKING.memory_anyway + _PACKING.memory * packed:
                raise FormatError(
                    path, Fact("member-out-of-proportion", member=member, size_mb=size >> 20, packed=packed)
                )
        return decode(b"".join(parts))[0]


@contextmanager
def _unpacking(path: Path, member: str) -> Iterator[tuple[IO[bytes], int]]:
    """A member of a zip, opened, and the bytes that it takes there."""
    with reading(path, Fact("member-not-unpacked", member=member)), zipfile.ZipFile(path) as archive:
        info = archive.getinfo(member)
        if info.compress_type not in _METHODS:
            method = info.compress_type
            raise FormatError(path, Fact("member-packed-otherwise", member=member, method=method))
        with archive.open(info) as file:
            yield file, min(info.compress_size, path.stat().st_size)
