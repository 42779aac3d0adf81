"""Metadata of a TIFF that is carried to another one: its entries, with their values, are written again at its end."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from colmap_inertial.io.images import TIFF_ORDERS, tiff_entries


@dataclass(frozen=True, kw_only=True)
class TiffLayout:
    """Entries that are carried, and sizes of values (TIFF 6.0)."""

    #: ImageDescription, Make, Model, Orientation, DateTime, Artist, XMP, Copyright, IPTC, ICC profile.
    carried: frozenset[int] = frozenset({270, 271, 272, 274, 306, 315, 700, 33432, 33723, 34675})
    #: Directories: of EXIF, of GPS, and inside EXIF of interoperability (CIPA DC-008).
    directories: frozenset[int] = frozenset({34665, 34853, 40965})
    #: Bytes of a value by its type, from 0 on; those of fractions are two numbers.
    type_bytes: tuple[int, ...] = (0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8)
    fractions: frozenset[int] = frozenset({5, 10})


_LAYOUT = TiffLayout()

#: Type, count and value.
_Values = dict[int, tuple[int, int, bytes]]


def carry_tiff_metadata(original: bytes, encoded: bytes) -> bytes:
    """A newly encoded TIFF with device, date, EXIF, position, comments and colour profile of another one.

    Raises
    ------
    struct.error
        Where the directories of the original are damaged.
    """
    source, target = TIFF_ORDERS[original[:4]], TIFF_ORDERS[encoded[:4]]
    begin = struct.unpack_from(target + "I", encoded, 4)[0]
    entries = tiff_entries(encoded, target, begin)
    end = begin + 2 + 12 * len(entries)
    out = bytearray(encoded)
    made = {tag: struct.pack(target + "HHI", tag, kind, n) + value for tag, (kind, n, value) in entries.items()}
    first = tiff_entries(original, source, struct.unpack_from(source + "I", original, 4)[0])
    wanted = {tag: entry for tag, entry in first.items() if tag in _LAYOUT.carried | _LAYOUT.directories}
    made |= _append_entries(original, wanted, source, target, out)
    following = encoded[end : end + 4]
    at = _append(_directory(made, target) + following, out)
    struct.pack_into(target + "I", out, 4, at)
    return bytes(out)


def _append_entries(original: bytes, entries: _Values, source: str, target: str, out: bytearray) -> dict[int, bytes]:
    """Entries of a directory in another order of bytes; values that do not fit into them are appended."""
    made = {}
    for tag, (kind, count, field) in entries.items():
        if tag in _LAYOUT.directories:
            inner = tiff_entries(original, source, struct.unpack(source + "I", field)[0])
            inside = _append_entries(original, inner, source, target, out)
            value = struct.pack(target + "I", _append(_directory(inside, target) + bytes(4), out))
            made[tag] = struct.pack(target + "HHI", tag, 4, 1) + value
            continue
        each = _LAYOUT.type_bytes[kind] if kind < len(_LAYOUT.type_bytes) else 0
        size = each * count
        if not size:
            continue
        at = struct.unpack(source + "I", field)[0]
        value = field[:size] if size <= 4 else original[at : at + size]
        if len(value) < size:
            continue
        value = _reorder_bytes(value, each // 2 if kind in _LAYOUT.fractions else each, source != target)
        if size > 4:
            value = struct.pack(target + "I", _append(value, out))
        made[tag] = struct.pack(target + "HHI", tag, kind, count) + value.ljust(4, b"\0")
    return made


def _directory(entries: dict[int, bytes], order: str) -> bytes:
    return struct.pack(order + "H", len(entries)) + b"".join(entries[tag] for tag in sorted(entries))


def _append(data: bytes, out: bytearray) -> int:
    """Appended at an even place; returns it."""
    out.extend(bytes(len(out) % 2))
    at = len(out)
    out.extend(data)
    return at


def _reorder_bytes(value: bytes, part: int, turned: bool) -> bytes:
    if not turned or part == 1:
        return value
    return b"".join(value[i : i + part][::-1] for i in range(0, len(value), part))
