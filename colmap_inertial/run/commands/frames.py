"""The frames of a capture on their way to COLMAP, and images of some of them before and after."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import AnyArray, UInt8Array
from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel, Frame
from colmap_inertial.hooks import FrameStage, KeypointStage, apply_refined_calibration
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import Decision
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.io.files import path_in, write_json
from colmap_inertial.io.images import read_image
from colmap_inertial.io.recording import Recording
from colmap_inertial.io.rig_frames import RigFrames
from colmap_inertial.model import colmap_camera, read_model
from colmap_inertial.run.commands.result import ModelResult
from colmap_inertial.run.preparation.frame_reading import FullFrames
from colmap_inertial.run.stages.frame_folder import (
    FramePaths,
    FrameRecord,
    encode_image,
    image_movers,
    read_frame_records,
    write_frames,
    write_images,
)
from colmap_inertial.run.stages.imaging_plan import ImagingPlan
from colmap_inertial.run.steps.session import Session

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ContactSheet:
    """Layout of the contact sheet."""

    frames: int = 8
    width: int = 420
    height: int = 280
    gap: int = 6
    label: int = 22
    #: Frames that are looked at for the report, and how many of them it shows.
    candidates: int = 16
    shown: int = 4
    #: Distance of the arrows, px of the crop.
    arrows_px: int = 70


_LIMITS = ContactSheet()
_LEGEND = "red lines: the path of a point while the frame is exposed, by the gyroscope"

#: Top, left, height and width.
Part = tuple[int, int, int, int]


def write_contact_sheet(path: Path, frames: FullFrames, plan: ImagingPlan, images: Path, names: Sequence[str]) -> None:
    """Write a PNG: one row for each of the first frames named; before on the left, after on the right with the
    method that undid the blur.

    Parameters
    ----------
    path
        Of the PNG.
    frames
        The images as they were filmed.
    plan
        By which it was deblurred.
    images
        Folder of the deblurred images.
    names
        Of deblurred frames, the most blurred first.
    """
    import cv2

    view = plan.view
    if view is None:
        raise ValueError("nothing was deblurred without a view")
    index = view.index()
    motion, camera = view.motion(), colmap_camera(view.camera)
    rows: dict[str, UInt8Array] = {}
    for frame in frames.decode(names[: _LIMITS.frames]):
        parallax = plan.parallaxes.get(frame.name)
        field = blur_field(motion, camera, view.shutter(index[frame.name]), parallax=parallax)
        before, after = _eight_bit(frame.image), _eight_bit(read_image(path_in(images, frame.name)))
        top, left, height, width = _busiest(before)
        cut = [picture[top : top + height, left : left + width].copy() for picture in (before, after)]
        _draw(cut[0], field, top, left)
        length = float(np.percentile(field.extent_px(), 90))
        gap = np.full((height, _LIMITS.gap, 3), 255, np.uint8)
        label = _write_label(f"{frame.name}   {length:.1f} px   before | {plan.method}", 2 * width + _LIMITS.gap)
        rows[frame.name] = np.concatenate([label, np.concatenate([cut[0], gap, cut[1]], axis=1)])
    shown = [rows[name] for name in names[: _LIMITS.frames]]
    sheet = np.concatenate([_write_label(_LEGEND, shown[0].shape[1]), *shown])
    data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1]
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(Fact("cannot-be-written", path=str(path), detail=str(error.strerror or error))) from error


def _write_label(text: str, width: int) -> UInt8Array:
    """Black words on a white line."""
    import cv2

    label = np.full((_LIMITS.label, width, 3), 255, np.uint8)
    cv2.putText(label, text, (4, _LIMITS.label - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return label


@dataclass(eq=False)
class CropKeeper:
    """Keeps parts of some frames as they pass before and after the frame stages, a few however many there are.

    Attributes
    ----------
    blur_px
        By name, the blur of the frames to look at.
    """

    blur_px: Mapping[str, float]
    _seen: dict[str, tuple[Part, UInt8Array]] = field(default_factory=dict, init=False)
    _pairs: dict[str, tuple[UInt8Array, UInt8Array]] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, plan: ImagingPlan) -> CropKeeper:
        """The sheet of a plan: frames to deblur, evenly from the most to the least blurred."""
        blurred = () if plan.deblur is None else plan.deblur[0]
        by_blur = sorted(
            (d for d in blurred if d.action is Decision.DEBLUR), key=lambda d: (-(d.blur_px or 0.0), d.name)
        )
        some = by_blur[:: -(-len(by_blur) // _LIMITS.candidates) or 1]
        return cls(blur_px={decision.name: decision.blur_px or 0.0 for decision in some})

    def before(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """The first stage."""
        for frame in frames:
            if frame.name in self.blur_px:
                picture = _eight_bit(frame.image)
                part = _busiest(picture)
                self._seen[frame.name] = part, _cut(picture, part)
            yield frame

    def after(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """The last stage."""
        for frame in frames:
            seen = self._seen.pop(frame.name, None)
            if seen is not None:
                part, before = seen
                after = _cut(_eight_bit(frame.image), part)
                if before.shape == after.shape and not np.array_equal(before, after):
                    self._pairs[frame.name] = before, after
            yield frame

    def write(self, folder: Path) -> None:
        """Write the most blurred of the frames that were changed: JPEGs, and ``crops.json`` with their names."""
        folder.mkdir(parents=True)
        listed = []
        for number, name in enumerate(sorted(self._pairs, key=lambda name: -self.blur_px[name])[: _LIMITS.shown]):
            entry: dict[str, object] = {"name": name, "blur_px": self.blur_px[name]}
            for side, picture in zip(("before", "after"), self._pairs[name], strict=True):
                entry[side] = f"{number}_{side}.jpg"
                encode_image(folder / f"{number}_{side}.jpg", picture)
            listed.append(entry)
        write_json(folder / "crops.json", {"crops": listed})


def _cut(picture: UInt8Array, part: Part) -> UInt8Array:
    top, left, height, width = part
    return picture[top : top + height, left : left + width].copy()


def _eight_bit(image: AnyArray) -> UInt8Array:
    """(H, W, 3) with 8 bit."""
    codes = np.asarray(image if image.dtype == np.uint8 else image >> 8, dtype=np.uint8)
    return np.repeat(codes[..., None], 3, axis=2) if codes.ndim == 2 else codes


def _busiest(image: UInt8Array) -> Part:
    """Top, left, height and width of the part with the most texture."""
    import cv2

    height, width = min(_LIMITS.height, image.shape[0]), min(_LIMITS.width, image.shape[1])
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    texture = np.abs(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 2), cv2.CV_32F))
    sums = cv2.integral(np.minimum(texture, np.percentile(texture, 99)))
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return int(top), int(left), height, width


def _draw(crop: UInt8Array, field: BlurField, top: int, left: int) -> None:
    """The segments along which pixels were smeared."""
    import cv2

    height, width = crop.shape[:2]
    for y in range(_LIMITS.arrows_px // 2, height, _LIMITS.arrows_px):
        for x in range(_LIMITS.arrows_px // 2, width, _LIMITS.arrows_px):
            row, column = (round((at + offset) / field.step_px) for at, offset in ((y, top), (x, left)))
            row, column = min(row, field.vector_px.shape[0] - 1), min(column, field.vector_px.shape[1] - 1)
            dx, dy = 0.5 * field.vector_px[row, column]
            ends = [(round(float(x + sign * dx)), round(float(y + sign * dy))) for sign in (-1, 1)]
            cv2.line(crop, ends[0], ends[1], (255, 60, 0), 2, cv2.LINE_AA)


def run_frames(
    session: Session,
    recording: Recording,
    frames: FullFrames,
    stages: Sequence[FrameStage],
    images: Path,
    plan: ImagingPlan | None = None,
    rig: RigFrames | None = None,
) -> tuple[FrameRecord, ...]:
    """The frames through the stages into the folder ``images``; with a plan, parts of some are kept for the report.

    ``rig``: images of other cameras, which go with the frames.
    """
    workspace, timing = session.workspace, recording.timing
    names, elsewhere = list(timing.names), {}
    if rig is not None:
        names, elsewhere = names + rig.names(timing.names), rig.originals(timing.names)
    kept = None if plan is None else CropKeeper.of(plan)

    def work(partial: Sequence[Path]) -> None:
        images, records, unsmoothed = partial[:3]
        paths = FramePaths(
            source=frames.files, images=images, records=records, unsmoothed=unsmoothed, elsewhere=elsewhere
        )
        through = stages if kept is None else (kept.before, *stages, kept.after)
        decoded = frames.decode()
        every = decoded if rig is None else rig.add_images(decoded, timing)
        write_frames(every, names, through, paths, session.progress)
        if kept is not None:
            kept.write(partial[3])

    depends = {
        "capture": replace(recording.capture, target=None),
        "timing": recording.timing,
        "inputs": recording.inputs(),
        "stages": stages,
        "kept": {} if kept is None else kept.blur_px,
        "images": images.relative_to(workspace.root).as_posix(),
    }
    crops = [] if kept is None else [workspace.crops]
    outputs, depths = [images, workspace.frames, workspace.unsmoothed, *crops], [workspace.apertures]
    session.runner.run("frames", depends, outputs, work, beside=lambda: depths)
    return read_frame_records(workspace.frames)


def stages_of_refined(stages: Sequence[KeypointStage], models: Sequence[ModelResult]) -> list[KeypointStage]:
    """The stages with clocks, readout and camera as the largest model that was refined has them."""
    for model in models:
        refined = next(
            (treatment for treatment in model.treatments if treatment.action and "readout_s" in treatment.values), None
        )
        if refined is None or model.sparse_metric is None or model.scale.calibration is None:
            continue
        readout_s = refined.values["readout_s"]
        assert isinstance(readout_s, float)
        cameras = read_model(model.sparse_metric).cameras
        camera = cameras[min(cameras)]
        intrinsics = CameraModel(
            model=camera.model.name, width=camera.width, height=camera.height, params=tuple(camera.params)
        )
        return apply_refined_calibration(stages, model.scale.calibration, readout_s, intrinsics)
    return list(stages)


def run_images(
    session: Session,
    records: Sequence[FrameRecord],
    rectified: Collection[str],
    stages: Sequence[KeypointStage],
    *,
    smoothed: bool = False,
) -> Path:
    """Images that agree with the keypoints, for whoever goes on from the model; returns their folder.

    ``smoothed``: as COLMAP saw them.
    """
    workspace = session.workspace
    movers = image_movers(stages)
    if rectified and not movers:
        log.warning("keypoints of %d images are rectified by a stage that moves no pixels", len(rectified))
    moved = frozenset(rectified) if movers else frozenset()
    names = [record.name for record in records if record.used]

    def work(partial: Sequence[Path]) -> None:
        unsmoothed = None if smoothed else workspace.unsmoothed
        write_images(movers, names, moved, workspace.colmap_images, partial[0], session.progress, unsmoothed)

    depends: dict[str, object] = {"stages": stages if moved else (), "rectified": sorted(moved)}
    if smoothed:
        depends["smoothed"] = True
    session.runner.run("images", depends, [workspace.images], work, after=["frames"])
    return workspace.images
