"""Reconstruct a capture as a metric, gravity-up COLMAP model: one list of calls, with a hook at each seam."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import EllipsisType
from typing import get_args

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.tsdf import require_mesh_maker
from colmap_inertial.colmap.executable import Device
from colmap_inertial.colmap.features.extraction import check_pair_names, mapping_device, require_features
from colmap_inertial.colmap.features.given_database import read_given
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.choices import check_kind
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.gyro import gravity_in_cam
from colmap_inertial.core.options import BlurRemover, ReconstructOptions, ReferenceOptions
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import FrameTiming, ImuRecording, PositionFixes
from colmap_inertial.diagnose import Diagnosis
from colmap_inertial.hooks import (
    FrameStage,
    KeypointStage,
    ModelStage,
    Stages,
    changes_images,
    insert_defaults,
)
from colmap_inertial.io.calibration import describe_files
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import StrPath, reading_within
from colmap_inertial.io.frames import picture_folders, read_frame_timing, read_frames
from colmap_inertial.io.imu import read_unchecked_capture_imu
from colmap_inertial.io.recording import Recording, correct_imu, prior_calibration
from colmap_inertial.io.rig_frames import RigFrames, pair_rig_frames
from colmap_inertial.model import find_models
from colmap_inertial.report import require_plotly
from colmap_inertial.run.commands.colmap_steps import run_colmap
from colmap_inertial.run.commands.frames import (
    run_frames,
    run_images,
    stages_of_refined,
)
from colmap_inertial.run.commands.georeference import run_georeference
from colmap_inertial.run.commands.models import Submodels, run_dense_models, run_models, run_validation
from colmap_inertial.run.commands.reporting import report_result, reporting_stops, write_recording
from colmap_inertial.run.commands.result import ReconstructResult
from colmap_inertial.run.commands.unplaced import note_unplaced
from colmap_inertial.run.preparation.frame_reading import FullFrames, GreyFrames
from colmap_inertial.run.preparation.geolocation import positions_of
from colmap_inertial.run.preparation.known_lengths import add_target, check_reference_beside_imu
from colmap_inertial.run.preparation.packages import warn_of_conflicts
from colmap_inertial.run.preparation.plan import add_stated_exposures, ask_for_plan, expect_plan, run_plan
from colmap_inertial.run.preparation.preflight import check_imu, run_preflight
from colmap_inertial.run.preparation.selection import expect_selection, part_of, run_selection
from colmap_inertial.run.preparation.sensors import find_sensors
from colmap_inertial.run.stages.capture_sensors import CaptureSensors
from colmap_inertial.run.stages.deblur import require_method
from colmap_inertial.run.stages.defaults import (
    default_frame_stages,
    default_keypoint_stages,
    default_model_stages,
)
from colmap_inertial.run.stages.exposures import fuses_pairs
from colmap_inertial.run.stages.frame_folder import note_rectified, require_frames
from colmap_inertial.run.stages.inputs import Fuser, StageInputs, lsd2_fuser
from colmap_inertial.run.steps.session import Session, open_session
from colmap_inertial.validate import Target, parse_target

log = logging.getLogger(__name__)

#: A camera-IMU rotation less certain than this is no basis for gravity directions.
_GRAVITY_ROTATION_RAD = 0.2


def reconstruct(
    capture: StrPath,
    out: StrPath,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    reference: ReferenceOptions = ReferenceOptions(),
    frame_stages: Sequence[FrameStage | EllipsisType] = (...,),
    keypoint_stages: Sequence[KeypointStage | EllipsisType] = (...,),
    model_stages: Sequence[ModelStage | EllipsisType] = (...,),
    overwrite: bool = False,
    progress: Progress = silent,
    findings: Callable[[Diagnosis], None] = lambda _: None,
) -> ReconstructResult:
    """Turn images or video with an IMU recording into COLMAP models in metres, gravity along an axis.

    Parameters
    ----------
    capture
        A ``capture.toml``, a folder that holds one, or a dataset folder that ``load_capture`` knows.
    out
        A folder that does not exist, or holds a run of the same capture, which is then continued.
    options
        See :class:`ReconstructOptions`.
    reference
        A target, and a known distance of two markers, which gives metres where ``options.scale_from`` names it.
    frame_stages, keypoint_stages, model_stages
        The hooks. ``...`` stands for the default stages: :class:`ApertureStage` for a multi-aperture camera's frames,
        :class:`ExposureStage` for pairs of a short and a long exposure, :class:`DeblurStage` for all others;
        :class:`RollingShutterStage`; :class:`ReadoutStage`, :class:`MetricStage`, :class:`JoinStage` and
        :class:`RefineStage`, where the options and the recording allow them. The model stages must include one that
        makes the model metric.
    overwrite
        Where ``out`` holds a finished result of other options, stages or another recording: make again in place what
        depends on them. Without it, options may only add steps to a finished result, such as ``dense``.
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
        When ``out`` holds something else, or a finished result that would not stay as it is.
    MappingError
        When COLMAP finds no model.
    NotObservableError
        When the recording cannot give metres, as a stabilised video (``options.force`` goes on); when deblurring or
        rectifying was asked for by name, and the gyroscope does not belong to the pixels.
    """
    check_kind("options", options, ReconstructOptions)
    check_kind("reference", reference, ReferenceOptions)
    stages = Stages(frame=tuple(frame_stages), keypoint=tuple(keypoint_stages), model=tuple(model_stages))
    with reading_within(options.limits):
        return _reconstruct(Path(capture), Path(out), options, reference, stages, overwrite, progress, findings)


@dataclass(frozen=True, eq=False, kw_only=True)
class _CheckedCapture:
    """A capture that was read and checked.

    Attributes
    ----------
    raw
        The IMU, before any calibration of its own.
    recording
        With all frames; its capture has no long exposures where they are not fused.
    fuser
        What fuses pairs of exposures; ``None`` where none are fused.
    reference
        Known lengths.
    target
        To measure in the model.
    gravity
        By image name, where the options ask for it.
    fixes
        Positions of the frames, where the options ask for them.
    rig
        Images of the other cameras of a rig; ``None`` without one.
    """

    raw: ImuRecording
    recording: Recording
    fuser: Fuser | None
    reference: ReferenceOptions
    target: Target | None
    gravity: Mapping[str, Array]
    fixes: PositionFixes | None
    rig: RigFrames | None


def _read_capture(
    path: Path, options: ReconstructOptions, reference: ReferenceOptions, stages: Stages
) -> _CheckedCapture:
    """Read a capture; what is wrong with it, the options or the stages is said before any work."""
    for kind in (stages.frame, stages.keypoint, stages.model):
        insert_defaults(kind, [])
    if not stages.model:
        raise ValueError("model_stages: one must estimate the scale, such as ... or MetricStage")
    warn_of_conflicts()
    require_plotly()
    require_mesh_maker(options)
    require_method(options.deblur)
    capture = load_capture(path)
    if capture.frames is None:
        raise FormatError(capture.path, Fact("capture-has-no-frames"))
    reference = add_target(reference, capture)
    check_reference_beside_imu(reference, options.scale_from)
    if reference.has_points:
        raise InertialError(Fact("points-need-a-model"))
    capture = replace(capture, target=reference.target)
    pairs = ... in stages.frame and fuses_pairs(capture, options.exposures, deblur=options.deblur)
    fuser = lsd2_fuser(options.exposures) if pairs else None
    capture = capture if pairs else replace(capture, exposures=None)
    raw = check_imu(read_unchecked_capture_imu(capture), force=options.force)
    target = None if capture.target is None else parse_target(capture.target)
    _refuse_with_rig(capture, options)
    timing, rig = _read_used_frames(capture, options)
    timing = add_stated_exposures(capture, timing)
    require_frames(len(timing.names), of=len(timing.names))
    prior = prior_calibration(capture, options.calibration)
    imu = correct_imu(capture, raw, options.calibration)
    recording = Recording.of(capture, imu, timing, prior, max_offset_s=options.scale.max_offset_s)
    insert_defaults(stages.model, default_model_stages(StageInputs(recording=recording, options=options)))
    gravity = _gravity_priors(recording, options)
    check_pair_names(timing.names)
    return _CheckedCapture(
        raw=raw,
        recording=recording,
        fuser=fuser,
        reference=reference,
        target=target,
        gravity=gravity,
        fixes=positions_of(capture, timing.names) if options.georeference else None,
        rig=rig,
    )


def _read_used_frames(capture: Capture, options: ReconstructOptions) -> tuple[FrameTiming, RigFrames | None]:
    """Times of a capture's frames: of a rig, those that all cameras took; with a given database, those that it has."""
    timing = read_frame_timing(capture)
    rig = None
    if capture.rig:
        rig = pair_rig_frames(capture, timing)
        if rig.alone:
            log.warning("%d frames are left out: a camera of the rig has no image of them", len(rig.alone))
        timing = part_of(timing, rig.own_names[0].keys() - set(rig.alone))
    if options.database is not None:
        given = read_given(options.database)
        timing = part_of(timing, given.names_in_time(timing.names))
        first = next(read_frames(capture, only=timing.names[:1])[1])
        given.require_size(first.name, first.image.shape[1], first.image.shape[0])
    return timing, rig


def _refuse_with_rig(capture: Capture, options: ReconstructOptions) -> None:
    """Raise ``InertialError`` for what is asked for by name and not done with a rig."""
    if not capture.rig:
        return
    asked = {
        "--database": options.database is not None,
        "--colmap-executable": options.colmap_executable is not None,
        f"--deblur {options.deblur}": options.deblur in get_args(BlurRemover),
        "--rolling-shutter rectify": options.rolling_shutter == "rectify",
        "--refine inertial": options.refine == "inertial",
        "--mapping.mapper global": options.mapping.mapper == "global",
    }
    refused = [name for name, is_asked in asked.items() if is_asked]
    if refused:
        raise InertialError(Fact("not-for-rigs", option=refused[0]))


def _reconstruct(
    path: Path,
    out: Path,
    options: ReconstructOptions,
    reference: ReferenceOptions,
    stages: Stages,
    overwrite: bool,
    progress: Progress,
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    given = _read_capture(path, options, reference, stages)
    capture, used_calibration = given.recording.capture, describe_files(options.calibration)
    device: Device = "cpu"  # of pycolmap, which only verifies where an installed COLMAP does the rest
    if options.colmap_executable is None:
        device = mapping_device(options.mapping, deterministic=options.deterministic)
    context = RunContext.of(options, device=device, progress=progress)
    require_features(context)
    pictures = picture_folders(capture)
    with (
        open_session(out, capture.path, options, context, pictures=pictures, overwrite=overwrite) as session,
        reporting_stops(session, capture, given.recording),
    ):
        session.context.executor.require(session.context.scratch)
        result = _run_steps(session, given, options, stages, findings)
        result = report_result(session, result, capture, used_calibration, reference=reference)
        remove(session.workspace.colmap_features)
        session.runner.forget("features")
    return result


def _run_steps(
    session: Session,
    given: _CheckedCapture,
    options: ReconstructOptions,
    stages: Stages,
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    """The steps of a run, from the check beforehand to the dense reconstruction."""
    workspace, capture, recording = session.workspace, given.recording.capture, given.recording
    # whoever made a database chose its frames
    choice = options.frames if options.database is None else replace(options.frames, use="all")
    asked = ask_for_plan(options, stages.frame, stages.keypoint, pairs=given.fuser is not None)
    with closing(GreyFrames(capture, recording.timing, session.context.scratch)) as grey:
        # what the check passes on its way is kept for those who look after it
        expect_selection(grey, choice, capture)
        expect_plan(grey, recording, asked)
        doubts = run_preflight(session, recording, given.raw, findings, force=options.force, frames=grey)
        recording = replace(recording, doubts=doubts)
        selection = run_selection(session, recording, choice, grey)
        recording = recording.using(part_of(recording.timing, selection.names))
        if not options.apertures.depth:
            session.runner.discard(workspace.apertures)
        full = FullFrames(capture, recording.timing, session.context.scratch)
        plan = run_plan(session, recording, grey, full, asked)
    inputs = StageInputs(
        recording=recording,
        options=options,
        plan=plan,
        fuser=given.fuser,
        apertures=workspace.apertures,
        database=workspace.colmap_database,
        sensors=_find_sensors(recording, options, given.reference, workspace.images),
    )
    of_frames = insert_defaults(stages.frame, default_frame_stages(inputs))
    of_keypoints = insert_defaults(stages.keypoint, default_keypoint_stages(inputs))
    _require_known_images(options, of_keypoints)
    with closing(full):
        records = run_frames(session, recording, full, of_frames, workspace.colmap_images, plan, given.rig)
    used_timing = part_of(recording.timing, [record.name for record in records if record.used])
    # pairs are chosen by what the capture itself holds: a calibration that is given later maps nothing again
    plain_imu = correct_imu(capture, given.raw, None)
    plain = Recording.of(capture, plain_imu, used_timing, prior_calibration(capture, None))
    keypoints, matching, mapping = run_colmap(session, plain, records, of_keypoints, given.gravity, options)
    rectified = keypoints.rectified()
    of_models = insert_defaults(stages.model, default_model_stages(replace(inputs, keypoint_stages=of_keypoints)))
    # images agree with the model as it is in the end
    after_models = changes_images(of_models)
    if after_models and inputs.sensors is not None and inputs.sensors.seen_in is not None:
        raise InertialError(Fact("target-before-images"))
    if not after_models:
        images = run_images(session, records, rectified, of_keypoints)
    models, fragments, gaps = run_models(
        session, recording, of_models, Submodels(rectified=bool(rectified)), fragments=options.fragments
    )
    if after_models:
        images = run_images(session, records, rectified, stages_of_refined(of_keypoints, models))
    models = run_validation(session, models, given.target, images)
    models = run_georeference(session, models, given.fixes, recording.timing, options.world)
    if options.dense:
        models = run_dense_models(session, models, images, options.dense_options)
    write_recording(session, recording, of_keypoints, rectified)
    return ReconstructResult(
        workspace=workspace,
        models=models,
        fragments=fragments,
        gaps=gaps,
        frames=note_unplaced(
            note_rectified(records, rectified),
            find_models(workspace.colmap_sparse).values(),
            workspace.colmap_database,
        ),
        keypoints=keypoints,
        matching=matching,
        mapping=mapping,
        imaging=plan,
        selection=selection,
        seconds=session.runner.seconds,
    )


def _find_sensors(
    recording: Recording, options: ReconstructOptions, reference: ReferenceOptions, images: Path
) -> CaptureSensors:
    """What the capture holds beside the IMU that knows of metres."""
    capture, timing = recording.capture, recording.timing

    def size_px() -> tuple[int, int]:
        with closing(GreyFrames(capture, timing)) as grey:
            camera = grey.guess_camera()
        return camera.width, camera.height

    return find_sensors(
        capture,
        timing.names,
        size_px,
        timing=timing,
        chosen=options.scale_from,
        made=images,
        reference=reference,
    )


def _require_known_images(options: ReconstructOptions, stages: Sequence[KeypointStage]) -> None:
    """Ask which images a given database describes, where keypoints are corrected."""
    if options.database is not None and stages and options.database_images is None:
        raise InertialError(Fact("database-of-which-images"))


def _gravity_priors(recording: Recording, options: ReconstructOptions) -> Mapping[str, Array]:
    """Gravity by image name where the options ask for it, else empty."""
    if not options.mapping.gravity_priors:
        return {}
    if options.mapping.mapper != "global":
        raise InertialError(Fact("gravity-priors-need-global"))
    calibration = recording.prior
    if calibration.sigma("rotation_x_rad") > _GRAVITY_ROTATION_RAD or calibration.clock_sigma_s > 1:
        raise InertialError(Fact("gravity-priors-need-calibration"))
    timed = CameraTimedImu.from_recording(recording.imu, calibration, recording.timing.epoch_ns)
    return gravity_in_cam(timed, recording.timing)
