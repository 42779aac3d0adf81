"""How the camera and the IMU of one device relate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.validation import check_fields

#: Order of the parameters in ``CameraImuCalibration.cov``. The rotation error is in the camera frame, on the left:
#: true = exp(error) * estimate.
CALIBRATION_PARAMETERS = (
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad"),
    *("gyro_time_offset_s", "accel_time_offset_s"),
    *("gyro_bias_x_rad_s", "gyro_bias_y_rad_s", "gyro_bias_z_rad_s"),
    *("imu_in_cam_x_m", "imu_in_cam_y_m", "imu_in_cam_z_m"),
    "readout_s",
)


class CAL:
    """Where they stand: indices of the numbers, slices of the vectors of ``CALIBRATION_PARAMETERS``."""

    ROTATION = slice(0, 3)
    GYRO_TIME_OFFSET, ACCEL_TIME_OFFSET = 3, 4
    TIME_OFFSETS = slice(3, 5)
    GYRO_BIAS = slice(5, 8)
    LEVER_ARM = slice(8, 11)
    READOUT = 11
    COUNT = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraImuCalibration:
    """How the camera and the IMU of one device relate.

    Attributes
    ----------
    cam_from_imu_xyzw
        (4,) rotation.
    gyro_time_offset_s, accel_time_offset_s
        ``t_cam = t_stamp + offset`` between raw stamps (each clock's reading in seconds, epoch included).
    gyro_bias_rad_s
        (3,) IMU frame; the true rate is the reading minus this.
    imu_in_cam_m
        (3,) lever arm: the IMU's position in the camera frame.
    readout_s
        Rolling-shutter readout; 0 for a global shutter.
    cov
        (12, 12) in the order of ``CALIBRATION_PARAMETERS``. Wide where nothing is known.
    clock_rate, clock_middle_s
        Growth of the time offsets per second of the camera's clock (0 where the clocks keep step), and the camera
        time, since the epoch of the frame times, at which the offsets hold. ``CameraTimedImu`` holds a
        recording for which they hold throughout.
    """

    cam_from_imu_xyzw: Array
    gyro_time_offset_s: float
    accel_time_offset_s: float
    gyro_bias_rad_s: Array
    imu_in_cam_m: Array
    readout_s: float
    cov: Array
    clock_rate: float = 0.0
    clock_middle_s: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, cam_from_imu_xyzw=(4,), gyro_bias_rad_s=(3,), imu_in_cam_m=(3,), cov=(CAL.COUNT, CAL.COUNT))
        if not (abs(self.clock_rate) < 1 and math.isfinite(self.clock_middle_s)):
            raise ValueError("clock_rate must lie between -1 and 1, clock_middle_s must be finite")

    def sigma(self, parameter: str) -> float:
        """Standard deviation of one of ``CALIBRATION_PARAMETERS``."""
        i = CALIBRATION_PARAMETERS.index(parameter)
        return float(np.sqrt(self.cov[i, i]))

    @property
    def rotation_sigma_rad(self) -> float:
        """Standard deviation of the rotation about the camera axis about which it is known worst."""
        return float(np.sqrt(np.diagonal(self.cov)[CAL.ROTATION].max()))

    @property
    def clock_offset_s(self) -> float:
        """Camera time less a stamp of the gyroscope."""
        return self.gyro_time_offset_s

    @property
    def clock_offsets_s(self) -> tuple[float, float]:
        """Camera time less a stamp of the gyroscope, and of the accelerometer."""
        return self.gyro_time_offset_s, self.accel_time_offset_s

    @property
    def accel_delay_s(self) -> float:
        """What the accelerometer's time offset is larger than the gyroscope's."""
        return self.accel_time_offset_s - self.gyro_time_offset_s

    @property
    def clock_sigma_s(self) -> float:
        """Standard deviation of the clock offset."""
        return self.sigma("gyro_time_offset_s")

    def replace_clock_offset(self, offset_s: float, accel_delay_s: float = 0.0) -> CameraImuCalibration:
        """The calibration with another time offset, the accelerometer's larger by a delay; ``cov`` stays."""
        return replace(self, gyro_time_offset_s=offset_s, accel_time_offset_s=offset_s + accel_delay_s)

    def shift_clock_offsets(self, by_s: float, accel_by_s: float) -> CameraImuCalibration:
        """The calibration with both time offsets larger, the accelerometer's by the second as well; ``cov`` stays."""
        return replace(
            self,
            gyro_time_offset_s=self.gyro_time_offset_s + by_s,
            accel_time_offset_s=self.accel_time_offset_s + by_s + accel_by_s,
        )

    def drift_s(self, t_cam_s: Array) -> Array:
        """How much the time offsets have grown since ``clock_middle_s``, at camera times of any shape."""
        return np.asarray(self.clock_rate * (t_cam_s - self.clock_middle_s))
