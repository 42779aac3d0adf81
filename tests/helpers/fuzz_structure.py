"""Damage to the structure of a file: its nodes, members, values, chunks and counts, in place of its bytes.

What a file is shows in its content. Where it cannot be taken apart, :func:`structural` gives ``None``.
"""

import io
import json
import re
import sqlite3
import struct
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

#: Stand for what no writer writes, and are replaced in the text.
RAW = {"@inf@": "1e999", "@nan@": "NaN", "@huge@": "9" * 400, "@deep@": "[" * 900 + "]" * 900, "@deeper@": "[" * 9000}
CONTROL = "\x1b]0;gone\x07\x1b[2J"
TEXTS = (
    "",
    " ",
    "x" * 5000,
    CONTROL,
    "a\nb",
    "a\0b",
    "=1+1|A1",
    "../../up",
    "/etc/passwd",
    "\u202eexe",
    "\udcff",
    "1e5",
)
NUMBERS = (0, -1, 1, 255, 2**31, 2**63, 2**64, -(2**70), 10**30, 1e308, -1e308, 5e-324, 0.5, True)
VALUES: tuple[Any, ...] = (*TEXTS, *NUMBERS, None, [], {}, [[]], [1], [1, "a"], {"a": 1}, [None] * 40, *RAW)
CELLS = (
    *(b"", b"nan", b"-inf", b"1e999", b"1e-999", b"9" * 400, b"-1", b"0x10", b"1_0", b'"', b"=1+1", b"\xff\xfe"),
    *(CONTROL.encode(), b"../../up.png", b"/etc/passwd", b"a\0b", b"\xe2\x80\xae", b"x" * 5000, b"," * 300, b"#"),
)
COUNTS = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)

Rng = np.random.Generator


def _any(rng: Rng, values: Any) -> Any:
    return values[int(rng.integers(0, len(values)))]


def structural(data: bytes, rng: Rng) -> bytes | None:
    """A copy with one to three changes of its structure."""
    change = _change_of(data)
    if change is None:
        return None
    try:
        for _ in range(int(rng.integers(1, 4))):
            changed = change(data, rng)
            if changed is None:
                break
            data = changed
    except Exception:  # an earlier change took apart what this one would change
        return None
    return data


def _change_of(data: bytes) -> Callable[[bytes, Rng], bytes | None] | None:
    beginnings: dict[bytes, Callable[[bytes, Rng], bytes | None]] = {
        b"PK\3\4": _zip,
        b"SQLite format 3\0": _sqlite,
        b"\x89PNG": _png,
        b"\xff\xd8": _jpeg,
        b"II*\0": _tiff,
        b"ply": _ply,
        b"{": _json,
        b"[": _brackets,
    }
    for begin, change in beginnings.items():
        if data.startswith(begin):
            return change
    if data[4:8] in (b"ftyp", b"moov", b"mdat", b"free"):
        return _boxes
    if b"\0" in data:
        return _counts
    head = data[:4000].decode("utf-8", "replace")
    if re.search(r"^\[?[\w.\"]+\]?\s*=|^\[\[?[\w.]+\]\]?\s*$", head, re.M):
        return _toml
    if re.search(r"^[\w\"]+:(\s|$)", head, re.M):
        return _yaml
    return _table


# --- trees ----------------------------------------------------------------------------------------------------------


def _places(node: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Every container and key in a tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        found.append((node, key))
        _places(value, found)
    return found


def _change_tree(tree: Any, rng: Rng, values: tuple[Any, ...] = VALUES) -> None:
    places = _places(tree, [])
    if not places:
        return
    node, key = _any(rng, places)
    match int(rng.integers(0, 8)):
        case 0:
            del node[key]
        case 1:
            other, at = _any(rng, places)
            node[key] = json.loads(json.dumps(other[at]))
        case 2:
            node[key] = [node[key]]
        case 3:
            node[key] = {"a": node[key]}
        case 4 if isinstance(node, dict):
            node[str(_any(rng, TEXTS))] = node.pop(key)
        case 5 if isinstance(node[key], list) and node[key]:
            node[key] = node[key][: int(rng.integers(0, len(node[key]) + 1))] * int(rng.integers(1, 4))
        case _:
            node[key] = _any(rng, values)


def _with_raw(text: str) -> bytes:
    for name, raw in RAW.items():
        text = text.replace(f'"{name}"', raw)
    return text.encode("utf-8", "surrogatepass")


def _json(data: bytes, rng: Rng) -> bytes:
    tree = json.loads(data)
    if rng.random() < 0.03:
        return _with_raw(json.dumps(_any(rng, VALUES)))
    _change_tree(tree, rng)
    return _with_raw(json.dumps(tree, ensure_ascii=bool(rng.random() < 0.5)))


def _brackets(data: bytes, rng: Rng) -> bytes | None:
    """JSON's list, or a table of TOML."""
    try:
        return _json(data, rng)
    except ValueError:
        return _toml(data, rng)


#: What TOML can hold.
TOML_VALUES = tuple(value for value in VALUES if value is not None and value != [None] * 40 and value != "\udcff")


def _toml(data: bytes, rng: Rng) -> bytes | None:
    if b"a.a.a" in data:  # from an earlier change; a parser without limits takes memory by the square of its parts
        return None
    if rng.random() < 0.03:
        key = ".".join(["a"] * int(_any(rng, (20, 6000, 150_000))))
        return data + _any(rng, ("\n[{}]\n", "\n{} = 1\n", "\nx = {{ {} = 1 }}\n")).format(key).encode()
    tree = tomllib.loads(data.decode())
    _change_tree(tree, rng, TOML_VALUES)
    return _with_raw(tomli_w.dumps(tree))


def _yaml(data: bytes, rng: Rng) -> bytes:
    """Values behind keys and in lists, as the lines have them."""
    text = data.decode("utf-8", "replace")
    spots = [match.span(1) for match in re.finditer(r"(?:[:,\[]|- )\s*([^\s,\[\]{}:][^,\n\[\]{}]*)", text)]
    if not spots:
        return _table(data, rng)
    begin, end = _any(rng, spots)
    value = _any(rng, VALUES)
    new = RAW.get(value, json.dumps(value)) if isinstance(value, str) else json.dumps(value)
    more = (new, "&a [*a]", "!!python/object:os.system x", "{a: 1}", "", "*gone", "2020-01-01", "!!binary x")
    return (text[:begin] + str(_any(rng, more) if rng.random() < 0.3 else new) + text[end:]).encode("utf-8", "replace")


# --- containers -----------------------------------------------------------------------------------------------------


@cache
def _packed_bomb(name: str, line: bytes) -> bytes:
    """A zip of a few hundred kB that unpacks to 100 MB."""
    out, part = io.BytesIO(), line * ((1 << 20) // len(line))
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as file:
        for _ in range(100):
            file.write(part)
    return out.getvalue()


def _zip(data: bytes, rng: Rng) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist() if info.file_size < 1 << 24]
    if not members:
        return _counts(data, rng)
    at = int(rng.integers(0, len(members)))
    name, content = members[at]
    methods = [zipfile.ZIP_DEFLATED] * len(members)
    match int(rng.integers(0, 7)):
        case 0:
            methods[at] = _any(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
        case 1:
            del members[at], methods[at]
        case 2:
            members.append((name, _table(content, rng)))
            methods.append(zipfile.ZIP_DEFLATED)
        case 3:
            members[at] = (str(_any(rng, ("../up.csv", "/abs.csv", f"{CONTROL}.csv", "a/" * 300 + "a.csv"))), content)
        case 4 if rng.random() < 0.1:
            return _packed_bomb(name, _any(rng, (b"1,2\n", b"0,0,0,0,0\n", bytes(64))))
        case _:
            members[at] = (name, _table(content, rng))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for (name, content), method in zip(members, methods, strict=True):
            info = zipfile.ZipInfo(name[:60000])
            info.compress_type = method
            archive.writestr(info, content)
    packed = bytearray(out.getvalue())
    if rng.random() < 0.3:  # a field of a header: version, flags, method, sizes
        mark, fields = _any(rng, ((b"PK\3\4", (4, 6, 8, 14, 18, 22, 26)), (b"PK\1\2", (6, 8, 10, 16, 20, 24, 28, 42))))
        heads = [match.start() for match in re.finditer(re.escape(mark), packed)]
        at = _any(rng, heads) + _any(rng, fields)
        value = _any(rng, COUNTS) & 0xFFFF if rng.random() < 0.5 else _any(rng, (1, 9, 12, 14, 99))
        packed[at : at + 2] = struct.pack("<H", value)
    return bytes(packed)


def _sqlite(data: bytes, rng: Rng) -> bytes:
    with tempfile.NamedTemporaryFile(suffix=".db") as file:
        file.write(data)
        file.flush()
        opened = sqlite3.connect(file.name)
        try:
            opened.execute("PRAGMA journal_mode=MEMORY")
            # an update may fire an endless trigger of an earlier change
            opened.set_progress_handler(lambda: 1, 10_000_000)
            tables = [row[0] for row in opened.execute("SELECT name FROM sqlite_master WHERE type='table'")]
            table = _any(rng, [name for name in tables if not name.startswith("sqlite_")])
            columns = [row[1] for row in opened.execute(f'PRAGMA table_info("{table}")')]
            column = _any(rng, columns)
            row = f'rowid IN (SELECT rowid FROM "{table}" ORDER BY rowid LIMIT 1 OFFSET {int(rng.integers(0, 4))})'
            values = (None, 0, -1, 2**31, 2**62, -(2**63), 1e308, "text", CONTROL, "../../up.png")
            value = _any(rng, (*values, b"", b"\0" * 7, b"\xff" * 96))
            endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 1000000000000) SELECT"
            match int(rng.integers(0, 10)):
                case 8:
                    named = ", ".join(f'x AS "{name}"' for name in columns)
                    opened.execute(f'DROP TABLE "{table}"')
                    opened.execute(f'CREATE VIEW "{table}" AS {endless} {named} FROM n')
                case 9:
                    event = _any(rng, ("INSERT", "UPDATE", "DELETE"))
                    body = f"SELECT 1 WHERE ({endless} count(*) FROM n) > 5;"
                    opened.execute(f'CREATE TRIGGER slow AFTER {event} ON "{table}" BEGIN {body} END')
                case 0:
                    opened.execute(f'DELETE FROM "{table}" WHERE {row}')
                case 1:
                    opened.execute(f'ALTER TABLE "{table}" RENAME TO "{_any(rng, ("gone", CONTROL))}"')
                case 2:
                    opened.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "gone"')
                case 3:
                    opened.execute(f'ALTER TABLE "{table}" ADD COLUMN "more" BLOB')
                case 4:
                    opened.execute(f"PRAGMA user_version = {int(rng.integers(0, 2**31))}")
                case _:
                    opened.execute(f'UPDATE OR REPLACE "{table}" SET "{column}" = ? WHERE {row}', (value,))
            opened.commit()
        finally:
            opened.close()
        return Path(file.name).read_bytes()


def _boxes(data: bytes, rng: Rng) -> bytes:
    """Boxes of MP4 and QuickTime: their sizes, names, order, and the counts that they begin with."""
    found: list[tuple[int, int, int]] = []
    inside = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf")

    def walk(begin: int, end: int) -> None:
        while begin + 8 <= end:
            size, name = struct.unpack_from(">I4s", data, begin)
            if size < 8 or begin + size > end:
                return
            found.append((begin, begin + size, end))
            if name in inside:
                walk(begin + 8, begin + size)
            begin += size

    walk(0, len(data))
    if not found:
        return _counts(data, rng)
    begin, end, _ = _any(rng, found)
    out = bytearray(data)
    match int(rng.integers(0, 6)):
        case 0:
            out[begin : begin + 4] = struct.pack(">I", _any(rng, COUNTS) & 0xFFFFFFFF)
        case 1:
            out[begin + 4 : begin + 8] = _any(rng, (b"free", b"moov", b"trak", b"stsz", b"meta", b"\0\0\0\0"))
        case 2:
            return data[:begin] + data[end:]
        case 3 if end - begin < 1 << 16:
            return data[:end] + data[begin:end] * int(rng.integers(1, 4)) + data[end:]
        case _:
            at = begin + 8 + 4 * int(rng.integers(0, max(1, min(8, (end - begin - 8) // 4))))
            out[at : at + 4] = struct.pack(">I", _any(rng, COUNTS) & 0xFFFFFFFF)
    return bytes(out)


def _png(data: bytes, rng: Rng) -> bytes:
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack_from(">I", data, at)[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    at = int(rng.integers(0, len(chunks)))
    name, body = chunks[at]
    match int(rng.integers(0, 6)):
        case 0:
            del chunks[at]
        case 1:
            chunks.insert(int(rng.integers(0, len(chunks))), (name, body))
        case 2:
            chunks[at] = (_any(rng, (b"IDAT", b"PLTE", b"eXIf", b"tEXt", b"acTL", b"\1\2\3\4")), body)
        case 3:
            chunks[at] = (name, body[: int(rng.integers(0, len(body) + 1))])
        case 4:
            size = (_any(rng, COUNTS) & 0xFFFFFFFF for _ in range(2))
            kinds = (_any(rng, (0, 1, 2, 3, 4, 6, 8, 16, 255)) for _ in range(5))
            chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *size, *kinds))
        case _:
            out = bytearray(chunks[0][1])
            if len(out) == 13:
                out[int(rng.integers(0, 13))] = int(_any(rng, (0, 1, 2, 3, 4, 8, 16, 255)))
                chunks[0] = (b"IHDR", bytes(out))
    packed = (struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks)
    return data[:8] + b"".join(packed)


def _jpeg(data: bytes, rng: Rng) -> bytes:
    spans, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        spans.append((at, end))
        if data[at + 1] == 0xDA:
            break
        at = end
    if not spans:
        return _counts(data, rng)
    begin, end = _any(rng, spans)
    out = bytearray(data)
    match int(rng.integers(0, 5)):
        case 0:
            return data[:begin] + data[end:]
        case 1:
            return data[:end] + data[begin:end] * int(rng.integers(1, 3)) + data[end:]
        case 2:
            out[begin + 1] = int(_any(rng, (0xC0, 0xC2, 0xC4, 0xD8, 0xD9, 0xDA, 0xDB, 0xE1, 0xFE)))
        case 3:
            out[begin + 2 : begin + 4] = struct.pack(">H", _any(rng, COUNTS) & 0xFFFF)
        case _:  # a value within: of a frame its size and components, of EXIF its entries
            at = begin + 4 + int(rng.integers(0, max(1, min(96, end - begin - 6))))
            out[at : at + 2] = struct.pack(_any(rng, ("<H", ">H")), _any(rng, COUNTS) & 0xFFFF)
    return bytes(out)


def _tiff(data: bytes, rng: Rng) -> bytes:
    """Entries of the first directory: tag, type, count, value."""
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    out, entry = bytearray(data), at + 2 + 12 * int(rng.integers(0, max(1, count)))
    match int(rng.integers(0, 5)):
        case 0:
            struct.pack_into("<H", out, at, _any(rng, COUNTS) & 0xFFFF)
        case 1:
            struct.pack_into("<H", out, entry, _any(rng, (256, 257, 258, 259, 273, 277, 278, 339, 0x8769, 0xFFFF)))
        case 2:
            struct.pack_into("<H", out, entry + 2, int(rng.integers(0, 20)))
        case 3:
            struct.pack_into("<I", out, entry + 4, _any(rng, COUNTS) & 0xFFFFFFFF)
        case _:
            struct.pack_into("<I", out, entry + 8, _any(rng, COUNTS) & 0xFFFFFFFF)
    return bytes(out)


# --- rows -----------------------------------------------------------------------------------------------------------


def _ply(data: bytes, rng: Rng) -> bytes:
    head, end, body = data.partition(b"end_header\n")
    lines = head.split(b"\n")
    at = int(rng.integers(1, max(2, len(lines) - 1)))
    words = lines[at].split(b" ")
    match int(rng.integers(0, 6)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[int(rng.integers(1, len(lines)))])
        case 2:
            lines[at] = b"element vertex " + str(_any(rng, COUNTS)).encode()
        case 3:
            kinds = (b"uchar int x", b"float int y", b"int double x", b"uchar uchar vertex_indices")
            lines[at] = b"property list " + _any(rng, kinds)
        case 4:
            other = (b"double", b"uchar", b"list", b"vertex", b"x", b"ascii", b"binary_big_endian", *CELLS)
            words[int(rng.integers(0, len(words)))] = _any(rng, other)
            lines[at] = b" ".join(words)
        case _:
            counts = (len(body) * 4, len(body), 0, 1, 10**9, 10**15, 10**30)
            lines[at] = re.sub(rb"\d+$", str(_any(rng, counts)).encode(), lines[at])
    return b"\n".join(lines) + end + body


def _table(data: bytes, rng: Rng) -> bytes:
    """Cells, columns and rows."""
    lines = data.split(b"\n")
    at = int(rng.integers(0, min(len(lines), 6))) if rng.random() < 0.5 else int(rng.integers(0, len(lines)))
    mark = next((one for one in (b",", b";", b"\t", b" ") if one in lines[at]), b",")
    cells = lines[at].split(mark)
    cell = int(rng.integers(0, len(cells)))
    match int(rng.integers(0, 7)):
        case 0:
            lines = [mark.join(line.split(mark)[:cell] + line.split(mark)[cell + 1 :]) for line in lines]
        case 1:
            lines = [
                mark.join([*line.split(mark)[:cell], _any(rng, CELLS), *line.split(mark)[cell:]]) for line in lines
            ]
        case 2:
            lines = lines[: at + 1] * int(rng.integers(1, 4)) + lines[at:]
        case 3:
            lines = [line.replace(mark, _any(rng, (b",", b";", b"\t", b" ", mark * 2))) for line in lines]
        case _:
            cells[cell] = _any(rng, CELLS)
            lines[at] = mark.join(cells)
    return b"\n".join(lines)


def _counts(data: bytes, rng: Rng) -> bytes:
    """Of binary records: a count or size, at a place where one may stand."""
    kind = _any(rng, ("<I", ">I", "<Q", ">Q", "<H", "<d"))
    size = struct.calcsize(kind)
    value = (
        float(_any(rng, (np.nan, np.inf, -1.0, 1e308, 0.0))) if kind == "<d" else _any(rng, COUNTS) % 2 ** (8 * size)
    )
    places = max(1, min(len(data), int(_any(rng, (16, 64, 400, len(data))))) - size)
    at = 4 * int(rng.integers(0, places // 4 + 1)) if rng.random() < 0.7 else int(rng.integers(0, places))
    return data[:at] + struct.pack(kind, value) + data[at + size :]
