"""Quality and colour sampling of a JPEG, so that an image made of it is coded alike."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from colmap_inertial.io.images import START_OF_FRAME, jpeg_segments


@dataclass(frozen=True, kw_only=True)
class JpegLimits:
    """Limits of the quality."""

    #: Sum of the table of quantisation for luminance that quality 50 of the IJG's library stands for: ITU-T T.81, K.1.
    table_sum: float = 3688.0
    #: Quality is kept between these: below, deblurred noise would show blocks; above, files grow for nothing.
    least_quality: int = 85
    most_quality: int = 98
    #: Sampling of luminance, across and down, that OpenCV can write; chrominance has 1 x 1.
    written: frozenset[int] = frozenset({0x11, 0x12, 0x21, 0x22, 0x41})
    #: Marker of tables of quantisation.
    tables_marker: int = 0xDB


JPEG_LIMITS = JpegLimits()


def read_jpeg_coding(data: bytes) -> tuple[int, int | None]:
    """Quality, and sampling of the components as OpenCV's ``IMWRITE_JPEG_SAMPLING_FACTOR`` has it.

    Parameters
    ----------
    data
        Of a JPEG that can be decoded.

    Returns
    -------
    The quality of the IJG's library with as coarse a table for luminance, within `JPEG_LIMITS`; and the sampling, or
    ``None`` for a grey image and where OpenCV cannot write it.
    """
    tables: dict[int, int] = {}
    frame = b""
    for marker, begin, end in jpeg_segments(data):
        if marker == JPEG_LIMITS.tables_marker:
            tables |= _sum_tables(data[begin + 4 : end])
        elif marker in START_OF_FRAME:
            frame = data[begin + 4 : end]
    components = [frame[i : i + 3] for i in range(6, len(frame), 3)]
    coarseness = tables.get(components[0][2], JPEG_LIMITS.table_sum) if components else JPEG_LIMITS.table_sum
    scale = 100 * coarseness / JPEG_LIMITS.table_sum
    quality = round((200 - scale) / 2 if scale <= 100 else 5000 / scale)
    quality = min(max(quality, JPEG_LIMITS.least_quality), JPEG_LIMITS.most_quality)
    is_written = (
        len(components) == 3 and components[0][1] in JPEG_LIMITS.written and all(c[1] == 0x11 for c in components[1:])
    )
    return quality, components[0][1] << 16 | 0x1111 if is_written else None


def _sum_tables(segment: bytes) -> dict[int, int]:
    """Sums of the tables of a segment by their number."""
    tables, at = {}, 0
    while at < len(segment):
        wide, number = segment[at] >> 4, segment[at] & 15
        tables[number] = sum(struct.unpack_from(">64H" if wide else "64B", segment, at + 1))
        at += 129 if wide else 65
    return tables
