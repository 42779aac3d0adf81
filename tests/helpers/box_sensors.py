"""What a phone's other sensors would have said in the box: depth by its closed form, and a path that is too short."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_from_matrix, quat_multiply, so3_exp
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.io.trajectories import write_tum
from tests.helpers.box_project import FOCAL, HEIGHT, WIDTH, BoxProject, cast, rays

#: Depth maps are half as large as the images.
SMALLER = 2


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """Of a depth sensor: a factor on all depths, noise, and pixels that show nothing or something else (shares)."""

    factor: float = 1.0
    noise_m: float = 0.01
    unknown: float = 0.1
    wrong: float = 0.05


def write_depth(box: BoxProject, folder: Path, errors: DepthErrors = DepthErrors(), seed: int = 0) -> None:
    """16-bit PNG in millimetres, named as the images."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    width, height = WIDTH // SMALLER, HEIGHT // SMALLER
    params = (FOCAL / SMALLER, FOCAL / SMALLER, width / 2, height / 2)
    motion, t_s = box.recording.truth.motion, box.recording.trajectory.t_s
    for i, name in zip(box.frames, box.names, strict=True):
        t = t_s[i : i + 1]
        turn, centre = matrix_from_quat(motion.world_from_cam_xyzw(t))[0], motion.cam_in_world_m(t)[0]
        depth_m, _ = cast(turn, centre, rays(width, height, params))
        depth_m = errors.factor * depth_m + errors.noise_m * rng.normal(size=depth_m.shape)
        depth_m[: round(errors.wrong * height)] *= 1.5  # a pane of glass
        depth_m[:, : round(errors.unknown * width)] = 0.0
        cv2.imwrite(str(folder / f"{Path(name).stem}.png"), np.rint(1000 * depth_m).astype(np.uint16))


@dataclass(frozen=True, kw_only=True)
class PathErrors:
    """Of a device's own path: a factor on its lengths, a random walk, and a jump in the middle."""

    factor: float = 1.0
    walk_m: float = 0.002
    jump_m: float = 0.0


def device_path(box: BoxProject, errors: PathErrors = PathErrors(), seed: int = 0) -> CameraTrajectory:
    """The true path in a world of its own, turned about y, which is against gravity (ARKit's)."""
    rng = np.random.default_rng(seed)
    trajectory = box.recording.trajectory
    motion = box.recording.truth.motion
    t_s = trajectory.t_s[box.frames]
    # z-up to y-up, then by some heading
    turn = so3_exp(np.array([0.0, 0.7, 0.0])) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    centres = errors.factor * motion.cam_in_world_m(t_s) @ turn.T
    centres = centres + np.cumsum(errors.walk_m * rng.normal(size=centres.shape), axis=0)
    centres[len(centres) // 2 :] += (errors.jump_m, 0.0, 0.0)
    world_from_cam = quat_multiply(
        np.broadcast_to(quat_from_matrix(turn), (len(t_s), 4)), motion.world_from_cam_xyzw(t_s)
    )
    return CameraTrajectory(
        names=tuple(box.names),
        t_s=t_s,
        cam_from_world_xyzw=quat_conjugate(world_from_cam),
        cam_in_world=centres,
        epoch_ns=trajectory.epoch_ns,
        length_unit="m",
    )


def write_capture(
    box: BoxProject,
    folder: Path,
    *,
    imu: bool = True,
    depth: DepthErrors | None = None,
    path: PathErrors | None = None,
    seed: int = 0,
) -> Path:
    """A capture.toml beside the box, with what was recorded."""
    folder.mkdir(parents=True)
    rows = [f"{name},{t_ns}" for name, t_ns in zip(box.names, box.t_ns(), strict=True)]
    (folder / "frames.csv").write_text("name,t_ns\n" + "\n".join(rows) + "\n")
    lines = [
        "[images]",
        f'folder = "{box.root / "images"}"',
        'times = "frames.csv"',
        "[timing]",
        "readout_s = 0.0",
        "[camera]",
        'model = "PINHOLE"',
        f"width = {WIDTH}",
        f"height = {HEIGHT}",
        'pixel_origin = "corner"',
        f"params = [{FOCAL}, {FOCAL}, {WIDTH / 2}, {HEIGHT / 2}]",
    ]
    if imu:
        lines += ["[imu]", f'path = "{box.imu}"']
    if path is not None:
        write_tum(folder / "device.tum", device_path(box, path, seed))
        lines += ["[poses]", 'path = "device.tum"', 'up = "y"']
    if depth is not None:
        write_depth(box, folder / "depth", depth, seed)
        lines += ["[depth]", 'folder = "depth"', 'unit = "mm"']
    (folder / "capture.toml").write_text("\n".join(lines) + "\n")
    return folder / "capture.toml"
