"""How a camera rotates while it exposes: the gyroscope on the camera's clock, and the order in which lines expose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_rotate, so3_log
from colmap_inertial.gyro import GyroPath
from colmap_inertial.types import (
    Array,
    CameraImuCalibration,
    FrameTiming,
    ImuRecording,
    ReadoutDirection,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class GyroCamera:
    """Orientation of a camera at any instant of its clock, from the gyroscope beside it.

    Attributes
    ----------
    path
        The gyroscope without its bias, on its own clock.
    cam_from_imu_xyzw
        (4,) rotation.
    offset_s
        Camera time = time of ``path`` + this.
    """

    path: GyroPath
    cam_from_imu_xyzw: Array
    offset_s: float

    @classmethod
    def of(cls, imu: ImuRecording, calibration: CameraImuCalibration, *, camera_epoch_ns: int) -> GyroCamera:
        """The camera of a recording.

        Parameters
        ----------
        imu
            Its gyroscope.
        calibration
            Rotation, time offset and gyroscope bias.
        camera_epoch_ns
            Epoch of the frame times (``FrameTiming.epoch_ns``).
        """
        return cls(
            path=GyroPath(imu.gyro_t_s, imu.gyro_rad_s, calibration.gyro_bias_rad_s),
            cam_from_imu_xyzw=calibration.cam_from_imu_xyzw,
            offset_s=calibration.gyro_time_offset_s + (imu.epoch_ns - camera_epoch_ns) * 1e-9,
        )

    def covers(self, begin_s: Array, end_s: Array) -> NDArray[np.bool_]:
        """(N,) which of the intervals the gyroscope recorded without a gap."""
        return self.path.covers(np.asarray(begin_s) - self.offset_s, np.asarray(end_s) - self.offset_s)

    def start_from_cam(self, t_s: Array) -> Array:
        """(..., 3, 3) orientations at times of any shape, in a frame that stays where the IMU began."""
        t_s = np.asarray(t_s, dtype=np.float64)
        start_from_imu, _ = self.path.at(t_s.ravel() - self.offset_s)
        start_from_cam = quat_multiply(start_from_imu, quat_conjugate(self.cam_from_imu_xyzw))
        return matrix_from_quat(start_from_cam).reshape(*t_s.shape, 3, 3)

    def turn_rad(self, t_s: Array) -> Array:
        """(..., N-1, 3) rotations ``before_from_after`` between consecutive ones of (..., N) times, camera frame."""
        looking = self.start_from_cam(t_s)
        return so3_log(np.swapaxes(looking[..., :-1, :, :], -1, -2) @ looking[..., 1:, :, :])

    def rate_in_cam_rad_s(self, t_s: Array) -> Array:
        """(N, 3) angular velocities at (N,) times, camera frame."""
        _, rate = self.path.at(np.asarray(t_s, dtype=np.float64) - self.offset_s)
        return quat_rotate(self.cam_from_imu_xyzw, rate)


@dataclass(frozen=True, kw_only=True)
class FrameShutter:
    """When each line of one frame is exposed, camera clock.

    Attributes
    ----------
    width, height
        Size of the image, px.
    t_s
        Start of exposure of the line that is read first.
    exposure_s
        Of every line; ``None`` where unknown.
    readout_s
        From the first line to one past the last; 0 is a global shutter.
    readout_direction
        Where the exposed line moves in the stored image: lines are rows (down, up) or columns (right, left).
    """

    width: int
    height: int
    t_s: float
    exposure_s: float | None
    readout_s: float = 0.0
    readout_direction: ReadoutDirection = "down"

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError("width and height must be positive")
        if (self.exposure_s is not None and not self.exposure_s >= 0) or not self.readout_s >= 0:
            raise ValueError("exposure_s and readout_s must not be negative")

    @classmethod
    def of(cls, timing: FrameTiming, index: int, *, width: int, height: int) -> FrameShutter:
        """Of one frame of a recording; a readout that is unknown counts as none."""
        return cls(
            width=width,
            height=height,
            t_s=float(timing.t_s[index]),
            exposure_s=None if timing.exposure_s is None else float(timing.exposure_s[index]),
            readout_s=timing.readout_s or 0.0,
            readout_direction=timing.readout_direction,
        )

    @property
    def line_step_s(self) -> tuple[float, float]:
        """Seconds by which a line is later than its neighbour one pixel to the left, and one pixel above."""
        step_x, step_y = self.readout_s / self.width, self.readout_s / self.height
        return {"down": (0.0, step_y), "up": (0.0, -step_y), "right": (step_x, 0.0), "left": (-step_x, 0.0)}[
            self.readout_direction
        ]

    def reference_s(self) -> float:
        """The instant that stands for the whole image: as ``FrameTiming.pose_t_s``."""
        return self.t_s + 0.5 * (self.exposure_s or 0.0) + 0.5 * self.readout_s

    def middle_s(self, xy_px: Array) -> Array:
        """(...) mid-exposure of the line through (..., 2) image points (COLMAP's pixel coordinates)."""
        xy = np.asarray(xy_px, dtype=np.float64)
        step_x, step_y = self.line_step_s
        first = self.t_s + 0.5 * (self.exposure_s or 0.0)
        # the first line read is the last in the image for up and left
        begin_x = self.width - 0.5 if step_x < 0 else 0.5
        begin_y = self.height - 0.5 if step_y < 0 else 0.5
        return np.asarray(first + step_x * (xy[..., 0] - begin_x) + step_y * (xy[..., 1] - begin_y))

    def covered_by(self, motion: GyroCamera, *, reference: bool = False) -> bool:
        """Whether the gyroscope recorded the whole exposure (with ``reference``, also the reference instant)."""
        begin_s, end_s = self.t_s, self.t_s + (self.exposure_s or 0.0) + self.readout_s
        if reference:
            begin_s, end_s = min(begin_s, self.reference_s()), max(end_s, self.reference_s())
        return bool(motion.covers(np.array([begin_s]), np.array([end_s]))[0])
