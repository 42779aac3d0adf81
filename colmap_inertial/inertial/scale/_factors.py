"""Residuals of the joint model with their derivatives, all divided by their standard deviations.

Rotations change on the right (``R exp(d)``, body frame), cam_from_imu on the left (camera frame), the scale through
``u`` = assumed over true metres per unit, all else by addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.geometry import skew, so3_exp, so3_log
from colmap_inertial.inertial.scale import _parameters as par
from colmap_inertial.inertial.scale._parameters import Data, Estimate, Noise, Prior
from colmap_inertial.inertial.scale._preintegration import Preintegrated, SensorErrors, preintegrate
from colmap_inertial.inertial.scale._solver import ArrowSystem, Inverse

#: Cauchy scale of the visual residuals, in standard deviations: a normal error loses 4 % of its weight on average.
ROBUST_SIGMAS = 4.0
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

    def explained(self, inverse: Inverse) -> float:
        """How many of the residuals' degrees of freedom the fit takes: the trace of their covariance after it."""
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
        """As :meth:`Group.apply`."""
        values = states[self.first : self.first + len(self.info) + self.step, self.columns]
        if self.step:
            values = values[1:] - self._kept(values[:-1])
        return np.asarray(self.info[:, None, None] * values)

    def _kept(self, values: Array) -> Array:
        return values if self.keep is None else np.asarray(self.keep[:, None, None] * values)

    def pull_back(self, values: Array, states: Array, z: Array) -> None:
        """As :meth:`Group.pull_back`."""
        n = len(self.info)
        pulled = self.info[:, None, None] * values
        if self.step:
            states[self.first + 1 : self.first + 1 + n, self.columns] += pulled
            pulled = -self._kept(pulled)
        states[self.first : self.first + n, self.columns] += pulled

    def explained(self, inverse: Inverse) -> float:
        """As :meth:`Group.explained`; of the share, the diagonal."""
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
        """As :meth:`Group.add_to`."""
        n, squared = len(self.info), self.info**2
        keep = np.ones(n) if self.keep is None else self.keep
        for i in range(self.columns.start, self.columns.stop):
            system.diagonal[self.first : self.first + n, i, i] += squared * keep**2
            if self.step:
                system.diagonal[self.first + 1 : self.first + 1 + n, i, i] += squared
                system.below[self.first : self.first + n, i, i] -= squared * keep


def _mv(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def integrate(data: Data, x: Estimate) -> Preintegrated:
    """Preintegration between the nodes at the biases, gains and delays of ``x``."""
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=x.accel_biases_m_s2[:-1],
        gyro_gain=x.gyro_gain,
        accel_gain=x.accel_gain,
        accel_delay_s=x.accel_delay_s,
    )
    return preintegrate(nodes_s(data, x), data.tracks, errors)


def nodes_s(data: Data, x: Estimate) -> Array:
    """(K,) times of the nodes on the clock of the tracks."""
    return np.asarray(data.t_s - x.delay_s - x.clock_rate * (data.t_s - par.middle_s(data.t_s)))


def still_near(then: Estimate, x: Estimate, t_s: Array, tolerance: float = 1.0) -> bool:
    """Whether the increments of an earlier estimate need only :func:`corrected` to be those of this one.

    At a tolerance of one the difference is far below the noise.
    """
    delay_s = abs(x.delay_s - then.delay_s) + abs(x.clock_rate - then.clock_rate) * 0.5 * float(np.ptp(t_s))
    return bool(
        delay_s < tolerance * 3e-4
        and abs(x.accel_delay_s - then.accel_delay_s) < tolerance * 1e-3
        and np.max(np.abs(x.gyro_bias_rad_s - then.gyro_bias_rad_s)) < tolerance * 1e-3
        and np.max(np.abs(x.gyro_gain - then.gyro_gain)) < tolerance * 2e-3
    )


def corrected(pre: Preintegrated, then: Estimate, x: Estimate) -> Preintegrated:
    """Increments that were integrated for the estimate ``then``, for ``x``, to first order."""
    gyro_gain, accel_gain = x.gyro_gain - then.gyro_gain, x.accel_gain - then.accel_gain
    gyro_bias = x.gyro_bias_rad_s - then.gyro_bias_rad_s
    accel_bias = x.accel_biases_m_s2 - then.accel_biases_m_s2
    change = (
        _mv(pre.by_gyro_bias, gyro_bias[:-1])
        + _mv(pre.by_accel_bias, accel_bias[:-1])
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


def imu_group(noise: Noise, x: Estimate, pre: Preintegrated, *, rotation_only: bool = False) -> Group:
    """Rows: rotation, velocity, position between consecutive nodes."""
    k, dt = len(pre.dt_s), pre.dt_s[:, None]
    body_from_world = x.world_from_imu[:-1].transpose(0, 2, 1)
    step_velocity = x.velocity_m_s[1:] - x.velocity_m_s[:-1] - x.gravity_m_s2 * dt
    step_position = x.imu_in_world_m[1:] - x.imu_in_world_m[:-1] - x.velocity_m_s[:-1] * dt
    velocity = _mv(body_from_world, step_velocity)
    position = _mv(body_from_world, step_position - 0.5 * x.gravity_m_s2 * dt**2)
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

    z = np.zeros((k, 9, par.N_GLOBALS))
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
    cov = noise.gyro_rad_s_rthz**2 * pre.cov_gyro + noise.accel_m_s2_rthz**2 * pre.cov_accel + pre.cov_gaps
    root = np.linalg.inv(np.linalg.cholesky(cov[:, rows, rows]))
    return Group(
        residual=_mv(root, residual[:, rows]),
        here=root @ here[:, rows],
        after=root @ after[:, rows],
        by_globals=root @ z[:, rows],
        columns=par.IMU_GLOBALS,
        share=noise.accel_m_s2_rthz**2 * root @ pre.cov_accel[:, rows, rows] @ root.transpose(0, 2, 1),
        root=root,
    )


def visual_groups(data: Data, noise: Noise, x: Estimate, rate_rad_s: Array, *, robust: bool) -> tuple[Group, Group]:
    """Rotations, and centres given the rotations.

    A picture determines a camera's rotation and its centre together: what turns the camera and moves it so that the
    scene stays in place hardly changes the picture. The errors of the two are therefore strongly correlated (by 0.6
    to 0.9 in real recordings), and the centre is much better known once the gyroscope has told the rotation. So the
    error of the centre is modelled as coupling times error of the rotation plus a rest; the coupling is estimated.
    """
    k = len(data.t_s)
    camera = x.world_from_imu @ x.cam_from_imu.T  # world_from_cam
    cam_from_world = camera.transpose(0, 2, 1)
    # Mean rate of the group's frames: what row times and a delay act on
    mean_rate_rad_s = data.groups.rate_rad_s @ (np.eye(3) + x.gyro_gain).T - x.gyro_bias_rad_s
    rate = mean_rate_rad_s @ x.cam_from_imu.T
    velocity = _mv(cam_from_world, x.velocity_m_s)
    rotation_by_rate, rotation_by_velocity, centre_by_rate, centre_by_velocity = x.shutter

    rotation = so3_log(data.groups.world_from_cam.transpose(0, 2, 1) @ camera)
    # The frames were moved to their mean instant with the first guess of the delay
    rotation = rotation + (rate_rad_s @ x.cam_from_imu.T - rate) * x.delay_s
    rotation_here = np.zeros((k, 3, par.N_STATE))
    rotation_here[:, :, par.THETA] = x.cam_from_imu
    since_middle = (data.t_s - par.middle_s(data.t_s))[:, None]
    rotation_z = np.zeros((k, 3, par.N_GLOBALS))
    rotation_z[:, :, par.ROTATION] = -np.eye(3)
    rotation_z[:, :, par.DELAY] = -rate
    rotation_z[:, :, par.CLOCK_RATE] = -rate * since_middle

    lever_body = x.cam_from_imu.T @ x.imu_in_cam_m
    smear = rate @ centre_by_rate.T + velocity @ centre_by_velocity.T
    half_spread_s2 = 0.5 * data.groups.spread_s2[:, None]
    displacement = data.groups.displacement_m - half_spread_s2 * x.accel_biases_m_s2
    displacement = displacement - _mv(data.groups.rotation_since - np.eye(3), np.broadcast_to(lever_body, (k, 3)))
    predicted = x.imu_in_world_m + _mv(camera, smear - x.imu_in_cam_m)
    predicted = predicted + half_spread_s2 * x.gravity_m_s2 + _mv(x.world_from_imu, displacement)
    camera_velocity = x.velocity_m_s - _mv(x.world_from_imu, np.cross(rate_rad_s, lever_body))
    centre = data.groups.centre * x.metres_per_unit - predicted - x.drift_m
    centre_here = np.zeros((k, 3, par.N_STATE))
    centre_here[:, :, par.POSITION] = -np.eye(3)
    centre_here[:, :, par.DRIFT] = -np.eye(3)
    centre_here[:, :, par.THETA] = x.world_from_imu @ skew(displacement - lever_body)
    centre_here[:, :, par.ACCEL_WALK] = centre_here[:, :, par.ACCEL_SLOW] = (
        half_spread_s2[:, :, None] * x.world_from_imu
    )
    centre_here[:, :, par.VELOCITY] = -camera @ centre_by_velocity @ cam_from_world
    centre_z = np.zeros((k, 3, par.N_GLOBALS))
    # The noise sits on the visual centre, so a change of log u scales the prediction: total least squares
    centre_z[:, :, par.SCALE] = -predicted
    centre_z[:, :, par.ROTATION] = camera @ skew(x.imu_in_cam_m)
    centre_z[:, :, par.GRAVITY] = -half_spread_s2[:, :, None] * np.eye(3)
    centre_z[:, :, par.ACCEL_BIAS] = half_spread_s2[:, :, None] * x.world_from_imu
    centre_z[:, :, par.LEVER] = x.world_from_imu @ data.groups.rotation_since @ x.cam_from_imu.T
    centre_z[:, :, par.DELAY] = camera_velocity
    centre_z[:, :, par.CLOCK_RATE] = camera_velocity * since_middle

    # Before the shutter's part: that one, too, is mostly along the direction in which a picture changes little
    carried = camera @ (x.coupling_m + x.metres_per_unit * data.coupling)
    centre = centre - _mv(carried, rotation)
    centre_here -= carried @ rotation_here
    centre_z -= carried @ rotation_z
    unsmeared = rotation
    rotation = rotation - rate @ rotation_by_rate.T - velocity @ rotation_by_velocity.T
    rotation_here[:, :, par.VELOCITY] = -rotation_by_velocity @ cam_from_world
    for i in range(3):
        # Entries of the four shutter matrices and of the coupling, row by row
        at = [par.SHUTTER.start + 9 * j + 3 * i for j in range(4)] + [par.COUPLING.start + 3 * i]
        rotation_z[:, i, at[0] : at[0] + 3] = -rate
        rotation_z[:, i, at[1] : at[1] + 3] = -velocity
        column = -camera[:, :, i, None]
        centre_z[:, :, at[2] : at[2] + 3] = column * rate[:, None, :]
        centre_z[:, :, at[3] : at[3] + 3] = column * velocity[:, None, :]
        centre_z[:, :, at[4] : at[4] + 3] = column * unsmeared[:, None, :]

    groups = []
    for residual, here, z, root, columns in (
        (
            rotation,
            rotation_here,
            rotation_z,
            data.rotation_shape / (noise.rotation_rad * noise.rotation_excess),
            par.VISUAL_GLOBALS,
        ),
        (centre, centre_here, centre_z, data.centre_shape / noise.centre_m, slice(0, par.N_GLOBALS)),
    ):
        whitened = _mv(root, residual)
        weight = np.ones(k)
        if robust:
            weight = 1 / (1 + np.sum(whitened**2, axis=1) / (3 * ROBUST_SIGMAS**2))
        root_weight = np.sqrt(weight)[:, None, None]
        root = root * root_weight
        groups.append(
            Group(
                residual=whitened * root_weight[:, :, 0],
                here=root @ here,
                by_globals=root @ z[:, :, columns],
                columns=columns,
                weight=weight,
            )
        )
    return groups[0], groups[1]


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


def all_groups(
    data: Data, noise: Noise, prior: Prior, x: Estimate, pre: Preintegrated, *, robust: bool
) -> dict[str, Group | Direct]:
    """Everything but the priors of the globals."""
    rotation, centre = visual_groups(data, noise, x, pre.rate_rad_s, robust=robust)
    middle = int(np.argmin(np.abs(data.t_s - par.middle_s(data.t_s))))
    return {
        "imu": imu_group(noise, x, pre),
        "rotation": rotation,
        "centre": centre,
        "gyro_walk": walk_group(x.gyro_bias_rad_s, par.GYRO_BIAS, noise.gyro_walk_rad_s_rts, pre.dt_s),
        "accel_walk": walk_group(x.accel_walk_m_s2, par.ACCEL_WALK, noise.accel_walk_m_s2_rts, pre.dt_s),
        "drift": lasting_group(x.drift_m, par.DRIFT, noise.drift_m_rts, par.DRIFT_S, pre.dt_s, data.broken),
        "accel_slow": lasting_group(
            x.accel_slow_m_s2,
            par.ACCEL_SLOW,
            noise.accel_slow_m_s2_rts,
            par.ACCEL_SLOW_S,
            pre.dt_s,
            np.zeros_like(data.broken),
        ),
        # Anchors of what only differences determine
        "gyro_bias": state_group(
            x.gyro_bias_rad_s[:1] - prior.mean.gyro_bias_rad_s[:1], par.GYRO_BIAS, prior.gyro_bias_sigma_rad_s
        ),
        "accel_zero": state_group(x.accel_walk_m_s2[middle : middle + 1], par.ACCEL_WALK, 1e-4, middle),
        "drift_zero": state_group(x.drift_m[:1], par.DRIFT, noise.drift_m_rts * (0.5 * par.DRIFT_S) ** 0.5),
        "accel_slow_zero": state_group(
            x.accel_slow_m_s2[:1], par.ACCEL_SLOW, noise.accel_slow_m_s2_rts * (0.5 * par.ACCEL_SLOW_S) ** 0.5
        ),
        "speed": state_group(x.velocity_m_s, par.VELOCITY, prior.speed_sigma_m_s),
    }


def rotation_groups(
    data: Data, noise: Noise, prior: Prior, x: Estimate, pre: Preintegrated
) -> dict[str, Group | Direct]:
    """What rotations alone say; all else is held."""
    k = len(data.t_s)
    rotation, _ = visual_groups(data, noise, x, pre.rate_rad_s, robust=True)
    held = {
        str(columns): state_group(np.zeros((k, 3)), columns, 1.0)
        for columns in (par.POSITION, par.VELOCITY, par.ACCEL_WALK, par.DRIFT, par.ACCEL_SLOW)
    }
    return {
        "imu": imu_group(noise, x, pre, rotation_only=True),
        "rotation": rotation,
        "gyro_walk": walk_group(x.gyro_bias_rad_s, par.GYRO_BIAS, noise.gyro_walk_rad_s_rts, pre.dt_s),
        "gyro_bias": state_group(
            x.gyro_bias_rad_s[:1] - prior.mean.gyro_bias_rad_s[:1], par.GYRO_BIAS, prior.gyro_bias_sigma_rad_s
        ),
        **held,
    }


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
