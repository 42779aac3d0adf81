"""From a capture to a metric, gravity-up COLMAP model: one list of calls, with a hook at each seam."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.colmap.sparse import (
    check_names,
    extract_features,
    image_pairs,
    map_images,
    match_features,
    write_gravity_priors,
)
from colmap_inertial.drivers.contact_sheet import CropKeeper
from colmap_inertial.drivers.models import run_models, validated, with_dense
from colmap_inertial.drivers.reporting import report_result, reporting_stops, write_recording
from colmap_inertial.drivers.result import ReconstructResult
from colmap_inertial.errors import FormatError, InertialError
from colmap_inertial.gravity import gravity_in_cam
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.io.calibration import SHARED_CLOCK_OFFSET_S, for_another_recording, read_calibration
from colmap_inertial.io.capture import Capture, Video, load_capture
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.io.frames import frame_source, read_frames
from colmap_inertial.options import ApertureOptions, ReconstructOptions
from colmap_inertial.precalibrate.pairs import exposure_stage, for_pairs, fuses_pairs
from colmap_inertial.precalibrate.plan import ImagingPlan, plan_imaging, read_plan, with_stated_exposures, write_plan
from colmap_inertial.precalibrate.preflight import preflight, read_checked_imu, stop_or_doubt
from colmap_inertial.precalibrate.selection import part_of, run_selection
from colmap_inertial.report import require_plotly
from colmap_inertial.run.config import config_as_toml
from colmap_inertial.run.progress import Progress, silent
from colmap_inertial.run.runner import StageRunner, fingerprint, remove
from colmap_inertial.run.session import logging_to
from colmap_inertial.run.workspace import Workspace
from colmap_inertial.stages.apertures import ApertureStage
from colmap_inertial.stages.deblur import require_method
from colmap_inertial.stages.exposures import lsd2_fuser
from colmap_inertial.stages.frame_folder import FrameRecord, read_frame_records, require_frames, write_frames
from colmap_inertial.stages.metric import MetricStage
from colmap_inertial.stages.protocols import FrameStage, KeypointStage, ModelStage
from colmap_inertial.stages.readout import ReadoutStage
from colmap_inertial.stages.rectified import write_rectified
from colmap_inertial.stages.rolling_shutter import RollingShutterStage, for_rectified
from colmap_inertial.types import (
    Array,
    CameraImuCalibration,
    Frame,
    FrameTiming,
    ImuRecording,
)
from colmap_inertial.validate import parse_target

log = logging.getLogger(__name__)

#: A camera-IMU rotation less certain than this is no basis for gravity directions.
_GRAVITY_ROTATION_RAD = 0.2


def prior_calibration(capture: Capture, options: ReconstructOptions) -> CameraImuCalibration:
    """What is known of camera and IMU beforehand: from ``--calibration``, else from the capture."""
    if options.calibration is None:
        return capture.calibration
    return for_another_recording(read_calibration(options.calibration), shared_clock=capture.shared_clock)


def default_model_stages(
    capture: Capture,
    imu: ImuRecording,
    options: ReconstructOptions,
    *,
    rectified: bool = False,
    doubts: Sequence[str] = (),
) -> list[ModelStage]:
    """What ``reconstruct`` runs when ``model_stages`` is ``None``: a starting point for one's own list.

    With ``rectified`` keypoints, the model is that of a global shutter, once the camera's translation is undone, too.
    With ``doubts`` about the recording, no scale is trusted.
    """
    scale = options.scale
    if capture.shared_clock and scale.max_offset_s is None:
        scale = dataclasses.replace(scale, max_offset_s=SHARED_CLOCK_OFFSET_S)
    calibration = prior_calibration(capture, options)
    if rectified:
        calibration = for_rectified(calibration)
    metric = MetricStage(imu=imu, calibration=calibration, options=scale, world=options.world, doubts=tuple(doubts))
    if not rectified:
        return [metric]
    refine = options.mapping.refine_intrinsics
    return [
        ReadoutStage(
            imu=imu,
            calibration=calibration,
            options=scale,
            refine_intrinsics=capture.camera is None if refine is None else refine,
            num_threads=1 if options.deterministic else -1,
        ),
        metric,
    ]


def reconstruct(
    capture: Path,
    out: Path,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    frame_stages: Sequence[FrameStage] | None = None,
    keypoint_stages: Sequence[KeypointStage] | None = None,
    model_stages: Sequence[ModelStage] | None = None,
    progress: Progress = silent,
) -> ReconstructResult:
    """Turn images or video with an IMU recording into COLMAP models in metres, gravity along an axis.

    Parameters
    ----------
    capture
        A ``capture.toml``, a folder that holds one, or a dataset folder that ``load_capture`` knows.
    out
        A folder that does not exist, or holds an unfinished run of the same capture, which is then continued.
    options
        See :class:`ReconstructOptions`.
    frame_stages, keypoint_stages, model_stages
        The hooks. ``None`` means the default stages, an empty list none: :class:`ApertureStage` for a multi-aperture
        camera's frames, :class:`ExposureStage` for pairs of a short and a long exposure, :class:`DeblurStage` for all
        others, and :class:`RollingShutterStage` for keypoints, where the options and the recording allow them. The
        model stages must include one that makes the model metric, see :func:`default_model_stages`.
    progress
        Called with stage, steps done and steps in all.

    Returns
    -------
    ReconstructResult
        A refused scale is a result, too: its model stays in COLMAP's units and has no metric copy.

    Raises
    ------
    FormatError, TimingError
        For a capture that cannot be read.
    OutputExistsError
        When ``out`` holds something else.
    MappingError
        When COLMAP finds no model.
    NotObservableError
        When the recording cannot give metres, as a stabilised video (``options.force`` goes on); when deblurring or
        rectifying was asked for by name, and the gyroscope does not belong to the pixels.
    """
    require_plotly()
    require_method(options.deblur)
    loaded = load_capture(capture)
    if loaded.frames is None:
        raise FormatError(loaded.path, "has no frames: add [images] or [video]")
    pairs = frame_stages is None and fuses_pairs(loaded, options.exposures, deblur=options.deblur)
    fuser = lsd2_fuser(options.exposures) if pairs else None
    loaded = loaded if pairs else dataclasses.replace(loaded, exposures=None)
    raw = read_checked_imu(loaded, force=options.force)
    imu = raw.imu
    if loaded.target is not None:
        parse_target(loaded.target)  # a wrong specification is said before the work, not after it
    timing, frames = read_frames(loaded)
    timing = with_stated_exposures(loaded, timing)
    require_frames(len(timing.names), of=len(timing.names))
    gravity = _gravity_priors(loaded, imu, timing, options)
    check_names(timing.names)
    prior = prior_calibration(loaded, options)  # likewise
    workspace = Workspace(out)
    workspace.open(loaded.path)
    with workspace.locked(), logging_to(workspace.log), reporting_stops(workspace, loaded):
        log.info("colmap-inertial %s: %s -> %s", __version__, capture, out)
        write_text(workspace.config, config_as_toml(options))
        diagnosis = preflight(loaded, raw, timing, prior, progress)
        write_json(workspace.diagnosis, diagnosis.as_json())
        write_recording(workspace, imu, timing)
        doubts = stop_or_doubt(diagnosis, force=options.force)
        runner = StageRunner(workspace)
        inputs = _inputs(loaded, timing)
        every = timing
        selection = run_selection(runner, workspace, loaded, imu, timing, prior, options, inputs, progress)
        if len(selection.names) < len(timing.names):
            timing = part_of(timing, selection.names)
            _, frames = read_frames(loaded, only=timing.names)
        plan = run_plan(runner, workspace, loaded, imu, timing, options, progress, every=every, pairs=pairs)
        fused = [exposure_stage(loaded, options.exposures, timing=timing, view=plan.view, fuser=fuser)] if pairs else []
        of_frames: list[FrameStage] = (
            [*fusing(loaded, workspace, options.apertures), *fused, *plan.frame_stages()]
            if frame_stages is None
            else list(frame_stages)
        )
        of_keypoints = list(plan.keypoint_stages() if keypoint_stages is None else keypoint_stages)
        kept = CropKeeper.of(plan)
        run_frames(runner, workspace, loaded, timing, frames, of_frames, progress, kept=kept)
        records = read_frame_records(workspace.frames)
        _run_colmap(runner, workspace, records, gravity, options, of_keypoints, progress)
        rectifying = [stage for stage in of_keypoints if isinstance(stage, RollingShutterStage)]
        run_rectified(runner, workspace, records, rectifying, progress)
        stages = (
            default_model_stages(loaded, imu, options, rectified=bool(rectifying), doubts=doubts)
            if model_stages is None
            else list(model_stages)
        )
        models = run_models(workspace, timing, imu, stages, runner, progress)
        images = workspace.images_rectified if workspace.images_rectified.is_dir() else workspace.images
        if loaded.target is not None:
            models = validated(workspace, models, parse_target(loaded.target), images, progress)
        if options.dense:
            models = with_dense(runner, workspace, models, images, options, progress)
        result = ReconstructResult(
            workspace=workspace,
            models=models,
            frames=records,
            imaging=plan,
            selection=selection,
            seconds=runner.seconds,
        )
        write_recording(workspace, imu, timing, rectifying)
        result = report_result(result, loaded)
        if not result.waiting:  # else the run goes on later, and needs them
            remove(workspace.features)
        log.info("finished")
    return result


def run_plan(
    runner: StageRunner,
    workspace: Workspace,
    capture: Capture,
    imu: ImuRecording,
    timing: FrameTiming,
    options: ReconstructOptions,
    progress: Progress,
    *,
    every: FrameTiming | None = None,
    pairs: bool = False,
) -> ImagingPlan:
    """What to do to frames and keypoints; with both switched off, nothing is looked at.

    ``every``: all frames of the video that ``timing``'s were chosen from. ``pairs``: frames are fused of short and long
    exposures, and not deblurred.
    """
    prior = prior_calibration(capture, options)

    def work(partial: Sequence[Path]) -> None:
        plan = plan_imaging(
            capture,
            imu,
            timing,
            prior,
            deblur="off" if pairs else options.deblur,
            rolling_shutter=options.rolling_shutter,
            scratch=workspace.stamps,
            every=every,
            max_offset_s=options.scale.max_offset_s,
            num_threads=1 if options.deterministic else -1,
            seed=options.seed,
            progress=progress,
        )
        if pairs:
            plan = for_pairs(
                plan,
                capture,
                imu,
                timing,
                prior,
                scratch=workspace.stamps,
                max_offset_s=options.scale.max_offset_s,
                num_threads=1 if options.deterministic else -1,
                seed=options.seed,
                progress=progress,
            )
        write_plan(partial[0], plan)

    depends = {
        "capture": capture,
        "imu": imu,
        "timing": timing,
        "prior": prior,
        "deblur": options.deblur,
        "weights": checksum("deepgyro") if options.deblur == "deepgyro" else "",
        "pairs": pairs,
        "rolling_shutter": options.rolling_shutter,
        "max_offset_s": options.scale.max_offset_s,
        "deterministic": options.deterministic,
        "seed": options.seed,
        "inputs": _inputs(capture, timing),
    }
    runner.run("imaging", depends, [workspace.imaging], work)
    plan = read_plan(workspace.imaging, imu, timing)
    log.info("deblurring: %s", plan.deblur_note)
    log.info("rolling shutter: %s", plan.rolling_shutter_note)
    return plan


def _gravity_priors(
    capture: Capture, imu: ImuRecording, timing: FrameTiming, options: ReconstructOptions
) -> Mapping[str, Array]:
    """Gravity by image name where the options ask for it, else empty."""
    if not options.mapping.gravity_priors:
        return {}
    if options.mapping.mapper != "global":
        raise InertialError(
            "--mapping.gravity-priors needs --mapping.mapper global: the incremental mapper ignores them"
        )
    calibration = prior_calibration(capture, options)
    if calibration.sigma("rotation_x_rad") > _GRAVITY_ROTATION_RAD or calibration.sigma("gyro_time_offset_s") > 1:
        raise InertialError(
            "--mapping.gravity-priors needs the rotation between camera and IMU and their time offset beforehand: give "
            "[calibration] in capture.toml or --calibration FILE, and shared_clock or a time offset"
        )
    return gravity_in_cam(imu, calibration, timing)


def run_frames(
    runner: StageRunner,
    workspace: Workspace,
    capture: Capture,
    timing: FrameTiming,
    frames: Iterator[Frame],
    stages: Sequence[FrameStage],
    progress: Progress,
    *,
    kept: CropKeeper | None = None,
) -> None:
    """The frames through the stages; ``kept`` keeps parts of some before and after."""
    source = frame_source(capture)

    def work(partial: Sequence[Path]) -> None:
        images, records = partial[:2]
        through = stages if kept is None else (kept.before, *stages, kept.after)
        write_frames(frames, timing, through, source_folder=source, images=images, records=records, progress=progress)
        if kept is not None:
            kept.write(partial[2])

    depends = {"capture": capture, "timing": timing, "inputs": _inputs(capture, timing), "stages": stages}
    crops = [] if kept is None else [workspace.crops]
    runner.run("frames", depends, [workspace.images, workspace.frames, *crops], work)


def fusing(capture: Capture, workspace: Workspace, options: ApertureOptions) -> list[ApertureStage]:
    """The stage that makes frames of a multi-aperture camera's sub-images; none for other cameras."""
    if capture.apertures is None:
        return []
    keep = workspace.apertures if options.depth else None
    return [ApertureStage(pictures=capture.apertures, options=options, keep=keep)]


def _inputs(capture: Capture, timing: FrameTiming) -> list[object]:
    """What identifies the files that frames are read from."""
    source = frame_source(capture)
    paths = [] if source is None else [source / name for name in timing.names]
    if isinstance(capture.frames, Video):
        paths = [capture.frames.file]
    if capture.apertures is not None:
        paths += capture.apertures.files(timing.names)
    if capture.exposures is not None:
        paths += [*capture.exposures.files(timing.names), *filter(None, [capture.exposures.times])]
    return [fingerprint(path) for path in paths]


def run_rectified(
    runner: StageRunner,
    workspace: Workspace,
    records: Sequence[FrameRecord],
    stages: Sequence[RollingShutterStage],
    progress: Progress,
) -> None:
    """Images that agree with the rectified keypoints, for whoever goes on from the model."""
    if not stages:
        remove(workspace.images_rectified)
        return

    def work(partial: Sequence[Path]) -> None:
        write_rectified(stages[0], records, workspace.images, partial[0], progress)

    runner.run("rectified", {"stages": stages}, [workspace.images_rectified], work)


def _run_colmap(
    runner: StageRunner,
    workspace: Workspace,
    records: Sequence[FrameRecord],
    gravity: Mapping[str, Array],
    options: ReconstructOptions,
    stages: Sequence[KeypointStage],
    progress: Progress,
) -> None:
    """Extract, keypoint stages, match, map: into ``database.db`` and ``sparse/``."""
    mapping = options.mapping
    used = [record for record in records if record.action != "dropped"]
    cameras = {record.name: record.camera for record in used}
    threads = 1 if options.deterministic else -1

    def features(partial: Sequence[Path]) -> None:
        extract_features(
            workspace.images,
            cameras,
            partial[0],
            mapping,
            keypoint_stages=stages,
            num_threads=threads,
            seed=options.seed,
            progress=progress,
        )
        write_gravity_priors(partial[0], gravity)

    def matches(partial: Sequence[Path]) -> None:
        pairs = image_pairs([record.name for record in used], mapping)
        match_features(workspace.features, partial[0], pairs, num_threads=threads, seed=options.seed, progress=progress)

    def models(partial: Sequence[Path]) -> None:
        refine = mapping.refine_intrinsics
        map_images(
            workspace.database,
            workspace.images,
            partial[0],
            mapping,
            refine_intrinsics=any(camera is None for camera in cameras.values()) if refine is None else refine,
            num_images=len(used),
            num_threads=threads,
            seed=options.seed,
            progress=progress,
        )

    common = {"mapping": mapping, "deterministic": options.deterministic, "seed": options.seed}
    runner.run("features", {**common, "stages": stages, "gravity": gravity}, [workspace.features], features)
    runner.run("matches", common, [workspace.database], matches)
    runner.run("mapping", common, [workspace.sparse], models)
