"""Motion models of the smoothers as chains, and noise by maximum likelihood."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.motion.smooth._chain import Chain


def constant_acceleration(dt_s: Array) -> Array:
    """(K, 3, 3) transitions of position, velocity, acceleration."""
    out = np.tile(np.eye(3), (len(dt_s), 1, 1))
    out[:, 0, 1] = out[:, 1, 2] = dt_s
    out[:, 0, 2] = 0.5 * dt_s**2
    return out


def white_jerk(dt_s: Array) -> Array:
    """(K, 3, 3) covariances that white jerk of density one adds to position, velocity, acceleration."""
    out = np.empty((len(dt_s), 3, 3))
    for i, j, power, divisor in (
        *((0, 0, 5, 20), (0, 1, 4, 8), (0, 2, 3, 6)),
        *((1, 1, 3, 3), (1, 2, 2, 2), (2, 2, 1, 1)),
    ):
        out[:, i, j] = out[:, j, i] = dt_s**power / divisor
    return out


def white_acceleration(dt_s: Array) -> Array:
    """(K, 2, 2) covariances that white acceleration of density one adds to position, velocity."""
    out = np.empty((len(dt_s), 2, 2))
    out[:, 0, 0], out[:, 1, 1] = dt_s**3 / 3, dt_s
    out[:, 0, 1] = out[:, 1, 0] = dt_s**2 / 2
    return out


def worst_outliers(t: Array, wrong: Array, jumped: Array, *, limit: float, reach: float) -> tuple[BoolArray, BoolArray]:
    """Which measurements (T,) to leave out and which transitions (T-1,) to free, after one look.

    Whatever exceeds ``limit`` competes; the worst wins, and silences everything within ``reach`` of its time, because
    an outlier makes its neighbours look like ones.
    """
    count = len(t)
    score = np.concatenate([wrong, jumped])
    time = np.concatenate([t, 0.5 * (t[1:] + t[:-1])])
    chosen = np.zeros(len(score), dtype=bool)
    candidates = np.flatnonzero(score > limit)
    for i in candidates[np.argsort(-score[candidates])]:
        if not np.any(np.abs(time[chosen] - time[i]) <= reach):
            chosen[i] = True
    return chosen[:count], chosen[count:]


def runs_of(count: int, *, longest: int = 600, runs: int = 3) -> IndexArray:
    """Frames to estimate noise from: all of a short recording, else three runs of consecutive ones."""
    if count <= longest:
        return np.arange(count)
    length = longest // runs
    starts = np.linspace(0, count - length, runs).astype(np.intp)
    return np.concatenate([start + np.arange(length) for start in starts])


def most_likely(chain_of: Callable[[Array], Chain], start: Array, *, expected: Array, spread: float) -> Array:
    """Logarithms of the variances that make the measurements most likely, given where they usually lie.

    Parameters
    ----------
    chain_of
        Builds the chain from the logarithms of P variances that together scale all of its noise.
    start
        (P,) where to start.
    expected, spread
        Mean (P,) and standard deviation of a normal prior of the logarithms.
    """
    from scipy.optimize import minimize

    def cost(logs: Array) -> float:
        return -chain_of(logs).log_likelihood + 0.5 * float(np.sum(((logs - expected) / spread) ** 2))

    simplex = np.concatenate([start[None], start + 1.5 * np.eye(len(start))])
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"xatol": 0.1, "fatol": 0.1, "maxiter": 150, "initial_simplex": simplex},
    )
    return np.asarray(found.x)
