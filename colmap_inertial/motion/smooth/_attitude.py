"""Orientation from gyroscope and camera: the gyroscope owns quick changes, the camera owns drift.

Also the accelerometer in the world frame, integrated once and twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    slerp,
)
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.sampling import Coverage
from colmap_inertial.core.types import (
    CAL,
    TYPICAL_NOISE,
    CameraTrajectory,
)
from colmap_inertial.motion.smooth._positions import Chain, most_likely, runs_of, worst_outliers


@dataclass(frozen=True, kw_only=True)
class AttitudeLimits:
    """Usual errors of visual rotations, and when one is an outlier."""

    #: Orientations from images err independently and, over about this time, together (as features come and go).
    correlation_s: float = 0.35
    #: Usual noise of orientations from images, rad: a start for the estimate, which may end far away.
    usual_rad: float = 2e-3
    spread: float = 3.0
    #: Variance (rad2) that frees the correction where the gyroscope is silent.
    free: float = 1e2
    reach_s: float = 0.5
    outlier_chi2: float = 30.0
    rounds: int = 4


_LIMITS = AttitudeLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Attitude:
    """Orientation of the IMU at any instant of the recording.

    Attributes
    ----------
    t_s
        (T,) frame times, camera clock.
    world_from_imu_xyzw
        (T, 4) smoothed orientations at the frames.
    sigma_rad
        (T,) their standard deviations, each axis.
    """

    t_s: Array
    world_from_imu_xyzw: Array
    sigma_rad: Array
    path: GyroPath

    def at(self, query_s: Array) -> tuple[Array, Array]:
        """``world_from_imu`` (M, 4) and angular velocity in the IMU frame (M, 3) in rad/s at camera times."""
        world_from_start = quat_multiply(self.world_from_imu_xyzw, quat_conjugate(self.path.at(self.t_s)[0]))
        start_from_imu, rate = self.path.at(query_s)
        # the correction of the gyroscope's drift changes slowly: between frames it follows the shortest way
        correction = slerp(self.t_s, world_from_start, np.clip(query_s, self.t_s[0], self.t_s[-1]))
        return quat_normalize(quat_multiply(correction, start_from_imu)), rate


def smooth_attitude(trajectory: CameraTrajectory, timed: CameraTimedImu) -> Attitude:
    """Fuse the orientations of the frames with the gyroscope between them.

    What the gyroscope's path lacks to the camera's orientations is a slow curve: white rate noise, a bias that walks,
    and the noise of the frames, white and correlated, whose sizes are those of the greatest likelihood. Where the
    gyroscope is silent, the camera's orientations stand.

    Parameters
    ----------
    trajectory
        Its orientations are used; any length unit.
    timed
        Gyroscope, and its rotation and bias.
    """
    t_s, imu, calibration = trajectory.t_s, timed.imu, timed.calibration
    path = GyroPath(timed.gyro_t_s, imu.gyro_rad_s, calibration.gyro_bias_rad_s)
    world_from_cam = quat_conjugate(trajectory.cam_from_world_xyzw)
    seen = quat_multiply(world_from_cam, calibration.cam_from_imu_xyzw)
    correction = quat_multiply(seen, quat_conjugate(path.at(t_s)[0]))
    # summed up from frame to frame, because over a long recording it may exceed half a turn
    steps = quat_log(quat_multiply(correction[1:], quat_conjugate(correction[:-1])))
    curve = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    # an error of the bias is constant in the IMU's frame: as the IMU turns, it walks in the world's
    bias_sigma = np.sqrt(np.trace(calibration.cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS]) / 3)
    rate_rms = np.sqrt(np.mean(np.sum(path.rate_rad_s**2, axis=1)))
    noise = imu.noise or TYPICAL_NOISE
    model = _Model(
        t_s=t_s,
        curve=curve,
        silent=~path.covers(t_s[:-1], t_s[1:]),
        left_out=np.zeros(len(t_s), dtype=bool),
        density=noise.gyro_density_rad_s_rthz,
        walk=float(np.hypot(noise.gyro_walk_rad_s2_rthz, bias_sigma * rate_rms)),
    )
    logs = np.log([_LIMITS.usual_rad**2, _LIMITS.usual_rad**2])
    for attempt in range(_LIMITS.rounds):
        if attempt < 2:  # once with the worst still in, once without
            run = model.select(runs_of(len(t_s)))
            logs = most_likely(run.chain, logs, expected=np.log([_LIMITS.usual_rad**2] * 2), spread=_LIMITS.spread)
        chain = model.chain(logs)
        wrong, jumped = chain.outlier_statistics()
        left_out, jumps = worst_outliers(t_s, wrong, jumped, limit=_LIMITS.outlier_chi2, reach=_LIMITS.reach_s)
        if not (left_out.any() or jumps.any()):
            break
        model = replace(model, left_out=model.left_out | left_out, silent=model.silent | jumps)
    smoothed = chain.states[:, 0]
    world_from_imu = quat_multiply(quat_exp(smoothed - curve), seen)
    return Attitude(
        t_s=t_s,
        world_from_imu_xyzw=quat_normalize(world_from_imu),
        sigma_rad=np.sqrt(chain.cov[:, 0, 0]),
        path=path,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Model:
    """The correction at the frames (T, 3); intervals in which it may jump; frames that are left out."""

    t_s: Array
    curve: Array
    silent: BoolArray
    left_out: BoolArray
    density: float
    walk: float

    def select(self, index: IndexArray) -> _Model:
        silent = np.concatenate([[0], np.cumsum(self.silent)])[index]
        return replace(
            self,
            t_s=self.t_s[index],
            curve=self.curve[index],
            silent=np.diff(silent) > 0,
            left_out=self.left_out[index],
        )

    def chain(self, logs: Array) -> Chain:
        """Correction, drift rate and correlated error; ``logs`` of the variances of white and correlated error."""
        white, correlated = np.exp(logs)
        dt = np.diff(self.t_s)
        decay = np.exp(-dt / _LIMITS.correlation_s)
        transition = np.tile(np.eye(3), (len(dt), 1, 1))
        transition[:, 0, 1], transition[:, 2, 2] = dt, decay
        process = np.zeros((len(dt), 3, 3))
        process[:, 0, 0] = self.density**2 * dt + self.walk**2 * dt**3 / 3 + _LIMITS.free * self.silent
        process[:, 0, 1] = process[:, 1, 0] = self.walk**2 * dt**2 / 2
        process[:, 1, 1] = self.walk**2 * dt
        process[:, 2, 2] = correlated * (1 - decay**2)
        return Chain(
            transition=transition,
            process_cov=process,
            drive=np.zeros((len(dt), 3, 3)),
            observed=np.array([1.0, 0.0, 1.0]),
            measured=self.curve,
            measured_var=np.where(self.left_out, _LIMITS.free, white),
            initial_information=np.diag([0.0, 1.0 / 0.05**2, 1.0 / correlated]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldAcceleration:
    """Acceleration of the IMU in the world, linear between samples, with its integrals from the first sample.

    Attributes
    ----------
    t_s
        (M,) camera clock.
    accel_m_s2, velocity_m_s, position_m
        (M, 3).
    """

    t_s: Array
    accel_m_s2: Array
    velocity_m_s: Array
    position_m: Array

    @classmethod
    def of(
        cls,
        timed: CameraTimedImu,
        attitude: Attitude,
        *,
        bias_m_s2: Array,
        gravity_in_world_m_s2: Array,
    ) -> WorldAcceleration:
        """Turn the readings into the world, without their bias and gravity."""
        world_from_imu, _ = attitude.at(timed.accel_t_s)
        accel = quat_rotate(world_from_imu, timed.imu.accel_m_s2 - bias_m_s2) + gravity_in_world_m_s2
        return cls.integrated(timed.accel_t_s, accel)

    @classmethod
    def integrated(cls, t_s: Array, accel_m_s2: Array) -> WorldAcceleration:
        """Integrate an acceleration (M, 3) that is linear between its samples."""
        step = np.diff(t_s)[:, None]
        gained = step * 0.5 * (accel_m_s2[1:] + accel_m_s2[:-1])
        velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])
        moved = step * velocity[:-1] + step**2 / 6 * (2 * accel_m_s2[:-1] + accel_m_s2[1:])
        position = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
        return cls(t_s=t_s, accel_m_s2=accel_m_s2, velocity_m_s=velocity, position_m=position)

    @property
    def step_s(self) -> float:
        """Usual interval between samples."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def variance(self) -> float:
        """Variance of the motion, each axis (m2/s4)."""
        return float(np.mean(np.var(self.accel_m_s2, axis=0)))

    @property
    def sample_variance(self) -> float:
        """Variance of one sample's noise, each axis, from deviations from straight lines (m2/s4)."""
        bend = self.accel_m_s2[2:] - 2 * self.accel_m_s2[1:-1] + self.accel_m_s2[:-2]
        # median of the square of a normal variable: 0.455; a second difference has six times the variance
        return float(np.median(bend**2)) / 0.455 / 6

    def covers(self, t_s: Array) -> BoolArray:
        """(T-1,) which intervals between these times have samples throughout."""
        return Coverage(self.t_s).covers(t_s[:-1], t_s[1:])

    def at(self, t_s: Array) -> tuple[Array, BoolArray]:
        """Acceleration (T, 3), zero where there are no samples, and whether there are."""
        here = self.covers(np.append(t_s, t_s[-1]) if len(t_s) == 1 else t_s)
        sampled = np.append(here, False) | np.append(False, here)
        accel = np.stack([np.interp(t_s, self.t_s, self.accel_m_s2[:, k]) for k in range(3)], axis=1)
        return np.where(sampled[:, None], accel, 0.0), sampled

    def sums(self, t_s: Array) -> Array:
        """(T, 2, 3) position and velocity gained since the first sample."""
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        step = self.t_s[i + 1] - self.t_s[i]
        since = np.clip(t_s - self.t_s[i], 0.0, step)[:, None]
        start, slope = self.accel_m_s2[i], (self.accel_m_s2[i + 1] - self.accel_m_s2[i]) / step[:, None]
        velocity = self.velocity_m_s[i] + since * start + since**2 / 2 * slope
        position = self.position_m[i] + since * self.velocity_m_s[i] + since**2 / 2 * start + since**3 / 6 * slope
        return np.stack([position, velocity], axis=1)
