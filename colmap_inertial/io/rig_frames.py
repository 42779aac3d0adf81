"""Images that the cameras of a rig took together: paired by name or time, and decoded in one stream."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import IndexArray, Int64Array
from colmap_inertial.core.errors import TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_rig import RigCamera
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import ImageFolder, image_names
from colmap_inertial.io.frame_times import SAME_MOMENT_NS
from colmap_inertial.io.frames import decode_images, read_frame_timing, read_frames


@dataclass(frozen=True, kw_only=True)
class RigFrameLimits:
    """Limits for images of cameras that belong together."""

    #: With a smaller share of the main camera's frames in all cameras, clocks or names do not belong together.
    least_share: float = 0.5


_LIMITS = RigFrameLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class RigFrames:
    """Images of the other cameras of a capture's rig, by the main camera's frames.

    Attributes
    ----------
    capture
        With the rig.
    own_names
        For each of the other cameras, by frame, the name of its image or frame of its video.
    alone
        Frames of the main camera that another camera has no image of.
    """

    capture: Capture
    own_names: tuple[Mapping[str, str], ...]
    alone: tuple[str, ...] = ()

    def names(self, frames: Sequence[str]) -> list[str]:
        """Names that COLMAP sees of the other cameras' images of some frames."""
        return [image_name(camera, frame) for camera in self.capture.rig for frame in frames]

    def originals(self, frames: Sequence[str]) -> dict[str, Path | None]:
        """Files of these images by those names; ``None`` of a video's, and of another format than the frame's."""
        return {
            image_name(camera, frame): path_in(camera.frames.folder, own[frame])
            if isinstance(camera.frames, ImageFolder) and Path(own[frame]).suffix == Path(frame).suffix
            else None
            for camera, own in zip(self.capture.rig, self.own_names, strict=True)
            for frame in frames
        }

    def add_images(self, frames: Iterator[Frame], timing: FrameTiming) -> Iterator[Frame]:
        """The frames of the main camera, each followed by the other cameras' images.

        Raises
        ------
        FormatError
            While iterating, as :func:`read_frames`.
        """
        others = [
            _decode(self.capture, camera, own, timing)
            for camera, own in zip(self.capture.rig, self.own_names, strict=True)
        ]
        return heapq.merge(frames, *others, key=lambda frame: frame.t_s)


def image_name(camera: RigCamera, frame: str) -> str:
    """Name that COLMAP sees of another camera's image of a frame."""
    return f"{camera.name}/{frame}"


def pair_rig_frames(capture: Capture, timing: FrameTiming) -> RigFrames:
    """Find the images of all cameras that belong together.

    Cameras whose images have times are paired by these, within a millisecond; the others by names.

    Raises
    ------
    FormatError, TimingError
        Where images cannot be read, the names collide, or fewer than half of the frames have an image of a camera.
    """
    own_names = tuple(_find_own(capture, camera, timing) for camera in capture.rig)
    for camera, own in zip(capture.rig, own_names, strict=True):
        if len(own) < _LIMITS.least_share * len(timing.names):
            raise TimingError(_say_missing(capture, camera, own, timing))
        taken = next((name for name in timing.names if name.startswith(f"{camera.name}/")), None)
        if taken is not None:
            raise TimingError(Fact("main-image-in-camera-folder", camera=camera.name, image=taken))
    alone = tuple(name for name in timing.names if not all(name in own for own in own_names))
    together = len(timing.names) - len(alone)
    if together < _LIMITS.least_share * len(timing.names):
        raise TimingError(Fact("rig-frames-too-few", together=together, frames=len(timing.names)))
    return RigFrames(capture=capture, own_names=own_names, alone=alone)


def _capture_of(capture: Capture, camera: RigCamera) -> Capture:
    """The capture as if another camera of its rig were the only one."""
    return replace(capture, frames=camera.frames, camera=camera.camera, frame_log=None, rig=())


def _find_own(capture: Capture, camera: RigCamera, timing: FrameTiming) -> dict[str, str]:
    if isinstance(camera.frames, ImageFolder) and camera.frames.times is None:
        present = set(image_names(camera.frames))
        return {name: name for name in timing.names if name in present}
    own = read_frame_timing(_capture_of(capture, camera))
    nearest, apart_ns = _find_nearest(own, timing)
    together = np.flatnonzero(apart_ns <= SAME_MOMENT_NS).tolist()
    frame_of = {own.names[nearest[i]]: timing.names[i] for i in together}  # each image once
    return {name: image for image, name in frame_of.items()}


def _find_nearest(own: FrameTiming, timing: FrameTiming) -> tuple[IndexArray, Int64Array]:
    """For each frame, the nearest image of another camera in time, and how far apart they are in nanoseconds."""
    own_ns, frame_ns = (one.epoch_ns + np.rint(one.t_s * 1e9).astype(np.int64) for one in (own, timing))
    after = np.clip(np.searchsorted(own_ns, frame_ns), 0, len(own_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(own_ns[before] - frame_ns) < np.abs(own_ns[after] - frame_ns), before, after)
    return nearest, np.abs(own_ns[nearest] - frame_ns)


def _say_missing(capture: Capture, camera: RigCamera, own: Mapping[str, str], timing: FrameTiming) -> Fact:
    found = {"camera": camera.name, "found": len(own), "frames": len(timing.names)}
    if isinstance(camera.frames, ImageFolder) and camera.frames.times is None:
        return Fact("rig-names-differ", **found, folder=str(camera.frames.folder), main=timing.names[0])
    others = read_frame_timing(_capture_of(capture, camera))
    apart_ns = int(np.median(_find_nearest(others, timing)[1]))
    apart = {"within_ms": SAME_MOMENT_NS / 1e6, "images": len(others.names), "apart_ms": apart_ns / 1e6}
    return Fact("rig-times-differ", **found, **apart)


def _decode(capture: Capture, camera: RigCamera, own: Mapping[str, str], timing: FrameTiming) -> Iterator[Frame]:
    """Images of another camera for the frames of a timing, with their names and times."""
    source = _capture_of(capture, camera)
    frame_of = {own[name]: i for i, name in enumerate(timing.names)}
    if isinstance(camera.frames, ImageFolder):
        images = decode_images(source, replace(timing, names=tuple(frame_of), exposure_s=None))
    else:
        images = read_frames(source, only=frame_of)[1]
    for image in images:
        i = frame_of[image.name]
        yield replace(image, name=image_name(camera, timing.names[i]), t_s=float(timing.t_s[i]))
