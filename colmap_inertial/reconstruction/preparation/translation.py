"""How the camera moves past what each frame shows, from small models made before the reconstruction.

Positions of a model alone do not give the velocity of a hand between frames; smoothed with the accelerometer, they do,
also for frames that the model lacks. Depths are those of the points that the nearest frames of the model have seen.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.imaging.parallax import Parallax, parallax_from_points
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.model import colmap_camera, trajectory_from_model
from colmap_inertial.pipeline.stages.gyro_view import GyroView
from colmap_inertial.pipeline.stages.metric import smoothed_path
from colmap_inertial.pipeline.stages.rolling_shutter import for_rectified

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: A frame shows what the nearest frames of a model show, where they are near enough.
_NEIGHBOURS, _FARTHEST_S = 3, 2.0
#: Velocities are used where their standard deviation is below this share of them, or of what is slow anyway.
_USABLE_SHARE, _SLOW_M_S = 0.3, 0.1
#: A model of fewer images says nothing.
_FEWEST_IMAGES = 8


def find_parallaxes(models: Sequence[pycolmap.Reconstruction], view: GyroView) -> dict[str, Parallax]:
    """The parallax of frames, by name; those without are of frames that no model tells about.

    Parameters
    ----------
    models
        Of frames of the recording, of rectified keypoints where there is a readout. Of several that tell about a frame,
        the one counts that has it, or has one nearest to it.
    view
        Gyroscope, camera and times.
    """
    out: dict[str, tuple[float, Parallax]] = {}
    for model in models:
        if model.num_reg_images() >= _FEWEST_IMAGES:
            for name, away_s, parallax in _of_model(model, view):
                if name not in out or away_s < out[name][0]:
                    out[name] = away_s, parallax
    return {name: parallax for name, (_, parallax) in out.items()}


def _of_model(model: pycolmap.Reconstruction, view: GyroView) -> Iterator[tuple[str, float, Parallax]]:
    """Names of frames, how far in time they are from the model's nearest one, and their parallax."""
    calibration = for_rectified(view.calibration) if view.timing.readout_s else view.calibration
    trajectory, _ = trajectory_from_model(model, view.timing)
    imu = view.timed().imu
    estimate = estimate_scale(trajectory, imu, calibration=calibration, options=ScaleOptions())
    if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
        log.info("no blur by translation: %s", "; ".join(estimate.reasons))
        return
    metric = dataclasses.replace(
        trajectory, cam_in_world=trajectory.cam_in_world * estimate.metres_per_unit, length_unit="m", pose_cov=None
    )
    every_s = view.timing.pose_t_s()
    around = np.flatnonzero(
        (every_s >= trajectory.t_s[0] - _FARTHEST_S) & (every_s <= trajectory.t_s[-1] + _FARTHEST_S)
    )
    try:
        path = smoothed_path(metric, imu, estimate, estimate.gravity_in_world_m_s2, also_at_s=every_s[around])
    except NotObservableError as error:
        log.info("no blur by translation: %s", error)
        return
    seen = _points_seen(model, trajectory, estimate.metres_per_unit)
    camera, width, height = colmap_camera(view.camera), view.camera.width, view.camera.height
    rotation = matrix_from_quat(path.cam_from_world_xyzw)
    sigma = np.sqrt(np.trace(path.cov[:, 3:6, 3:6], axis1=1, axis2=2))
    known = sigma < _USABLE_SHARE * np.maximum(np.linalg.norm(path.velocity_in_world, axis=1), _SLOW_M_S)
    for k in around:
        t_s = float(every_s[k])
        i = min(int(np.searchsorted(path.t_s, t_s - 1e-6)), len(path.t_s) - 1)
        away_s = np.abs(trajectory.t_s - t_s)
        near = np.argsort(away_s)[:_NEIGHBOURS]
        if abs(path.t_s[i] - t_s) > 1e-5 or not known[i] or away_s[near[0]] > _FARTHEST_S:
            continue
        points = np.unique(np.concatenate([seen[n] for n in near]), axis=0)
        in_cam = (points - path.cam_in_world[i]) @ rotation[i].T
        velocity = rotation[i] @ path.velocity_in_world[i]
        found = parallax_from_points(in_cam, velocity, camera, width=width, height=height)
        if found is not None:
            yield view.timing.names[k], float(away_s[near[0]]), found


def _points_seen(model: pycolmap.Reconstruction, trajectory: CameraTrajectory, factor: float) -> list[Array]:
    """For each pose, (N, 3) the points that its image has seen."""
    points = {key: factor * point.xyz for key, point in model.points3D.items()}
    out = []
    for name in trajectory.names:
        image = model.find_image_with_name(name)
        out.append(np.array([points[p.point3D_id] for p in image.points2D if p.has_point3D()]).reshape(-1, 3))
    return out
