"""Camera-IMU calibrations: what is known before an estimate, and the JSON file that carries one between recordings."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from colmap_inertial.errors import FormatError
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.types import CALIBRATION_PARAMETERS, CameraImuCalibration

#: Standard deviations of what nobody knows. A rotation: any. Offsets: clock origins are arbitrary.
UNKNOWN_ROTATION_RAD = np.pi
UNKNOWN_OFFSET_S = 1e4
UNKNOWN_GYRO_BIAS_RAD_S = 0.1
UNKNOWN_LEVER_ARM_M = (0.08, 0.08, 0.01)  # a device is flat: along the optical axis it is centimetres thick at most
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

_ROTATION, _OFFSETS, _BIAS, _LEVER, _READOUT = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 11), 11


def calibration_prior(
    *,
    cam_from_imu_xyzw: ArrayLike | None = None,
    imu_in_cam_m: ArrayLike | None = None,
    gyro_time_offset_s: float | None = None,
    accel_time_offset_s: float | None = None,
    gyro_bias_rad_s: ArrayLike | None = None,
    readout_s: float | None = None,
    shared_clock: bool = False,
    rotation_sigma_rad: float = KNOWN_ROTATION_RAD,
    imu_in_cam_sigma_m: float = KNOWN_LEVER_ARM_M,
    time_offset_sigma_s: float = KNOWN_OFFSET_S,
    gyro_bias_sigma_rad_s: float = KNOWN_GYRO_BIAS_RAD_S,
) -> CameraImuCalibration:
    """A calibration that is as sure as what was declared, and wide where nothing was.

    Parameters
    ----------
    cam_from_imu_xyzw, imu_in_cam_m, gyro_time_offset_s, accel_time_offset_s, gyro_bias_rad_s, readout_s
        As in :class:`CameraImuCalibration`; ``None`` where unknown. Of the two offsets one alone carries the other,
        as gyroscope and accelerometer of a device differ by milliseconds.
    shared_clock
        Camera and IMU stamps come from one clock: unknown offsets are within a second.
    rotation_sigma_rad, imu_in_cam_sigma_m, time_offset_sigma_s, gyro_bias_sigma_rad_s
        Standard deviations of the declared ones.
    """
    if gyro_time_offset_s is None and accel_time_offset_s is None:
        offsets = (0.0, 0.0)
        sigma_s = SHARED_CLOCK_OFFSET_S if shared_clock else UNKNOWN_OFFSET_S
        common, gyro_extra, accel_extra = sigma_s**2, 0.0, ACCEL_MINUS_GYRO_OFFSET_S**2
    elif gyro_time_offset_s is None or accel_time_offset_s is None:
        known = gyro_time_offset_s if accel_time_offset_s is None else accel_time_offset_s
        assert known is not None
        offsets = (known, known)
        extra = ACCEL_MINUS_GYRO_OFFSET_S**2
        common = time_offset_sigma_s**2
        gyro_extra, accel_extra = (0.0, extra) if accel_time_offset_s is None else (extra, 0.0)
    else:
        offsets = (gyro_time_offset_s, accel_time_offset_s)
        common, gyro_extra, accel_extra = 0.0, time_offset_sigma_s**2, time_offset_sigma_s**2

    cov = np.zeros((len(CALIBRATION_PARAMETERS),) * 2)
    rotation_sd = UNKNOWN_ROTATION_RAD if cam_from_imu_xyzw is None else rotation_sigma_rad
    bias_sd = UNKNOWN_GYRO_BIAS_RAD_S if gyro_bias_rad_s is None else gyro_bias_sigma_rad_s
    lever_sd = UNKNOWN_LEVER_ARM_M if imu_in_cam_m is None else imu_in_cam_sigma_m
    cov[_ROTATION, _ROTATION] = np.eye(3) * rotation_sd**2
    cov[_OFFSETS, _OFFSETS] = common + np.diag([gyro_extra, accel_extra])
    cov[_BIAS, _BIAS] = np.eye(3) * bias_sd**2
    cov[_LEVER, _LEVER] = np.eye(3) * np.square(lever_sd)
    cov[_READOUT, _READOUT] = readout_sigma_s(readout_s) ** 2
    return CameraImuCalibration(
        cam_from_imu_xyzw=np.array([0.0, 0.0, 0.0, 1.0] if cam_from_imu_xyzw is None else cam_from_imu_xyzw),
        gyro_time_offset_s=offsets[0],
        accel_time_offset_s=offsets[1],
        gyro_bias_rad_s=np.array(np.zeros(3) if gyro_bias_rad_s is None else gyro_bias_rad_s),
        imu_in_cam_m=np.array(np.zeros(3) if imu_in_cam_m is None else imu_in_cam_m),
        readout_s=0.0 if readout_s is None else readout_s,
        cov=cov,
    )


def readout_sigma_s(readout_s: float | None) -> float:
    """Standard deviation of a readout that was declared (or not: ``None``)."""
    if readout_s is None:
        return UNKNOWN_READOUT_S
    return max(SMALLEST_READOUT_S, KNOWN_READOUT_SHARE * readout_s)


def for_another_recording(calibration: CameraImuCalibration, *, shared_clock: bool = False) -> CameraImuCalibration:
    """What a calibration of one recording says about the next one of the same device.

    Rotation, lever arm, readout and the accelerometer's delay against the gyroscope stay; the time offset and the
    gyroscope's bias change with every recording and are opened again. With ``shared_clock`` the offset stays as the
    centre of a search within a second.
    """
    cov = calibration.cov.copy()
    # From (gyro, accel) offsets to (gyro, accel - gyro): there the first widens and the second stays.
    jacobian = np.eye(len(cov))
    jacobian[4, 3] = -1.0
    cov = jacobian @ cov @ jacobian.T
    for index, sigma in (
        (3, SHARED_CLOCK_OFFSET_S if shared_clock else UNKNOWN_OFFSET_S),
        *((i, UNKNOWN_GYRO_BIAS_RAD_S) for i in range(5, 8)),
    ):
        cov[index, :] = cov[:, index] = 0.0
        cov[index, index] = sigma**2
    back = np.eye(len(cov))
    back[4, 3] = 1.0
    cov = back @ cov @ back.T
    delay_s = calibration.accel_time_offset_s - calibration.gyro_time_offset_s
    gyro_offset_s = calibration.gyro_time_offset_s if shared_clock else 0.0
    return CameraImuCalibration(
        cam_from_imu_xyzw=calibration.cam_from_imu_xyzw,
        gyro_time_offset_s=gyro_offset_s,
        accel_time_offset_s=gyro_offset_s + delay_s,
        gyro_bias_rad_s=calibration.gyro_bias_rad_s,
        imu_in_cam_m=calibration.imu_in_cam_m,
        readout_s=calibration.readout_s,
        cov=0.5 * (cov + cov.T),
    )


def write_calibration(path: Path, calibration: CameraImuCalibration) -> None:
    """Write a calibration as JSON: the fields of :class:`CameraImuCalibration`, and the order of ``cov``."""
    names = [field.name for field in fields(calibration)]
    write_json(
        path,
        {**{name: getattr(calibration, name) for name in names}, "cov_parameters": list(CALIBRATION_PARAMETERS)},
    )


def read_calibration(path: Path) -> CameraImuCalibration:
    """Read a calibration that :func:`write_calibration` (or ``colmap-inertial align``) wrote.

    Raises
    ------
    FormatError
        Where a field is missing, unknown, of a wrong shape, or not finite.
    """
    path = Path(path)
    values = read_json(path)
    order = values.pop("cov_parameters", list(CALIBRATION_PARAMETERS))
    if order != list(CALIBRATION_PARAMETERS):
        raise FormatError(path, "cov_parameters: the order of cov is not the one of this version")
    names = {field.name for field in fields(CameraImuCalibration)}
    missing, unknown = sorted(names - values.keys()), sorted(values.keys() - names)
    if missing or unknown:
        what = "; ".join(
            f"{label} {', '.join(items)}" for label, items in (("missing:", missing), ("unknown:", unknown)) if items
        )
        raise FormatError(path, f"not a calibration file ({what})")
    for name, value in values.items():
        if not _is_numeric(value):
            raise FormatError(path, f"{name}: expected numbers")
    scalars = ("gyro_time_offset_s", "accel_time_offset_s", "readout_s")
    if any(not isinstance(values[name], int | float) for name in scalars):
        raise FormatError(path, f"{', '.join(scalars)} must be single numbers")
    try:
        return CameraImuCalibration(**values)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(path, str(error)) from None


def _is_numeric(value: object) -> bool:
    if isinstance(value, list):
        return all(_is_numeric(item) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool)
