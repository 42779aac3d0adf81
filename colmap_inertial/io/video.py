"""Video: exact presentation stamps, and frames one by one in the sensor's own orientation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError, TimingError

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.stream import VideoStream


T = TypeVar("T")


def video_stamps_ns(path: Path) -> NDArray[np.int64]:
    """(F,) presentation time of every frame, without decoding: nanoseconds on the container's clock, its start offset
    included, in order.

    Raises
    ------
    FormatError
        Where the file is missing or holds no video.
    TimingError
        Where frames have no stamp, or two have the same.
    """
    container, stream = _open(path)
    with container:
        packets = _guarded(path, container.demux(stream))
        found = [(packet.pts, packet.is_discard) for packet in packets if packet.size > 0]
        listed, time_base = stream.frames, stream.time_base
    if len(found) < listed:
        raise FormatError(path, f"is cut off: it holds {len(found)} of the {listed} frames that its index lists")
    stamps = [stamp for stamp, is_discarded in found if not is_discarded]
    if not stamps:
        raise FormatError(path, "holds no video frames")
    known = [stamp for stamp in stamps if stamp is not None]
    if time_base is None or len(known) < len(stamps):
        raise TimingError(
            f"{path}: frames carry no presentation stamps; give frame_times under [video] in capture.toml"
        )
    t_ns = np.array(sorted(_ns(stamp, time_base.numerator, time_base.denominator) for stamp in known))
    same = np.flatnonzero(np.diff(t_ns) == 0)
    if len(same):
        raise TimingError(
            f"{path}: two frames have the presentation stamp {t_ns[same[0]] * 1e-9:.6f} s; give frame_times under "
            "[video] in capture.toml"
        )
    return t_ns


def frame_name(t_ns: int, first_ns: int) -> str:
    """The name of a frame: its presentation stamp in microseconds, so that names sort by time.

    A stamp before the container's zero cannot be written so; then all count from the first frame.
    """
    return f"frame_{(t_ns - min(0, first_ns) + 500) // 1000:012d}.png"


def decode_video(
    path: Path, wanted_ns: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.uint8] | NDArray[np.uint16]]]:
    """Decode the frames with the wanted presentation stamps, in order.

    Rotation that the container states is not applied: rows stay the sensor's rows, which the rolling shutter, the
    calibration and the IMU's axes refer to. Videos of more than 8 bit give uint16.

    Raises
    ------
    FormatError
        Where a wanted frame cannot be decoded.
    """
    container, stream = _open(path)
    stream.thread_type = "AUTO"
    wanted = set(wanted_ns.tolist())
    missing = set(wanted)
    with container:
        for frame in _guarded(path, container.decode(stream)):
            if frame.pts is None or frame.time_base is None:
                continue
            t_ns = _ns(frame.pts, frame.time_base.numerator, frame.time_base.denominator)
            if t_ns in missing:
                missing.discard(t_ns)
                yield t_ns, _pixels(frame)
                if not missing:
                    return
    raise FormatError(
        path, f"{len(missing)} of {len(wanted)} frames cannot be decoded (first: at {min(missing) * 1e-9:.6f} s)"
    )


def decode_grey(path: Path) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """Every frame's presentation stamp in nanoseconds, the turn that the container wants (degrees), and (H, W) grey.

    The grey is in the sensor's orientation, as :func:`decode_video` has it.
    """
    container, stream = _open(path)
    stream.thread_type = "AUTO"
    with container:
        for frame in _guarded(path, container.decode(stream)):
            if frame.pts is not None and frame.time_base is not None:
                t_ns = _ns(frame.pts, frame.time_base.numerator, frame.time_base.denominator)
                turn = int(getattr(frame, "rotation", 0))  # PyAV 13 does not tell it
                yield t_ns, turn, np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)


def _ns(pts: int, numerator: int, denominator: int) -> int:
    """Nanoseconds of a stamp, rounded once, in whole numbers."""
    return (2 * pts * numerator * 1_000_000_000 + denominator) // (2 * denominator)


def _pixels(frame: av.VideoFrame) -> NDArray[np.uint8] | NDArray[np.uint16]:
    grey = frame.format.name.startswith("gray")
    deep = max(component.bits for component in frame.format.components) > 8
    layout = ("gray16le" if deep else "gray") if grey else ("rgb48le" if deep else "rgb24")
    pixels = frame.to_ndarray(format=layout)
    return np.asarray(pixels, dtype=np.uint16) if deep else np.asarray(pixels, dtype=np.uint8)


def _open(path: Path) -> tuple[InputContainer, VideoStream]:
    import av

    if not path.is_file():
        raise FormatError(path, "no such video")
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FormatError(path, f"is no video that FFmpeg reads: {_reason(error)}") from None
    if not container.streams.video:
        container.close()
        raise FormatError(path, "holds no video stream")
    return container, container.streams.video[0]


def _guarded(path: Path, items: Iterator[T]) -> Iterator[T]:
    """The same items; FFmpeg's complaint about a damaged file becomes ours."""
    import av

    try:
        yield from items
    except (av.FFmpegError, OSError) as error:
        raise FormatError(path, f"is damaged or cut off: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).splitlines()[0]
