"""Positions alone, smoothed by a constant-acceleration model driven by white jerk."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.types import CameraTrajectory, SmoothedTrajectory
from colmap_inertial.motion.smooth._chain import Chain
from colmap_inertial.motion.smooth._models import constant_acceleration, white_jerk, worst_outliers

#: Range of the smoother's time constant in frame intervals. Longer ones than the last would lose the digits of a
#: double; they would smooth nothing but stillness any further.
_SHORTEST, _LONGEST = 0.3, 50.0
#: Neighbours of an outlier within this many time constants suffer from it and are not judged in the same round.
_REACH = 4.0
_ROUNDS, _MOST_OUTLIERS = 8, 0.1
#: Factor on a variance that frees a measurement or a transition; least variance, relative to the path's: rounding.
_FREE, _LEAST_VAR = 1e8, 1e-20


@dataclass(frozen=True, kw_only=True)
class SmoothOptions:
    """How the camera's path is smoothed."""

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
            raise NotObservableError("smooth motion", f"{count} poses are too few to tell motion from noise")
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
        process = white_jerk(np.maximum(dt, time_constant / _LONGEST)) * (var / time_constant**6)
        process[:, 0, 0] += var * _FREE * self.jumps
        return Chain(
            transition=constant_acceleration(dt),
            process_cov=process,
            drive=np.zeros((len(dt), 3, 3)),
            observed=np.array([1.0, 0.0, 0.0]),
            measured=self.measured,
            measured_var=var * np.where(self.left_out, _FREE, self.relative_var),
            initial_information=np.zeros((3, 3)),
        )

    def most_likely(self) -> tuple[float, Chain]:
        """The time constant of the greatest likelihood, and the chain with the variance that goes with it."""
        from scipy.optimize import minimize_scalar

        freedom = 3 * max(len(self.t) - 3 - int(self.left_out.sum()) - int(self.jumps.sum()), 1)

        def variance(chain: Chain) -> float:
            return max(chain.energy / freedom, _LEAST_VAR)

        def cost(log_constant: float) -> float:
            chain = self.chain(float(np.exp(log_constant)), 1.0)
            return 0.5 * (freedom * np.log(variance(chain)) + 3 * chain.log_determinant)

        bounds = (np.log(_SHORTEST), np.log(_LONGEST))
        found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02})
        constant = float(np.exp(found.x))
        return constant, self.chain(constant, variance(self.chain(constant, 1.0)))


def _remove_outliers(model: _Model, limit: float) -> tuple[float, Chain]:
    """Leave out poses, and allow jumps, one neighbourhood at a time, until nothing contradicts the rest."""
    constant, chain = model.most_likely()
    for _ in range(_ROUNDS):
        wrong, jumped = chain.outlier_statistics()
        left_out, jumps = worst_outliers(model.t, wrong, jumped, limit=limit, reach=_REACH * constant)
        left_out, jumps = model.left_out | left_out, model.jumps | jumps
        if left_out.sum() + jumps.sum() == model.left_out.sum() + model.jumps.sum():
            break
        if left_out.sum() + jumps.sum() > _MOST_OUTLIERS * len(model.t):
            break  # not outliers, but noise of another kind
        model = replace(model, left_out=left_out, jumps=jumps)
        constant, chain = model.most_likely()
    return constant, chain
