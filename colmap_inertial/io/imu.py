"""``read_imu``: one door for every kind of inertial recording, found by content.

Families of files, and how another package adds one: :mod:`colmap_inertial.io.imu_formats`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording, ImuSource
from colmap_inertial.io import imu_text
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.capture_tables import ImuPath
from colmap_inertial.io.files import StrPath, reader, reading
from colmap_inertial.io.imu_formats import find_imu_format
from colmap_inertial.io.plausible import check_readings
from colmap_inertial.io.units import DeclaredUnits


def read_imu(path: StrPath, *, format: str = "auto") -> ImuRecording:
    """Read an inertial recording: SI units, sorted, checked for plausibility.

    Parameters
    ----------
    path
        A file or folder of one of the families, which include videos with an IMU inside, or a ``capture.toml`` (or a
        folder that holds one).
    format
        ``"auto"`` finds it by content; otherwise the name of a family, or ``"capture"``.

    Returns
    -------
    The recording. ``repairs`` lists what was sorted, merged or dropped.

    Raises
    ------
    FormatError
        Where the recording cannot be read, or its numbers cannot be rad/s and m/s2 of a working IMU.
    TimingError
        Where its stamps run backwards or cannot be in the stated unit.
    """
    return check_readings(read_unchecked_imu(Path(path), format=format))


@reader("an inertial recording")
def read_unchecked_imu(path: Path, *, format: str = "auto") -> ImuRecording:
    """:func:`read_imu` without the check that the numbers are plausible, for callers who check themselves."""
    if format == "capture" or (format == "auto" and is_capture(path)):
        return read_unchecked_capture_imu(load_capture(path))
    return replace(find_imu_format(path, format).read(path, DeclaredUnits()), source=ImuSource(path=path))


@reader("an inertial recording")
def read_frame_log(path: StrPath, *, format: str = "auto") -> FrameLog | None:
    """Notes of a recording on the frames of its video: times, exposure, readout, stabilisation, intrinsics.

    Parameters
    ----------
    path, format
        As for :func:`read_imu`, without captures.

    Returns
    -------
    ``None`` where the recording, or its kind, says nothing.

    Raises
    ------
    FormatError
        Where the recording is damaged or of no known kind.
    """
    path = Path(path)
    family = find_imu_format(path, format)
    return None if family.frames is None else family.frames(path)


def read_capture_imu(capture: Capture) -> ImuRecording:
    """The inertial recording of a capture, as :func:`read_imu` gives it."""
    return check_readings(read_unchecked_capture_imu(capture))


def read_unchecked_capture_imu(capture: Capture) -> ImuRecording:
    """The inertial recording of a capture, as :func:`read_unchecked_imu` gives it."""
    source = capture.imu
    if source is None:
        raise FormatError(capture.path, Fact("capture-without-imu"))
    if isinstance(source, ImuPath):
        path = accel_path = source.path
        with reading(path, Fact("not-readable-as", what="an inertial recording")):
            imu = find_imu_format(path, source.format).read(path, source.units)
    else:
        path = accel_path = source.gyro.file
        if source.accel is not None:
            accel_path = source.accel.file
        with reading(path, Fact("not-readable-as-described")):
            imu = imu_text.read_tables(source.gyro, source.accel)
    return replace(
        imu,
        gyro_rad_s=imu.gyro_rad_s if source.gyro_axes is None else source.gyro_axes.apply(imu.gyro_rad_s),
        accel_m_s2=imu.accel_m_s2 if source.accel_axes is None else source.accel_axes.apply(imu.accel_m_s2),
        noise=imu.noise if source.noise is None else source.noise,
        device=capture.device or imu.device,
        source=ImuSource(path=path, accel_path=accel_path, gyro_axes=source.gyro_axes, accel_axes=source.accel_axes),
    )


def is_capture(path: Path) -> bool:
    """Whether ``path`` is a capture.toml or a folder that holds one."""
    return path.suffix.lower() == ".toml" or (path / "capture.toml").is_file()
