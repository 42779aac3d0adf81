"""Sheets of numbers about sensors; the ``sensor.yaml`` of ASL/EuRoC datasets: intrinsics, extrinsics, IMU noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import CameraModel, ImuNoise
from colmap_inertial.io.files import read_text, read_yaml

_NOISE_KEYS = {
    "gyro_density_rad_s_rthz": "gyroscope_noise_density",
    "accel_density_m_s2_rthz": "accelerometer_noise_density",
    "gyro_walk_rad_s2_rthz": "gyroscope_random_walk",
    "accel_walk_m_s3_rthz": "accelerometer_random_walk",
}
#: COLMAP's camera models in the order of their ids: parameters, and where the principal point stands among them.
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": (3, 1),
    "PINHOLE": (4, 2),
    "SIMPLE_RADIAL": (4, 1),
    "RADIAL": (5, 1),
    "OPENCV": (8, 2),
    "OPENCV_FISHEYE": (8, 2),
    "FULL_OPENCV": (12, 2),
    "FOV": (5, 2),
    "SIMPLE_RADIAL_FISHEYE": (4, 1),
    "RADIAL_FISHEYE": (5, 1),
    "THIN_PRISM_FISHEYE": (12, 2),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, 2),
    "SIMPLE_DIVISION": (4, 1),
    "DIVISION": (5, 2),
    "SIMPLE_FISHEYE": (3, 1),
    "FISHEYE": (4, 2),
    "EUCM": (6, 2),
}
#: COLMAP's model for each name of a distortion of pinhole cameras: those of the ASL format, then Kalibr's.
_COLMAP_MODELS = {
    "radial-tangential": "OPENCV",
    "radtan": "OPENCV",
    "equidistant": "OPENCV_FISHEYE",
    "none": "PINHOLE",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """Keys and values of a sheet of numbers, or of one ``part`` of it, whose complaints name file and part."""

    path: Path
    values: Mapping[str, Any]
    part: str = ""

    def fault(self, reason: Fact) -> FormatError:
        """The error for what is wrong with a value."""
        return FormatError(self.path, Fact("wrong-entry", entry=self.part, fault=reason) if self.part else reason)

    def unknown(self, key: str, known: Iterable[str]) -> FormatError:
        """The error for a value that is none of those known here."""
        return self.fault(Fact("value-not-known", key=key, found=repr(self.values.get(key))[:200], known=tuple(known)))

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """The finite numbers under a key: one, a list, or lists of them; ``count`` of them."""
        if self.values.get(key) is None:
            raise self.fault(Fact("key-missing", key=key))
        value = self.values[key]
        try:
            numbers: list[float] = np.asarray(value, dtype=np.float64).ravel().tolist()
        except (TypeError, ValueError):
            raise self.fault(Fact("key-not-numbers", key=key, found=repr(value)[:300])) from None
        if not np.isfinite(numbers).all():
            raise self.fault(Fact("key-not-finite", key=key))
        if count is not None and len(numbers) != count:
            raise self.fault(Fact("key-of-other-count", key=key, count=count, found=len(numbers)))
        return numbers

    def pose(self, key: str, what: str) -> Array:
        """A (4, 4) matrix that moves and rotates."""
        matrix = np.array(self.numbers(key, 16)).reshape(4, 4)
        if not is_rotation(matrix[:3, :3]):
            raise self.fault(Fact("no-rotation", what=what))
        return matrix

    def pinhole(self, coefficients: str) -> tuple[str, tuple[float, ...], tuple[int, int]]:
        """Model and parameters in COLMAP's terms, width and height, of a pinhole camera of the ASL format or Kalibr's.

        With radial-tangential distortion it is COLMAP's OPENCV, with equidistant distortion OPENCV_FISHEYE; the
        principal point is moved by half a pixel from OpenCV's origin to COLMAP's.
        """
        if self.values.get("camera_model") != "pinhole":
            raise self.unknown("camera_model", ("pinhole",))
        distortion = self.values.get("distortion_model")
        if distortion not in _COLMAP_MODELS:
            raise self.unknown("distortion_model", _COLMAP_MODELS)
        fx, fy, *centre = self.numbers("intrinsics", 4)
        more = [] if distortion == "none" else self.numbers(coefficients, 4)
        width, height = self.numbers("resolution", 2)
        params = (fx, fy, *colmap_px_from_opencv(np.array(centre)).tolist(), *more)
        return _COLMAP_MODELS[distortion], params, (int(width), int(height))


def is_rotation(matrix: Array) -> bool:
    """Whether a (3, 3) matrix is a rotation, to the precision that people write."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(matrix) > 0)


def _read(path: Path) -> Sheet:
    return Sheet(path=path, values=read_yaml(path, "a sensor.yaml"))


def is_asl(path: Path) -> bool:
    """Whether a sheet is the ASL format's: of one sensor, whose keys stand at the top."""
    known = {"T_BS", "sensor_type", "camera_model", "rate_hz"}
    return not path.is_file() or bool(
        known & {line.partition(":")[0].strip() for line in read_text(path).splitlines() if line[:1].strip()}
    )


def read_imu_noise(path: Path) -> ImuNoise | None:
    """The noise densities and walks of an IMU's sheet; ``None`` where it gives none.

    Raises
    ------
    FormatError
        Where the sheet gives some of the four and not all, or not as numbers.
    """
    sheet = _read(path)
    if not any(key in sheet.values for key in _NOISE_KEYS.values()):
        return None
    values = {name: sheet.numbers(key, 1)[0] for name, key in _NOISE_KEYS.items()}
    try:
        return ImuNoise(**values)
    except ValueError as error:
        raise FormatError(path, Fact("invalid-values", detail=str(error))) from None


def read_camera(path: Path) -> CameraModel:
    """The camera model of a camera's sheet, in COLMAP's terms; see :meth:`Sheet.pinhole`."""
    model, params, (width, height) = _read(path).pinhole("distortion_coefficients")
    try:
        return CameraModel(model=model, width=width, height=height, params=params)
    except ValueError as error:
        raise FormatError(
            path, Fact("wrong-entry", entry="resolution", fault=Fact("invalid-values", detail=str(error)))
        ) from None


def read_body_from_sensor(path: Path) -> Array:
    """(4, 4) ``T_BS``: body frame from sensor frame, metres."""
    entry = _read(path).values.get("T_BS")
    if not isinstance(entry, dict):
        raise FormatError(path, Fact("no-body-pose"))
    return Sheet(path=path, values=entry).pose("data", "T_BS")
