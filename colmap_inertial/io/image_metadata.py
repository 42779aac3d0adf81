"""Metadata of pictures: carried over to the deblurred picture byte for byte, and the exposure time that it states."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.io.exif import HEAD_BYTES, PNG, exposure_of, jpeg_segments, png_chunks
from colmap_inertial.io.files import read_bytes

#: Chunks of a PNG that say something about its pixels or where they come from.
_PNG_CARRIED = (b"eXIf", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"pHYs", b"tIME", b"tEXt", b"zTXt", b"iTXt")
#: JPEG application segments that belong to the coding of the pixels: JFIF's, and Adobe's colour transform.
_JPEG_CODING = (0xE0, 0xEE)


def carry_metadata(original: bytes, encoded: bytes) -> bytes:
    """A newly encoded picture with the metadata of the one that it was made from: EXIF, XMP, colour profile, comments.

    Of JPEG and PNG; other formats come back as they are.
    """
    if original.startswith(b"\xff\xd8") and encoded.startswith(b"\xff\xd8"):
        carried = [part for marker, part in jpeg_segments(original) if _is_jpeg_metadata(marker)]
        own = list(jpeg_segments(encoded))
        first = b"".join(part for marker, part in own if marker == 0xE0)
        dropped = sum(len(part) for marker, part in own if marker == 0xE0 or _is_jpeg_metadata(marker))
        rest = b"".join(part for marker, part in own if not (marker == 0xE0 or _is_jpeg_metadata(marker)))
        scan = encoded[2 + dropped + len(rest) :]
        return b"\xff\xd8" + first + b"".join(carried) + rest + scan
    if original.startswith(PNG) and encoded.startswith(PNG):
        carried = [part for name, part in png_chunks(original) if name in _PNG_CARRIED]
        kept = [part for name, part in png_chunks(encoded) if name not in _PNG_CARRIED]
        return PNG + kept[0] + b"".join(carried) + b"".join(kept[1:])
    return encoded


def stated_exposures_s(paths: list[Path]) -> Array | None:
    """(F,) exposure times by the EXIF of JPEG, PNG or TIFF files; ``None`` where one of them does not say."""
    found = []
    for path in paths:
        exposure_s, _ = exposure_of(read_bytes(path, HEAD_BYTES, what="picture"))
        if exposure_s is None:
            return None
        found.append(exposure_s)
    return np.array(found)


def _is_jpeg_metadata(marker: int) -> bool:
    return (0xE1 <= marker <= 0xEF and marker not in _JPEG_CODING) or marker == 0xFE
