"""Rigs of a capture in COLMAP's database: pairs of all cameras, poses of the cameras, frames of one moment."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import MatchRecord, match_pairs, writing_database
from colmap_inertial.colmap.views.two_views import count_verified
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import InertialError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_from_matrix,
    quat_log,
    quat_multiply,
)
from colmap_inertial.io.capture_rig import RigCamera
from colmap_inertial.io.rig_frames import image_name

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RigLimits:
    """Limits for poses of cameras that are found in a model without a rig."""

    #: Frames that both cameras are registered in.
    least_frames: int = 5
    #: Median difference of the rotation between two cameras from frame to frame: EuRoC's is 0.03, and cameras that
    #: are 30 ms apart in time turn by 0.9 degrees at 0.5 rad/s.
    most_apart_deg: float = 0.5


_LIMITS = RigLimits()
#: What COLMAP's mapper does with declared poses, as with declared intrinsics: it keeps them.
FIXED_POSES = "Mapper.ba_refine_sensor_from_rig=0"


def poses_are_known(rig: Sequence[RigCamera]) -> bool:
    """Whether the pose of each camera is declared."""
    return all(camera.cam_from_reference is not None for camera in rig)


def match_rig_images(
    database: Path, record: MatchRecord, frames: Sequence[str], rig: Sequence[RigCamera], context: RunContext
) -> MatchRecord:
    """Match images of the other cameras, where the main camera's have matches or are next to each other in time.

    Parameters
    ----------
    database
        With features of all images, and the pairs of the main camera matched and judged.
    record
        Of these pairs.
    frames
        Names of the main camera's images, in order of time.
    """
    import pycolmap

    place = {name: k for k, name in enumerate(frames)}
    with pycolmap.Database.open(str(database)) as opened:
        name_of = {image.image_id: image.name for image in opened.read_all_images()}
        verified, inliers = opened.read_two_view_geometry_num_inliers()
    joined = {
        tuple(sorted(place[name_of[number]] for number in pycolmap.pair_id_to_image_pair(pair)))
        for pair, count in zip(verified, inliers, strict=True)
        if count
    }
    close = itertools.chain(((k, k) for k in range(len(frames))), itertools.pairwise(range(len(frames))))
    present = set(name_of.values())
    pairs: list[tuple[str, str]] = []
    for a, b in sorted(joined.union(close)):
        first, second = ([frames[k], *(image_name(camera, frames[k]) for camera in rig)] for k in (a, b))
        every = itertools.combinations(first, 2) if a == b else itertools.product(first, second)
        pairs += [pair for pair in every if present.issuperset(pair) and pair != (frames[a], frames[b])]
    match_pairs(database, pairs, context)
    return replace(
        record,
        images=len(present),
        pairs=record.pairs + len(pairs),
        matched=record.matched + len(pairs),
        verified=count_verified(database),
    )


def find_rig_poses(models: Iterable[pycolmap.Reconstruction], rig: Sequence[RigCamera]) -> dict[str, Array]:
    """(4, 4) cam_from_reference of each camera by name, in units of the largest of some models without a rig.

    Raises
    ------
    MappingError
        Where cameras are in no model together, or turn against each other.
    """
    model = max(models, key=lambda each: int(each.num_reg_images()))
    images = (model.image(number) for number in model.reg_image_ids())
    cam_from_world = {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images}
    return {camera.name: _find_pose(cam_from_world, camera) for camera in rig}


def _find_pose(cam_from_world: Mapping[str, Array], camera: RigCamera) -> Array:
    others = {frame: cam_from_world.get(image_name(camera, frame)) for frame in cam_from_world}
    relative = np.array(
        [pose @ np.linalg.inv(cam_from_world[frame]) for frame, pose in others.items() if pose is not None]
    ).reshape(-1, 4, 4)
    if len(relative) < _LIMITS.least_frames:
        raise MappingError(Fact("rig-frames-too-few-placed", camera=camera.name, frames=len(relative)))
    quaternions = np.array([quat_from_matrix(pose[:3, :3]) for pose in relative])
    middle = quaternions[0]
    for _ in range(2):  # the first one may be far from the others
        middle = quat_multiply(quat_exp(np.median(_differences(quaternions, middle), axis=0)), middle)
    apart_deg = float(np.degrees(np.median(np.linalg.norm(_differences(quaternions, middle), axis=1))))
    log.info("rig: pose of %s by %d frames, rotations differ by %.3f deg", camera.name, len(relative), apart_deg)
    if apart_deg > _LIMITS.most_apart_deg:
        raise MappingError(Fact("rig-camera-turns", camera=camera.name, apart_deg=apart_deg))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix_from_quat(middle), np.median(relative[:, :3, 3], axis=0)
    return pose


def _differences(quaternions: Array, middle: Array) -> Array:
    """(N, 3) rotation vectors from the middle to each rotation."""
    return quat_log(quat_multiply(quaternions, quat_conjugate(middle)))


def write_rig(database: Path, rig: Sequence[RigCamera], poses: Mapping[str, Array]) -> None:
    """Make one rig of the cameras, and one frame of the images of a moment; rigs and frames before are removed.

    Parameters
    ----------
    poses
        (4, 4) cam_from_reference by the name of the camera.

    Raises
    ------
    InertialError
        Where images of one camera have different intrinsics.
    """
    import pycolmap

    with writing_database(database), pycolmap.Database.open(str(database)) as opened:
        images: dict[str, dict[str, pycolmap.Image]] = {"": {}, **{camera.name: {} for camera in rig}}
        for image in opened.read_all_images():
            folder, _, frame = image.name.partition("/")
            own = folder if folder in poses else ""
            images[own][frame if own else image.name] = image
        made = pycolmap.Rig()
        for name, own_images in images.items():
            cameras = {image.camera_id for image in own_images.values()}
            if len(cameras) != 1:
                raise InertialError(Fact("rig-of-several-cameras", camera=name, count=len(cameras)))
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras.pop())
            if not name:
                made.add_ref_sensor(sensor)
            else:
                made.add_sensor(sensor, pycolmap.Rigid3d(poses[name][:3]))
        opened.clear_frames()
        opened.clear_rigs()
        number = opened.write_rig(made)
        for name in dict.fromkeys(frame for own_images in images.values() for frame in own_images):
            taken = pycolmap.Frame(rig_id=number)
            for own_images in images.values():
                if name in own_images:
                    taken.add_data_id(own_images[name].data_id)
            opened.write_frame(taken)
