"""From a recording and a calibration to the measurements and priors of the joint fit."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CAL, CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Estimate, Prior
from colmap_inertial.inertial.core.preintegration import SensorStreams, find_saturated
from colmap_inertial.inertial.core.priors import PRIORS, gains_cov
from colmap_inertial.inertial.scale._grouping import Data, Groups, find_breaks, group_frames
from colmap_inertial.inertial.scale._noise import roughness

#: Standard deviation of rows' times about the middle row, in readouts (uniform over the picture).
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


def prepare(
    trajectory: CameraTrajectory,
    timed: CameraTimedImu,
    *,
    gravity_m_s2: float,
    gravity_sigma_m_s2: float,
    states_hz: float,
) -> tuple[Data, Prior]:
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
            raise NotObservableError(
                "scale",
                f"nearly all of the {sensor}'s readings stand at the end of its range: move less violently, or give "
                "the sensor a wider range",
            )
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
    rotation_shape, centre_shape, coupling = _pose_shapes(pose_cov, world_from_cam)
    data = Data(
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
        info=_information(calibration, imu),
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
        raise NotObservableError("scale", "the camera does not move in the model: move it, do not only turn it")
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
        raise NotObservableError(
            "scale",
            f"only {k} camera poses, an eighth of a second or more apart, lie inside the IMU recording and at least "
            f"{_MIN_STATES} are needed: record a longer clip, or check that both recordings belong together",
        )
    return groups


def _information(calibration: CameraImuCalibration, imu: ImuRecording) -> Array:
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


def _pose_shapes(pose_cov: Array | None, world_from_cam: Array) -> tuple[Array, Array, Array]:
    """What covariances of the poses say about frames relative to each other; their overall levels are estimated."""
    k = len(world_from_cam)
    if pose_cov is None:
        eye = np.tile(np.eye(3), (k, 1, 1))
        return eye, eye, np.zeros((k, 3, 3))
    rotation, cross, centre = pose_cov[:, :3, :3], pose_cov[:, 3:, :3], pose_cov[:, 3:, 3:]
    slack = 1e-6 * np.trace(rotation, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    carried = cross @ np.linalg.inv(rotation + slack)
    rest = centre - carried @ cross.transpose(0, 2, 1)
    coupling = world_from_cam.transpose(0, 2, 1) @ carried
    return _shape(rotation), _shape(rest), coupling


def _shape(cov: Array) -> Array:
    """Square roots of the information relative to the median level; no direction counts more than tenfold."""
    level = float(np.median(np.trace(cov, axis1=1, axis2=2))) / 3
    if not level > 0:
        return np.tile(np.eye(3), (len(cov), 1, 1))
    relative = 0.5 * (cov + cov.transpose(0, 2, 1)) / level + 0.1 * np.eye(3)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(relative)))
