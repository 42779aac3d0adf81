"""What a rolling shutter does to two views, and what rectified keypoints leave of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.rolling_shutter import rectify_keypoints
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import colmap_camera
from scripts.common.imaging_scenes import CAM_FROM_IMU, GYRO_HZ, GYRO_NOISE_RAD_S, lens

READOUT_S, RATE_RAD_S, DURATION_S = 0.025, 1.0, 30.0
#: Points that both frames see, their depths, and how well they are located.
POINTS, DEPTH_M, NOISE_PX = 500, (2.0, 8.0), 0.5
#: Between the frames: seconds, metres, degrees.
APART_S, APART_M, APART_DEG = (0.1, 1.5), (0.15, 0.8), 25.0


def two_views(count: int, seed: int) -> dict[str, Any]:
    """Rotation and inliers of COLMAP's calibrated two-view geometry (its defaults) before and after rectification.

    A walking hand turns at 1 rad/s in both frames; points lie at random depths and are seen exactly as a shutter with
    25 ms readout does, translation included, with half a pixel of noise. All matches are right, so that the share of
    inliers would be 1. Rotation is that between the two reference instants (mid-exposure of the middle row).
    """
    model = lens(1920, 1080)
    camera = colmap_camera(model)
    found: dict[str, list[tuple[float, float, float]]] = {"as filmed": [], "rectified": []}
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        motion, shutters = _two_frames(rng)
        views = _points(motion, shutters, rng)
        gyro = _gyro(motion, rng)
        rectified = [rectify_keypoints(v, gyro, camera, s) for v, s in zip(views, shutters, strict=True)]
        for name, points in (("as filmed", views), ("rectified", rectified)):
            found[name].append(_errors(camera, points, motion, shutters))
    out: dict[str, Any] = {"pairs": count, "readout_s": READOUT_S, "rate_rad_s": RATE_RAD_S}
    for name, rows in found.items():
        rotation, direction, inliers = np.array(rows).T
        out[name] = {
            "rotation_deg": float(np.median(rotation)),
            "rotation_deg_90th": float(np.percentile(rotation, 90)),
            "direction_deg": float(np.median(direction)),
            "inliers": float(np.mean(inliers)),
        }
    return out


def _two_frames(rng: np.random.Generator) -> tuple[Motion, list[FrameShutter]]:
    while True:
        motion = make_motion(MotionOptions(kind="roam", duration_s=DURATION_S), rng)
        t = np.arange(0.2, DURATION_S - 0.2, 1 / 60)
        middle = t + 0.5 * READOUT_S
        good = np.flatnonzero(
            np.abs(np.linalg.norm(motion.rate_in_cam_rad_s(middle), axis=1) - RATE_RAD_S) < 0.1 * RATE_RAD_S
        )
        a, b = np.meshgrid(good, good, indexing="ij")
        apart_m = np.linalg.norm(
            motion.cam_in_world_m(middle[a.ravel()]) - motion.cam_in_world_m(middle[b.ravel()]), axis=1
        )
        looking = matrix_from_quat(motion.world_from_cam_xyzw(middle[good]))
        apart_deg = np.degrees(
            np.arccos(np.clip(0.5 * (np.einsum("aij,bij->ab", looking, looking) - 1), -1, 1))
        ).ravel()
        apart_s = t[b.ravel()] - t[a.ravel()]
        suits = (apart_s > APART_S[0]) & (apart_s < APART_S[1]) & (apart_deg < APART_DEG)
        suits &= (apart_m > APART_M[0]) & (apart_m < APART_M[1])
        chosen = np.flatnonzero(suits)
        if len(chosen):
            pick = rng.choice(chosen)
            starts = t[a.ravel()[pick]], t[b.ravel()[pick]]
            return motion, [
                FrameShutter(width=1920, height=1080, t_s=float(s), exposure_s=0.0, readout_s=READOUT_S) for s in starts
            ]


def _gyro(motion: Motion, rng: np.random.Generator) -> GyroCamera:
    t = np.arange(0.0, DURATION_S, 1 / GYRO_HZ)
    rate = motion.rate_in_cam_rad_s(t)
    rate = rate + GYRO_NOISE_RAD_S * rng.standard_normal(rate.shape)
    path = GyroPath(t, rate @ matrix_from_quat(CAM_FROM_IMU), np.zeros(3))
    return GyroCamera(path=path, cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=0.0)


def _points(motion: Motion, shutters: list[FrameShutter], rng: np.random.Generator) -> list[Array]:
    """(POINTS, 2) what each frame sees of the same points."""
    camera = colmap_camera(lens(1920, 1080))
    pixels = rng.uniform([0, 0], [1920, 1080], (8 * POINTS, 2))
    rays = np.concatenate([np.asarray(camera.cam_from_img(pixels))[:, :2], np.ones((len(pixels), 1))], axis=1)
    depth = np.exp(rng.uniform(*np.log(DEPTH_M), len(pixels)))
    at = np.full(len(pixels), shutters[0].reference_s())
    world = np.einsum("nij,nj->ni", matrix_from_quat(motion.world_from_cam_xyzw(at)), rays * depth[:, None])
    world += motion.cam_in_world_m(at)
    views = [_seen(motion, shutter, world) for shutter in shutters]
    inside = np.all([((v > 0) & (v < [1920, 1080])).all(axis=1) for v in views], axis=0)
    chosen = np.flatnonzero(inside)[:POINTS]
    return [v[chosen] + NOISE_PX * rng.standard_normal((len(chosen), 2)) for v in views]


def _seen(motion: Motion, shutter: FrameShutter, world: Array) -> Array:
    """(N, 2) where a rolling shutter sees (N, 3) points: each at the instant of the line that it falls on."""
    camera = colmap_camera(lens(1920, 1080))
    found = np.tile([960.0, 540.0], (len(world), 1))
    for _ in range(10):
        t = shutter.middle_s(np.clip(found, -2000, 4000))
        turn = matrix_from_quat(motion.world_from_cam_xyzw(t))
        local = np.einsum("nji,nj->ni", turn, world - motion.cam_in_world_m(t))
        with np.errstate(invalid="ignore"):
            seen = np.asarray(camera.img_from_cam(local))
        found = np.where(np.isfinite(seen) & (local[:, 2:] > 0.1), seen, 1e4)
    return found


def _errors(
    camera: pycolmap.Camera, points: list[Array], motion: Motion, shutters: list[FrameShutter]
) -> tuple[float, float, float]:
    """Degrees of rotation and of the baseline's direction; share of inliers."""
    matches = np.tile(np.arange(len(points[0]), dtype=np.uint32)[:, None], (1, 2))
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    geometry = pycolmap.estimate_calibrated_two_view_geometry(camera, points[0], camera, points[1], matches, options)
    at = np.array([s.reference_s() for s in shutters])
    turn, centre = matrix_from_quat(motion.world_from_cam_xyzw(at)), motion.cam_in_world_m(at)
    true_rotation, true_shift = turn[1].T @ turn[0], turn[1].T @ (centre[0] - centre[1])
    pose = geometry.cam2_from_cam1.matrix()
    cosine = 0.5 * (np.trace(pose[:, :3].T @ true_rotation) - 1)
    along = pose[:, 3] @ true_shift / (np.linalg.norm(pose[:, 3]) * np.linalg.norm(true_shift))
    inliers = len(geometry.inlier_matches) / len(matches)
    return (*np.degrees(np.arccos(np.clip([cosine, along], -1, 1))).tolist(), inliers)
