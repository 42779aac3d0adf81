"""COLMAP's models through the model stages, to their final places; measured and made dense where that is asked for."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError, TimingError
from colmap_inertial.core.facts import Fact, as_fact, sentences
from colmap_inertial.core.options import DenseOptions
from colmap_inertial.core.types import Gap, JoinedPart, ScaleEstimate
from colmap_inertial.hooks import JoiningStage, ModelStage, joins_models
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import (
    Model,
    downgraded,
    find_models,
    model_format,
    num_registered,
    read_model,
    summarize,
    trajectory_from_model,
    transformed,
    write_model,
)
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.model.rigs import rig_sensors
from colmap_inertial.model.similarities import undoing
from colmap_inertial.run.commands.dense_steps import run_dense
from colmap_inertial.run.commands.project_output import remove_stale_dense
from colmap_inertial.run.commands.reporting import write_model_record
from colmap_inertial.run.commands.result import Fragment, ModelResult, ScaledModel
from colmap_inertial.run.commands.torn_parts import TornParts
from colmap_inertial.run.stages.metric import gravity_in_model, metric_trajectory, write_trajectory
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


#: A model that went through the first stages, ``None`` where it was refused before, and what is known of it.
_Begun: TypeAlias = "tuple[ScaledModel, Model | None]"


@dataclass(frozen=True, kw_only=True)
class _Made:
    """Results of the model stages for all models."""

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
    rectified, numbered = submodels.rectified, submodels.numbered
    folders = find_models(workspace.colmap_sparse) if submodels.folders is None else submodels.folders
    record = workspace.stamps / "models.json"

    def work(partial: Sequence[Path]) -> None:
        for path in (workspace.sparse, *workspace.trajectories()):
            remove(path)
        for path in workspace.report_data.glob("model_*.json"):
            remove(path)
        kept, left_out = _select_models(folders, keep=fragments)
        read_in = (
            Model(
                reconstruction=submodels.read(folders[number]),
                colmap_index=number,
                timing=recording.timing,
                rectified=rectified,
                doubts=tuple(map(as_fact, recording.doubts)),
            )
            for number in kept
        )
        place_of = {number: number if numbered else place for place, number in enumerate(kept)}
        made, gaps = _run_stages(session, recording, stages, read_in, place_of, folders, numbered=numbered)
        small = [replace(fragment, sparse=_within(workspace.root, fragment.sparse)) for fragment in left_out]
        write_record(partial[0], _Made(models=tuple(made), fragments=tuple(small), gaps=gaps))

    def beside() -> Iterable[Path]:
        return [workspace.sparse, *workspace.trajectories(), *workspace.report_data.glob("model_*.json")]

    depends = {
        "recording": {name: getattr(recording, name) for name in ("imu", "timing", "doubts")},
        "stages": stages,
        "rectified": rectified,
        "fragments": fragments,
        "numbered": numbered,
        "found": [] if submodels.after else [fingerprint(folder) for folder in folders.values()],
    }
    session.runner.run("metric", depends, [record], work, after=submodels.after, beside=beside)
    record_made = read_record(record, _Made)
    models = tuple(
        ModelResult(**{f.name: getattr(fragment, f.name) for f in fields(fragment)}).within(workspace.root)
        for fragment in record_made.models
    )
    remove_stale_dense(
        workspace, {fragment.index: fragment.sparse_metric for fragment in models if fragment.sparse_metric is not None}
    )
    return (
        models,
        tuple(replace(fragment, sparse=workspace.root / fragment.sparse) for fragment in record_made.fragments),
        record_made.gaps,
    )


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


def _run_stages(
    session: Session,
    recording: Recording,
    stages: Sequence[ModelStage],
    models: Iterator[Model],
    place_of: Mapping[int, int],
    folders: Mapping[int, Path],
    *,
    numbered: bool,
) -> tuple[list[ScaledModel], tuple[Gap, ...]]:
    """Run the stages on COLMAP's models; without a stage that joins them, one is in memory at a time.

    Raises
    ------
    TimingError
        Where no model has two timed images.
    """
    at, joining = next(((i, s) for i, s in enumerate(stages) if joins_models(s)), (len(stages), None))
    torn = TornParts(max(folders) + 1)
    untimed: list[TimingError] = []
    places: dict[int, OwnPlace] = {}

    def begun() -> Iterator[_Begun]:
        for done, model in enumerate(models):
            session.progress("metric", done, len(place_of))
            place = places[model.colmap_index] = OwnPlace.of(model.reconstruction)
            # COLMAP's own counts, whatever the stages make of the model
            scaled = ScaledModel(
                index=place_of[model.colmap_index],
                colmap_index=model.colmap_index,
                scale=_refused(Fact("scale-not-estimated")),
                summary=summarize(model.reconstruction),
                sparse=_within(session.workspace.root, folders[model.colmap_index]),
                identity=ModelIdentity.of(model.reconstruction),
            )
            if (reason := _too_few_timed(model)) is None:
                model = replace(model, reconstruction=place.enter(model.reconstruction))
                made = _after(stages[:at], model)
                yield scaled, made
                # an existing project has no place for models that it did not have
                for part in torn.split(model, made) if joining is not None and not numbered else ():
                    if _too_few_timed(part) is None:
                        places[part.colmap_index] = place
                        yield replace(scaled, colmap_index=part.colmap_index, identity=None), _after(stages[:at], part)
            else:
                untimed.append(reason)
                yield replace(scaled, scale=_refused(reason.fact)), None

    going: Iterable[_Begun] = begun()
    gaps: tuple[Gap, ...] = ()
    staged: dict[int, Model] = {}
    if joining is not None:
        going = list(going)
        if numbered:
            staged = {model.colmap_index: model for _, model in going if model is not None}
        if len(going) > 1:
            going, gaps = _joined(joining, going, torn, numbered=numbered)
        else:
            going = [(scaled, None if model is None else joining(model)) for scaled, model in going]
    made: list[ScaledModel] = []
    for scaled, model in going:
        if model is None:
            log.info("model %d: refused %s", scaled.index, "; ".join(sentences(scaled.scale.reasons)))
            made.append(scaled)
            continue
        made.append(_placed(session, recording, scaled, _after(stages[at + 1 :], model), places))
        if numbered:
            _write_parts(session, model, staged, folders, places)
    if len(untimed) == len(place_of):
        raise untimed[0]
    session.progress("metric", len(place_of), len(place_of))
    return made, gaps


def _joined(
    joining: JoiningStage, begun: Sequence[_Begun], torn: TornParts, *, numbered: bool
) -> tuple[list[_Begun], tuple[Gap, ...]]:
    """Run a stage on all models at once, the largest first; numbers of models that were joined become free."""
    of_number = {scaled.colmap_index: scaled for scaled, _ in begun}
    going = [model for _, model in begun if model is not None]
    if torn:
        going.sort(key=lambda model: -int(model.reconstruction.num_reg_images()))
    models, gaps = joining.join_models(going)
    left: list[_Begun] = [(scaled, None) for scaled, model in begun if model is None]
    for model in torn.describe_joined(models):
        scaled = of_number[model.colmap_index]
        if model.parts:
            scaled = replace(scaled, summary=summarize(model.reconstruction))
        left.append((scaled, model))
    left.sort(key=lambda each: (-each[0].summary["registered_images"], each[0].colmap_index))
    return [(scaled if numbered else replace(scaled, index=i), model) for i, (scaled, model) in enumerate(left)], gaps


def _write_parts(
    session: Session,
    model: Model,
    staged: Mapping[int, Model],
    folders: Mapping[int, Path],
    places: Mapping[int, OwnPlace],
) -> None:
    """The other parts of a joined model by themselves, in its world: what a project made from them goes by them.

    As the stages before the joining left them.
    """
    for part in _others(model):
        before = staged[part.colmap_index]
        own = before.reconstruction
        if before.similarity is not None:
            own = transformed(own, undoing(before.similarity))
        target = session.workspace.sparse / str(part.colmap_index)
        place = places[model.colmap_index]
        moved = place.leave(transformed(own, part.similarity))
        similarity = place.similarity(part.similarity, places[part.colmap_index])
        write_model(moved, target, similarity, suffix=model_format(folders[part.colmap_index]))


def _others(model: Model | ScaledModel) -> list[JoinedPart]:
    """The parts of a joined model but the first, whose number it has."""
    return [part for part in model.parts if part.colmap_index != model.colmap_index]


def _after(stages: Sequence[ModelStage], model: Model) -> Model:
    """Run stages on a model, one after the other."""
    for stage in stages:
        model = stage(model)
    return model


def _placed(
    session: Session, recording: Recording, scaled: ScaledModel, model: Model, places: Mapping[int, OwnPlace]
) -> ScaledModel:
    """A model that went through the stages, written to where it stays, with its path; far from the origin again."""
    workspace, place = session.workspace, places[model.colmap_index]
    if model.scale is None:
        raise ValueError("the model stages must include one that estimates the scale, such as ... or MetricStage")
    scale, similarity = downgraded(model.scale, recording.doubts), model.similarity
    if similarity is not None and scale.verdict == "refused":
        raise ValueError("the model stages made a model metric whose scale they refused")
    if similarity is not None and scale.verdict != model.scale.verdict:
        similarity = replace(similarity, provenance=f"{similarity.provenance}; {scale.verdict}: {scale.reasons[0]}")
    model = replace(model, scale=scale, similarity=similarity)
    parts = tuple(
        replace(part, similarity=place.similarity(part.similarity, places[part.colmap_index])) for part in model.parts
    )
    scaled = replace(scaled, scale=scale, treatments=model.treatments, parts=parts)
    # the smoother weighs by them; of a model whose motion a stage solved for, nothing is smoothed
    poses, _ = trajectory_from_model(model.reconstruction, model.timing, covariances=model.motion is None)
    if model.similarity is not None:
        target = workspace.sparse / str(scaled.index)
        suffix = model_format(workspace.root / scaled.sparse) or ".bin"
        write_model(place.leave(model.reconstruction), target, place.similarity(model.similarity), suffix=suffix)
        poses = metric_trajectory(poses)
        rig = rig_sensors(model.reconstruction)
        scaled = replace(scaled, sparse_metric=_within(workspace.root, target), rig=rig)
        if scale.calibration is not None and gravity_in_model(model) is not None:
            trajectory = workspace.trajectory(scaled.index, first=not any(workspace.root.glob("trajectory*.tum")))
            write_trajectory(trajectory, model, poses, recording.imu, place)
            scaled = replace(scaled, trajectory=_within(workspace.root, trajectory))
    write_model_record(workspace, scaled.index, model, poses, recording.imu)
    log.info("model %d: %s %s", scaled.index, scale.verdict, "; ".join(sentences(scale.reasons)))
    return scaled


def _within(root: Path, path: Path) -> Path:
    """A path as it counts from ``root``; one elsewhere as it counts from anywhere."""
    return path.relative_to(root) if path.is_relative_to(root) else path.resolve()


def _too_few_timed(model: Model) -> TimingError | None:
    names, reconstruction = set(model.timing.names), model.reconstruction
    if sum(reconstruction.image(i).name in names for i in reconstruction.reg_image_ids()) >= 2:
        return None
    try:
        trajectory_from_model(reconstruction, model.timing)
    except TimingError as error:
        return error
    return None


def _refused(reason: Fact) -> ScaleEstimate:
    return ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="none", reasons=(reason,)
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Checked:
    """Measurement of the target in a model, or the error, in its parts."""

    found: Validation | None = None
    unobservable: str | None = None
    why_not: Fact | None = None

    def outcome(self) -> Validation | TargetNotFoundError | NotObservableError:
        if self.found is not None:
            return self.found
        assert self.why_not is not None
        if self.unobservable is not None:
            return NotObservableError(self.unobservable, self.why_not)
        return TargetNotFoundError(self.why_not)


def run_validation(
    session: Session, models: Sequence[ModelResult], target: Target | None, images: Path | None
) -> tuple[ModelResult, ...]:
    """Measure the target in the metric models; one that cannot be measured does not undo its model."""
    if target is None or images is None:
        remove(session.workspace.validation)
        return tuple(models)
    checked = []
    for stale in session.workspace.validation.glob("[0-9]*"):
        if stale.name not in {str(model.index) for model in models}:
            remove(stale)
    for model in models:
        pictures = session.workspace.validation / str(model.index)
        if model.sparse_metric is None:
            remove(pictures)
            checked.append(model)
            continue
        metric = model.sparse_metric

        def work(partial: Sequence[Path], metric: Path = metric, pictures: Path = pictures) -> None:
            remove(pictures)
            try:
                validation = validate_model(
                    metric, images, target, progress=lambda done, total: session.progress("validation", done, total)
                )
            except TargetNotFoundError as error:
                write_record(partial[0], _Checked(why_not=error.fact))
            except NotObservableError as error:
                write_record(partial[0], _Checked(unobservable=error.quantity, why_not=error.fact))
            else:
                write_overlays(validation, images, pictures)
                write_record(partial[0], _Checked(found=validation))

        record = session.workspace.stamps / f"validated_{model.index}.json"
        after = ["metric", *session.runner.of("frames", "images")]
        depends = {"target": target.spec, "images": [] if len(after) > 1 else fingerprint(images)}
        step = f"validation_{model.index}"
        session.runner.run(step, depends, [record], work, after=after, beside=partial(list, [pictures]))
        check = read_record(record, _Checked).outcome()
        outcome = f"scale error {check.scale_error_pct:+.3f} %" if isinstance(check, Validation) else str(check)
        log.info("model %d: %s against %s", model.index, outcome, target.spec)
        if isinstance(check, Validation):
            model = replace(model, scale=doubt_by_target(model.scale, check))
        checked.append(replace(model, validation=check))
    return tuple(checked)


def run_dense_models(
    session: Session, models: Sequence[ModelResult], images: Path, options: DenseOptions
) -> tuple[ModelResult, ...]:
    """The models with their dense reconstructions, where they are metric."""
    metric = [model.index for model in models if model.sparse_metric is not None]
    dense = run_dense(session, metric, images, options)
    return tuple(replace(model, dense=dense.get(model.index)) for model in models)
