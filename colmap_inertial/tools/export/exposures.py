"""How the camera moved while each exported picture was exposed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.types import CameraMotion
from colmap_inertial.tools.export.source import ExportSource, Picture
from colmap_inertial.tools.export.transforms import Exposure
from colmap_inertial.tools.export.undistort import Undistortion

if TYPE_CHECKING:
    import pycolmap


def exposures_of(
    model: pycolmap.Reconstruction,
    source: ExportSource,
    pictures: Mapping[str, Picture],
    cameras: Mapping[int, Undistortion],
    notes: list[str],
) -> dict[str, Exposure]:
    """Velocity, exposure and readout by image name; images without a velocity are left out.

    The exported picture's rows are those of the filmed one, stretched: its readout is that of as many rows as it shows.

    Parameters
    ----------
    model, source
        What is exported.
    pictures
        The exported files: where the rolling shutter was undone there is no readout, where the blur was, no exposure.
    cameras
        What became of the cameras.
    notes
        Gets what the user should know.

    Raises
    ------
    NotObservableError
        Where no velocity is known, and where lines are read out in another direction than down.
    """
    motion = _known_motion(source.motion, pictures)
    readout_s = motion.readout_s or 0.0
    if motion.exposure_s is None and any(not picture.sharpened for picture in pictures.values()):
        notes.append("exposure times are not known and count as 0: blur is not modelled")
    place = {name: i for i, name in enumerate(motion.names)}
    found = {}
    for image in map(model.image, model.reg_image_ids()):
        index = place.get(image.name)
        if index is None:
            continue
        picture, undistortion = pictures[image.name], cameras[image.camera_id]
        share, late = _rows(undistortion)
        exposed = 0.0 if motion.exposure_s is None or picture.sharpened else float(motion.exposure_s[index])
        left_s = 0.0 if picture.rectified else readout_s
        rotation = image.cam_from_world().rotation.matrix()
        found[image.name] = Exposure(
            velocity_in_cam_m_s=rotation @ motion.velocity_in_world_m_s[index],
            angular_velocity_in_cam_rad_s=motion.angular_velocity_in_cam_rad_s[index],
            exposure_s=exposed,
            readout_s=left_s * share,
            late_s=left_s * late,
        )
    if not found:
        raise NotObservableError("camera motion", "none of the model's images has a velocity")
    if motion.exposure_s is not None and len({one.exposure_s for one in found.values()}) > 1:
        notes.append("exposure times differ between pictures; the program takes one for all, their median")
    return found


def _known_motion(motion: CameraMotion | None, pictures: Mapping[str, Picture]) -> CameraMotion:
    """The motion, where it is known and a program can be told of the pictures' readout."""
    if motion is None or not motion.names:
        raise NotObservableError(
            "camera motion",
            "the run kept no velocities: its model has no scale, its gyroscope was silent, or an earlier version made "
            "it (then start reconstruct again with the same arguments, it adds them)",
        )
    as_filmed = any(not picture.rectified for picture in pictures.values())
    if as_filmed and (motion.readout_s or 0.0) > 0 and motion.readout_direction != "down":
        raise NotObservableError(
            "rolling shutter",
            f"these pictures are read out {motion.readout_direction}, which the program cannot be told; export the "
            "rectified ones, or turn the pictures",
        )
    return motion


def _rows(undistortion: Undistortion) -> tuple[float, float]:
    """How many rows of the filmed picture the new one shows, and how much lower its middle is: shares of its height."""
    pinhole, height = undistortion.pinhole, undistortion.camera.height
    middle = [0.5 * pinhole.width, 0.5 * pinhole.height]
    step = 0.25 * pinhole.height
    above, at, below = undistortion.source_px(np.array(middle) + np.array([[0.0, -step], [0.0, 0.0], [0.0, step]]))[
        :, 1
    ]
    return float((below - above) * pinhole.height / (2 * step) / height), float(at / height - 0.5)
