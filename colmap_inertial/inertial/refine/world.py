"""The scale, gravity and bias that a refinement found itself, with covariance and what makes the scale unsure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import AcceptedScale, ScaleEstimate, Similarity
from colmap_inertial.inertial.core.parameters import LARGEST_GAIN_CHI2
from colmap_inertial.inertial.core.priors import PRIORS, AccelPart
from colmap_inertial.inertial.refine._residuals import TURN as MOVING_TURN, Moving, Rows, all_rows
from colmap_inertial.inertial.refine._system import Factored
from colmap_inertial.inertial.refine.values import (
    ACCEL_BIAS,
    ACCEL_DENSITY,
    CLOCK_RATE,
    GYRO_BIAS,
    N_STATE,
    ROTATION,
    Estimate,
    Problem,
)
from colmap_inertial.inertial.scale.verdict import half_width, verdict_of, without_width
from colmap_inertial.model.similarities import compose

# Columns of its covariance.
SIZE, TURN, STRENGTH, BIAS = (slice(0, 1), slice(1, 4), slice(4, 5), slice(5, 8))
COUNT = BIAS.stop


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundWorld:
    """Uncertainty of a solution's world: scale, gravity, velocities.

    Attributes
    ----------
    cov
        (8, 8) of the logarithm of the path's size, its mean rotation (world axes, rad) against gravity, the strength of
        gravity and the mean accelerometer bias.
    parts
        Variance of that logarithm by cause, as ``ScaleEstimate.parts`` names them.
    """

    cov: Array
    parts: dict[str, float]


def find_world(problem: Problem, x: Estimate, centres: Array, solved: Factored, by: Moving) -> FoundWorld:
    """Estimate the world from the information at a solution.

    Parameters
    ----------
    problem, x
        The refinement and its solution.
    centres
        (F, 3) the camera's centres there.
    solved, by
        The information, and the camera's motion.
    """
    count = len(centres)
    by_state, by_shared = np.zeros((COUNT, count, N_STATE)), np.zeros((COUNT, x.columns.count))
    size = derive_log_size(centres, np.arange(count))[None]
    by_state[:1], by_shared[:1] = differentiate_by_centres(size, by)
    by_state[TURN], by_shared[TURN] = differentiate_by_mean_turn(by)
    by_shared[STRENGTH, x.columns.gravity] = 1.0
    by_state[BIAS, :, ACCEL_BIAS] = np.eye(3)[:, None] / count
    cov, states, shared = solved.cov_of(by_state, by_shared)
    return FoundWorld(cov=cov, parts=_split(problem, x, float(cov[0, 0]), states[:, :, 0], shared[:, 0]))


def state_scale(
    before: ScaleEstimate,
    source: Similarity,
    move: Similarity,
    problem: Problem,
    x: Estimate,
    world: FoundWorld,
    *,
    accel: AccelPart,
) -> tuple[ScaleEstimate, Similarity]:
    """A refinement's own scale, up and bias, and the similarity that they give.

    Parameters
    ----------
    before, source
        The estimate that the refinement started from, and the similarity from COLMAP's model that it gave. What was
        found wrong then stays said.
    move
        From the model before to the refined one.
    problem, x, world
        The refinement, its solution, and how sure that is of its world.
    accel
        What the accelerometer adds to a scale's interval.
    """
    inertial = problem.inertial
    assert inertial is not None
    first, similarity = before.accepted, compose(move, source)
    metres_per_unit = first.metres_per_unit * move.scale
    # what the refinement does not see: the lens, and which of two clocks is wrong
    variances = world.parts | {"lens": PRIORS.lens**2, "clocks": (before.parts or {}).get("clocks", 0.0) ** 2}
    variances["accel_gain"] = (variances["accel_gain"] + accel.model_sigma**2) * accel.factor**2
    sigma_log = sum(variances.values()) ** 0.5
    doubts = [*without_width(before.reasons), *_doubts(first, move, problem, x)]
    verdict, ci95, reasons = verdict_of(metres_per_unit, sigma_log, doubts)
    down, turn = inertial.down, matrix_from_quat(similarity.rotation_xyzw)
    by_world, by_gravity = np.zeros((7, COUNT)), np.zeros((7, COUNT))
    by_world[0, SIZE] = by_gravity[0, SIZE] = 1.0
    # heading is free and carries none
    by_world[1:4, TURN] = np.eye(3) - np.outer(down, down)
    by_gravity[1:4, TURN] = x.gravity_m_s2 * turn.T @ skew(down)
    by_gravity[1:4, STRENGTH], by_gravity[4:, BIAS] = (turn.T @ down)[:, None], np.eye(3)
    covs = [by @ world.cov @ by.T for by in (by_world, by_gravity)]
    for cov in covs:
        cov[0, 0] = sigma_log**2
    estimate = replace(
        before,
        metres_per_unit=metres_per_unit,
        sigma_log=sigma_log,
        ci95=ci95,
        verdict=verdict,
        reasons=reasons,
        gravity_in_world_m_s2=x.gravity_m_s2 * turn.T @ down,
        accel_bias_m_s2=x.accel_bias_m_s2.mean(axis=0),
        cov=covs[1],
        parts={name: variance**0.5 for name, variance in variances.items()},
    )
    return estimate, replace(similarity, cov=covs[0])


def _doubts(first: AcceptedScale, move: Similarity, problem: Problem, x: Estimate) -> list[Fact]:
    """Reasons why a refinement's own scale is not trusted."""
    out, gains = [], x.columns.accel_gain
    errors = x.accel_gain.ravel()
    if errors @ problem.prior.info[gains, gains] @ errors > LARGEST_GAIN_CHI2:
        out.append(Fact("refinement-gain-large", gains=-np.diagonal(x.accel_gain)))
    if abs(np.log(move.scale)) > Z95 * first.sigma_log:
        width = half_width(first.sigma_log)
        out.append(Fact("refined-scale-differs", difference=move.scale - 1, half_width=width))
    return out


def _split(problem: Problem, x: Estimate, variance: float, states: Array, shared: Array) -> dict[str, float]:
    """A variance by cause: what each residual's noise alone would leave; the rest is that of the images.

    ``states`` (F, 15) and ``shared`` (Q,) are the covariance of the unknowns with the number.
    """
    rows, info, at = all_rows(problem, x), problem.prior.info, x.columns
    imu, walk, first = rows["imu"], _along(rows["walk"], states, shared), _along(rows["states"], states, shared)
    along = _along(imu, states, shared)
    accel = float(np.einsum("ni,nij,nj->", along, imu.shares[ACCEL_DENSITY], along))

    def of_prior(columns: slice | int) -> float:
        index = np.atleast_1d(np.arange(at.count)[columns])
        return float(shared[index] @ info[np.ix_(index, index)] @ shared[index])

    out = {
        "accel_gain": of_prior(at.accel_gain),
        "accel_noise": accel,
        "accel_bias": float(np.sum(walk[:, 3:] ** 2) + np.sum(first[:, ACCEL_BIAS] ** 2)),
        "gyro": of_prior(at.gyro_gain)
        + float(np.sum(along**2) - accel + np.sum(walk[:, :3] ** 2) + np.sum(first[:, GYRO_BIAS] ** 2)),
        "camera_imu": of_prior(slice(ROTATION.start, CLOCK_RATE + 1)) + of_prior(at.accel_delay),
        "gravity": of_prior(at.gravity),
    }
    return out | {"camera_path": max(0.0, variance - sum(out.values()))}


def _along(rows: Rows, states: Array, shared: Array) -> Array:
    """(N, r) changes of residuals by one step."""
    out = np.einsum("nri,ni->nr", rows.here, states[: len(rows.here)])
    if rows.after is not None:
        out += np.einsum("nri,ni->nr", rows.after, states[1:])
    return out if rows.by_shared is None else out + rows.by_shared @ shared


def differentiate_by_centres(by_centre: Array, by: Moving) -> tuple[Array, Array]:
    """(k, F, 15) and (k, Q) derivatives by states and what is shared, of (k, F, 3) by the camera's centres."""
    by_state = np.einsum("kfi,fij->kfj", by_centre, by.by_state[:, :3])
    return by_state, np.einsum("kfi,fiq->kq", by_centre, by.by_shared[:, :3])


def differentiate_by_mean_turn(by: Moving) -> tuple[Array, Array]:
    """(3, F, 15) and (3, Q) derivatives of the camera's mean rotation."""
    by_state = by.by_state[:, MOVING_TURN].transpose(1, 0, 2) / len(by.by_state)
    return by_state, by.by_shared[:, MOVING_TURN].mean(axis=0)


def derive_log_size(centres: Array, part: IndexArray) -> Array:
    """(F, 3) derivative of the logarithm of a part's size by its centres."""
    out = np.zeros_like(centres)
    if len(part) > 1:
        away = centres[part] - centres[part].mean(axis=0)
        out[part] = away / max(float(np.sum(away**2)), 1e-12)
    return out


def size_of(centres: Array) -> float:
    """Root of the mean square distance of (F, 3) points from their middle."""
    return float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))))
