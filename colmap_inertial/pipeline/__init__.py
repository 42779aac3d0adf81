"""From a capture to a metric, gravity-up COLMAP model: one list of calls, with a hook at each seam."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.errors import FormatError, InertialError, NotObservableError, TargetNotFoundError
from colmap_inertial.gravity import gravity_in_cam
from colmap_inertial.io.calibration import SHARED_CLOCK_OFFSET_S, for_another_recording, read_calibration
from colmap_inertial.io.capture import Capture, Video, load_capture
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.io.frames import frame_source, read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.model import Model, find_models, read_model, summarize
from colmap_inertial.pipeline.colmap import (
    KeypointStage,
    MappingOptions,
    Progress,
    check_names,
    extract_features,
    image_pairs,
    map_images,
    match_features,
    write_gravity_priors,
)
from colmap_inertial.pipeline.config import config_as_toml
from colmap_inertial.pipeline.frames import FrameRecord, FrameStage, read_frame_records, require_frames, write_frames
from colmap_inertial.pipeline.metric import MetricStage, ModelStage, write_trajectory
from colmap_inertial.pipeline.workspace import StageRunner, Workspace, fingerprint, remove
from colmap_inertial.scale import ScaleOptions
from colmap_inertial.types import (
    Array,
    CameraImuCalibration,
    Frame,
    FrameTiming,
    ImuRecording,
    ScaleEstimate,
    WorldAxes,
)
from colmap_inertial.validate import Target, Validation, parse_target, validate_model, write_pictures

log = logging.getLogger(__name__)

#: A camera-IMU rotation less certain than this is no basis for gravity directions.
_GRAVITY_ROTATION_RAD = 0.2


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Everything that decides the result of a reconstruction, beside the capture itself."""

    mapping: MappingOptions = field(default_factory=MappingOptions)
    """How COLMAP builds the model."""
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    """How metres come from the IMU."""
    world: WorldAxes = "z-up"
    """Axes of the metric model: z away from the ground, or y towards it, as COLMAP's own cameras have it."""
    deterministic: bool = False
    """Fixed seed and one thread: the same input gives the same model, bit for bit. Slower."""
    seed: int = 0
    """Seed of COLMAP's random sampling."""
    calibration: Path | None = None
    """A calibration file of this device (from `colmap-inertial align --out`), used as a prior."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to 2147483647, not {self.seed}")


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelResult:
    """What became of one of COLMAP's models; paths are ``None`` where the scale was refused."""

    index: int
    scale: ScaleEstimate
    summary: dict[str, int | float]
    sparse: Path
    sparse_metric: Path | None = None
    trajectory: Path | None = None
    validation: Validation | InertialError | None = None
    """Against the capture's target, where it names one; an error says why the target could not be measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructResult:
    """What ``reconstruct`` made; the same as ``result.json``."""

    workspace: Workspace
    models: tuple[ModelResult, ...]
    frames: tuple[FrameRecord, ...]
    seconds: dict[str, float]

    def exit_code(self) -> int:
        """0; 1 where a validation is outside its tolerance; its error's code where the target could not be measured.

        Raises
        ------
        NotObservableError
            When every model's scale was refused.
        """
        if all(model.sparse_metric is None for model in self.models):
            reasons = {model.index: "; ".join(model.scale.reasons) for model in self.models}
            raise NotObservableError(
                "scale",
                next(iter(reasons.values()))
                if len(reasons) == 1
                else "; ".join(f"model {i}: {text}" for i, text in reasons.items()),
            )
        checked = [model.validation for model in self.models if model.validation is not None]
        failures = [check.exit_code for check in checked if isinstance(check, InertialError)]
        outside = any(not check.within_tolerance for check in checked if isinstance(check, Validation))
        if outside:
            return 1
        return failures[0] if len(failures) == len(checked) > 0 else 0


def silent(stage: str, done: int, total: int, /) -> None:
    """A progress receiver that shows nothing."""


def prior_calibration(capture: Capture, options: ReconstructOptions) -> CameraImuCalibration:
    """What is known of camera and IMU beforehand: from ``--calibration``, else from the capture."""
    if options.calibration is None:
        return capture.calibration
    return for_another_recording(read_calibration(options.calibration), shared_clock=capture.shared_clock)


def default_model_stages(capture: Capture, imu: ImuRecording, options: ReconstructOptions) -> list[ModelStage]:
    """What ``reconstruct`` runs when ``model_stages`` is ``None``: a starting point for one's own list."""
    scale = options.scale
    if capture.shared_clock and scale.max_offset_s is None:
        scale = dataclasses.replace(scale, max_offset_s=SHARED_CLOCK_OFFSET_S)
    calibration = prior_calibration(capture, options)
    return [MetricStage(imu=imu, calibration=calibration, options=scale, world=options.world)]


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
        The hooks. ``None`` means the default stages, an empty list none. The model stages must include one that makes
        the model metric, see :func:`default_model_stages`.
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
    """
    loaded = load_capture(capture)
    if loaded.frames is None:
        raise FormatError(loaded.path, "has no frames: add [images] or [video]")
    imu = read_capture_imu(loaded)
    if loaded.target is not None:
        parse_target(loaded.target)  # a wrong specification is said before the work, not after it
    timing, frames = read_frames(loaded)
    require_frames(len(timing.names), of=len(timing.names))
    gravity = _gravity_priors(loaded, imu, timing, options)
    check_names(timing.names)
    stages = default_model_stages(loaded, imu, options) if model_stages is None else list(model_stages)
    workspace = Workspace(out)
    workspace.open(loaded.path)
    with workspace.locked(), _logging_to(workspace.log):
        log.info("colmap-inertial %s: %s -> %s", __version__, capture, out)
        write_text(workspace.config, config_as_toml(options))
        runner = StageRunner(workspace)
        _run_frames(runner, workspace, loaded, timing, frames, list(frame_stages or ()), progress)
        records = read_frame_records(workspace.frames)
        _run_colmap(runner, workspace, records, gravity, options, list(keypoint_stages or ()), progress)
        models = run_models(workspace, timing, imu, stages, runner, progress)
        if loaded.target is not None:
            models = tuple(_validated(workspace, model, parse_target(loaded.target), progress) for model in models)
        result = ReconstructResult(workspace=workspace, models=models, frames=records, seconds=runner.seconds)
        write_json(workspace.result, _result_as_json(result, loaded))
        remove(workspace.features)
        log.info("finished")
    return result


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


@contextlib.contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    """Send this package's log to a file, and keep COLMAP's chatter off the terminal."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    logger = logging.getLogger("colmap_inertial")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except InertialError as error:
        log.error("%s", error)
        raise
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()


def _run_frames(
    runner: StageRunner,
    workspace: Workspace,
    capture: Capture,
    timing: FrameTiming,
    frames: Iterator[Frame],
    stages: Sequence[FrameStage],
    progress: Progress,
) -> None:
    source = frame_source(capture)

    def work(partial: Sequence[Path]) -> None:
        images, records = partial
        write_frames(frames, timing, stages, source_folder=source, images=images, records=records, progress=progress)

    inputs = [] if source is None else [source / name for name in timing.names]
    if isinstance(capture.frames, Video):
        inputs = [capture.frames.file]
    depends = {"capture": capture, "timing": timing, "inputs": [fingerprint(path) for path in inputs], "stages": stages}
    runner.run("frames", depends, [workspace.images, workspace.frames], work)


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


def run_models(
    workspace: Workspace,
    timing: FrameTiming,
    imu: ImuRecording,
    stages: Sequence[ModelStage],
    runner: StageRunner,
    progress: Progress,
) -> tuple[ModelResult, ...]:
    """Every sub-model through the model stages, then to its final place; run again after an interruption."""
    start = time.perf_counter()
    scratch = workspace.stamps / "models"
    for path in (scratch, workspace.sparse_metric, workspace.validation, *workspace.root.glob("trajectory*")):
        remove(path)
    results: list[ModelResult] = []
    found = find_models(workspace.sparse)
    for done, (index, folder) in enumerate(found.items()):
        progress("metric", done, len(found))
        shutil.copytree(folder, scratch / str(index))
        model = Model(folder=scratch / str(index), index=index, timing=timing)
        for stage in stages:
            model = stage(model)
        if model.scale is None:
            raise ValueError("the model stages must include one that estimates the scale; see default_model_stages")
        result = ModelResult(index=index, scale=model.scale, summary=summarize(read_model(folder)), sparse=folder)
        if model.similarity is not None:
            target = workspace.sparse_metric / str(index)
            target.parent.mkdir(exist_ok=True)
            os.replace(model.folder, target)
            first = not any(other.sparse_metric for other in results)
            trajectory = workspace.trajectory(index, first=first)
            write_trajectory(trajectory, dataclasses.replace(model, folder=target), imu)
            result = dataclasses.replace(result, sparse_metric=target, trajectory=trajectory)
        log.info("model %d: %s %s", index, result.scale.verdict, "; ".join(result.scale.reasons))
        results.append(result)
    remove(scratch)
    progress("metric", len(found), len(found))
    runner.seconds["metric"] = time.perf_counter() - start
    return tuple(results)


def _validated(workspace: Workspace, model: ModelResult, target: Target, progress: Progress) -> ModelResult:
    """Measure the capture's target in a metric model; a target that cannot be measured does not undo the model."""
    if model.sparse_metric is None:
        return model
    check: Validation | InertialError
    try:
        check = validate_model(
            model.sparse_metric,
            workspace.images,
            target,
            progress=lambda done, total: progress("validation", done, total),
        )
        write_pictures(check, workspace.images, workspace.validation / str(model.index))
    except (TargetNotFoundError, NotObservableError) as error:
        check = error
    found = check if isinstance(check, InertialError) else f"scale error {check.scale_error_pct:+.3f} %"
    log.info("model %d: %s against %s", model.index, found, target.spec)
    return dataclasses.replace(model, validation=check)


def _validation_as_json(check: Validation | InertialError | None) -> object:
    return {"error": str(check)} if isinstance(check, InertialError) else check and check.as_json()


def _result_as_json(result: ReconstructResult, capture: Capture) -> dict[str, object]:
    import pycolmap

    root = result.workspace.root

    def relative(path: Path | None) -> str | None:
        return None if path is None else str(path.relative_to(root))

    return {
        "versions": {"colmap_inertial": __version__, "pycolmap": pycolmap.__version__},
        "capture": str(capture.path),
        "models": [
            {
                "index": model.index,
                **model.summary,
                "sparse": relative(model.sparse),
                "sparse_metric": relative(model.sparse_metric),
                "trajectory": relative(model.trajectory),
                **model.scale.as_json(),
                "validation": _validation_as_json(model.validation),
            }
            for model in result.models
        ],
        "frames": [{"name": record.name, "action": record.action} for record in result.frames],
        "seconds": result.seconds,
    }
