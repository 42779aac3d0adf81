"""One metric model of several that were placed together: images, points, scale, and a record of each part."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_rotate,
    rotation_between,
    skew,
)
from colmap_inertial.core.options import WorldAxes
from colmap_inertial.core.types import DOWN_IN_WORLD, Action, JoinedPart, ScaleEstimate, Similarity, Treatment
from colmap_inertial.inertial.join.placement import FittedSubmodel, Placed
from colmap_inertial.inertial.join.relative_poses import JoinedGroup, relative_cov, worst_sigmas
from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, finite, half_width, verdict_of
from colmap_inertial.model import Model, transform_model
from colmap_inertial.model.similarities import compose
from colmap_inertial.model.submodels.graph import PLACEMENT
from colmap_inertial.model.submodels.matches import PlacedImages
from colmap_inertial.model.submodels.merging import merge_models, merge_points

log = logging.getLogger(__name__)

#: Two points become one where every image sees it so close, as COLMAP filters points.
SAME_POINT_PX = 4.0


def join_models(
    models: Sequence[Model],
    submodels: Sequence[FittedSubmodel],
    group: JoinedGroup,
    placed_images: Sequence[PlacedImages],
    *,
    world: WorldAxes,
) -> Model:
    """One model of a group, in the world of its first, gravity and scale as all have them together.

    Parameters
    ----------
    models, submodels
        All that were judged, in the order that the group's members are places of.
    placed_images
        Images of one model that matches place in another.
    world
        Where gravity points.
    """
    members, fitted = [models[k] for k in group.members], [submodels[k] for k in group.members]
    first, placed = members[0], group.placed
    assert first.scale is not None and first.similarity is not None
    moves = [_metric_move(placed, k, world) for k in range(len(members))]
    about: list[JoinedPart] = []
    for k, (model, submodel, move) in enumerate(zip(members, fitted, moves, strict=True)):
        assert model.scale is not None and model.similarity is not None
        similarity, sigma_log = compose(move, model.similarity), _sigma_log(model, submodel, placed, k)
        sigma_m = sigma_rad = 0.0
        if k:
            cov = _similarity_cov(placed, k, move)
            shared = np.zeros((4, 4))
            shared[0, 0] = _scale_variance_beside(model, submodel)
            shared[1:, 1:] = about[0].similarity.cov[1:4, 1:4]
            by = _world_jacobian(similarity.translation_m)
            cov = cov + by @ shared @ by.T
            cov = 0.5 * (cov + cov.T)
            middles = [member.trajectory.cam_in_world.mean(axis=0) for member in (fitted[0], submodel)]
            sigma_m, sigma_rad = worst_sigmas(relative_cov(fitted, placed, middles, (0, k)))
        else:
            # the first one's up and scale are as uncertain as before, at most
            cov = _reduce_scale_sigma(first.similarity.cov, sigma_log)
        about.append(
            JoinedPart(
                colmap_index=model.colmap_index,
                images=model.reconstruction.num_reg_images(),
                begin_s=float(submodel.trajectory.t_s[0]),
                end_s=float(submodel.trajectory.t_s[-1]),
                verdict=model.scale.verdict,
                sigma_log=sigma_log,
                similarity=replace(similarity, cov=cov),
                sigma_m=sigma_m,
                sigma_deg=float(np.degrees(sigma_rad)),
            )
        )
    numbers, images = [model.colmap_index for model in members], sum(part.images for part in about)
    reason = Fact("models-joined", numbers=numbers, images=images)
    scale = _combine_scales(members, about, float(np.linalg.norm(placed.gravity_m_s2)) * DOWN_IN_WORLD[world])
    return replace(
        _merge_members(members, moves, fitted, group, placed_images),
        scale=replace(scale, notes=(*scale.notes, Fact("model-was", done=reason))),
        similarity=replace(about[0].similarity, provenance=f"{first.similarity.provenance}; {reason}"),
        treatments=(
            *first.treatments,
            Treatment(stage="join", reason=reason, action=Action.JOINED, values={"parts": len(members)}),
        ),
        observed_px={name: xy for model in reversed(members) for name, xy in model.observed_px.items()},
        parts=tuple(about),
    )


def _metric_move(placed: Placed, k: int, world: WorldAxes) -> Similarity:
    """Similarity from a submodel's own metric world to the joined one; the first one's origin stays where it is."""
    up = matrix_from_quat(rotation_between(placed.gravity_m_s2, DOWN_IN_WORLD[world]))
    scale, rotation = float(placed.places.scale[k]), up @ placed.places.rotation[k]
    shift = up @ placed.places.translation[k] + placed.origins[0] - scale * rotation @ placed.origins[k]
    return Similarity(scale=scale, rotation_xyzw=quat_from_matrix(rotation), translation_m=shift, cov=np.zeros((7, 7)))


def _merge_members(
    members: Sequence[Model],
    moves: Sequence[Similarity],
    fitted: Sequence[FittedSubmodel],
    group: JoinedGroup,
    placed_images: Sequence[PlacedImages],
) -> Model:
    """The first model with all images and points of a group, those that matches say are one as one."""
    agreeing = {
        (constraint.first, constraint.second): {
            fitted[constraint.first].trajectory.names[i] for i in constraint.images[:, 0].tolist()
        }
        for constraint in group.shared
    }
    pieces = [transform_model(model.reconstruction, move) for model, move in zip(members, moves, strict=True)]
    whole, points = merge_models(pieces, agreeing=agreeing)
    number = {model.colmap_index: of_model for model, of_model in zip(members, points, strict=True)}
    same = [
        (number[placed.first][a], number[placed.second][b])
        for placed in placed_images
        if {(placed.first, placed.second), (placed.second, placed.first)} & group.matched
        for a, b in placed.matches.tolist()
        if a in number[placed.first] and b in number[placed.second]
    ]
    log.info("%d points of two models are one", merge_points(whole, same, within_px=SAME_POINT_PX))
    return replace(members[0], reconstruction=whole)


def _similarity_cov(placed: Placed, k: int, move: Similarity) -> Array:
    """(7, 7) covariance of log scale, rotation and translation, now of the world's origin, not the submodel's."""
    rotation = matrix_from_quat(move.rotation_xyzw)
    up, arm = rotation @ placed.places.rotation[k].T, -move.scale * rotation @ placed.origins[k]
    by = np.zeros((PLACEMENT, PLACEMENT))
    by[0, 0] = 1.0
    by[1:4, 1:4] = by[4:, 4:] = up
    by[4:, 0] = arm
    by[4:, 1:4] = -skew(arm) @ up
    own = slice(PLACEMENT * k, PLACEMENT * (k + 1))
    return np.asarray(placed.inflation * by @ placed.cov[own, own] @ by.T)


def _reduce_scale_sigma(cov: Array, sigma_log: float) -> Array:
    """A similarity's covariance with a smaller standard deviation of its scale."""
    before = float(cov[0, 0]) ** 0.5
    by = np.eye(7)
    by[0, 0] = min(1.0, sigma_log / before) if before > 0 else 1.0
    return np.asarray(by @ cov @ by.T)


def _world_jacobian(translation_m: Array) -> Array:
    """(7, 4) of a similarity by the size of a metre and by a rotation of the world, both about the world's origin."""
    by = np.zeros((PLACEMENT, 4))
    by[0, 0], by[4:, 0] = 1.0, translation_m
    by[1:4, 1:], by[4:, 1:] = np.eye(3), -skew(translation_m)
    return by


def _scale_variance_beside(model: Model, submodel: FittedSubmodel) -> float:
    """Variance of a scale beside that of the fit itself: lens, accelerometer and more."""
    assert model.scale is not None and model.scale.sigma_log is not None
    return max(0.0, model.scale.sigma_log**2 - submodel.path.scale[1])


def _sigma_log(model: Model, submodel: FittedSubmodel, placed: Placed, k: int) -> float:
    """Standard deviation of a scale once joined: the share of the fit goes down, the rest stays."""
    # where the ties are off by more than noise makes them, the scale gains less by them
    joined = placed.inflation * float(placed.cov[7 * k, 7 * k])
    return float((min(submodel.path.scale[1], joined) + _scale_variance_beside(model, submodel)) ** 0.5)


def _combine_scales(members: Sequence[Model], parts: Sequence[JoinedPart], down: Array) -> ScaleEstimate:
    """The scale of a joined model: that of its first part, constrained by the others."""
    first, similarity, sigma_log = members[0].scale, parts[0].similarity, parts[0].sigma_log
    assert first is not None and first.gravity_in_world_m_s2 is not None and first.sigma_log is not None
    verdict, ci95, reasons = verdict_of(
        similarity.scale, sigma_log, [*first.reasons, *_scale_warnings(members[1:], parts[1:])]
    )
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


def _scale_warnings(members: Sequence[Model], parts: Sequence[JoinedPart]) -> list[Fact]:
    """Reasons not to trust a joined model's scale, of all parts but the first."""
    out = []
    for model, part in zip(members, parts, strict=True):
        scale = model.scale
        assert scale is not None and scale.sigma_log is not None
        width = half_width(part.sigma_log)
        if width > TRUSTED_HALF_WIDTH:
            why: tuple[Fact, ...] = (Fact("part-scale-wide", half_width=finite(width)),)
        elif scale.verdict == "weak" and half_width(scale.sigma_log) <= TRUSTED_HALF_WIDTH:
            why = scale.reasons
        else:
            continue
        out.append(Fact("joined-part-weak", colmap_index=part.colmap_index, images=part.images, why=why))
    return out
