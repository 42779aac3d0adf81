"""Decoding single pictures exactly as COLMAP sees them."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import UInt8Array, UInt16Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.limits import read_limits

#: File endings of pictures that both OpenCV and the published builds of pycolmap read (the latter read no WebP).
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")

#: OpenCV's level of logging that says nothing.
_SILENT = 0


def read_image(path: Path) -> UInt8Array | UInt16Array:
    """Decode a picture: (H, W) or (H, W, 3) RGB, in the file's own depth, rows as stored.

    The orientation that EXIF may state is not applied, as COLMAP does not apply it either (pycolmap 4.2's
    ``Bitmap.read``). An alpha channel is dropped.

    Raises
    ------
    FormatError
        Where the file is missing, damaged, cut off, too large, or not 8 or 16 bit.
    """
    import cv2

    data = read_bytes(path, what="picture")
    require_modest(path, data)
    fault = _fault(data)
    if fault is not None:
        raise FormatError(path, f"{fault}; copy it again from its source, or take it out of the folder")
    logging = getattr(cv2.utils, "logging", cv2)  # before OpenCV 4.13 it stood in cv2 itself
    level = logging.setLogLevel(_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        logging.setLogLevel(level)
    if image is None:
        raise FormatError(path, "cannot be decoded: damaged, cut off, or no picture; take it out of the folder")
    if image.dtype not in (np.uint8, np.uint16):
        raise FormatError(path, f"holds {image.dtype} pixels; 8 or 16 bit are needed")
    if image.ndim == 3 and image.shape[2] in (3, 4):
        image = np.ascontiguousarray(image[:, :, 2::-1])
    elif image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, 0])
    return image


def require_modest(path: Path, data: bytes) -> None:
    """Refuse a picture by what its header says, before it takes the memory.

    Raises
    ------
    FormatError
        For more pixels than the limits allow.
    """
    size, most = _stated_size(data), read_limits().megapixels
    if size is not None and size[0] * size[1] > 1e6 * most:
        raise FormatError(
            path,
            f"has {size[0]} x {size[1]} pixels; more than {most:g} million are not decoded: make it smaller, take it "
            "out of the folder, or raise --limits.megapixels",
        )


def _stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the header of a PNG, JPEG, BMP, PGM, PPM or TIFF; ``None`` where it does not tell."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
            return abs(width), abs(height)
        if pnm := re.match(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", data[:4096]):
            return int(pnm[1]), int(pnm[2])
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(data)
    except (struct.error, IndexError):
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while data[at : at + 1] == b"\xff":
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """By the first directory (TIFF 6.0): tags 256 and 257, SHORT or LONG."""
    order = "<" if data.startswith(b"II") else ">"
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    found = {}
    for i in range(struct.unpack_from(f"{order}H", data, start)[0]):
        tag, kind = struct.unpack_from(f"{order}HH", data, start + 2 + 12 * i)
        if tag in (256, 257):
            found[tag] = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, start + 10 + 12 * i)[0]
    return (found[256], found[257]) if len(found) == 2 else None


def grey_8bit(image: UInt8Array | UInt16Array) -> UInt8Array:
    """(H, W) brightness of an image in 8 bit."""
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(grey if grey.dtype == np.uint8 else grey >> 8, dtype=np.uint8)


def _fault(data: bytes) -> str | None:
    """What is wrong with the bytes of a picture, as far as its format tells; decoders pass over some of it."""
    if not data:
        return "is empty"
    if data.startswith(b"\xff\xd8"):
        return _jpeg_fault(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_fault(data)
    return None


def _jpeg_fault(data: bytes) -> str | None:
    """JPEG (ITU-T T.81, annex B): segments up to the first scan, then coded data that an EOI marker ends."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return "is damaged (a JPEG segment does not start with a marker)"
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
        if marker == 0xDA:
            return None if data.find(b"\xff\xd9", at) >= 0 else "is cut off (no end of image)"
    return "is cut off (no picture data)"


def _png_fault(data: bytes) -> str | None:
    """PNG (ISO/IEC 15948): chunks with a CRC each, the last one IEND."""
    at = 8
    while at + 12 <= len(data):
        length = struct.unpack_from(">I", data, at)[0]
        body = memoryview(data)[at + 4 : at + 8 + length]
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(body) != struct.unpack_from(">I", data, end - 4)[0]:
            return "is damaged (a PNG checksum is wrong)"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end
    return "is cut off (no end of image)"
