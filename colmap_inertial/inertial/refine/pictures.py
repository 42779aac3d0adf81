"""The problem of images alone, without an IMU, and how its observations err."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Int64Array
from colmap_inertial.inertial.refine._residuals import derivatives, project
from colmap_inertial.inertial.refine.setup import Seen, free_cameras, intrinsics_of
from colmap_inertial.inertial.refine.values import FIRST_INTRINSIC, N_POSE, POSITION, Estimate, Prior, Problem

#: Points this much nearer or farther than a path is long are left out.
_EXTREME = 1e4
#: No observation is better.
_LEAST_PX = 0.05
#: Noise is measured by this quantile of the squares of both coordinates, which for normal errors is that of chi-square
#: with two degrees: a robust fit follows the quieter observations, and the median is a tenth too small.
_QUANTILE = 0.75
#: Cells of an image, across and down, in which errors are looked at together: residuals of real keypoints are alike up
#: to a sixth of its width.
_CELLS = 4
#: Frames with fewer observations do not tell.
_FEWEST = 20


def make_pictures(seen: Seen) -> tuple[Problem, Estimate]:
    """The problem of images alone, as a global shutter sees them, cameras free; and the model as its estimate.

    The IMU stands where the camera does, as nothing is known of it.
    """
    seen = remove_extremes(seen)
    cameras = free_cameras(seen, True)
    intrinsics, spread = intrinsics_of(cameras)
    still, none = np.zeros_like(seen.cam_in_world), np.zeros((3, 3))
    x = Estimate(
        world_from_imu=seen.cam_from_world.transpose(0, 2, 1),
        imu_in_world_m=seen.cam_in_world,
        velocity_m_s=still,
        gyro_bias_rad_s=still,
        accel_bias_m_s2=still,
        points_m=seen.points,
        cam_from_imu=np.eye(3),
        imu_in_cam_m=np.zeros(3),
        offset_s=0.0,
        clock_rate=0.0,
        readout_s=0.0,
        intrinsics=intrinsics,
        accel_delay_s=0.0,
        gyro_gain=none,
        accel_gain=none,
        gravity_m_s2=0.0,
    )
    # what images do not tell counts as known
    sigma = np.full(x.columns.count, 1e-4)
    sigma[FIRST_INTRINSIC : x.columns.seen.stop] = spread
    prior = Prior(mean=x, info=np.diag(sigma**-2), gyro_bias_sigma_rad_s=1.0, accel_bias_sigma_m_s2=1.0)
    problem = Problem(
        observations=seen.observations,
        cameras=cameras,
        camera_of=seen.camera_of,
        inertial=None,
        prior=prior,
        sigma_px=1.0,
    )
    return problem, x


def remove_extremes(seen: Seen) -> Seen:
    """A model without points that are extremely near to one of their cameras, or far, by the path's extent.

    Beside their observations, rounding hides what the others tell.
    """
    observed = seen.observations
    away = seen.points[observed.point] - seen.cam_in_world[observed.frame]
    depth = np.einsum("ni,ni->n", seen.cam_from_world[observed.frame, 2], away)
    extent = float(np.linalg.norm(np.ptp(seen.cam_in_world, axis=0)))
    wrong = (depth < extent / _EXTREME) | (depth > extent * _EXTREME)
    return select_points(seen, np.bincount(observed.point, wrong, minlength=len(seen.points)) == 0)


def select_points(seen: Seen, kept: BoolArray) -> Seen:
    """A model of some of its points."""
    observed = seen.observations
    mine = kept[observed.point]
    return replace(
        seen,
        point_ids=tuple(np.array(seen.point_ids)[kept].tolist()),
        points=seen.points[kept],
        observations=observed.select_points(kept),
        place=seen.place[mine],
    )


def pictures_alone(problem: Problem, xy_px: Array) -> Problem:
    """The problem without the IMU, of observations that a global shutter would have made."""
    observations = problem.observations
    at_once = replace(observations, xy_px=xy_px, line=np.zeros(len(xy_px)))
    return replace(problem, observations=at_once, inertial=None)


@dataclass(frozen=True, kw_only=True)
class ImageNoise:
    """Noise of observations, and its robust loss.

    Attributes
    ----------
    sigma_px
        Standard deviation, each coordinate, by a quantile of the residuals.
    robust_px
        Scale of the loss.
    weighed_px
        What errors are divided by, so that they weigh as much as they tell: the loss takes weight off errors that are
        only large, not false, and leaves less of their noise than of their slope (Huber 1964). With twice the noise as
        its scale, observations would weigh 0.6 of what they should beside the IMU.
    informs
        What they tell over what their weights say: the weights are those of steps, steeper than the loss is curved.
    shared_errors
        Of :func:`measure_shared_errors`.
    """

    sigma_px: float
    robust_px: float
    weighed_px: float
    informs: float
    shared_errors: float


def measure_image_noise(problem: Problem, x: Estimate) -> ImageNoise:
    """Noise of observations, from the residuals of a fit and its number of parameters."""
    observations = problem.observations
    at = project(problem, x, observations)
    squares = np.sum(at.residual[at.seen] ** 2, axis=1)
    used = 3 * len(x.points_m) + 6 * len(x.velocity_m_s)
    squares = squares / max(0.2, 1 - used / (2 * len(observations.frame)))
    sigma_px = max(_LEAST_PX, float(np.sqrt(np.quantile(squares, _QUANTILE) / (-2 * np.log(1 - _QUANTILE)))))
    # noise alone shall not lose its weight
    robust_px = max(problem.robust_px, 2 * sigma_px)
    weight = 1 / (1 + squares / robust_px**2)
    # of what the loss pulls with: its mean slope by the error, and its variance, in two coordinates
    slope = float(np.mean(weight**2))
    variance = float(np.mean(squares * weight**2)) / (2 * sigma_px**2)
    return ImageNoise(
        sigma_px=sigma_px,
        robust_px=robust_px,
        weighed_px=max(_LEAST_PX, sigma_px * float(np.sqrt(variance / slope))),
        informs=slope / float(np.mean(weight)),
        shared_errors=measure_shared_errors(replace(problem, robust_px=robust_px), x),
    )


def measure_shared_errors(problem: Problem, x: Estimate) -> float:
    """Variance of poses by their observations, over what independent errors would make of it; 1 or more.

    Neighbouring keypoints err alike, and so from frame to frame: by what the camera model leaves of the lens, by blur,
    by what is left of a rolling shutter. What residuals pull at their frame's pose with is summed in each of 4 x 4
    cells of the image, over as many frames as see a point. Independent errors give these sums the variance of the
    cell's information, less what the pose took of them (variances by clusters: Liang and Zeger, Biometrika 1986; of
    what lasts: Newey and West, Econometrica 1987). What all of an image shares is the pose's, and not seen.

    Parameters
    ----------
    problem, x
        Observations, with their robust loss, and a solution.
    """
    observations, at = problem.observations, project(problem, x, problem.observations)
    frame, frames, cells = observations.frame, len(x.velocity_m_s), _CELLS**2
    weight = 1 / (1 + np.sum(at.residual**2, axis=1) / problem.robust_px**2)
    pull = weight[:, None] * at.residual
    by_pose = derivatives(problem, x, observations, at, np.ones(len(frame))).by_frame[:, :, :N_POSE].copy()
    # along the body's axes, in which what lasts stays as it is
    by_pose[:, :, POSITION] = by_pose[:, :, POSITION] @ x.world_from_imu[frame]
    size = np.array([(camera.model.width, camera.model.height) for camera in problem.cameras])
    place = observations.xy_px / size[problem.camera_of[frame]] * _CELLS
    column, row = np.clip(place.astype(np.int64), 0, _CELLS - 1).T
    cell = (frame * _CELLS + column) * _CELLS + row
    by_cell = _sum_by(cell, frames * cells, by_pose.transpose(0, 2, 1) @ by_pose)
    by_cell = by_cell.reshape(frames, cells, N_POSE, N_POSE)
    whole = by_cell.sum(axis=1)
    told = np.flatnonzero(np.bincount(frame[at.seen], minlength=frames) >= _FEWEST)
    told = told[np.linalg.cond(whole[told]) < 1 / np.finfo(np.float64).eps]
    if not len(told):
        return 1.0
    # poses that their observations do not determine say nothing
    cov, root = np.zeros_like(whole), np.zeros_like(whole)
    cov[told] = np.linalg.inv(whole[told])
    root[told] = np.linalg.cholesky(cov[told])
    moved = (cov @ _sum_by(frame, frames, by_pose.transpose(0, 2, 1) @ pull[:, :, None]))[:, :, 0]
    left = pull - np.einsum("nri,ni->nr", by_pose, moved[frame])
    sums = _sum_by(cell, frames * cells, np.einsum("nri,nr->ni", by_pose, left)).reshape(frames, cells, N_POSE)
    lasts = min(frames, max(1, round(len(frame) / len(x.points_m))))
    added = np.pad(np.cumsum(sums @ root, axis=0), ((lasts, lasts - 1), (0, 0), (0, 0)), mode="constant")
    added[frames + lasts :] = added[frames + lasts - 1]
    squares = float(np.sum((added[lasts:] - added[:-lasts]) ** 2)) / lasts
    share = cov[:, None] @ by_cell
    expected = float(np.mean(pull**2)) * float(np.einsum("fcii->", share) - np.einsum("fcij,fcji->", share, share))
    return max(1.0, squares / expected)


def _sum_by(group: Int64Array, groups: int, values: Array) -> Array:
    """(G, ...) sums of values (N, ...) by group."""
    out = np.zeros((groups, *values.shape[1:]))
    np.add.at(out, group, values)
    return out


def apply_noise(problem: Problem, noise: ImageNoise) -> Problem:
    """The problem with its observations weighed so."""
    return replace(
        problem,
        sigma_px=noise.weighed_px,
        robust_px=noise.robust_px,
        informs=noise.informs,
        shared_errors=noise.shared_errors,
    )
