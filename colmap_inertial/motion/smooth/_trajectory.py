"""Positions smoothed with the accelerometer: right for video and for keyframes seconds apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_multiply, quat_normalize, quat_rotate
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    TYPICAL_NOISE,
    CameraImuCalibration,
    CameraTrajectory,
    ImuRecording,
    SmoothedTrajectory,
)
from colmap_inertial.motion.smooth._attitude import Attitude, WorldAcceleration, smooth_attitude
from colmap_inertial.motion.smooth._positions import (
    Chain,
    SmoothOptions,
    most_likely,
    runs_of,
    white_acceleration,
    white_jerk,
    worst_outliers,
)


@dataclass(frozen=True, kw_only=True)
class TrajectoryLimits:
    """Usual errors of a model's poses, and when one is an outlier."""

    #: Time over which errors of positions from images stay correlated, as features come and go.
    correlation_s: float = 0.35
    #: Correlation time of motion that nothing measures.
    motion_s: float = 0.2
    #: Gain and misalignment of IMUs, by their data sheets: motion too quick for the camera is wrong by this much of it.
    gain_sigma: float = 0.01
    #: An instant this close to a pose is that of the pose.
    same_s: float = 1e-6
    #: Variance (m2) that frees a pose or a transition; how far an outlier makes its neighbours look like outliers.
    free: float = 1e4
    reach_s: float = 0.5
    rounds: int = 5
    most_outliers: float = 0.1


_LIMITS = TrajectoryLimits()

#: Usual standard deviations, as a weak prior of their estimates: white and correlated error of a position (m); white
#: noise of the accelerometer with all that errs like it (m/s2/sqrt(Hz)); walk of what gravity, bias and tilt leave
#: (m/s2/sqrt(s)). Natural logarithms of the variances spread by this much around them.
_USUAL, _SPREAD = np.array([3e-3, 3e-3, 1e-2, 1e-2]), 4.0


@one_blas_thread()
def smooth_trajectory(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    calibration: CameraImuCalibration,
    *,
    gravity_in_world_m_s2: Array,
    accel_bias_m_s2: Array | None = None,
    also_at_s: Array | None = None,
    options: SmoothOptions | None = None,
) -> SmoothedTrajectory:
    """Smooth a metric camera path with the IMU recorded with it.

    The accelerometer, turned into the world by orientations from gyroscope and camera, drives positions and
    velocities from frame to frame; what it leaves (tilt, bias, gravity) is an acceleration that walks. Positions from
    images err independently and together over a third of a second. The four noise levels are those of the greatest
    likelihood; a pose that contradicts the rest is left out. Smoothing is that of Rauch, Tung and Striebel.

    Parameters
    ----------
    trajectory
        Metric (``length_unit`` "m"), at least six poses; its world may point anywhere.
    imu
        Both sensors; where they are silent, the camera alone is smoothed.
    calibration
        Rotation, time offsets with their clock rate, gyroscope bias, lever arm.
    gravity_in_world_m_s2
        (3,) points down, in the trajectory's world.
    accel_bias_m_s2
        (3,) IMU frame; zero if not given.
    also_at_s
        Instants without a pose, camera clock: between poses and beyond them the IMU goes on alone, and the covariance
        grows. Instants before the IMU's first sample or after its last are passed over.
    options
        When to leave a pose out.

    Returns
    -------
    The camera's path at the frame times, and the others asked for, with its covariance (position, velocity,
    acceleration); smoothed orientations.

    Raises
    ------
    NotObservableError
        For fewer than six poses, without an accelerometer, or where the IMU recorded during none of the frame
        intervals.
    """
    _require_smoothable(trajectory, imu)
    timed = CameraTimedImu.from_recording(imu, calibration, trajectory.epoch_ns)
    attitude = smooth_attitude(trajectory, timed)
    bias = np.zeros(3) if accel_bias_m_s2 is None else np.asarray(accel_bias_m_s2, dtype=np.float64)
    inertial = WorldAcceleration.of(
        timed, attitude, bias_m_s2=bias, gravity_in_world_m_s2=np.asarray(gravity_in_world_m_s2, dtype=np.float64)
    )
    t_s, silent = trajectory.t_s, ~inertial.covers(trajectory.t_s)
    if silent.all():
        raise NotObservableError("smoothed trajectory", Fact("imu-in-no-interval"))

    world_from_imu, _ = attitude.at(t_s)
    imu_from_cam = quat_conjugate(calibration.cam_from_imu_xyzw)
    lever = quat_rotate(imu_from_cam, calibration.imu_in_cam_m)  # from the camera to the IMU, IMU frame
    origin = trajectory.cam_in_world.mean(axis=0)
    model = _Model(
        t_s=t_s,
        measured=trajectory.cam_in_world - origin + quat_rotate(world_from_imu, lever),
        gained=inertial.sums(t_s),
        silent=silent,
        left_out=np.zeros(len(t_s), dtype=bool),
        jumps=np.zeros(len(t_s) - 1, dtype=bool),
        motion_density=2 * _LIMITS.motion_s * inertial.variance,
    )
    model, logs = _remove_outliers(model, (options or SmoothOptions()).outlier_chi2)
    if also_at_s is not None:
        model = _insert_instants(model, inertial, also_at_s)
    chain, t_s = model.chain(logs), model.t_s
    world_from_imu, rate = attitude.at(t_s)

    states, cov = chain.states, chain.cov[:, :3, :3].copy()
    # acceleration of the IMU: the sample itself, and what was found to be missing
    measured_accel, sampled = inertial.at(t_s)
    accel = states[:, 2] + measured_accel
    cov[:, 2, 2] += np.where(sampled, inertial.sample_variance, inertial.variance)
    # from the IMU to the camera
    turning, centripetal = np.cross(rate, lever), np.cross(rate, np.cross(rate, lever))
    spin = _rate_of_change(attitude, t_s, inertial.step_s)
    cov[:, 2, 2] += _spin_variance(imu, inertial.step_s) * float(lever @ lever)
    cov[:, 1, 1] += _LIMITS.gain_sigma**2 * float(np.mean(np.var(states[:, 1], axis=0)))
    return SmoothedTrajectory(
        t_s=t_s,
        cam_in_world=states[:, 0] + origin - quat_rotate(world_from_imu, lever),
        velocity_in_world=states[:, 1] - quat_rotate(world_from_imu, turning),
        accel_in_world=accel - quat_rotate(world_from_imu, np.cross(spin, lever) + centripetal),
        cam_from_world_xyzw=quat_normalize(quat_conjugate(quat_multiply(world_from_imu, imu_from_cam))),
        cov=np.asarray(np.kron(cov, np.eye(3)), dtype=np.float64),
        length_unit="m",
        epoch_ns=trajectory.epoch_ns,
    )


def _require_smoothable(trajectory: CameraTrajectory, imu: ImuRecording) -> None:
    if trajectory.length_unit != "m":
        raise ValueError("smooth_trajectory needs a metric trajectory")
    if len(trajectory) < 6:
        raise NotObservableError("smooth motion", Fact("poses-too-few-to-smooth", count=len(trajectory)))
    if not imu.has_accel:
        raise NotObservableError("smooth motion", Fact("no-accelerometer-for-gravity"))


def _insert_instants(model: _Model, inertial: WorldAcceleration, also_at_s: Array) -> _Model:
    """The model with states at instants that nothing was measured at."""
    asked = np.unique(np.asarray(also_at_s, dtype=np.float64))
    nearest = np.minimum(np.searchsorted(model.t_s, asked), len(model.t_s) - 1)
    new = np.minimum(np.abs(model.t_s[nearest] - asked), np.abs(model.t_s[nearest - 1] - asked)) > _LIMITS.same_s
    asked = asked[new & (asked > inertial.t_s[0]) & (asked < inertial.t_s[-1])]
    t_s = np.concatenate([model.t_s, asked])
    order = np.argsort(t_s)
    t_s, posed = t_s[order], np.argsort(order)[: len(model.t_s)]
    measured = np.stack([np.interp(t_s, model.t_s, model.measured[:, k]) for k in range(3)], axis=1)
    left_out = np.ones(len(t_s), dtype=bool)
    left_out[posed] = model.left_out
    jumps = np.zeros(len(t_s) - 1, dtype=bool)
    jumps[posed[:-1]] = model.jumps
    gained, silent = inertial.sums(t_s), ~inertial.covers(t_s)
    return replace(model, t_s=t_s, measured=measured, gained=gained, silent=silent, left_out=left_out, jumps=jumps)


def _rate_of_change(attitude: Attitude, t_s: Array, step_s: float) -> Array:
    """(T, 3) angular acceleration, from readings two samples apart."""
    return (attitude.at(t_s + step_s)[1] - attitude.at(t_s - step_s)[1]) / (2 * step_s)


def _spin_variance(imu: ImuRecording, step_s: float) -> float:
    """Variance of that angular acceleration, from the gyroscope's white noise."""
    density = (imu.noise or TYPICAL_NOISE).gyro_density_rad_s_rthz
    return 2 * density**2 / step_s / (2 * step_s) ** 2


@dataclass(frozen=True, eq=False, kw_only=True)
class _Model:
    """Positions of the IMU at the frames (T, 3), what the accelerometer gained until then (T, 2, 3), and the outliers.

    ``silent`` are intervals without accelerometer: motion of ``motion_density`` (white acceleration) fills them.
    """

    t_s: Array
    measured: Array
    gained: Array
    silent: BoolArray
    left_out: BoolArray
    jumps: BoolArray
    motion_density: float

    def select(self, index: IndexArray) -> _Model:
        def any_between(flags: BoolArray) -> BoolArray:
            return np.diff(np.concatenate([[0], np.cumsum(flags)])[index]) > 0

        return replace(
            self,
            t_s=self.t_s[index],
            measured=self.measured[index],
            gained=self.gained[index],
            silent=any_between(self.silent),
            left_out=self.left_out[index],
            jumps=any_between(self.jumps),
        )

    def chain(self, logs: Array) -> Chain:
        """Position, velocity, missing acceleration, correlated error; ``logs`` of the four variances."""
        white, correlated, accel, walk = np.exp(logs)
        dt = np.diff(self.t_s)
        decay = np.exp(-dt / _LIMITS.correlation_s)
        transition = np.tile(np.eye(4), (len(dt), 1, 1))
        transition[:, 0, 1] = transition[:, 1, 2] = dt
        transition[:, 0, 2] = 0.5 * dt**2
        transition[:, 3, 3] = decay
        process = np.zeros((len(dt), 4, 4))
        process[:, :3, :3] = walk * white_jerk(dt)
        density = np.where(self.silent, self.motion_density, accel)
        process[:, :2, :2] += density[:, None, None] * white_acceleration(dt)
        process[:, 0, 0] += _LIMITS.free * self.jumps
        process[:, 3, 3] = correlated * (1 - decay**2)
        drive = np.zeros((len(dt), 4, 3))
        drive[:, 0] = np.diff(self.gained[:, 0], axis=0) - dt[:, None] * self.gained[:-1, 1]
        drive[:, 1] = np.diff(self.gained[:, 1], axis=0)
        drive[self.silent] = 0.0
        return Chain(
            transition=transition,
            process_cov=process,
            drive=drive,
            observed=np.array([1.0, 0.0, 0.0, 1.0]),
            measured=self.measured,
            measured_var=np.where(self.left_out, _LIMITS.free, white),
            initial_information=np.diag([0.0, 0.0, 0.0, 1.0 / correlated]),
        )


def _remove_outliers(model: _Model, limit: float) -> tuple[_Model, Array]:
    """The model without the poses and with the jumps that contradict the rest, and its noise."""
    usual = 2 * np.log(_USUAL)
    logs = usual
    for attempt in range(_LIMITS.rounds):
        if attempt < 2:  # once with the worst still in, once without
            run = model.select(runs_of(len(model.t_s)))
            logs = most_likely(run.chain, logs, expected=usual, spread=_SPREAD)
        chain = model.chain(logs)
        wrong, jumped = chain.outlier_statistics()
        left_out, jumps = worst_outliers(model.t_s, wrong, jumped, limit=limit, reach=_LIMITS.reach_s)
        left_out, jumps = model.left_out | left_out, model.jumps | jumps
        removed = left_out.sum() + jumps.sum()
        if removed == model.left_out.sum() + model.jumps.sum() or removed > _LIMITS.most_outliers * len(model.t_s):
            break
        model = replace(model, left_out=left_out, jumps=jumps)
    return model, logs
