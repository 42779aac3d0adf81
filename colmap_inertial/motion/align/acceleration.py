"""Acceleration as the poses show it and as the accelerometer measured it, in the world, without what is slow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_rotate
from colmap_inertial.core.sampling import without_running_mean
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording

#: Window of the quadratics whose second derivative is the visual acceleration.
ACCELERATION_S = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class QuickAccelerations:
    """What changes within some two windows; N instants of the poses.

    Attributes
    ----------
    inertial_m_s2
        (N, 3) specific force.
    visual
        (N, 3) second derivative of the camera's centre, its unit per s2.
    arm_per_s2
        (N, 3, 3) second derivative of ``world_from_imu``: times a lever arm in metres, what that adds to the former.
    steadiness
        Length of the mean specific force over the mean of its lengths, both of windows: one where gravity is steady in
        the world and accelerations cancel.
    seconds
        How long the instants last.
    """

    inertial_m_s2: Array
    visual: Array
    arm_per_s2: Array
    steadiness: float
    seconds: float


def quick_accelerations(
    poses: CameraTrajectory, imu: ImuRecording, calibration: CameraImuCalibration
) -> QuickAccelerations | None:
    """Both accelerations at the poses' instants; ``None`` where frames are too sparse or too few."""
    step_s = float(np.median(np.diff(poses.t_s)))
    half = round(0.5 * ACCELERATION_S / step_s)
    if half < 3 or len(poses) < 40 * half:
        return None
    timed = CameraTimedImu(imu=imu, calibration=calibration, camera_epoch_ns=poses.epoch_ns)
    t_s = poses.t_s - calibration.drift_s(poses.t_s) - timed.accel_offset_s
    time = step_s * np.arange(-half, half + 1)
    basis = np.stack([np.ones(len(time)), time, time**2], axis=1)
    second = 2 * np.linalg.pinv(basis)[2][::-1]
    mean = np.ones(len(time)) / len(time)
    force = np.stack([np.interp(t_s, imu.accel_t_s, column) for column in imu.accel_m_s2.T], axis=1)
    world_from_imu = quat_multiply(quat_conjugate(poses.cam_from_world_xyzw), calibration.cam_from_imu_xyzw)
    inertial = _filtered(quat_rotate(world_from_imu, force), mean)
    visual = _filtered(poses.cam_in_world, second)
    arm = _filtered(matrix_from_quat(world_from_imu).reshape(-1, 9), second)
    even = np.abs(poses.t_s[2 * half :] - poses.t_s[: -2 * half] - 2 * half * step_s) < 0.1 * step_s
    even &= (t_s[half:-half] > imu.accel_t_s[0]) & (t_s[half:-half] < imu.accel_t_s[-1])
    width = 4 * half
    if even.sum() < 2 * width - 1:
        return None
    quick = [without_running_mean(values[even], width) for values in (inertial, visual, arm)]
    lengths = np.linalg.norm(inertial[even], axis=1)
    return QuickAccelerations(
        inertial_m_s2=quick[0],
        visual=quick[1],
        arm_per_s2=quick[2].reshape(-1, 3, 3),
        steadiness=float(np.linalg.norm(inertial[even].mean(axis=0)) / max(float(lengths.mean()), 1e-12)),
        seconds=len(quick[0]) * step_s,
    )


def _filtered(values: Array, kernel: Array) -> Array:
    return np.stack([np.convolve(column, kernel, "valid") for column in values.T], axis=1)
