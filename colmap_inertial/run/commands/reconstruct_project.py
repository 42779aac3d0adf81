"""``reconstruct`` on a project that COLMAP has made already: no mapping, everything else."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, Literal

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.tsdf import require_mesh_maker
from colmap_inertial.colmap.settings import read_settings
from colmap_inertial.core.choices import check_kind
from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.core.facts import Fact, as_fact, read_facts
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import (
    CameraTrajectory,
    FrameTiming,
)
from colmap_inertial.diagnose import Diagnosis
from colmap_inertial.hooks import ModelStage, insert_defaults
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import StrPath, read_json, reading_within
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.imu import is_capture
from colmap_inertial.io.recording import Recording
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
from colmap_inertial.run.commands.project_sources import (
    ProjectSources,
    find_images,
    list_registered,
    read_sources,
    run_times,
)
from colmap_inertial.run.commands.reporting import report_result, reporting_stops, write_recording
from colmap_inertial.run.commands.result import Fragment, ModelResult, ReconstructResult
from colmap_inertial.run.preparation.geolocation import positions_of
from colmap_inertial.run.preparation.known_lengths import add_target, check_reference_beside_imu
from colmap_inertial.run.preparation.packages import warn_of_conflicts
from colmap_inertial.run.preparation.preflight import run_preflight
from colmap_inertial.run.preparation.sensors import find_sensors
from colmap_inertial.run.stages.capture_sensors import CaptureSensors
from colmap_inertial.run.stages.defaults import default_model_stages
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.steps.session import Session, open_session
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.validate import Target, parse_target

if TYPE_CHECKING:
    import pycolmap


def is_project(path: Path) -> bool:
    """Whether ``path`` holds a COLMAP model in a project's place, and is no capture."""
    if not _holds_model(path):
        return False
    try:
        load_capture(path)
    except FormatError:
        return not is_capture(path)
    return False


def _holds_model(path: Path) -> bool:
    places = (path, path / "sparse")
    return any(
        model_format(folder) is not None
        or (folder.is_dir() and any(p.name.isdigit() and model_format(p) is not None for p in folder.iterdir()))
        for folder in places
    )


def _require_model(project: Path) -> None:
    if not _holds_model(project):
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
    reference: ReferenceOptions = ReferenceOptions(),
    model_stages: Sequence[ModelStage | EllipsisType] = (...,),
    overwrite: bool = False,
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
    reference
        A target, and a known distance of two markers or points, which gives metres where ``options.scale_from`` names
        it.
    model_stages, overwrite
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
        When ``out`` holds something else or a finished result that would not stay as it is, or lies in the project, or
        something in the project has a name that the run needs.
    NotObservableError
        When the recording cannot give metres (``options.force`` goes on).
    """
    check_kind("source", source, ProjectOptions, options=ReconstructOptions)
    check_kind("options", options, ReconstructOptions, source=ProjectOptions)
    check_kind("reference", reference, ReferenceOptions)
    with reading_within(options.limits):
        return _reconstruct(
            Path(project), Path(out), source, options, reference, model_stages, overwrite, progress, findings
        )


def _reconstruct(
    project: Path,
    out: Path,
    source: ProjectOptions,
    options: ReconstructOptions,
    reference: ReferenceOptions,
    model_stages: Sequence[ModelStage | EllipsisType],
    overwrite: bool,
    progress: Progress,
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    given = _read_project(project, out, source, options, reference)
    context, pictures = RunContext.of(options, progress=progress), () if given.images is None else (given.images,)
    with (
        open_session(out, project, options, context, pictures=pictures, overwrite=overwrite) as session,
        reporting_stops(session, given.beside.capture),
    ):
        result = _run_steps(session, given, source, options, model_stages, findings)
        beside = given.beside
        return report_result(
            session, result, beside.capture, beside.calibration_files, project=source, reference=reference
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _CheckedProject:
    """A project that was read and checked.

    Attributes
    ----------
    folder
        The project's.
    layout, models
        What lies where in it, and the folders of its models by their number.
    beside
        What is given beside it.
    images
        The folder of its images; ``None`` where there is none and none is needed.
    reference
        Known lengths.
    target
        To measure in the models.
    read
        Reads a model, once.
    """

    folder: Path
    layout: Layout
    models: dict[int, Path]
    beside: ProjectSources
    images: Path | None
    reference: ReferenceOptions
    target: Target | None
    read: functools._lru_cache_wrapper[pycolmap.Reconstruction]


def _read_project(
    project: Path, out: Path, source: ProjectOptions, options: ReconstructOptions, reference: ReferenceOptions
) -> _CheckedProject:
    """Read a project; what is wrong with it, the options or what is given beside it is said before any work."""
    warn_of_conflicts()
    _require_model(project)
    _check_options(options)
    beside = read_sources(project, source, options)
    reference = add_target(reference, beside.capture)
    check_reference_beside_imu(reference, options.scale_from)
    beside = dataclasses.replace(beside, capture=dataclasses.replace(beside.capture, target=reference.target))
    target = None if reference.target is None else parse_target(reference.target)
    layout = read_submodels(project, out, source)
    models = {index: project / folder for index, folder in layout.submodels.items()}
    if reference.has_points and (len(models) > 1 or options.refine != "off"):
        raise InertialError(Fact("points-of-another-model"))
    require_free_names(project, Workspace(out), dense=options.dense)
    seen_in_images = "target" in options.scale_from or reference.has_markers
    looks_at_images = options.dense or source.exif_times or source.video is not None or seen_in_images
    filmed = isinstance(beside.capture.frames, Video)
    images = find_images(project, source, needed=looks_at_images or (options.georeference and not filmed))
    read = functools.cache(read_model)
    require_refinable(options, models, read)
    if options.dense:
        require_near(models, read)
    return _CheckedProject(
        folder=project,
        layout=layout,
        models=models,
        beside=beside,
        images=images,
        reference=reference,
        target=target,
        read=read,
    )


def _run_steps(
    session: Session,
    given: _CheckedProject,
    source: ProjectOptions,
    options: ReconstructOptions,
    model_stages: Sequence[ModelStage | EllipsisType],
    findings: Callable[[Diagnosis], None],
) -> ReconstructResult:
    """The steps of a run, from the times of the images to the dense reconstruction."""
    beside, models, images, target, read = given.beside, given.models, given.images, given.target, given.read
    timing, notes = run_times(session, beside, models, images, read)
    fixes = positions_of(beside.capture, list_registered(models, read), images) if options.georeference else None
    limit_s = options.scale.max_offset_s
    recording = Recording.of(beside.capture, beside.imu, timing, beside.prior, max_offset_s=limit_s)
    largest = read(models[max(models, key=lambda n: (num_registered(models[n]), -n))])
    poses = _read_poses(largest, timing)
    doubts = run_preflight(session, recording, beside.raw, findings, force=options.force, model=poses)
    recording = dataclasses.replace(recording, doubts=doubts)
    inputs = _make_stage_inputs(given, recording, source, options, _find_sensors(given, recording, options))
    stages = insert_defaults(model_stages, default_model_stages(inputs))
    submodels = Submodels(folders=models, numbered=True, after=(), read=read)
    results, fragments, gaps = run_models(session, recording, stages, submodels, fragments=options.fragments)
    read.cache_clear()
    if target is not None and images is None:
        notes = (*notes, Fact("target-without-images"))
    results = tuple(_add_notes(result, notes) for result in results)
    results = run_validation(session, results, target, images)
    results = run_georeference(session, results, fixes, timing, options.world)
    metric = place_project(session, given.folder, source, models, _collect_scales(results, fragments))
    results = _add_notes_on_files(results, metric)
    if options.dense and images is not None:
        results = run_dense_models(session, results, images, options.dense_options)
    write_recording(session, recording)
    return ReconstructResult(
        workspace=session.workspace,
        models=results,
        fragments=fragments,
        gaps=gaps,
        seconds=session.runner.seconds,
        project_metric=metric,
    )


def _read_poses(model: pycolmap.Reconstruction, timing: FrameTiming) -> CameraTrajectory | Literal["untimed"]:
    """The poses of a model, where enough of its images have times."""
    try:
        return trajectory_from_model(model, timing)[0]
    except TimingError:
        return "untimed"


def _find_sensors(given: _CheckedProject, recording: Recording, options: ReconstructOptions) -> CaptureSensors:
    """What the recording holds beside the IMU that knows of metres, by the names of the images."""
    names = list_registered(given.models, given.read)

    def size_px() -> tuple[int, int]:
        camera = next(iter(given.read(next(iter(given.models.values()))).cameras.values()))
        return camera.width, camera.height

    found = find_sensors(
        given.beside.capture,
        names,
        size_px,
        timing=recording.timing,
        chosen=options.scale_from,
        images=given.images,
        reference=given.reference,
    )
    if found.seen_in is None:
        return found
    return dataclasses.replace(found, files=(*found.files, fingerprint(found.seen_in)))


def _make_stage_inputs(
    given: _CheckedProject,
    recording: Recording,
    source: ProjectOptions,
    options: ReconstructOptions,
    sensors: CaptureSensors,
) -> StageInputs:
    """Inputs of the model stages."""
    project, layout = given.folder, given.layout
    files = list_tree(project, follow_links=source.follow_links)[1]
    return StageInputs(
        recording=recording,
        options=_hold_cameras(options),
        database=find_database(project, files),
        made_from=name_made_from(project, layout, files, source.keep) if options.refine == "auto" else "",
        sensors=sensors,
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


def _add_notes(result: ModelResult, notes: Sequence[Fact]) -> ModelResult:
    scale = result.scale
    return dataclasses.replace(result, scale=dataclasses.replace(scale, notes=(*scale.notes, *map(as_fact, notes))))


def _add_notes_on_files(results: tuple[ModelResult, ...], metric: Path | None) -> tuple[ModelResult, ...]:
    """The results, the first in metres with what is to be said of the project's other files."""
    at = next((i for i, result in enumerate(results) if result.sparse_metric is not None), None)
    if metric is None or at is None:
        return results
    notes = read_facts(read_json(metric / TRANSFORM_FILE), "notes")
    return (*results[:at], _add_notes(results[at], notes), *results[at + 1 :])


def _collect_scales(results: Sequence[ModelResult], fragments: Sequence[Fragment]) -> dict[int | None, ModelScale]:
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
