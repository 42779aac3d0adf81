"""A COLMAP model of pinhole cameras: cameras, names and keypoints change, poses and points stay to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.export.undistort import Undistortion

if TYPE_CHECKING:
    import pycolmap


def pinhole_model(
    model: pycolmap.Reconstruction, cameras: Mapping[int, Undistortion], names: Mapping[str, str]
) -> pycolmap.Reconstruction:
    """The model with its pictures undistorted.

    Observations move along with the pictures; those beyond an edge of the new picture, and keypoints that see no point,
    are left out. All points stay, also those that lose observations.

    Parameters
    ----------
    model
        As COLMAP made it; not changed.
    cameras
        What takes the place of each camera, by its number.
    names
        The new name of each registered image.
    """
    import pycolmap

    made = pycolmap.Reconstruction()
    for camera_id, undistortion in cameras.items():
        made.add_camera(colmap_camera(undistortion.pinhole, camera_id))
    for rig_id in _rigs(model):
        made.add_rig(model.rig(rig_id))
    registered = set(model.reg_image_ids())
    frames = {model.image(i).frame_id for i in registered}
    for frame_id in sorted(frames):
        frame = model.frame(frame_id)
        copy = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id, rig_from_world=frame.rig_from_world)
        for data_id in frame.data_ids:
            copy.add_data_id(data_id)
        made.add_frame(copy)
    tracks: dict[int, pycolmap.Track] = {point_id: pycolmap.Track() for point_id in model.points3D}
    for image_id in sorted(registered):
        image = model.image(image_id)
        kept = _observations(image, cameras[image.camera_id])
        made.add_image(
            pycolmap.Image(
                name=names[image.name],
                points2D=[pycolmap.Point2D(xy) for xy, _ in kept],
                camera_id=image.camera_id,
                image_id=image_id,
                frame_id=image.frame_id,
            )
        )
        for index, (_, point_id) in enumerate(kept):
            tracks[point_id].add_element(image_id, index)
    for point_id, track in tracks.items():
        point = model.points3D[point_id]
        made.add_point3D_with_id(
            point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
        )
    for frame_id in sorted(frames):
        made.register_frame(frame_id)
    return made


def needed_cameras(model: pycolmap.Reconstruction) -> list[int]:
    """Numbers of the cameras that registered images have, and of those on the same rigs."""
    import pycolmap

    sensors = [model.camera(model.image(i).camera_id).sensor_id for i in model.reg_image_ids()]
    for rig_id in _rigs(model):
        rig = model.rig(rig_id)
        sensors += [rig.ref_sensor_id, *rig.non_ref_sensors]
    return sorted({int(sensor.id) for sensor in sensors if sensor.type == pycolmap.SensorType.CAMERA})


def _rigs(model: pycolmap.Reconstruction) -> list[int]:
    return sorted({int(model.frame(model.image(i).frame_id).rig_id) for i in model.reg_image_ids()})


def _observations(image: pycolmap.Image, undistortion: Undistortion) -> list[tuple[np.ndarray, int]]:
    """Where an image sees points after undistortion, and which."""
    seen = [point for point in image.points2D if point.has_point3D()]
    if not seen:
        return []
    moved = undistortion.moved_px(np.array([point.xy for point in seen]))
    size = [undistortion.pinhole.width, undistortion.pinhole.height]
    inside = np.flatnonzero(((moved >= 0) & (moved <= size)).all(axis=1))  # not where one of them is nan
    return [(moved[i], seen[i].point3D_id) for i in inside]
