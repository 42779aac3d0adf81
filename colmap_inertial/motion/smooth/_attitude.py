"""Orientation from gyroscope and camera: the gyroscope owns quick changes, the camera owns drift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_normalize, slerp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import (
    CAL,
    TYPICAL_NOISE,
    CameraTrajectory,
)
from colmap_inertial.motion.smooth._chain import Chain
from colmap_inertial.motion.smooth._models import most_likely, runs_of, worst_outliers

#: Orientations from pictures err independently and, over about this time, together (as features come and go).
_CORRELATION_S = 0.35
#: Usual noise of orientations from pictures, rad: a start for the estimate, which may end far away.
_USUAL_RAD, _SPREAD = 2e-3, 3.0
#: Variance (rad2) that frees the correction where the gyroscope is silent.
_FREE = 1e2
_REACH_S, _OUTLIER_CHI2, _ROUNDS = 0.5, 30.0, 4


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
    logs = np.log([_USUAL_RAD**2, _USUAL_RAD**2])
    for attempt in range(_ROUNDS):
        if attempt < 2:  # once with the worst still in, once without
            run = model.select(runs_of(len(t_s)))
            logs = most_likely(run.chain, logs, expected=np.log([_USUAL_RAD**2] * 2), spread=_SPREAD)
        chain = model.chain(logs)
        wrong, jumped = chain.outlier_statistics()
        left_out, jumps = worst_outliers(t_s, wrong, jumped, limit=_OUTLIER_CHI2, reach=_REACH_S)
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
        decay = np.exp(-dt / _CORRELATION_S)
        transition = np.tile(np.eye(3), (len(dt), 1, 1))
        transition[:, 0, 1], transition[:, 2, 2] = dt, decay
        process = np.zeros((len(dt), 3, 3))
        process[:, 0, 0] = self.density**2 * dt + self.walk**2 * dt**3 / 3 + _FREE * self.silent
        process[:, 0, 1] = process[:, 1, 0] = self.walk**2 * dt**2 / 2
        process[:, 1, 1] = self.walk**2 * dt
        process[:, 2, 2] = correlated * (1 - decay**2)
        return Chain(
            transition=transition,
            process_cov=process,
            drive=np.zeros((len(dt), 3, 3)),
            observed=np.array([1.0, 0.0, 1.0]),
            measured=self.curve,
            measured_var=np.where(self.left_out, _FREE, white),
            initial_information=np.diag([0.0, 1.0 / 0.05**2, 1.0 / correlated]),
        )
