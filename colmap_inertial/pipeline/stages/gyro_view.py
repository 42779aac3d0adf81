"""A recording's gyroscope, camera and frame times, brought together."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.types import (
    CameraImuCalibration,
    CameraModel,
    FrameTiming,
    ImuRecording,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera


@dataclass(frozen=True, eq=False, kw_only=True)
class GyroView:
    """A recording's gyroscope, camera and frame times, brought together.

    Attributes
    ----------
    imu
        The recording, as it was read.
    timing
        Of all frames.
    calibration
        Rotation, time offset with its clock rate, and gyroscope bias.
    camera
        Intrinsics.
    source
        Where the calibration comes from: ``"capture"``, ``"model"`` (a small one, made beforehand) or ``"pixels"``.
    notes
        What there is to say about it, in words.
    """

    imu: ImuRecording
    timing: FrameTiming
    calibration: CameraImuCalibration
    camera: CameraModel
    source: str
    notes: tuple[str, ...] = ()

    def timed(self) -> CameraTimedImu:
        """The recording on the camera's clock."""
        return CameraTimedImu.from_recording(self.imu, self.calibration, self.timing.epoch_ns)

    def motion(self) -> GyroCamera:
        """The gyroscope on the camera's clock."""
        return GyroCamera.from_timed(self.timed())

    def shutter(self, index: int) -> FrameShutter:
        """When the lines of one frame are exposed."""
        return FrameShutter.of(self.timing, index, width=self.camera.width, height=self.camera.height)

    def index(self) -> dict[str, int]:
        """The place of each frame name."""
        return {name: i for i, name in enumerate(self.timing.names)}
