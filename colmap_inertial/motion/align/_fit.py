"""Refinement of rotation, time offset and gyroscope bias together, with an honest covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import epoch_shift_s
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import (
    CAL,
    TYPICAL_NOISE,
    CameraImuCalibration,
    CameraTrajectory,
    ImuRecording,
)
from colmap_inertial.motion.align._clock_search import ClockFit

#: A time offset with at least this standard deviation is unknown: its value carries nothing.
OFFSET_UNKNOWN_FROM_S = 1e3
#: Columns of the refinement among ``CALIBRATION_PARAMETERS``: rotation, gyroscope offset, gyroscope bias.
_FITTED = np.r_[CAL.ROTATION, CAL.GYRO_TIME_OFFSET, CAL.GYRO_BIAS]
_OTHERS = np.setdiff1d(np.arange(CAL.COUNT), _FITTED)
_TURN, _OFFSET, _BIAS = slice(0, 3), 3, slice(4, 7)
#: A clock rate is corrected where it is this many standard deviations from zero, and faster than what the estimators
#: allow for.
_SIGNIFICANT, _FAST_CLOCK = 5.0, 3e-4
#: Intervals whose residual is this many times its standard deviation lose weight fast: jumps of the poses.
_OUTLIER_SIGMAS = 4.0
_N, _N_NUISANCE = len(_FITTED), 19
#: Among the nuisance parameters: rotation of the gyroscope in the IMU (camera axes), its gain (xx, yy, zz, yz, xz,
#: xy of a symmetric matrix), rolling shutter (3, 3), clock rate.
_MOUNT, _GAIN, _SHUTTER, _RATE = slice(0, 3), slice(3, 9), slice(9, 18), 18
#: Data sheets: gain within 1 %, axes within half a percent (of a radian). Clocks of action cameras: within 1 %.
_GAIN_SIGMA, _AXIS_SIGMA, _RATE_SIGMA = 0.01, 0.005 / np.sqrt(2), 0.01
#: Orientation error of a rolling-shutter frame by angular velocity, in parts of the readout time, computed for
#: points all over the image at random depths: a turn about the vertical looks like a roll; along the diagonal it
#: averages out, because poses hold at the middle row.
_SHUTTER_SIGMA_DIAGONAL, _SHUTTER_SIGMA_ELSEWHERE = 0.1, 0.4
#: Standard deviations beyond which rotation and offset count as not observed.
_OPEN_ROTATION_RAD, _OPEN_OFFSET_S = 0.2, 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """Relation of camera and IMU estimated from rotations.

    Attributes
    ----------
    calibration
        With the clock rate that was fitted, be it significant or not; its time offsets hold in the middle of what both
        recorded.
    clock_rate_sigma
        Standard deviation of the clock rate.
    """

    calibration: CameraImuCalibration
    clock_rate_sigma: float

    def drifts(self, faster_than: float = _FAST_CLOCK) -> bool:
        """Whether the clocks drift apart significantly, and faster than the estimators allow for (or than
        ``beyond``).
        """
        return abs(self.calibration.clock_rate) > max(_SIGNIFICANT * self.clock_rate_sigma, faster_than)

    def settle_clock_rate(self) -> CameraImuCalibration:
        """The calibration to continue with: its clock rate is zero unless the clocks drift apart (:meth:`drifts`)."""
        return self.calibration if self.drifts() else replace(self.calibration, clock_rate=0.0)


@dataclass(frozen=True, eq=False)
class _State:
    """State of Gauss-Newton: rotation (xyzw), offset, bias, nuisance parameters."""

    rotation: Array
    offset_s: float
    bias: Array
    nuisance: Array

    def moved(self, step: Array) -> _State:
        return _State(
            quat_normalize(quat_multiply(quat_exp(step[_TURN]), self.rotation)),
            self.offset_s + float(step[_OFFSET]),
            self.bias + step[_BIAS],
            self.nuisance + step[_N:],
        )


def refine_alignment(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    start: ClockFit,
    prior: CameraImuCalibration,
    *,
    clock_rate: float = 0.0,
) -> Alignment:
    """Gauss-Newton on the rotations between consecutive frames, with their noise estimated along the way.

    Beside rotation, offset and bias, three errors that real devices have are fitted within their usual size, so that
    the covariance contains them: gain and misalignment of the gyroscope, the rolling shutter's effect on orientations
    (to first order a matrix times the angular velocity), and the rate of the IMU's clock.

    Parameters
    ----------
    trajectory
        Frames far enough apart to have turned by more than the noise of a pose.
    imu
        Its gyroscope.
    start
        Where to start: the offset in the middle, to within a tenth of a second.
    prior
        Takes part as a measurement; its entries that the rotations say nothing about pass through.
    clock_rate
        Where to start: change of the offset per second.

    Raises
    ------
    NotObservableError
        Where the rotation about some axis, or the offset, stays open.
    """
    shift_s = epoch_shift_s(imu, trajectory.epoch_ns)
    (prior_rotation, prior_offset_s, prior_bias), prior_info = _make_prior(prior, start, shift_s)
    state = _State(start.cam_from_imu_xyzw, start.offset_s, start.gyro_bias_rad_s, np.zeros(_N_NUISANCE))
    state.nuisance[_RATE] = clock_rate
    middle_s = middle_of_overlap(trajectory, imu.gyro_t_s, start.offset_s)
    noise: tuple[float, float] | None = None
    least_density = max((imu.noise or TYPICAL_NOISE).gyro_density_rad_s_rthz, 1e-6)
    for iteration in range(25):
        if iteration in (0, 2, 6):  # the path is linear enough in the bias between these
            path, path_bias = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, state.bias), state.bias
        residual, jacobian, dt_s = _compare_rotations(trajectory, path, state, state.bias - path_bias, middle_s)
        if len(residual) < 4:
            raise NotObservableError("time offset", Fact("too-few-intervals"))
        if noise is None:
            spread = float(np.median(np.sum(residual**2, axis=1))) / 2.366 + 1e-14  # median of chi2 with 3 dof
            noise = (0.25 * spread, 0.5 * spread / float(np.median(dt_s)))
        excess = np.ones(len(residual))
        if iteration >= 2:
            sigmas = np.sqrt(np.sum(residual**2, axis=1) / (2 * noise[0] + noise[1] * dt_s))
            excess = np.minimum(np.maximum(sigmas / _OUTLIER_SIGMAS, 1.0) ** 4, 1e8)
        if iteration in (2, 3, 5, 8):
            noise = _estimate_noise(residual, dt_s, excess, least_density**2)
        white_residual, white_jacobian = _whiten(residual, jacobian, dt_s, excess, noise)
        from_prior = np.concatenate(
            [
                quat_log(quat_multiply(state.rotation, quat_conjugate(prior_rotation))),
                [state.offset_s - prior_offset_s],
                state.bias - prior_bias,
                state.nuisance,
            ]
        )
        information = np.einsum("kai,kaj->ij", white_jacobian, white_jacobian)
        gradient = np.einsum("kai,ka->i", white_jacobian, white_residual)
        step = -np.linalg.solve(information + prior_info, gradient + prior_info @ from_prior)
        step[_OFFSET] = np.clip(step[_OFFSET], -0.1, 0.1)
        state = state.moved(step)
        cov = np.linalg.inv(information + prior_info)
        if iteration > 8 and np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(cov))):
            break
    cov = _widen_for_correlation(cov, white_residual, white_jacobian, dt_s)
    _require_observable(cov, state.offset_s - start.offset_s)
    fitted = _complete_calibration(prior, state.rotation, state.offset_s - shift_s, state.bias, cov[:_N, :_N])
    fitted = replace(fitted, clock_rate=float(state.nuisance[_RATE]), clock_middle_s=middle_s)
    return Alignment(calibration=fitted, clock_rate_sigma=float(np.sqrt(cov[-1, -1])))


def _require_observable(cov: Array, offset_change_s: float) -> None:
    """Refuse rotations that leave an axis or the offset open."""
    axis_sigma = float(np.sqrt(np.linalg.eigvalsh(cov[_TURN, _TURN])[-1]))
    if axis_sigma > _OPEN_ROTATION_RAD:
        raise NotObservableError("camera-IMU rotation", Fact("rotation-axis-open", axis_sigma_rad=axis_sigma))
    if cov[_OFFSET, _OFFSET] > _OPEN_OFFSET_S**2 or abs(offset_change_s) > 0.5:
        raise NotObservableError("time offset", Fact("rotation-too-slow"))


def middle_of_overlap(trajectory: CameraTrajectory, imu_t_s: Array, offset_s: float) -> float:
    """The middle of what both recorded, camera clock."""
    begin_s = max(trajectory.t_s[0], imu_t_s[0] + offset_s)
    end_s = min(trajectory.t_s[-1], imu_t_s[-1] + offset_s)
    return float(0.5 * (begin_s + end_s))


def _make_prior(
    prior: CameraImuCalibration, start: ClockFit, shift_s: float
) -> tuple[tuple[Array, float, Array], Array]:
    """Mean (rotation, offset, bias) and information of what is fitted; what is unknown starts at the search's."""
    rotation_known = prior.sigma("rotation_x_rad") < 1
    offset_known = prior.clock_sigma_s < OFFSET_UNKNOWN_FROM_S
    mean = (
        prior.cam_from_imu_xyzw if rotation_known else start.cam_from_imu_xyzw,
        prior.gyro_time_offset_s + shift_s if offset_known else start.offset_s,
        prior.gyro_bias_rad_s,
    )
    readout_s = float(np.hypot(prior.readout_s, prior.sigma("readout_s")))
    shutter = np.full((3, 3), _SHUTTER_SIGMA_ELSEWHERE)
    np.fill_diagonal(shutter, _SHUTTER_SIGMA_DIAGONAL)
    sigmas = np.concatenate(
        [
            *([_AXIS_SIGMA] * 3, [_GAIN_SIGMA] * 3, [_AXIS_SIGMA] * 3),
            *(readout_s * shutter.ravel() + 1e-6, [_RATE_SIGMA]),
        ]
    )
    info = np.diag(np.concatenate([np.zeros(_N), 1 / sigmas**2]))
    info[:_N, :_N] = np.linalg.inv(prior.cov[np.ix_(_FITTED, _FITTED)])
    return mean, info


def _compare_rotations(
    trajectory: CameraTrajectory, path: GyroPath, state: _State, bias_change: Array, middle_s: float
) -> tuple[Array, Array, Array]:
    """``r_k`` of ``docs/dev/alignment.md#fit``: residuals (K, 3) rad, derivatives (K, 3, 26), lengths (K,).

    Of covered intervals, in the world frame. Columns: rotation, offset, bias, nuisance parameters.
    """
    since_s = trajectory.t_s - middle_s
    t_s = trajectory.t_s - state.offset_s - state.nuisance[_RATE] * since_s
    covered = path.covers(t_s[:-1], t_s[1:])
    attitude, rate, bias_lever, gain_lever = path.at_with_levers(t_s)
    to_end = matrix_from_quat(quat_conjugate(attitude[1:]))
    by_bias = -to_end @ np.diff(bias_lever, axis=0)
    by_gain = to_end @ np.diff(gain_lever, axis=0)
    turn = quat_multiply(quat_conjugate(attitude[:-1]), attitude[1:])
    change = by_bias @ bias_change + by_gain @ state.nuisance[_GAIN]
    turn = quat_multiply(turn, quat_exp(change))
    cam_from_gyro = quat_multiply(quat_exp(state.nuisance[_MOUNT]), state.rotation)
    inertial = quat_multiply(quat_multiply(cam_from_gyro, turn), quat_conjugate(cam_from_gyro))
    inertial_back = matrix_from_quat(quat_conjugate(inertial))
    cam_from_world = trajectory.cam_from_world_xyzw
    visual = quat_multiply(cam_from_world[:-1], quat_conjugate(cam_from_world[1:]))
    residual = quat_log(quat_multiply(quat_conjugate(visual), inertial))
    to_cam = matrix_from_quat(cam_from_gyro)
    rate_in_cam = rate @ to_cam.T
    # the shutter turns each frame by K rate: K[i, j] acts on axis i by the rate about j
    by_shutter = np.einsum("ai,kj->kaij", np.eye(3), rate_in_cam).reshape(-1, 3, 9)
    by_shutter = inertial_back @ by_shutter[:-1] - by_shutter[1:]
    residual += by_shutter @ state.nuisance[_SHUTTER]
    by_offset = np.einsum("kij,kj->ki", inertial_back, rate_in_cam[:-1]) - rate_in_cam[1:]
    jacobian = np.empty((len(residual), 3, _N + _N_NUISANCE))
    jacobian[:, :, _TURN] = jacobian[:, :, _N:][:, :, _MOUNT] = inertial_back - np.eye(3)
    jacobian[:, :, _OFFSET] = by_offset
    jacobian[:, :, _BIAS] = to_cam @ by_bias
    jacobian[:, :, _N:][:, :, _GAIN] = to_cam @ by_gain
    jacobian[:, :, _N:][:, :, _SHUTTER] = by_shutter
    moving = np.einsum("kij,kj->ki", inertial_back, rate_in_cam[:-1] * since_s[:-1, None])
    jacobian[:, :, _N + _RATE] = moving - rate_in_cam[1:] * since_s[1:, None]
    # in the world frame, errors of a pose enter the intervals before and after it equally, whatever the rotation
    to_world = matrix_from_quat(quat_conjugate(cam_from_world[1:]))[covered]
    residual = np.einsum("kij,kj->ki", to_world, residual[covered])
    return residual, to_world @ jacobian[covered], np.diff(trajectory.t_s)[covered]


def _whiten(
    residual: Array, jacobian: Array, dt_s: Array, excess: Array, noise: tuple[float, float]
) -> tuple[Array, Array]:
    """Residuals and derivatives divided by the Cholesky factor of the covariance of the residuals."""
    both = np.concatenate([residual[:, :, None], jacobian], axis=2)
    _whiten_sides(both.reshape(len(both), -1), dt_s, excess, noise)
    return both[:, :, 0], both[:, :, 1:]


def _whiten_sides(sides: Array, dt_s: Array, excess: Array, noise: tuple[float, float]) -> float:
    """Whiten ``sides`` (K, c) in place; returns half the logarithm of the determinant of the covariance (K, K).

    The covariance: pose noise shared by neighbours, gyroscope noise, outliers.
    """
    pose, rate = noise
    half_log_det = _inertial.whiten_tridiagonal((2 * pose + rate * dt_s) * excess, np.full(len(dt_s) - 1, -pose), sides)
    if not np.isfinite(half_log_det):
        raise np.linalg.LinAlgError("the covariance of the residuals is not positive definite")
    return half_log_det


def _estimate_noise(residual: Array, dt_s: Array, excess: Array, least_rate: float) -> tuple[float, float]:
    """Variance of a pose (rad2) and density of the rate (rad2/s), by maximum likelihood.

    The density is at least the sensor's: a few poses could not tell it from nothing, and the bias would look too good.
    """
    least_pose, count = 1e-12, residual.size  # a microradian: below any camera, above rounding

    def best(log_ratio: float) -> tuple[float, float]:
        """Cost and pose variance where the density is ``exp(log_ratio)`` times the latter: a closed form."""
        white, ratio = residual.copy(), float(np.exp(log_ratio))
        half_log_det = _whiten_sides(white, dt_s, excess, (1.0, ratio))
        squares = float(np.sum(white**2))
        pose = min(max(squares / count, least_pose, least_rate / ratio), 1.0, 1 / ratio)
        return 0.5 * squares / pose + 0.5 * count * float(np.log(pose)) + residual.shape[1] * half_log_det, pose

    # All ratios within the bounds, then golden sections about the best one
    ratios = np.linspace(np.log(least_rate), -np.log(least_pose), 25)
    costs = [best(ratio)[0] for ratio in ratios]
    at = int(np.argmin(costs))
    low, high = float(ratios[max(at - 1, 0)]), float(ratios[min(at + 1, len(ratios) - 1)])
    golden = 0.5 * (np.sqrt(5) - 1)
    inner = [high - golden * (high - low), low + golden * (high - low)]
    values = [best(ratio)[0] for ratio in inner]
    while high - low > 0.01:
        if values[0] < values[1]:
            high, inner[1], values[1] = inner[1], inner[0], values[0]
            inner[0] = high - golden * (high - low)
            values[0] = best(inner[0])[0]
        else:
            low, inner[0], values[0] = inner[0], inner[1], values[1]
            inner[1] = low + golden * (high - low)
            values[1] = best(inner[1])[0]
    log_ratio = 0.5 * (low + high)
    pose = best(log_ratio)[1]
    return pose, max(least_rate, pose * float(np.exp(log_ratio)))


def _widen_for_correlation(cov: Array, white_residual: Array, white_jacobian: Array, dt_s: Array) -> Array:
    """Covariance that also holds for errors that are not white.

    The scores of up to twelve parts of the recording scatter as much as the errors really do (cluster-robust
    "sandwich" covariance). Each parameter's variance is raised to what they show; it is never lowered.
    """
    scores = np.einsum("kai,ka->ki", white_jacobian, white_residual)
    parts = min(12, len(scores) // 4)
    if parts < 4:
        return cov
    elapsed = np.cumsum(dt_s)
    part = np.minimum((parts * elapsed / elapsed[-1]).astype(np.intp), parts - 1)
    sums = np.stack([np.bincount(part, scores[:, i], parts) for i in range(scores.shape[1])], axis=1)
    shown = cov @ (sums.T @ sums) @ cov * parts / (parts - 1)
    factor = np.sqrt(np.maximum(np.diag(shown) / np.diag(cov), 1.0))
    return np.asarray(cov * np.outer(factor, factor))


def _complete_calibration(
    prior: CameraImuCalibration, rotation: Array, offset_s: float, bias: Array, cov: Array
) -> CameraImuCalibration:
    """The fitted entries with the prior's others, which follow where they are correlated."""
    before = prior.cov[np.ix_(_FITTED, _FITTED)]
    follow = np.linalg.solve(before, prior.cov[np.ix_(_FITTED, _OTHERS)]).T
    moved = np.zeros(len(_FITTED))
    moved[_TURN] = quat_log(quat_multiply(rotation, quat_conjugate(prior.cam_from_imu_xyzw)))
    moved[_OFFSET], moved[_BIAS] = offset_s - prior.gyro_time_offset_s, bias - prior.gyro_bias_rad_s
    others = np.concatenate([[prior.accel_time_offset_s], prior.imu_in_cam_m, [prior.readout_s]])
    others = others + follow @ moved
    full = np.empty_like(prior.cov)
    full[np.ix_(_FITTED, _FITTED)] = cov
    full[np.ix_(_OTHERS, _FITTED)] = follow @ cov
    full[np.ix_(_FITTED, _OTHERS)] = (follow @ cov).T
    left = prior.cov[np.ix_(_OTHERS, _OTHERS)] - follow @ prior.cov[np.ix_(_FITTED, _OTHERS)]
    full[np.ix_(_OTHERS, _OTHERS)] = left + follow @ cov @ follow.T
    return CameraImuCalibration(
        cam_from_imu_xyzw=rotation,
        gyro_time_offset_s=offset_s,
        accel_time_offset_s=float(others[0]),
        gyro_bias_rad_s=bias,
        imu_in_cam_m=others[1:4],
        readout_s=float(others[4]),
        cov=0.5 * (full + full.T),
    )
