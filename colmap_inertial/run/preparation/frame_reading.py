"""Frames of a capture for all that looks at them before COLMAP: each is decoded once in small, and once in full.

A video is decoded forwards only, as far as somebody asks. Of the frames that pass, what others are going to look at is
kept in their sizes: in memory, and beyond that in a file in the run's folder. What was not kept is decoded again.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.core.threads import frames_at_once, map_in_order
from colmap_inertial.core.types import CameraModel, Frame, FrameTiming
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.frames import LazyFrame, decode_images, decode_lazily, read_frames, read_lazily
from colmap_inertial.motion.flow import FOLLOWED_PX, GreyFrame
from colmap_inertial.motion.two_view_rotation import COMPARED_PX
from colmap_inertial.run.stages.frame_folder import encode_image


@dataclass(frozen=True, kw_only=True)
class ReadingLimits:
    """Limits for frames that are kept for others to look at."""

    #: Bytes that are kept in memory, and beyond that in a file, at most.
    in_memory: int = 64 << 20
    in_all: int = 2 << 30
    #: COLMAP's guess of a focal length, in longer sides of the image.
    focal_per_side: float = 1.2


_LIMITS = ReadingLimits()


@dataclass(frozen=True)
class Reduction:
    """A size in which frames are looked at.

    Attributes
    ----------
    long_side_px
        Larger frames are shrunk to this by area.
    of_luma
        Whether a video's luma is taken as it is coded, which is quicker than the brightness of its colours.
    """

    long_side_px: int
    of_luma: bool = False


#: To follow corners, to compare images two by two, and to see whether there is anything in an image.
FOLLOWED, COMPARED, GLANCED_AT = Reduction(FOLLOWED_PX), Reduction(COMPARED_PX), Reduction(320)
#: In grey, but not reduced.
WHOLE = Reduction(1 << 16)
#: To rank frames by their sharpness.
RANKED = Reduction(960, of_luma=True)


@dataclass(frozen=True)
class _Place:
    """Where a frame was kept: offset in the file, shape; and the size of the frame itself."""

    offset: int
    shape: tuple[int, ...]
    width: int
    height: int


class GreyFrames:
    """Frames of a capture in grey and in small.

    Parameters
    ----------
    capture
        Where they are.
    timing
        Of all frames.
    folder
        For the file of what is kept; that of temporary files where absent.

    Attributes
    ----------
    timing
        As given.
    """

    def __init__(self, capture: Capture, timing: FrameTiming, folder: Path | None = None) -> None:
        self.timing = timing
        self._capture, self._folder = capture, folder
        self._index = {name: i for i, name in enumerate(timing.names)}
        self._expected = Counter[tuple[Reduction, str]]()
        self._reductions: set[Reduction] = set()
        self._kept: dict[tuple[Reduction, str], _Place] = {}
        self._file: tempfile.SpooledTemporaryFile[bytes] | None = None
        self._bytes = 0
        self._size: tuple[int, int] | None = None
        self._decoder: Iterator[LazyFrame] | None = None
        self._passed = -1

    def expect(self, reduction: Reduction, names: Iterable[str]) -> None:
        """Announce a :meth:`look` at frames: where they pass before it, they are kept in this size."""
        self._reductions.add(reduction)
        self._expected.update((reduction, name) for name in names)

    def look(self, reduction: Reduction, names: Iterable[str]) -> Iterator[GreyFrame]:
        """Frames in this size, in order of time.

        Raises
        ------
        FormatError
            For a frame that cannot be decoded, or of a video has another size than the camera.
        """
        for name in sorted(names, key=self._index.__getitem__):
            self._expected[reduction, name] -= 1
            place = self._kept.get((reduction, name))
            if place is not None:
                yield GreyFrame(name=name, grey=self._read(place), width=place.width, height=place.height)
            else:
                yield self._convert(self._decode(name), reduction)

    def guess_camera(self) -> CameraModel:
        """The declared intrinsics, or what COLMAP starts from without any."""
        if self._capture.camera is not None:
            return self._capture.camera
        if self._size is None:
            first = next(self.look(GLANCED_AT, self.timing.names[:1]))
            self._size = first.width, first.height
        return _guess_camera(*self._size)

    def close(self) -> None:
        """Forget all that was kept."""
        self._kept.clear()
        self._decoder = None
        self._bytes = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def _decode(self, name: str) -> LazyFrame:
        """A frame by itself, or of a video the decoder's next of that name; what passes is kept where expected."""
        if isinstance(self._capture.frames, ImageFolder):
            return read_lazily(path_in(self._capture.frames.folder, name), name)
        if self._decoder is None or self._index[name] <= self._passed:
            self._decoder = decode_lazily(self._capture)
        for passing in self._decoder:
            self._passed = self._index.get(passing.name, -1)
            if passing.name == name:
                return passing
            self._keep(passing)
        raise AssertionError("a video that lacks a frame raises an error")

    def _convert(self, frame: LazyFrame, reduction: Reduction) -> GreyFrame:
        """A frame in one size; in others it is kept where expected."""
        self._keep(frame)
        return _reduce(frame, reduction)

    def _keep(self, frame: LazyFrame) -> None:
        for reduction in self._reductions:
            key = reduction, frame.name
            if self._expected[key] > 0 and key not in self._kept and self._bytes < _LIMITS.in_all:
                reduced = _reduce(frame, reduction)
                self._kept[key] = self._write(reduced)

    def _write(self, frame: GreyFrame) -> _Place:
        if self._file is None:
            folder = None if self._folder is None else str(self._folder)
            self._file = tempfile.SpooledTemporaryFile(_LIMITS.in_memory, dir=folder)  # noqa: SIM115
            weakref.finalize(self, self._file.close)  # for who looks once and does not close
        self._file.seek(self._bytes)
        self._file.write(frame.grey.tobytes())
        place = _Place(self._bytes, frame.grey.shape, frame.width, frame.height)
        self._bytes += frame.grey.size
        return place

    def _read(self, place: _Place) -> UInt8Array:
        assert self._file is not None
        self._file.seek(place.offset)
        data = self._file.read(int(np.prod(place.shape)))
        return np.frombuffer(data, np.uint8).reshape(place.shape)


def _reduce(frame: LazyFrame, reduction: Reduction) -> GreyFrame:
    if reduction.of_luma:
        luma = frame.luma(reduction.long_side_px)
        return GreyFrame(name=frame.name, grey=luma, width=frame.width, height=frame.height)
    return GreyFrame.of(frame.frame(), reduction.long_side_px)


def _guess_camera(width: int, height: int) -> CameraModel:
    params = (_LIMITS.focal_per_side * max(width, height), width / 2, height / 2)
    return CameraModel(model="SIMPLE_PINHOLE", width=width, height=height, params=params)


class FullFrames:
    """The frames to use as they are. Those of a video become files once, where some are needed before all of them.

    Parameters
    ----------
    capture
        Where they are.
    timing
        Of the frames to use.
    scratch
        A folder for such files.
    """

    def __init__(self, capture: Capture, timing: FrameTiming, scratch: Path) -> None:
        self._capture, self._timing, self._scratch = capture, timing, scratch
        self._decoded: Path | None = None

    @property
    def camera(self) -> CameraModel | None:
        """Declared intrinsics."""
        return self._capture.camera

    @property
    def files(self) -> Path | None:
        """The folder of the frames' files; ``None`` for a video that has none yet."""
        return self._capture.image_folder or self._decoded

    def require_files(self) -> Path:
        """The folder of the frames' files; those of a video are decoded."""
        if self.files is None:
            folder = Path(tempfile.mkdtemp(dir=self._scratch))
            for _ in map_in_order(lambda frame: _write(folder, frame), self.decode(), workers=frames_at_once()):
                pass
            self._decoded = folder
        assert self.files is not None
        return self.files

    def decode(self, names: Iterable[str] | None = None) -> Iterator[Frame]:
        """All frames in order of time, or some of them.

        Raises
        ------
        FormatError
            For a frame that cannot be decoded, or has another size than the camera.
        """
        if names is not None:
            self.require_files()
        wanted = set(self._timing.names if names is None else names)
        if self.files is None:
            yield from read_frames(self._capture, only=wanted)[1]
            return
        places = np.flatnonzero([name in wanted for name in self._timing.names])
        yield from decode_images(replace(self._capture, frames=ImageFolder(folder=self.files)), self._timing, places)

    def close(self) -> None:
        """Remove files that were decoded."""
        if self._decoded is not None:
            shutil.rmtree(self._decoded)
            self._decoded = None


def _write(folder: Path, frame: Frame) -> None:
    target = path_in(folder, frame.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    encode_image(target, frame.image)
