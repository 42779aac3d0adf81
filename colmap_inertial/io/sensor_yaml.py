"""The ``sensor.yaml`` of ASL/EuRoC datasets: intrinsics, extrinsics, IMU noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError
from colmap_inertial.geometry import colmap_px_from_opencv
from colmap_inertial.io.files import read_yaml
from colmap_inertial.types import CameraModel, ImuNoise

_NOISE_KEYS = {
    "gyro_density_rad_s_rthz": "gyroscope_noise_density",
    "accel_density_m_s2_rthz": "accelerometer_noise_density",
    "gyro_walk_rad_s2_rthz": "gyroscope_random_walk",
    "accel_walk_m_s3_rthz": "accelerometer_random_walk",
}
_COLMAP_MODELS = {"radial-tangential": "OPENCV", "radtan": "OPENCV", "equidistant": "OPENCV_FISHEYE"}


def read_imu_noise(path: Path) -> ImuNoise | None:
    """The noise densities and walks of an IMU's sheet; ``None`` where it gives none.

    Raises
    ------
    FormatError
        Where the sheet gives some of the four and not all, or not as numbers.
    """
    sheet = read_yaml(path, "a sensor.yaml")
    given = [key for key in _NOISE_KEYS.values() if key in sheet]
    if not given:
        return None
    values = {name: _numbers(path, sheet, key, 1)[0] for name, key in _NOISE_KEYS.items()}
    try:
        return ImuNoise(**values)
    except ValueError as error:
        raise FormatError(path, str(error)) from None


def read_camera(path: Path) -> CameraModel:
    """The camera model of a camera's sheet, in COLMAP's terms.

    Pinhole with radial-tangential distortion is COLMAP's OPENCV, with equidistant distortion OPENCV_FISHEYE; the
    principal point is moved by half a pixel from OpenCV's origin to COLMAP's.
    """
    sheet = read_yaml(path, "a sensor.yaml")
    if sheet.get("camera_model") != "pinhole":
        raise FormatError(path, f"camera_model {sheet.get('camera_model')!r} is not known here (pinhole is)")
    distortion = sheet.get("distortion_model")
    if distortion not in _COLMAP_MODELS:
        raise FormatError(path, f"distortion_model {distortion!r} is not known here ({', '.join(_COLMAP_MODELS)} are)")
    fx, fy, cx, cy = _numbers(path, sheet, "intrinsics", 4)
    coefficients = _numbers(path, sheet, "distortion_coefficients", 4)
    width, height = _numbers(path, sheet, "resolution", 2)
    centre = colmap_px_from_opencv(np.array([cx, cy]))
    try:
        return CameraModel(
            model=_COLMAP_MODELS[distortion],
            width=int(width),
            height=int(height),
            params=(fx, fy, float(centre[0]), float(centre[1]), *coefficients),
        )
    except ValueError as error:
        raise FormatError(path, f"resolution: {error}") from None


def read_body_from_sensor(path: Path) -> NDArray[np.float64]:
    """(4, 4) ``T_BS``: body frame from sensor frame, metres."""
    sheet = read_yaml(path, "a sensor.yaml")
    entry = sheet.get("T_BS")
    if not isinstance(entry, dict):
        raise FormatError(path, "holds no T_BS with rows, cols and data")
    matrix = np.array(_numbers(path, entry, "data", 16)).reshape(4, 4)
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise FormatError(path, "T_BS holds no rotation")
    return matrix


def _numbers(path: Path, sheet: dict[str, Any], key: str, count: int) -> list[float]:
    value = sheet.get(key)
    if value is None:
        raise FormatError(path, f"{key} is missing")
    items = value if isinstance(value, list) else [value]
    try:
        numbers = [float(item) for item in items]
    except (TypeError, ValueError):
        raise FormatError(path, f"{key}: {value!r} is not {'a number' if count == 1 else f'{count} numbers'}") from None
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise FormatError(path, f"{key}: expected {count} finite number{'s' if count > 1 else ''}, found {value!r}")
    return numbers
