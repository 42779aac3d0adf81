"""EXIF of images: time, place and exposure, and metadata that is copied to a deblurred image byte for byte.

Times are taken only where they tell more than whole seconds.
"""

from __future__ import annotations

import contextlib
import datetime
import re
import struct
from collections.abc import Sequence
from enum import IntEnum
from math import nan
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import HeightDatum
from colmap_inertial.io.files import read_bytes, reader, reading
from colmap_inertial.io.frame_times import FrameStamps, stamps_in_order
from colmap_inertial.io.images import PNG, TIFF_ORDERS, jpeg_segments, png_chunks, tiff_entries
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.tiff_metadata import carry_tiff_metadata

_EXIF_HEADER = b"Exif\0\0"
#: EXIF stands at the beginning of a file.
HEAD_BYTES = 256 * 1024
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


class _Tag(IntEnum):
    """EXIF tags (CIPA DC-008): directories, DateTimeOriginal and its companions, PhotographicSensitivity."""

    EXIF, GPS = 0x8769, 0x8825
    DATE, OFFSET, FRACTION = 0x9003, 0x9011, 0x9291
    EXPOSURE_TIME, SENSITIVITY = 0x829A, 0x8827


class _GpsTag(IntEnum):
    """EXIF tags of positions: GPSLatitudeRef and so on; GPSHPositioningError."""

    LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, HEIGHT_REF, HEIGHT, ERROR = 1, 2, 3, 4, 5, 6, 31


class _Type(IntEnum):
    """EXIF types of a value."""

    ASCII, SHORT = 2, 3


@reader("pictures with times")
def stamps_of_exif(folder: Path, names: Sequence[str]) -> tuple[FrameStamps, int]:
    """Take each image's time from DateTimeOriginal and SubSecTimeOriginal of its EXIF.

    Parameters
    ----------
    folder, names
        The images: JPEG, PNG or TIFF.

    Returns
    -------
    stamps
        Universal time where the EXIF states its offset, else the camera's local time.
    digits
        Of the fraction of a second, in the image with the fewest.

    Raises
    ------
    FormatError
        For an image that is missing, or whose EXIF is.
    TimingError
        For a time to whole or tenths of a second, which is too coarse to join with an IMU, and where only some images
        state their time's offset.
    """
    t_ns, digits, offsets = [], [], []
    for name in names:
        path = picture_in(folder, name)
        texts = _texts(path)
        fraction = texts.get(_Tag.FRACTION, "").strip()
        if not re.fullmatch(r"\d{2,9}", fraction):
            raise TimingError(Fact("exif-time-coarse", path=str(path), to_tenths=fraction.isdigit()))
        try:
            local = datetime.datetime.strptime(texts.get(_Tag.DATE, "").strip(), "%Y:%m:%d %H:%M:%S")
        except ValueError:
            raise FormatError(path, Fact("exif-without-date")) from None
        seconds = (local.replace(tzinfo=datetime.UTC) - _EPOCH) // datetime.timedelta(seconds=1)
        offset = re.fullmatch(r"([+-])(\d\d):(\d\d)", texts.get(_Tag.OFFSET, "").strip())
        if offset is not None:
            sign, hours, minutes = offset.groups()
            seconds -= (1 if sign == "+" else -1) * (3600 * int(hours) + 60 * int(minutes))
        offsets.append(offset is not None)
        t_ns.append(seconds * 1_000_000_000 + int(fraction.ljust(9, "0")))
        digits.append(len(fraction))
    if len(set(offsets)) > 1:
        raise TimingError(
            Fact(
                "exif-offset-of-some", path=str(folder / names[offsets.index(False)]), other=names[offsets.index(True)]
            )
        )
    return stamps_in_order(folder, list(names), np.array(t_ns, dtype=np.int64)), min(digits)


def _texts(path: Path) -> dict[int, str]:
    """The text entries of an image's EXIF directory."""
    head = read_bytes(path, HEAD_BYTES, what="picture")
    try:
        entries = _directory(head, _Tag.EXIF)
        if entries is None:
            raise FormatError(path, Fact("exif-missing"))
        tiff, order, directory = entries
        return {tag: _text(tiff, order, *entry) for tag, entry in directory.items() if entry[0] == _Type.ASCII}
    except (struct.error, KeyError):
        raise FormatError(path, Fact("exif-damaged")) from None


def _directory(head: bytes, tag: _Tag) -> tuple[bytes, str, dict[int, tuple[int, int, bytes]]] | None:
    """A directory of EXIF in the head of a JPEG, PNG or TIFF file.

    Returns
    -------
    The TIFF structure that EXIF is, its byte order for ``struct``, and type, count and value field of the directory's
    entries by tag (CIPA DC-008); ``None`` where the file has no EXIF.

    Raises
    ------
    struct.error, KeyError
        Where the EXIF is damaged or has no such directory.
    """
    tiff = _tiff(head)
    order = {b"II": "<", b"MM": ">"}.get(b"" if tiff is None else tiff[:2])
    if tiff is None or order is None:
        return None
    first = tiff_entries(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])
    return tiff, order, tiff_entries(tiff, order, struct.unpack_from(order + "I", first[tag][2])[0])


def _tiff(head: bytes) -> bytes | None:
    """The TIFF structure that EXIF is, in the head of a file."""
    if head.startswith(b"\xff\xd8"):
        exif = (head[begin + 4 : end] for marker, begin, end in jpeg_segments(head) if marker == 0xE1)
        return next((part[len(_EXIF_HEADER) :] for part in exif if part.startswith(_EXIF_HEADER)), None)
    if head.startswith(PNG):
        chunk = next((part for name, part in png_chunks(head) if name == b"eXIf"), None)
        return None if chunk is None else chunk[8 : 8 + struct.unpack_from(">I", chunk)[0]]
    return head if head[:4] in TIFF_ORDERS else None


def exposure_of(head: bytes) -> tuple[float | None, float | None]:
    """Exposure time in seconds and ISO sensitivity by the EXIF in the head of a file; ``None`` where it does not say.

    ExposureTime is a fraction, PhotographicSensitivity a whole number (CIPA DC-008).
    """
    try:
        entries = _directory(head, _Tag.EXIF)
    except (struct.error, KeyError):
        entries = None
    if entries is None:
        return None, None
    tiff, order, directory = entries
    exposure_s = iso = None
    if _Tag.EXPOSURE_TIME in directory:
        try:
            at = struct.unpack(order + "I", directory[_Tag.EXPOSURE_TIME][2])[0]
            numerator, denominator = struct.unpack_from(order + "II", tiff, at)
        except struct.error:
            numerator = denominator = 0
        exposure_s = numerator / denominator if denominator else 0.0
    if _Tag.SENSITIVITY in directory and directory[_Tag.SENSITIVITY][0] == _Type.SHORT:
        iso = float(struct.unpack_from(order + "H", directory[_Tag.SENSITIVITY][2])[0])
    return exposure_s if exposure_s is not None and 0 < exposure_s < 10 else None, iso or None


def position_of(head: bytes) -> tuple[float, float, float, float, HeightDatum] | None:
    """Position from the EXIF in the head of an image's file; ``None`` where there is none.

    Returns
    -------
    latitude_deg, longitude_deg, height_m, sigma_m, height_above
        nan where the height or the error is not stated (CIPA DC-008, table 15).
    """
    try:
        entries = _directory(head, _Tag.GPS)
        if entries is None:
            return None
        tiff, order, gps = entries
        latitude = _angle_deg(tiff, order, gps[_GpsTag.LATITUDE], gps[_GpsTag.LATITUDE_REF], "NS")
        longitude = _angle_deg(tiff, order, gps[_GpsTag.LONGITUDE], gps[_GpsTag.LONGITUDE_REF], "EW")
        wanted = (_GpsTag.HEIGHT, _GpsTag.ERROR)
        height, error = (_fractions(tiff, order, gps[tag], 1)[0] if tag in gps else nan for tag in wanted)
        side = gps[_GpsTag.HEIGHT_REF][2][0] if _GpsTag.HEIGHT_REF in gps else 0
    except (struct.error, KeyError, IndexError, ValueError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    datum: HeightDatum = "ellipsoid" if side in (2, 3) else "sea"  # 2 and 3: EXIF 3.0, above and below the ellipsoid
    return latitude, longitude, -height if side in (1, 3) else height, error if error > 0 else nan, datum


def _angle_deg(
    tiff: bytes, order: str, angle: tuple[int, int, bytes], side: tuple[int, int, bytes], letters: str
) -> float:
    """Degrees, minutes and seconds as degrees, negative on the second side."""
    letter = _text(tiff, order, *side).strip().upper()
    if len(letter) != 1 or letter not in letters:
        raise ValueError(letter)
    degrees, minutes, seconds = _fractions(tiff, order, angle, 3)
    return (degrees + minutes / 60 + seconds / 3600) * (1 if letter == letters[0] else -1)


def _fractions(tiff: bytes, order: str, entry: tuple[int, int, bytes], count: int) -> list[float]:
    """Unsigned fractions."""
    at = struct.unpack(order + "I", entry[2])[0]
    numbers = struct.unpack_from(f"{order}{2 * count}I", tiff, at)
    if entry[1] != count or 0 in numbers[1::2]:
        raise ValueError(numbers)
    return [above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True)]


def _text(tiff: bytes, order: str, kind: int, count: int, value: bytes) -> str:
    if count > 4:
        at = struct.unpack(order + "I", value)[0]
        value = tiff[at : at + count]
    return value[:count].split(b"\0")[0].decode("ascii", errors="replace")


#: Chunks of a PNG that say something about its pixels or where they come from.
_PNG_CARRIED = (b"eXIf", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"pHYs", b"tIME", b"tEXt", b"zTXt", b"iTXt")
#: JPEG application segments that belong to the coding of the pixels: JFIF's, and Adobe's colour transform.
_JPEG_CODING = (0xE0, 0xEE)


def carry_metadata(original: bytes, encoded: bytes) -> bytes:
    """A newly encoded image with the metadata of the one that it was made from: EXIF, XMP, colour profile, comments.

    Of JPEG, PNG and TIFF; other formats, and TIFFs whose directories are damaged, come back as they are.
    """
    if original.startswith(b"\xff\xd8") and encoded.startswith(b"\xff\xd8"):
        *own, (_, scan, _) = jpeg_segments(encoded)
        carried = [original[begin:end] for marker, begin, end in jpeg_segments(original) if _is_jpeg_metadata(marker)]
        first = [encoded[begin:end] for marker, begin, end in own if marker == 0xE0]
        rest = [encoded[begin:end] for marker, begin, end in own if marker != 0xE0 and not _is_jpeg_metadata(marker)]
        return b"".join([b"\xff\xd8", *first, *carried, *rest, encoded[scan:]])
    if original.startswith(PNG) and encoded.startswith(PNG):
        carried = [part for name, part in png_chunks(original) if name in _PNG_CARRIED]
        kept = [part for name, part in png_chunks(encoded) if name not in _PNG_CARRIED]
        return PNG + kept[0] + b"".join(carried) + b"".join(kept[1:])
    if original[:4] in TIFF_ORDERS and encoded[:4] in TIFF_ORDERS:
        with contextlib.suppress(struct.error):
            return carry_tiff_metadata(original, encoded)
    return encoded


def read_exposures_s(paths: list[Path]) -> Array | None:
    """(F,) exposure times by the EXIF of JPEG, PNG or TIFF files; ``None`` where one of them does not say."""
    exposures_s = []
    for path in paths:
        with reading(path):
            exposure_s, _ = exposure_of(read_bytes(path, HEAD_BYTES, what="picture"))
        if exposure_s is None:
            return None
        exposures_s.append(exposure_s)
    return np.array(exposures_s)


def _is_jpeg_metadata(marker: int) -> bool:
    return (0xE1 <= marker <= 0xEF and marker not in _JPEG_CODING) or marker == 0xFE
