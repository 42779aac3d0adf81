"""Positions smoothed on their own, and the chain that all smoothers use.

A linear-Gaussian Markov chain observed with noise: smoothed states, their covariance, the likelihood, outliers. It is
the Rauch-Tung-Striebel smoother in its batch form: all times are solved at once by a banded Cholesky factorisation of
the posterior precision, in linear time, and the covariances follow in one backward recursion. Axes that share noise
share the factorisation. Noise is found by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory, SmoothedTrajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """``x[k+1] = transition[k] x[k] + drive[k] + noise``, ``y[k] = observed . x[k] + noise``; no prior on ``x[0]``.

    Attributes
    ----------
    transition, process_cov
        (T-1, n, n).
    drive
        (T-1, n, m) known inputs, one column for each of m axes.
    observed
        (n,) the combination of the state that is measured.
    measured
        (T, m).
    measured_var
        (T,) variances, shared by the axes.
    initial_information
        (n, n) precision of a zero-mean prior of ``x[0]``; zero rows for what is free.
    """

    transition: Array
    process_cov: Array
    drive: Array
    observed: Array
    measured: Array
    measured_var: Array
    initial_information: Array

    @cached_property
    def _weight(self) -> Array:
        return np.asarray(np.linalg.inv(self.process_cov), dtype=np.float64)

    @cached_property
    def _factor(self) -> tuple[Array, Array]:
        """Banded Cholesky factor of the precision (2n, T n) and right-hand side (T n, m)."""
        from scipy.linalg import cholesky_banded

        count, n = len(self.measured), len(self.observed)
        f, w = self.transition, self._weight
        fw = f.transpose(0, 2, 1) @ w
        diagonal = np.zeros((count, n, n))
        diagonal += np.outer(self.observed, self.observed) / self.measured_var[:, None, None]
        diagonal[0] += self.initial_information
        diagonal[:-1] += fw @ f
        diagonal[1:] += w
        below = -(w @ f)
        bands = np.zeros((2 * n, count, n))
        for row in range(n):
            for column in range(n):
                if row >= column:
                    bands[row - column, :, column] = diagonal[:, row, column]
                bands[n + row - column, :-1, column] = below[:, row, column]
        rhs = self.observed[None, :, None] * (self.measured / self.measured_var[:, None])[:, None, :]
        rhs[:-1] -= fw @ self.drive
        rhs[1:] += w @ self.drive
        factor = np.asarray(cholesky_banded(bands.reshape(2 * n, -1), lower=True), dtype=np.float64)
        return factor, rhs.reshape(count * n, -1)

    @cached_property
    def states(self) -> Array:
        """(T, n, m) smoothed states."""
        from scipy.linalg import cho_solve_banded

        factor, rhs = self._factor
        return np.asarray(cho_solve_banded((factor, True), rhs).reshape(len(self.measured), len(self.observed), -1))

    @cached_property
    def energy(self) -> float:
        """Sum of squared whitened residuals of all measurements, transitions and the prior."""
        x = self.states
        wrong = self.measured - np.einsum("i,kim->km", self.observed, x)
        jump = self._process_residual
        return float(
            np.sum(wrong**2 / self.measured_var[:, None])
            + np.sum(jump * (self._weight @ jump))
            + np.sum(x[0] * (self.initial_information @ x[0]))
        )

    @property
    def _process_residual(self) -> Array:
        x = self.states
        return np.asarray(x[1:] - self.transition @ x[:-1] - self.drive)

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of the measurements' covariance, up to a constant that does not depend on the noise."""
        return float(
            2 * np.sum(np.log(self._factor[0][0]))
            + np.sum(np.linalg.slogdet(self.process_cov)[1])
            + np.sum(np.log(self.measured_var))
        )

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of all axes, up to a constant; free directions of the first state are integrated out."""
        return -0.5 * (self.energy + self.measured.shape[1] * self.log_determinant)

    @cached_property
    def _backward(self) -> tuple[Array, Array]:
        """Covariances (T, n, n) of the states, shared by the axes, and gains (T-1, n, n): cov(k, k+1) = gain cov."""
        count, n = len(self.measured), len(self.observed)
        bands = self._factor[0].reshape(2 * n, count, n)
        low, below = np.zeros((count, n, n)), np.zeros((count - 1, n, n))
        for row in range(n):
            for column in range(n):
                if row >= column:
                    low[:, row, column] = bands[row - column, :, column]
                below[:, row, column] = bands[n + row - column, :-1, column]
        inverse = np.linalg.inv(low)
        own = inverse.transpose(0, 2, 1) @ inverse
        gain = -(inverse[:-1].transpose(0, 2, 1) @ below.transpose(0, 2, 1))
        # cov[k] = own[k] + g cov[k+1] g' with g = -L_kk^-T L_(k+1,k)'
        cov = own.copy()
        transposed = gain.transpose(0, 2, 1)
        for k in range(count - 2, -1, -1):
            cov[k] += gain[k] @ cov[k + 1] @ transposed[k]
        return 0.5 * (cov + cov.transpose(0, 2, 1)), gain

    @property
    def cov(self) -> Array:
        """(T, n, n) covariance of the states of one axis."""
        return self._backward[0]

    def outlier_statistics(self) -> tuple[Array, Array]:
        """Auxiliary residuals (Harvey and Koopman 1992), squared: where the data contradict the model.

        Returns
        -------
        (T,) for a wrong measurement, (T-1,) for a jump of the first state between two measurements. Each is the sum
        over m axes of squares of a standard normal variable if all is well, and ignores its own datum.
        """
        h, x = self.observed, self.states
        cov, gain = self._backward
        wrong = self.measured - np.einsum("i,kim->km", h, x)
        spread = np.maximum(self.measured_var - np.einsum("i,kij,j->k", h, cov, h), 1e-9 * self.measured_var)
        measured = np.sum(wrong**2, axis=1) / spread

        # of w = x[k+1] - F x[k] - drive, the part along the first state, weighed by the inverse process covariance
        w, f = self._weight, self.transition
        cross = gain @ cov[1:]
        left = f @ cross
        cov_jump = cov[1:] + f @ cov[:-1] @ f.transpose(0, 2, 1) - left - left.transpose(0, 2, 1)
        pull = np.einsum("kj,kjm->km", w[:, 0, :], self._process_residual)
        spread = w[:, 0, 0] - np.einsum("ki,kij,kj->k", w[:, 0, :], cov_jump, w[:, 0, :])
        jumped = np.sum(pull**2, axis=1) / np.maximum(spread, 1e-8 * w[:, 0, 0])
        return measured, jumped


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
    """Measurements (T,) to leave out and transitions (T-1,) to free, after one look.

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
    minimum = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"xatol": 0.1, "fatol": 0.1, "maxiter": 150, "initial_simplex": simplex},
    )
    return np.asarray(minimum.x)


@dataclass(frozen=True, kw_only=True)
class PositionLimits:
    """Limits of the search for the noise of positions, and for outliers."""

    #: Range of the smoother's time constant in frame intervals. Longer ones than the last would lose the digits of a
    #: double; they would smooth nothing but stillness any further.
    shortest: float = 0.3
    longest: float = 50.0
    #: Neighbours of an outlier within this many time constants suffer from it and are not judged in the same round.
    reach: float = 4.0
    rounds: int = 8
    most_outliers: float = 0.1
    #: Factor on a variance that frees a measurement or a transition; least variance, relative to the path's: rounding.
    free: float = 1e8
    least_var: float = 1e-20


_LIMITS = PositionLimits()


@dataclass(frozen=True, kw_only=True)
class SmoothOptions:
    """Options of smoothing the camera's path."""

    outlier_chi2: float = 30.0
    """A pose, or a jump between two poses, this unlikely (chi-square with 3 degrees of freedom) is left out."""


def smooth_positions(trajectory: CameraTrajectory, options: SmoothOptions | None = None) -> SmoothedTrajectory:
    """Smooth the camera's path and differentiate it twice, without an IMU.

    Rauch-Tung-Striebel smoothing with constant acceleration driven by white jerk. The noise of positions and the
    strength of the jerk are those that make the recording most likely; nothing depends on the unit of length. A pose
    that contradicts the others is left out, and where all later poses are shifted against the earlier ones, the path
    jumps with them while velocity and acceleration go on.

    Parameters
    ----------
    trajectory
        At least six poses, in any unit, at any times. Where it carries covariances, they weigh the positions against
        each other.
    options
        When to leave a pose out.

    Returns
    -------
    At the frame times, in the trajectory's unit; orientations as they came. The covariance (position, velocity,
    acceleration) is that of the smoother with the estimated noise.

    Raises
    ------
    NotObservableError
        For fewer than six poses.
    """
    return PositionSmoother.of(trajectory, options).smoothed()


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionSmoother:
    """The smoother that the noise of a trajectory asks for, ready to be applied to other signals too.

    Attributes
    ----------
    trajectory
        What it was made from.
    noise_sigma
        Standard deviation of a position's white noise, trajectory's unit.
    time_constant_s
        Motion slower than this passes: white noise through the smoother has a spectrum like
        ``1 / (1 + (2 pi f time_constant_s)^6)``, squared.
    """

    trajectory: CameraTrajectory
    noise_sigma: float
    time_constant_s: float
    _chain: Chain
    _size: float
    _step_s: float

    @classmethod
    def of(cls, trajectory: CameraTrajectory, options: SmoothOptions | None = None) -> PositionSmoother:
        """Estimate the noise; parameters and errors as for :func:`smooth_positions`."""
        options = options or SmoothOptions()
        count = len(trajectory)
        if count < 6:
            raise NotObservableError("smooth motion", Fact("poses-too-few-to-smooth", count=count))
        centre = trajectory.cam_in_world - trajectory.cam_in_world.mean(axis=0)
        size = float(np.sqrt(np.mean(centre**2))) or 1.0
        step_s = float(np.median(np.diff(trajectory.t_s)))
        relative_var = np.ones(count)
        if trajectory.pose_cov is not None:
            own = np.trace(trajectory.pose_cov[:, 3:, 3:], axis1=1, axis2=2)
            relative_var = np.clip(own / np.median(own), 1e-4, 1e4)
        model = _Model(
            t=(trajectory.t_s - trajectory.t_s[0]) / step_s,
            measured=centre / size,
            relative_var=relative_var,
            left_out=np.zeros(count, dtype=bool),
            jumps=np.zeros(count - 1, dtype=bool),
        )
        constant, chain = _remove_outliers(model, options.outlier_chi2)
        return cls(
            trajectory=trajectory,
            noise_sigma=size * float(np.sqrt(np.median(chain.measured_var))),
            time_constant_s=constant * step_s,
            _chain=chain,
            _size=size,
            _step_s=step_s,
        )

    def smoothed(self) -> SmoothedTrajectory:
        """The trajectory itself."""
        units = self._size / self._step_s ** np.arange(3)
        states = self._chain.states * units[None, :, None]
        return SmoothedTrajectory(
            t_s=self.trajectory.t_s,
            cam_in_world=states[:, 0] + self.trajectory.cam_in_world.mean(axis=0),
            velocity_in_world=states[:, 1],
            accel_in_world=states[:, 2],
            cam_from_world_xyzw=self.trajectory.cam_from_world_xyzw,
            cov=np.asarray(np.kron(self._chain.cov * np.outer(units, units), np.eye(3)), dtype=np.float64),
            length_unit=self.trajectory.length_unit,
            epoch_ns=self.trajectory.epoch_ns,
        )

    def accelerations_of(self, signals: Array) -> Array:
        """Second derivatives (T, m) of other signals (T, m) at the frame times, after the very same smoothing.

        What is compared with smoothed positions must have lost what they lost; exact for signals up to parabolas.
        """
        centred = signals - signals.mean(axis=0)
        chain = replace(self._chain, measured=centred, drive=np.zeros((len(self._chain.drive), 3, signals.shape[1])))
        return chain.states[:, 2] / self._step_s**2


@dataclass(frozen=True, eq=False, kw_only=True)
class _Model:
    """Normalised data, with time in frame intervals and length in rms deviations, and its outliers."""

    t: Array
    measured: Array
    relative_var: Array
    left_out: BoolArray
    jumps: BoolArray

    def chain(self, time_constant: float, var: float) -> Chain:
        """The time constant is where the noise of positions (``var``) and motion meet: white jerk has the density
        ``var / time_constant**6``."""
        dt = np.diff(self.t)
        process = white_jerk(np.maximum(dt, time_constant / _LIMITS.longest)) * (var / time_constant**6)
        process[:, 0, 0] += var * _LIMITS.free * self.jumps
        return Chain(
            transition=constant_acceleration(dt),
            process_cov=process,
            drive=np.zeros((len(dt), 3, 3)),
            observed=np.array([1.0, 0.0, 0.0]),
            measured=self.measured,
            measured_var=var * np.where(self.left_out, _LIMITS.free, self.relative_var),
            initial_information=np.zeros((3, 3)),
        )

    def most_likely(self) -> tuple[float, Chain]:
        """The time constant of the greatest likelihood, and the chain with the variance that goes with it."""
        from scipy.optimize import minimize_scalar

        freedom = 3 * max(len(self.t) - 3 - int(self.left_out.sum()) - int(self.jumps.sum()), 1)

        def variance(chain: Chain) -> float:
            return max(chain.energy / freedom, _LIMITS.least_var)

        def cost(log_constant: float) -> float:
            chain = self.chain(float(np.exp(log_constant)), 1.0)
            return 0.5 * (freedom * np.log(variance(chain)) + 3 * chain.log_determinant)

        bounds = (np.log(_LIMITS.shortest), np.log(_LIMITS.longest))
        minimum = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02})
        constant = float(np.exp(minimum.x))
        return constant, self.chain(constant, variance(self.chain(constant, 1.0)))


def _remove_outliers(model: _Model, limit: float) -> tuple[float, Chain]:
    """Leave out poses, and allow jumps, one neighbourhood at a time, until nothing contradicts the rest."""
    constant, chain = model.most_likely()
    for _ in range(_LIMITS.rounds):
        wrong, jumped = chain.outlier_statistics()
        left_out, jumps = worst_outliers(model.t, wrong, jumped, limit=limit, reach=_LIMITS.reach * constant)
        left_out, jumps = model.left_out | left_out, model.jumps | jumps
        if left_out.sum() + jumps.sum() == model.left_out.sum() + model.jumps.sum():
            break
        if left_out.sum() + jumps.sum() > _LIMITS.most_outliers * len(model.t):
            break  # not outliers, but noise of another kind
        model = replace(model, left_out=left_out, jumps=jumps)
        constant, chain = model.most_likely()
    return constant, chain
