"""MP4 and QuickTime files without a decoder: which tracks there are, and where and when their samples lie.

A file is a row of boxes: 32-bit size (all big-endian; 1 means that a 64-bit size follows, 0 that the box reaches to the
end of the file), four letters, contents. ``moov`` describes the tracks; a track's ``stbl`` tells the sizes (``stsz``),
the chunks (``stsc``, ``stco`` or ``co64``), and the durations (``stts``, and ``ctts`` where frames are shown in another
order) of its samples, in ticks of the ``mdhd`` timescale; an edit list (``elst``) moves all of them (ISO/IEC 14496-12).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io import files

#: Four letters at the start of a file of this family.
_FIRST_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
#: An index larger than this belongs to no recording.
_LARGEST_INDEX = 1 << 30
#: Nor does a track with more samples: five hours of a kilohertz are a quarter of it. Sound, which may, is not read.
_MOST_SAMPLES = 1 << 26


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """One track's samples.

    Attributes
    ----------
    handler, entry
        Four letters each: the kind (``vide``, ``meta``), and the format of the samples (``gpmd``, ``camm``, ``avc1``).
    offset, size
        (N,) where each sample lies in the file, in bytes.
    t_ns
        (N,) presentation time on the movie's clock, edit list included.
    width_px, height_px
        Of a video's stored images; 0 for other tracks.
    """

    handler: str
    entry: str
    offset: Int64Array
    size: Int64Array
    t_ns: Int64Array
    width_px: int = 0
    height_px: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Movie:
    """The tracks of a file but for sound, and its ``udta`` boxes by their four letters."""

    path: Path
    tracks: tuple[Track, ...]
    user_data: dict[str, bytes] = field(default_factory=dict)

    def track(self, *, handler: str | None = None, entry: str | None = None) -> Track | None:
        """The first track of a kind and format, or ``None``."""
        return next(
            (t for t in self.tracks if handler in (None, t.handler) and entry in (None, t.entry)),
            None,
        )

    def telemetry(self, entry: str, what: str) -> Track:
        """The track of a format, which holds ``what``; a :class:`FormatError` where there is none."""
        track = self.track(entry=entry)
        if track is None or len(track.size) == 0:
            raise FormatError(self.path, Fact("track-missing", what=what, entry=entry))
        return track

    def frame_times_ns(self) -> Int64Array:
        """(F,) presentation times of the video's frames, in order.

        Raises
        ------
        FormatError
            Where there is no video, or two frames are shown at one time.
        """
        video = self.track(handler="vide")
        if video is None or len(video.t_ns) == 0:
            raise FormatError(self.path, Fact("no-video"))
        shown = np.sort(video.t_ns)
        if (np.diff(shown) <= 0).any():
            raise FormatError(self.path, Fact("samples-at-one-time", entry=video.entry))
        return shown

    def samples(self, track: Track) -> list[bytes]:
        """The contents of a track's samples, in their order."""
        data, begin = self.contents(track)
        ends = begin + track.size
        return [data[b:e] for b, e in zip(begin.tolist(), ends.tolist(), strict=True)]

    def beyond(self, track: Track) -> Int64Array:
        """Whether each of a track's samples lies outside the file."""
        length = self.path.stat().st_size
        return np.flatnonzero((track.offset < 0) | (track.size < 0) | (track.offset + track.size > length))

    def contents(self, track: Track) -> tuple[bytes, Int64Array]:
        """A track's samples one after the other, and (N,) where each begins; neighbours in the file are read at once.

        Raises
        ------
        FormatError
            Where a sample lies beyond the end of the file, or samples overlap.
        """
        length, beyond = self.path.stat().st_size, self.beyond(track)
        if len(beyond):
            place = {"sample": beyond[0] + 1, "track": track.entry, "byte": track.offset[beyond[0]]}
            raise FormatError(self.path, Fact("sample-beyond-file", **place, length=length))
        if int(track.size.sum()) > length:
            raise FormatError(self.path, Fact("samples-overlap", entry=track.entry))
        ends = track.offset + track.size
        runs = np.flatnonzero(np.concatenate([[True], track.offset[1:] != ends[:-1]])) if len(ends) else ends
        parts = []
        with open(self.path, "rb") as file:
            for first, last in zip(runs.tolist(), [*(runs[1:] - 1).tolist(), len(ends) - 1], strict=False):
                file.seek(int(track.offset[first]))
                parts.append(file.read(int(ends[last] - track.offset[first])))
        return b"".join(parts), np.cumsum(track.size) - track.size


def is_mp4(path: Path) -> bool:
    """Whether a file begins like an MP4 or QuickTime file."""
    if not path.is_file():
        return False
    try:
        with open(path, "rb") as file:
            return file.read(8)[4:] in _FIRST_BOXES
    except OSError:
        return False


def has_track(path: Path, entry: str) -> bool:
    """Whether a readable file holds a track of this format; ``False`` for a damaged one or another kind of file."""
    if not path.is_file() or not is_mp4(path):
        return False
    try:
        return read_movie(path).track(entry=entry) is not None
    except (FormatError, OSError):
        return False


@files.reader("a video")
def read_movie(path: Path) -> Movie:
    """Read the index of an MP4 or QuickTime file.

    Raises
    ------
    FormatError
        Where the file is missing, cut off before its index, or damaged; the message names the byte.
    """
    try:
        files.require_regular(path)
        with open(path, "rb") as file:
            moov, start = _find_index(path, file)
    except OSError as error:
        raise FormatError(path, Fact("file-not-readable", detail=str(error.strerror))) from None
    reader = _Boxes(path, moov, start)
    movie_scale, tracks, user_data = 0, [], {}
    for name, begin, end in reader.inside(0, len(moov)):
        if name == b"mvhd":
            movie_scale = reader.timescale(begin, end)
        elif name == b"udta":
            user_data.update({n.decode("latin-1"): moov[b:e] for n, b, e in reader.inside(begin, end)})
    for name, begin, end in reader.inside(0, len(moov)):
        if name == b"trak":
            track = _track(reader, begin, end, movie_scale)
            if track is not None:
                tracks.append(track)
    return Movie(path=path, tracks=tuple(tracks), user_data=user_data)


def _find_index(path: Path, file: BinaryIO) -> tuple[bytes, int]:
    """Contents of the ``moov`` box, and the byte at which they begin."""
    length = file.seek(0, 2)
    at = 0
    while at + 8 <= length:
        file.seek(at)
        size, name = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            long = file.read(8)
            size, head = (struct.unpack(">Q", long)[0], 16) if len(long) == 8 else (0, 16)
        elif size == 0:
            size = length - at
        if size < head:
            raise FormatError(path, Fact("mp4-box-size", box=_show_name(name), byte=at, size=size))
        if name == b"moov":
            if at + size > length:
                raise FormatError(path, Fact("mp4-index-cut-off", byte=at, length=length))
            if size > _LARGEST_INDEX:
                raise FormatError(path, Fact("mp4-index-size", byte=at, size=size))
            file.seek(at + head)
            return file.read(size - head), at + head
        at += size
    raise FormatError(path, Fact("mp4-without-index"))


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes inside the index; positions count from its first byte."""

    path: Path
    data: bytes
    start: int

    def fail(self, at: int, fault: Fact) -> FormatError:
        return FormatError(self.path, Fact("damaged-at-byte", byte=self.start + at, fault=fault))

    def inside(self, begin: int, end: int) -> Iterator[tuple[bytes, int, int]]:
        """Name, first byte and end of the contents of each box from ``begin`` to ``end``."""
        at = begin
        while at + 8 <= end:
            size, name = struct.unpack_from(">I4s", self.data, at)
            head = 8
            if size == 1 and at + 16 <= end:
                size, head = struct.unpack_from(">Q", self.data, at + 8)[0], 16
            elif size == 0:
                # a closing zero is how QuickTime ends user data
                return
            if size < head or at + size > end:
                raise self.fail(at, Fact("mp4-box-beyond", box=_show_name(name), size=size, left=end - at))
            yield name, at + head, at + size
            at += size

    def find(self, begin: int, end: int, *names: bytes) -> tuple[int, int] | None:
        """Location of a nested box's contents, or ``None``."""
        for name, b, e in self.inside(begin, end):
            if name == names[0]:
                return (b, e) if len(names) == 1 else self.find(b, e, *names[1:])
        return None

    def need(self, begin: int, end: int, count: int, box: str, rows: int | None = None) -> None:
        if begin + count > end:
            raise self.fail(begin, Fact("mp4-box-cut-off", box=box, rows=rows, bytes=end - begin, needed=count))

    def timescale(self, begin: int, end: int) -> int:
        """Ticks per second that a ``mvhd`` or ``mdhd`` states."""
        self.need(begin, end, 24, "a header")
        scale = int(struct.unpack_from(">I", self.data, begin + (20 if self.data[begin] == 1 else 12))[0])
        if scale == 0:
            raise self.fail(begin, Fact("mp4-timescale-zero"))
        return scale

    def table(self, place: tuple[int, int] | None, name: str, kind: str, columns: int, head: int = 8) -> Int64Array:
        """(N, columns) of a table whose number of rows stands just before the rows."""
        if place is None:
            return np.zeros((0, columns), dtype=np.int64)
        begin, end = place
        self.need(begin, end, head, name)
        count = int(struct.unpack_from(">I", self.data, begin + head - 4)[0])
        dtype = np.dtype(kind)
        self.need(begin, end, head + count * columns * dtype.itemsize, name, count)
        table = np.frombuffer(self.data, dtype, count * columns, begin + head)
        return table.astype(np.int64).reshape(count, columns)


def _show_name(name: bytes) -> str:
    return repr(name.decode("latin-1"))


def _track(reader: _Boxes, begin: int, end: int, movie_scale: int) -> Track | None:
    """A track; ``None`` where it has no samples table, and for sound."""
    header, handler = reader.find(begin, end, b"mdia", b"mdhd"), reader.find(begin, end, b"mdia", b"hdlr")
    table = reader.find(begin, end, b"mdia", b"minf", b"stbl")
    if header is None or handler is None or table is None:
        return None
    scale = reader.timescale(*header)
    reader.need(*handler, 12, "a handler")
    kind = reader.data[handler[0] + 8 : handler[0] + 12].decode("latin-1")
    if kind == "soun":
        return None
    boxes = {name: (b, e) for name, b, e in reader.inside(*table)}
    entry, width, height = _entry(reader, boxes.get(b"stsd"), kind)
    size = _sizes(reader, boxes.get(b"stsz"))
    count = len(size)
    duration = _runs(reader, reader.table(boxes.get(b"stts"), "stts", ">u4", 2), count, "stts")
    shown = np.cumsum(duration) - duration
    if b"ctts" in boxes:
        shown = shown + _runs(reader, reader.table(boxes[b"ctts"], "ctts", ">i4", 2), count, "ctts")
    edits = reader.find(begin, end, b"edts", b"elst")
    t_ns = np.array(_ns(shown, scale) + _edit_ns(reader, edits, scale, movie_scale), dtype=np.int64)
    return Track(
        handler=kind,
        entry=entry,
        offset=_offsets(reader, boxes, size),
        size=size,
        t_ns=t_ns,
        width_px=width,
        height_px=height,
    )


def _entry(reader: _Boxes, place: tuple[int, int] | None, kind: str) -> tuple[str, int, int]:
    """The format of the samples, and the size of a video's images."""
    if place is None:
        return "", 0, 0
    begin, end = place
    reader.need(begin, end, 16, "stsd")
    entry = reader.data[begin + 12 : begin + 16].decode("latin-1")
    if kind != "vide" or begin + 44 > end:
        return entry, 0, 0
    width, height = struct.unpack_from(">HH", reader.data, begin + 40)
    return entry, int(width), int(height)


def _sizes(reader: _Boxes, place: tuple[int, int] | None) -> Int64Array:
    if place is None:
        return np.zeros(0, dtype=np.int64)
    begin, end = place
    reader.need(begin, end, 12, "stsz")
    common, count = struct.unpack_from(">II", reader.data, begin + 4)
    if common == 0:
        return reader.table(place, "stsz", ">u4", 1, head=12)[:, 0]
    if common * count > reader.path.stat().st_size or count > _MOST_SAMPLES:
        raise reader.fail(begin, Fact("mp4-samples-beyond", count=count, sample_bytes=common))
    return np.full(count, common, dtype=np.int64)


def _runs(reader: _Boxes, rows: Int64Array, count: int, what: str) -> Int64Array:
    """(count,) values of a table of (how many, value)."""
    if int(rows[:, 0].sum()) != count or (rows[:, 0] < 0).any():
        raise FormatError(reader.path, Fact("mp4-other-count", table=what, listed=int(rows[:, 0].sum()), count=count))
    return np.repeat(rows[:, 1], rows[:, 0])


def _offsets(reader: _Boxes, boxes: dict[bytes, tuple[int, int]], size: Int64Array) -> Int64Array:
    """Offset of each sample: samples follow each other inside their chunk."""
    if b"co64" in boxes:
        chunks = reader.table(boxes[b"co64"], "co64", ">i8", 1)[:, 0]
    else:
        chunks = reader.table(boxes.get(b"stco"), "stco", ">u4", 1)[:, 0]
    rows = reader.table(boxes.get(b"stsc"), "stsc", ">u4", 3)
    if len(size) == 0:
        return np.zeros(0, dtype=np.int64)
    first = rows[:, 0] - 1
    edges = np.append(first, len(chunks))
    if len(rows) == 0 or first[0] != 0 or (np.diff(edges) < 0).any():
        raise FormatError(reader.path, Fact("mp4-chunks-unordered"))
    per_chunk = np.repeat(rows[:, 1], np.diff(edges))
    if int(per_chunk.sum()) != len(size):
        raise FormatError(reader.path, Fact("mp4-chunks-other-count", held=int(per_chunk.sum()), count=len(size)))
    begin = np.cumsum(size) - size
    before = np.cumsum(per_chunk) - per_chunk
    # bytes of the track before each chunk, so that within a chunk only its own samples count
    skipped = np.append(begin, int(size.sum()))[before]
    return begin + np.repeat(chunks - skipped, per_chunk)


def _edit_ns(reader: _Boxes, place: tuple[int, int] | None, scale: int, movie_scale: int) -> int:
    """Offset of all presentation times by an edit list: empty edits delay, a first edit inside the media advances."""
    if place is None:
        return 0
    begin, end = place
    reader.need(begin, end, 8, "elst")
    version, count = reader.data[begin], int(struct.unpack_from(">I", reader.data, begin + 4)[0])
    row = ">qq4x" if version == 1 else ">ii4x"
    reader.need(begin, end, 8 + count * struct.calcsize(row), "elst", count)
    delay_ns = 0
    for i in range(count):
        duration, media_time = struct.unpack_from(row, reader.data, begin + 8 + i * struct.calcsize(row))
        if media_time == -1:
            delay_ns += duration * 1_000_000_000 // max(movie_scale, 1)
        else:
            return delay_ns - (2 * media_time * 1_000_000_000 + scale) // (2 * scale)
    return delay_ns


def _ns(ticks: Int64Array, scale: int) -> Int64Array:
    """Nanoseconds of ticks, rounded once; whole seconds apart, so that nothing overflows."""
    whole, rest = np.divmod(ticks, scale)
    return np.asarray(whole * 1_000_000_000 + (2 * rest * 1_000_000_000 + scale) // (2 * scale), dtype=np.int64)
