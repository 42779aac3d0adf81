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
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS
from colmap_inertial.io.stand_ins import refuse_stand_in
from colmap_inertial.model.lenses import farthest_corner_px, find_fold, sees_all_around
from colmap_inertial.model.notes import take_note

if TYPE_CHECKING:
    import pycolmap


#: Number of parameters of COLMAP's camera models, by id; the last one is EQUIRECTANGULAR, which no capture has.
NUM_PARAMETERS = (*(count for count, _ in CAMERA_MODELS.values()), 2)
#: No camera, pose or point has a number as large as this.
LARGEST = 1e12
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_POINT = struct.Struct("<Qddd11xQ")


class _Damaged(Exception):
    def __init__(self, why: Fact) -> None:
        super().__init__(str(why))
        self.why = why


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
        refuse_stand_in(path)
        if size < _U64.size:
            raise FormatError(path, Fact("truncated"))
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                count = _U64.unpack_from(data)[0]
                if count > size:
                    raise _Damaged(Fact("records-claimed", count=count))
                end = walk(data, count)
            except (struct.error, IndexError, OverflowError):
                raise FormatError(path, Fact("truncated")) from None
            except _Damaged as error:
                raise FormatError(path, Fact("damaged-model-file", why=error.why)) from None
        if end > size:
            raise FormatError(path, Fact("truncated"))
        if end < size:
            raise FormatError(path, Fact("bytes-after-last-record", count=size - end))


def _cameras(data: mmap.mmap, count: int) -> int:
    at = 8
    for _ in range(count):
        _, model, width, height = _CAMERA.unpack_from(data, at)
        if not 0 <= model < len(NUM_PARAMETERS):
            raise _Damaged(Fact("camera-model-unknown", model=str(model)))
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise _Damaged(Fact("camera-without-pixels", width=width, height=height))
        at += 24 + 8 * NUM_PARAMETERS[model]
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
            raise _Damaged(Fact("point-impossible", point=number, xyz=(x, y, z)))
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
            raise FormatError(
                path, Fact("camera-size-impossible", camera=camera_id, width=camera.width, height=camera.height)
            )
        focal = params[list(camera.focal_length_idxs())]
        if not _sane(params) or (focal < _LEAST_FOCAL_PX).any():
            raise FormatError(
                path,
                Fact(
                    "camera-impossible",
                    camera=camera_id,
                    model=camera.model.name,
                    names=camera.params_info,
                    params=tuple(params.tolist()),
                ),
            )
        _note_odd_lens(camera, path)
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        pose = image.cam_from_world()
        numbers = np.concatenate([pose.rotation.quat, pose.translation])
        if not _sane(numbers) or not np.linalg.norm(pose.rotation.quat) > 0.5:
            raise FormatError(
                folder / f"images{suffix}", Fact("pose-impossible", image=image.name, numbers=tuple(numbers.tolist()))
            )
    for rig_id, rig in reconstruction.rigs.items():
        for sensor, mounted in rig.non_ref_sensors.items():
            if mounted is not None and not _sane(np.concatenate([mounted.rotation.quat, mounted.translation])):
                raise FormatError(folder / f"rigs{suffix}", Fact("rig-pose-impossible", rig=rig_id, sensor=sensor.id))
    if suffix == ".txt":
        for point_id, point in reconstruction.points3D.items():
            if not _sane(point.xyz):
                raise FormatError(
                    folder / "points3D.txt", Fact("point-impossible", point=point_id, xyz=tuple(point.xyz.tolist()))
                )


def _note_odd_lens(camera: pycolmap.Camera, path: Path) -> None:
    """Tell of a lens that folds within its images, and of a principal point outside of them."""
    if sees_all_around(camera):
        return
    named = {"camera": int(camera.camera_id)}
    cx, cy = float(camera.principal_point_x), float(camera.principal_point_y)
    if not (0 <= cx <= camera.width and 0 <= cy <= camera.height):
        fact = Fact("odd-principal-point", **named, width=int(camera.width), height=int(camera.height), cx=cx, cy=cy)
        take_note(path, fact)
        return
    fold, corner_px = find_fold(camera), farthest_corner_px(camera)
    if fold is not None and fold.radius_px < corner_px:
        values = {"radius_px": fold.radius_px, "corner_px": corner_px}
        take_note(path, Fact("folded-lens", **named, model=camera.model.name, **values))


#: Key points farther from where their points are seen do not see these, pixels (median).
_SAME_POINT_PX = 8.0


def add_tracks(reconstruction: pycolmap.Reconstruction, observations: NDArray[np.int64], path: Path) -> None:
    """Give points that name no images the key points that name them, where these see them.

    Parameters
    ----------
    reconstruction
        Is changed.
    observations
        (N, 3) image, key point and point.
    path
        Of the points, for the note.
    """
    import pycolmap

    if not len(observations):
        return
    errors = []
    for image_id in np.unique(observations[:, 0]).tolist():
        rows = observations[observations[:, 0] == image_id]
        image = reconstruction.image(image_id)
        if not image.has_pose:
            continue
        world = np.array([reconstruction.point3D(number).xyz for number in rows[:, 2].tolist()])
        pose = image.cam_from_world()
        cam = world @ pose.rotation.matrix().T + pose.translation
        seen = np.asarray(reconstruction.camera(image.camera_id).img_from_cam(cam), dtype=np.float64)
        where = np.array([image.point2D(index).xy for index in rows[:, 1].tolist()])
        errors.append(np.linalg.norm(seen - where, axis=1))
    found = np.concatenate(errors) if errors else np.empty(0)
    if not len(found) or not np.nanmedian(np.where(np.isfinite(found), found, np.inf)) <= _SAME_POINT_PX:
        take_note(path, Fact("lost-points", count=len(observations), points=len(np.unique(observations[:, 2]))))
        return
    for image_id, index, point in observations.tolist():
        reconstruction.add_observation(point, pycolmap.TrackElement(image_id, index))
    take_note(path, Fact("tracks-from-images", count=len(observations)))


def _sane(numbers: Array) -> bool:
    return bool((np.abs(numbers) < LARGEST).all())  # not where one of them is NaN
