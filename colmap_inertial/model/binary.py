"""Whether COLMAP's binary model files are whole, and their points somewhere.

COLMAP's reader trusts every count: a damaged one makes it run for hours, ask for all memory, or go on with rubbish. So
the records are counted here first, which takes a fraction of the time of reading them.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from colmap_inertial.core.errors import FormatError

#: Number of parameters of COLMAP's camera models, by id.
_CAMERA_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
#: No camera, pose or point has a number as large as this.
LARGEST = 1e12
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_POINT = struct.Struct("<Qddd11xQ")


class _Damaged(Exception):
    pass


def check_binary_model(folder: Path) -> None:
    """Compare every file's size with the records that it says it has.

    Raises
    ------
    FormatError
        Naming the file that is truncated or damaged.
    """
    for name, walk in _WALKS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        size = path.stat().st_size
        if size < _U64.size:
            raise FormatError(path, "truncated")
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                count = _U64.unpack_from(data)[0]
                if count > size:
                    raise _Damaged(f"it claims {count} records")
                end = walk(data, count)
            except (struct.error, IndexError, OverflowError):
                raise FormatError(path, "truncated") from None
            except _Damaged as error:
                raise FormatError(path, f"damaged: {error}") from None
        if end > size:
            raise FormatError(path, "truncated")
        if end < size:
            raise FormatError(path, f"damaged: {size - end} bytes follow the last record")


def _cameras(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        _, model, width, height = _CAMERA.unpack_from(data, at)
        if not 0 <= model < len(_CAMERA_PARAMETERS):
            raise _Damaged(f"camera model {model} is unknown")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise _Damaged(f"a camera of {width} x {height} pixels")
        at += 24 + 8 * _CAMERA_PARAMETERS[model]
    return at


def _images(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise IndexError
        at = end + 9 + 24 * _U64.unpack_from(data, end + 1)[0]
    return at


def _points(data: mmap.mmap, count: int) -> int:
    at, read = 8, _POINT.unpack_from
    for _ in range(count):
        number, x, y, z, length = read(data, at)
        if not (abs(x) < LARGEST and abs(y) < LARGEST and abs(z) < LARGEST):
            raise _Damaged(f"point {number} lies at {x:g}, {y:g}, {z:g}")
        at += 51 + 8 * length
    return at


def _rigs(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        sensors = _U32.unpack_from(data, at + 4)[0]
        at += 8
        if sensors:
            at += 8
        for _ in range(sensors - 1 if sensors else 0):
            at += 9 + 56 * (data[at + 8] != 0)
    return at


def _frames(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        at += 68 + 16 * _U32.unpack_from(data, at + 64)[0]
    return at


_WALKS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}
