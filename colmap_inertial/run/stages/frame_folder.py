"""Folders of frames: those that COLMAP reads, with a record of each, and those that agree with the model."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import AnyArray, set_fields
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.threads import frames_at_once, map_in_order
from colmap_inertial.core.types import Action, CameraModel, Frame, Treatment
from colmap_inertial.hooks import FrameStage, KeypointStage
from colmap_inertial.imaging.path_filters import smoothed
from colmap_inertial.io.exif import carry_metadata
from colmap_inertial.io.files import path_in, read_record, write_record
from colmap_inertial.io.images import read_alpha, read_image
from colmap_inertial.io.jpeg_coding import JPEG_LIMITS, read_jpeg_coding
from colmap_inertial.model.copying import copy_file

_WITH_ALPHA = (".png", ".tif", ".tiff")


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """Treatment of one frame.

    Attributes
    ----------
    name
        Image name.
    action
        What the last frame stage that changed it says; ``Action.PASSED`` for the original file or pixels,
        ``Action.DROPPED`` for a frame that a stage left out.
    camera
        Intrinsics that COLMAP starts from; ``None`` where COLMAP guesses.
    treatments
        What the stages said.
    sharpened
        Whether the image that COLMAP sees had its blur undone.
    rectified
        Whether the rolling shutter of its keypoints was undone; ``None`` before there are keypoints, as in
        ``frames.json``.
    """

    name: str
    action: Action
    camera: CameraModel | None = None
    treatments: tuple[Treatment, ...] = ()
    sharpened: bool = False
    rectified: bool | None = None

    def __post_init__(self) -> None:
        set_fields(self, action=Action(self.action))

    @property
    def used(self) -> bool:
        """Whether COLMAP sees it."""
        return self.action is not Action.DROPPED

    @property
    def reason(self) -> Fact | None:
        """Why, by the last stage that said something; ``None`` where none did."""
        return self.treatments[-1].reason if self.treatments else None

    def value(self, key: str) -> Any:
        """A figure that a stage gave; ``None`` where none did."""
        return next((t.values[key] for t in reversed(self.treatments) if key in t.values), None)


@dataclass(frozen=True, kw_only=True)
class FrameRecords:
    """Treatment of the frames of a capture, in order of time."""

    frames: tuple[FrameRecord, ...]


@dataclass(frozen=True, kw_only=True)
class FramePaths:
    """Sources and destinations of frames.

    Attributes
    ----------
    source
        Where the original files lie, for image folders: a frame that no stage changed is copied, byte for byte.
    images
        Written: the folder for COLMAP.
    records
        Written: a JSON with one :class:`FrameRecord` for each frame of the capture.
    unsmoothed
        Written: the folder for frames as they are, of which COLMAP is to see smoothed ones. Without it, those are
        nowhere.
    elsewhere
        Original files that are not in ``source``, by frame; ``None`` where there is no file.
    """

    source: Path | None
    images: Path
    records: Path
    unsmoothed: Path | None = None
    elsewhere: Mapping[str, Path | None] = field(default_factory=dict)

    def original(self, name: str) -> Path | None:
        """The original file of a frame; ``None`` where there is none."""
        if name in self.elsewhere:
            return self.elsewhere[name]
        return None if self.source is None else path_in(self.source, name)


class _Originals:
    """Remembers the decoded array of each frame in flight, to tell whether a stage has changed it."""

    def __init__(self) -> None:
        self._arrays: dict[str, AnyArray] = {}

    def tap(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        for frame in frames:
            self._arrays[frame.name] = frame.image
            yield frame

    def pop_through(self, name: str) -> AnyArray | None:
        """The original of ``name``; forgets it and, as order is kept, every frame before it."""
        original = None
        for known in list(self._arrays):
            array = self._arrays.pop(known)
            if known == name:
                original = array
                break
        return original


def write_frames(
    frames: Iterator[Frame],
    names: Sequence[str],
    stages: Sequence[FrameStage],
    paths: FramePaths,
    progress: Progress,
    *,
    least: int = 3,
) -> None:
    """Run the frames through the stages and write them.

    Parameters
    ----------
    frames
        Decoded frames in order of time.
    names
        Of all these frames, in order.
    paths
        Where they come from and go to.
    progress
        Called with ``"frames"``.

    Raises
    ------
    InertialError
        When fewer than ``least`` frames are left: three, where they are to become a model.
    """
    originals = _Originals()
    stream = originals.tap(frames)
    for stage in stages:
        stream = iter(stage(stream))
    seen: dict[str, FrameRecord] = {}
    paths.images.mkdir(parents=True)
    if paths.unsmoothed is not None:
        paths.unsmoothed.mkdir(parents=True)
    known = set(names)

    def with_original() -> Iterator[tuple[Frame, AnyArray | None]]:
        came: set[str] = set()
        for frame in stream:
            if frame.name not in known or frame.name in came:
                raise ValueError(
                    f"a frame stage yielded {frame.name!r}, which is no frame of the capture or came twice"
                )
            came.add(frame.name)
            yield frame, originals.pop_through(frame.name)

    def write(item: tuple[Frame, AnyArray | None]) -> tuple[Frame, Action]:
        frame, original = item
        return frame, Action.DROPPED if frame.dropped else _write(frame, original, paths)

    for frame, action in map_in_order(write, with_original(), workers=frames_at_once()):
        seen[frame.name] = FrameRecord(
            name=frame.name,
            action=action,
            camera=None if frame.dropped else frame.camera,
            treatments=frame.treatments,
            sharpened=_is_sharpened(frame, action),
        )
        progress("frames", len(seen), len(names))
    require_frames(sum(record.used for record in seen.values()), of=len(names), least=least)
    every = tuple(seen.get(name) or FrameRecord(name=name, action=Action.DROPPED) for name in names)
    write_record(paths.records, FrameRecords(frames=every))


def _write(frame: Frame, original: AnyArray | None, paths: FramePaths) -> Action:
    """Write the image of a frame; returns what happened to it."""
    source = paths.original(frame.name)
    target = path_in(paths.images, frame.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    passed = original is not None and _same_memory(original, frame.image)
    if frame.smoothing_px > 0 and paths.unsmoothed is not None:
        itself = path_in(paths.unsmoothed, frame.name)
        itself.parent.mkdir(parents=True, exist_ok=True)
        encode_image(itself, frame.image, source)
    if frame.smoothing_px > 0:
        encode_image(target, smooth_for_colmap(frame), source)
    elif passed and source is not None:
        shutil.copyfile(source, target)
    else:
        encode_image(target, frame.image, source)
    actions = [treatment.action for treatment in frame.treatments if treatment.action]
    return Action.PASSED if passed else (actions or [Action.CHANGED])[-1]


def _is_sharpened(frame: Frame, action: Action) -> bool:
    changed = action not in (Action.PASSED, Action.DROPPED)
    return changed and any(treatment.action is Action.DEBLURRED for treatment in frame.treatments)


def smooth_for_colmap(frame: Frame) -> AnyArray:
    """The image of a frame that features are extracted from."""
    image: Any = frame.image  # either of two types of pixel
    return smoothed(image, frame.smoothing_px) if frame.smoothing_px > 0 else image


def require_frames(count: int, *, of: int, least: int = 3) -> None:
    """Raise ``InertialError`` where there are too few frames for a model."""
    if count < least:
        raise InertialError(Fact("frames-left-too-few", count=count, of=of))


def _same_memory(a: AnyArray, b: AnyArray) -> bool:
    """Whether two arrays show the same bytes of the same buffer (``is`` fails: a Frame holds a read-only view)."""
    return a.__array_interface__ == b.__array_interface__


def encode_image(
    target: Path,
    image: AnyArray,
    original: Path | None = None,
    *,
    moved: bool = False,
    alpha: AnyArray | None = None,
) -> None:
    """Write an image in the format of its file name, with the metadata of the file that it was made from.

    A JPEG has that one's quality and sampling of colours; PNG and TIFF keep its alpha, unless pixels have ``moved``, or
    have the one that is given.

    Raises
    ------
    FormatError
        Where the format cannot hold such pixels.
    """
    import cv2

    bgr = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR)
    before = None if original is None else original.read_bytes()
    options = _jpeg_options(before) if target.suffix.lower() in (".jpg", ".jpeg") else []
    if alpha is None and before is not None and not moved and target.suffix.lower() in _WITH_ALPHA:
        alpha = read_alpha(before)
    if alpha is not None and alpha.shape == image.shape[:2] and alpha.dtype == image.dtype:
        bgr = np.dstack([bgr, alpha] if bgr.ndim == 3 else [bgr, bgr, bgr, alpha])
    # Through memory: cv2.imwrite reports a full disk as success.
    ok, data = cv2.imencode(target.suffix, bgr, options)
    if not ok:
        raise FormatError(target, Fact("picture-not-writable", dtype=str(image.dtype), suffix=target.suffix))
    encoded = data.tobytes()
    target.write_bytes(encoded if before is None else carry_metadata(before, encoded))


def _jpeg_options(original: bytes | None) -> list[int]:
    """OpenCV's options for a JPEG that is made of another file."""
    import cv2

    if original is None or not original.startswith(b"\xff\xd8"):
        return [cv2.IMWRITE_JPEG_QUALITY, JPEG_LIMITS.most_quality]
    quality, sampling = read_jpeg_coding(original)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return options if sampling is None else [*options, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]


def read_frame_records(path: Path) -> tuple[FrameRecord, ...]:
    """The records that :func:`write_frames` wrote."""
    return read_record(path, FrameRecords).frames


def note_rectified(records: Iterable[FrameRecord], rectified: Collection[str]) -> tuple[FrameRecord, ...]:
    """The records with the frames marked whose keypoints were rectified."""
    return tuple(replace(record, rectified=record.name in rectified) for record in records)


#: Moves the pixels of a named image as a keypoint stage moves its keypoints.
ImageMover = Callable[[str, Any], Any]


def image_movers(stages: Sequence[KeypointStage]) -> list[ImageMover]:
    """Those of the keypoint stages that can move pixels, too: by a method ``move_image(name, image)``."""
    return [stage.move_image for stage in stages if hasattr(stage, "move_image")]


def rectifiable(stages: Sequence[KeypointStage], names: Iterable[str]) -> frozenset[str]:
    """Names of the images that one of the stages can move: where it has a method ``covers(name)``, what that says."""
    movers = [stage for stage in stages if hasattr(stage, "move_image")]
    return frozenset(name for name in names if any(_covers(stage, name) for stage in movers))


def _covers(stage: object, name: str) -> bool:
    covers = getattr(stage, "covers", None)
    return covers is None or bool(covers(name))


def write_images(
    movers: Sequence[ImageMover],
    names: Sequence[str],
    rectified: Collection[str],
    images: Path,
    target: Path,
    progress: Progress,
    unsmoothed: Path | None = None,
) -> None:
    """Write the images that COLMAP saw as they are without smoothing, and as a global shutter would have taken them.

    What was not rectified is the same file under a second name (a hard link), or a copy where the file system has none.

    Parameters
    ----------
    movers
        Applied one after the other.
    names
        Of all images.
    rectified
        Names of those whose keypoints were rectified.
    images, target
        Folders of the images that COLMAP saw, and of those that are written.
    progress
        Called with ``"images"``.
    unsmoothed
        Folder of those images as they are that COLMAP saw smoothed.
    """

    def work(name: str) -> None:
        source, out = path_in(images, name), path_in(target, name)
        if unsmoothed is not None and path_in(unsmoothed, name).is_file():
            source = path_in(unsmoothed, name)
        out.parent.mkdir(parents=True, exist_ok=True)
        if name in rectified:
            image: Any = read_image(source)
            for move in movers:
                image = move(name, image)
            encode_image(out, image, source, moved=True)
        else:
            copy_file(source, out, link=True)

    target.mkdir(parents=True)
    progress("images", 0, len(names))
    for done, _ in enumerate(map_in_order(work, names, workers=2), start=1):
        progress("images", done, len(names))
