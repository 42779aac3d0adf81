"""Residuals of the IMU between frames, of biases that walk, and of what is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew, so3_log
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.factors import imu_group
from colmap_inertial.inertial.core.preintegration import SensorErrors, preintegrate
from colmap_inertial.inertial.refine.values import (
    ACCEL_BIAS,
    GYRO_BIAS,
    N_STATE,
    POSITION,
    THETA,
    VELOCITY,
    Estimate,
    Problem,
)

#: Standard deviations of the first position and heading, which nothing else determines.
_HELD_M, _HELD_RAD = 1e-5, 1e-6
#: Of every pose about where it starts: holds a frame that neither points nor the IMU hold.
_STAYS_M, _STAYS_RAD = 10.0, 1.0
#: Of a velocity that the IMU does not touch: holds a frame that the IMU did not record.
_SPEED_M_S = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows:
    """Residuals over their standard deviations, each of a state, of it and the next, and of what is shared.

    Attributes
    ----------
    residual
        (N, r).
    here, after
        (N, r, 15) derivatives by the states ``0 .. N`` and by the ones after them.
    by_shared
        (N, r, Q), or ``None`` where it is zero.
    share
        (N, r, r) part of the residuals' covariance that is the accelerometer's white noise; ``None`` where there is
        none.
    """

    residual: Array
    here: Array
    after: Array | None = None
    by_shared: Array | None = None
    share: Array | None = None


def imu_rows(problem: Problem, x: Estimate) -> Rows:
    """Rotation, velocity, position between consecutive frames."""
    inertial = problem.inertial
    assert inertial is not None
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=x.accel_bias_m_s2[:-1],
        gyro_gain=x.gyro_gain,
        accel_gain=x.accel_gain,
        accel_delay_s=x.accel_delay_s,
    )
    pre = preintegrate(inertial.nodes_s, inertial.streams, errors)
    states = par.InertialStates(
        world_from_imu=x.world_from_imu,
        imu_in_world_m=x.imu_in_world_m,
        velocity_m_s=x.velocity_m_s,
        gravity_m_s2=x.gravity_m_s2 * inertial.down,
        accel_gain=x.accel_gain,
    )
    group = imu_group(inertial.noise, states, pre)
    assert group.after is not None and group.by_globals is not None
    at, start = x.columns, par.IMU_GLOBALS.start
    by = group.by_globals
    by_shared = np.zeros((*by.shape[:2], at.count))
    by_shared[:, :, at.gravity] = by[:, :, par.GRAVITY.start - start : par.GRAVITY.stop - start] @ inertial.down
    by_shared[:, :, at.accel_delay] = by[:, :, par.ACCEL_DELAY - start]
    for mine, theirs in ((at.gyro_gain, par.GYRO_GAIN), (at.accel_gain, par.ACCEL_GAIN)):
        by_shared[:, :, mine] = by[:, :, theirs.start - start : theirs.stop - start]
    counts = inertial.linked.astype(np.float64)[:, None]
    assert group.share is not None
    return Rows(
        residual=group.residual * counts,
        here=group.here[:, :, :N_STATE] * counts[:, :, None],
        after=group.after[:, :, :N_STATE] * counts[:, :, None],
        by_shared=by_shared * counts[:, :, None],
        share=group.share * counts[:, :, None],
    )


def walk_rows(problem: Problem, x: Estimate) -> Rows:
    """Changes of the biases from frame to frame."""
    inertial = problem.inertial
    assert inertial is not None
    root_s = np.sqrt(np.maximum(np.diff(inertial.nodes_s), 1e-3))[:, None]
    noise, count = inertial.noise, len(root_s)
    residual, here = np.empty((count, 6)), np.zeros((count, 6, N_STATE))
    for rows, columns, values, sigma in (
        (slice(0, 3), GYRO_BIAS, x.gyro_bias_rad_s, noise.gyro_walk_rad_s2_rthz),
        (slice(3, 6), ACCEL_BIAS, x.accel_bias_m_s2, noise.accel_walk_m_s3_rthz),
    ):
        residual[:, rows] = np.diff(values, axis=0) / (sigma * root_s)
        here[:, rows, columns] = -np.eye(3) / (sigma * root_s[:, :, None])
    return Rows(residual=residual, here=here, after=-here)


def state_rows(problem: Problem, x: Estimate) -> Rows:
    """What is known of states: next to nothing of poses and speeds; of the first one biases, position and heading."""
    count, prior = len(x.velocity_m_s), problem.prior
    residual, here = np.zeros((count, 21)), np.zeros((count, 21, N_STATE))
    inertial = problem.inertial
    if inertial is None:  # what pictures do not show stays as it is
        for columns in (VELOCITY, GYRO_BIAS, ACCEL_BIAS):
            here[:, columns, columns] = np.eye(3)
        heading = np.eye(3)
    else:
        untouched = ~inertial.touched
        residual[untouched, VELOCITY] = x.velocity_m_s[untouched] / _SPEED_M_S
        here[untouched, VELOCITY, VELOCITY] = np.eye(3) / _SPEED_M_S
        for columns, now, mean, sigma in (
            (GYRO_BIAS, x.gyro_bias_rad_s, prior.mean.gyro_bias_rad_s, prior.gyro_bias_sigma_rad_s),
            (ACCEL_BIAS, x.accel_bias_m_s2, prior.mean.accel_bias_m_s2, prior.accel_bias_sigma_m_s2),
        ):
            residual[0, columns] = (now[0] - mean[0]) / sigma
            here[0, columns, columns] = np.eye(3) / sigma
        heading = np.outer(inertial.down, inertial.down)
    residual[0, POSITION] = (x.imu_in_world_m[0] - prior.mean.imu_in_world_m[0]) / _HELD_M
    here[0, POSITION, POSITION] = np.eye(3) / _HELD_M
    turn = so3_log(prior.mean.world_from_imu.transpose(0, 2, 1) @ x.world_from_imu)
    by_turn = np.eye(3) + 0.5 * skew(turn)
    held = heading @ prior.mean.world_from_imu[0] / _HELD_RAD
    residual[0, THETA], here[0, THETA, THETA] = held @ turn[0], held @ by_turn[0]
    residual[:, 15:18] = (x.imu_in_world_m - prior.mean.imu_in_world_m) / _STAYS_M
    here[:, 15:18, POSITION] = np.eye(3) / _STAYS_M
    residual[:, 18:], here[:, 18:, THETA] = turn / _STAYS_RAD, by_turn / _STAYS_RAD
    return Rows(residual=residual, here=here)


def prior_offset(problem: Problem, x: Estimate) -> Array:
    """(Q,) shared numbers less their expected values."""
    mean = problem.prior.mean
    out = x.shared_numbers() - mean.shared_numbers()
    out[:3] = so3_log(x.cam_from_imu @ mean.cam_from_imu.T)
    return out


def all_rows(problem: Problem, x: Estimate) -> dict[str, Rows]:
    """Everything but observations and priors of shared numbers."""
    if problem.inertial is None:
        return {"states": state_rows(problem, x)}
    return {"imu": imu_rows(problem, x), "walk": walk_rows(problem, x), "states": state_rows(problem, x)}
