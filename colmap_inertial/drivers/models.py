"""COLMAP's models through the model stages, to their final places; measured and made dense where that is asked for."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.colmap.dense import run_dense
from colmap_inertial.drivers.reporting import write_model_record
from colmap_inertial.drivers.result import ModelResult
from colmap_inertial.errors import InertialError, NotObservableError, TargetNotFoundError, TimingError
from colmap_inertial.model import Model, find_models, read_model, summarize, trajectory_from_model
from colmap_inertial.options import ReconstructOptions
from colmap_inertial.run.progress import Progress
from colmap_inertial.run.runner import StageRunner, remove
from colmap_inertial.run.workspace import Workspace
from colmap_inertial.stages.metric import MetricStage, metric_trajectory, write_trajectory
from colmap_inertial.stages.protocols import ModelStage
from colmap_inertial.stages.readout import ReadoutStage
from colmap_inertial.types import FrameTiming, ImuRecording, ScaleEstimate
from colmap_inertial.validate import Target, Validation, validate_model, write_pictures

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


def run_models(
    workspace: Workspace,
    timing: FrameTiming,
    imu: ImuRecording,
    stages: Sequence[ModelStage],
    runner: StageRunner,
    progress: Progress,
    found: Mapping[int, Path] | None = None,
) -> tuple[ModelResult, ...]:
    """Every sub-model through the model stages, then to its final place; run again after an interruption.

    The sub-models are those of ``sparse/``, or ``found`` by number elsewhere. One with fewer than two timed images is
    refused, and the others go on.

    Raises
    ------
    TimingError
        Where that is so of all.
    """
    start = time.perf_counter()
    scratch = workspace.stamps / "models"
    stale = [*workspace.root.glob("trajectory*"), *workspace.report_data.glob("model_*.json")]
    for path in (scratch, workspace.sparse_metric, workspace.validation, *stale):
        remove(path)
    results: list[ModelResult] = []
    untimed: list[TimingError] = []
    found = find_models(workspace.sparse) if found is None else found
    for done, (index, folder) in enumerate(found.items()):
        progress("metric", done, len(found))
        mapped = read_model(folder)
        reason = _too_few_timed(mapped, timing)
        if reason is not None:
            if len(found) == 1:
                raise reason
            untimed.append(reason)
            log.info("model %d: refused %s", index, reason)
            results.append(_refused(index, mapped, folder, str(reason), stages))
            continue
        shutil.copytree(folder, scratch / str(index))
        model = Model(folder=scratch / str(index), index=index, timing=timing)
        for stage in stages:
            model = stage(model)
        if model.scale is None:
            raise ValueError("the model stages must include one that estimates the scale; see default_model_stages")
        settled = [stage.settled(index) for stage in stages if isinstance(stage, ReadoutStage)]
        result = ModelResult(
            index=index,
            scale=model.scale,
            summary=summarize(mapped),
            sparse=folder,
            readout=next((one for one in settled if one is not None), None),
        )
        if model.similarity is not None:
            target = workspace.sparse_metric / str(index)
            target.parent.mkdir(exist_ok=True)
            os.replace(model.folder, target)
            model = dataclasses.replace(model, folder=target)
            first = not any(other.sparse_metric for other in results)
            trajectory = workspace.trajectory(index, first=first)
            result = dataclasses.replace(result, sparse_metric=target, trajectory=trajectory)
        reconstruction = read_model(model.folder)
        poses, _ = trajectory_from_model(reconstruction, timing)
        if model.similarity is not None and result.trajectory is not None:
            poses = metric_trajectory(poses)
            write_trajectory(result.trajectory, model, poses, imu)
        write_model_record(workspace, model, reconstruction, poses, imu)
        log.info("model %d: %s %s", index, result.scale.verdict, "; ".join(result.scale.reasons))
        results.append(result)
    if untimed and len(untimed) == len(results):
        raise untimed[0]
    remove(scratch)
    progress("metric", len(found), len(found))
    runner.seconds["metric"] = time.perf_counter() - start
    return tuple(results)


def _too_few_timed(reconstruction: pycolmap.Reconstruction, timing: FrameTiming) -> TimingError | None:
    names = set(timing.names)
    if sum(reconstruction.image(i).name in names for i in reconstruction.reg_image_ids()) >= 2:
        return None
    try:
        trajectory_from_model(reconstruction, timing)
    except TimingError as error:
        return error
    return None


def _refused(
    index: int, reconstruction: pycolmap.Reconstruction, folder: Path, reason: str, stages: Sequence[ModelStage]
) -> ModelResult:
    method = next((stage.options.method for stage in stages if isinstance(stage, MetricStage)), "joint")
    scale = ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method=method, reasons=(reason,)
    )
    return ModelResult(index=index, scale=scale, summary=summarize(reconstruction), sparse=folder)


def validated(
    workspace: Workspace, models: Sequence[ModelResult], target: Target, images: Path, progress: Progress
) -> tuple[ModelResult, ...]:
    """Measure the target in the metric models; one that cannot be measured does not undo its model."""
    checked = []
    for model in models:
        if model.sparse_metric is None:
            checked.append(model)
            continue
        check: Validation | InertialError
        try:
            check = validate_model(
                model.sparse_metric,
                images,
                target,
                progress=lambda done, total: progress("validation", done, total),
            )
            write_pictures(check, images, workspace.validation / str(model.index))
        except (TargetNotFoundError, NotObservableError) as error:
            check = error
        said = check if isinstance(check, InertialError) else f"scale error {check.scale_error_pct:+.3f} %"
        log.info("model %d: %s against %s", model.index, said, target.spec)
        checked.append(dataclasses.replace(model, validation=check))
    return tuple(checked)


def with_dense(
    runner: StageRunner,
    workspace: Workspace,
    models: Sequence[ModelResult],
    images: Path,
    options: ReconstructOptions,
    progress: Progress,
) -> tuple[ModelResult, ...]:
    """The models with their dense reconstructions, where they are metric."""
    metric = [model.index for model in models if model.sparse_metric is not None]
    threads = 1 if options.deterministic else -1
    dense = run_dense(runner, workspace, metric, images, options.dense_options, num_threads=threads, progress=progress)
    return tuple(dataclasses.replace(model, dense=dense.get(model.index)) for model in models)
