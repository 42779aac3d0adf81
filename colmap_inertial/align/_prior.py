"""Calibrations of which only some entries are known."""

from __future__ import annotations

import numpy as np

from colmap_inertial.types import Array, CameraImuCalibration

#: A time offset with at least this standard deviation is unknown: its value carries nothing.
UNKNOWN_OFFSET_S = 1e3


def calibration_prior(
    *,
    cam_from_imu_xyzw: Array | None = None,
    rotation_sigma_rad: float = 0.02,
    gyro_time_offset_s: float | None = None,
    gyro_time_offset_sigma_s: float = 0.05,
    accel_minus_gyro_offset_s: float = 0.0,
    accel_minus_gyro_offset_sigma_s: float = 0.02,
    gyro_bias_rad_s: Array | None = None,
    gyro_bias_sigma_rad_s: float = 0.2,
    imu_in_cam_m: Array | None = None,
    imu_in_cam_sigma_m: float | None = None,
    readout_s: float | None = None,
    readout_sigma_s: float | None = None,
) -> CameraImuCalibration:
    """A calibration of which only some entries are known; the rest stays wide.

    Parameters
    ----------
    cam_from_imu_xyzw, rotation_sigma_rad
        Rotation and its standard deviation about each axis. Unknown: 10 rad, which says nothing.
    gyro_time_offset_s, gyro_time_offset_sigma_s
        Between raw stamps. Unknown: ``10 * UNKNOWN_OFFSET_S``.
    accel_minus_gyro_offset_s, accel_minus_gyro_offset_sigma_s
        Accelerometer against gyroscope; both sensors usually sit in one chip but pass different filters.
    gyro_bias_rad_s, gyro_bias_sigma_rad_s
        IMU frame.
    imu_in_cam_m, imu_in_cam_sigma_m
        Lever arm, camera frame. Unknown: 0 +- 0.08 m, as in phones and tablets; known: +- 0.005 m.
    readout_s, readout_sigma_s
        Rolling-shutter readout. Unknown: 0 +- 0.02 s; known: +- 0.0005 s.
    """
    offset_sigma = 10 * UNKNOWN_OFFSET_S if gyro_time_offset_s is None else gyro_time_offset_sigma_s
    lever_sigma = imu_in_cam_sigma_m or (0.08 if imu_in_cam_m is None else 0.005)
    readout_sigma = readout_sigma_s or (0.02 if readout_s is None else 0.0005)
    sigmas = np.array(
        [
            *[10.0 if cam_from_imu_xyzw is None else rotation_sigma_rad] * 3,
            *(offset_sigma, np.hypot(offset_sigma, accel_minus_gyro_offset_sigma_s)),
            *[gyro_bias_sigma_rad_s] * 3,
            *[lever_sigma] * 3,
            readout_sigma,
        ]
    )
    cov = np.diag(sigmas**2)
    cov[3, 4] = cov[4, 3] = offset_sigma**2
    offset = gyro_time_offset_s or 0.0
    return CameraImuCalibration(
        cam_from_imu_xyzw=np.array([0.0, 0.0, 0.0, 1.0]) if cam_from_imu_xyzw is None else cam_from_imu_xyzw,
        gyro_time_offset_s=offset,
        accel_time_offset_s=offset + accel_minus_gyro_offset_s,
        gyro_bias_rad_s=np.zeros(3) if gyro_bias_rad_s is None else gyro_bias_rad_s,
        imu_in_cam_m=np.zeros(3) if imu_in_cam_m is None else imu_in_cam_m,
        readout_s=readout_s or 0.0,
        cov=cov,
    )
