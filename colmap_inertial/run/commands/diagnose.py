"""Inputs of ``diagnose``, read from captures, sources of ``scale`` and IMU files."""

from __future__ import annotations

from pathlib import Path

from colmap_inertial.core.errors import FormatError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress
from colmap_inertial.diagnose import Diagnosis, Recorded, diagnose, unreadable
from colmap_inertial.io.calibration import CalibrationFiles, largest_offset_s
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.imu import is_capture, read_unchecked_capture_imu, read_unchecked_imu
from colmap_inertial.io.imu_formats import find_recorder_output
from colmap_inertial.io.recording import prior_calibration
from colmap_inertial.io.rig_frames import pair_rig_frames
from colmap_inertial.io.table_report import TableReport, report_table
from colmap_inertial.run.commands.paths import check_output
from colmap_inertial.run.commands.scale import ScaleSource, brings_imu, read_source
from colmap_inertial.run.preparation.plan import add_stated_exposures
from colmap_inertial.run.preparation.preflight import TolerantReader, add_images


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


def describe_table(source: ScaleSource, capture: Path | None = None) -> TableReport | None:
    """What a table of samples was taken for; ``None`` for any other source, and for what a capture.toml describes.

    Parameters
    ----------
    capture
        Where to write the capture.toml.

    Raises
    ------
    OutputExistsError
        Where there is a file already.
    FormatError
        Where one is to be written, and the source is no table.
    """
    if capture is None and is_capture(source.source):
        return None
    report = report_table(source.source, None if capture is None else capture.parent)
    if capture is not None:
        if report is None:
            raise FormatError(source.source, Fact("no-table-of-samples"))
        if capture.exists():
            raise OutputExistsError(Fact("output-exists", path=str(capture)))
        write_text(capture, report.toml)
    return report


def collect(source: ScaleSource, progress: Progress) -> Recorded:
    """Read what there is of a source; what cannot be read is kept with its reason, and the rest is read all the same.

    Raises
    ------
    FormatError, TimingError
        Where that leaves nothing.
    """
    path, capture = source.source, None
    if source.imu is not None or brings_imu(source):
        recorded, capture, _ = read_source(source)
    elif _describes_frames(path):
        capture = load_capture(path)
        recorded = _read_capture(capture, source.calibration)
    else:
        recorded = _read_imu(path)
    if capture is not None:
        return add_images(recorded, capture, progress)
    if recorded.imu is None and recorded.trajectory is None and recorded.timing is None:
        error = recorded.refused[0]
        # a file of no known kind is bad input; one that is known and damaged is a finding
        if unreadable(error).code in ("unreadable", "untimed"):
            raise error
    return recorded


def _describes_frames(path: Path) -> bool:
    """Whether a path is a capture rather than an inertial recording alone."""
    if is_capture(path) or find_recorder_output(path) is not None:
        return True
    return any((base / "cam0" / "data.csv").is_file() for base in (path, path / "mav0"))


def _read_imu(path: Path) -> Recorded:
    reader = TolerantReader()
    # arguments are read in order: the reason for a refusal is there by the second
    return Recorded(imu=reader.attempt(lambda: read_unchecked_imu(path)), refused=tuple(reader.refused))


def _read_capture(capture: Capture, calibration: CalibrationFiles) -> Recorded:
    reader = TolerantReader()
    timing = None
    if capture.frames is not None:
        timing = reader.attempt(lambda: add_stated_exposures(capture, read_frame_timing(capture)))
    if timing is not None:
        known = timing
        reader.attempt(lambda: pair_rig_frames(capture, known))
    imu = None if capture.imu is None else reader.attempt(lambda: read_unchecked_capture_imu(capture))
    return Recorded(
        refused=tuple(reader.refused),
        imu=imu,
        timing=timing,
        log=capture.frame_log,
        is_capture=True,
        camera=capture.camera,
        calibration=prior_calibration(capture, calibration),
        max_offset_s=largest_offset_s(capture.shared_clock),
    )
