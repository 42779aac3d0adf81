"""Damages the bytes of files at random, and reads them."""

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import InertialError
from tests.helpers.files import write_anew

NASTY = (
    b"nan",
    b"1e999",
    b"-",
    b"9" * 40,
    b"\x00",
    b"\xff\xfe",
    b"1_0",
    b"\n\n",
    b",,",
    b"\xc2\x85",
    b"inf",
    b"[[",
    b'"',
)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three of: cut, flip a bit, exchange lines, repeat a line, write something nasty, drop bytes."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, max(1, len(data))))
        lines = data.split(b"\n")
        a, b = rng.integers(0, len(lines), 2)
        match rng.integers(0, 6):
            case 0:
                data = data[:at]
            case 1:
                flipped = bytearray(data)
                if flipped:
                    flipped[at] ^= 1 << int(rng.integers(0, 8))
                data = bytes(flipped)
            case 2:
                lines[a], lines[b] = lines[b], lines[a]
                data = b"\n".join(lines)
            case 3:
                lines.insert(a, lines[b])
                data = b"\n".join(lines)
            case 4:
                data = data[:at] + NASTY[rng.integers(0, len(NASTY))] + data[at:]
            case 5:
                data = data[:at] + data[at + int(rng.integers(1, 40)) :]
    return data


def refusals(path: Path, read: Callable[[], object], *, key: str, count: int) -> list[InertialError]:
    """The errors of reading a file damaged in ``count`` ways, none of which may be another's; it is whole before."""
    whole = path.read_bytes()
    read()
    rng = np.random.default_rng(zlib.crc32(key.encode()))
    found = []
    for i in range(count):
        damaged = mutated(whole, rng)
        write_anew(path, damaged)
        try:
            read()
        except InertialError as error:
            found.append(error)
        except Exception as error:
            error.add_note(f"mutation {i}: {damaged[:600]!r}")
            raise
    assert found
    return found
