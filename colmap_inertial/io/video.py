"""Video: exact presentation stamps, and frames one by one in the sensor's own orientation.

Colours follow what the video says of itself: matrix (BT.601, BT.709, BT.2020) and range, limited where it says nothing,
BT.709 from 720 rows on where it says nothing, as players have it. Transfer curves stay: a log or HDR image stays one.

The readout of a video that does not state its own is looked up by camera and mode: model, image size and frame rate
must all be those of a row of the table (``readouts.csv``, with the source of each figure). Where two sources contradict
each other, none of them is in it.
"""

from __future__ import annotations

import csv
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from colmap_inertial.core.arrays import Int64Array, UInt8Array, UInt16Array
from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import require_regular
from colmap_inertial.io.mp4 import is_mp4, read_movie

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream


T = TypeVar("T")

#: FFmpeg's number for a colour matrix that is not stated, and the rows from which it is then BT.709.
_UNSTATED, _HD_ROWS = 2, 720


def video_stamps_ns(path: Path) -> Int64Array:
    """(F,) presentation time of every frame, without decoding: nanoseconds on the container's clock, its start offset
    included, in order. Frames that an edit list cuts away have none.

    Raises
    ------
    FormatError
        Where the file is missing, cut off, or holds no video.
    TimingError
        Where frames have no stamp, or two have the same.
    """
    container, stream = _open(path)
    with container:
        packets = _convert_errors(path, container.demux(stream))
        packet_stamps = [(packet.pts, packet.is_discard) for packet in packets if packet.size > 0]
        listed, time_base, duration_s = stream.frames, stream.time_base, _read_duration_s(stream)
        kind = container.format.name
    stamps = [stamp for stamp, is_discarded in packet_stamps if not is_discarded]
    known = [stamp for stamp in stamps if stamp is not None]
    t_ns = np.zeros(0, dtype=np.int64)
    if time_base is not None:
        t_ns = np.array(sorted(_ns(stamp, time_base.numerator, time_base.denominator) for stamp in known), np.int64)
    last_s = t_ns[-1] * 1e-9 if len(t_ns) else None
    if len(packet_stamps) < listed:
        missing = _count_lost(path, kind, listed, listed - len(packet_stamps))
        if missing:
            raise FormatError(path, Fact("video-lacks-frames", held=listed - missing, listed=listed, last_s=last_s))
    if not stamps:
        raise FormatError(path, Fact("no-video-frames"))
    if time_base is None or len(known) < len(stamps):
        raise TimingError(Fact("frames-without-stamps", path=str(path)))
    steps = np.diff(t_ns)
    same = np.flatnonzero(steps == 0)
    if len(same):
        raise TimingError(Fact("frames-of-one-stamp", path=str(path), stamp_s=t_ns[same[0]] * 1e-9))
    # the last frame may stand as long as any other did
    longest_s = 1e-9 * float(steps.max(initial=0))
    if duration_s is not None and t_ns[-1] * 1e-9 + 2 * longest_s + 0.1 < duration_s:
        early = Fact("video-ends-early", duration_s=duration_s, frames=len(t_ns), last_s=last_s)
        raise FormatError(path, early)
    return t_ns


def frame_name(t_ns: int, first_ns: int) -> str:
    """The name of a frame: its presentation stamp in microseconds, so that names sort by time.

    A stamp before the container's zero cannot be written so; then all count from the first frame.
    """
    return f"frame_{(t_ns - min(0, first_ns) + 500) // 1000:012d}.png"


@dataclass(frozen=True, eq=False)
class DecodedPicture:
    """A decoded frame of a video, converted as far as somebody asks.

    Attributes
    ----------
    t_ns
        Its presentation stamp.
    """

    t_ns: int
    _frame: av.VideoFrame
    _reformatter: VideoReformatter

    def pixels(self) -> UInt8Array | UInt16Array:
        """(H, W, 3) RGB or (H, W) grey; of more than 8 bit uint16, spread over its whole range."""
        return _pixels(self._frame, self._reformatter)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self._frame.width, self._frame.height

    def luma(self, long_side_px: int) -> UInt8Array:
        """8 bit luma alone, not larger than ``long_side_px``: for analysis."""
        return reduced(_brightness(self._frame), long_side_px)


def decode_pictures(path: Path, wanted_ns: Int64Array) -> Iterator[DecodedPicture]:
    """Decode the frames with the wanted presentation stamps, in order; each is to be converted before the next.

    Rotation that the container states is not applied: rows stay the sensor's rows, which the rolling shutter, the
    calibration and the IMU's axes refer to.

    Raises
    ------
    FormatError
        Where a wanted frame cannot be decoded whole, or has another size than those before.
    """
    from av.video.reformatter import VideoReformatter

    reformatter = VideoReformatter()  # one for all frames: to set one up takes longer than a frame
    for t_ns, frame in _decode_wanted(path, wanted_ns):
        yield DecodedPicture(t_ns, frame, reformatter)


def decode_video(path: Path, wanted_ns: Int64Array) -> Iterator[tuple[int, UInt8Array | UInt16Array]]:
    """Stamps and pixels of :func:`decode_pictures`."""
    for picture in decode_pictures(path, wanted_ns):
        yield picture.t_ns, picture.pixels()


def reduced(grey: UInt8Array, long_side_px: int) -> UInt8Array:
    """A grey image, shrunk by area where its longer side is longer than this."""
    import cv2

    scale = long_side_px / max(grey.shape)
    if scale >= 1:
        return np.ascontiguousarray(grey)
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def decode_grey(path: Path) -> Iterator[tuple[int, int, UInt8Array]]:
    """Every frame's presentation stamp in nanoseconds, the turn that the container wants (degrees), and (H, W) grey.

    The grey is in the sensor's orientation, as :func:`decode_video` has it.
    """
    from av.video.reformatter import VideoReformatter

    container, stream = _open(path)
    stream.thread_type = "AUTO"
    reformatter = VideoReformatter()
    with container:
        for frame in _convert_errors(path, container.decode(stream)):
            if frame.pts is not None and frame.time_base is not None:
                t_ns = _ns(frame.pts, frame.time_base.numerator, frame.time_base.denominator)
                turn = int(getattr(frame, "rotation", 0))  # PyAV 13 does not tell it
                grey = reformatter.reformat(frame, format="gray").to_ndarray()
                yield t_ns, turn, np.asarray(grey, dtype=np.uint8)


def _decode_wanted(path: Path, wanted_ns: Int64Array) -> Iterator[tuple[int, av.VideoFrame]]:
    """The frames with the wanted stamps, each of them whole, and all of one size."""
    if len(wanted_ns) == 0:
        return
    size: tuple[int, int] | None = None
    container, stream = _open(path)
    stream.thread_type = "AUTO"
    missing = set(wanted_ns.tolist())
    first_ns = min(missing)
    with container:
        for frame in _convert_errors(path, container.decode(stream)):
            if frame.pts is None or frame.time_base is None:
                continue
            t_ns = _ns(frame.pts, frame.time_base.numerator, frame.time_base.denominator)
            if frame.is_corrupt and t_ns >= first_ns:
                # whether wanted or not: others are made from it
                raise FormatError(path, Fact("frame-damaged", frame_s=t_ns * 1e-9))
            if t_ns not in missing:
                continue
            missing.discard(t_ns)
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                other = (frame.width, frame.height)
                raise FormatError(path, Fact("frame-size-changes", old=size, new=other, frame_s=t_ns * 1e-9))
            yield t_ns, frame
            if not missing:
                return
    raise FormatError(
        path, Fact("frames-not-decoded", missing=len(missing), wanted=len(wanted_ns), first_s=min(missing) * 1e-9)
    )


def _ns(pts: int, numerator: int, denominator: int) -> int:
    """Nanoseconds of a stamp, rounded once, in whole numbers."""
    return (2 * pts * numerator * 1_000_000_000 + denominator) // (2 * denominator)


def _pixels(frame: av.VideoFrame, reformatter: VideoReformatter) -> UInt8Array | UInt16Array:
    from av.video.reformatter import Colorspace

    grey = frame.format.name.startswith("gray")
    deep = max(component.bits for component in frame.format.components) > 8
    layout = ("gray16le" if deep else "gray") if grey else ("rgb48le" if deep else "rgb24")
    by_rows = frame.colorspace == _UNSTATED and frame.height >= _HD_ROWS and not grey
    colorspace = int(Colorspace.ITU709) if by_rows else None
    pixels = reformatter.reformat(frame, format=layout, src_colorspace=colorspace).to_ndarray()
    return np.asarray(pixels, dtype=np.uint16) if deep else np.asarray(pixels, dtype=np.uint8)


def _brightness(frame: av.VideoFrame) -> UInt8Array:
    """The plane of brightness, as it is coded, in 8 bit; FFmpeg's grey is ten times as slow."""
    name, bits = frame.format.name, frame.format.components[0].bits
    if not name.startswith(("yuv", "nv12", "gray")) or name.endswith("be"):
        return np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: frame.height]
    if bits == 8:
        return rows[:, : frame.width]
    return np.asarray(rows[:, : 2 * frame.width].view("<u2") >> (bits - 8), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class VideoMode:
    """The camera that a video names, and how it filmed: size of the stored images, mean frame rate."""

    make: str
    model: str
    width: int
    height: int
    rate_hz: float


#: Where QuickTime and Android write maker and model of the camera.
_MAKES = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
_MODELS = ("com.apple.quicktime.model", "com.android.model", "model")


def video_mode(path: Path) -> VideoMode | None:
    """Camera and mode of a video; ``None`` where it names no camera.

    Raises
    ------
    FormatError
        Where it is no video.
    """
    container, stream = _open(path)
    with container:
        tags = container.metadata
        make, model = (next((tags[key] for key in keys if key in tags), "") for keys in (_MAKES, _MODELS))
        if not make or not model or not stream.average_rate:
            return None
        return VideoMode(
            make=make, model=model, width=stream.width, height=stream.height, rate_hz=float(stream.average_rate)
        )


def _open(path: Path) -> tuple[InputContainer, VideoStream]:
    try:
        import av
    except ImportError:
        raise InertialError(Fact("pyav-missing", path=str(path))) from None
    if not path.is_file():
        if path.exists():
            require_regular(path)
        raise FormatError(path, Fact("no-such-file", what="video"))
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError, ValueError) as error:
        if is_mp4(path):
            read_movie(path)  # knows better what is wrong with its index
        raise FormatError(path, Fact("not-read-by-ffmpeg", detail=_reason(error))) from None
    try:
        return container, _find_filmed(path, container)
    except FormatError:
        container.close()
        raise


def _find_filmed(path: Path, container: InputContainer) -> VideoStream:
    """The video stream that the camera filmed: no cover image, no smaller copy."""
    from av.stream import Disposition

    accompanying = Disposition.attached_pic | Disposition.timed_thumbnails
    streams = [stream for stream in container.streams.video if not stream.disposition & accompanying]
    if not streams:
        raise FormatError(path, Fact("cover-picture-alone" if container.streams.video else "no-video-stream"))
    largest = max(_area(stream) for stream in streams)
    streams = [stream for stream in streams if _area(stream) == largest]
    if len(streams) > 1:
        raise FormatError(
            path, Fact("several-video-streams", count=len(streams), width=streams[0].width, height=streams[0].height)
        )
    return streams[0]


def _area(stream: VideoStream) -> int:
    # a stream of no known codec has no size
    return int(getattr(stream, "width", 0) * getattr(stream, "height", 0))


def _count_lost(path: Path, kind: str, listed: int, not_found: int) -> int:
    """Number of frames in an index that lie beyond the end of the file, where FFmpeg gave fewer than the index lists.

    An intact file gives fewer, too: what an edit list cuts away is dropped by whole groups of images, and AVI counts
    a frame that the camera dropped as an empty one.
    """
    if kind.startswith("mov,"):
        movie = read_movie(path)
        tracks = [track for track in movie.tracks if track.handler == "vide" and len(track.size) == listed]
        return max((len(movie.beyond(track)) for track in tracks), default=0)
    if kind == "avi" and not _ends_inside_riff(path):
        return 0
    return not_found


def _ends_inside_riff(path: Path) -> bool:
    """Whether an AVI file ends before its last RIFF list does: ``RIFF``, 32-bit size, contents, and so on."""
    with open(path, "rb") as file:
        length, at = file.seek(0, 2), 0
        while at + 8 <= length:
            file.seek(at)
            name, size = struct.unpack("<4sI", file.read(8))
            if name != b"RIFF":
                return False
            # some writers count the head of 8 bytes, too
            if at + size > length:
                return True
            at += 8 + size + size % 2
    return False


def _read_duration_s(stream: VideoStream) -> float | None:
    """End of the stream as noted at the end of the recording (Matroska)."""
    try:
        hours, minutes, seconds = stream.metadata.get("DURATION", "").split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    except ValueError:
        return None


def _convert_errors(path: Path, items: Iterator[T]) -> Iterator[T]:
    """The same items; FFmpeg's complaint about a damaged file becomes ours."""
    import av

    after_s: float | None = None
    try:
        for item in items:
            time_s = getattr(item, "time", None)  # of a frame; packets have none
            after_s = after_s if time_s is None else time_s
            yield item
    except (av.FFmpegError, OSError) as error:
        raise FormatError(path, Fact("video-damaged", after_s=after_s, detail=_reason(error))) from None


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).splitlines()[0]


#: Rates that differ by less are one mode: 29.97 and 30.
_SAME_RATE = 0.02


@dataclass(frozen=True, kw_only=True)
class PublishedReadout:
    """One line of the table.

    Attributes
    ----------
    make, model, width, height, rate_hz
        The camera and its mode.
    readout_s, sigma_s
        From the first row to one past the last, and its standard deviation.
    source
        Who published it.
    """

    make: str
    model: str
    width: int
    height: int
    rate_hz: float
    readout_s: float
    sigma_s: float
    source: str

    def is_of(self, mode: VideoMode) -> bool:
        """Whether a video was filmed by this camera in this mode."""
        return (
            mode.make.strip().lower() == self.make.lower()
            and mode.model.strip().lower() == self.model.lower()
            and (mode.width, mode.height) == (self.width, self.height)
            and abs(mode.rate_hz / self.rate_hz - 1) < _SAME_RATE
        )

    def __str__(self) -> str:
        mode = f"{self.make} {self.model} at {self.width}x{self.height}, {self.rate_hz:g} a second"
        return f"from the table: {mode}, +-{1e3 * self.sigma_s:.2g} ms ({self.source})"


@cache
def read_published_readouts() -> tuple[PublishedReadout, ...]:
    """The whole table."""
    with files("colmap_inertial.io").joinpath("readouts.csv").open(encoding="utf-8") as table:
        return tuple(
            PublishedReadout(
                make=row["make"],
                model=row["model"],
                width=int(row["width"]),
                height=int(row["height"]),
                rate_hz=float(row["rate_hz"]),
                readout_s=float(row["readout_ms"]) * 1e-3,
                sigma_s=float(row["sigma_ms"]) * 1e-3,
                source=row["source"],
            )
            for row in csv.DictReader(table)
        )


def readout_of_video(path: Path) -> PublishedReadout | None:
    """Published readout of the camera and mode that a video names; ``None`` where unnamed or unknown."""
    try:
        mode = video_mode(path)
    except FormatError:
        return None  # whoever reads its frames says what is wrong with it
    return None if mode is None else next((row for row in read_published_readouts() if row.is_of(mode)), None)
