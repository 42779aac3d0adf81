"""Frames of a capture, one at a time: memory stays flat however long the recording."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import IndexArray, Int64Array, UInt8Array, UInt16Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Frame, FrameLog, FrameTiming
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import StrPath, path_in, reading
from colmap_inertial.io.frame_sources import ImageFolder, Video, image_names
from colmap_inertial.io.frame_times import NO_RIGS, FrameStamps, stamps_of_csv, stamps_of_log, stamps_of_names
from colmap_inertial.io.images import SUFFIXES, grey_8bit, read_image
from colmap_inertial.io.video import (
    DecodedPicture,
    decode_pictures,
    decode_video,
    frame_name,
    reduced,
    video_stamps_ns,
)


def read_frames(
    capture: Capture | StrPath, *, only: Collection[str] | None = None
) -> tuple[FrameTiming, Iterator[Frame]]:
    """The frames of a capture and when they were exposed.

    Parameters
    ----------
    capture
        A capture, or what :func:`load_capture` reads.
    only
        Names of the frames to decode; all, where absent.

    Returns
    -------
    timing
        Names and times of all frames, known before any is decoded.
    frames
        The frames in order of time, decoded as they are asked for. Images keep the file's depth and stored
        orientation; see :func:`read_image` and :func:`decode_video`.

    Raises
    ------
    FormatError
        For a frame that cannot be decoded or has another size than the camera (while iterating), or no frames.
    TimingError
        Where frames have no times; the message says how to give them.
    """
    if not isinstance(capture, Capture):
        capture = load_capture(capture)
    if isinstance(capture.frames, Video):
        with reading(capture.path, Fact("frames-not-readable")):
            stamps, source_ns = _video_frames(capture.frames, capture.frame_log)
            timing = _timing(capture, stamps)
        return timing, _decode_video(capture, capture.frames, timing, source_ns, _places(timing, only))
    timing = read_frame_timing(capture)
    return timing, decode_images(capture, timing, _places(timing, only))


class LazyFrame:
    """A decoded frame that is converted as far as somebody asks.

    Attributes
    ----------
    name
        Its name.
    width, height
        Its size, px.
    frame
        Its pixels, as of :func:`read_frames`.
    luma
        8 bit brightness, not larger than so many pixels; of a video as it is coded.
    """

    def __init__(
        self, name: str, size: tuple[int, int], frame: Callable[[], Frame], luma: Callable[[int], UInt8Array]
    ) -> None:
        self.name, (self.width, self.height) = name, size
        self.frame, self.luma = cache(frame), luma


def decode_lazily(capture: Capture) -> Iterator[LazyFrame]:
    """All frames of a capture's video in order of time; each is to be converted before the next is asked for.

    Raises
    ------
    FormatError, TimingError
        As :func:`read_frames`.
    """
    assert isinstance(capture.frames, Video)
    stamps, source_ns = _video_frames(capture.frames, capture.frame_log)
    timing, place = _timing(capture, stamps), {int(t_ns): i for i, t_ns in enumerate(source_ns)}

    def convert(i: int, picture: DecodedPicture) -> Frame:
        assert isinstance(capture.frames, Video)
        return _frame(capture, timing, i, capture.frames.file, picture.pixels())

    for picture in decode_pictures(capture.frames.file, source_ns):
        i = place[picture.t_ns]
        yield LazyFrame(timing.names[i], picture.size, partial(convert, i, picture), picture.luma)


def read_lazily(path: Path, name: str) -> LazyFrame:
    """An image of a folder; its time is not told."""
    image = read_image(path)
    frame, size = Frame(name=name, image=image, t_s=0.0), (image.shape[1], image.shape[0])
    return LazyFrame(name, size, lambda: frame, lambda long_side_px: reduced(grey_8bit(image), long_side_px))


def _places(timing: FrameTiming, only: Collection[str] | None) -> IndexArray:
    """Indices of the frames to decode."""
    if only is None:
        return np.arange(len(timing.names))
    wanted = set(only)
    return np.array([i for i, name in enumerate(timing.names) if name in wanted], dtype=np.intp)


def read_frame_timing(capture: Capture | Path, first_of: Mapping[str, str] = NO_RIGS) -> FrameTiming:
    """Exposure times of a capture's frames, without decoding any; see :func:`read_frames`.

    ``first_of`` names the image that stands for each frame of a rig (:meth:`FrameStamps.one_per_frame`).
    """
    if isinstance(capture, Path):
        capture = load_capture(capture)
    with reading(capture.path, Fact("frames-not-readable")):
        match capture.frames:
            case ImageFolder():
                return _timing(capture, _image_stamps(capture.frames).one_per_frame(first_of))
            case Video():
                return _timing(capture, _video_frames(capture.frames, capture.frame_log)[0])
            case None:
                raise FormatError(capture.path, Fact("capture-without-frames"))


def read_frame_times(path: StrPath, first_of: Mapping[str, str] = NO_RIGS) -> FrameTiming:
    """Frame times from a CSV (``name,t_s`` or ``name,t_ns``; optionally ``exposure_s``), or those of a capture.

    ``first_of`` names the image that stands for each frame of a rig (:meth:`FrameStamps.one_per_frame`).

    Raises
    ------
    FormatError, TimingError
        See :func:`stamps_of_csv` and :func:`read_frame_timing`.
    """
    path = Path(path)
    if path.is_dir() or path.suffix.lower() == ".toml":
        return read_frame_timing(load_capture(path), first_of)
    return stamps_of_csv(path).one_per_frame(first_of).timing()


def picture_folders(capture: Capture) -> tuple[Path, ...]:
    """All folders that images of a capture are read from; empty where they come from videos."""
    folders = [capture.frames.folder] if isinstance(capture.frames, ImageFolder) else []
    if capture.apertures is not None:
        folders += [source.folder for source in capture.apertures.sources]
    if capture.exposures is not None:
        folders.append(capture.exposures.source.folder)
    folders += [camera.frames.folder for camera in capture.rig if isinstance(camera.frames, ImageFolder)]
    return tuple(dict.fromkeys(folders))


def _timing(capture: Capture, stamps: FrameStamps) -> FrameTiming:
    if capture.exposure_s is not None and isinstance(capture.frames, Video):
        # what the user states goes before what the recorder noted
        stamps = replace(stamps, exposure_s=None)
    timing = stamps.timing(exposure_s=capture.exposure_s, readout_s=capture.readout_s)
    return replace(timing, readout_direction=capture.readout_direction)


def _image_stamps(source: ImageFolder) -> FrameStamps:
    names = image_names(source)
    if source.times is None:
        raise TimingError(Fact("pictures-untimed", folder=str(source.folder), count=len(names)))
    if source.times == "name":
        return stamps_of_names(source.folder, names, str(source.time_unit))
    stamps = stamps_of_csv(source.times, source.time_unit)
    untimed = sorted(set(names) - set(stamps.names))
    if untimed:
        raise TimingError(
            Fact(
                "pictures-without-row",
                times=str(source.times),
                untimed=len(untimed),
                count=len(names),
                first=untimed[0],
            )
        )
    present = set(names)
    unread = [name for name in stamps.names if name not in present and _is_other_picture(source, name)]
    if unread:
        named = Fact("names-of-other-pictures", count=len(unread), first=unread[0], endings=SUFFIXES)
        raise FormatError(source.times, named)
    keep = np.array([name in present for name in stamps.names])
    return FrameStamps(
        names=tuple(name for name in stamps.names if name in present),
        t_ns=stamps.t_ns[keep],
        exposure_s=None if stamps.exposure_s is None else stamps.exposure_s[keep],
        source=stamps.source,
    )


def _is_other_picture(source: ImageFolder, name: str) -> bool:
    """Whether a file of that name is in the folder, with an ending that is not read."""
    return Path(name).suffix.lower() not in SUFFIXES and (source.folder / name).is_file()


def decode_images(capture: Capture, timing: FrameTiming, places: IndexArray | None = None) -> Iterator[Frame]:
    """Pictures of a capture's folder that a timing names, or those of them at some places; see :func:`read_frames`."""
    assert isinstance(capture.frames, ImageFolder)
    for i in range(len(timing.names)) if places is None else places.tolist():
        path = path_in(capture.frames.folder, timing.names[i])
        yield _frame(capture, timing, i, path, read_image(path))


def _video_frames(source: Video, log: FrameLog | None) -> tuple[FrameStamps, Int64Array]:
    """Stamps of the frames to use, and the presentation stamps by which to find them in the video."""
    source_ns = video_stamps_ns(source.file)
    names = tuple(frame_name(int(t_ns), int(source_ns[0])) for t_ns in source_ns)
    t_ns = source_ns
    recorded_ns = None if log is None else log.epoch_ns + np.rint(log.t_s * 1e9).astype(np.int64)
    if source.frame_times is None and log is not None and recorded_ns is not None and not log.in_video_time:
        if len(recorded_ns) not in (0, len(source_ns)):
            raise TimingError(
                Fact(
                    "recorder-noted-other-count", video=str(source.file), frames=len(source_ns), noted=len(recorded_ns)
                )
            )
        t_ns = recorded_ns if len(recorded_ns) else source_ns
    if source.frame_times is not None:
        t_ns = stamps_of_log(source.frame_times, source.time_unit)
        if len(t_ns) != len(source_ns):
            raise TimingError(
                Fact(
                    "times-of-other-count",
                    times_file=str(source.frame_times),
                    times=len(t_ns),
                    video=str(source.file),
                    frames=len(source_ns),
                )
            )
        if (np.diff(t_ns) <= 0).any():
            raise TimingError(
                Fact("frame-times-back", times_file=str(source.frame_times), row=int(1 + np.argmin(np.diff(t_ns))))
            )
    keep = np.arange(len(t_ns)) if source.frames_per_s is None else thin(t_ns, source.frames_per_s)
    exposure_s = None
    if log is not None and log.exposure_s is not None and len(log.exposure_s) == len(source_ns):
        exposure_s = log.exposure_s[keep]
    return FrameStamps(names=tuple(names[i] for i in keep), t_ns=t_ns[keep], exposure_s=exposure_s), source_ns[keep]


def thin(t_ns: Int64Array, frames_per_s: float) -> IndexArray:
    """Indices of about ``frames_per_s`` frames a second: for each tick of that clock the frame nearest to it."""
    since_s = (t_ns - t_ns[0]) / 1e9
    ticks = np.arange(int(since_s[-1] * frames_per_s) + 1) / frames_per_s
    after = np.clip(np.searchsorted(since_s, ticks), 1, max(1, len(since_s) - 1))
    if len(since_s) == 1:
        return np.zeros(1, dtype=np.intp)
    nearest = np.where(since_s[after] - ticks < ticks - since_s[after - 1], after, after - 1)
    return np.unique(nearest)


def _decode_video(
    capture: Capture, source: Video, timing: FrameTiming, source_ns: Int64Array, places: IndexArray
) -> Iterator[Frame]:
    place = {int(source_ns[i]): i for i in places.tolist()}
    for t_ns, image in decode_video(source.file, source_ns[places]):
        yield _frame(capture, timing, place[t_ns], source.file, image)


def _frame(capture: Capture, timing: FrameTiming, i: int, path: Path, image: UInt8Array | UInt16Array) -> Frame:
    camera = capture.camera
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        height, width = image.shape[:2]
        declared = {"declared_width": camera.width, "declared_height": camera.height, "declared_in": str(capture.path)}
        raise FormatError(path, Fact("picture-of-other-size", width=width, height=height, **declared))
    return Frame(
        name=timing.names[i],
        image=image,
        t_s=float(timing.t_s[i]),
        exposure_s=None if timing.exposure_s is None else float(timing.exposure_s[i]),
        readout_s=timing.readout_s,
        camera=camera,
    )
