"""The JSON file of an IMU's own calibration; and what several calibration files of one device hold together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import IMU_CALIBRATION_PARAMETERS, CameraImuCalibration, ImuCalibration
from colmap_inertial.io.calibration import (
    CAMERA_IMU,
    calibration_from_fields,
    for_another_recording,
    read_calibration,
    write_calibration_fields,
)
from colmap_inertial.io.files import StrPath, read_json

#: No file, one, or several of one device.
CalibrationFiles = StrPath | Sequence[StrPath] | None
#: What a file of this module holds, under ``kind``.
IMU = "imu"
#: Who writes each kind.
_WRITERS = {CAMERA_IMU: "align", IMU: "calibrate-imu"}
_WORDS = {CAMERA_IMU: "how camera and IMU relate", IMU: "the IMU's own gains"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibrations:
    """What is known of a device from files: how camera and IMU relate, and the IMU's own; ``None`` where nothing is.

    Attributes
    ----------
    camera_imu, imu
        The calibrations.
    """

    camera_imu: CameraImuCalibration | None = None
    imu: ImuCalibration | None = None


def write_imu_calibration(path: StrPath, calibration: ImuCalibration) -> None:
    """Write an IMU's calibration as JSON: its kind, the fields of :class:`ImuCalibration`, and the order of ``cov``."""
    write_calibration_fields(Path(path), IMU, calibration, IMU_CALIBRATION_PARAMETERS)


def read_imu_calibration(path: StrPath) -> ImuCalibration:
    """Read a calibration that :func:`write_imu_calibration` (or ``colmap-inertial calibrate-imu``) wrote.

    Raises
    ------
    FormatError
        Where it is of another kind; where a field is missing, unknown, of a wrong shape, or not finite.
    """
    path = Path(path)
    values = read_json(path)
    if values.pop("kind", None) != IMU:
        raise FormatError(path, "holds no calibration of an IMU (colmap-inertial calibrate-imu writes one)")
    return calibration_from_fields(path, values, ImuCalibration, IMU_CALIBRATION_PARAMETERS)


def calibration_kind(path: StrPath) -> str:
    """What a calibration file holds: ``"camera-imu"`` or ``"imu"``.

    Raises
    ------
    FormatError
        For a file of another kind.
    """
    path = Path(path)
    kind = read_json(path).get("kind", CAMERA_IMU)
    if not isinstance(kind, str) or kind not in _WRITERS:
        known = ", ".join(f'"{name}" ({command})' for name, command in _WRITERS.items())
        raise FormatError(path, f"kind: {str(kind)[:40]!r} is no kind of calibration; known: {known}")
    return kind


def holds_imu_alone(path: Path) -> bool:
    """Whether a file is there and says nothing of a camera."""
    return path.is_file() and calibration_kind(path) == IMU


def as_paths(paths: CalibrationFiles) -> tuple[Path, ...]:
    """The paths of calibration files, however many were given."""
    if paths is None:
        return ()
    return (Path(paths),) if isinstance(paths, str | os.PathLike) else tuple(map(Path, paths))


def used_files(paths: CalibrationFiles) -> list[dict[str, str]]:
    """What a result says of the calibration files that were used: path and kind of each."""
    return [{"path": str(path.resolve()), "kind": calibration_kind(path)} for path in as_paths(paths)]


def read_calibrations(paths: CalibrationFiles) -> Calibrations:
    """Read the calibration files of one device; each says what it holds.

    Raises
    ------
    FormatError
        Where two files hold the same; for a file that cannot be read.
    """
    found: dict[str, Path] = {}
    for path in as_paths(paths):
        kind = calibration_kind(path)
        if kind in found:
            raise FormatError(path, f"and {found[kind]} both say {_WORDS[kind]}; give one of them")
        found[kind] = path
    return Calibrations(
        camera_imu=read_calibration(found[CAMERA_IMU]) if CAMERA_IMU in found else None,
        imu=read_imu_calibration(found[IMU]) if IMU in found else None,
    )


def read_for_another(paths: CalibrationFiles, *, shared_clock: bool = False) -> Calibrations:
    """As :func:`read_calibrations`; of camera and IMU, what they say about another recording of the device."""
    found = read_calibrations(paths)
    if found.camera_imu is None:
        return found
    return replace(found, camera_imu=for_another_recording(found.camera_imu, shared_clock=shared_clock))
