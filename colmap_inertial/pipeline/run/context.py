"""Values that go through a run: the recording, and how the work is done."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import CameraImuCalibration, FrameTiming, ImuRecording
from colmap_inertial.io.calibration import CalibrationFiles, largest_offset_s, read_calibrations, read_for_recording
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_rig import rig_files
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.pipeline.run.chunks import Executor
from colmap_inertial.pipeline.run.colmap_settings import NO_SETTINGS, ColmapSettings, read_settings
from colmap_inertial.pipeline.run.executable import ColmapExecutable, Device, read_executable
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.pipeline.run.runner import fingerprint
from colmap_inertial.pipeline.run.workers import get_executor

Features = Literal["sift", "aliked"]


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


@dataclass(frozen=True, eq=False, kw_only=True)
class RunContext:
    """Settings of the work: progress, threads, seed, limits.

    Attributes
    ----------
    scratch
        A folder for temporary files; that of a session where there is one.
    num_threads
        Of COLMAP; -1 uses all.
    seed
        Of COLMAP.
    device
        What COLMAP finds and matches features on.
    features
        What COLMAP finds and matches.
    colmap
        What the user set of COLMAP's own options.
    executable
        An installed COLMAP that finds and matches features and maps; ``None`` where pycolmap does.
    executor
        Who maps parts of a long capture; on a cluster, who finds features and matches pairs, too.
    progress
        Hears how far it is.
    """

    scratch: Path = Path()
    num_threads: int = -1
    seed: int = 0
    device: Device = "cpu"
    features: Features = "sift"
    colmap: ColmapSettings = NO_SETTINGS
    executable: ColmapExecutable | None = None
    executor: Executor = field(default_factory=get_executor)
    progress: Progress = silent

    @classmethod
    def of(cls, options: ReconstructOptions, *, device: Device = "cpu", progress: Progress = silent) -> RunContext:
        """Settings from the options of a reconstruction; an ``InertialError`` for options that COLMAP does not have."""
        num_threads = 1 if options.deterministic else -1
        settings = read_settings(options.colmap, options.colmap_project)
        executable = None
        if options.colmap_executable is not None:
            if get_executor().remote:
                raise InertialError(Fact("executable-with-scheduler"))
            executable = read_executable(
                options.colmap_executable, options.mapping, settings, deterministic=options.deterministic
            )
        return cls(
            num_threads=num_threads,
            seed=options.seed,
            device=device,
            features=options.mapping.features,
            colmap=settings,
            executable=executable,
            progress=progress,
        )

    def reporting(self, progress: Progress) -> RunContext:
        """The same, heard by somebody else."""
        return replace(self, progress=progress)

    def identity(self) -> dict[str, object]:
        """Settings that decide a result, without listeners and places."""
        values: dict[str, object] = {
            name: getattr(self, name) for name in ("num_threads", "seed", "device", "features")
        }
        return values if self.executable is None else {**values, "executable": self.executable.identity()}
