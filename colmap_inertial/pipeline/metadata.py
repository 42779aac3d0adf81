"""Metadata of pictures: carried over to the deblurred picture byte for byte, and the exposure time that it states."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from colmap_inertial.types import Array

_PNG = b"\x89PNG\r\n\x1a\n"
#: Chunks of a PNG that say something about its pixels or where they come from.
_PNG_CARRIED = (b"eXIf", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"pHYs", b"tIME", b"tEXt", b"zTXt", b"iTXt")
#: JPEG application segments that belong to the coding of the pixels: JFIF's, and Adobe's colour transform.
_JPEG_CODING = (0xE0, 0xEE)
_EXIF_HEADER = b"Exif\0\0"
_EXIF_POINTER, _EXPOSURE_TIME = 0x8769, 0x829A
#: EXIF stands at the beginning of a file.
_HEAD_BYTES = 256 * 1024


def carry_metadata(original: bytes, encoded: bytes) -> bytes:
    """A newly encoded picture with the metadata of the one that it was made from: EXIF, XMP, colour profile, comments.

    Of JPEG and PNG; other formats come back as they are.
    """
    if original.startswith(b"\xff\xd8") and encoded.startswith(b"\xff\xd8"):
        carried = [part for marker, part in _jpeg_segments(original) if _is_jpeg_metadata(marker)]
        own = list(_jpeg_segments(encoded))
        first = b"".join(part for marker, part in own if marker == 0xE0)
        dropped = sum(len(part) for marker, part in own if marker == 0xE0 or _is_jpeg_metadata(marker))
        rest = b"".join(part for marker, part in own if not (marker == 0xE0 or _is_jpeg_metadata(marker)))
        scan = encoded[2 + dropped + len(rest) :]
        return b"\xff\xd8" + first + b"".join(carried) + rest + scan
    if original.startswith(_PNG) and encoded.startswith(_PNG):
        carried = [part for name, part in _png_chunks(original) if name in _PNG_CARRIED]
        kept = [part for name, part in _png_chunks(encoded) if name not in _PNG_CARRIED]
        return _PNG + kept[0] + b"".join(carried) + b"".join(kept[1:])
    return encoded


def stated_exposures_s(paths: list[Path]) -> Array | None:
    """(F,) exposure times by the EXIF of JPEG, PNG or TIFF files; ``None`` where one of them does not say."""
    found = []
    for path in paths:
        with open(path, "rb") as file:
            exposure_s = _exposure_s(file.read(_HEAD_BYTES))
        if exposure_s is None:
            return None
        found.append(exposure_s)
    return np.array(found)


def _is_jpeg_metadata(marker: int) -> bool:
    return (0xE1 <= marker <= 0xEF and marker not in _JPEG_CODING) or marker == 0xFE


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Marker and bytes (marker and length included) of the segments before the scan (ITU-T T.81, annex B)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        size = struct.unpack_from(">H", data, at + 2)[0]
        yield data[at + 1], data[at : at + 2 + size]
        at += 2 + size


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and bytes of the chunks of a PNG (ISO/IEC 15948)."""
    at = len(_PNG)
    while at + 12 <= len(data):
        size = 12 + struct.unpack_from(">I", data, at)[0]
        yield data[at + 4 : at + 8], data[at : at + size]
        at += size


def _exposure_s(head: bytes) -> float | None:
    tiff = None
    if head.startswith(b"\xff\xd8"):
        exif = (part[4:] for marker, part in _jpeg_segments(head) if marker == 0xE1)
        tiff = next((part[len(_EXIF_HEADER) :] for part in exif if part.startswith(_EXIF_HEADER)), None)
    elif head.startswith(_PNG):
        tiff = next((part[8:-4] for name, part in _png_chunks(head) if name == b"eXIf"), None)
    elif head[:4] in (b"II*\0", b"MM\0*"):
        tiff = head
    try:
        return None if tiff is None else _exposure_of_tiff(tiff)
    except struct.error:
        return None


def _exposure_of_tiff(tiff: bytes) -> float | None:
    """ExposureTime of EXIF (CIPA DC-008): a fraction in seconds, in the directory that tag 0x8769 points at."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    directory = _tags(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])
    if _EXIF_POINTER not in directory:
        return None
    at = _tags(tiff, order, directory[_EXIF_POINTER]).get(_EXPOSURE_TIME)
    if at is None:
        return None
    numerator, denominator = struct.unpack_from(order + "II", tiff, at)
    exposure_s = numerator / denominator if denominator else 0.0
    return exposure_s if 0 < exposure_s < 10 else None


def _tags(tiff: bytes, order: str, at: int) -> dict[int, int]:
    """Tag and value field of a directory's entries."""
    count = struct.unpack_from(order + "H", tiff, at)[0]
    entries = (struct.unpack_from(order + "HHII", tiff, at + 2 + 12 * i) for i in range(count))
    return {tag: value for tag, _, _, value in entries}
