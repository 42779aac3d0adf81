"""Inputs of ``diagnose``, read from captures, sources of ``scale`` and IMU files."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from colmap_inertial.checks.diagnose import Diagnosis, Recorded, diagnose, unreadable
from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.io.calibration import CalibrationFiles, largest_offset_s, read_for_recording
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frames import read_frame_times, read_frame_timing
from colmap_inertial.io.imu import is_capture, read_raw_capture_imu, read_raw_imu
from colmap_inertial.io.imu_formats import find_recording
from colmap_inertial.io.imu_text import is_inertial_scale
from colmap_inertial.io.plausible import RawImu
from colmap_inertial.io.pose_convention import ARRAYS, COLMAP, INERTIAL_SCALE, TUM, PoseConvention
from colmap_inertial.io.rig_frames import pair_rig_frames
from colmap_inertial.io.trajectories import read_inertial_scale_poses, read_tum
from colmap_inertial.model import read_model, trajectory_from_model
from colmap_inertial.model.rigs import frames_of_rigs
from colmap_inertial.pipeline.run.progress import Progress
from colmap_inertial.reconstruction.drivers.sources import ScaleSource, check_output, only_model
from colmap_inertial.reconstruction.preparation.plan import add_stated_exposures
from colmap_inertial.reconstruction.preparation.preflight import find_in_video, measure_images

T = TypeVar("T")


def diagnose_source(
    source: ScaleSource, *, json: Path | None = None, progress: Progress = lambda *_: None
) -> Diagnosis:
    """Diagnose whatever there is.

    Parameters
    ----------
    source
        A capture, a source of ``scale``, or an IMU recording alone.
    json
        Where to write the findings.
    progress
        Called with ``"check"`` and ``"video"``.

    Raises
    ------
    FormatError, TimingError
        Where nothing can be read at all.
    """
    if json is not None:
        check_output(json, [source.source, source.imu, source.frame_times])
    diagnosis = diagnose(collect(source, progress))
    if json is not None:
        write_json(json, diagnosis.as_json())
    return diagnosis


def collect(source: ScaleSource, progress: Progress) -> Recorded:
    """Read what there is of a source; what cannot be read is kept with its reason, and the rest is read all the same.

    Raises
    ------
    FormatError, TimingError
        Where that leaves nothing.
    """
    path = source.source
    if not path.exists():
        raise FormatError(path, "no such file or folder")
    inertial_scale = path.is_dir() and is_inertial_scale(path)
    if source.imu is None and not inertial_scale:
        if _describes_frames(path):
            return _read_capture(load_capture(path), source.calibration, progress)
        return _recorded(_Reading(), imu=lambda: read_raw_imu(path))
    reading = _Reading()
    times = source.frame_times or _times_of_capture(source.imu)
    timing = None if times is None else reading.attempt(lambda: _read_times(times, path))
    trajectory: CameraTrajectory | None = None
    read_as = INERTIAL_SCALE if inertial_scale else COLMAP if path.is_dir() else TUM
    if read_as is INERTIAL_SCALE:
        trajectory = reading.attempt(lambda: read_inertial_scale_poses(path))
    elif read_as is TUM:
        trajectory = reading.attempt(lambda: read_tum(path))
    else:
        model = only_model(path)
        if times is None:
            raise FormatError(path, "a COLMAP model has no frame times: give --frame-times, a CSV with name,t_s")
        if timing is not None:
            trajectory = reading.attempt(functools.partial(_read_trajectory, model, timing))
    captures = [load_capture(p) for p in (source.imu, source.frame_times, path) if p is not None and is_capture(p)]
    return _recorded(
        reading,
        imu=lambda: read_raw_imu(path if source.imu is None else source.imu),
        timing=timing,
        trajectory=trajectory,
        read_as=read_as,
        **_clock_and_calibration(source.calibration, captures),
    )


def _read_times(times: Path, source: Path) -> FrameTiming:
    is_model = source.is_dir() and not is_inertial_scale(source)
    return read_frame_times(times, frames_of_rigs([read_model(only_model(source))] if is_model else ()))


def _read_trajectory(model: Path, timing: FrameTiming) -> CameraTrajectory:
    return trajectory_from_model(read_model(model), timing)[0]


def _times_of_capture(imu: Path | None) -> Path | None:
    """The source of the IMU, where it is a capture that also has frames."""
    return imu if imu is not None and is_capture(imu) and load_capture(imu).frames is not None else None


def _clock_and_calibration(files: CalibrationFiles, captures: Sequence[Capture]) -> dict[str, Any]:
    """The calibration of camera and IMU, from files or else the first capture, and how far apart the clocks may be."""
    shared = any(capture.shared_clock for capture in captures)
    stated = captures[0].calibration if captures else None
    calibration = read_for_recording(files, shared_clock=shared).camera_imu or stated
    return {"calibration": calibration, "max_offset_s": largest_offset_s(shared)}


def _describes_frames(path: Path) -> bool:
    """Whether a path is a capture rather than an inertial recording alone."""
    if is_capture(path) or find_recording(path) is not None:
        return True
    return any((base / "cam0" / "data.csv").is_file() for base in (path, path / "mav0"))


class _Reading:
    """Reads what can be read, and remembers what could not."""

    def __init__(self) -> None:
        self.refused: list[InertialError] = []

    def attempt(self, read: Callable[[], T]) -> T | None:
        try:
            return read()
        except (FormatError, TimingError) as error:
            self.refused.append(error)
            return None


def _recorded(
    reading: _Reading, *, imu: Callable[[], RawImu] | None, read_as: PoseConvention = ARRAYS, **known: Any
) -> Recorded:
    raw = None if imu is None else reading.attempt(imu)
    if raw is None and all(value is None for value in known.values()):
        error = reading.refused[0]
        # a file of no known kind is bad input; one that is known and damaged is a finding
        if unreadable(error).code in ("unreadable", "untimed"):
            raise error
    return Recorded(
        refused=tuple(reading.refused),
        imu=None if raw is None else raw.imu,
        gyro_axes=None if raw is None else raw.gyro_axes,
        accel_axes=None if raw is None else raw.accel_axes,
        read_as=read_as,
        **known,
    )


def _read_capture(capture: Capture, calibration: CalibrationFiles, progress: Progress) -> Recorded:
    reading = _Reading()
    timing = rotation = in_video = None
    if capture.frames is not None:
        timing = reading.attempt(lambda: add_stated_exposures(capture, read_frame_timing(capture)))
    if timing is not None:
        known = timing
        rotation = reading.attempt(lambda: measure_images(capture, known, progress))
        in_video = reading.attempt(lambda: find_in_video(capture, known, progress))
        reading.attempt(lambda: pair_rig_frames(capture, known))
    return _recorded(
        reading,
        imu=None if capture.imu is None else lambda: read_raw_capture_imu(capture),
        timing=timing,
        log=capture.frame_log,
        is_capture=True,
        rotation=rotation,
        camera=capture.camera,
        # the readings stay the sensor's own: that is what the checks are about
        **_clock_and_calibration(calibration, [capture]),
        in_video=in_video,
    )
