"""Covariances of the poses of a model's images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import cross
from colmap_inertial.model.rigs import PosedFrame

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class PointLimits:
    """Numbers of observations that a model needs and that are used."""

    #: Observations of an image that its covariance is computed from: fewer do not tell, more are not needed.
    fewest_observations: int = 10
    most_observations: int = 1000
    #: Keypoints are not better than this.
    smallest_error_px: float = 0.05


_LIMITS = PointLimits()


def pose_covariances(reconstruction: pycolmap.Reconstruction, frames: Sequence[PosedFrame]) -> Array | None:
    """(F, 6, 6) covariances of the poses given the points, in the terms of ``CameraTrajectory.pose_cov``.

    What a frame's own observations say about its pose: the error that a pose does not share with its neighbours,
    which see the same points. (The covariance from bundle adjustment also holds what they share, and the gauge.)
    Cameras of a rig are taken as they are placed in it.

    Returns
    -------
    ``None`` where a frame's observations do not determine its pose.
    """
    covariances = []
    # to ask for each observation's point by itself would take longer than all the rest
    place = {number: point.xyz for number, point in reconstruction.points3D.items()}
    for frame in frames:
        seen = sum(len(image.get_observation_points2D()) for image in frame.images)
        if seen < _LIMITS.fewest_observations:
            return None
        informations = [
            _pose_information(reconstruction.camera(image.camera_id), image, frame.pose, place)
            for image in frame.images
            if image.num_points3D
        ]
        variance_px2 = informations[0][1]
        try:
            root = np.linalg.inv(
                np.linalg.cholesky(sum(variance_px2 / own_px2 * information for information, own_px2 in informations))
            )
        except np.linalg.LinAlgError:
            return None
        covariances.append(variance_px2 * (root.T @ root))
    return np.array(covariances)


def _pose_information(
    camera: pycolmap.Camera, image: pycolmap.Image, pose: pycolmap.Rigid3d, place: Mapping[int, Array]
) -> tuple[Array, float]:
    """(6, 6) what an image's observations of points, (3,) ``place`` each, say about the pose of its frame.

    For observations of 1 px; and their variance (px²).
    """
    seen = image.get_observation_points2D()
    seen = seen[:: -(-len(seen) // _LIMITS.most_observations) or 1]
    own = image.cam_from_world()
    world = np.array([place[point.point3D_id] for point in seen])
    cam = world @ own.rotation.matrix().T + own.translation
    error_px = camera.img_from_cam(cam) - np.array([point.xy for point in seen])
    squares = np.sum(error_px**2, axis=1)
    level = float(np.nanmedian(squares))
    # Of normal errors, the median of the squares' sum is 2 ln 2 variances; COLMAP's own weights are robust, too
    weight = np.where(np.isfinite(squares), 1 / (1 + squares / max(2 * level, 1e-12)), 0.0)
    by_cam = np.zeros((len(seen), 2, 3))
    by_cam[:, 0, 0] = by_cam[:, 1, 1] = 1 / cam[:, 2]
    by_cam[:, :, 2] = -cam[:, :2] / cam[:, 2:] ** 2
    if not image.is_ref_in_frame():
        by_cam = by_cam @ (own.rotation.matrix() @ pose.rotation.matrix().T)
        cam = world @ pose.rotation.matrix().T + pose.translation
    by_turn, by_place = -cross(by_cam, cam[:, None]).reshape(-1, 3), -by_cam.reshape(-1, 3) @ pose.rotation.matrix()
    by_pose = camera.mean_focal_length() * np.concatenate([by_turn, by_place], axis=1)
    information = np.asarray(by_pose.T @ (np.repeat(weight, 2)[:, None] * by_pose))
    return information, max(level / (2 * np.log(2)), _LIMITS.smallest_error_px**2)
