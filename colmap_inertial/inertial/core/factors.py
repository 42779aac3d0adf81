"""Residuals of an IMU and of errors that last, with their derivatives, all divided by their standard deviations.

Rotations change on the right (``R exp(d)``, body frame), cam_from_imu on the left (camera frame), the scale through
``u`` = assumed over true metres per unit, all else by addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.geometry import skew, so3_exp, so3_log
from colmap_inertial.core.types.imu import ImuNoise
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.arrow import ArrowSystem, Inverse
from colmap_inertial.inertial.core.parameters import Estimate, InertialStates, Prior
from colmap_inertial.inertial.core.preintegration import Preintegrated

#: How far a model's parts may be shifted against each other where it breaks.
_BREAK_M = 10.0


@dataclass(eq=False, kw_only=True)
class Group:
    """Residuals of one kind.

    Attributes
    ----------
    residual
        (N, r).
    here, after
        (N, r, m) derivatives by the states ``first .. first + N`` and by the ones after them.
    by_globals
        (N, r, g) derivatives by the globals ``columns``.
    weight
        (N,) robust weights, already contained in the rest.
    share
        (N, r, r) part of the residuals' covariance (of their whitened one) that grows with the noise level which is
        estimated from them; all of it where this is None.
    root
        (N, r, r) what the residuals were whitened by, where somebody else needs it.
    """

    residual: Array
    here: Array
    after: Array | None = None
    by_globals: Array | None = None
    columns: slice = field(default_factory=lambda: slice(0, 0))
    weight: Array | None = None
    first: int = 0
    share: Array | None = None
    root: Array | None = None

    def apply(self, states: Array, z: Array) -> Array:
        """(N, r, q) changes of the residuals under q steps: states (K, m, q), globals (n, q)."""
        n = len(self.residual)
        out = self.here @ states[self.first : self.first + n]
        if self.after is not None:
            out += self.after @ states[self.first + 1 : self.first + 1 + n]
        if self.by_globals is not None:
            out += self.by_globals @ z[self.columns]
        return np.asarray(out)

    def pull_back(self, values: Array, states: Array, z: Array) -> None:
        """Add the transposed derivative times ``values`` (N, r, q) to ``states`` (K, m, q) and ``z`` (n, q)."""
        n = len(self.residual)
        states[self.first : self.first + n] += self.here.transpose(0, 2, 1) @ values
        if self.after is not None:
            states[self.first + 1 : self.first + 1 + n] += self.after.transpose(0, 2, 1) @ values
        if self.by_globals is not None:
            flat = self.by_globals.reshape(-1, self.by_globals.shape[2])
            z[self.columns] += flat.T @ values.reshape(len(flat), -1)

    def count_explained(self, inverse: Inverse) -> float:
        """Degrees of freedom of the residuals that the fit takes: the trace of their covariance after it."""
        n = len(self.residual)
        here, after = inverse.here[self.first :], inverse.here[self.first + 1 :]
        cov = self.here @ here[:n] @ self.here.transpose(0, 2, 1)
        along = -self.here @ inverse.followed[self.first : self.first + n]
        if self.after is not None:
            cov += self.after @ after[:n] @ self.after.transpose(0, 2, 1)
            cross = self.here @ inverse.beside[self.first : self.first + n] @ self.after.transpose(0, 2, 1)
            cov += cross + cross.transpose(0, 2, 1)
            along -= self.after @ inverse.followed[self.first + 1 : self.first + 1 + n]
        if self.by_globals is not None:
            along[:, :, self.columns] += self.by_globals
        # as one product: many small ones take several times as long
        along = (along.reshape(-1, along.shape[2]) @ inverse.root).reshape(along.shape)
        cov += along @ along.transpose(0, 2, 1)
        return float(np.trace(cov, axis1=1, axis2=2).sum() if self.share is None else np.sum(self.share * cov))

    def add_to(self, system: ArrowSystem) -> None:
        """Add the group's information."""
        system.add(self.here, self.after, self.by_globals, first=self.first, column=self.columns.start)


@dataclass(eq=False, kw_only=True)
class Direct:
    """Residuals that are three numbers of a state, or their change to the next state, times ``info``.

    Attributes
    ----------
    residual
        (N, 3).
    columns
        The three numbers.
    info
        (N,) one over their standard deviation.
    step
        Whether it is the change to the next state.
    keep
        (N,) what of a state's numbers is expected in the next one; all of it where this is None.
    share
        As :class:`Group` has it.
    """

    residual: Array
    columns: slice
    info: Array
    step: bool = False
    first: int = 0
    weight: Array | None = None
    keep: Array | None = None
    share: Array | None = None

    def apply(self, states: Array, z: Array) -> Array:
        """See :meth:`Group.apply`."""
        values = states[self.first : self.first + len(self.info) + self.step, self.columns]
        if self.step:
            values = values[1:] - self._kept(values[:-1])
        return np.asarray(self.info[:, None, None] * values)

    def _kept(self, values: Array) -> Array:
        return values if self.keep is None else np.asarray(self.keep[:, None, None] * values)

    def pull_back(self, values: Array, states: Array, z: Array) -> None:
        """See :meth:`Group.pull_back`."""
        n = len(self.info)
        pulled = self.info[:, None, None] * values
        if self.step:
            states[self.first + 1 : self.first + 1 + n, self.columns] += pulled
            pulled = -self._kept(pulled)
        states[self.first : self.first + n, self.columns] += pulled

    def count_explained(self, inverse: Inverse) -> float:
        """See :meth:`Group.count_explained`; only the diagonal of the share."""
        last = self.first + len(self.info)
        own = np.s_[:, self.columns, self.columns]
        cov = np.diagonal(inverse.here[self.first : last][own], axis1=1, axis2=2)
        along = inverse.followed[self.first : last, self.columns]
        if self.step:
            keep = np.ones(len(self.info)) if self.keep is None else self.keep
            beside = np.diagonal(inverse.beside[self.first : last][own], axis1=1, axis2=2)
            after = np.diagonal(inverse.here[self.first + 1 : last + 1][own], axis1=1, axis2=2)
            cov = after + keep[:, None] * (keep[:, None] * cov - 2 * beside)
            along = inverse.followed[self.first + 1 : last + 1, self.columns] - keep[:, None, None] * along
        along = (along.reshape(-1, along.shape[2]) @ inverse.root).reshape(along.shape)
        cov = (cov + np.sum(along**2, axis=2)) * self.info[:, None] ** 2
        return float(np.sum(cov if self.share is None else cov * np.diagonal(self.share, axis1=1, axis2=2)))

    def add_to(self, system: ArrowSystem) -> None:
        """See :meth:`Group.add_to`."""
        n, squared = len(self.info), self.info**2
        keep = np.ones(n) if self.keep is None else self.keep
        for i in range(self.columns.start, self.columns.stop):
            system.diagonal[self.first : self.first + n, i, i] += squared * keep**2
            if self.step:
                system.diagonal[self.first + 1 : self.first + 1 + n, i, i] += squared
                system.below[self.first : self.first + n, i, i] -= squared * keep


def rotate(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def still_near(then: Estimate, x: Estimate, t_s: Array, tolerance: float = 1.0) -> bool:
    """Whether :func:`correct_increments` brings the increments of an earlier estimate near enough to those of this one.

    At a tolerance of one the difference is far below the noise.
    """
    delay_s = abs(x.delay_s - then.delay_s) + abs(x.clock_rate - then.clock_rate) * 0.5 * float(np.ptp(t_s))
    return bool(
        delay_s < tolerance * 3e-4
        and abs(x.accel_delay_s - then.accel_delay_s) < tolerance * 1e-3
        and np.max(np.abs(x.gyro_bias_rad_s - then.gyro_bias_rad_s)) < tolerance * 1e-3
        and np.max(np.abs(x.gyro_gain - then.gyro_gain)) < tolerance * 2e-3
    )


def correct_increments(pre: Preintegrated, then: Estimate, x: Estimate) -> Preintegrated:
    """Correct increments that were integrated for the estimate ``then`` to first order for ``x``."""
    gyro_gain, accel_gain = x.gyro_gain - then.gyro_gain, x.accel_gain - then.accel_gain
    gyro_bias = x.gyro_bias_rad_s - then.gyro_bias_rad_s
    accel_bias = x.accel_biases_m_s2 - then.accel_biases_m_s2
    change = (
        rotate(pre.by_gyro_bias, gyro_bias[:-1])
        + rotate(pre.by_accel_bias, accel_bias[:-1])
        + pre.by_gyro_gain @ gyro_gain.ravel()
        + pre.by_accel_gain @ accel_gain.ravel()
        + pre.by_accel_delay * (x.accel_delay_s - then.accel_delay_s)
    )
    return replace(
        pre,
        rotation=so3_exp(change[:, :3]) @ pre.rotation,
        velocity=pre.velocity + change[:, 3:6],
        position=pre.position + change[:, 6:],
        rate_rad_s=pre.rate_rad_s + (pre.rate_rad_s + then.gyro_bias_rad_s) @ gyro_gain.T - gyro_bias,
    )


def imu_group(noise: ImuNoise, x: InertialStates, pre: Preintegrated, *, rotation_only: bool = False) -> Group:
    """``r_R, r_v, r_p`` of ``docs/dev/scale.md#imu-factor`` between consecutive nodes, whitened."""
    k, dt = len(pre.dt_s), pre.dt_s[:, None]
    body_from_world = x.world_from_imu[:-1].transpose(0, 2, 1)
    step_velocity = x.velocity_m_s[1:] - x.velocity_m_s[:-1] - x.gravity_m_s2 * dt
    step_position = x.imu_in_world_m[1:] - x.imu_in_world_m[:-1] - x.velocity_m_s[:-1] * dt
    velocity = rotate(body_from_world, step_velocity)
    position = rotate(body_from_world, step_position - 0.5 * x.gravity_m_s2 * dt**2)
    twist = so3_log(body_from_world @ x.world_from_imu[1:] @ pre.rotation.transpose(0, 2, 1))
    residual = np.concatenate([twist, velocity - pre.velocity, position - pre.position], axis=1)

    here, after = np.zeros((k, 9, par.N_STATE)), np.zeros((k, 9, par.N_STATE))
    half_twist = 0.5 * skew(twist)
    here[:, 0:3, par.THETA] = half_twist - np.eye(3)
    here[:, 3:6, par.THETA] = skew(velocity)
    here[:, 6:9, par.THETA] = skew(position)
    here[:, 3:6, par.VELOCITY] = -body_from_world
    here[:, 6:9, par.VELOCITY] = -body_from_world * dt[:, :, None]
    here[:, 6:9, par.POSITION] = -body_from_world
    here[:, :, par.GYRO_BIAS] = -pre.by_gyro_bias
    here[:, :, par.ACCEL_WALK] = here[:, :, par.ACCEL_SLOW] = -pre.by_accel_bias
    after[:, 0:3, par.THETA] = (np.eye(3) + half_twist) @ pre.rotation
    after[:, 3:6, par.VELOCITY] = body_from_world
    after[:, 6:9, par.POSITION] = body_from_world

    z = np.zeros((k, 9, par.IMU_GLOBALS.stop))
    z[:, 3:6, par.GRAVITY] = -body_from_world * dt[:, :, None]
    z[:, 6:9, par.GRAVITY] = -0.5 * body_from_world * dt[:, :, None] ** 2
    z[:, :, par.ACCEL_BIAS] = -pre.by_accel_bias
    z[:, :, par.ACCEL_DELAY] = -pre.by_accel_delay
    z[:, :, par.GYRO_GAIN] = -pre.by_gyro_gain
    z[:, :, par.ACCEL_GAIN] = -pre.by_accel_gain
    # The noise sits on the readings: what they differ by counts as they have it, before the gains. Squares of what is
    # left behind the gains would be least where gains make the noise small
    reading_from_force = np.linalg.inv(np.eye(3) + x.accel_gain)
    for rows in (slice(3, 6), slice(6, 9)):
        residual[:, rows] = residual[:, rows] @ reading_from_force.T
        for by in (here, after, z):
            by[:, rows] = reading_from_force @ by[:, rows]
        for i in range(3):
            gains = slice(par.ACCEL_GAIN.start + 3 * i, par.ACCEL_GAIN.start + 3 * i + 3)
            z[:, rows, gains] -= reading_from_force[:, i, None] * residual[:, None, rows]
    z = z[:, :, par.IMU_GLOBALS]

    rows = slice(0, 3) if rotation_only else slice(0, 9)
    cov = (
        noise.gyro_density_rad_s_rthz**2 * pre.cov_gyro
        + noise.accel_density_m_s2_rthz**2 * pre.cov_accel
        + pre.cov_gaps
    )
    root = np.linalg.inv(np.linalg.cholesky(cov[:, rows, rows]))
    return Group(
        residual=rotate(root, residual[:, rows]),
        here=root @ here[:, rows],
        after=root @ after[:, rows],
        by_globals=root @ z[:, rows],
        columns=par.IMU_GLOBALS,
        share=noise.accel_density_m_s2_rthz**2 * root @ pre.cov_accel[:, rows, rows] @ root.transpose(0, 2, 1),
        root=root,
    )


def walk_group(values: Array, columns: slice, sigma: float, dt_s: Array) -> Direct:
    """A random walk that grows by ``sigma`` in a second."""
    info = 1 / (sigma * np.sqrt(dt_s))
    return Direct(residual=np.diff(values, axis=0) * info[:, None], columns=columns, info=info, step=True)


def lasting_group(
    values: Array, columns: slice, sigma: float, lasting_s: float, dt_s: Array, broken: BoolArray
) -> Direct:
    """An error that is alike over ``lasting_s``, and anything where it is ``broken``.

    A Gauss-Markov process of the first order; over times that are short against ``lasting_s`` it is a random walk that
    grows by ``sigma`` in a second. Where it breaks it is that throughout: what was shifted stays shifted.
    """
    if broken.any():
        keep, info = np.ones(len(dt_s)), np.where(broken, 1 / _BREAK_M, 1 / (sigma * np.sqrt(dt_s)))
    else:
        keep = np.exp(-dt_s / lasting_s)
        info = 1 / (sigma * np.sqrt(0.5 * lasting_s * (1 - keep**2)))
    residual = (values[1:] - keep[:, None] * values[:-1]) * info[:, None]
    share = np.where(broken, 0.0, 1.0)[:, None, None] * np.eye(3)
    return Direct(residual=residual, columns=columns, info=info, step=True, keep=keep, share=share)


def state_group(values: Array, columns: slice, sigma: float, first: int = 0) -> Direct:
    """Values of states ``first ..`` expected to be zero."""
    info = np.full(len(values), 1 / sigma)
    return Direct(residual=values / sigma, columns=columns, info=info, first=first)


def normal_equations(groups: Sequence[Group | Direct], prior: Prior, x: Estimate) -> tuple[ArrowSystem, Array, Array]:
    """The system, and the right-hand side (K, m, 1), (n, 1) of a step towards the optimum."""
    k = len(x.velocity_m_s)
    system = ArrowSystem.zeros(k, par.N_STATE, par.N_GLOBALS)
    states, z = np.zeros((k, par.N_STATE, 1)), np.zeros((par.N_GLOBALS, 1))
    for group in groups:
        group.add_to(system)
        group.pull_back(-group.residual[:, :, None], states, z)
    system.corner += prior.info
    z[:, 0] -= prior.info @ prior.offset(x)
    magnitude = float(np.linalg.norm(x.gravity_m_s2))
    row = x.gravity_m_s2 / magnitude / prior.gravity_sigma_m_s2
    system.corner[par.GRAVITY, par.GRAVITY] += np.outer(row, row)
    z[par.GRAVITY, 0] -= row * (magnitude - prior.gravity_m_s2) / prior.gravity_sigma_m_s2
    return system, states, z
