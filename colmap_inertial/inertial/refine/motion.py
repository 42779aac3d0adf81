"""Where the camera is and how fast, at a solution, and how that depends on what is solved for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import cross, skew
from colmap_inertial.inertial.refine._seen import poses_at, since_middle_s
from colmap_inertial.inertial.refine.values import (
    ACCEL_BIAS,
    CLOCK_RATE,
    GYRO_BIAS,
    LEVER,
    N_STATE,
    OFFSET,
    POSITION,
    ROTATION,
    THETA,
    VELOCITY,
    Estimate,
    Problem,
)

_CENTRE, _SPEED = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, eq=False, kw_only=True)
class Moving:
    """The camera when the middle lines of F frames were exposed.

    Attributes
    ----------
    velocity_m_s
        (F, 3) of its centre, in the world.
    by_state
        (F, 6, 15) derivatives of position and velocity by the frame's own state.
    by_shared
        (F, 6, Q) by what is shared.
    """

    velocity_m_s: Array
    by_state: Array
    by_shared: Array


def moving(problem: Problem, x: Estimate) -> Moving:
    """The camera's motion; it is carried on the lever arm about the IMU."""
    count, at = len(x.velocity_m_s), x.columns
    frames = np.arange(count)
    poses = poses_at(problem, x, frames, np.zeros(count))
    t = poses.since_s[:, None, None]
    start, now, turn = x.world_from_imu, poses.world_from_imu, poses.turn
    arm = np.broadcast_to(-x.cam_from_imu.T @ x.imu_in_cam_m, (count, 3))
    swing = cross(poses.rate, arm)
    by_state, by_shared = np.zeros((count, 6, N_STATE)), np.zeros((count, 6, at.count))
    for rows, body, pushed in ((_CENTRE, arm, 0.5 * t**2), (_SPEED, swing, t)):
        turned = np.einsum("nij,nj->ni", turn, body)
        by_state[:, rows, THETA] = -start @ (skew(turned) + pushed * skew(poses.force))
        by_state[:, rows, ACCEL_BIAS] = -pushed * start
    by_state[:, _CENTRE, POSITION] = np.eye(3)
    by_state[:, _CENTRE, VELOCITY] = t * np.eye(3)
    by_state[:, _SPEED, VELOCITY] = np.eye(3)
    swinging = now @ skew(arm)
    by_state[:, _SPEED, GYRO_BIAS] = swinging
    for columns, by_arm in ((LEVER, -x.cam_from_imu.T), (ROTATION, -x.cam_from_imu.T @ skew(x.imu_in_cam_m))):
        by_shared[:, _CENTRE, columns] = now @ by_arm
        by_shared[:, _SPEED, columns] = now @ skew(poses.rate) @ by_arm
    velocity = poses.velocity_m_s + np.einsum("nij,nj->ni", now, swing)
    if problem.inertial is not None:
        force = np.einsum("nij,nj->ni", start, poses.force) + x.gravity_m_s2 * problem.inertial.down
        # that the arm swings faster and faster is nothing within an offset
        by_time = np.concatenate([velocity, force], axis=1)
        by_shared[:, :, OFFSET] = -by_time
        by_shared[:, :, CLOCK_RATE] = -since_middle_s(problem, frames)[:, None] * by_time
        by_gain = -swinging[:, :, :, None] * problem.inertial.turning.powers[:, 0][:, None, None, :]
        by_shared[:, _SPEED, at.gyro_gain] = by_gain.reshape(count, 3, 9)
    return Moving(velocity_m_s=velocity, by_state=by_state, by_shared=by_shared)
