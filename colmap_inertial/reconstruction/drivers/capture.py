"""From a capture to a metric, gravity-up COLMAP model: one list of calls, with a hook at each seam."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import EllipsisType

from colmap_inertial.checks.diagnose import Diagnosis
from colmap_inertial.checks.report import require_plotly
from colmap_inertial.checks.validate import parse_target
from colmap_inertial.colmap.sparse import check_pair_names, mapping_device
from colmap_inertial.colmap.steps import run_colmap
from colmap_inertial.colmap.tsdf import require_mesh_maker
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.gravity import gravity_in_cam
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import StrPath, write_json
from colmap_inertial.io.frames import picture_folders, read_frames
from colmap_inertial.io.imu import read_raw_capture_imu
from colmap_inertial.io.imu_calibration import used_files
from colmap_inertial.io.limits import reading_within
from colmap_inertial.pipeline.run.context import Recording, corrected_imu, prior_calibration
from colmap_inertial.pipeline.run.installed import warn_of_conflicts
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.pipeline.run.runner import remove
from colmap_inertial.pipeline.run.session import open_session
from colmap_inertial.pipeline.stages.deblur import require_method
from colmap_inertial.pipeline.stages.exposures import lsd2_fuser
from colmap_inertial.pipeline.stages.frame_folder import require_frames
from colmap_inertial.pipeline.stages.join import JoinStage
from colmap_inertial.pipeline.stages.metric import MetricStage
from colmap_inertial.pipeline.stages.protocols import FrameStage, KeypointStage, ModelStage, with_defaults
from colmap_inertial.pipeline.stages.readout import ReadoutStage
from colmap_inertial.pipeline.stages.refine import RefineStage
from colmap_inertial.pipeline.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.reconstruction.drivers.frames import (
    as_refined,
    ask_for_plan,
    fusing,
    run_frames,
    run_images,
    run_plan,
)
from colmap_inertial.reconstruction.drivers.georeference import positions_of, run_georeference
from colmap_inertial.reconstruction.drivers.models import run_dense_models, run_models, run_validation
from colmap_inertial.reconstruction.drivers.reporting import report_result, reporting_stops, write_recording
from colmap_inertial.reconstruction.drivers.result import ReconstructResult
from colmap_inertial.reconstruction.preparation.pairs import exposure_stage, fuses_pairs
from colmap_inertial.reconstruction.preparation.plan import with_stated_exposures
from colmap_inertial.reconstruction.preparation.preflight import checked_imu, preflight, stop_or_doubt
from colmap_inertial.reconstruction.preparation.selection import part_of, run_selection

#: A camera-IMU rotation less certain than this is no basis for gravity directions.
_GRAVITY_ROTATION_RAD = 0.2


def default_model_stages(
    recording: Recording,
    options: ReconstructOptions,
    keypoint_stages: Sequence[KeypointStage] = (),
    *,
    database: Path | None = None,
) -> list[ModelStage]:
    """What stands for ``...`` in ``model_stages``, after these keypoint stages, of models of a database of COLMAP."""
    scale = dataclasses.replace(options.scale, max_offset_s=recording.max_offset_s)
    asked = options.mapping.refine_intrinsics
    refine_intrinsics = recording.capture.camera is None if asked is None else asked
    readout = ReadoutStage(
        imu=recording.imu,
        calibration=recording.prior,
        options=scale,
        refine_intrinsics=refine_intrinsics,
        num_threads=1 if options.deterministic else -1,
    )
    metric = MetricStage(imu=recording.imu, calibration=recording.prior, options=scale, world=options.world)
    joining: list[ModelStage] = []
    if options.join == "inertial":
        limits = options.join_options
        joining = [
            JoinStage(
                imu=recording.imu,
                calibration=recording.prior,
                options=scale,
                limits=limits,
                world=options.world,
                database=database,
            )
        ]
    if options.refine == "off":
        return [readout, metric, *joining]
    # only what moved keypoints all by itself can say from where
    shutters = [stage for stage in keypoint_stages if isinstance(stage, RollingShutterStage)]
    refined = RefineStage(
        imu=recording.imu,
        calibration=recording.prior,
        options=scale,
        refine_intrinsics=refine_intrinsics,
        shutter=shutters[0] if len(shutters) == len(keypoint_stages) == 1 else None,
    )
    return [readout, metric, *joining, refined]


def reconstruct(
    capture: StrPath,
    out: StrPath,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    frame_stages: Sequence[FrameStage | EllipsisType] = (...,),
    keypoint_stages: Sequence[KeypointStage | EllipsisType] = (...,),
    model_stages: Sequence[ModelStage | EllipsisType] = (...,),
    progress: Progress = silent,
    findings: Callable[[Diagnosis], None] = lambda _: None,
) -> ReconstructResult:
    """Turn images or video with an IMU recording into COLMAP models in metres, gravity along an axis.

    Parameters
    ----------
    capture
        A ``capture.toml``, a folder that holds one, or a dataset folder that ``load_capture`` knows.
    out
        A folder that does not exist, or holds a run of the same capture, which is then gone on with: only what the
        options, the recording or the stages changed is made again.
    options
        See :class:`ReconstructOptions`.
    frame_stages, keypoint_stages, model_stages
        The hooks. ``...`` stands for the default stages: :class:`ApertureStage` for a multi-aperture camera's frames,
        :class:`ExposureStage` for pairs of a short and a long exposure, :class:`DeblurStage` for all others;
        :class:`RollingShutterStage`; :class:`ReadoutStage`, :class:`MetricStage`, :class:`JoinStage` and
        :class:`RefineStage`, where the options and the recording allow them. The model stages must include one that
        makes the model metric.
    progress
        Called with stage, steps done and steps in all.
    findings
        Called with what the check beforehand found, before the work and before a refusal that it leads to.

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
    with reading_within(options.limits):
        return _reconstruct(
            Path(capture), Path(out), options, frame_stages, keypoint_stages, model_stages, progress, findings
        )


def _reconstruct(
    capture: Path,
    out: Path,
    options: ReconstructOptions,
    frame_stages: Sequence[FrameStage | EllipsisType],
    keypoint_stages: Sequence[KeypointStage | EllipsisType],
    model_stages: Sequence[ModelStage | EllipsisType],
    progress: Progress,
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    for stages in (frame_stages, keypoint_stages, model_stages):
        with_defaults(stages, [])  # a wrong list is said before the work, not after it
    if not model_stages:
        raise ValueError("model_stages: one must estimate the scale, such as ... or MetricStage")
    warn_of_conflicts()
    require_plotly()
    require_mesh_maker(options)
    require_method(options.deblur)
    loaded = load_capture(capture)
    if loaded.frames is None:
        raise FormatError(loaded.path, "has no frames: add [images] or [video]")
    pairs = ... in frame_stages and fuses_pairs(loaded, options.exposures, deblur=options.deblur)
    fuser = lsd2_fuser(options.exposures) if pairs else None
    loaded = loaded if pairs else dataclasses.replace(loaded, exposures=None)
    raw = checked_imu(read_raw_capture_imu(loaded), force=options.force)
    target = None if loaded.target is None else parse_target(loaded.target)  # what is wrong is said before the work
    timing, frames = read_frames(loaded)
    timing = with_stated_exposures(loaded, timing)
    require_frames(len(timing.names), of=len(timing.names))
    used = used_files(options.calibration)
    prior = prior_calibration(loaded, options.calibration)
    imu = corrected_imu(loaded, raw.imu, options.calibration)
    recording = Recording.of(loaded, imu, timing, prior, max_offset_s=options.scale.max_offset_s)
    gravity = _gravity_priors(recording, options)
    check_pair_names(timing.names)
    fixes = positions_of(loaded, timing.names) if options.georeference else None
    device = mapping_device(options.mapping, deterministic=options.deterministic)
    with (
        open_session(
            out,
            loaded.path,
            options,
            pictures=picture_folders(loaded),
            deterministic=options.deterministic,
            seed=options.seed,
            device=device,
            progress=progress,
        ) as session,
        reporting_stops(session.workspace, loaded),
    ):
        workspace = session.workspace
        write_recording(session, recording)  # a run that stops reports it, too
        diagnosis = preflight(recording, raw, progress)
        write_json(workspace.diagnosis, diagnosis.as_json())
        findings(diagnosis)
        doubts = stop_or_doubt(diagnosis, force=options.force)
        recording = dataclasses.replace(recording, doubts=doubts)
        selection = run_selection(session, recording, options.frames)
        if len(selection.names) < len(timing.names):
            recording = recording.using(part_of(timing, selection.names))
            _, frames = read_frames(loaded, only=selection.names)
        plan = run_plan(session, recording, ask_for_plan(options, frame_stages, keypoint_stages, pairs=pairs))
        fused = [exposure_stage(recording, options.exposures, plan.view, fuser)] if fuser is not None else []
        defaults: list[FrameStage] = [*fusing(loaded, workspace, options.apertures), *fused, *plan.frame_stages()]
        of_frames = with_defaults(frame_stages, defaults)
        of_keypoints = with_defaults(keypoint_stages, plan.keypoint_stages())
        records = run_frames(session, recording, frames, of_frames, workspace.colmap_images, plan)
        used_timing = part_of(recording.timing, [record.name for record in records if record.used])
        # pairs are chosen by what the capture itself holds: a calibration that is given later maps nothing again
        plain_imu = corrected_imu(loaded, raw.imu, None)
        seen = Recording.of(loaded, plain_imu, used_timing, prior_calibration(loaded, None))
        keypoints, matching, mapping = run_colmap(session, seen, records, of_keypoints, gravity, options)
        of_models = with_defaults(
            model_stages,
            default_model_stages(recording, options, of_keypoints, database=workspace.colmap_database),
        )
        # images agree with the model as it is in the end
        refining = any(isinstance(stage, RefineStage) and stage.shutter is not None for stage in of_models)
        if not refining:
            images = run_images(session, records, keypoints.rectified(), of_keypoints)
        models, fragments, gaps = run_models(
            session, recording, of_models, rectified=bool(keypoints.rectified()), fragments=options.fragments
        )
        if refining:
            images = run_images(session, records, keypoints.rectified(), as_refined(of_keypoints, models))
        models = run_validation(session, models, target, images)
        models = run_georeference(session, models, fixes, recording.timing, options.world)
        if options.dense:
            models = run_dense_models(session, models, images, options.dense_options)
        result = ReconstructResult(
            workspace=workspace,
            models=models,
            fragments=fragments,
            gaps=gaps,
            frames=records,
            keypoints=keypoints,
            matching=matching,
            mapping=mapping,
            imaging=plan,
            selection=selection,
            seconds=session.runner.seconds,
        )
        write_recording(session, recording, of_keypoints, keypoints.rectified())
        result = report_result(session, result, loaded, used)
        remove(workspace.colmap_features)
    return result


def _gravity_priors(recording: Recording, options: ReconstructOptions) -> Mapping[str, Array]:
    """Gravity by image name where the options ask for it, else empty."""
    if not options.mapping.gravity_priors:
        return {}
    if options.mapping.mapper != "global":
        raise InertialError(
            "--mapping.gravity-priors needs --mapping.mapper global: the incremental mapper ignores them"
        )
    calibration = recording.prior
    if calibration.sigma("rotation_x_rad") > _GRAVITY_ROTATION_RAD or calibration.sigma("gyro_time_offset_s") > 1:
        raise InertialError(
            "--mapping.gravity-priors needs the rotation between camera and IMU and their time offset beforehand: give "
            "[calibration] in capture.toml or --calibration FILE, and shared_clock or a time offset"
        )
    return gravity_in_cam(recording.imu, calibration, recording.timing)
