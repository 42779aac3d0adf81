"""The frames of a capture on their way to COLMAP: what is to be done, done, and written down."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import CameraModel, Frame
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.model import read_model
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.pipeline.run.session import Session
from colmap_inertial.pipeline.stages.frame_folder import FramePaths, FrameRecord, read_frame_records, write_frames
from colmap_inertial.pipeline.stages.imaging_plan import ImagingPlan, read_plan, write_plan
from colmap_inertial.pipeline.stages.protocols import FrameStage, KeypointStage, refined_stages
from colmap_inertial.pipeline.stages.rectified import image_movers, write_images
from colmap_inertial.reconstruction.drivers.contact_sheet import CropKeeper
from colmap_inertial.reconstruction.drivers.result import ModelResult
from colmap_inertial.reconstruction.preparation.plan import Treatments, plan_imaging

log = logging.getLogger(__name__)


def ask_for_plan(
    options: ReconstructOptions, frame_stages: Sequence[object], keypoint_stages: Sequence[object], *, pairs: bool
) -> Treatments:
    """What the options ask for, as far as the default stages are to do it."""
    return Treatments(
        deblur=options.deblur,
        rolling_shutter=options.rolling_shutter,
        pairs=pairs,
        frames_by_others=... not in frame_stages,
        keypoints_by_others=... not in keypoint_stages,
    )


def run_plan(session: Session, recording: Recording, asked: Treatments) -> ImagingPlan:
    """What to do to frames and keypoints; where nothing is asked for, nothing is looked at."""

    def work(partial: Sequence[Path]) -> None:
        write_plan(partial[0], plan_imaging(recording, session.context, asked))

    depends = {
        **recording.identity(),
        **session.context.identity(),
        "asked": asked,
        "weights": checksum("deepgyro") if asked.deblur == "deepgyro" else "",
    }
    imaging = session.workspace.imaging
    session.runner.run("imaging", depends, [imaging], work)
    plan = read_plan(imaging, recording.imu, recording.timing)
    log.info("deblurring: %s", plan.deblur_note)
    log.info("rolling shutter: %s", plan.rolling_shutter_note)
    return plan


def run_frames(
    session: Session,
    recording: Recording,
    frames: Iterator[Frame],
    stages: Sequence[FrameStage],
    images: Path,
    plan: ImagingPlan | None = None,
) -> tuple[FrameRecord, ...]:
    """The frames through the stages into the folder ``images``; with a plan, parts of some are kept for the report."""
    source, workspace = recording.capture.image_folder, session.workspace
    kept = None if plan is None else CropKeeper.of(plan)

    def work(partial: Sequence[Path]) -> None:
        paths = FramePaths(source=source, images=partial[0], records=partial[1], unsmoothed=partial[2])
        through = stages if kept is None else (kept.before, *stages, kept.after)
        write_frames(frames, recording.timing.names, through, paths, session.progress)
        if kept is not None:
            kept.write(partial[3])

    depends = {
        "capture": replace(recording.capture, target=None),
        "timing": recording.timing,
        "inputs": recording.inputs(),
        "stages": stages,
        "kept": {} if kept is None else kept.blur_px,
        "images": images.relative_to(workspace.root),
    }
    crops = [] if kept is None else [workspace.crops]
    session.runner.run("frames", depends, [images, workspace.frames, workspace.unsmoothed, *crops], work)
    return read_frame_records(workspace.frames)


def stages_of_refined(stages: Sequence[KeypointStage], models: Sequence[ModelResult]) -> list[KeypointStage]:
    """The stages with clocks, readout and camera as the largest model that was refined has them."""
    for model in models:
        refined = next((one for one in model.treatments if one.action and "readout_s" in one.values), None)
        if refined is None or model.sparse_metric is None or model.scale.calibration is None:
            continue
        readout_s = refined.values["readout_s"]
        assert isinstance(readout_s, float)
        cameras = read_model(model.sparse_metric).cameras
        camera = cameras[min(cameras)]
        intrinsics = CameraModel(
            model=camera.model.name, width=camera.width, height=camera.height, params=tuple(camera.params)
        )
        return refined_stages(stages, model.scale.calibration, readout_s, intrinsics)
    return list(stages)


def run_images(
    session: Session,
    records: Sequence[FrameRecord],
    rectified: Collection[str],
    stages: Sequence[KeypointStage],
) -> Path:
    """Images that agree with the keypoints, for whoever goes on from the model; returns their folder."""
    workspace = session.workspace
    movers = image_movers(stages)
    if rectified and not movers:
        log.warning("keypoints of %d images are rectified by a stage that moves no pixels", len(rectified))
    moved = frozenset(rectified) if movers else frozenset()
    names = [record.name for record in records if record.used]

    def work(partial: Sequence[Path]) -> None:
        write_images(movers, names, moved, workspace.colmap_images, partial[0], session.progress, workspace.unsmoothed)

    depends = {"stages": stages if moved else (), "rectified": sorted(moved)}
    session.runner.run("images", depends, [workspace.images], work, after=["frames"])
    return workspace.images
