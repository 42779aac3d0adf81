"""The model stage that brings sub-models of one recording into one, by what the IMU felt between them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError, TimingError
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_rotate,
    rotation_between,
    skew,
)
from colmap_inertial.core.options import JoinOptions
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    DOWN_IN_WORLD,
    Gap,
    JoinedPart,
    ScaleEstimate,
    Similarity,
    Treatment,
)
from colmap_inertial.inertial.join.judge import Together, join_parts, relative_cov, worst
from colmap_inertial.inertial.join.solve import Placed
from colmap_inertial.inertial.join.values import Found, Part, Placement
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, half_width, verdict_of
from colmap_inertial.model import Model, has_rigs, trajectory_from_model, transformed
from colmap_inertial.model.merging import merged
from colmap_inertial.pipeline.stages.across import images_in_others, one_points
from colmap_inertial.pipeline.stages.inertial import InertialStage
from colmap_inertial.pipeline.stages.inputs import StageInputs
from colmap_inertial.pipeline.stages.metric import metric_trajectory

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

_NO_MATCHES = "without matches between the two: COLMAP's database is gone"


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinStage(InertialStage):
    """Joins metric models of one recording; those that nothing places surely enough stay apart.

    Comes after the scale. It takes all models at once (:meth:`join_models`); one alone stays as it is. Each joined
    model is in the world of its largest part, gravity and scale as all parts together have them.

    Attributes
    ----------
    limits
        Up to where gaps are closed.
    database
        COLMAP's, of the models: matches between images of two of them tie these, too.
    """

    limits: JoinOptions = field(default_factory=JoinOptions)
    #: a run with other matches has other models
    database: Path | None = field(default=None, compare=False)

    @classmethod
    def for_run(cls, inputs: StageInputs) -> JoinStage | None:
        """The stage of a run, where models are to be joined."""
        if inputs.options.join == "off":
            return None
        return cls(**cls.fields_for(inputs), limits=inputs.options.join_options, database=inputs.database)

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
        parts: list[Part] = []
        of_part: list[Model] = []
        why_not: dict[int, str] = {}
        for model in models:
            try:
                parts.append(self.part(model))
            except (NotObservableError, TimingError) as error:
                hint = error.hint if isinstance(error, NotObservableError) else str(error)
                why_not[model.colmap_index] = hint
            else:
                of_part.append(model)
        found = self._found(of_part)
        with one_blas_thread():
            joined = join_parts(parts, self.imu, self.limits, found)
        between = joined.gaps
        if self._lacks_database():
            # the same stage with its matches would have joined otherwise: the result has to say so
            log.warning("%s is gone: matches between models do not count", self.database)
            between = tuple(replace(gap, reason=f"{gap.reason} ({_NO_MATCHES})") for gap in between)
        spans = _spans(models)
        ends_s = {number: end_s for _, end_s, number in spans}
        gaps = sorted([*between, *_beside(spans, why_not)], key=lambda gap: ends_s[gap.first])
        for gap in gaps:
            log.info("models %d and %d, %.2f s: %s", gap.first, gap.second, gap.seconds, gap.reason)
        made: dict[int, Model] = {}
        gone: set[int] = set()
        for group in joined.groups:
            members = [of_part[k] for k in group.parts]
            whole = self._whole(members, [parts[k] for k in group.parts], group, found)
            made[whole.colmap_index] = whole
            gone |= {model.colmap_index for model in members[1:]}
        kept = [made.get(m.colmap_index, m) for m in models if m.colmap_index not in gone]
        return tuple(kept), tuple(gaps)

    def part(self, model: Model) -> Part:
        """A model as a part.

        Raises
        ------
        NotObservableError
            Where it cannot be one.
        """
        scale, reconstruction = model.scale, model.reconstruction
        if scale is None or model.similarity is None or scale.verdict == "refused":
            raise NotObservableError("place", f"the scale of model {model.colmap_index} was refused")
        if scale.method != "joint":
            raise NotObservableError("place", "scales of the joint method alone say how the models moved at their ends")
        if has_rigs(reconstruction):
            raise NotObservableError("place", f"the cameras of model {model.colmap_index} are a rig")
        trajectory = metric_trajectory(trajectory_from_model(reconstruction, model.timing)[0])
        path = FittedPath.of(trajectory, self.imu, self.calibration_of(model), self.options)
        return Part(number=model.colmap_index, trajectory=trajectory, path=path, cameras=_cameras(reconstruction))

    def _lacks_database(self) -> bool:
        return self.database is not None and not self.database.is_file()

    def _found(self, models: Sequence[Model]) -> list[Found]:
        """Images of one model that matches place in another."""
        if self.database is None or self._lacks_database():
            return []
        numbers = [model.colmap_index for model in models]
        return images_in_others(self.database, [model.reconstruction for model in models], numbers)

    def _whole(self, members: Sequence[Model], parts: Sequence[Part], group: Together, found: Sequence[Found]) -> Model:
        """One model of several, in the world of the first."""
        first, placed = members[0], group.placed
        assert first.scale is not None and first.similarity is not None
        up = matrix_from_quat(rotation_between(placed.gravity_m_s2, DOWN_IN_WORLD[self.world]))
        # the first part's origin stays where it is
        origin = parts[0].path.origin
        pieces, placements = [], []
        for k, (model, placement) in enumerate(zip(members, placed.placements, strict=True)):
            assert model.similarity is not None
            rotation = up @ placement.rotation
            shift = up @ placement.translation_m + origin - placement.scale * rotation @ placement.origin
            moved = Similarity(
                scale=placement.scale,
                rotation_xyzw=quat_from_matrix(rotation),
                translation_m=shift,
                cov=np.zeros((7, 7)),
            )
            pieces.append(transformed(model.reconstruction, moved))
            if k == 0:
                # its own up and scale are as uncertain as before, at most
                cov = _with_scale(first.similarity.cov, _sigma_log(first, parts[0], placed, 0))
            else:
                own = placed.inflation * placed.cov[7 * k : 7 * k + 7, 7 * k : 7 * k + 7]
                cov = _similarity_cov(own, up, placement)
            placements.append(_after(moved, model.similarity, cov))
        placements[1:] = [
            _of_world(one, _left_of_scale(model, part), placements[0].cov[1:4, 1:4])
            for one, model, part in zip(placements[1:], members[1:], parts[1:], strict=True)
        ]
        about = [_part_of(model, parts, group, k, placements[k]) for k, model in enumerate(members)]
        numbers = ", ".join(str(model.colmap_index) for model in members)
        reason = f"joined of COLMAP's models {numbers}, {sum(part.images for part in about)} images"
        down = float(np.linalg.norm(placed.gravity_m_s2)) * DOWN_IN_WORLD[self.world]
        scale = _scale_of(members, about, down)
        done = Treatment(stage="join", reason=reason, action="joined", values={"parts": len(members)})
        reconstruction = merged(pieces, _agreeing(parts, group))
        before = {model.colmap_index: model.reconstruction for model in members}
        one = one_points(reconstruction, before, [each for each in found if _used(each, group)])
        log.info("%s: %d points of two models are one", reason, one)
        return replace(
            first,
            reconstruction=reconstruction,
            scale=replace(scale, notes=(*scale.notes, f"the model was {reason}")),
            similarity=replace(placements[0], provenance=f"{first.similarity.provenance}; {reason}"),
            treatments=(*first.treatments, done),
            observed_px={name: xy for model in reversed(members) for name, xy in model.observed_px.items()},
            parts=tuple(about),
        )


def _cameras(reconstruction: pycolmap.Reconstruction) -> frozenset[str]:
    """Names for a model's cameras: their numbers; where nearly each image has one of its own, the images' folders."""
    images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
    numbers = {image.camera_id for image in images}
    if len(numbers) > max(1, len(images) // 2):
        return frozenset(image.name.rpartition("/")[0] + "/" for image in images)
    return frozenset(map(str, numbers))


def _used(found: Found, group: Together) -> bool:
    """Whether a pair's matches helped to place it."""
    return bool({(found.first, found.second), (found.second, found.first)} & group.matched)


def _agreeing(parts: Sequence[Part], group: Together) -> dict[tuple[int, int], frozenset[str]]:
    """By places of two parts: names of images whose poses agree."""
    return {
        (one.first, one.second): frozenset(parts[one.first].trajectory.names[i] for i in one.in_first)
        for one in group.shared
    }


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


def _beside(spans: Sequence[tuple[float, float, int]], why_not: dict[int, str]) -> list[Gap]:
    """Gaps next to models that cannot be joined to anything."""
    out = []
    for (_, end_s, first), (begin_s, _, second) in pairwise(spans):
        reason = why_not.get(first) or why_not.get(second)
        if reason is not None:
            out.append(Gap(first=first, second=second, seconds=begin_s - end_s, joined=False, reason=reason))
    return out


def _similarity_cov(cov: Array, up: Array, placement: Placement) -> Array:
    """(7, 7) covariance of log scale, rotation and translation, now of the world's origin, not the part's."""
    by = np.zeros((7, 7))
    arm = -placement.scale * up @ placement.rotation @ placement.origin
    by[0, 0] = 1.0
    by[1:4, 1:4] = by[4:, 4:] = up
    by[4:, 0] = arm
    by[4:, 1:4] = -skew(arm) @ up
    return np.asarray(by @ cov @ by.T)


def _with_scale(cov: Array, sigma_log: float) -> Array:
    """A similarity's covariance with another standard deviation of its scale."""
    before = float(cov[0, 0]) ** 0.5
    by = np.eye(7)
    by[0, 0] = min(1.0, sigma_log / before) if before > 0 else 1.0
    return np.asarray(by @ cov @ by.T)


def _after(moved: Similarity, before: Similarity, cov: Array) -> Similarity:
    """One similarity after the other, with this covariance."""
    rotation = matrix_from_quat(moved.rotation_xyzw) @ matrix_from_quat(before.rotation_xyzw)
    shift = moved.scale * quat_rotate(moved.rotation_xyzw, before.translation_m) + moved.translation_m
    return Similarity(
        scale=moved.scale * before.scale,
        rotation_xyzw=quat_from_matrix(rotation),
        translation_m=shift,
        cov=0.5 * (cov + cov.T),
        provenance=before.provenance,
    )


def _of_world(similarity: Similarity, scale_variance: float, cov_of_up: Array) -> Similarity:
    """A part's similarity with what is not known of the world itself: a length's size, and where up is."""
    by = np.zeros((7, 4))
    # both about the world's origin
    by[0, 0], by[4:, 0] = 1.0, similarity.translation_m
    by[1:4, 1:], by[4:, 1:] = np.eye(3), -skew(similarity.translation_m)
    cov = np.zeros((4, 4))
    cov[0, 0], cov[1:, 1:] = scale_variance, cov_of_up
    return replace(similarity, cov=similarity.cov + by @ cov @ by.T)


def _left_of_scale(model: Model, part: Part) -> float:
    """What the fit itself does not say of a scale's variance: lens, accelerometer and more."""
    assert model.scale is not None and model.scale.sigma_log is not None
    return max(0.0, model.scale.sigma_log**2 - part.path.scale[1])


def _sigma_log(model: Model, part: Part, placed: Placed, k: int) -> float:
    """Of a scale once joined: what the fit left of it goes down, all the rest stays."""
    # where the ties are off by more than noise makes them, the scale gains less by them
    joined = placed.inflation * float(placed.cov[7 * k, 7 * k])
    return float((min(part.path.scale[1], joined) + _left_of_scale(model, part)) ** 0.5)


def _part_of(model: Model, parts: Sequence[Part], group: Together, k: int, similarity: Similarity) -> JoinedPart:
    part, placed = parts[k], group.placed
    assert model.scale is not None
    sigma_m, sigma_rad = 0.0, 0.0
    if k:
        middles = [part.trajectory.cam_in_world.mean(axis=0) for part in parts]
        sigma_m, sigma_rad = worst(relative_cov(parts, placed, [middles[0], middles[k]], (0, k)))
    return JoinedPart(
        colmap_index=model.colmap_index,
        images=model.reconstruction.num_reg_images(),
        begin_s=float(part.trajectory.t_s[0]),
        end_s=float(part.trajectory.t_s[-1]),
        verdict=model.scale.verdict,
        sigma_log=_sigma_log(model, part, placed, k),
        similarity=similarity,
        sigma_m=sigma_m,
        sigma_deg=float(np.degrees(sigma_rad)),
    )


def _scale_of(members: Sequence[Model], parts: Sequence[JoinedPart], down: Array) -> ScaleEstimate:
    """The scale of a joined model: that of its first part, with what the others say of it."""
    first, similarity, sigma_log = members[0].scale, parts[0].similarity, parts[0].sigma_log
    assert first is not None and first.gravity_in_world_m_s2 is not None and first.sigma_log is not None
    verdict, ci95, reasons = verdict_of(similarity.scale, sigma_log, [*first.reasons, *_doubts(members[1:], parts[1:])])
    narrower = sigma_log / first.sigma_log
    return replace(
        first,
        metres_per_unit=similarity.scale,
        sigma_log=sigma_log,
        ci95=ci95,
        verdict="weak" if first.verdict == "weak" else verdict,
        reasons=tuple(dict.fromkeys(reasons)),
        # in COLMAP's world, as the similarity turns it down
        gravity_in_world_m_s2=quat_rotate(quat_conjugate(similarity.rotation_xyzw), down),
        parts=None if first.parts is None else {name: narrower * sigma for name, sigma in first.parts.items()},
    )


def _doubts(members: Sequence[Model], parts: Sequence[JoinedPart]) -> list[str]:
    """What keeps a joined model from being trusted, beside its first part."""
    out = []
    for model, part in zip(members, parts, strict=True):
        scale = model.scale
        assert scale is not None and scale.sigma_log is not None
        known = half_width(part.sigma_log)
        if known > TRUSTED_HALF_WIDTH:
            why = f"its scale is known to +-{100 * known:.1f} % only"
        elif scale.verdict == "weak" and half_width(scale.sigma_log) <= TRUSTED_HALF_WIDTH:
            why = "; ".join(scale.reasons)
        else:
            continue
        out.append(f"its part of {part.images} images, COLMAP's model {part.colmap_index}: {why}")
    return out
