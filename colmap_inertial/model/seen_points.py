"""Depths of a model's points at the keypoints of its images."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.types.seen_points import SeenPoints

if TYPE_CHECKING:
    import pycolmap

#: Points that fewer images see, or that are known worse, are left out: mismatches are among the former, and the mean
#: of the latter is biased (a reciprocal of noise).
_FEWEST_VIEWS = 3
_LEAST_SURE = 0.05
#: Standard deviation of a keypoint, pixels, at least.
_LEAST_PX = 0.5


def seen_points(
    reconstruction: pycolmap.Reconstruction, t_s: Mapping[str, float], names: Collection[str]
) -> tuple[SeenPoints, ...]:
    """Points that images show, in the order of time.

    Parameters
    ----------
    reconstruction
        A COLMAP model.
    t_s
        When its images were exposed, by name.
    names
        The images to look at.
    """
    images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
    images = sorted((image for image in images if image.name in names), key=lambda image: (t_s[image.name], image.name))
    sigma_log = _depth_sigmas(reconstruction)
    seen = []
    for image in images:
        camera = reconstruction.camera(image.camera_id)
        observed = [point for point in image.get_observation_points2D() if point.point3D_id in sigma_log]
        xyz = np.array([reconstruction.point3D(point.point3D_id).xyz for point in observed]).reshape(-1, 3)
        pose = image.cam_from_world()
        depth = xyz @ pose.rotation.matrix()[2] + pose.translation[2]
        before = depth > 0
        seen.append(
            SeenPoints(
                name=image.name,
                t_s=t_s[image.name],
                width=camera.width,
                height=camera.height,
                xy_px=np.array([point.xy for point in observed]).reshape(-1, 2)[before],
                depth=depth[before],
                sigma_log=np.array([sigma_log[point.point3D_id] for point in observed])[before],
            )
        )
    return tuple(seen)


def _depth_sigmas(reconstruction: pycolmap.Reconstruction) -> dict[int, float]:
    """Standard deviation of the logarithm of the distance of points that are known well enough, by their number.

    Rays of n images at angles of rms a about their mean, each off by e, leave e / (a sqrt(n)).
    """
    reconstruction.update_point_3d_errors()
    images = {i: reconstruction.image(i) for i in reconstruction.reg_image_ids()}
    centres = {i: image.projection_center() for i, image in images.items()}
    focal_px = {i: reconstruction.camera(image.camera_id).mean_focal_length() for i, image in images.items()}
    known = {}
    for number, point in reconstruction.points3D.items():
        seen_by = {element.image_id for element in point.track.elements} & images.keys()
        if len(seen_by) < _FEWEST_VIEWS:
            continue
        rays = point.xyz - np.array([centres[i] for i in seen_by])
        lengths = np.linalg.norm(rays, axis=1)
        if not lengths.min() > 0:
            continue
        along = float(np.linalg.norm((rays / lengths[:, None]).mean(axis=0)))
        spread_rad = np.sqrt(max(2 * (1 - along), 0.0))
        noise_rad = max(point.error, _LEAST_PX) / float(np.mean([focal_px[i] for i in seen_by]))
        if spread_rad > 0 and (sigma := noise_rad / (spread_rad * len(seen_by) ** 0.5)) < _LEAST_SURE:
            known[number] = float(sigma)
    return known
