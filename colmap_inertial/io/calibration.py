"""Calibrations: what is known before an estimate, and JSON files that carry one between recordings.

A file holds the calibration of a camera and an IMU, or the IMU's own; several files describe one device together.
"""

from __future__ import annotations

import os
from collections.abc import Sequence, Set
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.types import (
    CAL,
    CALIBRATION_PARAMETERS,
    IMU_CALIBRATION_PARAMETERS,
    CameraImuCalibration,
    ImuCalibration,
)
from colmap_inertial.io.device_yaml import is_yaml, read_device_yaml
from colmap_inertial.io.files import StrPath, read_json, read_text, reader, write_json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


T = TypeVar("T", bound="DataclassInstance")


@dataclass(frozen=True, kw_only=True)
class CalibrationSigmas:
    """Standard deviations of a calibration before an estimate: of what nobody knows, and of what is stated."""

    #: Any rotation.
    unknown_rotation_rad: float = np.pi
    #: The origins of clocks are arbitrary.
    unknown_offset_s: float = 1e4
    #: Of a gyroscope that nothing was said about.
    unknown_gyro_bias_rad_s: float = 0.1
    #: Along each axis: a phone is flat, an action camera or a rig is not.
    unknown_lever_arm_m: float = 0.08
    #: Where no readout is declared.
    unknown_readout_s: float = 0.02
    #: Camera and IMU on one clock differ by pipeline delays: none on EuRoC and TUM-VI, 14 ms on a phone, 55 ms in a
    #: recording by a camera on a computer;
    shared_clock_sigma_s: float = 0.1
    #: at most.
    shared_clock_offset_s: float = 1.0
    #: Within one device the delays of the two sensors differ by filters; -8 to -13 ms on a tablet.
    accel_minus_gyro_offset_s: float = 0.02
    #: What was stated without a standard deviation.
    known_rotation_rad: float = 0.01
    #: What was stated without a standard deviation.
    known_lever_arm_m: float = 0.005
    #: What was stated without a standard deviation.
    known_offset_s: float = 0.002
    #: What was stated without a standard deviation.
    known_gyro_bias_rad_s: float = 0.002
    #: What a program was told to refine.
    guessed_rotation_rad: float = 0.05
    #: What a program was told to refine.
    guessed_lever_arm_m: float = 0.05
    #: A readout that was stated, as a share of it, and at least.
    known_readout_share: float = 0.02
    #: A readout that was stated, as a share of it, and at least.
    smallest_readout_s: float = 1e-4


SIGMAS = CalibrationSigmas()

#: What a file of this module holds, under ``kind``; one without it is of this kind, too.
CAMERA_IMU = "camera-imu"
#: Fields that a file may lack, as those of clocks that keep step do.
_CLOCK = frozenset({"clock_rate", "clock_middle_s"})
#: Fields of an IMU's calibration that one by rests may lack.
_COMPARED = frozenset({"compared", "accel_factor"})


@dataclass(frozen=True, eq=False, kw_only=True)
class Declared:
    """Stated values of a device's camera and IMU, ``None`` where nothing is stated, with uncertainties.

    Attributes
    ----------
    cam_from_imu_xyzw, imu_in_cam_m, gyro_time_offset_s, accel_time_offset_s, gyro_bias_rad_s, readout_s
        As in :class:`CameraImuCalibration`. Of the two offsets one alone carries the other, as gyroscope and
        accelerometer of a device differ by milliseconds.
    rotation_sigma_rad, imu_in_cam_sigma_m, time_offset_sigma_s, gyro_bias_sigma_rad_s
        Standard deviations of what is stated.
    """

    cam_from_imu_xyzw: ArrayLike | None = None
    imu_in_cam_m: ArrayLike | None = None
    gyro_time_offset_s: float | None = None
    accel_time_offset_s: float | None = None
    gyro_bias_rad_s: ArrayLike | None = None
    readout_s: float | None = None
    rotation_sigma_rad: float = SIGMAS.known_rotation_rad
    imu_in_cam_sigma_m: float = SIGMAS.known_lever_arm_m
    time_offset_sigma_s: float = SIGMAS.known_offset_s
    gyro_bias_sigma_rad_s: float = SIGMAS.known_gyro_bias_rad_s


def calibration_prior(declared: Declared | None = None, *, shared_clock: bool = False) -> CameraImuCalibration:
    """A calibration that is as sure as what was declared, and wide where nothing was.

    Parameters
    ----------
    declared
        What is known.
    shared_clock
        Camera and IMU stamps come from one clock: unknown offsets are delays of a tenth of a second.
    """
    known = declared or Declared()
    gyro_s, accel_s, sigma_s = known.gyro_time_offset_s, known.accel_time_offset_s, known.time_offset_sigma_s
    stated = [offset_s for offset_s in (gyro_s, accel_s) if offset_s is not None]
    origin_s = stated[0] if stated else 0.0
    if len(stated) == 2:
        common_s, extra_s = 0.0, [sigma_s, sigma_s]
    else:
        common_s = sigma_s if stated else _unknown_offset_s(shared_clock)
        on_gyro = bool(stated) and gyro_s is None
        delay_s = SIGMAS.accel_minus_gyro_offset_s
        extra_s = [delay_s * on_gyro, delay_s * (not on_gyro)]

    cov = np.zeros((CAL.COUNT, CAL.COUNT))
    rotation_sd = SIGMAS.unknown_rotation_rad if known.cam_from_imu_xyzw is None else known.rotation_sigma_rad
    bias_sd = SIGMAS.unknown_gyro_bias_rad_s if known.gyro_bias_rad_s is None else known.gyro_bias_sigma_rad_s
    lever_sd = SIGMAS.unknown_lever_arm_m if known.imu_in_cam_m is None else known.imu_in_cam_sigma_m
    cov[CAL.ROTATION, CAL.ROTATION] = np.eye(3) * rotation_sd**2
    cov[CAL.TIME_OFFSETS, CAL.TIME_OFFSETS] = common_s**2 + np.diag(np.square(extra_s))
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = np.eye(3) * bias_sd**2
    cov[CAL.LEVER_ARM, CAL.LEVER_ARM] = np.eye(3) * np.square(lever_sd)
    cov[CAL.READOUT, CAL.READOUT] = readout_sigma_s(known.readout_s) ** 2
    rotation = [0.0, 0.0, 0.0, 1.0] if known.cam_from_imu_xyzw is None else known.cam_from_imu_xyzw
    return CameraImuCalibration(
        cam_from_imu_xyzw=np.array(rotation),
        gyro_time_offset_s=origin_s if gyro_s is None else gyro_s,
        accel_time_offset_s=origin_s if accel_s is None else accel_s,
        gyro_bias_rad_s=np.array(np.zeros(3) if known.gyro_bias_rad_s is None else known.gyro_bias_rad_s),
        imu_in_cam_m=np.array(np.zeros(3) if known.imu_in_cam_m is None else known.imu_in_cam_m),
        readout_s=0.0 if known.readout_s is None else known.readout_s,
        cov=cov,
    )


def _unknown_offset_s(shared_clock: bool) -> float:
    """Standard deviation of a time offset that nothing was said about."""
    return SIGMAS.shared_clock_sigma_s if shared_clock else SIGMAS.unknown_offset_s


def readout_sigma_s(readout_s: float | None) -> float:
    """Standard deviation of a readout that was declared (or not: ``None``)."""
    if readout_s is None:
        return SIGMAS.unknown_readout_s
    return max(SIGMAS.smallest_readout_s, SIGMAS.known_readout_share * readout_s)


def largest_offset_s(shared_clock: bool, asked: float | None = None) -> float | None:
    """Largest offset between raw stamps to search for: what was asked for, else a shared clock's, else any."""
    return SIGMAS.shared_clock_offset_s if asked is None and shared_clock else asked


def reset_for_recording(calibration: CameraImuCalibration, *, shared_clock: bool = False) -> CameraImuCalibration:
    """Turn a calibration from one recording into a prior for the next one of the same device.

    Rotation, lever arm, readout and the accelerometer's delay against the gyroscope stay; the time offset, its growth
    and the gyroscope's bias change with every recording and are opened again. With ``shared_clock`` the offset stays
    as the centre of a search within a second.
    """
    # From (gyro, accel) offsets to (gyro, accel - gyro): there the first widens and the second stays.
    to_delay, back = np.eye(CAL.COUNT), np.eye(CAL.COUNT)
    to_delay[CAL.ACCEL_TIME_OFFSET, CAL.GYRO_TIME_OFFSET] = -1.0
    back[CAL.ACCEL_TIME_OFFSET, CAL.GYRO_TIME_OFFSET] = 1.0
    cov = to_delay @ calibration.cov @ to_delay.T
    opened = np.r_[CAL.GYRO_TIME_OFFSET, CAL.GYRO_BIAS]
    cov[opened, :] = cov[:, opened] = 0.0
    cov[opened, opened] = np.square([_unknown_offset_s(shared_clock), *[SIGMAS.unknown_gyro_bias_rad_s] * 3])
    cov = back @ cov @ back.T
    gyro_offset_s = calibration.gyro_time_offset_s if shared_clock else 0.0
    return replace(
        calibration.replace_clock_offset(gyro_offset_s, calibration.accel_delay_s),
        clock_rate=0.0,
        clock_middle_s=0.0,
        cov=0.5 * (cov + cov.T),
    )


def write_calibration(path: StrPath, calibration: CameraImuCalibration) -> None:
    """Write a calibration as JSON: its kind, the fields of :class:`CameraImuCalibration`, and the order of ``cov``.

    A clock rate and when the offsets hold are written where the clocks do not keep step.
    """
    left_out = _CLOCK if calibration.clock_rate == 0 else frozenset()
    _write_fields(Path(path), CAMERA_IMU, calibration, CALIBRATION_PARAMETERS, left_out)


@reader("a calibration")
def read_calibration(path: StrPath) -> CameraImuCalibration:
    """Read a calibration that :func:`write_calibration` (or ``colmap-inertial align``) wrote.

    Raises
    ------
    FormatError
        Where a field is missing, unknown, of a wrong shape, or not finite.
    """
    path = Path(path)
    if is_yaml(path):
        return calibration_prior(read_declared(path))
    # a file that states neither is of this kind and order
    values = {"kind": CAMERA_IMU, "cov_parameters": list(CALIBRATION_PARAMETERS), **_read_values(path)}
    if values.pop("kind") != CAMERA_IMU:
        raise FormatError(path, Fact("calibration-of-another-kind"))
    return _read_fields(path, values, CameraImuCalibration, CALIBRATION_PARAMETERS, _CLOCK)


def read_declared(path: Path, readout_s: float | None = None) -> Declared:
    """What the YAML of another program states of camera and IMU; ``readout_s`` where it is known otherwise.

    Raises
    ------
    FormatError
        Where it says nothing of an IMU.
    """
    sheet = read_device_yaml(path)
    pose = sheet.cam_from_imu
    if pose is None and sheet.clock_offset_s is None:
        raise FormatError(path, Fact("calibration-without-imu"))
    guess = {"rotation_sigma_rad": SIGMAS.guessed_rotation_rad, "imu_in_cam_sigma_m": SIGMAS.guessed_lever_arm_m}
    return Declared(
        cam_from_imu_xyzw=None if pose is None else quat_from_matrix(pose[:3, :3]),
        imu_in_cam_m=None if pose is None else pose[:3, 3],
        gyro_time_offset_s=sheet.clock_offset_s,
        readout_s=sheet.readout_s if readout_s is None else readout_s,
        **(guess if sheet.is_first_guess else {}),
    )


def _write_fields(
    path: Path, kind: str, calibration: DataclassInstance, parameters: Sequence[str], left_out: Set[str] = frozenset()
) -> None:
    """Write a calibration: its kind, its fields but those left out, and the order of ``cov``."""
    written = {f.name: getattr(calibration, f.name) for f in fields(calibration) if f.name not in left_out}
    write_json(path, {"kind": kind, **written, "cov_parameters": list(parameters)})


def _read_fields(
    path: Path, values: dict[str, Any], cls: type[T], parameters: Sequence[str], optional: Set[str] = frozenset()
) -> T:
    """The calibration of fields that :func:`_write_fields` wrote, each of the type that the class states.

    Raises
    ------
    FormatError
        Where a field is missing (but for ``optional`` ones), unknown, of another type, or refused by the class.
    """
    if values.pop("cov_parameters", None) != list(parameters):
        raise FormatError(path, Fact("calibration-cov-order"))
    types = {field.name: str(field.type) for field in fields(cls)}
    missing, unknown = sorted(types.keys() - values.keys() - optional), sorted(values.keys() - types.keys())
    if missing or unknown:
        raise FormatError(path, Fact("calibration-fields", missing=missing, unknown=unknown))
    for name, value in values.items():
        if fault := _field_fault(name, value, types[name]):
            raise FormatError(path, fault)
    try:
        return cls(**values)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(path, Fact("invalid-values", detail=str(error))) from None


def _field_fault(name: str, value: object, kind: str) -> Fact | None:
    """Reason why a value from JSON does not fit a field's annotation; ``None`` where it does."""

    def other_type(expected: str) -> Fact:
        return Fact("field-of-other-type", name=name, expected=expected)

    if kind == "str":
        return None if isinstance(value, str) else other_type("text")
    if kind == "int":
        return None if isinstance(value, int) and not isinstance(value, bool) else other_type("integer")
    if value is None and kind.endswith("None"):
        return None
    if not _is_numeric(value):
        return other_type("numbers")
    return Fact("field-not-single", name=name) if kind.startswith("float") and isinstance(value, list) else None


def _is_numeric(value: object) -> bool:
    """Whether a value from JSON is a number, or lists of numbers."""
    if isinstance(value, list):
        return all(map(_is_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


#: No file, one, or several of one device.
CalibrationFiles = StrPath | Sequence[StrPath] | None
#: What a file of this module holds, under ``kind``.
IMU = "imu"
#: Who writes each kind.
_WRITERS = {CAMERA_IMU: "align", IMU: "calibrate-imu"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibrations:
    """Calibrations of a device from files: camera to IMU, and the IMU's own; ``None`` where missing.

    Attributes
    ----------
    camera_imu, imu
        The calibrations.
    """

    camera_imu: CameraImuCalibration | None = None
    imu: ImuCalibration | None = None


def write_imu_calibration(path: StrPath, calibration: ImuCalibration) -> None:
    """Write an IMU's calibration as JSON: its kind, the fields of :class:`ImuCalibration`, and the order of ``cov``."""
    left_out = _COMPARED if calibration.accel_factor is None else frozenset[str]()
    _write_fields(Path(path), IMU, calibration, IMU_CALIBRATION_PARAMETERS, left_out)


@reader("a calibration of an IMU")
def read_imu_calibration(path: StrPath) -> ImuCalibration:
    """Read a calibration that :func:`write_imu_calibration` (or ``colmap-inertial calibrate-imu``) wrote.

    Raises
    ------
    FormatError
        Where it is of another kind; where a field is missing, unknown, of a wrong shape, or not finite.
    """
    path = Path(path)
    values = _read_values(path)
    if values.pop("kind", None) != IMU:
        raise FormatError(path, Fact("no-imu-calibration"))
    return _read_fields(path, values, ImuCalibration, IMU_CALIBRATION_PARAMETERS, _COMPARED)


def _read_values(path: Path) -> dict[str, Any]:
    """The fields of a calibration."""
    if path.suffix.lower() != ".json" and read_text(path).lstrip()[:1] != "{":
        raise FormatError(path, Fact("calibration-unknown"))
    return read_json(path)


def calibration_kind(path: StrPath) -> str:
    """Kind of a calibration file: ``"camera-imu"`` or ``"imu"``.

    Raises
    ------
    FormatError
        For a file of another kind.
    """
    path = Path(path)
    if is_yaml(path):
        return CAMERA_IMU
    kind = _read_values(path).get("kind", CAMERA_IMU)
    if not isinstance(kind, str) or kind not in _WRITERS:
        known, writers = tuple(_WRITERS), tuple(_WRITERS.values())
        raise FormatError(path, Fact("calibration-kind-unknown", kind=str(kind)[:40], known=known, writers=writers))
    return kind


def holds_imu_alone(path: Path) -> bool:
    """Whether a file is there and says nothing of a camera."""
    return path.is_file() and calibration_kind(path) == IMU


def list_paths(paths: CalibrationFiles) -> tuple[Path, ...]:
    """The paths of calibration files, however many were given."""
    if paths is None:
        return ()
    return (Path(paths),) if isinstance(paths, str | os.PathLike) else tuple(map(Path, paths))


def describe_files(paths: CalibrationFiles) -> list[dict[str, str]]:
    """Calibration files in a result: path and kind of each."""
    return [{"path": str(path.resolve()), "kind": calibration_kind(path)} for path in list_paths(paths)]


def read_calibrations(paths: CalibrationFiles) -> Calibrations:
    """Read the calibration files of one device; each says what it holds.

    Raises
    ------
    FormatError
        Where two files hold the same; for a file that cannot be read.
    """
    file_of: dict[str, Path] = {}
    for path in list_paths(paths):
        kind = calibration_kind(path)
        if kind in file_of:
            raise FormatError(path, Fact("calibrations-say-the-same", other=str(file_of[kind]), kind=kind))
        file_of[kind] = path
    return Calibrations(
        camera_imu=read_calibration(file_of[CAMERA_IMU]) if CAMERA_IMU in file_of else None,
        imu=read_imu_calibration(file_of[IMU]) if IMU in file_of else None,
    )


def read_for_recording(
    paths: CalibrationFiles, *, shared_clock: bool = False, readout_s: float | None = None
) -> Calibrations:
    """:func:`read_calibrations` as priors for another recording of the device.

    The YAML of another program states its offset of the clocks for all recordings; ``readout_s`` goes before its.
    """
    calibrations = read_calibrations(paths)
    if calibrations.camera_imu is None:
        return calibrations
    sheet = next((path for path in list_paths(paths) if is_yaml(path)), None)
    if sheet is not None:
        prior = calibration_prior(read_declared(sheet, readout_s), shared_clock=shared_clock)
        return replace(calibrations, camera_imu=prior)
    return replace(calibrations, camera_imu=reset_for_recording(calibrations.camera_imu, shared_clock=shared_clock))
