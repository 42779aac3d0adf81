"""Frames of a video, an eighth of a second at a time: one averaged pose for each state of the joint fit.

Averaging keeps what every frame says without a state for every frame. Within a group the IMU tells the motion far
better than pictures do, so frames are compared after moving them to the group's mean instant: rotations by the
gyroscope, centres by what the accelerometer and gravity add to a uniform motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply, so3_exp, so3_log
from colmap_inertial.inertial.core.preintegration import SensorStreams

#: Longest step of the integration from a group's mean instant to a frame.
_STEP_S = 0.01
#: A step is a break where it is this many times as surprising as steps usually are, altogether and among the nearest;
#: known only where states are at most so far apart.
_BREAK, _NEAR, _DENSE_S = 9.0, 10, 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class Groups:
    """K groups of frames, each with the motion around its mean instant.

    Attributes
    ----------
    first
        (K,) index of a group's first frame; groups are consecutive.
    count
        (K,) numbers of frames.
    t_s
        (K,) mean times of the frames.
    world_from_cam
        (K, 3, 3) means of the rotations, moved to ``t_s``.
    centre
        (K, 3) means of the centres.
    spread_s2
        (K,) mean squares of the frames' times about ``t_s``.
    rotation_since
        (K, 3, 3) means of the body's rotation since ``t_s``.
    displacement_m
        (K, 3) means of what the readings of the accelerometer add to the position since ``t_s``, body frame at ``t_s``.
    rate_rad_s
        (K, 3) mean readings of the gyroscope, body frame.
    """

    first: IndexArray
    count: IndexArray
    t_s: Array
    world_from_cam: Array
    centre: Array
    spread_s2: Array
    rotation_since: Array
    displacement_m: Array
    rate_rad_s: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Data:
    """Measurements at K nodes, each the mean of a few frames of the camera.

    Attributes
    ----------
    groups
        Visual rotations and centres in model units, about their mean.
    origin
        (3,) that mean, in the model's world.
    rotation_shape, centre_shape
        (K, 3, 3) square roots of the information of the visual rotation (camera frame) and of the centre (world frame)
        given the rotation, for a noise level of one.
    coupling
        (K, 3, 3) model units per radian: the error of the centre (camera frame) that comes with an error of the
        rotation, as far as the covariances of the poses tell.
    broken
        (K - 1,) where the model's parts may be shifted against each other.
    streams
        Readings over camera time, by the first guess of the offsets.
    gyro_roughness_rad_s_rthz, accel_roughness_m_s2_rthz
        Densities of white noise that would make the streams as rough as they are (``_noise.roughness``).
    gyro_cut_share, accel_cut_share
        Parts of the readings that stand at the end of the sensor's range; they count as gaps.
    """

    groups: Groups
    origin: Array
    rotation_shape: Array
    centre_shape: Array
    coupling: Array
    broken: BoolArray
    streams: SensorStreams
    gyro_roughness_rad_s_rthz: float
    accel_roughness_m_s2_rthz: float
    gyro_cut_share: float
    accel_cut_share: float

    @property
    def t_s(self) -> Array:
        """(K,) camera time."""
        return self.groups.t_s


def first_of_groups(t_s: Array, rate_hz: float, pauses: Array) -> IndexArray:
    """Indices where a new group begins: ``1 / rate_hz`` after the last beginning, and after a pause of the IMU.

    Parameters
    ----------
    t_s
        (F,) times of the frames.
    rate_hz
        Groups per second; sparser frames are groups of their own.
    pauses
        (F - 1,) seconds of pauses of the IMU between consecutive frames.
    """
    step = 1 / rate_hz
    slack = 0.5 * min(float(np.median(np.diff(t_s))), step) if len(t_s) > 1 else 0.0
    begins: list[int] = []
    last = -np.inf
    paused = np.concatenate([[False], pauses > 0]).tolist()
    for i, t in enumerate(t_s.tolist()):
        if t - last >= step - slack or paused[i]:
            begins.append(i)
            last = t
    return np.array(begins, dtype=np.intp)


def find_breaks(t_s: Array, centre: Array) -> BoolArray:
    """Between which of K states (K,), (K, 3) the path jumps, as where a reconstruction lost and found its way again.

    A displacement is compared with the median velocity of its neighbours. Of eight recordings no step is more than six
    times as far from it as steps usually are. Sparse frames tell nothing: anything may happen between them.

    Returns
    -------
    (K - 1,) mask.
    """
    dt_s = np.diff(t_s)
    if len(dt_s) < 2 * _NEAR or np.median(dt_s) > _DENSE_S:
        return np.zeros(len(dt_s), dtype=np.bool_)
    velocity = np.diff(centre, axis=0) / dt_s[:, None]
    around = [np.roll(velocity, shift, axis=0) for shift in (-3, -2, -1, 1, 2, 3)]
    surprise = np.linalg.norm(velocity - np.median(around, axis=0), axis=1) * dt_s
    usual = float(np.median(surprise))
    nearby = np.median([np.roll(surprise, shift) for shift in range(-_NEAR, _NEAR + 1)], axis=0)
    return np.asarray(surprise > _BREAK * np.maximum(nearby, usual))


def group_frames(
    t_s: Array,
    world_from_cam: Array,
    centre: Array,
    *,
    rate_hz: float,
    streams: SensorStreams,
    gyro_bias_rad_s: Array,
    cam_from_imu: Array,
) -> Groups:
    """Average the poses of frames (F,), (F, 3, 3), (F, 3) in groups.

    Parameters
    ----------
    streams
        Readings over camera time; the frames lie inside.
    gyro_bias_rad_s
        (3,) subtracted from the readings.
    cam_from_imu
        (3, 3) from the alignment: its error matters little over the small rotations within a group.
    """
    first = first_of_groups(t_s, rate_hz, np.add(*streams.gap_s(t_s)))
    count = np.diff(first, append=len(t_s))
    group = np.repeat(np.arange(len(first)), count)

    def mean(values: Array) -> Array:
        total = np.add.reduceat(values, first, axis=0)
        return np.asarray(total / count.reshape(-1, *[1] * (values.ndim - 1)))

    mean_s = mean(t_s)
    since_s = t_s - mean_s[group]
    steps = max(1, int(np.ceil(np.abs(since_s).max() / _STEP_S)))
    step_s = since_s / steps
    rotated = np.zeros((len(t_s), 4))
    rotated[:, 3] = 1.0
    # The midpoint rule, of order two in the step: on three recordings at 100 Hz its errors are at most 6e-5 rad and
    # 4e-6 m against steps of 0.1 ms, a small part of what pictures err by.
    # Two integrations at once: each step's force, at its middle, acts on the position for the rest of the time
    displacement = np.zeros((len(t_s), 3))
    for i in range(steps):
        middle_s = mean_s[group] + (i + 0.5) * step_s
        half = quat_exp((streams.gyro.at(middle_s)[0] - gyro_bias_rad_s) * (0.5 * step_s)[:, None])
        rotated = quat_multiply(rotated, half)
        force = (matrix_from_quat(rotated) @ streams.accel.at(middle_s)[0][:, :, None])[:, :, 0]
        displacement += force * (step_s * (steps - i - 0.5) * step_s)[:, None]
        rotated = quat_multiply(rotated, half)
    turns = matrix_from_quat(rotated)
    moved = world_from_cam @ (cam_from_imu @ turns.transpose(0, 2, 1) @ cam_from_imu.T)
    reference = moved[first][group]
    away = mean(so3_log(reference.transpose(0, 2, 1) @ moved))
    return Groups(
        first=first,
        count=count,
        t_s=mean_s,
        world_from_cam=moved[first] @ so3_exp(away),
        centre=mean(centre),
        spread_s2=mean(since_s**2),
        rotation_since=mean(turns),
        displacement_m=mean(displacement),
        rate_rad_s=mean(streams.gyro.at(t_s)[0]),
    )
