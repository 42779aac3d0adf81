"""The model stages of a run: COLMAP's models go through them, and those that became metric are written."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from colmap_inertial.core.errors import TimingError
from colmap_inertial.core.facts import Fact, sentences
from colmap_inertial.core.types import Gap, JoinedPart, ScaleEstimate
from colmap_inertial.hooks import JoiningStage, ModelStage, joins_models
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import (
    Model,
    model_format,
    summarize,
    trajectory_from_model,
    transform_model,
    write_model,
)
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.model.rigs import rig_sensors
from colmap_inertial.model.similarities import invert_similarity
from colmap_inertial.run.commands.reporting import write_model_record
from colmap_inertial.run.commands.result import ScaledModel
from colmap_inertial.run.commands.torn_parts import TornParts
from colmap_inertial.run.stages.metric import MetricStage, gravity_in_model, metric_trajectory, write_trajectory
from colmap_inertial.run.steps.session import Session

log = logging.getLogger(__name__)


#: A model between two stages: what the result says of it, and it itself; ``None`` where it was refused.
_Staged = tuple[ScaledModel, Model | None]


@dataclass(eq=False, kw_only=True)
class ModelStageRun:
    """One run of the stages on all models; each model is near the origin on its way, and far from it again at the end.

    Attributes
    ----------
    session, recording, stages
        Of the run.
    folders
        Of COLMAP's models, by number.
    numbered
        Keep these numbers: an existing project has no place for models that it did not have, and its parts go by them.
    """

    session: Session
    recording: Recording
    stages: Sequence[ModelStage]
    folders: Mapping[int, Path]
    numbered: bool = False
    _places: dict[int, OwnPlace] = field(default_factory=dict, init=False)
    _untimed: list[TimingError] = field(default_factory=list, init=False)
    _torn: TornParts = field(init=False)

    def __post_init__(self) -> None:
        self._torn = TornParts(max(self.folders) + 1)

    def run(self, models: Iterable[Model], count: int) -> tuple[list[ScaledModel], tuple[Gap, ...]]:
        """Run the stages on ``count`` models, the largest first; where none joins, one model is in memory at a time.

        Raises
        ------
        TimingError
            Where no model has two timed images.
        """
        joining = next((stage for stage in self.stages if joins_models(stage)), None)
        at = len(self.stages) if joining is None else self.stages.index(joining)
        staged: Iterable[_Staged] = self._run_on_each(self.stages[:at], models, count, torn_apart=joining is not None)
        gaps: tuple[Gap, ...] = ()
        unjoined: dict[int, Model] = {}
        if joining is not None:
            staged = list(staged)
            if self.numbered:
                unjoined = {model.colmap_index: model for _, model in staged if model is not None}
            staged, gaps = self._join(joining, staged)
        results = []
        for result, model in staged:
            if model is None:
                log.info("model %d: refused %s", result.index, "; ".join(sentences(result.scale.reasons)))
                results.append(result)
                continue
            results.append(self._write(result, run_in_turn(self.stages[at + 1 :], model)))
            if self.numbered:
                self._write_other_parts(model, unjoined)
        if len(self._untimed) == count:
            raise self._untimed[0]
        self.session.progress("metric", count, count)
        return results, gaps

    def _run_on_each(
        self, stages: Sequence[ModelStage], models: Iterable[Model], count: int, *, torn_apart: bool
    ) -> Iterator[_Staged]:
        """Each model after the first stages; behind it its parts, where it is torn and something may join them."""
        for done, model in enumerate(models):
            self.session.progress("metric", done, count)
            place = self._places[model.colmap_index] = OwnPlace.of(model.reconstruction)
            # COLMAP's own counts, whatever the stages make of the model
            result = ScaledModel(
                index=model.colmap_index if self.numbered else done,
                colmap_index=model.colmap_index,
                scale=_refuse_scale(Fact("scale-not-estimated")),
                summary=summarize(model.reconstruction),
                sparse=count_from(self.session.workspace.root, self.folders[model.colmap_index]),
                identity=ModelIdentity.of(model.reconstruction),
            )
            if (error := _find_untimed(model)) is not None:
                self._untimed.append(error)
                yield replace(result, scale=_refuse_scale(error.fact)), None
                continue
            model = replace(model, reconstruction=place.enter(model.reconstruction))
            made = run_in_turn(stages, model)
            yield result, made
            for part in self._torn.split(model, made) if torn_apart and not self.numbered else ():
                if _find_untimed(part) is None:
                    self._places[part.colmap_index] = place
                    of_part = replace(result, colmap_index=part.colmap_index, identity=None)
                    yield of_part, run_in_turn(stages, part)

    def _join(self, stage: JoiningStage, staged: Sequence[_Staged]) -> tuple[list[_Staged], tuple[Gap, ...]]:
        """Run a stage on all models at once, the largest first; numbers of models that were joined become free."""
        if len(staged) == 1:
            ((result, alone),) = staged
            return [(result, None if alone is None else stage(alone))], ()
        models = [model for _, model in staged if model is not None]
        if self._torn:
            models.sort(key=lambda model: -int(model.reconstruction.num_reg_images()))
        joined, gaps = stage.join_models(models)
        result_of = {result.colmap_index: result for result, _ in staged}
        left: list[_Staged] = [(result, None) for result, model in staged if model is None]
        for model in self._torn.describe_joined(joined):
            result = result_of[model.colmap_index]
            if model.parts:
                result = replace(result, summary=summarize(model.reconstruction))
            left.append((result, model))
        left.sort(key=lambda one: (-one[0].summary["registered_images"], one[0].colmap_index))
        if not self.numbered:
            left = [(replace(result, index=i), model) for i, (result, model) in enumerate(left)]
        return left, gaps

    def _write(self, result: ScaledModel, model: Model) -> ScaledModel:
        """Write a model that went through all stages to where it stays, with its path."""
        if model.scale is None:
            raise ValueError("the model stages must include one that estimates the scale, such as ... or MetricStage")
        if model.similarity is not None and model.scale.verdict == "refused":
            raise ValueError("the model stages made a model metric whose scale they refused")
        model = replace(model, doubts=self.recording.doubts)  # whatever a user's stage made of them
        assert model.scale is not None
        workspace, imu, place = self.session.workspace, self.recording.imu, self._places[model.colmap_index]
        result = replace(
            result,
            scale=model.scale,
            treatments=model.treatments,
            parts=tuple(
                replace(part, similarity=place.similarity(part.similarity, self._places[part.colmap_index]))
                for part in model.parts
            ),
        )
        # the smoother weighs by them; of a model whose motion a stage solved for, nothing is smoothed
        poses, _ = trajectory_from_model(model.reconstruction, model.timing, covariances=model.motion is None)
        if model.similarity is not None:
            target = workspace.sparse / str(result.index)
            suffix = model_format(workspace.root / result.sparse) or ".bin"
            write_model(place.leave(model.reconstruction), target, place.similarity(model.similarity), suffix=suffix)
            poses, rig = metric_trajectory(poses), rig_sensors(model.reconstruction)
            result = replace(result, sparse_metric=count_from(workspace.root, target), rig=rig)
            if model.scale.calibration is not None and gravity_in_model(model) is not None:
                trajectory = workspace.trajectory(result.index, first=not any(workspace.root.glob("trajectory*.tum")))
                write_trajectory(trajectory, model, poses, imu, place)
                result = replace(result, trajectory=count_from(workspace.root, trajectory))
        keeps = any(isinstance(stage, MetricStage) and stage.keeps_intrinsics for stage in self.stages)
        write_model_record(workspace, result.index, model, poses, imu, keeps_intrinsics=keeps)
        log.info("model %d: %s %s", result.index, model.scale.verdict, "; ".join(sentences(model.scale.reasons)))
        return result

    def _write_other_parts(self, model: Model, unjoined: Mapping[int, Model]) -> None:
        """Write the other parts of a joined model by themselves, in its world, as the stages before left them.

        What a project made from them goes by them.
        """
        place = self._places[model.colmap_index]
        for part in list_other_parts(model):
            before = unjoined[part.colmap_index]
            own = before.reconstruction
            if before.similarity is not None:
                own = transform_model(own, invert_similarity(before.similarity))
            target = self.session.workspace.sparse / str(part.colmap_index)
            similarity = place.similarity(part.similarity, self._places[part.colmap_index])
            suffix = model_format(self.folders[part.colmap_index])
            write_model(place.leave(transform_model(own, part.similarity)), target, similarity, suffix=suffix)


def run_in_turn(stages: Sequence[ModelStage], model: Model) -> Model:
    """Run stages on a model, one after the other."""
    for stage in stages:
        model = stage(model)
    return model


def list_other_parts(model: Model | ScaledModel) -> list[JoinedPart]:
    """The parts of a joined model but the first, whose number it has."""
    return [part for part in model.parts if part.colmap_index != model.colmap_index]


def count_from(root: Path, path: Path) -> Path:
    """A path as it counts from ``root``; one elsewhere as it counts from anywhere."""
    return path.relative_to(root) if path.is_relative_to(root) else path.resolve()


def _find_untimed(model: Model) -> TimingError | None:
    """Why a model has fewer than two timed images; ``None`` where it has more."""
    names, reconstruction = set(model.timing.names), model.reconstruction
    if sum(reconstruction.image(i).name in names for i in reconstruction.reg_image_ids()) >= 2:
        return None
    try:
        trajectory_from_model(reconstruction, model.timing)
    except TimingError as error:
        return error
    return None


def _refuse_scale(reason: Fact) -> ScaleEstimate:
    return ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="none", reasons=(reason,)
    )
