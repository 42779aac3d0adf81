"""The problem of pictures alone, without an IMU, and how its observations err."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.inertial.refine._residuals import project
from colmap_inertial.inertial.refine.setup import Seen, free_cameras, intrinsics_of
from colmap_inertial.inertial.refine.values import FIRST_INTRINSIC, Estimate, Prior, Problem

#: Points this much nearer or farther than a path is long are left out.
_EXTREME = 1e4
#: No observation is better.
_LEAST_PX = 0.05
#: Noise is measured by this quantile of the squares of both coordinates, which for normal errors is that of chi-square
#: with two degrees: a robust fit follows the quieter observations, and the median is a tenth too small.
_QUANTILE = 0.75


def make_pictures(seen: Seen) -> tuple[Problem, Estimate]:
    """The problem of pictures alone, as a global shutter sees them, cameras free; and the model as its estimate.

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
    # what pictures do not tell counts as known
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
class PictureNoise:
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
    """

    sigma_px: float
    robust_px: float
    weighed_px: float
    informs: float


def measure_picture_noise(problem: Problem, x: Estimate) -> PictureNoise:
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
    return PictureNoise(
        sigma_px=sigma_px,
        robust_px=robust_px,
        weighed_px=max(_LEAST_PX, sigma_px * float(np.sqrt(variance / slope))),
        informs=slope / float(np.mean(weight)),
    )


def apply_noise(problem: Problem, noise: PictureNoise) -> Problem:
    """The problem with its observations weighed so."""
    return replace(problem, sigma_px=noise.weighed_px, robust_px=noise.robust_px, informs=noise.informs)
