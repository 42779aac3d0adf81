"""One recording: frames' times, the IMU recorded with them, and what is known of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraImuCalibration, FrameTiming, ImuRecording
from colmap_inertial.io.calibration import CalibrationFiles, largest_offset_s, read_calibrations, read_for_recording
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_rig import rig_files
from colmap_inertial.io.files import path_in
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import Video


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """One recording: its frames' times, the IMU recorded with it, and what is known of both.

    Attributes
    ----------
    capture
        What describes it, and where its files are.
    imu
        Gyroscope and accelerometer.
    timing
        Of the frames to use.
    prior
        Camera and IMU, as far as they are known beforehand.
    doubts
        What was found wrong with it; with any of them, no scale is trusted.
    every
        Of all frames of the video that ``timing``'s were chosen from; ``timing`` itself where all are used.
    max_offset_s
        Largest offset between the clocks; ``None`` where it may be any.
    """

    capture: Capture
    imu: ImuRecording
    timing: FrameTiming
    prior: CameraImuCalibration
    doubts: tuple[Fact, ...] = ()
    every: FrameTiming
    max_offset_s: float | None = None

    @classmethod
    def of(
        cls,
        capture: Capture,
        imu: ImuRecording,
        timing: FrameTiming,
        prior: CameraImuCalibration,
        *,
        max_offset_s: float | None = None,
    ) -> Recording:
        """A recording of which all frames are used; without a largest offset, that of a shared clock counts."""
        limit_s = largest_offset_s(capture.shared_clock, max_offset_s)
        return cls(capture=capture, imu=imu, timing=timing, prior=prior, every=timing, max_offset_s=limit_s)

    def using(self, timing: FrameTiming) -> Recording:
        """The recording with some of its frames."""
        return replace(self, timing=timing)

    def identity(self) -> dict[str, object]:
        """All that decides what is made of it."""
        names = ("imu", "timing", "every", "prior", "max_offset_s")
        return {
            **{name: getattr(self, name) for name in names},
            "capture": replace(self.capture, target=None),
            "inputs": self.inputs(),
        }

    def inputs(self) -> list[object]:
        """Identity of the files that frames are read from."""
        capture, source = self.capture, self.capture.image_folder
        paths = [] if source is None else [path_in(source, name) for name in self.timing.names]
        if isinstance(capture.frames, Video):
            paths = [capture.frames.file]
        if capture.apertures is not None:
            paths += capture.apertures.files(self.timing.names)
        if capture.exposures is not None:
            paths += [*capture.exposures.files(self.timing.names), *filter(None, [capture.exposures.times])]
        paths += rig_files(capture.rig)
        return [fingerprint(path) for path in paths]


def prior_calibration(capture: Capture, given: CalibrationFiles) -> CameraImuCalibration:
    """Prior calibration of camera and IMU: from a calibration file if given, else from the capture."""
    files = read_for_recording(given, shared_clock=capture.shared_clock)
    calibration, of_imu = files.camera_imu or capture.calibration, files.imu or capture.imu_calibration
    return calibration if of_imu is None else of_imu.loosened(calibration)


def correct_imu(capture: Capture, imu: ImuRecording, given: CalibrationFiles) -> ImuRecording:
    """The recording as its IMU's own calibration corrects it, from a file or from the capture; else as it is."""
    calibration = read_calibrations(given).imu or capture.imu_calibration
    return imu if calibration is None else calibration.corrected(imu)
