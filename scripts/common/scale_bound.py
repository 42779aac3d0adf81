"""How well the scale of a simulated recording can be known at all: the Bayesian Cramer-Rao bound.

Separate from the estimator on purpose: other states, other linearisation, other algorithm. The errors of an inertial
navigation that runs along (orientation, velocity, position of the IMU, biases), of structure from motion (white noise,
Ornstein-Uhlenbeck noise, drift) and of everything that calibrates them are one Gaussian process, linearised at the
truth, with the true noise levels. A Kalman filter over the frames at full rate propagates its covariance; the last one
knows what all data say about the constants, the scale among them. No data enter, only the motion: the result is the
inverse of the Fisher information plus that of the priors. It is a bound, as noise levels are unknown in practice.

Not modelled, and refused: rolling shutter, drift of scale and orientation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.inertial.core.priors import PRIORS, model_scale_sigma
from colmap_inertial.tools.simulate import ImuErrors, Motion, RecordingOptions, SimulatedRecording
from colmap_inertial.tools.simulate.sensors import true_rate_rad_s, true_specific_force_m_s2

#: Integration steps per frame, and the step of a numerical derivative.
_SUBSTEPS = 4
_DERIVATIVE_S = 1e-3


@dataclass(frozen=True, kw_only=True)
class BoundPriors:
    """Standard deviations, those of the estimator where it states them; 0 is known, and the large ones say nothing."""

    log_scale: float = 10.0
    attitude_rad: float = 1.0
    position_m: float = 100.0
    velocity_m_s: float = 100.0
    gyro_bias_rad_s: float = 1.0
    accel_bias_m_s2: float = PRIORS.accel_bias_m_s2
    gyro_gain: float = PRIORS.gyro_gain
    accel_gain: float = PRIORS.accel_gain
    gravity_m_s2: float = PRIORS.gravity_m_s2
    gravity_direction_m_s2: float = 10.0
    cam_from_imu_rad: float = 1.0
    imu_in_cam_m: tuple[float, float, float] = (0.08, 0.08, 0.01)
    time_offset_s: float = 1.0
    accel_delay_s: float = 0.02
    clock_rate: float = PRIORS.clock_rate
    model_scale: float = model_scale_sigma()


# Columns of the errors. World frame, but for the biases (IMU frame) and the correlated error of rotations (camera).
PHI, VELOCITY, POSITION, GYRO_BIAS, ACCEL_BIAS, TURN, SHIFT, DRIFT = (slice(3 * i, 3 * i + 3) for i in range(8))
GYRO_GAIN, ACCEL_GAIN = slice(24, 33), slice(33, 42)
GRAVITY, MOUNTING, LEVER = slice(42, 45), slice(45, 48), slice(48, 51)
OFFSET, ACCEL_DELAY, CLOCK_RATE, SCALE = 51, 52, 53, 54
SIZE = 55


def bound_of(recording: SimulatedRecording, options: RecordingOptions, priors: BoundPriors | None = None) -> float:
    """:func:`scale_bound` of a recording that was simulated with these options."""
    return scale_bound(recording.truth.motion, recording.truth.imu.errors, options, priors)


def scale_bound(
    motion: Motion, errors: ImuErrors, options: RecordingOptions, priors: BoundPriors | None = None
) -> float:
    """Posterior standard deviation of the logarithm of the scale.

    Parameters
    ----------
    motion, errors
        The camera's path, and the mounting of its IMU.
    options
        Duration, noise of the IMU and of structure from motion, gravity. What is drawn from its ``_sd`` fields is
        described by ``priors`` instead.
    priors
        What is known beforehand.
    """
    priors = priors or BoundPriors()
    sfm = options.sfm
    if sfm.readout_s or sfm.scale_drift_rts or sfm.rotation_drift_rad_rts:
        raise ValueError("no bound with rolling shutter, or drift of scale or orientation")
    dt_s = 1 / sfm.frame_rate_hz
    t_s = np.arange(int(options.motion.duration_s * sfm.frame_rate_hz)) * dt_s
    step, noise = _between_frames(motion, errors, options, t_s)
    seen = _seen(motion, errors, t_s)
    seen_noise = np.diag(np.repeat([sfm.rotation_white_rad**2, sfm.position_white_m**2], 3))
    decay = np.ones(SIZE)
    decay[TURN] = decay[SHIFT] = math.exp(-dt_s / sfm.correlation_s)
    walk = np.zeros(SIZE)
    walk[GYRO_BIAS] = options.imu.gyro_walk_rad_s2_rthz**2 * dt_s
    walk[ACCEL_BIAS] = options.imu.accel_walk_m_s3_rthz**2 * dt_s
    walk[TURN] = sfm.rotation_correlated_rad**2 * (1 - decay[TURN] ** 2)
    walk[SHIFT] = sfm.position_correlated_m**2 * (1 - decay[SHIFT] ** 2)
    walk[DRIFT] = sfm.position_drift_m_rts**2 * dt_s

    cov = np.diag(_before(priors, options))
    for k in range(len(t_s)):
        if k:
            # Only the first nine rows mix
            moved = step[k - 1] @ cov
            cov = cov * decay[:, None] * decay
            cov[:9, 9:] = moved[:, 9:] * decay[9:]
            cov[9:, :9] = cov[:9, 9:].T
            cov[:9, :9] = moved @ step[k - 1].T + noise[k - 1]
            cov[np.diag_indices(SIZE)] += walk
        carried = seen[k] @ cov
        root = np.linalg.cholesky(carried @ seen[k].T + seen_noise)
        gain = np.linalg.solve(root, carried)
        cov = cov - gain.T @ gain
    return math.hypot(math.sqrt(cov[SCALE, SCALE]), priors.model_scale)


def _before(priors: BoundPriors, options: RecordingOptions) -> Array:
    """(55,) variances at the first frame; the world's z axis is up, so that the third of gravity is its magnitude."""
    sigma = np.zeros(SIZE)
    sigma[PHI], sigma[VELOCITY], sigma[POSITION] = priors.attitude_rad, priors.velocity_m_s, priors.position_m
    sigma[GYRO_BIAS], sigma[ACCEL_BIAS] = priors.gyro_bias_rad_s, priors.accel_bias_m_s2
    sigma[TURN], sigma[SHIFT] = options.sfm.rotation_correlated_rad, options.sfm.position_correlated_m
    sigma[GYRO_GAIN], sigma[ACCEL_GAIN] = priors.gyro_gain, priors.accel_gain
    sigma[GRAVITY] = priors.gravity_direction_m_s2, priors.gravity_direction_m_s2, priors.gravity_m_s2
    sigma[MOUNTING], sigma[LEVER] = priors.cam_from_imu_rad, priors.imu_in_cam_m
    sigma[OFFSET], sigma[ACCEL_DELAY], sigma[CLOCK_RATE] = priors.time_offset_s, priors.accel_delay_s, priors.clock_rate
    sigma[SCALE] = priors.log_scale
    return sigma**2


def _between_frames(motion: Motion, errors: ImuErrors, options: RecordingOptions, t_s: Array) -> tuple[Array, Array]:
    """(N - 1, 9, 55) how errors become those of orientation, velocity and position a frame later; (N - 1, 9, 9) noise.

    phi' = R dw,  v' = dg - [R f] phi + R df,  p' = v with dw and df the errors of the readings: biases, gains, and
    readings of another instant than assumed.
    """
    h = (t_s[1] - t_s[0]) / _SUBSTEPS
    count, dt = len(t_s) - 1, np.eye(3) * h
    step = np.zeros((count, 9, SIZE))
    step[:, :, :9] = np.eye(9)
    noise = np.zeros((count, 9, 9))
    density = options.imu.gyro_density_rad_s_rthz**2, options.imu.accel_density_m_s2_rthz**2
    fresh = np.zeros((9, 9))
    fresh[PHI, PHI] = density[0] * dt
    fresh[VELOCITY, VELOCITY] = density[1] * dt
    fresh[VELOCITY, POSITION] = fresh[POSITION, VELOCITY] = density[1] * dt * h / 2
    fresh[POSITION, POSITION] = density[1] * dt * h**2 / 3
    middle_s = 0.5 * (t_s[0] + t_s[-1])
    cam_from_imu = matrix_from_quat(errors.cam_from_imu_xyzw)
    gravity = options.gravity_m_s2
    for i in range(_SUBSTEPS):
        now_s = t_s[:-1] + (i + 0.5) * h
        k = motion.at(now_s)
        to_world = matrix_from_quat(k.world_from_cam_xyzw) @ cam_from_imu
        rate = true_rate_rad_s(motion, errors, now_s)
        rate_dot = k.rate_dot_in_cam_rad_s2 @ cam_from_imu
        force = true_specific_force_m_s2(motion, errors, now_s, gravity)
        later, earlier = (
            true_specific_force_m_s2(motion, errors, now_s + sign * _DERIVATIVE_S, gravity) for sign in (1, -1)
        )
        force_dot = (later - earlier) / (2 * _DERIVATIVE_S)

        turned = np.zeros((count, 3, SIZE))  # phi' by the errors
        pushed = np.zeros((count, 3, SIZE))  # v' by the errors
        turned[:, :, GYRO_BIAS] = pushed[:, :, ACCEL_BIAS] = to_world
        turned[:, :, GYRO_GAIN] = (to_world[:, :, :, None] * rate[:, None, None, :]).reshape(count, 3, 9)
        pushed[:, :, ACCEL_GAIN] = (to_world[:, :, :, None] * force[:, None, None, :]).reshape(count, 3, 9)
        turned[:, :, OFFSET] = (to_world @ rate_dot[:, :, None])[:, :, 0]
        pushed[:, :, OFFSET] = pushed[:, :, ACCEL_DELAY] = (to_world @ force_dot[:, :, None])[:, :, 0]
        for by in (turned, pushed):
            by[:, :, CLOCK_RATE] = by[:, :, OFFSET] * (now_s - middle_s)[:, None]
        pushed[:, :, GRAVITY] = np.eye(3)
        lean = -skew((to_world @ force[:, :, None])[:, :, 0])
        forced = pushed + 0.5 * h * lean @ turned

        advance = np.tile(np.eye(9), (count, 1, 1))
        advance[:, VELOCITY, PHI] = h * lean
        advance[:, POSITION, PHI] = 0.5 * h**2 * lean
        advance[:, POSITION, VELOCITY] = dt
        step = advance @ step
        step[:, PHI] += h * turned
        step[:, VELOCITY] += h * forced
        step[:, POSITION] += 0.5 * h**2 * forced
        noise = advance @ noise @ advance.transpose(0, 2, 1) + fresh
    return step, noise


def _seen(motion: Motion, errors: ImuErrors, t_s: Array) -> Array:
    """(N, 6, 55) visual rotation (camera frame) and centre (world, metres) by the errors."""
    k = motion.at(t_s)
    to_world = matrix_from_quat(k.world_from_cam_xyzw)
    arm = skew(to_world @ errors.imu_in_cam_m)
    centre = k.cam_in_world_m - k.cam_in_world_m.mean(axis=0)
    seen = np.zeros((len(t_s), 6, SIZE))
    rotation, position = seen[:, :3], seen[:, 3:]
    rotation[:, :, PHI] = to_world.transpose(0, 2, 1)
    rotation[:, :, MOUNTING] = rotation[:, :, TURN] = np.eye(3)
    position[:, :, POSITION] = position[:, :, SHIFT] = position[:, :, DRIFT] = np.eye(3)
    position[:, :, PHI] = arm
    position[:, :, MOUNTING] = arm @ to_world
    position[:, :, LEVER] = -to_world
    position[:, :, SCALE] = -centre
    return seen
