"""Several COLMAP models in one world as one model, and points of them that are one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.model.submodels.graph import Pair

if TYPE_CHECKING:
    import pycolmap

#: Keypoints at the same place are the same (px).
SAME_KEYPOINT_PX = 1e-3


def merge_models(
    models: Sequence[pycolmap.Reconstruction],
    *,
    agreeing: Mapping[Pair, Collection[str]] | None = None,
    owner: Mapping[str, int] | None = None,
) -> tuple[pycolmap.Reconstruction, list[dict[int, int]]]:
    """Merge models into one of all images and points.

    Images that several have keep the pose of their owner, and of two observations of one keypoint the owner's; where
    the poses differ, the owner's observations are all that is kept. Numbers of images and frames stay where they are
    free, as they are in models of one database. Cameras of one number whose parameters differ, as each model refined
    its own, stay apart.

    Parameters
    ----------
    models
        In one world already; one camera to a frame.
    agreeing
        By places of two models, the owner first: names of images whose poses in both agree.
    owner
        By name of an image, the place of the model whose pose it keeps; the first one that has it where none is given.

    Returns
    -------
    whole
        The merged model.
    points
        By models: numbers of their points, and these points' numbers in the merged model.
    """
    import pycolmap

    agreeing, owner, whole = agreeing or {}, dict(owner or {}), pycolmap.Reconstruction()
    for k, model in enumerate(models):
        owner = {model.image(i).name: k for i in model.reg_image_ids()} | owner
    number: list[dict[int, int]] = []
    for k, model in enumerate(models):
        own = [i for i in sorted(model.reg_image_ids()) if owner[model.image(i).name] == k]
        camera_of = {i: _add_camera(whole, model, i) for i in sorted({model.image(i).camera_id for i in own})}
        number.append({i: _add_image(whole, model.image(i), camera_of[model.image(i).camera_id]) for i in own})
    by_name = {whole.image(i).name: i for i in whole.reg_image_ids()}
    points = []
    for k, model in enumerate(models):
        kept: dict[int, set[int]] = {}
        for i in set(model.reg_image_ids()) - number[k].keys():
            image = model.image(i)
            if image.name in agreeing.get((owner[image.name], k), ()):
                number[k][i] = by_name[image.name]
                kept[i] = _free_keypoints(whole.image(number[k][i]), image)
        points.append(_add_points(whole, model, number[k], kept))
    whole.update_point_3d_errors()
    return whole, points


def _add_points(
    whole: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    number: Mapping[int, int],
    kept: Mapping[int, set[int]],
) -> dict[int, int]:
    """Add a model's points as far as images see them; of images that are another's, by the keypoints that are kept."""
    import pycolmap

    out = {}
    for point_id, point in sorted(model.points3D.items()):
        seen = [e for e in point.track.elements if e.image_id in number]
        seen = [e for e in seen if e.image_id not in kept or e.point2D_idx in kept[e.image_id]]
        if len({number[e.image_id] for e in seen}) > 1:
            track = pycolmap.Track([pycolmap.TrackElement(number[e.image_id], e.point2D_idx) for e in seen])
            out[point_id] = whole.add_point3D(point.xyz, track, point.color)
    return out


def _add_camera(whole: pycolmap.Reconstruction, model: pycolmap.Reconstruction, number: int) -> int:
    """The number that a model's camera has in the whole; a new one where it is not there yet."""
    import pycolmap

    camera, cameras = model.camera(number), whole.cameras

    def same(candidate: pycolmap.Camera) -> bool:
        sizes = (candidate.model, candidate.width, candidate.height) == (camera.model, camera.width, camera.height)
        return sizes and np.array_equal(candidate.params, camera.params)

    first = [i for i in (number, *sorted(cameras)) if i in cameras and same(cameras[i])]
    if first and number in cameras:
        return int(first[0])
    rig_id = next(i for i, rig in sorted(model.rigs.items()) if rig.ref_sensor_id.id == number)
    new = pycolmap.Camera(camera.todict() | {"camera_id": max(cameras) + 1 if number in cameras else number})
    whole.add_camera(new)
    rig = pycolmap.Rig(rig_id=max(whole.rigs) + 1 if rig_id in whole.rigs else rig_id)
    rig.add_ref_sensor(new.sensor_id)
    whole.add_rig(rig)
    return int(new.camera_id)


def _add_image(whole: pycolmap.Reconstruction, image: pycolmap.Image, camera_id: int) -> int:
    """Add an image with its keypoints and pose; its number there."""
    import pycolmap

    image_id, frame_id = (
        max(taken) + 1 if number in taken else number
        for number, taken in ((image.image_id, whole.images), (image.frame_id, whole.frames))
    )
    keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
    new = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=camera_id, image_id=image_id)
    new.frame_id = frame_id
    rig_id = next(i for i, rig in sorted(whole.rigs.items()) if rig.ref_sensor_id.id == camera_id)
    frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_id)
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
    return {i for i, (a, b) in pairs if not a.has_point3D() and float(np.abs(a.xy - b.xy).max()) < SAME_KEYPOINT_PX}


def merge_points(
    whole: pycolmap.Reconstruction, pairs: Iterable[tuple[int, int]], *, within_px: float | None = None
) -> int:
    """Merge pairs of points that matches say are one, unless an image sees both; how many were.

    Parameters
    ----------
    whole
        Changed.
    pairs
        Numbers of points, as they were before any was merged.
    within_px
        Merge only where every image then still sees the point where it did, to so many pixels.
    """
    latest: dict[int, int] = {}
    count = 0
    for pair in pairs:
        first, second = pair
        # a merged point never has the number of an old one
        while first in latest:
            first = latest[first]
        while second in latest:
            second = latest[second]
        if first == second or not _can_be_one(whole, first, second, within_px):
            continue
        latest[first] = latest[second] = int(whole.merge_points3D(first, second))
        count += 1
    return count


def _can_be_one(whole: pycolmap.Reconstruction, first: int, second: int, within_px: float | None) -> bool:
    points = [whole.point3D(number) for number in (first, second)]
    tracks = [point.track.elements for point in points]
    if {e.image_id for e in tracks[0]} & {e.image_id for e in tracks[1]}:
        return False
    if within_px is None:
        return True
    middle = np.average([point.xyz for point in points], axis=0, weights=[len(track) for track in tracks])
    for element in (*tracks[0], *tracks[1]):
        image = whole.image(element.image_id)
        xy_px = image.project_point(middle)
        if xy_px is None or float(np.linalg.norm(xy_px - image.point2D(element.point2D_idx).xy)) > within_px:
            return False
    return True
