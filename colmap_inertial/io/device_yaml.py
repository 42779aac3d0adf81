"""Calibrations of camera and IMU as other programs write them, in YAML, turned into our terms.

========================  ===========================================  ================================================
program                   pose                                         time
========================  ===========================================  ================================================
Kalibr camchain-imucam    ``T_cam_imu``: x_cam = T x_imu               ``timeshift_cam_imu``: t_imu = t_cam + shift
OpenVINS                  ``T_imu_cam``: x_imu = T x_cam               as Kalibr
VINS-Mono                 ``extrinsicRotation``, ``-Translation``:     ``td``: t_imu = t_cam + td
                          x_imu = R x_cam + t
VINS-Fusion               ``body_T_cam0``: x_imu = T x_cam             as VINS-Mono
ORB-SLAM                  ``Tbc``, ``IMU.T_b_c1``: x_imu = T x_cam     none
ROS CameraInfo            none                                         none
========================  ===========================================  ================================================

Camera time is stamp + offset here, so that the offset is minus the shift. All of them count pixels from the centre of
the top-left one, COLMAP from its corner. (github.com/ethz-asl/kalibr wiki; docs.openvins.com, Propagation and
Calibration; github.com/HKUST-Aerial-Robotics config files; docs.ros.org sensor_msgs/CameraInfo)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.files import read_yaml
from colmap_inertial.io.sensor_yaml import Sheet, is_rotation

_KALIBR_POSES = ("T_cam_imu", "T_imu_cam")
_BODY_POSES = ("body_T_cam0", "IMU.T_b_c1", "Tbc", "T_b_c1")
#: OpenCV's coefficients, as many as there are, and COLMAP's model for them.
_PLUMB_BOB, _RATIONAL, _EQUIDISTANT = ("plumb_bob", "radtan"), ("rational_polynomial",), ("equidistant", "fisheye")


@dataclass(frozen=True, eq=False, kw_only=True)
class SheetCamera:
    """A camera of such a calibration.

    Attributes
    ----------
    cam_from_imu
        (4, 4), metres; ``None`` where it is not stated.
    clock_offset_s
        Camera time minus IMU stamp; ``None`` where it is not stated.
    readout_s
        ``None`` where it is not stated.
    is_first_guess
        Whether its program was to refine the pose.
    """

    sheet: Sheet
    cam_from_imu: Array | None = None
    clock_offset_s: float | None = None
    readout_s: float | None = None
    is_first_guess: bool = False

    def camera(self) -> CameraModel:
        """The intrinsics, in COLMAP's terms.

        Raises
        ------
        FormatError
            Where they are missing, or of a model that is not known here.
        """
        model, params, (width, height) = _intrinsics(self.sheet)
        try:
            return CameraModel(model=model, width=width, height=height, params=params)
        except ValueError as error:
            raise self.sheet.fault(Fact("invalid-values", detail=str(error))) from None


def is_yaml(path: Path) -> bool:
    """Whether a path is named like YAML."""
    return path.suffix.lower() in (".yaml", ".yml")


def read_device_yaml(path: Path, camera: str | None = None) -> SheetCamera:
    """The camera of a calibration, and its IMU.

    Parameters
    ----------
    camera
        Its name, where there are several.

    Raises
    ------
    FormatError
        Where it is none of these, or has several cameras and no one is named.
    """
    values = read_tagged_yaml(path)
    linked = values.get("relative_config_imucam")
    if isinstance(linked, str) and "/" not in linked and (path.parent / linked).is_file():
        return read_device_yaml(path.parent / linked, camera)  # OpenVINS's estimator_config.yaml
    cameras = _cameras(path, values)
    if not cameras:
        raise FormatError(path, Fact("calibration-unknown"))
    if camera is None and len(cameras) > 1:
        raise FormatError(path, Fact("calibration-of-several", cameras=tuple(cameras)))
    if camera is not None and camera not in cameras:
        raise FormatError(path, Fact("no-camera-of-name", name=camera, cameras=tuple(cameras)))
    return cameras[camera or next(iter(cameras))]


def read_tagged_yaml(path: Path) -> dict[str, Any]:
    """Keys and values of a YAML file that may hold OpenCV's matrices."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Knows OpenCV's matrices."""

    def matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> object:
        return loader.construct_mapping(node, deep=True).get("data")

    for tag in ("opencv-matrix", "opencv-nd-matrix"):  # OpenCV 5 writes the latter for one-dimensional arrays
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", matrix)
    sheet = read_yaml(path, "a calibration", Loader)
    return {str(key): value for key, value in sheet.items()}


def _cameras(path: Path, values: dict[str, Any]) -> dict[str, SheetCamera]:
    blocks = {
        name: Sheet(path=path, values=block, part=name)
        for name, block in values.items()
        if isinstance(block, dict) and ("intrinsics" in block or any(key in block for key in _KALIBR_POSES))
    }
    if blocks:
        return _kalibr(blocks)
    whole = Sheet(path=path, values=values)
    if any(key in values for key in ("extrinsicRotation", *_BODY_POSES)):
        return {"cam0": _vins(whole)}
    if any(key in values for key in ("camera_matrix", "projection_parameters", "Camera.fx", "Camera1.fx")) or (
        {"K", "D"} <= values.keys() or {"k", "d"} <= values.keys()
    ):
        return {"cam0": SheetCamera(sheet=whole)}
    return {}


def _kalibr(blocks: Mapping[str, Sheet]) -> dict[str, SheetCamera]:
    cameras: dict[str, SheetCamera] = {}
    before: Array | None = None
    for name in sorted(blocks, key=lambda n: (len(n), n)):
        sheet = blocks[name]
        pose: Array | None = None
        if "T_cam_imu" in sheet.values:
            pose = sheet.pose("T_cam_imu", "T_cam_imu")
        elif "T_imu_cam" in sheet.values:
            pose = _inverse(sheet.pose("T_imu_cam", "T_imu_cam"))
        elif "T_cn_cnm1" in sheet.values and before is not None:
            pose = sheet.pose("T_cn_cnm1", "T_cn_cnm1") @ before
        shift = sheet.numbers("timeshift_cam_imu", 1)[0] if "timeshift_cam_imu" in sheet.values else None
        cameras[name] = SheetCamera(sheet=sheet, cam_from_imu=pose, clock_offset_s=None if shift is None else -shift)
        before = pose
    return cameras


def _vins(sheet: Sheet) -> SheetCamera:
    """VINS's configuration, or ORB-SLAM's: the pose of the camera in the body, whose frame is the IMU's."""
    values = sheet.values
    mode = int(sheet.numbers("estimate_extrinsic", 1)[0]) if "estimate_extrinsic" in values else 0
    body_from_cam = None
    if "extrinsicRotation" in values:
        body_from_cam = np.eye(4)
        body_from_cam[:3, :3] = np.array(sheet.numbers("extrinsicRotation", 9)).reshape(3, 3)
        body_from_cam[:3, 3] = sheet.numbers("extrinsicTranslation", 3)
        if not is_rotation(body_from_cam[:3, :3]):
            raise sheet.fault(Fact("no-rotation", what="extrinsicRotation"))
    else:
        key = next(key for key in _BODY_POSES if key in values)
        body_from_cam = sheet.pose(key, key)
    offset = -sheet.numbers("td", 1)[0] if "td" in values else None
    rolls = "rolling_shutter" in values and bool(sheet.numbers("rolling_shutter", 1)[0])
    return SheetCamera(
        sheet=_follow_camera(sheet),
        cam_from_imu=None if mode == 2 else _inverse(body_from_cam),
        clock_offset_s=offset,
        readout_s=sheet.numbers("rolling_shutter_tr", 1)[0] if rolls else None,
        is_first_guess=mode == 1,
    )


def _follow_camera(sheet: Sheet) -> Sheet:
    """VINS-Fusion keeps intrinsics in a file of their own."""
    linked = sheet.values.get("cam0_calib")
    if isinstance(linked, str) and "/" not in linked and (sheet.path.parent / linked).is_file():
        file = sheet.path.parent / linked
        return Sheet(path=file, values=read_tagged_yaml(file))
    return sheet


def _inverse(pose: Array) -> Array:
    return np.asarray(np.linalg.inv(pose), dtype=np.float64)


# --- intrinsics -------------------------------------------------------------------------------------------------------


def _intrinsics(sheet: Sheet) -> tuple[str, tuple[float, ...], tuple[int, int]]:
    values = sheet.values
    if "distortion_coeffs" in values or ("camera_model" in values and "intrinsics" in values):
        return sheet.pinhole("distortion_coeffs")
    if "projection_parameters" in values:
        return _camodocal(sheet)
    for before in ("Camera1.", "Camera."):
        if f"{before}fx" in values:
            return _orb_slam(sheet, before)
    matrix = next((key for key in ("camera_matrix", "K", "k") if key in values), None)
    if matrix is None:
        raise sheet.fault(Fact("sheet-without-intrinsics"))
    fx, _, cx, _, fy, cy, *_ = _data(sheet, matrix, 9)
    key = next((key for key in ("distortion_coefficients", "D", "d") if key in values), None)
    coefficients = [] if key is None else _data(sheet, key)
    model = str(values.get("distortion_model", "plumb_bob"))
    size = [int(sheet.numbers(key, 1)[0]) for key in _size_keys(values)]
    return _convert_to_colmap(sheet, model, (fx, fy, cx, cy), coefficients, (size[0], size[1]))


def _size_keys(values: Mapping[str, Any]) -> tuple[str, str]:
    return ("image_width", "image_height") if "image_width" in values else ("width", "height")


def _data(sheet: Sheet, key: str, count: int | None = None) -> list[float]:
    """Numbers of ROS's matrices, which have rows, cols and data."""
    entry = sheet.values[key]
    if isinstance(entry, dict):
        return Sheet(path=sheet.path, values=entry, part=key).numbers("data", count)
    return [] if entry is None or entry == [] else sheet.numbers(key, count)


def _camodocal(sheet: Sheet) -> tuple[str, tuple[float, ...], tuple[int, int]]:
    model = str(sheet.values.get("model_type", "PINHOLE")).upper()
    projection = Sheet(path=sheet.path, values=_map(sheet, "projection_parameters"), part="projection_parameters")
    size = int(sheet.numbers("image_width", 1)[0]), int(sheet.numbers("image_height", 1)[0])
    if model == "PINHOLE":
        values = tuple(projection.numbers(key, 1)[0] for key in ("fx", "fy", "cx", "cy"))
        distortion = _map(sheet, "distortion_parameters")
        bent = Sheet(path=sheet.path, values=distortion, part="distortion_parameters")
        coefficients = [bent.numbers(key, 1)[0] for key in ("k1", "k2", "p1", "p2")] if distortion else []
        return _convert_to_colmap(sheet, "plumb_bob", values, coefficients, size)
    if model == "KANNALA_BRANDT":
        values = tuple(projection.numbers(key, 1)[0] for key in ("mu", "mv", "u0", "v0"))
        return _convert_to_colmap(
            sheet, "equidistant", values, [projection.numbers(f"k{i}", 1)[0] for i in (2, 3, 4, 5)], size
        )
    raise sheet.fault(
        Fact("value-not-known", key="model_type", found=repr(model)[:200], known=("PINHOLE", "KANNALA_BRANDT"))
    )


def _map(sheet: Sheet, key: str) -> dict[str, Any]:
    value = sheet.values.get(key)
    return value if isinstance(value, dict) else {}


def _orb_slam(sheet: Sheet, before: str) -> tuple[str, tuple[float, ...], tuple[int, int]]:
    values = tuple(sheet.numbers(f"{before}{key}", 1)[0] for key in ("fx", "fy", "cx", "cy"))
    kind = str(sheet.values.get("Camera.type", "PinHole"))
    names = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3")
    coefficients = [
        sheet.numbers(f"{before}{name}", 1)[0] if f"{before}{name}" in sheet.values else 0.0 for name in names
    ]
    size = int(sheet.numbers("Camera.width", 1)[0]), int(sheet.numbers("Camera.height", 1)[0])
    return _convert_to_colmap(
        sheet, "equidistant" if kind == "KannalaBrandt8" else "plumb_bob", values, coefficients, size
    )


def _convert_to_colmap(
    sheet: Sheet, model: str, values: Sequence[float], coefficients: Sequence[float], size: tuple[int, int]
) -> tuple[str, tuple[float, ...], tuple[int, int]]:
    """COLMAP's model and parameters of OpenCV's, whose pixels count from the centre of the first."""
    fx, fy, cx, cy = values
    centre = colmap_px_from_opencv(np.array([cx, cy])).tolist()
    if model in _EQUIDISTANT:
        return "OPENCV_FISHEYE", (fx, fy, *centre, *([*coefficients, *[0.0] * 4][:4])), size
    if model not in (*_PLUMB_BOB, *_RATIONAL):
        raise sheet.fault(
            Fact(
                "value-not-known",
                key="distortion_model",
                found=repr(model)[:200],
                known=("plumb_bob", "rational_polynomial", "equidistant"),
            )
        )
    if any(coefficients[8:]):
        raise sheet.fault(Fact("lens-model-unknown-to-colmap"))
    bent = [*coefficients, *[0.0] * 8][:8]
    full = any(bent[4:])
    return "FULL_OPENCV" if full else "OPENCV", (fx, fy, *centre, *bent[: 8 if full else 4]), size
