"""A model as the report shows it in 3-D: some of its points, the camera's path, the direction of gravity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.checks.report.series import strided
from colmap_inertial.checks.report.sizes import SIZES
from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_rotate, rotation_between
from colmap_inertial.core.types import CameraTrajectory

if TYPE_CHECKING:
    import pycolmap


def scene_record(
    reconstruction: pycolmap.Reconstruction,
    trajectory: CameraTrajectory,
    gravity_in_world_m_s2: Array | None,
    *,
    first_frame_s: float | None = None,
) -> dict[str, Any]:
    """A model rotated upright, and thinned to a bounded size.

    Parameters
    ----------
    reconstruction
        The model.
    trajectory
        Its cameras in order of time, in metres where its scale is known.
    gravity_in_world_m_s2
        (3,) in the model's world; where unknown, the mean direction of the images' upper edges counts as up.
    first_frame_s
        When the recording's first frame was taken, on the trajectory's clock; without it, the first pose counts.

    Returns
    -------
    ``scene`` as ``colmap_inertial.checks.report`` describes it.
    """
    world_from_cam = quat_conjugate(trajectory.cam_from_world_xyzw)
    start_s = trajectory.t_s[0] if first_frame_s is None else first_frame_s
    down = gravity_in_world_m_s2
    if down is None:
        down = quat_rotate(world_from_cam, np.array([0.0, 1.0, 0.0])).mean(axis=0)
    upright = rotation_between(down, np.array([0.0, 0.0, -1.0]))
    centres = quat_rotate(upright, trajectory.cam_in_world)
    xyz, rgb = _choose_points(reconstruction, trajectory.cam_in_world)
    xyz = quat_rotate(upright, xyz) if len(xyz) else xyz
    some = strided(len(centres), SIZES.scene_cameras)
    poses = strided(len(centres), SIZES.scene_poses)
    size = _measure_extent(np.concatenate([xyz, centres]))
    digits = int(np.clip(4 - np.floor(np.log10(size)), 0, 9)) if size > 0 else 6
    axes = np.einsum("ij,njk->nik", matrix_from_quat(upright), matrix_from_quat(world_from_cam[some]))
    half_width, half_height = _measure_half_sides(reconstruction)
    return {
        "unit": trajectory.length_unit,
        "gravity_known": gravity_in_world_m_s2 is not None,
        "display_from_model_xyzw": np.round(upright, 9).tolist(),
        "points_in_model": reconstruction.num_points3D(),
        "points": {"xyz": np.round(xyz.T, digits).tolist(), "rgb": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in rgb]},
        "path": {
            "t_s": np.round(trajectory.t_s[poses] - start_s, 3).tolist(),
            "xyz": np.round(centres[poses].T, digits).tolist(),
        },
        "cameras": {
            "xyz": np.round(centres[some].T, digits).tolist(),
            "right": np.round(axes[:, :, 0].T, 4).tolist(),
            "down": np.round(axes[:, :, 1].T, 4).tolist(),
            "ahead": np.round(axes[:, :, 2].T, 4).tolist(),
            "half_width": round(half_width, 4),
            "half_height": round(half_height, 4),
        },
        "path_length": float(np.sum(np.linalg.norm(np.diff(trajectory.cam_in_world, axis=0), axis=1))),
    }


def _measure_half_sides(reconstruction: pycolmap.Reconstruction) -> tuple[float, float]:
    """Half of an image's width and height at distance 1; a nominal size for cameras that see all around."""
    images = reconstruction.reg_image_ids()
    camera = reconstruction.camera(reconstruction.image(min(images)).camera_id)
    focal = camera.mean_focal_length()
    focal = focal if focal > 0 else max(camera.width, camera.height)
    return 0.5 * camera.width / focal, 0.5 * camera.height / focal


def _choose_points(reconstruction: pycolmap.Reconstruction, centres: Array) -> tuple[Array, UInt8Array]:
    """(N, 3) positions and colours of some points, chosen by their numbers: the same each time."""
    chosen = []
    ids = sorted(reconstruction.point3D_ids())
    # a first choice bounds the work for models of millions of points
    for i in np.array(ids)[strided(len(ids), 6 * SIZES.scene_points)].tolist() if ids else []:
        point = reconstruction.points3D[i]
        seen_well = point.track.length() >= SIZES.fewest_views and not point.error > SIZES.worst_point_px
        if seen_well and np.isfinite(point.xyz).all():
            chosen.append(point)
    if not chosen:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    xyz = np.array([point.xyz for point in chosen])
    middle = np.median(np.concatenate([xyz, centres]), axis=0)
    away = np.linalg.norm(xyz - middle, axis=1)
    near = np.flatnonzero(away < SIZES.farthest_medians * max(float(np.median(away)), 1e-12))
    near = near[strided(len(near), SIZES.scene_points)]
    return xyz[near], np.array([chosen[i].color for i in near], dtype=np.uint8).reshape(-1, 3)


def _measure_extent(xyz: Array) -> float:
    return float(np.ptp(xyz, axis=0).max()) if len(xyz) else 0.0
