"""Covariances of camera paths against the first image: of a refined path, and of one that images and a scale made."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import skew
from colmap_inertial.inertial.refine._panels import Layout
from colmap_inertial.inertial.refine._residuals import CENTRE, N_MOVING, SPEED, TURN, Moving, moving
from colmap_inertial.inertial.refine._system import Factored
from colmap_inertial.inertial.refine.judging_points import JUDGING
from colmap_inertial.inertial.refine.pictures import apply_noise, make_pictures, measure_image_noise, pictures_alone
from colmap_inertial.inertial.refine.setup import Seen
from colmap_inertial.inertial.refine.solve import factor_information
from colmap_inertial.inertial.refine.values import N_STATE, Estimate, Problem
from colmap_inertial.inertial.refine.world import (
    derive_log_size,
    differentiate_by_centres,
    differentiate_by_mean_turn,
    size_of,
)


@dataclass(frozen=True, kw_only=True)
class DriftLimits:
    """Limits of the work for a path's covariance, and for choosing a refinement."""

    #: Normal equations of images alone, for a covariance: more take longer than a scale is worth.
    most_bytes: int = 300_000_000
    #: Processor seconds: of a step of the refinement for each observation, and for each product of its factor; steps of
    #: those that judge, and of all; of features, matching and mapping for each image and each observation (a desk
    #: computer's core).
    step_observation_s: float = 2.5e-6
    step_product_s: float = 3.2e-11
    judging_steps: int = 45
    steps: int = 10
    mapped_image_s: float = 0.4
    mapped_observation_s: float = 2e-4
    #: Of that time what a refinement may take.
    share: float = 0.25
    #: Frames whose centres say how much drift is expected, and observations that each of them has.
    centres: int = 40
    fewest: int = 10
    #: A shape that errs by less than this share of its size is held by loops or by points that all images see.
    least_drift: float = 3e-4
    #: A walk that ends so many times as far off is worse; the largest probability of that; draws of errors, their seed.
    farther: float = 1.05
    most_risk: float = 0.05
    draws: int = 4000
    seed: int = 0


_LIMITS = DriftLimits()


def find_motion_covs(frames: Int64Array, solved: Factored, by: Moving) -> Array:
    """(K, 9, 9) covariances of K frames' positions against the first frame's, of velocities, and of rotations.

    Rotations are along the world's axes, from the left; heading is that of the first frame.
    """
    by_state = np.zeros((3, len(by.by_state), N_STATE))
    by_state[:, 0] = by.by_state[0, CENTRE]
    both = solved.with_frames(frames, by, by_state, by.by_shared[0, CENTRE])
    minus = np.eye(N_MOVING, N_MOVING + 3)
    minus[CENTRE, N_MOVING:] = -np.eye(3)
    cov = minus @ both @ minus.T
    # against itself, the first one is sure, and not but for rounding
    cov[frames == 0, CENTRE] = 0.0
    cov[frames == 0, :, CENTRE] = 0.0
    return np.asarray(0.5 * (cov + cov.transpose(0, 2, 1)))


def add_scale(cov: Array, variance_log: float, centre_m: Array, velocity_m_s: Array) -> Array:
    """(K, 9, 9) the same with an error of scale of its own; ``centre_m`` (K, 3) counts from the first frame."""
    along = np.concatenate([centre_m, velocity_m_s, np.zeros_like(centre_m)], axis=1)
    return cov + variance_log * along[:, :, None] * along[:, None, :]


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageDrift:
    """Drift of a path that was mapped from images alone.

    Attributes
    ----------
    names
        (F,) of the images.
    cam_in_world
        (F, 3) their centres.
    cov
        (F, 6, 6) of position and rotation (world, left) against the first one's position and heading, once the path's
        size and up are right.
    """

    names: tuple[str, ...]
    cam_in_world: Array
    cov: Array

    def motion_covs(self, similarity_cov: Array, velocity_m_s: Array, local: Array) -> Array:
        """(F, 9, 9) covariances of position, velocity and rotation with drift, scale and gravity in them.

        Parameters
        ----------
        similarity_cov
            (7, 7) as in :class:`~colmap_inertial.core.types.Similarity`.
        velocity_m_s
            (F, 3).
        local
            (F, 3, 3) covariance of the velocity beside the path's drift.
        """
        centre_m = self.cam_in_world - self.cam_in_world[0]
        count = len(centre_m)
        by_drift, by_similarity = np.zeros((count, N_MOVING, 6)), np.zeros((count, N_MOVING, 4))
        by_drift[:, CENTRE, :3] = by_drift[:, TURN, 3:] = np.eye(3)
        # what is turned moves elsewhere
        by_drift[:, SPEED, 3:] = -skew(velocity_m_s)
        by_similarity[:, CENTRE] = np.concatenate([centre_m[:, :, None], -skew(centre_m)], axis=2)
        by_similarity[:, SPEED] = np.concatenate([velocity_m_s[:, :, None], -skew(velocity_m_s)], axis=2)
        by_similarity[:, TURN, 1:] = np.eye(3)
        cov = by_drift @ self.cov @ by_drift.transpose(0, 2, 1)
        cov += by_similarity @ similarity_cov[:4, :4] @ by_similarity.transpose(0, 2, 1)
        cov[:, SPEED, SPEED] += local
        return np.asarray(0.5 * (cov + cov.transpose(0, 2, 1)))


def find_drift(seen: Seen, down: Array) -> ImageDrift | None:
    """Covariance of the shape of a metric path from images alone; ``None`` without points, or where it takes too much
    work.

    Parameters
    ----------
    seen
        The model.
    down
        (3,) unit vector of gravity in its world.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where images do not determine it.
    """
    problem, x = make_pictures(seen)
    if not len(problem.observations.point):
        return None
    if Layout.of(problem.observations, len(seen.names)).size_bytes > _LIMITS.most_bytes:
        return None
    problem = apply_noise(problem, measure_image_noise(problem, x))
    solved, by = factor_information(problem, x), moving(problem, x)
    return ImageDrift(names=seen.names, cam_in_world=seen.cam_in_world, cov=_drift_covs(seen, down, solved, by))


@dataclass(frozen=True, kw_only=True)
class Worth:
    """Expected benefit of a refinement.

    Attributes
    ----------
    alone_m, refined_m
        Standard deviation of positions for the path's shape, of images alone and of the refinement; 0 where that was
        not looked at.
    risk
        Probability that the refined path is more than 1.05 times as far off as the one before; 0 where it was not
        looked at.
    share
        Processor time that it takes, of that of features, matching and mapping.
    reason
        Why it is not worth that; ``None`` where it is.
    """

    alone_m: float = 0.0
    refined_m: float = 0.0
    risk: float = 0.0
    share: float
    reason: Fact | None = None


def expect_worth(seen: Seen, problem: Problem, start: Estimate, *, bent: bool = False) -> Worth:
    """Whether a refinement is expected to bring a path closer to the truth, surely enough and in little time.

    A model that is ``bent`` by more than its noise, as by a rolling shutter that it ignores, is worth any risk.

    Times are predicted from counts, so that the same model always has the same answer, also where nobody knows how long
    its mapping took. The error of the refined path is part of that of images alone; what it removes is independent.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where nothing determines the path.
    """
    frames, observations = len(seen.names), len(problem.observations.frame)
    layout = Layout.of(problem.observations, frames)
    judging = min(observations, frames * JUDGING.of_frame(frames))
    steps, judging_steps = _LIMITS.steps, _LIMITS.judging_steps
    needed_s = _LIMITS.step_observation_s * (judging_steps * judging + steps * observations)
    needed_s += _LIMITS.step_product_s * (judging_steps + steps) * layout.products
    share = needed_s / (_LIMITS.mapped_image_s * frames + _LIMITS.mapped_observation_s * observations)
    if share > _LIMITS.share or layout.size_bytes > _LIMITS.most_bytes:
        return Worth(share=share, reason=Fact("refine-takes-long", share=share))
    pictures, x = make_pictures(seen)
    pictures = apply_noise(pictures, measure_image_noise(pictures, x))
    alone, size_m = _shape_cov(seen, factor_information(pictures, x), moving(pictures, x))
    worth = Worth(alone_m=_sigma(alone), share=share)
    if worth.alone_m < _LIMITS.least_drift * size_m and not bent:
        held = Fact("refine-shape-held", alone_m=worth.alone_m, share=worth.alone_m / size_m)
        return replace(worth, reason=held)
    noise = measure_image_noise(pictures_alone(problem, seen.observations.xy_px), start)
    problem = apply_noise(problem, noise)
    refined, _ = _shape_cov(seen, factor_information(problem, start), moving(problem, start))
    worth = replace(worth, refined_m=_sigma(refined), risk=_risk(alone, refined))
    if worth.risk <= _LIMITS.most_risk or bent:
        return worth
    risky = Fact("refine-risky", alone_m=worth.alone_m, refined_m=worth.refined_m, risk=worth.risk)
    return replace(worth, reason=risky)


def _shape_cov(seen: Seen, solved: Factored, by: Moving) -> tuple[Array, float]:
    """(3 K, 3 K) covariance of K centres of cameras that see enough, but for one similarity; and their size (m)."""
    centres = seen.cam_in_world
    often = np.flatnonzero(np.bincount(seen.observations.frame, minlength=len(centres)) >= _LIMITS.fewest)
    some = often[np.linspace(0, len(often) - 1, min(len(often), _LIMITS.centres)).astype(np.int64)]
    away = centres[some] - centres[some].mean(axis=0)
    free = np.zeros((len(some), 3, 7))
    free[:, :, :3], free[:, :, 3], free[:, :, 4:] = np.eye(3), away, -skew(away)
    basis, _ = np.linalg.qr(free.reshape(-1, 7))
    left = np.eye(len(basis)) - basis @ basis.T
    return left @ solved.centres_cov(some, by) @ left, size_of(centres[some])


def _sigma(cov: Array) -> float:
    return float(np.sqrt(3 * np.trace(cov) / len(cov)))


def _risk(alone: Array, refined: Array) -> float:
    """Probability that normal errors of the refined shape are farther than with what the refinement removes."""
    rng = np.random.default_rng(_LIMITS.seed)

    def draw(cov: Array) -> Array:
        weights, ways = np.linalg.eigh(cov)
        return rng.standard_normal((_LIMITS.draws, len(cov))) * np.sqrt(np.maximum(weights, 0)) @ ways.T

    left, removed = draw(refined), draw(alone - refined)
    before, after = np.linalg.norm(left + removed, axis=1), np.linalg.norm(left, axis=1)
    return float(np.mean(after > _LIMITS.farther * before))


def _drift_covs(seen: Seen, down: Array, solved: Factored, by: Moving) -> Array:
    """(F, 6, 6) of position and rotation, with the first's position and heading, and the whole's size and up."""
    count, shared = len(seen.names), by.by_shared.shape[2]
    by_state, by_shared = np.zeros((10, count, N_STATE)), np.zeros((10, shared))
    size = derive_log_size(seen.cam_in_world, np.arange(count))[None]
    by_state[:1], by_shared[:1] = differentiate_by_centres(size, by)
    by_state[1:4], by_shared[1:4] = differentiate_by_mean_turn(by)
    for at, rows in ((slice(4, 7), CENTRE), (slice(7, 10), TURN)):
        by_state[at, 0], by_shared[at] = by.by_state[0, rows], by.by_shared[0, rows]
    both = solved.with_frames(np.arange(count), by, by_state, by_shared)
    away = seen.cam_in_world - seen.cam_in_world[0]
    along = np.outer(down, down)
    out = np.zeros((count, 6, both.shape[1]))
    out[:, :3, CENTRE] = out[:, 3:, TURN] = np.eye(3)
    size_at, turn_at, centre_at, first_at = (
        slice(N_MOVING + a, N_MOVING + b) for a, b in ((0, 1), (1, 4), (4, 7), (7, 10))
    )
    out[:, :3, centre_at], out[:, :3, size_at] = -np.eye(3), -away[:, :, None]
    out[:, 3:, turn_at], out[:, 3:, first_at] = along - np.eye(3), -along
    out[:, :3, turn_at], out[:, :3, first_at] = skew(away) @ (np.eye(3) - along), skew(away) @ along
    cov = out @ both @ out.transpose(0, 2, 1)
    cov[0, :3] = cov[0, :, :3] = 0.0
    return np.asarray(0.5 * (cov + cov.transpose(0, 2, 1)))
