"""Measurements and priors of the joint fit, from a recording and a calibration.

Frames of a video are averaged to one pose an eighth of a second. Averaging keeps what every frame says without a state
for every frame. Within a group the IMU tells the motion far better than images do, so frames are compared after
moving them to the group's mean instant: rotations by the gyroscope, centres by what the accelerometer and gravity add
to a uniform motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply, so3_exp, so3_log
from colmap_inertial.core.types import CAL, CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Estimate, Prior
from colmap_inertial.inertial.core.preintegration import SensorStreams, find_saturated
from colmap_inertial.inertial.core.priors import PRIORS, gains_cov

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
class Measurements:
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
        Densities of white noise that would make the streams as rough as they are (:func:`roughness`).
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
    # 4e-6 m against steps of 0.1 ms, a small part of what images err by.
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


#: Standard deviation of rows' times about the middle row, in readouts (uniform over the image).
_ROW_SPREAD = 12**-0.5
#: Scene depths that turn row times into errors of rotation by velocity (1/m) and of position by rate (m).
_NEAR_M, _FAR_M = 1.0, 2.0
#: An alignment's covariance stems from the very data that are used again here.
_COUNTED_ONCE = 5.0
_MIN_STATES, _FEWEST_READINGS = 8, 4
#: Frames nearer to the recording's ends than this are left out.
_MARGIN_S = 0.02
#: Recordings with more states than the first have fewer of them in a second, down to the second.
_MANY_STATES, _FEWEST_HZ = 2400.0, 2.0


def roughness(t_s: Array, values: Array) -> float:
    """Density of the white noise that would make samples as rough as they are; more than the noise where they move.

    From third differences, which leave little of a motion that is slow against the samples: 20 times the variance of
    white noise.

    Parameters
    ----------
    t_s, values
        (N,), (N, 3) samples.
    """
    if len(t_s) < 4:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(values, 3, axis=0) ** 2) / 20 * np.median(np.diff(t_s))))


def prepare(
    trajectory: CameraTrajectory,
    timed: CameraTimedImu,
    *,
    gravity_m_s2: float,
    gravity_sigma_m_s2: float,
    states_hz: float,
) -> tuple[Measurements, Prior]:
    """Measurements at the nodes, and the prior, whose mean is the starting point.

    Raises
    ------
    NotObservableError
        When too few frames lie inside the IMU recording.
    """
    imu, calibration = timed.imu, timed.calibration
    gyro_cut, accel_cut = find_saturated(imu)
    for sensor, cut in (("gyroscope", gyro_cut), ("accelerometer", accel_cut)):
        if np.sum(~cut) < _FEWEST_READINGS:
            raise NotObservableError("scale", Fact("sensor-saturated", sensor=sensor))
    streams = SensorStreams.from_camera(timed)
    begin_s = max(streams.gyro.t_s[0], streams.accel.t_s[0]) + _MARGIN_S
    end_s = min(streams.gyro.t_s[-1], streams.accel.t_s[-1]) - _MARGIN_S
    inside = np.flatnonzero((trajectory.t_s >= begin_s) & (trajectory.t_s <= end_s))
    centre = trajectory.cam_in_world[inside]
    cam_from_imu = matrix_from_quat(calibration.cam_from_imu_xyzw)
    groups = _group_poses(trajectory, inside, streams, calibration, states_hz)
    world_from_cam = groups.world_from_cam
    pose_cov = None
    if trajectory.pose_cov is not None:
        pose_cov = np.add.reduceat(trajectory.pose_cov[inside], groups.first, axis=0) / groups.count[:, None, None]
    rotation_shape, centre_shape, coupling = _whiten_poses(pose_cov, world_from_cam)
    data = Measurements(
        groups=groups,
        origin=centre.mean(axis=0),
        rotation_shape=rotation_shape,
        centre_shape=centre_shape,
        coupling=coupling,
        broken=find_breaks(groups.t_s, groups.centre),
        streams=streams,
        gyro_roughness_rad_s_rthz=roughness(imu.gyro_t_s, imu.gyro_rad_s),
        accel_roughness_m_s2_rthz=roughness(imu.accel_t_s, imu.accel_m_s2),
        gyro_cut_share=float(gyro_cut.mean()),
        accel_cut_share=float(accel_cut.mean()),
    )

    world_from_imu = world_from_cam @ cam_from_imu
    mean_force = np.mean((world_from_imu @ streams.accel.at(data.t_s)[0][:, :, None])[:, :, 0], axis=0)
    gravity = -mean_force * gravity_m_s2 / max(float(np.linalg.norm(mean_force)), 1e-9)
    mean = Estimate.at_start(
        world_from_imu, gravity, cam_from_imu, calibration.imu_in_cam_m, calibration.gyro_bias_rad_s
    )
    prior = Prior(
        mean=mean,
        info=_prior_information(calibration, imu),
        gravity_m_s2=gravity_m_s2,
        gravity_sigma_m_s2=gravity_sigma_m_s2,
    )
    return data, prior


def _group_poses(
    trajectory: CameraTrajectory,
    inside: IndexArray,
    streams: SensorStreams,
    calibration: CameraImuCalibration,
    states_hz: float,
) -> Groups:
    """Averaged poses of the frames inside the recording; refuse too few, or a camera that does not move."""
    centre = trajectory.cam_in_world[inside]
    if len(inside) and float(np.max(np.ptp(centre, axis=0))) == 0.0:
        raise NotObservableError("scale", Fact("camera-still"))
    groups = None
    if len(inside) > 1:
        span_s = float(trajectory.t_s[inside[-1]] - trajectory.t_s[inside[0]])
        groups = group_frames(
            trajectory.t_s[inside],
            matrix_from_quat(trajectory.cam_from_world_xyzw[inside]).transpose(0, 2, 1),
            centre - centre.mean(axis=0),
            rate_hz=max(min(_MANY_STATES / span_s, states_hz), min(_FEWEST_HZ, states_hz)),
            streams=streams,
            gyro_bias_rad_s=calibration.gyro_bias_rad_s,
            cam_from_imu=matrix_from_quat(calibration.cam_from_imu_xyzw),
        )
    k = 0 if groups is None else len(groups.t_s)
    if groups is None or k < _MIN_STATES:
        raise NotObservableError("scale", Fact("poses-too-few", count=k, needed=_MIN_STATES))
    return groups


def _prior_information(calibration: CameraImuCalibration, imu: ImuRecording) -> Array:
    """(79, 79) prior information of the globals; none for scale and gravity.

    The readings of a calibrated IMU are corrected already: the mean of its gains stays 0, and what is left of them is
    as uncertain as the calibration says, and as they change with age and temperature.
    """
    cov = calibration.cov
    variance = np.diagonal(cov)
    gyro, accel = CAL.GYRO_TIME_OFFSET, CAL.ACCEL_TIME_OFFSET
    accel_delay_s = float(np.sqrt(max(variance[gyro] + variance[accel] - 2 * cov[gyro, accel], 1e-8)))
    row_spread_s = _ROW_SPREAD * float(np.hypot(calibration.readout_s, np.sqrt(variance[CAL.READOUT])))
    sigma = np.full(par.N_GLOBALS, np.inf)
    sigma[par.ACCEL_BIAS] = PRIORS.accel_bias_m_s2
    sigma[par.ACCEL_DELAY] = accel_delay_s
    sigma[par.GYRO_GAIN] = PRIORS.gyro_gain
    sigma[par.ACCEL_GAIN] = PRIORS.accel_gain
    sigma[par.ROTATION] = np.maximum(_COUNTED_ONCE * np.sqrt(variance[CAL.ROTATION]), 1e-6)
    sigma[par.LEVER] = np.maximum(np.sqrt(variance[CAL.LEVER_ARM]), 1e-6)
    sigma[par.DELAY] = np.clip(_COUNTED_ONCE * np.sqrt(variance[gyro]), 1e-6, 0.1)
    sigma[par.CLOCK_RATE] = PRIORS.clock_rate
    shutter = row_spread_s * np.array([1.0, 1 / _NEAR_M, _FAR_M, 1.0])
    sigma[par.SHUTTER] = np.maximum(np.repeat(shutter, 9), 1e-9)
    sigma[par.COUPLING] = PRIORS.coupling_m
    info = np.diag(sigma**-2)
    if imu.calibration is not None:
        here = np.r_[par.ACCEL_GAIN, par.GYRO_GAIN]
        info[np.ix_(here, here)] = np.linalg.inv(gains_cov(imu))
    return info


def _whiten_poses(pose_cov: Array | None, world_from_cam: Array) -> tuple[Array, Array, Array]:
    """Relative covariances of frames from covariances of the poses; their overall levels are estimated."""
    k = len(world_from_cam)
    if pose_cov is None:
        eye = np.tile(np.eye(3), (k, 1, 1))
        return eye, eye, np.zeros((k, 3, 3))
    rotation, cross, centre = pose_cov[:, :3, :3], pose_cov[:, 3:, :3], pose_cov[:, 3:, 3:]
    slack = 1e-6 * np.trace(rotation, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    carried = cross @ np.linalg.inv(rotation + slack)
    rest = centre - carried @ cross.transpose(0, 2, 1)
    coupling = world_from_cam.transpose(0, 2, 1) @ carried
    return _whiten_relative(rotation), _whiten_relative(rest), coupling


def _whiten_relative(cov: Array) -> Array:
    """Square roots of the information relative to the median level; no direction counts more than tenfold."""
    level = float(np.median(np.trace(cov, axis1=1, axis2=2))) / 3
    if not level > 0:
        return np.tile(np.eye(3), (len(cov), 1, 1))
    relative = 0.5 * (cov + cov.transpose(0, 2, 1)) / level + 0.1 * np.eye(3)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(relative)))
