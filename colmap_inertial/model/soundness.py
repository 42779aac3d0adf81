"""Whether the numbers of a COLMAP model can be those of cameras and points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.model.binary import LARGEST

if TYPE_CHECKING:
    import pycolmap

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
