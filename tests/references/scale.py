"""The plain numpy versions of the joint estimator's compiled kernels: the truth that these are tested against."""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_cumulative,
    quat_exp,
    quat_multiply,
    skew,
)
from colmap_inertial.inertial.core.arrow import ArrowSystem
from colmap_inertial.inertial.core.preintegration import (
    DELAY_STEP_S,
    Preintegrated,
    SensorErrors,
    SensorStreams,
    accel_noise_cov,
    gap_cov,
    integration_steps,
)


def preintegrate_reference(nodes_s: Array, streams: SensorStreams, errors: SensorErrors) -> Preintegrated:
    """As ``preintegrate``, in numpy."""
    steps = integration_steps(nodes_s, streams)
    dt = np.diff(nodes_s)
    points = steps + 1
    first = np.concatenate([[0], np.cumsum(points)[:-1]])
    interval = np.repeat(np.arange(len(dt)), points)
    h = (dt / steps)[interval]
    since = (np.arange(len(interval)) - first[interval]) * h
    t = nodes_s[interval] + since
    is_last = np.zeros(len(t), dtype=bool)
    is_last[first + steps] = True
    weight = np.where(is_last, 0.5, 1.0) * h
    weight[first] *= 0.5
    h_step = np.where(is_last, 0.0, h)[:-1, None]

    reading, _ = streams.gyro.at(t)
    rate = reading @ (np.eye(3) + errors.gyro_gain).T - errors.gyro_bias_rad_s[interval]
    # Second-order Magnus expansion for a rate that changes linearly within the step
    turn = h_step * (0.5 * (rate[:-1] + rate[1:])) + h_step**2 / 12 * np.cross(rate[:-1], rate[1:])
    product = quat_cumulative(quat_exp(turn))
    rotation = matrix_from_quat(quat_multiply(quat_conjugate(product[first])[interval], product))

    reading_a, _ = streams.accel.at(t - errors.accel_delay_s)
    later, _ = streams.accel.at(t - errors.accel_delay_s + DELAY_STEP_S)
    earlier, _ = streams.accel.at(t - errors.accel_delay_s - DELAY_STEP_S)
    slope_a = (later - earlier) / (2 * DELAY_STEP_S)
    in_body = reading_a @ (np.eye(3) + errors.accel_gain).T - errors.accel_bias_m_s2[interval]
    force = np.einsum("nij,nj->ni", rotation, in_body)

    def accumulated(increment: Array) -> Array:
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(increment, axis=0)])
        return total - total[first][interval]

    velocity = accumulated(0.5 * h_step * (force[:-1] + force[1:]))
    position = accumulated(h_step * velocity[:-1] + h_step**2 / 6 * (2 * force[:-1] + force[1:]))
    left = dt[interval] - since
    end = first + steps
    velocity_to_come = velocity[end][interval] - velocity
    position_to_come = position[end][interval] - position - velocity * left[:, None]

    def total(values: Array) -> Array:
        return np.add.reduceat(values * weight.reshape(-1, *[1] * (values.ndim - 1)), first, axis=0)

    g = np.empty((len(t), 9, 3))
    g[:, :3] = np.eye(3)
    g[:, 3:6] = -skew(velocity_to_come)
    g[:, 6:] = -skew(position_to_come)
    g_body = g @ rotation
    k = len(dt)
    by_accel_bias = np.zeros((k, 9, 3))
    by_accel_bias[:, 3:6] = -total(rotation)
    by_accel_bias[:, 6:] = -total(left[:, None, None] * rotation)
    by_accel_gain = np.zeros((k, 9, 9))
    lever = (rotation[:, :, :, None] * reading_a[:, None, None, :]).reshape(-1, 3, 9)
    by_accel_gain[:, 3:6] = total(lever)
    by_accel_gain[:, 6:] = total(left[:, None, None] * lever)
    by_accel_delay = np.zeros((k, 9))
    change = np.einsum("nij,nj->ni", rotation, slope_a)
    by_accel_delay[:, 3:6] = -total(change)
    by_accel_delay[:, 6:] = -total(left[:, None] * change)
    return Preintegrated(
        dt_s=dt,
        rotation=rotation[end],
        velocity=velocity[end],
        position=position[end],
        cov_gyro=total(g @ g.transpose(0, 2, 1)),
        cov_accel=accel_noise_cov(dt),
        cov_gaps=gap_cov(nodes_s, *streams.gap_s(nodes_s, errors.accel_delay_s)),
        by_gyro_bias=-total(g_body),
        by_accel_bias=by_accel_bias,
        by_gyro_gain=total((g_body[:, :, :, None] * reading[:, None, None, :]).reshape(-1, 9, 9)),
        by_accel_gain=by_accel_gain,
        by_accel_delay=by_accel_delay,
        rate_rad_s=np.concatenate([rate[first], rate[end[-1:]]]),
    )


def add_reference(
    system: ArrowSystem, here: Array, after: Array | None, by_globals: Array | None, *, first: int, column: int
) -> None:
    """As ``ArrowSystem.add``, in numpy."""
    n, g = len(here), 0 if by_globals is None else by_globals.shape[2]
    z = np.zeros((*here.shape[:2], 0)) if by_globals is None else by_globals
    now, then, columns = slice(first, first + n), slice(first + 1, first + 1 + n), slice(column, column + g)
    here_t, flat = here.transpose(0, 2, 1), z.reshape(n * here.shape[1], g)
    system.diagonal[now] += here_t @ here
    system.border[now, :, columns] += here_t @ z
    system.corner[columns, columns] += flat.T @ flat
    if after is not None:
        after_t = after.transpose(0, 2, 1)
        system.diagonal[then] += after_t @ after
        system.below[now] += after_t @ here
        system.border[then, :, columns] += after_t @ z


def solve_reference(system: ArrowSystem, rhs_states: Array, rhs_globals: Array) -> tuple[Array, Array, Array]:
    """As ``ArrowSystem.solve``, by LAPACK's routines for banded matrices."""
    unit, rhs = system.scaling(rhs_states)
    k, m, n = system.border.shape
    band = np.zeros((2 * m, k, m))
    diagonal = system.diagonal * unit[:, :, None] * unit[:, None, :]
    below = system.below * unit[1:, :, None] * unit[:-1, None, :]
    for j in range(m):
        band[: m - j, :, j] = diagonal[:, j:, j].T
        band[m - j : 2 * m - j, :-1, j] = below[:, :, j].T
    band = band.reshape(2 * m, k * m)
    factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
    sides = np.concatenate([system.border * unit[:, :, None], rhs], axis=2).reshape(k * m, -1)
    products = sides[:, :n].T @ cho_solve_banded((factor, True), sides, check_finite=False)
    x_globals, cov = system.solve_globals(products, rhs_globals)
    rest = rhs - (system.border @ x_globals) * unit[:, :, None]
    x_states = cho_solve_banded((factor, True), rest.reshape(k * m, -1), check_finite=False)
    return x_states.reshape(k, m, -1) * unit[:, :, None], x_globals, cov
