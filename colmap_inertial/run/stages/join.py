"""The model stage that brings sub-models of one recording into one, by what the IMU felt between them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from colmap_inertial.core.errors import NotObservableError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import JoinOptions
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import Gap
from colmap_inertial.inertial.join.grouping import join_submodels
from colmap_inertial.inertial.join.joined_model import join_models
from colmap_inertial.inertial.join.placement import FittedSubmodel
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.model import Model, trajectory_from_model
from colmap_inertial.model.rigs import has_rigs
from colmap_inertial.model.submodels.matches import PlacedImages, place_images
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.joined_path import find_joined_covs
from colmap_inertial.run.stages.metric import InertialStage, metric_trajectory

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinStage(InertialStage):
    """Joins metric models of one recording; those whose relative pose is not known well enough stay apart.

    Comes after the scale. It takes all models at once (:meth:`join_models`); one alone stays as it is. Each joined
    model is in the world of its largest part, gravity and scale as all parts together have them.

    Attributes
    ----------
    limits
        Up to where gaps are closed.
    """

    limits: JoinOptions = field(default_factory=JoinOptions)

    @classmethod
    def for_run(cls, inputs: StageInputs) -> JoinStage | None:
        """The stage of a run, where models are to be joined."""
        if inputs.options.join == "off":
            return None
        return cls(**cls.fields_for(inputs), limits=inputs.options.join_options)

    def __call__(self, model: Model, /) -> Model:
        """One model by itself: it stays as it is."""
        return model

    def join_models(self, models: Sequence[Model], /) -> tuple[tuple[Model, ...], tuple[Gap, ...]]:
        """Join what can be joined; the joined models in the places of their largest parts.

        Parameters
        ----------
        models
            The largest one first, each through the stages before.

        Raises
        ------
        FormatError
            Where the database cannot be read.
        """
        if len(models) < 2:
            return tuple(models), ()
        parts: list[FittedSubmodel] = []
        of_part: list[Model] = []
        why_not: dict[int, Fact] = {}
        for model in models:
            try:
                parts.append(self.part(model))
            except (NotObservableError, TimingError) as error:
                why_not[model.colmap_index] = Fact("model-apart", why=error.fact)
            else:
                of_part.append(model)
        placed = self._found(of_part)
        with one_blas_thread():
            joined = join_submodels(parts, self.imu, self.limits, placed)
        between = joined.gaps
        if self._lacks_database():
            # the same stage with its matches would have joined otherwise: the result has to say so
            log.warning("%s is gone: matches between models do not count", self.database)
            between = tuple(replace(gap, reason=Fact("gap-without-database", reason=gap.reason)) for gap in between)
        spans = _spans(models)
        ends_s = {number: end_s for _, end_s, number in spans}
        gaps = sorted([*between, *_beside(spans, why_not)], key=lambda gap: ends_s[gap.first])
        for gap in gaps:
            log.info("models %d and %d, %.2f s: %s", gap.first, gap.second, gap.seconds, gap.reason)
        made: dict[int, Model] = {}
        gone: set[int] = set()
        for group in joined.groups:
            whole = join_models(of_part, parts, group, placed, world=self.world)
            with one_blas_thread():
                whole = replace(whole, joined_covs=find_joined_covs(whole, of_part, parts, group))
            made[whole.colmap_index] = whole
            gone |= {of_part[k].colmap_index for k in group.members[1:]}
        kept = [made.get(m.colmap_index, m) for m in models if m.colmap_index not in gone]
        return tuple(kept), tuple(gaps)

    def part(self, model: Model) -> FittedSubmodel:
        """A model as a part.

        Raises
        ------
        NotObservableError
            Where it cannot be one.
        """
        scale, reconstruction = model.scale, model.reconstruction
        if scale is None or model.similarity is None or scale.verdict == "refused":
            raise NotObservableError("place", Fact("join-scale-refused", colmap_index=model.colmap_index))
        if scale.method != "joint":
            raise NotObservableError("place", Fact("join-other-method"))
        if has_rigs(reconstruction):
            raise NotObservableError("place", Fact("join-rig", colmap_index=model.colmap_index))
        trajectory = metric_trajectory(trajectory_from_model(reconstruction, model.timing)[0])
        path = FittedPath.of(trajectory, self.imu, self.calibration_of(model), self.options)
        cameras = _cameras(reconstruction)
        return FittedSubmodel(number=model.colmap_index, trajectory=trajectory, path=path, cameras=cameras)

    def _lacks_database(self) -> bool:
        return self.database is not None and not self.database.is_file()

    def _found(self, models: Sequence[Model]) -> list[PlacedImages]:
        """Images of one model that matches place in another."""
        if self.database is None or self._lacks_database():
            return []
        numbers = [model.colmap_index for model in models]
        return place_images(self.database, [model.reconstruction for model in models], numbers)


def _cameras(reconstruction: pycolmap.Reconstruction) -> frozenset[str]:
    """Names for a model's cameras: their numbers; where nearly each image has one of its own, the images' folders."""
    images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
    numbers = {image.camera_id for image in images}
    if len(numbers) > max(1, len(images) // 2):
        return frozenset(image.name.rpartition("/")[0] + "/" for image in images)
    return frozenset(map(str, numbers))


def _spans(models: Sequence[Model]) -> list[tuple[float, float, int]]:
    """First and last image (camera clock) and COLMAP's number of each model, in order of time."""
    spans = []
    for model in models:
        times = dict(zip(model.timing.names, model.timing.pose_t_s().tolist(), strict=True))
        names = [model.reconstruction.image(i).name for i in model.reconstruction.reg_image_ids()]
        t_s = [times[name] for name in names if name in times]
        if t_s:
            spans.append((min(t_s), max(t_s), model.colmap_index))
    return sorted(spans)


def _beside(spans: Sequence[tuple[float, float, int]], why_not: dict[int, Fact]) -> list[Gap]:
    """Gaps next to models that cannot be joined to anything."""
    out = []
    for (_, end_s, first), (begin_s, _, second) in pairwise(spans):
        reason = why_not.get(first) or why_not.get(second)
        if reason is not None:
            out.append(Gap(first=first, second=second, seconds=begin_s - end_s, joined=False, reason=reason))
    return out
