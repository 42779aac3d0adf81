"""An IMU recording on the camera's clock: the one place where stamps become camera times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types.imu import CameraImuCalibration, ImuRecording


def epoch_shift_s(imu: ImuRecording, camera_epoch_ns: int) -> float:
    """Constant that turns an offset between raw stamps into one between times since the two epochs, by addition."""
    return (imu.epoch_ns - camera_epoch_ns) * 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraTimedImu:
    """A recording whose samples have camera times.

    Attributes
    ----------
    imu
        The recording; its stamps advance as the camera's clock does.
    calibration
        Its time offsets hold for all of the recording.
    camera_epoch_ns
        The epoch that camera times count from (``FrameTiming.epoch_ns``).
    """

    imu: ImuRecording
    calibration: CameraImuCalibration
    camera_epoch_ns: int

    @classmethod
    def from_recording(
        cls, imu: ImuRecording, calibration: CameraImuCalibration, camera_epoch_ns: int
    ) -> CameraTimedImu:
        """Stretch the stamps of a recording as it was read to the camera's rate.

        Parameters
        ----------
        imu
            Taken as it is where its clock keeps step with the camera's; else ``repairs`` of the stretched one say so.
        calibration
            Time offsets, the clock rate, and when the offsets hold.
        camera_epoch_ns
            The epoch that ``calibration.clock_middle_s`` counts from, too.
        """
        timed = cls(imu=imu, calibration=calibration, camera_epoch_ns=camera_epoch_ns)
        rate = calibration.clock_rate
        if rate == 0:
            return timed
        fixed_s = calibration.clock_middle_s - timed.gyro_offset_s

        def stretch(t_s: Array) -> Array:
            return np.asarray(fixed_s + (t_s - fixed_s) / (1 - rate))

        repair = Fact("imu-clock-stretched", clock_rate=rate)
        stretched = replace(
            imu, gyro_t_s=stretch(imu.gyro_t_s), accel_t_s=stretch(imu.accel_t_s), repairs=(*imu.repairs, repair)
        )
        return replace(timed, imu=stretched)

    @property
    def gyro_offset_s(self) -> float:
        """Camera time less the gyroscope's, each since its epoch."""
        return epoch_shift_s(self.imu, self.camera_epoch_ns) + self.calibration.clock_offset_s

    @property
    def accel_offset_s(self) -> float:
        """Camera time less the accelerometer's, each since its epoch."""
        return epoch_shift_s(self.imu, self.camera_epoch_ns) + self.calibration.clock_offsets_s[1]

    @cached_property
    def gyro_t_s(self) -> Array:
        """(N,) camera times of the gyroscope's samples."""
        return np.asarray(self.imu.gyro_t_s + self.gyro_offset_s)

    @cached_property
    def accel_t_s(self) -> Array:
        """(M,) camera times of the accelerometer's samples."""
        return np.asarray(self.imu.accel_t_s + self.accel_offset_s)

    def between(self, begin_s: float, end_s: float) -> ImuRecording:
        """The samples of an interval of camera time, as they were stamped; all of a sensor that has fewer than two."""
        gyro = _inside(self.gyro_t_s, begin_s, end_s)
        accel = _inside(self.accel_t_s, begin_s, end_s)
        return replace(
            self.imu,
            gyro_t_s=self.imu.gyro_t_s[gyro],
            gyro_rad_s=self.imu.gyro_rad_s[gyro],
            accel_t_s=self.imu.accel_t_s[accel],
            accel_m_s2=self.imu.accel_m_s2[accel],
        )


def _inside(t_s: Array, begin_s: float, end_s: float) -> BoolArray:
    inside = (t_s >= begin_s) & (t_s <= end_s)
    return np.asarray(inside if inside.sum() > 1 else np.ones_like(inside))
