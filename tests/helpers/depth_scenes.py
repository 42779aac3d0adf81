"""Depth maps of a room with boxes, by intersecting rays with planes: a truth that knows nothing of the estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_exp
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.depth import DepthMap, DepthMaps, PinholeGrid

VIEW = PinholeGrid(width=96, height=72, focal_px=(70.0, 70.0), centre_px=(48.3, 35.6))
#: Corners of boxes, least and largest, metres; the first is the room, seen from inside.
ROOM = (
    ((-2.0, -1.4, -2.5), (2.2, 1.1, 2.6)),
    ((0.7, 0.2, 1.2), (1.4, 1.1, 1.9)),
    ((-1.5, -0.3, 0.8), (-0.9, 1.1, 1.6)),
    ((-0.3, 0.6, 1.5), (0.3, 1.1, 2.1)),
)


def cast(origin: np.ndarray, rays: np.ndarray, boxes=ROOM) -> np.ndarray:
    """(...,) distance along rays to the first wall, in lengths of the ray."""
    best = np.full(rays.shape[:-1], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, (low, high) in enumerate(boxes):
            near, far = (np.array(low) - origin) / rays, (np.array(high) - origin) / rays
            enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
            hit = leave if i == 0 else np.where((enter > 0) & (enter < leave), enter, np.inf)
            best = np.minimum(best, hit)
    return best


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Errors of a depth sensor."""

    factor: float = 1.0
    noise_m: float = 0.004
    flying: float = 0.5
    farthest_m: float = 4.0


def walk(count: int, seed: int, *, turn: float = 0.35) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) cam_from_world and (N, 3) centres of a hand that moves about in the room, metres."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, count)
    phases, rates = rng.uniform(0, 2 * np.pi, (2, 3)), rng.uniform(1.0, 2.2, (2, 3))
    centres = np.stack([0.6 * np.sin(2 * np.pi * rates[0, k] * t + phases[0, k]) for k in range(3)], axis=1)
    centres *= (1.0, 0.5, 0.8)
    turns = np.stack([turn * np.sin(2 * np.pi * rates[1, k] * t + phases[1, k]) for k in range(3)], axis=1)
    return np.array([quat_from_matrix(so3_exp(turn)) for turn in turns]), centres


def record(
    count: int = 50,
    seed: int = 0,
    *,
    unit_m: float = 1.0,
    pose_m: float = 0.002,
    pose_rad: float = 0.001,
    sensor: Sensor = Sensor(),
    boxes=ROOM,
    path: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[DepthMaps, CameraTrajectory]:
    """Depth maps and a path that counts in units of ``unit_m`` metres."""
    rng = np.random.default_rng(1000 + seed)
    xyzw, centres = walk(count, seed) if path is None else path
    maps: dict[str, DepthMap] = {}
    rays = VIEW.rays()
    for k, (pose, centre) in enumerate(zip(matrix_from_quat(xyzw), centres, strict=True)):
        depth_m = cast(centre, rays @ pose, boxes)
        depth_m = sensor.factor * depth_m + sensor.noise_m * rng.normal(size=depth_m.shape)
        # at edges the sensor sees both surfaces, and says something between
        mixed = np.abs(depth_m - np.roll(depth_m, 1, axis=1)) > 0.1
        share = rng.uniform(0, 1, depth_m.shape)
        flies = mixed & (rng.uniform(size=depth_m.shape) < sensor.flying)
        depth_m = np.where(flies, share * depth_m + (1 - share) * np.roll(depth_m, 1, axis=1), depth_m)
        depth_m[depth_m > sensor.farthest_m] = np.nan
        maps[f"{k:06d}"] = DepthMap(depth_m=depth_m, view=VIEW)
    turned = np.array(
        [
            quat_from_matrix(so3_exp(e) @ m)
            for e, m in zip(pose_rad * rng.normal(size=(count, 3)), matrix_from_quat(xyzw), strict=True)
        ]
    )
    trajectory = CameraTrajectory(
        names=tuple(maps),
        t_s=np.linspace(0, 20, count),
        cam_from_world_xyzw=turned,
        cam_in_world=(centres + pose_m * rng.normal(size=(count, 3))) / unit_m,
    )
    return DepthMaps(names=tuple(maps), read=maps.__getitem__, source="room"), trajectory
