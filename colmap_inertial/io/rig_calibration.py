"""Calibrations of cameras that are mounted together, in the formats that people have."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv, matrix_from_quat
from colmap_inertial.core.types import LengthUnit
from colmap_inertial.io.device_yaml import read_tagged_yaml
from colmap_inertial.io.files import read_bytes, read_json_value, reader
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS, Sheet, is_rotation

Metres = Literal["m", "mm"]


@dataclass(frozen=True, eq=False, kw_only=True)
class MountedCamera:
    """One camera of a calibration.

    Attributes
    ----------
    model, params
        In COLMAP's terms.
    size
        Width and height; ``None`` where the calibration does not say, and the images do.
    cam_from_rig
        (4, 4).
    """

    model: str
    params: tuple[float, ...]
    size: tuple[int, int] | None
    cam_from_rig: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class RigCalibration:
    """Cameras by the names that the calibration gives them."""

    path: Path
    cameras: Mapping[str, MountedCamera]
    length_unit: LengthUnit

    def camera(self, name: str) -> MountedCamera:
        """One of them; a :class:`FormatError` that lists them where there is none of that name."""
        if name not in self.cameras:
            raise FormatError(self.path, Fact("camera-not-calibrated", name=name, cameras=tuple(self.cameras)))
        return self.cameras[name]


@reader("a calibration of cameras")
def read_rig_calibration(path: Path, *, unit: Metres | None = None) -> RigCalibration:
    """Read a calibration; the format is found by content.

    Parameters
    ----------
    path
        One of these:

        - Kalibr's ``camchain.yaml``: cameras ``cam0``, ``cam1`` ...; metres.
        - OpenCV's YAML (FileStorage): a map for each camera, by its name, with ``camera_matrix``,
          ``distortion_coefficients``, ``image_width``, ``image_height`` as OpenCV's calibration sample writes them,
          and ``R``, ``T`` of x_camera = R x_rig + T (left out for the one that is the rig's frame); or the stereo
          sample's ``M1``, ``D1``, ``M2``, ``D2``, ``R``, ``T`` for cameras ``1`` and ``2``.
        - COLMAP's ``rig_config.json`` with camera models: cameras by ``image_prefix`` without the slash at its end.
        - The folder of a COLMAP model (``rigs.bin``, ``cameras.bin``) with one rig: cameras by their numbers.
    unit
        Of OpenCV's ``T``, where it is not metres; of COLMAP's lengths, which otherwise have none.

    Raises
    ------
    FormatError
        For what is none of these, or lacks something; the message says what.
    """
    path = Path(path)
    if path.is_dir():
        return _read_model(path, unit)
    if path.suffix.lower() == ".json":
        return _read_rig_config(path, unit)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise FormatError(path, Fact("no-rig-calibration"))
    sheet = read_tagged_yaml(path)
    if all(isinstance(entry, dict) and "intrinsics" in entry for entry in sheet.values()) and sheet:
        if unit not in (None, "m"):
            raise FormatError(path, Fact("kalibr-in-metres"))
        return RigCalibration(path=path, cameras=_kalibr(path, sheet), length_unit="m")
    return RigCalibration(path=path, cameras=_opencv(path, sheet, 1e-3 if unit == "mm" else 1.0), length_unit="m")


# --- Kalibr and OpenCV ----------------------------------------------------------------------------------------------


def _kalibr(path: Path, sheet: dict[str, Any]) -> dict[str, MountedCamera]:
    cameras: dict[str, MountedCamera] = {}
    cam_from_rig = np.eye(4)
    for index, name in enumerate(sorted(sheet, key=lambda n: (len(n), n))):
        entry = Sheet(path=path, values=sheet[name], part=name)
        model, params, size = entry.pinhole("distortion_coeffs")
        if index > 0:
            if "T_cn_cnm1" not in entry.values:
                raise entry.fault(Fact("kalibr-pose-missing"))
            cam_from_rig = entry.pose("T_cn_cnm1", "T_cn_cnm1") @ cam_from_rig
        cameras[name] = MountedCamera(model=model, params=params, size=size, cam_from_rig=cam_from_rig)
    return cameras


def _opencv(path: Path, sheet: dict[str, Any], metres: float) -> dict[str, MountedCamera]:
    if "M1" in sheet and "M2" in sheet:
        sheet = _stereo_pair(path, sheet)
    cameras = {
        name: _opencv_camera(Sheet(path=path, values=entry, part=name), metres)
        for name, entry in sheet.items()
        if isinstance(entry, dict) and "camera_matrix" in entry
    }
    if not cameras:
        raise FormatError(path, Fact("calibration-without-cameras"))
    return cameras


def _stereo_pair(path: Path, sheet: dict[str, Any]) -> dict[str, Any]:
    """Output of OpenCV's stereo sample, as a map for each of the cameras ``1`` and ``2``."""
    if not {"R", "T"} <= sheet.keys():
        raise FormatError(path, Fact("pose-of-second-camera-missing"))
    shared = {key: sheet[key] for key in ("image_width", "image_height") if key in sheet}
    pair = {
        name: {"camera_matrix": sheet[f"M{name}"], "distortion_coefficients": sheet.get(f"D{name}"), **shared}
        for name in ("1", "2")
    }
    pair["2"] |= {"R": sheet["R"], "T": sheet["T"]}
    return pair


def _opencv_camera(given: Sheet, metres: float) -> MountedCamera:
    matrix = np.array(given.numbers("camera_matrix", 9)).reshape(3, 3)
    key = "distortion_coefficients"
    coefficients = [] if given.values.get(key) is None else given.numbers(key)
    if any(coefficients[8:]):
        raise given.fault(Fact("lens-model-unknown-to-colmap"))
    coefficients = [*coefficients, *[0.0] * 8][:8]
    full = any(coefficients[4:])
    size = None
    if {"image_width", "image_height"} <= given.values.keys():
        size = int(given.numbers("image_width", 1)[0]), int(given.numbers("image_height", 1)[0])
    pose = np.eye(4)
    if ("R" in given.values) != ("T" in given.values):
        raise given.fault(Fact("rotation-without-translation"))
    if "R" in given.values:
        pose[:3, :3] = np.array(given.numbers("R", 9)).reshape(3, 3)
        pose[:3, 3] = metres * np.array(given.numbers("T", 3))
        if not is_rotation(pose[:3, :3]):
            raise given.fault(Fact("no-rotation", what="R"))
    centre = colmap_px_from_opencv(matrix[:2, 2]).tolist()
    return MountedCamera(
        model="FULL_OPENCV" if full else "OPENCV",
        params=(matrix[0, 0], matrix[1, 1], *centre, *coefficients[: 8 if full else 4]),
        size=size,
        cam_from_rig=pose,
    )


# --- COLMAP ---------------------------------------------------------------------------------------------------------


def _read_rig_config(path: Path, unit: Metres | None) -> RigCalibration:
    rigs = read_json_value(path)
    if not (isinstance(rigs, list) and rigs and all(isinstance(rig, dict) for rig in rigs)):
        raise FormatError(path, Fact("not-a-rig-config"))
    if len(rigs) > 1:
        raise FormatError(path, Fact("several-rigs-described", count=len(rigs)))
    cameras = {}
    for entry in rigs[0].get("cameras", []):
        name = str(entry.get("image_prefix", "")).rstrip("/")
        given = Sheet(path=path, values=entry, part=name)
        model = entry.get("camera_model_name")
        if model is None or "camera_params" not in entry:
            raise given.fault(Fact("camera-model-missing"))
        if model not in CAMERA_MODELS:
            raise given.fault(Fact("camera-model-unknown", model=repr(model)))
        pose = np.eye(4)
        if not entry.get("ref_sensor", False):
            quaternion = given.numbers("cam_from_rig_rotation", 4)  # w first, as COLMAP's files have it
            if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
                raise given.fault(Fact("cam-from-rig-not-a-quaternion"))
            pose[:3, :3] = matrix_from_quat(np.roll(quaternion, -1))
            pose[:3, 3] = _scale(unit) * np.array(given.numbers("cam_from_rig_translation", 3))
        params = tuple(given.numbers("camera_params", CAMERA_MODELS[model][0]))
        cameras[name] = MountedCamera(model=model, params=params, size=None, cam_from_rig=pose)
    return RigCalibration(path=path, cameras=cameras, length_unit="model" if unit is None else "m")


def _read_model(path: Path, unit: Metres | None) -> RigCalibration:
    """``rigs.bin`` and ``cameras.bin`` (COLMAP's scene/reconstruction_io): little-endian records after a count."""
    rigs, sheets = path / "rigs.bin", path / "cameras.bin"
    for file in (rigs, sheets):
        if not file.is_file():
            raise FormatError(file, Fact("rig-file-missing"))
    models = list(CAMERA_MODELS)

    def read_cameras(take: Callable[[str], tuple[Any, ...]]) -> dict[int, tuple[str, tuple[int, int], Any]]:
        poses_of = {}
        for _ in range(take("<Q")[0]):
            number, model, width, height = take("<IiQQ")
            if not 0 <= model < len(models):
                raise FormatError(sheets, Fact("camera-model-unknown", model=str(model)))
            poses_of[number] = models[model], (width, height), take(f"<{CAMERA_MODELS[models[model]][0]}d")
        return poses_of

    def read_rigs(take: Callable[[str], tuple[Any, ...]]) -> list[dict[int, Array]]:
        poses_of = []
        for _ in range(take("<Q")[0]):
            _, count = take("<II")
            poses = {}
            for i in range(count):
                kind, number = take("<iI")
                pose = np.eye(4)
                if i > 0:
                    if not take("<B")[0]:
                        raise FormatError(rigs, Fact("camera-without-pose-in-rig", camera=number))
                    w, x, y, z, *translation = take("<7d")
                    pose[:3, :3] = matrix_from_quat(np.array([x, y, z, w]))
                    pose[:3, 3] = _scale(unit) * np.array(translation)
                if kind == 0:
                    poses[number] = pose
            poses_of.append(poses)
        return poses_of

    cameras = _records(sheets, read_cameras)
    poses_of = [poses for poses in _records(rigs, read_rigs) if len(poses) > 1]
    if len(poses_of) != 1:
        raise FormatError(rigs, Fact("not-one-rig", count=len(poses_of)))
    mounted = {}
    for number, pose in poses_of[0].items():
        if number not in cameras:
            raise FormatError(sheets, Fact("camera-of-rig-missing", camera=number))
        model, size, params = cameras[number]
        mounted[str(number)] = MountedCamera(model=model, params=tuple(params), size=size, cam_from_rig=pose)
    return RigCalibration(path=path, cameras=mounted, length_unit="model" if unit is None else "m")


def _records(path: Path, read: Callable[[Callable[[str], tuple[Any, ...]]], Any]) -> Any:
    data, at = read_bytes(path), 0

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal at
        values = struct.unpack_from(layout, data, at)
        at += struct.calcsize(layout)
        return values

    try:
        return read(take)
    except struct.error:
        raise FormatError(path, Fact("truncated")) from None


def _scale(unit: Metres | None) -> float:
    return 1e-3 if unit == "mm" else 1.0
