"""Frames through the frame stages into the folder that COLMAP reads, with a record of what was done to each."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError, InertialError
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.io.image_metadata import carry_metadata
from colmap_inertial.run.progress import Progress
from colmap_inertial.run.workspace import a_record_of_ours
from colmap_inertial.stages.protocols import FrameStage
from colmap_inertial.types import CameraModel, Frame, FrameTiming


@dataclass(frozen=True, kw_only=True)
class FrameTreatment:
    """What a frame stage decided about one frame, and why.

    Attributes
    ----------
    reason
        In words.
    blur_px
        90th percentile over the image of the blur that the gyroscope predicts; ``None`` where unknown.
    deblurred
        Whether pixels were deblurred.
    kept_share
        Share of the image that kept its pixels.
    extent_factor
        What the predicted blur was multiplied by to agree with the images.
    """

    reason: str
    blur_px: float | None = None
    deblurred: bool = False
    kept_share: float = 1.0
    extent_factor: float = 1.0


@runtime_checkable
class ExplainedStage(Protocol):
    """A frame stage that says what it did to each frame."""

    def treatment(self, name: str, /) -> FrameTreatment | None:
        """What was decided about a frame that went through; ``None`` where there is nothing to say."""
        ...


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """What happened to one frame.

    Attributes
    ----------
    name
        Image name.
    action
        ``"passed"``: the original file or pixels; ``"deblurred"``; ``"changed"``: by another frame stage;
        ``"dropped"``: by a frame stage.
    camera
        Intrinsics that COLMAP starts from; ``None`` where COLMAP guesses.
    treatment
        What a stage that explains itself decided; ``None`` where there was none.
    """

    name: str
    action: str
    camera: CameraModel | None
    treatment: FrameTreatment | None = None


class _Originals:
    """Remembers the decoded array of each frame in flight, to tell whether a stage has changed it."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def tap(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        for frame in frames:
            self._arrays[frame.name] = frame.image
            yield frame

    def pop_through(self, name: str) -> NDArray[Any] | None:
        """The original of ``name``; forgets it and, as order is kept, every frame before it."""
        found = None
        for known in list(self._arrays):
            array = self._arrays.pop(known)
            if known == name:
                found = array
                break
        return found


def write_frames(
    frames: Iterator[Frame],
    timing: FrameTiming,
    stages: Sequence[FrameStage],
    *,
    source_folder: Path | None,
    images: Path,
    records: Path,
    progress: Progress,
) -> None:
    """Run the frames through the stages and write them.

    Parameters
    ----------
    frames
        Decoded frames in order of time.
    timing
        Of all frames that the capture has.
    source_folder
        Where the original files lie, for image folders: a frame that no stage changed is copied, byte for byte.
    images
        Written: the folder for COLMAP.
    records
        Written: a JSON with one :class:`FrameRecord` for each frame of the capture.

    Raises
    ------
    InertialError
        When fewer than three frames are left, which cannot become a model.
    """
    originals = _Originals()
    stream = originals.tap(frames)
    for stage in stages:
        stream = iter(stage(stream))
    written: dict[str, FrameRecord] = {}
    images.mkdir(parents=True)
    known = set(timing.names)
    for frame in stream:
        if frame.name not in known or frame.name in written:
            raise ValueError(f"a frame stage yielded {frame.name!r}, which is no frame of the capture or came twice")
        original = originals.pop_through(frame.name)
        passed = original is not None and _same_memory(original, frame.image)
        target = images / frame.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if passed and source_folder is not None:
            shutil.copyfile(source_folder / frame.name, target)
        else:
            encode_image(target, frame.image, None if source_folder is None else source_folder / frame.name)
        written[frame.name] = FrameRecord(
            name=frame.name, action="passed" if passed else "changed", camera=frame.camera
        )
        progress("frames", len(written), len(timing.names))
    require_frames(len(written), of=len(timing.names))
    every = [written.get(name) or FrameRecord(name=name, action="dropped", camera=None) for name in timing.names]
    for stage in stages:
        if isinstance(stage, ExplainedStage):
            every = [_explained(record, stage.treatment(record.name)) for record in every]
    write_json(records, {"frames": [asdict(record) for record in every]})


def _explained(record: FrameRecord, treatment: FrameTreatment | None) -> FrameRecord:
    if treatment is None:
        return record
    action = "deblurred" if record.action == "changed" and treatment.deblurred else record.action
    return replace(record, action=action, treatment=treatment)


def require_frames(count: int, *, of: int) -> None:
    """Raise ``InertialError`` where there are too few frames for a model."""
    if count < 3:
        raise InertialError(f"{count} frames are left of {of}; a model needs at least three")


def _same_memory(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Whether two arrays show the same bytes of the same buffer (``is`` fails: a Frame holds a read-only view)."""
    return a.__array_interface__ == b.__array_interface__


def encode_image(target: Path, image: NDArray[Any], original: Path | None = None) -> None:
    """Write an image in the format of its file name, with the metadata of the file that it was made from.

    Raises
    ------
    FormatError
        Where the format cannot hold such pixels.
    """
    import cv2

    bgr = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, 98] if target.suffix.lower() in (".jpg", ".jpeg") else []
    # Through memory: cv2.imwrite reports a full disk as success.
    ok, data = cv2.imencode(target.suffix, bgr, options)
    if not ok:
        raise FormatError(target, f"OpenCV cannot write {image.dtype} images as {target.suffix}")
    encoded = data.tobytes()
    target.write_bytes(encoded if original is None else carry_metadata(original.read_bytes(), encoded))


def read_frame_records(path: Path) -> tuple[FrameRecord, ...]:
    """The records that :func:`write_frames` wrote."""
    records, values = [], read_json(path)
    with a_record_of_ours(path):
        for item in values["frames"]:
            camera = item["camera"]
            if camera is not None:
                camera = CameraModel(**{**camera, "params": tuple(camera["params"])})
            treatment = None if item["treatment"] is None else FrameTreatment(**item["treatment"])
            records.append(FrameRecord(name=item["name"], action=item["action"], camera=camera, treatment=treatment))
    return tuple(records)
