"""What the camera's translation does to keypoints within a readout, once depths and velocities are known.

Keypoints that a gyroscope rectified lack the camera's turning, but each is still seen from where the camera was when
its line was exposed. A model gives the depth of each point, and with the camera's velocity where it would have been
seen at the instant that the pose holds; bundle adjustment of those gives the model of a global shutter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.imaging.gyro_camera import FrameShutter

if TYPE_CHECKING:
    import pycolmap

#: Smaller shifts are not worth a bundle adjustment (median over the frames of the 90th percentile within).
_LEAST_SHIFT_PX = 0.05


@dataclass(frozen=True, kw_only=True)
class Settled:
    """What became of a model.

    Attributes
    ----------
    shift_px
        By how much observations move: median over the images of the 90th percentile within each.
    before_px, after_px
        Mean reprojection error.
    accepted
        Whether the model was changed: only where the shifts matter and bring it closer to its observations.
    """

    shift_px: float
    before_px: float
    after_px: float
    accepted: bool


def settle_readout(
    reconstruction: pycolmap.Reconstruction,
    shutters: Mapping[str, FrameShutter],
    velocity_in_world: Mapping[str, Array],
    *,
    refine_intrinsics: bool,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, Settled]:
    """Take the camera's translation within the readout out of a model's observations, and adjust it to them.

    Parameters
    ----------
    reconstruction
        Mapped from keypoints without the camera's rotation within the readout; not changed.
    shutters
        By image name, when its lines were exposed; images without one stay as they are.
    velocity_in_world
        By image name, (3,) of the camera at the instant its pose holds, model units per second.
    refine_intrinsics
        Whether bundle adjustment may change the cameras.
    num_threads
        Of bundle adjustment; all where negative.

    Returns
    -------
    A new model, whose observations lie where a global shutter would have seen them (to first order in the readout
    time), and what it is worth; the given model where it is worth nothing.
    """
    import pycolmap

    before_px = float(reconstruction.compute_mean_reprojection_error())
    settled = pycolmap.Reconstruction(reconstruction)
    shifts = [
        _shift(settled, settled.image(i), shutters[name], velocity_in_world[name])
        for i in settled.reg_image_ids()
        if (name := settled.image(i).name) in shutters and name in velocity_in_world
    ]
    shift_px = float(np.median([float(np.percentile(s, 90)) for s in shifts if len(s)] or [0.0]))
    if shift_px < _LEAST_SHIFT_PX:
        return reconstruction, Settled(shift_px=shift_px, before_px=before_px, after_px=before_px, accepted=False)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.refine_principal_point = False
    solver: Any = getattr(options, "ceres", options)  # COLMAP 4.2 keeps the solver apart
    solver.solver_options.num_threads = num_threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in settled.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment would switch COLMAP's log back on
    pycolmap.create_default_bundle_adjuster(options, config, settled).solve()
    settled.update_point_3d_errors()
    after_px = float(settled.compute_mean_reprojection_error())
    accepted = after_px < before_px
    what = Settled(shift_px=shift_px, before_px=before_px, after_px=after_px, accepted=accepted)
    return settled if accepted else reconstruction, what


def _shift(
    reconstruction: pycolmap.Reconstruction, image: pycolmap.Image, shutter: FrameShutter, velocity: Array
) -> Array:
    """Move an image's observations of points; (N,) by how many px."""
    camera, pose = reconstruction.camera(image.camera_id), image.cam_from_world()
    points = image.points2D
    seen = [i for i in range(len(points)) if points[i].has_point3D()]
    if not seen:
        return np.zeros(0)
    rotation = pose.rotation.matrix()
    world = np.array([reconstruction.points3D[points[i].point3D_id].xyz for i in seen])
    at = np.array([points[i].xy for i in seen])
    late_s = shutter.middle_s(at) - shutter.reference_s()
    now = world @ rotation.T + pose.translation
    then = now - late_s[:, None] * (rotation @ velocity)
    shift = np.asarray(camera.img_from_cam(now)) - np.asarray(camera.img_from_cam(then))
    good = np.isfinite(shift).all(axis=1)
    for i, xy in zip(np.array(seen)[good], (at + shift)[good], strict=True):
        points[i].xy = xy
    return np.asarray(np.linalg.norm(shift[good], axis=1))
