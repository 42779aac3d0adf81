"""Refinement of rotation, time offset and gyroscope bias together, with an honest covariance."""

from __future__ import annotations

import numpy as np

from colmap_inertial.align._clock_search import ClockFit
from colmap_inertial.align._prior import UNKNOWN_OFFSET_S
from colmap_inertial.errors import NotObservableError
from colmap_inertial.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from colmap_inertial.gyro import GyroPath
from colmap_inertial.types import (
    CALIBRATION_PARAMETERS,
    Array,
    CameraImuCalibration,
    CameraTrajectory,
    ImuRecording,
    clock_shift_s,
)

#: Columns of the refinement among ``CALIBRATION_PARAMETERS``: rotation, gyroscope offset, gyroscope bias.
_FITTED = np.array([0, 1, 2, 3, 5, 6, 7])
_OTHERS = np.setdiff1d(np.arange(len(CALIBRATION_PARAMETERS)), _FITTED)
#: Intervals whose residual is this many times its standard deviation lose weight fast: jumps of the poses.
_OUTLIER_SIGMAS = 4.0
#: Standard deviations beyond which rotation and offset count as not observed.
_OPEN_ROTATION_RAD, _OPEN_OFFSET_S = 0.2, 0.1


def refine_alignment(
    trajectory: CameraTrajectory, imu: ImuRecording, start: ClockFit, prior: CameraImuCalibration
) -> CameraImuCalibration:
    """Gauss-Newton on the rotations between consecutive frames, with their noise estimated along the way.

    Parameters
    ----------
    trajectory
        Frames far enough apart to have turned by more than the noise of a pose.
    imu
        Its gyroscope.
    start
        Where to start: the offset to within a tenth of a second.
    prior
        Takes part as a measurement; its entries that the rotations say nothing about pass through.

    Raises
    ------
    NotObservableError
        Where the rotation about some axis, or the offset, stays open.
    """
    shift_s = clock_shift_s(trajectory, imu)
    prior_mean, prior_info = _prior_of_fitted(prior, start, shift_s)
    rotation, offset_s, bias = start.cam_from_imu_xyzw, start.offset_s, start.gyro_bias_rad_s
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, bias)
    path_bias = bias
    noise: tuple[float, float] | None = None
    for iteration in range(25):
        if iteration in (2, 6):  # the path is linear enough in the bias between these
            path, path_bias = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, bias), bias
        residual, jacobian, dt_s = _residuals(trajectory, path, rotation, offset_s, bias - path_bias)
        if len(residual) < 4:
            raise NotObservableError("time offset", "fewer than four frame intervals lie inside the IMU recording")
        if noise is None:
            spread = float(np.median(np.sum(residual**2, axis=1))) / 2.366 + 1e-14  # median of chi2 with 3 dof
            noise = (0.25 * spread, 0.5 * spread / float(np.median(dt_s)))
        excess = np.ones(len(residual))
        if iteration >= 2:
            sigmas = np.sqrt(np.sum(residual**2, axis=1) / (2 * noise[0] + noise[1] * dt_s))
            excess = np.minimum(np.maximum(sigmas / _OUTLIER_SIGMAS, 1.0) ** 4, 1e8)
        if iteration in (2, 3, 5, 8):
            noise = _noise_of(residual, dt_s, excess, noise)
        white_residual, white_jacobian = _whiten(residual, jacobian, dt_s, excess, noise)
        from_prior = np.concatenate(
            [
                quat_log(quat_multiply(rotation, quat_conjugate(prior_mean[0]))),
                [offset_s - prior_mean[1]],
                bias - prior_mean[2],
            ]
        )
        information = np.einsum("kai,kaj->ij", white_jacobian, white_jacobian)
        gradient = np.einsum("kai,ka->i", white_jacobian, white_residual)
        step = -np.linalg.solve(information + prior_info, gradient + prior_info @ from_prior)
        step[3] = np.clip(step[3], -0.1, 0.1)
        rotation = quat_normalize(quat_multiply(quat_exp(step[:3]), rotation))
        offset_s, bias = offset_s + float(step[3]), bias + step[4:]
        cov = np.linalg.inv(information + prior_info)
        if iteration > 8 and np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(cov))):
            break
    cov = _widened(cov, white_residual, white_jacobian, dt_s)
    axis_sigma = float(np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]))
    if axis_sigma > _OPEN_ROTATION_RAD:
        hint = (
            f"known to no better than {np.degrees(axis_sigma):.0f} deg about one axis: turn the camera about at least "
            "two axes while recording"
        )
        raise NotObservableError("camera-IMU rotation", hint)
    if cov[3, 3] > _OPEN_OFFSET_S**2 or abs(offset_s - start.offset_s) > 0.5:
        hint = "the rotation is too slow to place the clocks to a tenth of a second: turn the camera more briskly"
        raise NotObservableError("time offset", hint)
    return _completed(prior, rotation, offset_s - shift_s, bias, cov)


def _prior_of_fitted(
    prior: CameraImuCalibration, start: ClockFit, shift_s: float
) -> tuple[tuple[Array, float, Array], Array]:
    """Mean (rotation, offset, bias) and information of what is fitted; what is unknown starts at the search's."""
    rotation_known = prior.sigma("rotation_x_rad") < 1
    offset_known = prior.sigma("gyro_time_offset_s") < UNKNOWN_OFFSET_S
    mean = (
        prior.cam_from_imu_xyzw if rotation_known else start.cam_from_imu_xyzw,
        prior.gyro_time_offset_s + shift_s if offset_known else start.offset_s,
        prior.gyro_bias_rad_s,
    )
    return mean, np.linalg.inv(prior.cov[np.ix_(_FITTED, _FITTED)])


def _residuals(
    trajectory: CameraTrajectory, path: GyroPath, cam_from_imu: Array, offset_s: float, bias_change: Array
) -> tuple[Array, Array, Array]:
    """Gyroscope against camera over the covered intervals: residuals (K, 3) rad, derivatives (K, 3, 7), lengths (K,).

    Camera frame at the end of each interval. Columns: rotation, offset, bias.
    """
    t_s = trajectory.t_s - offset_s
    covered = path.covers(t_s[:-1], t_s[1:])
    attitude, rate = path.at(t_s)
    lever = path.bias_lever(t_s)
    turn = quat_multiply(quat_conjugate(attitude[:-1]), attitude[1:])
    by_bias = -matrix_from_quat(quat_conjugate(attitude[1:])) @ (lever[1:] - lever[:-1])
    turn = quat_multiply(turn, quat_exp(by_bias @ bias_change))
    felt = quat_multiply(quat_multiply(cam_from_imu, turn), quat_conjugate(cam_from_imu))
    cam_from_world = trajectory.cam_from_world_xyzw
    seen = quat_multiply(cam_from_world[:-1], quat_conjugate(cam_from_world[1:]))
    residual = quat_log(quat_multiply(quat_conjugate(seen), felt))
    cam_from_imu_matrix = matrix_from_quat(cam_from_imu)
    jacobian = np.empty((len(residual), 3, 7))
    jacobian[:, :, :3] = matrix_from_quat(quat_conjugate(felt)) - np.eye(3)
    turn_back = matrix_from_quat(quat_conjugate(turn))
    jacobian[:, :, 3] = (np.einsum("kij,kj->ki", turn_back, rate[:-1]) - rate[1:]) @ cam_from_imu_matrix.T
    jacobian[:, :, 4:] = cam_from_imu_matrix @ by_bias
    return residual[covered], jacobian[covered], np.diff(trajectory.t_s)[covered]


def _bands(dt_s: Array, excess: Array, noise: tuple[float, float]) -> Array:
    """Lower bands of the covariance of the residuals: pose noise shared by neighbours, gyroscope noise, outliers."""
    pose, rate = noise
    bands = np.zeros((2, len(dt_s)))
    bands[0] = (2 * pose + rate * dt_s) * excess
    bands[1, :-1] = -pose
    return bands


def _whiten(
    residual: Array, jacobian: Array, dt_s: Array, excess: Array, noise: tuple[float, float]
) -> tuple[Array, Array]:
    from scipy.linalg import cholesky_banded, solve_banded

    factor = cholesky_banded(_bands(dt_s, excess, noise), lower=True)
    both = np.concatenate([residual[:, :, None], jacobian], axis=2)
    white = solve_banded((1, 0), factor, both.reshape(len(both), -1)).reshape(both.shape)
    return white[:, :, 0], white[:, :, 1:]


def _noise_of(residual: Array, dt_s: Array, excess: Array, start: tuple[float, float]) -> tuple[float, float]:
    """Variance of a pose (rad2) and density of the rate (rad2/s), by maximum likelihood."""
    from scipy.linalg import cholesky_banded, solve_banded
    from scipy.optimize import minimize

    def cost(logs: Array) -> float:
        factor = cholesky_banded(_bands(dt_s, excess, (float(np.exp(logs[0])), float(np.exp(logs[1])))), lower=True)
        white = solve_banded((1, 0), factor, residual)
        return float(0.5 * np.sum(white**2) + 3 * np.sum(np.log(factor[0])))

    # 1 microradian, 1e-6 rad/s/sqrt(Hz): below any camera and gyroscope, above rounding
    start_logs = np.log(np.maximum(start, 1e-12))
    found = minimize(
        cost,
        start_logs,
        method="Nelder-Mead",
        bounds=[(np.log(1e-12), 0.0)] * 2,
        options={"xatol": 0.02, "fatol": 0.02, "maxiter": 80},
    )
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def _widened(cov: Array, white_residual: Array, white_jacobian: Array, dt_s: Array) -> Array:
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


def _completed(
    prior: CameraImuCalibration, rotation: Array, offset_s: float, bias: Array, cov: Array
) -> CameraImuCalibration:
    """The fitted entries with the prior's others, which follow where they are correlated."""
    before = prior.cov[np.ix_(_FITTED, _FITTED)]
    follow = np.linalg.solve(before, prior.cov[np.ix_(_FITTED, _OTHERS)]).T
    moved = np.zeros(len(_FITTED))
    moved[:3] = quat_log(quat_multiply(rotation, quat_conjugate(prior.cam_from_imu_xyzw)))
    moved[3], moved[4:] = offset_s - prior.gyro_time_offset_s, bias - prior.gyro_bias_rad_s
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
