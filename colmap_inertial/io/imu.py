"""``read_imu``: one door for every kind of inertial recording, found by content.

A new family of files joins with one function and one :class:`ImuFormat`; see :func:`register_imu_format`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.errors import FormatError
from colmap_inertial.io import imu_text
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.capture_tables import ImuPath
from colmap_inertial.io.plausible import check_plausible
from colmap_inertial.io.units import DeclaredUnits
from colmap_inertial.types import ImuRecording


@dataclass(frozen=True, kw_only=True)
class ImuFormat:
    """One family of inertial recordings.

    Attributes
    ----------
    name
        What ``format =`` and ``--imu-format`` call it.
    layout
        What such a recording looks like, for messages.
    accepts
        Whether a path holds one. Looks at names and first bytes; cheap, never raises for a readable path.
    read
        Reads it, given the units that the user declared in place of the file's.
    """

    name: str
    layout: str
    accepts: Callable[[Path], bool]
    read: Callable[[Path, DeclaredUnits], ImuRecording]


def read_imu(path: Path, *, format: str = "auto") -> ImuRecording:
    """Read an inertial recording: SI units, sorted, checked for plausibility.

    Parameters
    ----------
    path
        A file or folder: an ASL/EuRoC dataset (its root, ``mav0``, ``imu0`` or ``data.csv``), a folder with
        ``gyroscope.txt`` and ``accelerometer.txt``, a CSV whose header names columns and units, or a ``capture.toml``
        (or a folder that holds one).
    format
        ``"auto"`` finds it by content; otherwise a name from :func:`imu_formats` or ``"capture"``.

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
    path = Path(path)
    if format == "capture" or (format == "auto" and is_capture(path)):
        return read_capture_imu(load_capture(path))
    imu = _read_plain(path, format, DeclaredUnits())
    check_plausible(imu, path)
    return imu


def read_capture_imu(capture: Capture) -> ImuRecording:
    """The inertial recording of a capture, as :func:`read_imu` gives it."""
    source = capture.imu
    if source is None:
        raise FormatError(capture.path, "describes no inertial recording; add [imu] with path = ...")
    if isinstance(source, ImuPath):
        path = accel_path = source.path
        imu = _read_plain(path, source.format, source.units)
    else:
        path = accel_path = source.gyro.file
        if source.accel is not None:
            accel_path = source.accel.file
        imu = imu_text.read_tables(source.gyro, source.accel)
    imu = replace(
        imu,
        gyro_rad_s=imu.gyro_rad_s if source.gyro_axes is None else source.gyro_axes.apply(imu.gyro_rad_s),
        accel_m_s2=imu.accel_m_s2 if source.accel_axes is None else source.accel_axes.apply(imu.accel_m_s2),
        noise=imu.noise if source.noise is None else source.noise,
    )
    check_plausible(imu, path, accel_path=accel_path, gyro_axes=source.gyro_axes, accel_axes=source.accel_axes)
    return imu


def is_capture(path: Path) -> bool:
    """Whether ``path`` is a capture.toml or a folder that holds one."""
    return path.suffix.lower() == ".toml" or (path / "capture.toml").is_file()


def imu_formats() -> tuple[ImuFormat, ...]:
    """The known families, in the order in which they are tried."""
    return tuple(_formats)


def register_imu_format(added: ImuFormat) -> None:
    """Make :func:`read_imu` know one more family; it is tried before those already known."""
    if added.name in ("auto", "capture") or any(known.name == added.name for known in _formats):
        raise ValueError(f'the IMU format "{added.name}" exists already')
    _formats.insert(0, added)


def _read_plain(path: Path, name: str, units: DeclaredUnits) -> ImuRecording:
    if not path.exists():
        raise FormatError(path, "no such file or folder")
    if name == "auto":
        for candidate in _formats:
            if candidate.accepts(path):
                return candidate.read(path, units)
        known = "; ".join(candidate.layout for candidate in _formats)
        raise FormatError(
            path,
            f"not an inertial recording known here ({known}); describe its files under [imu.gyro] and [imu.accel] in a "
            "capture.toml",
        )
    for candidate in _formats:
        if candidate.name == name:
            return candidate.read(path, units)
    names = ", ".join(["auto", *(candidate.name for candidate in _formats), "capture"])
    raise FormatError(path, f'unknown IMU format "{name}"; known are {names}')


_formats: list[ImuFormat] = [
    ImuFormat(
        name="euroc",
        layout="an ASL/EuRoC dataset with mav0/imu0/data.csv",
        accepts=imu_text.is_euroc,
        read=imu_text.read_euroc,
    ),
    ImuFormat(
        name="inertial-scale",
        layout="a folder with gyroscope.txt and accelerometer.txt",
        accepts=imu_text.is_inertial_scale,
        read=imu_text.read_inertial_scale_imu,
    ),
    ImuFormat(
        name="csv",
        layout='a CSV file with a header such as "t [ns],gx [rad/s],...,az [m/s2]"',
        accepts=imu_text.is_csv,
        read=imu_text.read_csv,
    ),
]
