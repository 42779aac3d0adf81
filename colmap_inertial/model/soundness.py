"""Checks of a COLMAP model: binary files are complete, and numbers are possible for cameras, poses and points.

COLMAP's reader trusts every count: a damaged one makes it run for hours, ask for all memory, or go on with rubbish. So
the records are counted here first, which takes a fraction of the time of reading them.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS

if TYPE_CHECKING:
    import pycolmap


#: Number of parameters of COLMAP's camera models, by id; the last one is EQUIRECTANGULAR, which no capture has.
_CAMERA_PARAMETERS = (*(count for count, _ in CAMERA_MODELS.values()), 2)
#: No camera, pose or point has a number as large as this.
LARGEST = 1e12
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_POINT = struct.Struct("<Qddd11xQ")


class _Damaged(Exception):
    pass


def check_binary_model(folder: Path) -> None:
    """Compare every file's size with the records that it says it has.

    Raises
    ------
    FormatError
        Naming the file that is truncated or damaged.
    """
    for name, walk in _WALKS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        size = path.stat().st_size
        if size < _U64.size:
            raise FormatError(path, "truncated")
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                count = _U64.unpack_from(data)[0]
                if count > size:
                    raise _Damaged(f"it claims {count} records")
                end = walk(data, count)
            except (struct.error, IndexError, OverflowError):
                raise FormatError(path, "truncated") from None
            except _Damaged as error:
                raise FormatError(path, f"damaged: {error}") from None
        if end > size:
            raise FormatError(path, "truncated")
        if end < size:
            raise FormatError(path, f"damaged: {size - end} bytes follow the last record")


def _cameras(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        _, model, width, height = _CAMERA.unpack_from(data, at)
        if not 0 <= model < len(_CAMERA_PARAMETERS):
            raise _Damaged(f"camera model {model} is unknown")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise _Damaged(f"a camera of {width} x {height} pixels")
        at += 24 + 8 * _CAMERA_PARAMETERS[model]
    return at


def _images(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise IndexError
        at = end + 9 + 24 * _U64.unpack_from(data, end + 1)[0]
    return at


def _points(data: mmap.mmap, count: int) -> int:
    at, read = 8, _POINT.unpack_from
    for _ in range(count):
        number, x, y, z, length = read(data, at)
        if not (abs(x) < LARGEST and abs(y) < LARGEST and abs(z) < LARGEST):
            raise _Damaged(f"point {number} lies at {x:g}, {y:g}, {z:g}")
        at += 51 + 8 * length
    return at


def _rigs(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        sensors = _U32.unpack_from(data, at + 4)[0]
        at += 8
        if sensors:
            at += 8
        for _ in range(sensors - 1 if sensors else 0):
            at += 9 + 56 * (data[at + 8] != 0)
    return at


def _frames(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        at += 68 + 16 * _U32.unpack_from(data, at + 64)[0]
    return at


_WALKS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}


#: A focal length below it sees no image, pixels.
_LEAST_FOCAL_PX = 1e-3


def check_values(reconstruction: pycolmap.Reconstruction, folder: Path, suffix: str) -> None:
    """Refuse a model with cameras, poses or points that cannot be: COLMAP reads any number.

    Parameters
    ----------
    reconstruction
        As COLMAP read it.
    folder, suffix
        Where from, for the message; of a binary model, :func:`check_binary_model` has looked at the points.

    Raises
    ------
    FormatError
        Naming the camera, image, rig or point.
    """
    for camera_id, camera in reconstruction.cameras.items():
        path, params = folder / f"cameras{suffix}", np.asarray(camera.params, dtype=np.float64)
        if not (0 < camera.width < 2**31 and 0 < camera.height < 2**31):
            raise FormatError(path, f"camera {camera_id} has {camera.width} x {camera.height} pixels")
        focal = params[list(camera.focal_length_idxs())]
        if not _sane(params) or (focal < _LEAST_FOCAL_PX).any():
            raise FormatError(
                path, f"camera {camera_id} ({camera.model.name}) cannot be: {camera.params_info} = {_listed(params)}"
            )
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        pose = image.cam_from_world()
        numbers = np.concatenate([pose.rotation.quat, pose.translation])
        if not _sane(numbers) or not np.linalg.norm(pose.rotation.quat) > 0.5:
            raise FormatError(folder / f"images{suffix}", f"the pose of {image.name!r} cannot be: {_listed(numbers)}")
    for rig_id, rig in reconstruction.rigs.items():
        for sensor, mounted in rig.non_ref_sensors.items():
            if mounted is not None and not _sane(np.concatenate([mounted.rotation.quat, mounted.translation])):
                raise FormatError(folder / f"rigs{suffix}", f"rig {rig_id}: the pose of sensor {sensor.id} cannot be")
    if suffix == ".txt":
        for point_id, point in reconstruction.points3D.items():
            if not _sane(point.xyz):
                raise FormatError(folder / "points3D.txt", f"point {point_id} lies at {_listed(point.xyz)}")


def _sane(numbers: Array) -> bool:
    return bool((np.abs(numbers) < LARGEST).all())  # not where one of them is NaN


def _listed(numbers: Array) -> str:
    return ", ".join(f"{number:g}" for number in numbers.tolist())
