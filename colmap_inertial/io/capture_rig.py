"""The ``[rig]`` table of a ``capture.toml``: more cameras that are fixed to the main one and take images with it.

.. code-block:: toml

    [images]
    folder = "left"                     # the main camera's, which is the reference of the rig
    times = "left.csv"

    [rig]
    calibration = "camchain.yaml"       # intrinsics and poses of all cameras, the main one among them
    reference = "cam0"                  # its name there; default: the first one

    [rig.right]
    folder = "right"                    # or video = "right.mp4"
    times = "right.csv"                 # without times, images of the same names were taken together
    camera = "cam1"                     # its name in the calibration; default: the table's

Without a calibration of all cameras:

.. code-block:: toml

    [rig.right]
    video = "right.mp4"
    cam_from_reference = [[...], ...]   # 4x4, metres; without it, the pose is found

    [rig.right.camera]                  # intrinsics, as in [camera]
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.camera_table import CAMERA_KEYS, check_transform, read_camera_table
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import ImageFolder, Video, image_names, read_image_folder, read_video
from colmap_inertial.io.rig_calibration import Metres, MountedCamera, RigCalibration, read_rig_calibration
from colmap_inertial.io.toml_section import Section

_FOLDER_KEYS = ("folder", "pattern", "times", "time_unit")
_VIDEO_KEYS = ("video", "frame_times", "time_unit")
#: A name becomes a folder of images, and COLMAP's lists of pairs hold no blanks.
_NAME = re.compile(r"[A-Za-z0-9][\w\-]*")


@dataclass(frozen=True, eq=False, kw_only=True)
class RigCamera:
    """A camera that is fixed to a capture's main camera, the reference.

    Attributes
    ----------
    name
        Folder of its images in a run.
    frames
        Its images or video.
    camera
        Intrinsics; ``None`` lets COLMAP calibrate.
    cam_from_reference
        (4, 4), metres; ``None`` where it is to be found.
    """

    name: str
    frames: ImageFolder | Video
    camera: CameraModel | None = None
    cam_from_reference: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RigTable:
    """What a ``[rig]`` table says.

    Attributes
    ----------
    reference
        Intrinsics of the main camera, where a calibration of all cameras gives them.
    cameras
        The others.
    """

    reference: CameraModel | None
    cameras: tuple[RigCamera, ...]


def rig_files(rig: Iterable[RigCamera]) -> list[Path]:
    """Files of the images, videos and times of a rig's cameras."""
    files: list[Path] = []
    for source in (camera.frames for camera in rig):
        if isinstance(source, ImageFolder):
            files += [path_in(source.folder, name) for name in image_names(source)]
            files += [source.times] if isinstance(source.times, Path) else []
        else:
            files += [source.file, *filter(None, [source.frame_times])]
    return files


def read_rig_table(table: Section, *, body_from_cam: Array | None) -> RigTable:
    """The ``[rig]`` table.

    Parameters
    ----------
    body_from_cam
        (4, 4) of the main camera, where its sensor.yaml gives it.

    Raises
    ------
    FormatError
        Where the calibration cannot be read or lacks a camera, and for what is missing or said twice.
    """
    names = [key for key in table.names() if isinstance(table.raw(key), dict)]
    table.require_known(["calibration", "unit", "reference", *names])
    if not names:
        table.fail(None, Fact("rig-without-cameras"))
    path = table.file("calibration")
    units: tuple[Metres, ...] = get_args(Metres)
    unit, reference = table.choice("unit", units), table.text("reference")
    if path is None:
        for key in ("unit", "reference"):
            if key in table:
                table.fail(key, Fact("belongs-to-missing", key="calibration"))
        cameras = tuple(_read_camera(table.table(name), name, body_from_cam) for name in names)
        unknown = [camera.name for camera in cameras if camera.cam_from_reference is None]
        if 0 < len(unknown) < len(cameras):
            table.table(unknown[0]).fail(None, Fact("pose-of-some-cameras"))
        return RigTable(reference=None, cameras=cameras)
    known = read_rig_calibration(path, unit=unit)
    if known.length_unit != "m":
        table.fail("calibration", Fact("calibration-without-unit"))
    main = known.camera(reference or next(iter(known.cameras)))
    cameras = tuple(_read_calibrated(table.table(name), name, main, known) for name in names)
    models = [table.table(name).text("camera") or name for name in names]
    for name, model in zip(names, models, strict=True):
        if models.count(model) > 1:
            table.table(name).fail("camera", Fact("calibrated-camera-twice", name=model))
    return RigTable(reference=_model(known, main, reference), cameras=cameras)


def _read_calibrated(part: Section, name: str, main: MountedCamera, known: RigCalibration) -> RigCamera:
    """A camera that the calibration of the rig has."""
    frames = _read_frames(part, name, ("camera",))
    own = part.text("camera") or name
    camera = known.camera(own)
    if camera is main:
        part.fail("camera", Fact("calibrated-camera-is-main", name=own))
    return RigCamera(
        name=name,
        frames=frames,
        camera=_model(known, camera, own),
        cam_from_reference=camera.cam_from_rig @ np.linalg.inv(main.cam_from_rig),
    )


def _read_camera(part: Section, name: str, body_from_reference: Array | None) -> RigCamera:
    """A camera that its own table describes."""
    frames = _read_frames(part, name, ("camera", "cam_from_reference"))
    table = part.section("camera")
    camera, body_from_cam = None, None
    if table is not None:
        table.require_known(CAMERA_KEYS)
        camera, body_from_cam, _ = read_camera_table(table)
    rows, pose = part.matrix("cam_from_reference"), None
    if rows is not None:
        if len(rows) != 4:
            part.fail("cam_from_reference", Fact("pose-not-4x4"))
        pose = check_transform(part, "cam_from_reference", rows)
    elif body_from_cam is not None and body_from_reference is not None:
        pose = np.linalg.inv(body_from_cam) @ body_from_reference
    return RigCamera(name=name, frames=frames, camera=camera, cam_from_reference=pose)


def _read_frames(part: Section, name: str, more: tuple[str, ...]) -> ImageFolder | Video:
    if not _NAME.fullmatch(name):
        part.fail(None, Fact("camera-name-unsuited", name=name))
    if "video" in part:
        part.require_known([*_VIDEO_KEYS, *more])
        return read_video(part, "video")
    part.require_known([*_FOLDER_KEYS, "video", *more])
    return read_image_folder(part)


def _model(known: RigCalibration, camera: MountedCamera, name: str | None) -> CameraModel:
    if camera.size is None:
        raise FormatError(known.path, Fact("camera-without-size", name=name))
    return CameraModel(model=camera.model, width=camera.size[0], height=camera.size[1], params=camera.params)
