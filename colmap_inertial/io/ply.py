"""PLY files moved by a similarity: positions, normals and what splats have change, every other byte stays.

Any PLY: ASCII, binary little- or big-endian, whatever elements, properties, lists and comments it has. The file passes
through in chunks, and what the format lets one check on the way is checked: sizes, counts, indices of faces.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import advise
from colmap_inertial.io.splats import SplatMover, fault_of_splats, list_changed_fields
from colmap_inertial.io.stand_ins import refuse_stand_in

_CHUNK_BYTES = 512 << 10
_LONGEST_HEADER = 1 << 20
_LONGEST_LINE = 1 << 20
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
#: What a file of Gaussian splats has; of those that pack them into other fields, nothing is known here.
_OF_SPLATS = {"scale_0", "rot_0", "packed_position"}


@dataclass(frozen=True)
class Property:
    """One property of an element; ``count`` is the type of a list's length, ``None`` for a single value."""

    name: str
    kind: str
    count: str | None = None


@dataclass(frozen=True)
class Element:
    """One element of a PLY file: name, number of rows, properties in the file's order."""

    name: str
    rows: int
    properties: tuple[Property, ...]

    @property
    def has_list(self) -> bool:
        """Whether rows may differ in length."""
        return any(p.count is not None for p in self.properties)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """One row without lists, packed."""
        return np.dtype([(p.name, order + p.kind) for p in self.properties])


@dataclass(frozen=True)
class Header:
    """Header of a PLY file; ``raw`` has its bytes, ``order`` is ``None`` for ASCII."""

    raw: bytes
    order: str | None
    elements: tuple[Element, ...]

    @property
    def lines(self) -> int:
        """Number of lines of the header."""
        return self.raw.count(b"\n")


def read_ply_header(path: Path, file: BufferedReader) -> Header:
    """Read the header and leave the file behind it.

    Raises
    ------
    FormatError
        Where it is none, naming the line.
    """
    raw = [file.readline(64)]
    if raw[0].strip() != b"ply":
        refuse_stand_in(path)
        raise FormatError(path, Fact("not-a-ply"), line=1)
    formats: list[str] = []
    elements: list[Element] = []
    length = 0
    while raw[-1].split() != [b"end_header"]:
        raw.append(file.readline(_LONGEST_LINE))
        length += len(raw[-1])
        if not raw[-1].endswith(b"\n") or length > _LONGEST_HEADER:
            raise FormatError(path, Fact("ply-header-endless"), line=len(raw))
        fault = _read_header_line(raw[-1].decode("latin-1").split(), formats, elements)
        if fault is not None:
            raise FormatError(path, fault, line=len(raw))
    if not formats:
        raise FormatError(path, Fact("ply-format-missing"))
    for element in elements:
        if element.rows and not element.properties:
            raise FormatError(path, Fact("ply-rows-without-property", element=element.name))
    return Header(b"".join(raw), _BYTE_ORDERS[formats[0]], tuple(elements))


def _read_header_line(words: list[str], formats: list[str], elements: list[Element]) -> Fact | None:
    """Add what a line of the header declares to the formats and elements; what is wrong with it, if anything."""
    count: str | None = None
    match words:
        case ["end_header"] | ["comment" | "obj_info", *_]:
            return None
        case ["format", name, "1.0"] if name in _BYTE_ORDERS and not formats:
            formats.append(name)
            return None
        case ["element", name, rows] if rows.isascii() and rows.isdigit() and len(rows) < 16:
            if name in {e.name for e in elements}:
                return Fact("ply-element-twice", element=name)
            elements.append(Element(name, int(rows), ()))
            return None
        case ["property", "list", length, kind, name] if elements and _TYPES.get(length, "f")[0] in "iu":
            count = _TYPES[length]
        case ["property", kind, name] if elements:
            pass
        case _:
            return Fact("not-a-ply-line", line=" ".join(words)[:60])
    if kind not in _TYPES:
        return Fact("not-a-ply-type", type=kind)
    last = elements[-1]
    if name in {p.name for p in last.properties}:
        return Fact("ply-property-twice", property=name, element=last.name)
    new = Property(name, _TYPES[kind], count)
    elements[-1] = Element(last.name, last.rows, (*last.properties, new))
    return None


#: What a file says whose positions were given double precision, and lose it again with ``--undo``.
_WAS_SINGLE = b"comment colmap-inertial: x y z were float\n"


def _set_precision(header: Header, doubles: bool | None) -> Header:
    """The header of the copy: positions of vertices in double precision, or as they were before that."""
    vertices = next((e for e in header.elements if e.name == "vertex"), None)
    was_single = _WAS_SINGLE in header.raw
    if vertices is None or doubles is None or doubles == was_single:
        return header
    kinds = {p.name: p.kind for p in vertices.properties if p.count is None}
    old, new = ("f4", "f8") if doubles else ("f8", "f4")
    if {kinds.get(name) for name in _POSITION} != {old}:
        return header
    lines = _retype(header.raw, b"double" if doubles else b"float")
    lines[2:2] = [_WAS_SINGLE] if doubles else []
    properties = tuple(Property(p.name, new) if p.name in _POSITION else p for p in vertices.properties)
    elements = tuple(Element(e.name, e.rows, properties) if e is vertices else e for e in header.elements)
    return Header(b"".join(lines), header.order, elements)


def _retype(raw: bytes, word: bytes) -> list[bytes]:
    """Lines of a header with another type of vertices' positions, without the line on what they were."""
    element, lines = b"", []
    for line in raw.splitlines(keepends=True):
        words = line.split()
        if words[:1] == [b"element"]:
            element = words[1]
        if element == b"vertex" and words[:1] == [b"property"] and words[-1].decode("latin-1") in _POSITION:
            line = line.replace(words[1], word, 1)
        lines.append(line)
    return [line for line in lines if line != _WAS_SINGLE]


def transform_ply(
    source: Path, target: Path, similarity: Similarity, *, doubles: bool | None = None
) -> tuple[str, ...]:
    """Write a copy with positions ``x y z`` moved and normals ``nx ny nz`` rotated, wherever an element has them.

    Parameters
    ----------
    source, target
        Files; the target is written anew.
    similarity
        Target from source.
    doubles
        ``True`` gives positions of single precision double precision, where they come to lie too far away for it;
        ``False`` takes that back; ``None`` keeps them as they are.

    Returns
    -------
    tuple of str
        What was changed: ``"positions"``, ``"normals"``; empty where the file has neither.

    Raises
    ------
    FormatError
        For a file that is damaged, or holds what cannot be transformed.
    """
    with open(source, "rb") as file:
        advise(file.fileno(), "SEQUENTIAL")
        header = read_ply_header(source, file)
        vertices = next((e for e in header.elements if e.name == "vertex"), None)
        changed = () if vertices is None else _check_vertices(source, vertices)
        body = source.stat().st_size - len(header.raw)
        with open(target, "wb") as out:
            made = _set_precision(header, doubles if changed else None)
            out.write(made.raw)
            n_vertices = 0 if vertices is None else vertices.rows
            chunks: Iterator[bytes | memoryview]
            if header.order is None:
                chunks = _ascii(source, file, header, similarity, made)
            else:
                chunks = _binary(source, file, header, made, body, n_vertices, similarity)
            out.writelines(chunks)
    return changed


def sample_vertices(path: Path, most: int = 20_000) -> Array:
    """(N, 3) positions of some vertices from all over a file; empty where it has none that can be told quickly.

    Raises
    ------
    FormatError
        Where it is no PLY file.
    """
    with open(path, "rb") as file:
        header = read_ply_header(path, file)
        first = header.elements[0] if header.elements else None
        if first is None or first.name != "vertex" or first.has_list:
            return np.empty((0, 3))
        names = [p.name for p in first.properties]
        if not set(names).issuperset(_POSITION):
            return np.empty((0, 3))
        if header.order is None:
            columns = [names.index(name) for name in _POSITION]
            lines = (file.readline(_LONGEST_LINE).split() for _ in range(first.rows))
            rows = [line for i, line in enumerate(lines) if i % (first.rows // most + 1) == 0]
            with contextlib.suppress(ValueError, IndexError):
                return np.array([[float(row[c]) for c in columns] for row in rows]).reshape(-1, 3)
            return np.empty((0, 3))
        dtype = first.dtype(header.order)
        count = min(first.rows, (path.stat().st_size - len(header.raw)) // dtype.itemsize)
        mapped = (
            np.memmap(path, dtype, mode="r", offset=len(header.raw), shape=(count,)) if count else np.empty(0, dtype)
        )
        some = mapped[:: count // most + 1]
        return np.stack([np.asarray(some[name], dtype=np.float64) for name in _POSITION], axis=1)


def _check_vertices(path: Path, vertices: Element) -> tuple[str, ...]:
    kinds = {p.name: p for p in vertices.properties}
    changed = []
    for label, names in (("positions", _POSITION), ("normals", _NORMAL)):
        present = [name for name in names if name in kinds]
        if not present:
            continue
        if len(present) < 3:
            raise FormatError(path, Fact("ply-part-of-vector", label=label, present=" ".join(present)))
        for name in names:
            if kinds[name].count is not None or kinds[name].kind[0] != "f":
                raise FormatError(path, Fact("ply-field-not-float", name=name))
        changed.append(label)
    if is_splats(set(kinds)):
        fault = fault_of_splats(set(kinds))
        moved = [] if fault is not None else [kinds[name] for name in list_changed_fields(set(kinds))]
        if any(p.kind[0] != "f" or p.count is not None for p in moved):
            fault = Fact("splats-not-float")
        if fault is not None:
            raise FormatError(path, Fact("splats-not-transformed", fault=fault))
        changed += ["sizes", "rotations", *(["colours"] if "f_rest_0" in kinds else [])]
    if changed and vertices.has_list:
        raise FormatError(path, Fact("ply-lists-not-transformed"))
    return tuple(changed)


def is_splats(names: set[str]) -> bool:
    """Whether vertices with these properties are Gaussian splats."""
    return not names.isdisjoint(_OF_SPLATS)


def _mover(similarity: Similarity, element: Element) -> Mover | SplatMover:
    """Function that transforms the rows of an element."""
    names = {p.name for p in element.properties} if element.name == "vertex" else set()
    return SplatMover(similarity, names) if is_splats(names) else Mover(similarity, names)


class Mover:
    """Moves the named fields of structured rows in place."""

    def __init__(self, similarity: Similarity, names: set[str]) -> None:
        rotation = matrix_from_quat(similarity.rotation_xyzw)
        self._parts = []
        if names.issuperset(_POSITION):
            self._parts.append((_POSITION, similarity.scale * rotation, similarity.translation_m))
        if names.issuperset(_NORMAL):
            self._parts.append((_NORMAL, rotation, np.zeros(3)))

    @property
    def names(self) -> list[str]:
        """The fields that change."""
        return [name for names, _, _ in self._parts for name in names]

    def __call__(self, rows: NDArray[np.void]) -> None:
        """Move them."""
        # Points that are no number, or too far away for the file's precision, stay so and need no warning
        with np.errstate(over="ignore", invalid="ignore"):
            for names, matrix, offset in self._parts:
                values = np.empty((3, len(rows)))
                for i, name in enumerate(names):
                    values[i] = rows[name]
                moved = matrix @ values
                moved += offset[:, None]
                for i, name in enumerate(names):
                    rows[name] = moved[i]


def _binary(
    path: Path, file: BufferedReader, header: Header, made: Header, left: int, n_vertices: int, similarity: Similarity
) -> Iterator[memoryview]:
    order = header.order or "<"
    for element, new in zip(header.elements, made.elements, strict=True):
        smallest = sum(np.dtype(p.count or p.kind).itemsize for p in element.properties)
        if element.rows * smallest > left:
            raise FormatError(path, Fact("ply-rows-beyond", rows=element.rows, element=element.name))
        before = file.tell()
        if element.has_list:
            walked = _binary_lists(path, file, element, order, n_vertices)
        else:
            walked = _binary_rows(path, file, element, order, _mover(similarity, element), new.dtype(order))
        yield from walked
        left -= file.tell() - before
    if left != 0:
        raise FormatError(path, Fact("ply-bytes-follow", left=left))


def _read(path: Path, file: BufferedReader, buffer: memoryview, element: Element) -> memoryview:
    if file.readinto(buffer) < len(buffer):
        raise FormatError(path, Fact("ply-truncated", element=element.name))
    return buffer


def _binary_rows(
    path: Path,
    file: BufferedReader,
    element: Element,
    order: str,
    mover: Mover | SplatMover,
    made: np.dtype[np.void],
) -> Iterator[memoryview]:
    dtype = element.dtype(order)
    wide = max(dtype, made, key=lambda kind: kind.itemsize)
    per_chunk = max(1, _CHUNK_BYTES // dtype.itemsize)
    buffer = bytearray(min(per_chunk, element.rows) * dtype.itemsize)
    for start in range(0, element.rows, per_chunk):
        n = min(per_chunk, element.rows - start)
        data = _read(path, file, memoryview(buffer)[: n * dtype.itemsize], element)
        if made == dtype:
            mover(np.frombuffer(data, dtype))
            yield data
        else:
            rows = np.frombuffer(data, dtype).astype(wide)
            mover(rows)
            with np.errstate(over="ignore"):
                yield memoryview(rows.astype(made).tobytes())


def _binary_lists(
    path: Path, file: BufferedReader, element: Element, order: str, n_vertices: int
) -> Iterator[memoryview]:
    """Copy rows with lists; rows whose lists are as long as the first row's are checked together."""
    rows_left, window = element.rows, 64
    while rows_left:
        start = file.tell()
        lengths = _lengths(path, file, element, order)
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for i, p in enumerate(element.properties):
            if p.count is not None:
                fields.append((f"n{i}", order + p.count))
            fields.append((f"v{i}", order + p.kind, (lengths[i],)))
        dtype = np.dtype(fields)
        file.seek(start)
        n = max(1, min(rows_left, window, _CHUNK_BYTES // dtype.itemsize))
        data = bytearray(file.read(n * dtype.itemsize))
        table = np.frombuffer(data[: len(data) // dtype.itemsize * dtype.itemsize], dtype)
        same = np.ones(len(table), bool)
        for i, p in enumerate(element.properties):
            if p.count is not None:
                same &= table[f"n{i}"] == lengths[i]
        good = len(table) if same.all() else int(np.argmin(same))
        for i, p in enumerate(element.properties):
            if element.name == "face" and p.name in ("vertex_indices", "vertex_index") and p.kind[0] in "iu":
                indices = table[f"v{i}"][:good]
                if indices.size and (int(indices.min()) < 0 or int(indices.max()) >= n_vertices):
                    raise FormatError(path, Fact("ply-damaged-face", count=n_vertices))
        file.seek(good * dtype.itemsize - len(data), 1)
        rows_left -= good
        # Rows are expected to be of one length for as long as they have been so far
        window = 2 * window if good == n else max(16, good)
        yield memoryview(data)[: good * dtype.itemsize]


def _lengths(path: Path, file: BufferedReader, element: Element, order: str) -> list[int]:
    """Read one row: how many values each property has."""
    lengths = []
    for p in element.properties:
        n = 1
        if p.count is not None:
            counted = _read(path, file, memoryview(bytearray(np.dtype(p.count).itemsize)), element)
            n = int(np.frombuffer(counted, order + p.count)[0])
            if not 0 <= n <= _CHUNK_BYTES:
                raise FormatError(path, Fact("ply-list-length", length=n, element=element.name))
        _read(path, file, memoryview(bytearray(n * np.dtype(p.kind).itemsize)), element)
        lengths.append(n)
    return lengths


def _ascii(path: Path, file: BufferedReader, header: Header, similarity: Similarity, made: Header) -> Iterator[bytes]:
    number = header.lines
    n_vertices = next((e.rows for e in header.elements if e.name == "vertex"), 0)
    for element, new in zip(header.elements, made.elements, strict=True):
        names = [p.name for p in element.properties]
        mover = _mover(similarity, element)
        columns = [names.index(name) for name in mover.names]
        kinds = {p.name: (p.kind, q.kind) for p, q in zip(element.properties, new.properties, strict=True)}
        dtype = np.dtype([(name, max(kinds[name])) for name in mover.names])
        written = np.dtype([(name, kinds[name][1]) for name in mover.names])
        left = element.rows
        while left:
            lines = []
            for _ in range(min(left, 4096)):
                number += 1
                line = file.readline(_LONGEST_LINE)
                if not line.strip():
                    raise FormatError(path, Fact("ply-truncated", element=element.name), line=number)
                lines.append(line)
            rows = [
                _split_line(path, number - len(lines) + i + 1, element, line, n_vertices)
                for i, line in enumerate(lines)
            ]
            if columns:
                table = np.array([tuple(float(row[2 * c + 1]) for c in columns) for row in rows], dtype)
                mover(table)
                with np.errstate(over="ignore"):
                    table = table.astype(written)
                for column, name in zip(columns, mover.names, strict=True):
                    # numpy's shortest text that reads back as the same number of this precision
                    for row, text in zip(rows, table[name].astype("S32").tolist(), strict=True):
                        row[2 * column + 1] = text
                lines = [b"".join(row) for row in rows]
            left -= len(lines)
            yield b"".join(lines)
    rest = file.read(_CHUNK_BYTES)
    if rest.strip():
        raise FormatError(path, Fact("ply-text-follows"), line=number + 1)
    yield rest


def _split_line(path: Path, number: int, element: Element, line: bytes, n_vertices: int) -> list[bytes]:
    """A line as white space, token, white space, token, ..., white space, its values checked."""
    row = re.split(rb"(\S+)", line)
    tokens = row[1::2]
    at = 0
    try:
        for p in element.properties:
            n = 1
            if p.count is not None:
                n = _integer(tokens[at], p.count)
                at += 1
            values = tokens[at : at + n]
            if len(values) < n or n < 0:
                raise IndexError
            if p.kind[0] == "f":
                for token in values:
                    if b"_" in token:
                        raise ValueError(token)
                    float(token)
            else:
                indices = [_integer(token, p.kind) for token in values]
                points = element.name == "face" and p.name in ("vertex_indices", "vertex_index")
                if points and any(not 0 <= i < n_vertices for i in indices):
                    raise FormatError(path, Fact("ply-face-without-vertex", count=n_vertices), line=number)
            at += n
    except IndexError:
        raise FormatError(path, Fact("ply-too-few-values", element=element.name), line=number) from None
    except ValueError as error:
        raise FormatError(path, Fact("ply-not-a-value", element=element.name, detail=str(error)), line=number) from None
    if at != len(tokens):
        raise FormatError(
            path, Fact("ply-other-count", count=len(tokens), element=element.name, expected=at), line=number
        )
    return row


def _integer(token: bytes, kind: str) -> int:
    value = float(token)
    limits = np.iinfo(kind)
    if b"_" in token or not limits.min <= value <= limits.max or value != int(value):
        raise ValueError(Fact("integer-beyond-bits", text=token.decode("latin-1"), bits=limits.bits))
    return int(value)
