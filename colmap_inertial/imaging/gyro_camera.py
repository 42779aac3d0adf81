"""Rotation of a camera during its exposure: the gyroscope on the camera's clock, and the exposure of each line."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_rotate, skew, so3_log
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CAL, CameraImuCalibration, FrameTiming, ImuRecording, ReadoutDirection

#: Standard deviation of what is known of blur's length: exposure times are nominal, as are focal lengths.
EXTENT_SIGMA = 0.03
#: Nobody knows a bias worse than this, even unasked: what is said of it for a fit to find is wider.
MOST_BIAS_RAD_S = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionErrors:
    """Errors of a camera's rotation due to its gyroscope.

    Attributes
    ----------
    rotation_cov_rad2
        (3, 3) of the camera's axes against the gyroscope's, in the camera frame.
    offset_sigma_s
        Standard deviation of the clock's offset.
    rate_cov_rad2_s2
        (3, 3) of rates that are wrong alike throughout an exposure (the bias), camera frame.
    extent_sigma
        Standard deviation of the length of an exposure, as a share.
    """

    rotation_cov_rad2: Array = field(default_factory=lambda: np.zeros((3, 3)))
    offset_sigma_s: float = 0.0
    rate_cov_rad2_s2: Array = field(default_factory=lambda: np.zeros((3, 3)))
    extent_sigma: float = EXTENT_SIGMA

    @classmethod
    def of(cls, calibration: CameraImuCalibration) -> MotionErrors:
        """Errors by a calibration's covariance."""
        turn = matrix_from_quat(calibration.cam_from_imu_xyzw)
        bias = calibration.cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS]
        bias = bias * min(1.0, MOST_BIAS_RAD_S**2 / max(float(np.diagonal(bias).max()), 1e-30))
        return cls(
            rotation_cov_rad2=calibration.cov[CAL.ROTATION, CAL.ROTATION],
            offset_sigma_s=calibration.clock_sigma_s,
            rate_cov_rad2_s2=turn @ bias @ turn.T,
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
    errors
        Of what is known of these; the gyroscope's noise shows in its readings.
    """

    path: GyroPath
    cam_from_imu_xyzw: Array
    offset_s: float
    errors: MotionErrors = field(default_factory=MotionErrors)

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
        return cls.from_timed(CameraTimedImu(imu=imu, calibration=calibration, camera_epoch_ns=camera_epoch_ns))

    @classmethod
    def from_timed(cls, timed: CameraTimedImu) -> GyroCamera:
        """The camera of a recording on the camera's clock."""
        imu, calibration = timed.imu, timed.calibration
        return cls(
            path=GyroPath(imu.gyro_t_s, imu.gyro_rad_s, calibration.gyro_bias_rad_s),
            cam_from_imu_xyzw=calibration.cam_from_imu_xyzw,
            offset_s=timed.gyro_offset_s,
            errors=MotionErrors.of(calibration),
        )

    def covers(self, begin_s: Array, end_s: Array) -> BoolArray:
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

    def turn_cov_rad2(self, middle_s: Array, exposure_s: float) -> Array:
        """(N, 3, 3) covariance of how far the camera turns in exposures around (N,) instants, camera frame."""
        errors = self.errors
        ends = np.stack([middle_s - 0.5 * exposure_s, middle_s + 0.5 * exposure_s], axis=-1)
        turn = self.turn_rad(ends)[:, 0]
        tilted = skew(turn)
        grown = self.rate_in_cam_rad_s(ends[:, 1]) - self.rate_in_cam_rad_s(ends[:, 0])
        cov = tilted @ errors.rotation_cov_rad2 @ np.swapaxes(tilted, -1, -2)
        cov += errors.extent_sigma**2 * turn[:, :, None] * turn[:, None]
        cov += errors.offset_sigma_s**2 * grown[:, :, None] * grown[:, None]
        # noise bends the path as much as it lengthens it, and counts as length twice
        noise = 2 * self.path.noise_rad_s_rthz**2 * exposure_s
        return np.asarray(cov + exposure_s**2 * errors.rate_cov_rad2_s2 + noise * np.eye(3))

    def rate_in_cam_rad_s(self, t_s: Array) -> Array:
        """(N, 3) angular velocities at (N,) times, camera frame."""
        _, rate = self.path.at(np.asarray(t_s, dtype=np.float64) - self.offset_s)
        return quat_rotate(self.cam_from_imu_xyzw, rate)


@dataclass(frozen=True, kw_only=True)
class FrameShutter:
    """Exposure of each line of one frame, on the camera's clock.

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
        """The shutter of one frame of a recording; an unknown readout counts as none."""
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
