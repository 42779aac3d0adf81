"""How noisy the accelerometer is, by what the refinement itself leaves of its readings.

The scale estimate knows it from the readings' roughness more than from the path: what shakes faster than frames follow
counts as white noise there. Between frames most of it cancels; and beside pictures that know poses to a millimetre, the
path tells what is left. It is the level of the greatest restricted likelihood (REML), by Newton's steps with the
average information (Gilmour, Thompson and Cullis, Biometrics 1995), as the scale's own levels are found. The trace in
it, of how many residuals the fit explains, is that of random signs (Hutchinson 1990).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.inertial.refine._inertial import Rows, imu_rows
from colmap_inertial.inertial.refine._system import Factored
from colmap_inertial.inertial.refine.solve import Linearised, linearised
from colmap_inertial.inertial.refine.values import N_STATE, Estimate, Problem

#: Standard deviation of the logarithm of what was known before: on walks of 40 m, where little tells noise of pictures
#: from the accelerometer's, the scale's own level was right to a third or thirteen times too large.
_SPREAD = 0.7
#: The level stays within this factor of what was known before; no sensor is quieter than the other number.
_MOST, _LEAST_M_S2_RTHZ = 20.0, 3e-4
#: Columns of random signs: with four hundred frames the trace is known to a hundredth.
_PROBES, _SEED = 8, 0
#: Steps; the largest of a logarithm; and where they are at rest: a fiftieth of a level is nothing.
_STEPS, _LARGEST, _AT_REST = 8, 1.0, 0.02


def with_measured_noise(problem: Problem, x: Estimate) -> Problem:
    """The problem with its accelerometer as noisy as what is left of its readings says.

    Parameters
    ----------
    problem, x
        A refinement, and its solution with the noise that was assumed.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where nothing determines the solution.
    """
    inertial = problem.inertial
    assert inertial is not None
    known, change = inertial.noise, 0.0
    assumed = known.accel_density_m_s2_rthz
    least = min(0.0, max(-float(np.log(_MOST)), float(np.log(_LEAST_M_S2_RTHZ / assumed))))
    at = linearised(problem, x)
    for _ in range(_STEPS):
        noise = replace(known, accel_density_m_s2_rthz=assumed * float(np.exp(change)))
        problem = replace(problem, inertial=replace(inertial, noise=noise))
        step = _step(problem, x, at, change)
        moved = float(np.clip(change + step, least, np.log(_MOST)))
        step, change = moved - change, moved
        if abs(step) < _AT_REST:
            break
    noise = replace(known, accel_density_m_s2_rthz=assumed * float(np.exp(change)))
    return replace(problem, inertial=replace(inertial, noise=noise))


def _step(problem: Problem, x: Estimate, at: Linearised, change: float) -> float:
    """Newton's step of the logarithm of the level, which has changed by so much from what was known."""
    solved, states, shared = at.solved(problem)
    rows = imu_rows(problem, x)
    assert rows.share is not None
    left = rows.residual[:, :, None] + _apply(rows, states[:, :, None], shared[:, None])
    own = rows.share @ left
    squares = float(np.sum(left * own))
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], (*rows.residual.shape, _PROBES))
    along = _followed(rows, np.concatenate([signs, own], axis=2), solved)
    explained = float(np.sum(signs * (rows.share @ along[:, :, :-1]))) / _PROBES
    count = float(np.trace(rows.share, axis1=1, axis2=2).sum())
    right = max(count - explained, 0.01 * count)
    # of the logarithm of a variance, which is twice that of the density
    average = 0.5 * (float(np.sum(own**2)) - float(np.sum(own * along[:, :, -1:])))
    prior = 1 / (2 * _SPREAD) ** 2
    gradient = 0.5 * (squares - right) - prior * 2 * change
    step = 0.5 * gradient / (max(average, 0.1 * right) + prior)
    return float(np.clip(step, -_LARGEST, _LARGEST))


def _apply(rows: Rows, states: Array, shared: Array) -> Array:
    """(N, r, k) changes of residuals by steps (F, 15, k), (Q, k)."""
    assert rows.after is not None and rows.by_shared is not None
    return np.asarray(rows.here @ states[:-1] + rows.after @ states[1:] + rows.by_shared @ shared)


def _followed(rows: Rows, values: Array, solved: Factored) -> Array:
    """(N, r, k) of values the part that the fit follows: derivatives, covariance, derivatives."""
    assert rows.after is not None and rows.by_shared is not None
    place, count = solved.order.place, values.shape[2]
    sides = np.zeros((len(place), N_STATE, count))
    sides[place[:-1]] += rows.here.transpose(0, 2, 1) @ values
    sides[place[1:]] += rows.after.transpose(0, 2, 1) @ values
    flat = rows.by_shared.reshape(-1, rows.by_shared.shape[2])
    states, shared = solved.solve(sides.reshape(-1, count), flat.T @ values.reshape(-1, count))
    return _apply(rows, states.reshape(-1, N_STATE, count)[place], shared)
