"""Posterior of one model's joint fit at chosen instants, with the covariance of all of it together.

Two models of one recording share the device and what it felt between them. To bring them together one needs more than
their scales: rotation, position, velocity and biases at their ends, the direction of gravity, delays and gains, and how
the errors of all these go together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Noise
from colmap_inertial.inertial.core.priors import accel_part, clock_scale_sigma, model_scale_sigma
from colmap_inertial.inertial.scale._fit import Fit
from colmap_inertial.inertial.scale._inputs import align_recording, strength_of_gravity
from colmap_inertial.inertial.scale._setup import Measurements
from colmap_inertial.inertial.scale.interval import metres_per_unit_of, variance_factor
from colmap_inertial.inertial.scale.joint import JointOptions, fit_path

# Columns of a node: rotation (right, body frame), position, velocity, biases of gyroscope and accelerometer.
NODE = 15
THETA, POSITION, VELOCITY, GYRO_BIAS, ACCEL_BIAS = (slice(3 * i, 3 * i + 3) for i in range(5))
# Columns of what a model has for itself, after those of its nodes.
OWN = 6
LOG_SCALE, GRAVITY, DELAY, CLOCK_RATE = 0, slice(1, 4), 4, 5
# Columns of what all models of a device share, after those.
SHARED = 25
ACCEL_DELAY, GYRO_GAIN, ACCEL_GAIN, ROTATION, LEVER = 0, slice(1, 10), slice(10, 19), slice(19, 22), slice(22, 25)

#: The same among the globals of the fit.
_SHARED = [
    par.ACCEL_DELAY,
    *(i for part in (par.GYRO_GAIN, par.ACCEL_GAIN, par.ROTATION, par.LEVER) for i in range(part.start, part.stop)),
]


@dataclass(frozen=True, eq=False, kw_only=True)
class Posterior:
    """Posterior of n nodes of a fit, in metres, in the model's world with its origin at ``origin``.

    Attributes
    ----------
    t_s
        (n,) camera time.
    stamp_s
        (n,) the stamps of the IMU at these instants, as they were recorded.
    world_from_imu, imu_in_world_m, velocity_m_s, gyro_bias_rad_s, accel_bias_m_s2
        (n, 3, 3), (n, 3) ...
    metres_per_unit, gravity_m_s2
        Of the model's units; (3,) in its world.
    accel_delay_s, gyro_gain, accel_gain, cam_from_imu, imu_in_cam_m
        Of the device; the delay is added to stamps of the accelerometer to get those of the gyroscope.
    since_middle_s
        (n,) time since the instant about which the rate between the clocks turns.
    cov
        (15 n + 31, 15 n + 31) of the nodes, of scale (logarithm), gravity, delay and rate of the clocks, and of what is
        shared: delay, gains of gyroscope and accelerometer, rotation (camera frame, left), lever arm.
    prior_info, prior_offset
        (25, 25) information on what is shared that was there before the data, and (25,) from what it expects to what
        was found.
    """

    t_s: Array
    stamp_s: Array
    world_from_imu: Array
    imu_in_world_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    metres_per_unit: float
    gravity_m_s2: Array
    accel_delay_s: float
    gyro_gain: Array
    accel_gain: Array
    cam_from_imu: Array
    imu_in_cam_m: Array
    since_middle_s: Array
    cov: Array
    prior_info: Array
    prior_offset: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedPath:
    """A model's path, fitted to the IMU.

    Attributes
    ----------
    origin
        (3,) point of the model's world, in its units, that positions count from.
    floor_log
        What an accelerometer, a lens and clocks leave of any scale, as a standard deviation of its logarithm.
    """

    origin: Array
    floor_log: float
    _data: Measurements
    _fit: Fit
    _aligned: CameraImuCalibration
    _stamps_s: Array
    _widened: float
    _shift_log: float

    @classmethod
    def of(
        cls,
        trajectory: CameraTrajectory,
        imu: ImuRecording,
        calibration: CameraImuCalibration | None,
        options: ScaleOptions,
    ) -> FittedPath:
        """Fit a path, as :func:`estimate_scale` does by the joint method.

        Raises
        ------
        NotObservableError
            Where nothing comes of it, or the accelerometer has faults or the model is bent or torn.
        """
        strength, sigma = strength_of_gravity(options)
        known = JointOptions(gravity_m_s2=strength, gravity_sigma_m_s2=sigma)
        with one_blas_thread():
            timed, consensus = align_recording(trajectory, imu, calibration, options)
            trajectory = trajectory.select(consensus.kept)
            try:
                data, fit, wrong = fit_path(trajectory, timed, known)
            except np.linalg.LinAlgError as error:
                raise NotObservableError("place", Fact("motion-not-determined")) from error
        if wrong:
            raise NotObservableError("place", Fact("path-with-faults", faults=wrong))
        clock_rate = timed.calibration.clock_rate + fit.estimate.clock_rate
        ends = (0, -1)
        return cls(
            origin=data.origin,
            floor_log=math.hypot(model_scale_sigma(accel_part(imu)), clock_scale_sigma(clock_rate)),
            _data=data,
            _fit=fit,
            _aligned=timed.calibration,
            _stamps_s=np.array([[timed.gyro_t_s[i], imu.gyro_t_s[i]] for i in ends]),
            _widened=variance_factor(fit),
            _shift_log=float(np.log(metres_per_unit_of(fit) / fit.estimate.metres_per_unit)),
        )

    @property
    def nodes_s(self) -> Array:
        """(K,) camera time of all nodes."""
        return self._data.t_s

    @property
    def noise(self) -> Noise:
        """Noise levels that the fit estimated."""
        return self._fit.noise

    @property
    def scale(self) -> tuple[float, float]:
        """Metres per unit, and the variance of its logarithm that the fit's own posterior has."""
        log_shift, at = self._shift_log, par.SCALE
        return self._fit.estimate.metres_per_unit * float(np.exp(log_shift)), self._widened * float(
            self._fit.cov[at, at]
        )

    @property
    def seen_variances(self) -> tuple[float, float]:
        """Variances of a visual rotation (rad2) and centre (m2) at a usual node, each axis, as many of them weigh."""
        noise = self._fit.noise
        rotation = (noise.rotation_rad * noise.rotation_excess) ** 2
        return rotation, noise.centre_m**2 + noise.drift_m2

    def seen_cov(self, node: int) -> Array:
        """(6, 6) covariance of one visual pose at a node: rotation (left) and centre (m), along the model's axes."""
        data, x = self._data, self._fit.estimate
        noise = self._fit.noise
        camera = x.world_from_imu[node] @ x.cam_from_imu.T
        rotation = noise.rotation_rad**2 * _inverse_square(data.rotation_shape[node])
        carried = camera @ (x.coupling_m + x.metres_per_unit * data.coupling[node])
        centre = noise.centre_m**2 * _inverse_square(data.centre_shape[node]) + carried @ rotation @ carried.T
        cov = np.zeros((6, 6))
        cov[:3, :3] = camera @ rotation @ camera.T
        cov[3:, 3:] = centre + noise.drift_m2 * np.eye(3)
        cov[3:, :3] = -carried @ rotation @ camera.T
        cov[:3, 3:] = cov[3:, :3].T
        return cov

    def seen(self, node: int) -> tuple[Array, Array]:
        """(3, 3) world_from_cam and (3,) centre of the visual pose at a node, in the model's world and units."""
        groups = self._data.groups
        return groups.world_from_cam[node], groups.centre[node] + self.origin

    def stamps_s(self, nodes: Int64Array) -> Array:
        """(n,) the IMU's stamps, as they were recorded, at n of the nodes."""
        x, t_s = self._fit.estimate, self._data.t_s
        instant_s = t_s[nodes] - x.delay_s - x.clock_rate * (t_s[nodes] - par.middle_s(t_s))
        (first_s, first), (last_s, last) = self._stamps_s
        return np.asarray(first + (instant_s - first_s) * (last - first) / (last_s - first_s))

    def _rows(self, nodes: Int64Array) -> tuple[Array, Array]:
        """Rows for n nodes, by the fit's states (K, 21, s) and globals (79, s)."""
        fit, x, t_s = self._fit, self._fit.estimate, self._data.t_s
        n, k = len(nodes), len(t_s)
        since_s = t_s[nodes] - par.middle_s(t_s)
        size = NODE * n + OWN + SHARED
        own, shared = NODE * n, NODE * n + OWN
        states, z = np.zeros((k, par.N_STATE, size)), np.zeros((par.N_GLOBALS, size))
        eye = np.eye(3)
        for i, node in enumerate(nodes.tolist()):
            at = NODE * i
            for mine, theirs in (
                (THETA, par.THETA),
                (POSITION, par.POSITION),
                (VELOCITY, par.VELOCITY),
                (GYRO_BIAS, par.GYRO_BIAS),
                (ACCEL_BIAS, par.ACCEL_WALK),
            ):
                states[node, theirs, at + mine.start : at + mine.stop] = eye
            z[par.ACCEL_BIAS, at + ACCEL_BIAS.start : at + ACCEL_BIAS.stop] = eye
            # a later clock of the IMU makes the node an earlier instant of it
            for columns, speed in ((THETA, fit.rate_rad_s[node]), (POSITION, x.velocity_m_s[node])):
                z[par.DELAY, at + columns.start : at + columns.stop] = -speed
                z[par.CLOCK_RATE, at + columns.start : at + columns.stop] = -speed * since_s[i]
        z[par.SCALE, own + LOG_SCALE] = -1.0
        z[par.GRAVITY, own + GRAVITY.start : own + GRAVITY.stop] = eye
        z[par.DELAY, own + DELAY] = z[par.CLOCK_RATE, own + CLOCK_RATE] = 1.0
        z[_SHARED, shared + np.arange(SHARED)] = 1.0
        return states, z

    def at(self, nodes: Int64Array) -> Posterior:
        """The posterior of n of the nodes and of what is global."""
        fit, x, t_s = self._fit, self._fit.estimate, self._data.t_s
        n = len(nodes)
        own = NODE * n
        states, z = self._rows(nodes)
        solved, solved_z, _ = fit.system.solve(states, z)
        cov = np.einsum("kma,kmb->ab", states, solved) + z.T @ solved_z
        cov = 0.5 * self._widened * (cov + cov.T)
        # the scale is larger by what noise in the fitted path takes from it; the rest goes along
        along = cov[:, own + LOG_SCALE] / cov[own + LOG_SCALE, own + LOG_SCALE] * self._shift_log
        mean = fit.prior_info[np.ix_(_SHARED, _SHARED)] / self._widened
        moved = [along[NODE * i : NODE * (i + 1)] for i in range(n)]
        nodes_of = np.array(moved).reshape(n, NODE)
        guess = self._aligned
        shared = np.concatenate(
            [[x.accel_delay_s], x.gyro_gain.ravel(), x.accel_gain.ravel(), np.zeros(3), np.zeros(3)]
        )
        shared[LEVER] = x.imu_in_cam_m - guess.imu_in_cam_m
        # of the rotation, and of the offset, the alignment by the very data is all that was there before
        info = np.zeros_like(mean)
        kept = np.r_[np.arange(ROTATION.start), np.arange(LEVER.start, LEVER.stop)]
        info[np.ix_(kept, kept)] = mean[np.ix_(kept, kept)]
        return Posterior(
            t_s=t_s[nodes],
            stamp_s=self.stamps_s(nodes),
            world_from_imu=x.world_from_imu[nodes],
            imu_in_world_m=x.imu_in_world_m[nodes] + nodes_of[:, POSITION],
            velocity_m_s=x.velocity_m_s[nodes] + nodes_of[:, VELOCITY],
            gyro_bias_rad_s=x.gyro_bias_rad_s[nodes],
            accel_bias_m_s2=x.accel_bias_m_s2 + x.accel_walk_m_s2[nodes] + nodes_of[:, ACCEL_BIAS],
            metres_per_unit=x.metres_per_unit * float(np.exp(self._shift_log)),
            gravity_m_s2=x.gravity_m_s2 + along[own + GRAVITY.start : own + GRAVITY.stop],
            accel_delay_s=guess.accel_delay_s + x.accel_delay_s,
            gyro_gain=x.gyro_gain,
            accel_gain=x.accel_gain,
            cam_from_imu=x.cam_from_imu,
            imu_in_cam_m=x.imu_in_cam_m,
            since_middle_s=t_s[nodes] - par.middle_s(t_s),
            cov=cov,
            prior_info=info,
            prior_offset=shared,
        )


def _inverse_square(root: Array) -> Array:
    """The covariance of what a square root of its information is known of."""
    return np.asarray(np.linalg.inv(root.T @ root))
