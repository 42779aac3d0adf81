"""A model as the report shows it: in 3-D, and what photogrammetrists look for first.

That is cameras, residuals, tracks, overlap, ground sampling distance and extent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray, UInt8Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_rotate, rotation_between
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.model.readout import intrinsics_sigma
from colmap_inertial.report.series import SIZES, round_values, stride_indices

if TYPE_CHECKING:
    import pycolmap


def photogrammetry_record(
    reconstruction: pycolmap.Reconstruction,
    display_from_model_xyzw: Array,
    *,
    unit: str,
    keeps_intrinsics: bool = False,
) -> dict[str, Any]:
    """Figures of a model, its images and cameras; lengths are in ``unit``.

    Parameters
    ----------
    reconstruction
        The model.
    display_from_model_xyzw
        (4,) rotation that puts it upright, for what is seen from above.
    unit
        ``"m"`` or ``"model"``.
    keeps_intrinsics
        Whether the cameras are as they were declared: their parameters have no standard deviation then.

    Returns
    -------
    ``photogrammetry`` as :mod:`colmap_inertial.report` describes it.
    """
    image_ids = sorted(reconstruction.reg_image_ids())
    images = [reconstruction.image(i) for i in image_ids]
    points = dict(sorted(reconstruction.points3D.items()))
    xyz = np.array([point.xyz for point in points.values()]).reshape(-1, 3)
    place = dict(zip(points, xyz, strict=True))
    tracks = [point.track for point in points.values()]
    lengths = np.array([track.length() for track in tracks], dtype=np.intp)
    upright = quat_rotate(display_from_model_xyzw, xyz) if len(xyz) else xyz
    seen = [
        _observe(reconstruction.camera(images[i].camera_id), images[i], place)
        for i in stride_indices(len(images), SIZES.residual_images)
    ]
    sigma = {} if keeps_intrinsics else intrinsics_sigma(reconstruction)
    longest = SIZES.longest_track
    return {
        "unit": unit,
        "cameras": [
            _describe_camera(reconstruction, i, image_ids, sigma.get(i))
            for i in _choose_cameras(reconstruction, image_ids)
        ],
        "images": [
            {"name": s.name, "observations": len(s.residual_px), "rms_px": _rms(s.residual_px), "gsd": s.gsd}
            for s in seen
        ],
        "sensor": _average_over_sensor(seen),
        "tracks": {
            "mean": float(lengths.mean()) if len(lengths) else 0.0,
            "counts": np.bincount(np.minimum(lengths, longest), minlength=longest + 1)[2:].tolist(),
        },
        "extent": _measure_extent(upright),
        "ground": _count_from_above(upright, tracks),
    }


class _Seen(NamedTuple):
    """Observations of one image: position, reprojection error and resolution."""

    name: str
    size: tuple[int, int]
    xy_px: Array
    residual_px: Array
    gsd: float | None


def _observe(camera: pycolmap.Camera, image: pycolmap.Image, place: Mapping[int, Array]) -> _Seen:
    """``place``: (3,) by a point's number."""
    observed = image.get_observation_points2D()
    xy_px = np.array([p.xy for p in observed], dtype=np.float64).reshape(-1, 2)
    xyz = np.array([place[p.point3D_id] for p in observed]).reshape(-1, 3)
    pose = image.cam_from_world()
    in_cam = xyz @ pose.rotation.matrix().T + pose.translation
    ahead = in_cam[:, 2] > 0
    residual = xy_px[ahead] - np.array(camera.img_from_cam(in_cam[ahead])).reshape(-1, 2)
    finite = np.isfinite(residual).all(axis=1)
    focal = camera.mean_focal_length()
    gsd = float(np.median(in_cam[ahead, 2]) / focal) if ahead.any() and focal > 0 else None
    return _Seen(image.name, (camera.width, camera.height), xy_px[ahead][finite], residual[finite], gsd)


def _rms(residual_px: Array) -> float | None:
    return float(np.sqrt(np.mean(np.sum(residual_px**2, axis=1)))) if len(residual_px) else None


def _choose_cameras(reconstruction: pycolmap.Reconstruction, image_ids: list[int]) -> list[int]:
    used = [reconstruction.image(i).camera_id for i in image_ids]
    return sorted(set(used), key=lambda i: (-used.count(i), i))[: SIZES.cameras]


def _describe_camera(
    reconstruction: pycolmap.Reconstruction, camera_id: int, image_ids: list[int], sigma: Array | None
) -> dict[str, Any]:
    """Intrinsics, field of view, and the shift of points by the lens relative to a pinhole camera."""
    camera = reconstruction.camera(camera_id)
    names = [name.strip() for name in camera.params_info.split(",")]
    count = SIZES.distortion_points
    x, y = ((np.arange(count) + 0.5) * side / count for side in (camera.width, camera.height))
    at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.array(camera.cam_from_img(at)).reshape(-1, 2)
    matrix = np.array(camera.calibration_matrix())
    pinhole = rays @ matrix[:2, :2].T + matrix[:2, 2]
    good = np.isfinite(pinhole).all(axis=1)
    focal = camera.mean_focal_length()
    field = [float(np.degrees(2 * np.arctan(0.5 * side / focal))) for side in (camera.width, camera.height)]
    return {
        "camera_id": camera_id,
        "model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "images": sum(reconstruction.image(i).camera_id == camera_id for i in image_ids),
        "params": dict(zip(names, (float(p) for p in camera.params), strict=True)),
        "sigma": {n: float(s) for n, s in zip(names, () if sigma is None else sigma, strict=False) if np.isfinite(s)},
        "field_of_view_deg": round_values(np.array(field), 2),
        "distortion": {
            "at_px": np.round(at[good], 1).tolist(),
            "shift_px": np.round((at - pinhole)[good], 3).tolist(),
        },
    }


def _average_over_sensor(seen: list[_Seen]) -> dict[str, Any] | None:
    """Mean residual over the sensor, of the images of the commonest size."""
    sizes = [s.size for s in seen if len(s.xy_px)]
    if not sizes:
        return None
    width, height = max(sorted(set(sizes)), key=sizes.count)
    those = [s for s in seen if s.size == (width, height)]
    xy, residual = np.concatenate([s.xy_px for s in those]), np.concatenate([s.residual_px for s in those])
    step = max(width, height) / SIZES.sensor_cells
    columns, rows = int(np.ceil(width / step)), int(np.ceil(height / step))
    column, row = (np.clip((xy[:, k] / step).astype(np.intp), 0, n - 1) for k, n in ((0, columns), (1, rows)))
    cell, cells = row * columns + column, rows * columns
    count = np.bincount(cell, minlength=cells)
    sums = [np.bincount(cell, weights=w, minlength=cells) for w in (*residual.T, np.sum(residual**2, axis=1))]
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, rms = sums[0] / count, sums[1] / count, np.sqrt(sums[2] / count)
    return {
        "width": width,
        "height": height,
        "columns": columns,
        "rows": rows,
        "count": count.tolist(),
        "mean_x_px": _round_known(x),
        "mean_y_px": _round_known(y),
        "rms_px": _round_known(rms),
    }


def _round_known(values: Array) -> list[float | None]:
    return [round(float(v), 3) if np.isfinite(v) else None for v in values]


def _measure_extent(upright: Array) -> list[float] | None:
    """(3,) how far nearly all points reach, along x, y and up."""
    if not len(upright):
        return None
    low, high = np.percentile(upright, [SIZES.outside_pct, 100 - SIZES.outside_pct], axis=0)
    return [round(float(v), 4) for v in high - low]


def _count_from_above(upright: Array, tracks: list[Any]) -> dict[str, Any] | None:
    """Images that see each square of the ground, from above."""
    if len(upright) < 2:
        return None
    low, high = (np.percentile(upright[:, :2], pct, axis=0) for pct in (SIZES.outside_pct, 100 - SIZES.outside_pct))
    step = float((high - low).max()) / SIZES.ground_cells
    if not step > 0:
        return None
    columns, rows = (int(n) for n in np.ceil((high - low) / step).astype(np.intp).clip(1))
    place = ((upright[:, :2] - low) / step).astype(np.intp)
    inside = np.flatnonzero(np.all((upright[:, :2] >= low) & (upright[:, :2] <= high), axis=1))
    seen: dict[tuple[int, int], set[int]] = {}
    for i in inside[stride_indices(len(inside), 60_000)].tolist():
        key = (min(int(place[i, 1]), rows - 1), min(int(place[i, 0]), columns - 1))
        seen.setdefault(key, set()).update(element.image_id for element in tracks[i].elements)
    counts: IndexArray = np.zeros((rows, columns), dtype=np.intp)
    for key, by in seen.items():
        counts[key] = len(by)
    return {
        "x0": round(float(low[0]), 4),
        "y0": round(float(low[1]), 4),
        "step": step,
        "images": counts.tolist(),
    }


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
    ``scene`` as ``colmap_inertial.report`` describes it.
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
    some = stride_indices(len(centres), SIZES.scene_cameras)
    poses = stride_indices(len(centres), SIZES.scene_poses)
    shown = np.concatenate([xyz, centres])
    size = float(np.ptp(shown, axis=0).max()) if len(shown) else 0.0
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
    for i in np.array(ids)[stride_indices(len(ids), 6 * SIZES.scene_points)].tolist() if ids else []:
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
    near = near[stride_indices(len(near), SIZES.scene_points)]
    return xyz[near], np.array([chosen[i].color for i in near], dtype=np.uint8).reshape(-1, 3)
