"""Steps on COLMAP's models: made metric by the model stages, measured by a target, made dense."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError
from colmap_inertial.core.options import DenseOptions
from colmap_inertial.core.types import Gap
from colmap_inertial.hooks import ModelStage
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import (
    Model,
    find_models,
    num_registered,
    read_model,
)
from colmap_inertial.run.commands.dense_steps import run_dense
from colmap_inertial.run.commands.model_stages import ModelStageRun, count_from
from colmap_inertial.run.commands.outcome import Outcome
from colmap_inertial.run.commands.project_output import remove_stale_dense
from colmap_inertial.run.commands.result import Fragment, ModelResult, ScaledModel
from colmap_inertial.run.steps.session import Session
from colmap_inertial.validate import Target, Validation, validate_model, write_overlays
from colmap_inertial.validate.agreement import doubt_by_target

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FragmentLimits:
    """Limits for models that are too small to use."""

    #: COLMAP's models of fewer images, or of a smaller share of those of its largest one, are fragments.
    fewest_images: int = 5
    least_share: float = 0.01


_LIMITS = FragmentLimits()


@dataclass(frozen=True, kw_only=True)
class _Scaled:
    """Record of the step that makes models metric; its paths count from the output folder."""

    models: tuple[ScaledModel, ...]
    fragments: tuple[Fragment, ...]
    gaps: tuple[Gap, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Submodels:
    """COLMAP's models of a recording.

    Attributes
    ----------
    folders
        By COLMAP's number, where they are not those of ``colmap/sparse/``.
    rectified
        Whether they were mapped from keypoints without the rolling shutter.
    numbered
        Keep COLMAP's numbers, as an existing project's other parts go by them.
    after
        The step that made them, where one did.
    read
        Reads one.
    """

    folders: Mapping[int, Path] | None = None
    rectified: bool = False
    numbered: bool = False
    after: Sequence[str] = ("mapping",)
    read: Callable[[Path], pycolmap.Reconstruction] = read_model


def run_models(
    session: Session,
    recording: Recording,
    stages: Sequence[ModelStage],
    submodels: Submodels | None = None,
    *,
    fragments: bool = False,
) -> tuple[tuple[ModelResult, ...], tuple[Fragment, ...], tuple[Gap, ...]]:
    """Every sub-model through the model stages, then to its final place: the largest first, fragments left out.

    One with fewer than two timed images is refused, and the others go on. A stage that joins models takes all of them
    at once; any other one after the other. Beside models and fragments come the gaps between models that it found.

    Parameters
    ----------
    session, recording, stages
        Of the run.
    submodels
        What COLMAP made; those of ``colmap/sparse/`` by default.
    fragments
        Treat fragments as models.

    Raises
    ------
    TimingError
        Where no sub-model has two timed images.
    """
    workspace, submodels = session.workspace, submodels or Submodels()
    folders = find_models(workspace.colmap_sparse) if submodels.folders is None else submodels.folders
    record = workspace.stamps / "models.json"

    def list_written() -> list[Path]:
        return [workspace.sparse, *workspace.trajectories(), *workspace.report_data.glob("model_*.json")]

    def work(partial: Sequence[Path]) -> None:
        for path in list_written():
            remove(path)
        kept, left_out = _select_models(folders, keep=fragments)
        models = (
            Model(
                reconstruction=submodels.read(folders[number]),
                colmap_index=number,
                timing=recording.timing,
                rectified=submodels.rectified,
                doubts=recording.doubts,
            )
            for number in kept
        )
        stage_run = ModelStageRun(
            session=session, recording=recording, stages=stages, folders=folders, numbered=submodels.numbered
        )
        scaled, gaps = stage_run.run(models, len(kept))
        small = [replace(fragment, sparse=count_from(workspace.root, fragment.sparse)) for fragment in left_out]
        write_record(partial[0], _Scaled(models=tuple(scaled), fragments=tuple(small), gaps=gaps))

    depends = {
        "recording": {name: getattr(recording, name) for name in ("imu", "timing", "doubts")},
        "stages": stages,
        "rectified": submodels.rectified,
        "fragments": fragments,
        "numbered": submodels.numbered,
        "found": [] if submodels.after else [fingerprint(folder) for folder in folders.values()],
    }
    session.runner.run("metric", depends, [record], work, after=submodels.after, beside=list_written)
    scaled = read_record(record, _Scaled)
    models = tuple(ModelResult.of(model, workspace.root) for model in scaled.models)
    remove_stale_dense(workspace, {model.index: model.sparse_metric for model in models if model.sparse_metric})
    small = tuple(replace(fragment, sparse=workspace.root / fragment.sparse) for fragment in scaled.fragments)
    return models, small, scaled.gaps


def _select_models(folders: Mapping[int, Path], *, keep: bool) -> tuple[list[int], list[Fragment]]:
    """COLMAP's numbers of the models to continue with, the largest first; and what is too small."""
    sizes = {number: num_registered(folder) for number, folder in folders.items()}
    order = sorted(folders, key=lambda number: (-sizes[number], number))
    least = 0.0 if keep else max(_LIMITS.fewest_images, _LIMITS.least_share * sizes[order[0]])
    kept = [number for number in order if number == order[0] or sizes[number] >= least]
    left_out = [Fragment(colmap_index=n, registered_images=sizes[n], sparse=folders[n]) for n in order if n not in kept]
    for fragment in left_out:
        log.info("COLMAP's model %d is a fragment of %d images", fragment.colmap_index, fragment.registered_images)
    return kept, left_out


def run_validation(
    session: Session, models: Sequence[ModelResult], target: Target | None, images: Path | None
) -> tuple[ModelResult, ...]:
    """Measure the target in the metric models; one that cannot be measured does not undo its model."""
    pictures = session.workspace.validation
    if target is None or images is None:
        session.runner.discard(pictures)
        return tuple(models)
    metric = {str(model.index) for model in models if model.sparse_metric is not None}
    session.runner.discard(*(folder for folder in pictures.glob("[0-9]*") if folder.name not in metric))
    return tuple(_validate(session, model, target, images) for model in models)


def _validate(session: Session, model: ModelResult, target: Target, images: Path) -> ModelResult:
    metric, pictures = model.sparse_metric, session.workspace.validation / str(model.index)
    if metric is None:
        return model

    def work(partial: Sequence[Path]) -> None:
        remove(pictures)
        try:
            validation = validate_model(
                metric, images, target, progress=lambda done, total: session.progress("validation", done, total)
            )
        except (TargetNotFoundError, NotObservableError) as error:
            write_record(partial[0], Outcome[Validation].of_error(error))
        else:
            write_overlays(validation, images, pictures)
            write_record(partial[0], Outcome(found=validation))

    record = session.workspace.stamps / f"validated_{model.index}.json"
    after = ["metric", *session.runner.list_own("frames", "images")]
    depends = {"target": target.spec, "images": [] if len(after) > 1 else fingerprint(images)}
    step = f"validation_{model.index}"
    session.runner.run(step, depends, [record], work, after=after, beside=lambda: [pictures])
    outcome = read_record(record, Outcome[Validation]).result()
    words = f"scale error {outcome.scale_error_pct:+.3f} %" if isinstance(outcome, Validation) else str(outcome)
    log.info("model %d: %s against %s", model.index, words, target.spec)
    scale = doubt_by_target(model.scale, outcome) if isinstance(outcome, Validation) else model.scale
    return replace(model, scale=scale, validation=outcome)


def run_dense_models(
    session: Session, models: Sequence[ModelResult], images: Path, options: DenseOptions
) -> tuple[ModelResult, ...]:
    """The models with their dense reconstructions, where they are metric."""
    metric = [model.index for model in models if model.sparse_metric is not None]
    dense = run_dense(session, metric, images, options)
    return tuple(replace(model, dense=dense.get(model.index)) for model in models)
