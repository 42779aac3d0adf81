"""``reconstruct`` on a project that COLMAP has made already: no mapping, everything else."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, Literal, get_args

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.tsdf import require_mesh_maker
from colmap_inertial.colmap.settings import read_settings
from colmap_inertial.core.choices import check_kind
from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.core.facts import Fact, as_fact, read_facts
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import (
    CameraImuCalibration,
    CameraTrajectory,
    FrameTiming,
    ImuRecording,
    ReadoutDirection,
)
from colmap_inertial.diagnose import Diagnosis
from colmap_inertial.hooks import ModelStage, insert_defaults
from colmap_inertial.io.calibration import calibration_prior, describe_files
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.exif import read_exposures_s, stamps_of_exif
from colmap_inertial.io.files import StrPath, read_json, read_record, reading_within, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.frame_times import FrameStamps, stamps_of_pattern
from colmap_inertial.io.frames import read_frame_times, read_frame_timing
from colmap_inertial.io.imu import is_capture, read_unchecked_capture_imu, read_unchecked_imu
from colmap_inertial.io.imu_formats import find_recorder_output
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.recording import Recording, correct_imu, prior_calibration
from colmap_inertial.io.video import video_stamps_ns
from colmap_inertial.io.video_match import match_to_video
from colmap_inertial.model import (
    TRANSFORM_FILE,
    model_format,
    num_registered,
    read_model,
    trajectory_from_model,
)
from colmap_inertial.model.copying import list_tree
from colmap_inertial.model.database import find_database
from colmap_inertial.model.layout import Layout
from colmap_inertial.model.rigs import frames_of_rigs
from colmap_inertial.model.similarities import ModelScale, read_similarity
from colmap_inertial.report import require_plotly
from colmap_inertial.run.commands.georeference import run_georeference
from colmap_inertial.run.commands.models import Submodels, run_dense_models, run_models, run_validation
from colmap_inertial.run.commands.project_models import (
    name_made_from,
    read_submodels,
    require_near,
    require_refinable,
)
from colmap_inertial.run.commands.project_output import place_project, require_free_names
from colmap_inertial.run.commands.reporting import report_result, reporting_stops, write_recording
from colmap_inertial.run.commands.result import Fragment, ModelResult, ReconstructResult
from colmap_inertial.run.preparation.geolocation import positions_of
from colmap_inertial.run.preparation.preflight import check_imu, run_preflight
from colmap_inertial.run.stages.defaults import default_model_stages
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.steps.session import Session, open_session, warn_of_conflicts
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.validate import parse_target

if TYPE_CHECKING:
    import pycolmap

#: With fewer of the images found in the video, it is not theirs.
_LEAST_SHARE = 0.5
#: Digits of EXIF's fraction of a second that are as good as milliseconds.
_FINE_DIGITS = 3


def is_project(path: Path) -> bool:
    """Whether ``path`` holds a COLMAP model in a project's place, and is no capture."""
    if not _has_model(path):
        return False
    try:
        load_capture(path)
    except FormatError:
        return not is_capture(path)
    return False


def _has_model(path: Path) -> bool:
    places = (path, path / "sparse")
    return any(
        model_format(folder) is not None
        or (folder.is_dir() and any(p.name.isdigit() and model_format(p) is not None for p in folder.iterdir()))
        for folder in places
    )


def _require_model(project: Path) -> None:
    if not _has_model(project):
        raise FormatError(
            project,
            Fact("no-model-for-imu"),
        )


def reconstruct_project(
    project: StrPath,
    out: StrPath,
    source: ProjectOptions,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    model_stages: Sequence[ModelStage | EllipsisType] = (...,),
    progress: Progress = silent,
    findings: Callable[[Diagnosis], None] = lambda _: None,
) -> ReconstructResult:
    """Make an existing COLMAP project metric, gravity along an axis, with everything that was made from it.

    Parameters
    ----------
    project
        A folder with a COLMAP model; it is only read.
    out
        A folder that does not exist, or holds a run on the same project, which is then continued. It becomes the
        whole project in metres, with ``trajectory.tum``, ``result.json`` and the report of :func:`reconstruct`.
    source
        The IMU recording, and when the images were taken.
    options
        Those of mapping and of pixels must be left alone: the model is what it is.
    model_stages
        As of :func:`reconstruct`.
    progress
        Called with stage, steps done and steps in all.
    findings
        Called with what the check beforehand found, before the work and before a refusal that it leads to.

    Raises
    ------
    FormatError, TimingError
        For what is missing or cannot be read, naming the flag to give.
    AlreadyMetricError
        When the project carries a similarity of ours.
    OutputError, OutputExistsError
        When ``out`` holds something else, or lies in the project, or something in the project has a name that the run
        needs.
    NotObservableError
        When the recording cannot give metres (``options.force`` goes on).
    """
    check_kind("source", source, ProjectOptions, options=ReconstructOptions)
    check_kind("options", options, ReconstructOptions, source=ProjectOptions)
    with reading_within(options.limits):
        return _reconstruct(Path(project), Path(out), source, options, model_stages, progress, findings)


def _reconstruct(
    project: Path,
    out: Path,
    source: ProjectOptions,
    options: ReconstructOptions,
    model_stages: Sequence[ModelStage | EllipsisType],
    progress: Progress,
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    warn_of_conflicts()
    _require_model(project)
    _check_options(options)
    given = _read_sources(project, source, options)
    target = None if given.capture.target is None else parse_target(given.capture.target)
    layout = read_submodels(project, out, source)
    models = {index: project / folder for index, folder in layout.submodels.items()}
    require_free_names(project, Workspace(out), dense=options.dense)
    pictures = options.dense or source.exif_times or source.video is not None
    filmed = isinstance(given.capture.frames, Video)
    images = _images(project, source, needed=pictures or (options.georeference and not filmed))
    read = functools.cache(read_model)
    require_refinable(options, models, read)
    if options.dense:
        require_near(models, read)
    context, folders = RunContext.of(options, progress=progress), () if images is None else (images,)
    decides = given.source, given.capture, given.imu, given.prior, fingerprint(project), model_stages
    with (
        open_session(out, project, options, context, pictures=folders, decides=decides) as session,
        reporting_stops(session.workspace, given.capture),
    ):
        timing, notes = _run_times(session, given, models, images, read)
        fixes = positions_of(given.capture, _registered(models, read), images) if options.georeference else None
        limit_s = options.scale.max_offset_s
        recording = Recording.of(given.capture, given.imu, timing, given.prior, max_offset_s=limit_s)
        largest = read(models[max(models, key=lambda n: (num_registered(models[n]), -n))])
        poses = _trajectory(largest, timing)
        doubts = run_preflight(session, recording, given.raw, findings, force=options.force, model=poses)
        recording = dataclasses.replace(recording, doubts=doubts)
        stages = insert_defaults(
            model_stages, default_model_stages(_inputs(layout, recording, project, source, options))
        )
        submodels = Submodels(folders=models, numbered=True, after=(), read=read)
        results, fragments, gaps = run_models(session, recording, stages, submodels, fragments=options.fragments)
        read.cache_clear()
        if target is not None and images is None:
            notes = (*notes, Fact("target-without-images"))
        results = tuple(_noted(result, notes) for result in results)
        results = run_validation(session, results, target, images)
        results = run_georeference(session, results, fixes, timing, options.world)
        metric = place_project(session, project, source, models, _scales(results, fragments))
        results = _told_of_files(results, metric)
        if options.dense and images is not None:
            results = run_dense_models(session, results, images, options.dense_options)
        result = ReconstructResult(
            workspace=session.workspace,
            models=results,
            fragments=fragments,
            gaps=gaps,
            seconds=session.runner.seconds,
            project_metric=metric,
        )
        write_recording(session, recording)
        return session.in_place(report_result(session, result, given.capture, given.calibration_files, project=source))


def _trajectory(model: pycolmap.Reconstruction, timing: FrameTiming) -> CameraTrajectory | Literal["untimed"]:
    """The poses of a model, where enough of its images have times."""
    try:
        return trajectory_from_model(model, timing)[0]
    except TimingError:
        return "untimed"


def _inputs(
    layout: Layout, recording: Recording, project: Path, source: ProjectOptions, options: ReconstructOptions
) -> StageInputs:
    """Inputs of the model stages."""
    files = list_tree(project, follow_links=source.follow_links)[1]
    return StageInputs(
        recording=recording,
        options=_hold_cameras(options),
        database=find_database(project, files),
        made_from=name_made_from(project, layout, files, source.keep) if options.refine == "auto" else "",
    )


def _hold_cameras(options: ReconstructOptions) -> ReconstructOptions:
    """The options, with a project's cameras held where a refinement is not asked to change them, too."""
    if options.refine == "off" or options.mapping.refine_intrinsics is not None:
        return options
    return dataclasses.replace(options, mapping=dataclasses.replace(options.mapping, refine_intrinsics=False))


def _check_options(options: ReconstructOptions) -> None:
    """Refuse what needs a package that is not installed, and what has no meaning without mapping."""
    require_plotly()
    require_mesh_maker(options)
    default = ReconstructOptions()
    named = [
        f"--{group}.{f.name}"
        for group in ("mapping", "apertures", "exposures")
        for f in dataclasses.fields(getattr(default, group))
        if getattr(getattr(options, group), f.name) != getattr(getattr(default, group), f.name)
        and not (f.name == "refine_intrinsics" and options.refine != "off")
    ]
    named += ["--colmap-executable"] if options.colmap_executable is not None else []
    settings = read_settings(options.colmap, options.colmap_project)
    named += [f"--colmap {text}" for text in settings.of("features", "matches", "mapping", "adjustment")]
    named += ["--database"] if options.database is not None else []
    named += ["--deblur"] if options.deblur not in (None, "off") else []
    named += ["--rolling-shutter"] if options.rolling_shutter not in (None, "off") else []
    if named:
        flags = tuple(flag.replace("_", "-") for flag in named)
        raise InertialError(Fact("not-for-an-existing-model", options=flags))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Given:
    """Inputs given beside the project.

    Attributes
    ----------
    capture
        What is known of the recording, in a capture's terms; its frames are those of a capture that was given.
    raw, imu
        The IMU as it was recorded, and as its own calibration corrects it.
    prior
        Calibration of camera and IMU that is known beforehand.
    calibration_files
        What the result says of them.
    """

    source: ProjectOptions
    capture: Capture
    raw: ImuRecording
    imu: ImuRecording
    prior: CameraImuCalibration
    calibration_files: list[dict[str, str]]


def _require_recording(project: Path, source: ProjectOptions) -> Path:
    if source.imu is None:
        stated = (source.frame_times, source.name_times, source.video, source.exif_times or None)
        is_timed = any(times is not None for times in stated)
        raise FormatError(project, Fact("project-needs-imu" if is_timed else "project-needs-imu-and-times"))
    if source.frame_times is not None and not source.frame_times.exists():
        raise FormatError(source.frame_times, Fact("no-such-file", what="file or folder"))
    return source.imu


def _read_sources(project: Path, source: ProjectOptions, options: ReconstructOptions) -> _Given:
    """Read what was given beside the project, before any work."""
    imu, times = _require_recording(project, source), source.frame_times
    described = [p for p in (imu, times) if p is not None and (is_capture(p) or find_recorder_output(p) is not None)]
    captures = [load_capture(path) for path in described]
    raw = read_unchecked_capture_imu(captures[0]) if described[:1] == [imu] else read_unchecked_imu(imu)
    capture = captures[0] if captures else Capture(path=project, calibration=calibration_prior())
    frames = next((c.frames for c in captures if c.frames is not None), None)
    own_clock = source.exif_times or (source.video is not None and not isinstance(frames, Video))
    shared = any(c.shared_clock for c in captures) and not own_clock
    capture = dataclasses.replace(capture, path=project, frames=frames, shared_clock=shared)
    if source.video is not None:
        capture = _add_video(capture, source.video, None if times in described else times)
    elif frames is None and not (times or source.name_times is not None or source.exif_times):
        raise TimingError(Fact("project-untimed", project=str(project)))
    raw = check_imu(raw, force=options.force)
    return _Given(
        source=source,
        capture=capture,
        raw=raw,
        calibration_files=describe_files(options.calibration),
        prior=prior_calibration(capture, options.calibration),
        imu=correct_imu(capture, raw, options.calibration),
    )


def _add_video(capture: Capture, video: Path, times: Path | None) -> Capture:
    """The capture with all frames of a video; what the recorder noted about them counts where it is the recorder's."""
    frames = Video(file=video) if not isinstance(capture.frames, Video) else capture.frames
    if not isinstance(capture.frames, Video) and (recording := find_recorder_output(video)) is not None:
        log_ = recording.log
        capture = dataclasses.replace(capture, frame_log=log_)
        if log_ is not None and capture.readout_s is None:
            capture = dataclasses.replace(capture, readout_s=log_.readout_s, readout_direction=log_.readout_direction)
    frames = dataclasses.replace(frames, file=video, frames_per_s=None)
    return dataclasses.replace(
        capture, frames=frames if times is None else dataclasses.replace(frames, frame_times=times)
    )


def _images(project: Path, source: ProjectOptions, *, needed: bool) -> Path | None:
    folder = project / "images" if source.images is None else source.images
    if folder.is_dir():
        return folder
    if source.images is not None or needed:
        raise FormatError(folder, Fact("no-folder-of-pictures"))
    return None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Times:
    """Times of the images, with notes for the user."""

    timing: FrameTiming
    notes: tuple[Fact, ...]


def _run_times(
    session: Session,
    given: _Given,
    models: dict[int, Path],
    images: Path | None,
    read: Callable[[Path], pycolmap.Reconstruction],
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    """Read the times of the images, with notes for the user."""

    def work(partial: Sequence[Path]) -> None:
        first_of = frames_of_rigs(read(folder) for folder in models.values())
        timing, notes = _times(given, _registered(models, read), first_of, images, session.progress)
        write_record(partial[0], _Times(timing=timing, notes=notes))

    frames = given.capture.frames
    stated = frames.frame_times if isinstance(frames, Video) else None if frames is None else frames.times
    inputs = [given.source.frame_times, given.source.video, images, stated if isinstance(stated, Path) else None]
    depends = {
        "source": dataclasses.replace(given.source, keep=(), link=False),
        "capture": dataclasses.replace(given.capture, target=None),
        "models": [fingerprint(folder) for folder in models.values()],
        "inputs": [fingerprint(path) for path in inputs if path is not None],
    }
    session.runner.run("times", depends, [session.workspace.frames], work)
    times = read_record(session.workspace.frames, _Times)
    return times.timing, times.notes


def _registered(models: dict[int, Path], read: Callable[[Path], pycolmap.Reconstruction]) -> list[str]:
    """Names of all images of the models."""
    reconstructions = [read(folder) for folder in models.values()]
    return sorted({model.image(i).name for model in reconstructions for i in model.reg_image_ids()})


def _times(
    given: _Given, names: Sequence[str], first_of: Mapping[str, str], images: Path | None, progress: Progress
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    source, capture = given.source, given.capture
    notes: tuple[Fact, ...] = ()
    if source.video is not None:
        assert images is not None
        timing, notes = _video_times(capture, source.video, images, names, progress)
    elif source.exif_times:
        assert images is not None
        stamps, digits = stamps_of_exif(images, names)
        timing = _timing(capture, stamps.one_per_frame(first_of))
        if digits < _FINE_DIGITS:
            notes = (Fact("exif-times-coarse", digits=digits),)
    elif source.name_times is not None:
        timing = _timing(capture, stamps_of_pattern(images or Path(), names, source.name_times).one_per_frame(first_of))
    elif source.frame_times is not None:
        timing = read_frame_times(source.frame_times, first_of)
        if timing.readout_s is None:
            timing = dataclasses.replace(
                timing, readout_s=capture.readout_s, readout_direction=capture.readout_direction
            )
    else:
        timing = read_frame_timing(capture, first_of)
    # an exposure that the pictures state belongs to the frames; one that they do not is no reason to stop
    if timing.exposure_s is None and images is not None:
        paths = [picture_in(images, name) for name in timing.names]
        if all(path.is_file() for path in paths):
            timing = dataclasses.replace(timing, exposure_s=read_exposures_s(paths))
    return timing, notes


def _timing(capture: Capture, stamps: FrameStamps) -> FrameTiming:
    timing = stamps.timing(exposure_s=capture.exposure_s, readout_s=capture.readout_s)
    return dataclasses.replace(timing, readout_direction=capture.readout_direction)


def _video_times(
    capture: Capture, video: Path, images: Path, names: Sequence[str], progress: Progress
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    stamps_ns = video_stamps_ns(video)
    every = read_frame_timing(capture)
    match = match_to_video(video, images, names, progress=lambda done: progress("video", done, len(stamps_ns)))
    if len(match.t_ns) < max(2, _LEAST_SHARE * len(names)):
        name, why = next(iter(match.doubtful.items()), ("", None))
        found, images_ = len(match.t_ns), len(names)
        raise TimingError(
            Fact("video-of-other-images", video=str(video), found=found, images=images_, name=name, why=why)
        )
    name_of = {t_ns: name for name, t_ns in match.t_ns.items()}
    kept = [i for i, t_ns in enumerate(stamps_ns.tolist()) if t_ns in name_of]
    # counterclockwise, as the pictures were turned against the frames
    directions: tuple[ReadoutDirection, ...] = ("down", "right", "up", "left")
    assert set(directions) == set(get_args(ReadoutDirection))
    turned = (directions.index(every.readout_direction) + match.quarter_turns) % 4
    timing = FrameTiming(
        names=tuple(name_of[int(stamps_ns[i])] for i in kept),
        t_s=every.t_s[kept],
        exposure_s=None if every.exposure_s is None else every.exposure_s[kept],
        readout_s=every.readout_s,
        readout_direction=directions[turned],
        epoch_ns=every.epoch_ns,
    )
    notes = []
    for why in sorted(set(match.doubtful.values()), key=str):
        those = [name for name, reason in match.doubtful.items() if reason == why]
        notes.append(Fact("images-untimed-by-video", count=len(those), images=len(names), why=why, first=those[0]))
    return timing, tuple(notes)


def _noted(result: ModelResult, notes: Sequence[Fact]) -> ModelResult:
    scale = result.scale
    return dataclasses.replace(result, scale=dataclasses.replace(scale, notes=(*scale.notes, *map(as_fact, notes))))


def _told_of_files(results: tuple[ModelResult, ...], metric: Path | None) -> tuple[ModelResult, ...]:
    """The results, the first in metres with what is to be said of the project's other files."""
    at = next((i for i, result in enumerate(results) if result.sparse_metric is not None), None)
    if metric is None or at is None:
        return results
    notes = read_facts(read_json(metric / TRANSFORM_FILE), "notes")
    return (*results[:at], _noted(results[at], notes), *results[at + 1 :])


def _scales(results: Sequence[ModelResult], fragments: Sequence[Fragment]) -> dict[int | None, ModelScale]:
    """Similarity of each sub-model of the project, by COLMAP's number."""
    scales: dict[int | None, ModelScale] = {
        fragment.colmap_index: ModelScale(
            similarity=None,
            verdict="refused",
            reasons=(Fact("fragment-too-small", images=fragment.registered_images),),
        )
        for fragment in fragments
    }
    for result in results:
        similarity = None
        if result.sparse_metric is not None:
            similarity = read_similarity(result.sparse_metric / TRANSFORM_FILE)
        scales[result.colmap_index] = ModelScale(
            similarity=similarity,
            verdict=result.scale.verdict,
            reasons=result.scale.reasons,
            joined_of=tuple(part.colmap_index for part in result.parts),
            left_out=() if result.scale.rotations is None else result.scale.rotations.left_out,
        )
        for part in result.parts:
            if part.colmap_index != result.colmap_index:
                scales[part.colmap_index] = ModelScale(
                    similarity=part.similarity, verdict=part.verdict, reasons=result.scale.reasons
                )
    return scales
