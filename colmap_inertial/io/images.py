"""Decoding single images exactly as COLMAP sees them."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import UInt8Array, UInt16Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_bytes, read_limits, reader
from colmap_inertial.io.stand_ins import foreign_picture, what_stands_in

#: File endings of images that both OpenCV and the published builds of pycolmap read (the latter read no WebP).
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")

PNG = b"\x89PNG\r\n\x1a\n"
#: Order of bytes as of ``struct``, by the beginning of a TIFF.
TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
#: Images of photographs are not packed more tightly, each byte of a file for so many of pixels.
_PACKED = 20
#: Bytes of memory for each of a JPEG. Photographs of this many pixels have more than .5 bits each, or .7 in scans.
_JPEG_PACKED = 100
#: Markers of JPEG: C4, C8 and CC are none of frames.
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
START_OF_SCAN = 0xDA
#: Progressive ones, whose coefficients the decoder holds, all of the image.
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)


@reader("a picture")
def read_image(path: Path) -> UInt8Array | UInt16Array:
    """Decode an image: (H, W) or (H, W, 3) RGB, in the file's own depth, rows as stored.

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
        raise FormatError(path, fault)
    logging = getattr(cv2.utils, "logging", cv2)  # before OpenCV 4.13 it stood in cv2 itself
    level = logging.setLogLevel(0)  # nothing is logged
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        logging.setLogLevel(level)
    if image is None:
        raise FormatError(path, Fact("picture-not-decoded"))
    if image.dtype not in (np.uint8, np.uint16):
        raise FormatError(path, Fact("picture-depth", dtype=str(image.dtype)))
    if image.ndim == 3 and image.shape[2] in (3, 4):
        to_rgb = cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB
        image = cv2.cvtColor(image, to_rgb, image if image.shape[2] == 3 else None)
    elif image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, 0])
    return image


def read_alpha(data: bytes) -> UInt8Array | UInt16Array | None:
    """(H, W) alpha of a PNG, TIFF or WebP that can be decoded; ``None`` where it has none."""
    import cv2

    if data[:4] in TIFF_ORDERS:
        has_alpha = _tiff_number(data, TIFF_ORDERS[data[:4]], 277, 1) == 4  # samples of a pixel
    elif data.startswith(PNG):
        # colours of a palette may have some, too
        has_alpha = data[25] in (4, 6) or (data[25] == 3 and b"tRNS" in data[: data.find(b"IDAT")])
    else:
        has_alpha = data.startswith(b"RIFF") and _has_webp_alpha(data)
    if not has_alpha:
        return None
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return None
    return np.ascontiguousarray(image[..., 3])


def require_modest(path: Path, data: bytes) -> None:
    """Refuse an image by what its header says, before it takes the memory.

    Raises
    ------
    FormatError
        For more pixels than the limits allow, and where no header that is read here states how many there are.
    """
    size, most = _read_size(data), read_limits().megapixels
    if size is None:
        found = what_stands_in(data[:512]) or foreign_picture(data[:64])
        raise FormatError(path, found or Fact("picture-not-decoded") if data else Fact("is-empty"))
    weight = _weigh(data, size[0] * size[1])
    if size[0] * size[1] * weight > 1e6 * most:
        too_large = Fact("picture-too-large", width=size[0], height=size[1], most_megapixels=most / weight)
        raise FormatError(path, too_large)


def _weigh(data: bytes, pixels: int) -> float:
    """Memory of a pixel of a PNG, TIFF or JPEG in pixels of three bytes: these formats compress millions of pixels to
    nothing.
    """
    if data.startswith(b"\xff\xd8"):
        # decoded and with its colours in order; beside coefficients of two bytes
        held = 3.0 if _is_in_scans(data) else 2.0
        return held if 3 * held * pixels > _JPEG_PACKED * len(data) else 1.0
    if data.startswith(PNG):
        # with alpha it is there twice until that is dropped
        pixel_bytes = data[24] / 8 * {0: 1, 4: 7, 6: 7}.get(data[25], 3)
    elif data[:4] in TIFF_ORDERS:
        bits, channels = (_tiff_number(data, TIFF_ORDERS[data[:4]], tag, 1) for tag in (258, 277))
        pixel_bytes = bits / 8 * channels
    else:
        return 1.0
    # OpenCV holds it twice; a file that is hardly packed is as large on the disk
    return max(1.0, (2 if pixels * pixel_bytes > _PACKED * len(data) else 1) * pixel_bytes / 3)


def _is_in_scans(data: bytes) -> bool:
    """Whether a JPEG's pixels come in several scans: progressive, or the colours one after the other."""
    components = 0
    for marker, begin, _ in jpeg_segments(data):
        if marker in _PROGRESSIVE:
            return True
        if marker in START_OF_FRAME:
            components = data[begin + 9]
        elif marker == START_OF_SCAN:
            return data[begin + 4] < components
    return False


def _read_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the header of a PNG, JPEG, BMP, PGM, PPM, TIFF, WebP or JPEG 2000; ``None`` where it does
    not tell.
    """
    try:
        if data.startswith(PNG) and len(data) > 25:
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            frames = (begin for marker, begin, _ in jpeg_segments(data) if marker in START_OF_FRAME)
            begin = next(frames, None)
            return None if begin is None else struct.unpack_from(">HH", data, begin + 5)[::-1]
        if data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
            return abs(width), abs(height)
        if pnm := re.match(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", data[:4096]):
            return int(pnm[1]), int(pnm[2])
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data.startswith((b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51")):
            return _jpeg2000_size(data)
        if data[:4] in TIFF_ORDERS:
            width, height = (_tiff_number(data, TIFF_ORDERS[data[:4]], tag, 0) for tag in (256, 257))
            return (width, height) if width and height else None
    except (struct.error, IndexError):
        pass
    return None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a WebP (RFC 9649)."""
    if data[12:16] == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height
    if data[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", data, 26)
    return (width & 0x3FFF, height & 0x3FFF) if data[12:16] == b"VP8 " else None


def _has_webp_alpha(data: bytes) -> bool:
    """Whether a WebP says that it has alpha (RFC 9649)."""
    if data[12:16] == b"VP8X":
        return bool(data[20] & 0x10)
    return data[12:16] == b"VP8L" and bool(data[24] & 0x10)


def _jpeg2000_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a JPEG 2000 file, or bare code stream (ISO/IEC 15444-1)."""
    if data.startswith(b"\xff\x4f"):
        right, bottom, left, top = struct.unpack_from(">IIII", data, 8)
        return right - left, bottom - top
    at = data.find(b"ihdr", 0, 4096)
    return None if at < 0 else struct.unpack_from(">II", data, at + 4)[::-1]


def _tiff_number(data: bytes, order: str, tag: int, default: int) -> int:
    """The first value of a tag of the first directory, SHORT or LONG."""
    kind, count, value = tiff_entries(data, order, struct.unpack_from(f"{order}I", data, 4)[0]).get(tag, (0, 0, b""))
    if not count:
        return default
    letter, size = ("H", 2) if kind == 3 else ("I", 4)
    if count * size > len(value):  # what does not fit is elsewhere in the file
        return int(struct.unpack_from(order + letter, data, struct.unpack(f"{order}I", value)[0])[0])
    return int(struct.unpack_from(order + letter, value)[0])


def grey_8bit(image: UInt8Array | UInt16Array) -> UInt8Array:
    """(H, W) brightness of an image in 8 bit."""
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(grey if grey.dtype == np.uint8 else grey >> 8, dtype=np.uint8)


def _fault(data: bytes) -> Fact | None:
    """Fault in the bytes of an image, where its format shows it; decoders pass over some of them."""
    if data.startswith(b"\xff\xd8"):
        return _jpeg_fault(data)
    if data.startswith(PNG):
        return _png_fault(data)
    return None


def _jpeg_fault(data: bytes) -> Fact | None:
    """Segments up to the first scan, then coded data that an EOI marker ends."""
    end = 2
    for marker, _, end in jpeg_segments(data):
        if marker == START_OF_SCAN:
            return None if data.find(b"\xff\xd9", end) >= 0 else Fact("picture-without-end")
    if end + 4 <= len(data) and data[end] != 0xFF:
        return Fact("jpeg-segment-damaged")
    return Fact("picture-without-data")


def _png_fault(data: bytes) -> Fact | None:
    """Chunks with a CRC each, the last one IEND."""
    for name, chunk in png_chunks(data):
        if len(chunk) != 12 + struct.unpack_from(">I", chunk)[0]:
            break
        if zlib.crc32(memoryview(chunk)[4:-4]) != struct.unpack_from(">I", chunk, len(chunk) - 4)[0]:
            return Fact("png-checksum-wrong")
        if name == b"IEND":
            return None
    return Fact("picture-without-end")


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, begin and end of the segments up to the first scan, its header included (ITU-T T.81, annex B)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        yield marker, at, end
        if marker == START_OF_SCAN:
            return
        at = end


def png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and bytes (length, name and CRC included) of the chunks of a PNG (ISO/IEC 15948)."""
    at = len(PNG)
    while at + 12 <= len(data):
        size = 12 + struct.unpack_from(">I", data, at)[0]
        yield data[at + 4 : at + 8], data[at : at + size]
        at += size


def tiff_entries(tiff: bytes, order: str, at: int) -> dict[int, tuple[int, int, bytes]]:
    """Type, count and value field of a directory's entries, by tag (TIFF 6.0); ``order`` of bytes as of ``struct``."""
    (count,) = struct.unpack_from(order + "H", tiff, at)
    entries = {}
    for i in range(count):
        tag, kind, n, value = struct.unpack_from(order + "HHI4s", tiff, at + 2 + 12 * i)
        entries[tag] = (kind, n, value)
    return entries
