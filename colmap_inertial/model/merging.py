"""Several COLMAP models in one world as one model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

#: Keypoints at the same place are the same (px).
_SAME_PX = 1e-3


def merged(
    models: Sequence[pycolmap.Reconstruction], agreeing: Mapping[tuple[int, int], Collection[str]]
) -> pycolmap.Reconstruction:
    """One model of all images and points; the first one's stay as they are.

    Images that several have keep the pose of the first one that has them, and of two observations of one keypoint the
    first; where the poses differ, the first one's observations are all that is kept. Numbers of images and frames stay
    where they are free, as they are in models of one database; points get new ones. Cameras of one number whose
    parameters differ, as each model refined its own, stay apart.

    Parameters
    ----------
    models
        In one world already; one camera to a frame.
    agreeing
        By places of two models, the earlier one first: names of images whose poses in both agree.
    """
    import pycolmap

    whole = pycolmap.Reconstruction(models[0])
    whole.tear_down()  # images that have no pose, as a mapper leaves them, would keep their numbers
    owner = dict.fromkeys(_names(models[0]), 0)
    for k, model in enumerate(models[1:], start=1):
        names = _names(model)
        _add(whole, model, {name for name in names if name in agreeing.get((owner.get(name, k), k), ())})
        owner = dict.fromkeys(names, k) | owner
    whole.update_point_3d_errors()
    return whole


def _names(model: pycolmap.Reconstruction) -> list[str]:
    return [model.image(i).name for i in model.reg_image_ids()]


def _add(whole: pycolmap.Reconstruction, model: pycolmap.Reconstruction, agreeing: Collection[str]) -> None:
    """Add images that are not there yet, and points; of images that are, only observations of those that agree."""
    import pycolmap

    by_name = {whole.image(i).name: i for i in whole.reg_image_ids()}
    camera_of = {i: _camera(whole, model.camera(i)) for i in sorted(model.cameras)}
    number: dict[int, int] = {}
    kept: dict[int, set[int]] = {}
    for old in sorted(model.reg_image_ids()):
        image = model.image(old)
        if image.name in by_name:
            number[old] = by_name[image.name]
            there = whole.image(number[old])
            kept[old] = _free_keypoints(there, image) if image.name in agreeing else set()
        else:
            number[old] = _add_image(whole, image, camera_of[image.camera_id])
    for point_id in sorted(model.point3D_ids()):
        point = model.points3D[point_id]
        track = pycolmap.Track()
        seen = [e for e in point.track.elements if e.image_id in number]
        seen = [e for e in seen if e.image_id not in kept or e.point2D_idx in kept[e.image_id]]
        if len({number[e.image_id] for e in seen}) < 2:
            continue
        for element in seen:
            track.add_element(number[element.image_id], element.point2D_idx)
        whole.add_point3D(point.xyz, track, point.color)


def _camera(whole: pycolmap.Reconstruction, camera: pycolmap.Camera) -> int:
    """The number that a camera has in the whole; a new one where it is not there yet."""
    import pycolmap

    def same(one: pycolmap.Camera) -> bool:
        sizes = (one.model, one.width, one.height) == (camera.model, camera.width, camera.height)
        return sizes and np.array_equal(one.params, camera.params)

    cameras = whole.cameras
    first = [i for i in (camera.camera_id, *sorted(cameras)) if i in cameras and same(cameras[i])]
    if first:
        return int(first[0])
    taken = camera.camera_id in cameras or whole.exists_rig(camera.camera_id)
    new = pycolmap.Camera(
        camera_id=max(*cameras, *whole.rigs) + 1 if taken else camera.camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.params,
        has_prior_focal_length=camera.has_prior_focal_length,
    )
    whole.add_camera_with_trivial_rig(new)
    return int(new.camera_id)


def _add_image(whole: pycolmap.Reconstruction, image: pycolmap.Image, camera_id: int) -> int:
    """Add an image with its keypoints and pose; its number there."""
    import pycolmap

    free = image.image_id not in whole.images
    image_id = image.image_id if free else max(whole.images) + 1
    frame_id = image.frame_id if image.frame_id not in whole.frames else max(whole.frames) + 1
    rig_id = next(i for i, rig in sorted(whole.rigs.items()) if rig.ref_sensor_id.id == camera_id)
    keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
    new = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=camera_id, image_id=image_id)
    new.frame_id = frame_id
    frame = pycolmap.Frame()
    frame.frame_id, frame.rig_id = frame_id, rig_id
    frame.add_data_id(new.data_id)
    whole.add_frame(frame)
    whole.add_image(new)
    whole.frame(frame_id).set_cam_from_world(camera_id, image.cam_from_world())
    whole.register_frame(frame_id)
    return int(image_id)


def _free_keypoints(there: pycolmap.Image, here: pycolmap.Image) -> set[int]:
    """Keypoints of an image of two models that see no point in the first one, and are the same in both."""
    if len(there.points2D) != len(here.points2D):
        return set()
    pairs = enumerate(zip(there.points2D, here.points2D, strict=True))
    return {i for i, (a, b) in pairs if not a.has_point3D() and float(np.abs(a.xy - b.xy).max()) < _SAME_PX}
