"""Camera-IMU calibrations: what is known before an estimate, and the JSON file that carries one between recordings."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import CAL, CALIBRATION_PARAMETERS, CameraImuCalibration
from colmap_inertial.io.files import StrPath, read_json, write_json

#: Standard deviations of what nobody knows. A rotation: any. Offsets: clock origins are arbitrary.
UNKNOWN_ROTATION_RAD = np.pi
UNKNOWN_OFFSET_S = 1e4
UNKNOWN_GYRO_BIAS_RAD_S = 0.1
UNKNOWN_LEVER_ARM_M = 0.08  # along each axis: a phone is flat, an action camera or a rig is not
UNKNOWN_READOUT_S = 0.02
#: Camera and IMU on one clock differ by pipeline delays at most.
SHARED_CLOCK_OFFSET_S = 1.0
#: Within one device the accelerometer's delay differs from the gyroscope's by filters; -8 to -13 ms on a tablet.
ACCEL_MINUS_GYRO_OFFSET_S = 0.02
#: Standard deviations of what was declared without one.
KNOWN_ROTATION_RAD = 0.01
KNOWN_LEVER_ARM_M = 0.005
KNOWN_OFFSET_S = 0.002
KNOWN_GYRO_BIAS_RAD_S = 0.002
KNOWN_READOUT_SHARE = 0.02
SMALLEST_READOUT_S = 1e-4

#: What a file of this module holds, under ``kind``; one without it is of this kind, too.
CAMERA_IMU = "camera-imu"
#: Fields that a file may lack, as those of clocks that keep step do.
_CLOCK = {"clock_rate", "clock_middle_s"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Declared:
    """What is stated of the camera and the IMU of a device, ``None`` where nothing is, and how sure it is.

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
    rotation_sigma_rad: float = KNOWN_ROTATION_RAD
    imu_in_cam_sigma_m: float = KNOWN_LEVER_ARM_M
    time_offset_sigma_s: float = KNOWN_OFFSET_S
    gyro_bias_sigma_rad_s: float = KNOWN_GYRO_BIAS_RAD_S


def calibration_prior(declared: Declared | None = None, *, shared_clock: bool = False) -> CameraImuCalibration:
    """A calibration that is as sure as what was declared, and wide where nothing was.

    Parameters
    ----------
    declared
        What is known.
    shared_clock
        Camera and IMU stamps come from one clock: unknown offsets are within a second.
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
        extra_s = [ACCEL_MINUS_GYRO_OFFSET_S * on_gyro, ACCEL_MINUS_GYRO_OFFSET_S * (not on_gyro)]

    cov = np.zeros((CAL.COUNT, CAL.COUNT))
    rotation_sd = UNKNOWN_ROTATION_RAD if known.cam_from_imu_xyzw is None else known.rotation_sigma_rad
    bias_sd = UNKNOWN_GYRO_BIAS_RAD_S if known.gyro_bias_rad_s is None else known.gyro_bias_sigma_rad_s
    lever_sd = UNKNOWN_LEVER_ARM_M if known.imu_in_cam_m is None else known.imu_in_cam_sigma_m
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
    return SHARED_CLOCK_OFFSET_S if shared_clock else UNKNOWN_OFFSET_S


def readout_sigma_s(readout_s: float | None) -> float:
    """Standard deviation of a readout that was declared (or not: ``None``)."""
    if readout_s is None:
        return UNKNOWN_READOUT_S
    return max(SMALLEST_READOUT_S, KNOWN_READOUT_SHARE * readout_s)


def largest_offset_s(shared_clock: bool, asked: float | None = None) -> float | None:
    """Largest offset between raw stamps to search for: what was asked for, else a shared clock's, else any."""
    return SHARED_CLOCK_OFFSET_S if asked is None and shared_clock else asked


def for_another_recording(calibration: CameraImuCalibration, *, shared_clock: bool = False) -> CameraImuCalibration:
    """What a calibration of one recording says about the next one of the same device.

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
    cov[opened, opened] = np.square([_unknown_offset_s(shared_clock), *[UNKNOWN_GYRO_BIAS_RAD_S] * 3])
    cov = back @ cov @ back.T
    delay_s = calibration.accel_time_offset_s - calibration.gyro_time_offset_s
    gyro_offset_s = calibration.gyro_time_offset_s if shared_clock else 0.0
    return replace(
        calibration,
        gyro_time_offset_s=gyro_offset_s,
        accel_time_offset_s=gyro_offset_s + delay_s,
        clock_rate=0.0,
        clock_middle_s=0.0,
        cov=0.5 * (cov + cov.T),
    )


def write_calibration(path: StrPath, calibration: CameraImuCalibration) -> None:
    """Write a calibration as JSON: its kind, the fields of :class:`CameraImuCalibration`, and the order of ``cov``.

    A clock rate and when the offsets hold are written where the clocks do not keep step.
    """
    path = Path(path)
    values = {field.name: getattr(calibration, field.name) for field in fields(calibration)}
    if calibration.clock_rate == 0:
        values = {name: value for name, value in values.items() if name not in _CLOCK}
    write_json(path, {"kind": CAMERA_IMU, **values, "cov_parameters": list(CALIBRATION_PARAMETERS)})


def read_calibration(path: StrPath) -> CameraImuCalibration:
    """Read a calibration that :func:`write_calibration` (or ``colmap-inertial align``) wrote.

    Raises
    ------
    FormatError
        Where a field is missing, unknown, of a wrong shape, or not finite.
    """
    path = Path(path)
    values = read_json(path)
    if values.pop("kind", CAMERA_IMU) != CAMERA_IMU:
        raise FormatError(path, "holds no calibration of a camera and an IMU (its kind is another)")
    order = values.pop("cov_parameters", list(CALIBRATION_PARAMETERS))
    if order != list(CALIBRATION_PARAMETERS):
        raise FormatError(path, "cov_parameters: the order of cov is not the one of this version")
    names = {field.name for field in fields(CameraImuCalibration)}
    missing, unknown = sorted(names - values.keys() - _CLOCK), sorted(values.keys() - names)
    if missing or unknown:
        what = "; ".join(
            f"{label} {', '.join(items)}" for label, items in (("missing:", missing), ("unknown:", unknown)) if items
        )
        raise FormatError(path, f"not a calibration file ({what})")
    for name, value in values.items():
        if not is_numeric(value):
            raise FormatError(path, f"{name}: expected numbers")
    scalars = ["gyro_time_offset_s", "accel_time_offset_s", "readout_s", *sorted(_CLOCK & values.keys())]
    if any(not isinstance(values[name], int | float) for name in scalars):
        raise FormatError(path, f"{', '.join(scalars)} must be single numbers")
    try:
        return CameraImuCalibration(**values)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(path, str(error)) from None


def is_numeric(value: object) -> bool:
    """Whether a value of a JSON file is a number, or lists of numbers."""
    if isinstance(value, list):
        return all(is_numeric(item) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool)
