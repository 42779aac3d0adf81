"""How a table of text is written: encoding, delimiter, decimal sign, lines before the header, rows of the header.

Nobody states these. They are found in the first lines, and the table is written anew as
:func:`~colmap_inertial.io.tables.parse_table` knows it, each row on its own line. What is a plain table already stays
as it is.
"""

from __future__ import annotations

import csv
import functools
import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

#: What is looked at: characters, lines, and rows under the header that must agree.
_HEAD_CHARACTERS, _HEAD_LINES, _ALIKE = 1 << 16, 600, 3
#: Delimiter and decimal sign, those of plain tables first.
_WAYS = (
    (";", "."),
    (",", "."),
    ("\t", "."),
    (None, "."),
    (";", ","),
    ("\t", ","),
    (None, ","),
    ("|", "."),
    ("|", ","),
    (",", ","),
)
#: How much better another way must read than the plain one.
_CLEARLY = 0.05
#: Rows of a header.
_MOST_HEADER_ROWS = 4
#: Units, as a row under the header may spell them: letters, after blanks and signs of powers are taken out.
_UNIT = re.compile(
    r"(m|micro|µ|μ|u|n|milli|k)?(s|sec|seconds|g|gs|dps|t|hz|v|volts|m)|m/\(?s(ec)?2\)?|m/s²|m/s/s|ms-2|"
    r"(m|k)?rad(ians)?(/s(ec)?|s-1)?|"
    r"(m?deg(rees)?|°|º)(/s(ec)?|s-1|c)?|(u|µ|μ|m|n)?(t|tesla|gauss|pa)|h?pa|mbar|%|celsius|local_flux",
    re.IGNORECASE,
)
#: Words of a row under the header that name no column.
_NO_NAMES = {"cal", "raw", "uncal", "no units", "no_units", "n/a", "-"}

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)|null|none|na", re.IGNORECASE)
#: A date, a time of day, or both.
_STAMP = re.compile(
    r"(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})?[T _]?(\d{1,2}[:.]\d{1,2}([:.]\d{1,2}([.:,_]\d{1,9})?)?)?"
    r"( ?[AP]M)?( ?(Z|UTC|GMT|[-+]\d{2}:?\d{2}))?",
    re.IGNORECASE,
)
_COMMENTS = ("#", "%", "//", ";")
_QUOTED = re.compile(r'"([^"]*)"')


@dataclass(frozen=True, kw_only=True)
class PlainText:
    """The text of a table in the form that is known, and what was found.

    Attributes
    ----------
    text
        With as many lines as before.
    delimiter
        A blank means any white space; empty where the text is as it was.
    preamble
        The lines before the header.
    found
        What is unusual, in words.
    """

    text: str
    delimiter: str = ""
    preamble: tuple[str, ...] = ()
    found: tuple[str, ...] = ()


# --- bytes ------------------------------------------------------------------------------------------------------------


def decode(data: bytes) -> tuple[str, str]:
    """The text of a file and the name of its encoding: UTF-8, UTF-16, GB 18030 or Windows-1252.

    Bytes that are wrong in it become U+FFFD, so that a reader can name their line. A long minus becomes a plain one.
    """
    encoding = _encoding(data)
    text = data.decode(encoding, errors="replace").replace("\u2212", "-")
    return text.removeprefix("\ufeff"), "utf-8" if encoding == "utf-8-sig" else encoding


def _encoding(data: bytes) -> str:
    head = data[:_HEAD_CHARACTERS]
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    even, odd = head[:4096:2].count(0), head[1:4096:2].count(0)
    if max(even, odd) > 0.4 * len(head[:4096:2]) and min(even, odd) == 0:
        return "utf-16-be" if even else "utf-16-le"
    try:
        head.decode("utf-8-sig")
        return "utf-8-sig"
    except UnicodeDecodeError as error:
        if error.start >= len(head) - 4 or re.search(rb"[\xc2-\xf4][\x80-\xbf]+(?![\x80-\xff])", head):
            return "utf-8-sig"
    runs = re.findall(rb"[\x80-\xff]+", head)
    try:
        if all(len(run) % 2 == 0 for run in runs):
            b"".join(runs).decode("gb2312")
            return "gb18030"
    except UnicodeDecodeError:
        pass
    return "cp1252"


# --- text -------------------------------------------------------------------------------------------------------------


def plain_text(text: str) -> PlainText:
    """The table of a text, written as plain tables are; the same text where it is one, or none."""
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    head = _head(text)
    stated = re.fullmatch(r"\s*\"?sep=(.|\\t)\"?\s*", head[0]) if head else None
    standard = _standard_delimiter(head)
    layout = _find_layout(head, standard, stated[1].replace("\\t", "\t") if stated else None)
    if layout is None:
        return PlainText(text=text)
    return _write_plainly(text, layout)


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Where a table begins, and how its cells are written; lines count from 0."""

    delimiter: str | None
    decimal: str
    header: tuple[str, ...]
    header_line: int
    first_row: int
    width: int
    trailing: bool
    quoted: bool
    joined: int = 1


def _head(text: str) -> list[str]:
    """The first lines; the last of them only where it is whole."""
    head = text[:_HEAD_CHARACTERS].split("\n")
    if len(text) > _HEAD_CHARACTERS:
        head = head[:-1]
    return head[:_HEAD_LINES]


def _rows(head: Sequence[str]) -> list[str]:
    return [line for line in head if line.strip() and not line.lstrip().startswith("#")]


def _standard_delimiter(head: Sequence[str]) -> str | None:
    rows = _rows(head)[:2]
    return next((candidate for candidate in ";,\t" if rows and candidate in rows[-1]), None)


def split_cells(line: str, delimiter: str | None) -> list[str]:
    """The cells of one line, without quotes and the blanks around."""
    if '"' in line and delimiter is not None:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    else:
        cells = line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in cells]


def is_value(cell: str, decimal: str = ".") -> bool:
    """Whether a cell holds a number, a date or a time."""
    if len(cell) > 64 or not cell:
        return False
    if decimal != ".":
        if "." in cell and "," in cell:
            return False
        cell = cell.replace(decimal, ".") if "." not in cell or _STAMP.fullmatch(cell) else cell
    return bool(_NUMBER.fullmatch(cell) or (cell[:1].isdigit() and _STAMP.fullmatch(cell)))


def _is_row(cells: Sequence[str], decimal: str) -> bool:
    """Whether cells are a row of values: at least two, a fifth of those that are not empty."""
    values = sum(is_value(cell, decimal) for cell in cells)
    return values >= 2 and 5 * values >= sum(map(bool, cells))


def _find_layout(head: Sequence[str], standard: str | None, stated: str | None) -> _Layout | None:
    """How the table is written; ``None`` for a plain one, or where there is none."""
    best, plain_share = None, -1.0
    ways = [way for way in _WAYS if stated is None or way[0] == stated]
    for delimiter, decimal in ways:
        share, layout = _read_as(head, delimiter, decimal)
        if layout is None:
            continue
        if (delimiter, decimal) == (standard, "."):
            plain_share = share
        if (
            best is None
            or share > best[0] + _CLEARLY
            or ((delimiter, decimal) == (standard, ".") and share >= best[0] - _CLEARLY)
        ):
            best = share, layout
    if best is None:
        return None
    layout = best[1]
    if not layout.header and _hides_a_header(head, layout):
        return None  # the parser says what does not fit
    if stated is None and best[0] <= plain_share + _CLEARLY and _is_plain(head, standard, layout):
        return None
    return layout


def _hides_a_header(head: Sequence[str], layout: _Layout) -> bool:
    """Whether the line above the first row has several cells, and not as many as the rows."""
    above = next((line for line in reversed(head[: layout.first_row]) if line.strip()), "#")
    return not above.lstrip().startswith(_COMMENTS) and len(split_cells(above, layout.delimiter)) > 1


def _is_plain(head: Sequence[str], standard: str | None, layout: _Layout) -> bool:
    """Whether the plain parser finds the same rows under the same header."""
    if layout.delimiter != standard or layout.trailing or layout.quoted or layout.joined > 1:
        return False
    rows = _rows(head)
    first = rows.index(head[layout.first_row])
    return first == 0 or (first == 1 and len(rows[0].split(standard)) == layout.width)


def _read_as(head: Sequence[str], delimiter: str | None, decimal: str) -> tuple[float, _Layout | None]:
    """Share of cells that hold values, and where the table lies, if cells are written like this."""
    split = [split_cells(line, delimiter) if line.strip() else [] for line in head]
    rows = [i for i, cells in enumerate(split) if _is_row(cells, decimal)]
    if not rows:
        return 0.0, None
    width = Counter(len(split[i]) for i in rows[len(rows) // 2 :]).most_common(1)[0][0]
    good = [i for i in rows if len(split[i]) == width]
    alike = min(_ALIKE, len(good))
    first = next((i for n, i in enumerate(good) if len(good) >= n + alike and _follow(head, good[n : n + alike])), None)
    if first is None or width < 2:
        return 0.0, None
    good = [i for i in good if i >= first]
    values = sum(is_value(cell, decimal) for i in good for cell in split[i])
    filled = sum(map(bool, itertools.chain(*split[first:])))
    header, line, joined, trailing = _find_header(head, split, first, width, delimiter)
    return values / max(filled, 1), _Layout(
        delimiter=delimiter,
        decimal=decimal,
        header=header,
        header_line=line,
        first_row=first,
        width=width - trailing,
        trailing=trailing,
        quoted=delimiter is not None and any(head[i].count(delimiter) + 1 != width for i in good),
        joined=joined,
    )


def _follow(head: Sequence[str], rows: Sequence[int]) -> bool:
    """Whether nothing but blank lines and comments lies between rows."""
    between = [head[i].strip() for i in range(rows[0], rows[-1]) if i not in rows]
    return all(not line or line.startswith(_COMMENTS) for line in between)


def _find_header(
    head: Sequence[str], split: Sequence[Sequence[str]], first: int, width: int, delimiter: str | None
) -> tuple[tuple[str, ...], int, int, bool]:
    """Names of the columns, the line of the header, how many rows it has, and whether rows end with a delimiter."""
    data = [cells for cells in split[first:] if len(cells) == width]
    empty_end = width > 2 and all(not cells[-1] for cells in data)
    block = _header_block(head, split, first, width, empty_end)
    if block:
        trailing = empty_end and all(len(cells) < width or not cells[-1] for _, cells in block)
        rows = [cells[: width - 1] if trailing else cells for _, cells in reversed(block)]
        return join_header(rows), block[0][0], len(block), trailing
    for i in range(first - 1, -1, -1):
        line = head[i].strip()
        if line.startswith(_COMMENTS):
            cells = split_cells(line.lstrip("#%/;").strip(), delimiter)
            if len(cells) == width and not all(map(is_value, cells)):
                return tuple(cells), i, 1, False
    return (), first, 0, False


def _header_block(
    head: Sequence[str], split: Sequence[Sequence[str]], first: int, width: int, empty_end: bool
) -> list[tuple[int, list[str]]]:
    """Lines above the first row that have as many cells, the nearest first."""
    block: list[tuple[int, list[str]]] = []
    for i in range(first - 1, -1, -1):
        if not head[i].strip():
            continue
        cells = list(split[i])
        while len(cells) > width and not cells[-1]:
            cells = cells[:-1]
        fits = len(cells) == width or (empty_end and len(cells) == width - 1)
        if not fits or head[i].lstrip().startswith(_COMMENTS) or len(block) == _MOST_HEADER_ROWS:
            break
        block.append((i, cells))
    return block


def join_header(rows: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """One name for each column from several rows: names, parts of names, and units, which come in brackets."""
    if len(rows) == 1:
        return tuple(rows[0])
    filled = [list(row) for row in rows]
    if not all(filled[0]):  # a name over several columns stands over the first of them
        for i in range(1, len(filled[0])):
            filled[0][i] = filled[0][i] or filled[0][i - 1]
    names = []
    for cells in zip(*filled, strict=True):
        words: list[str] = []
        unit = ""
        for i, cell in enumerate(cells):
            bare = cell[1:-1] if cell[:1] in ("(", "[") else cell
            if i and _UNIT.fullmatch(re.sub(r"[\s_^*·]", "", bare)):
                unit = bare
            elif cell and cell.lower() not in _NO_NAMES and cell not in words:
                words.append(cell)
        names.append(" ".join(words) + (f" [{unit}]" if unit else ""))
    return tuple(names)


def _write_plainly(text: str, layout: _Layout) -> PlainText:
    lines = text.split("\n")
    delimiter = layout.delimiter or " "
    preamble = tuple(line for line in lines[: layout.header_line] if line.strip())
    header = split_cells(lines[layout.header_line], layout.delimiter) if layout.header else []
    for i in range(layout.first_row):
        lines[i] = ""
    names = [_QUOTED.sub(r"\1", name).replace(delimiter, "_" if delimiter == " " else " ") for name in layout.header]
    if names:
        lines[layout.first_row - 1] = delimiter.join(name or f"column_{i + 1}" for i, name in enumerate(names))
    for i in range(layout.first_row, len(lines)):
        line = lines[i]
        again = bool(header) and line[:1].isalpha() and split_cells(line, layout.delimiter) == header
        lines[i] = "" if again else _write_row(line, layout, delimiter)
    return PlainText(text="\n".join(lines), delimiter=delimiter, preamble=preamble, found=_describe(layout, preamble))


def _write_row(line: str, layout: _Layout, delimiter: str) -> str:
    if line.lstrip().startswith(_COMMENTS[1:3]):
        return ""
    if layout.quoted and '"' in line:
        inside = "." if layout.decimal == "," else " "
        line = _QUOTED.sub(functools.partial(_replace_inside, delimiter, inside), line)
    if layout.decimal == "," and delimiter != ",":
        line = line.replace(",", ".")
    return line.rstrip().removesuffix(delimiter) if layout.trailing else line


def _replace_inside(delimiter: str, by: str, quoted: re.Match[str]) -> str:
    return quoted[1].replace(delimiter, by)


def _describe(layout: _Layout, preamble: Sequence[str]) -> tuple[str, ...]:
    said = []
    if preamble:
        said.append(f"{len(preamble)} lines before the header")
    if layout.decimal == ",":
        said.append("decimal commas")
    if layout.joined > 1:
        said.append(f"{layout.joined} rows of a header")
    return tuple(said)
