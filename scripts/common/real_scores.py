"""How far a model, and what is said of it, lie from a filmed world's truth: for ``scripts/studies/refine_real.py``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, rotation_between, so3_exp, so3_log
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraMotion
from colmap_inertial.io.files import read_record
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import Model, trajectory_from_model
from colmap_inertial.run.stages.metric import gravity_in_model, metric_trajectory, motion_file, write_trajectory
from scripts.common.real_world import Filmed
from scripts.studies.check_euroc import similarity

#: Over so many seconds errors of the shape are told.
SPANS_S = (1.0, 5.0)
#: What the truth's positions err by.
TRUTH_M = 5e-4
#: 95 % quantile of chi-square with three degrees of freedom.
CHI2_95 = 7.815


def select_registered(model: Model, filmed: Filmed) -> Filmed:
    """What was filmed by the images that a model has: cameras that contradict the gyroscope are left out of it."""
    present = {model.reconstruction.image(number).name for number in model.reconstruction.reg_image_ids()}
    keep = np.array([name in present for name in filmed.timing.names])
    timing = filmed.timing
    names = tuple(name for name in timing.names if name in present)
    return replace(
        filmed,
        timing=replace(timing, names=names, t_s=timing.t_s[keep]),
        world_from_cam=filmed.world_from_cam[keep],
        centre_m=filmed.centre_m[keep],
        velocity_m_s=filmed.velocity_m_s[keep],
    )


def poses_of(model: Model, names: Sequence[str]) -> tuple[Array, Array]:
    """(N, 3, 3) world_from_cam and (N, 3) centres of images, by name; the model has all of them."""
    images = {image.name: image for image in map(model.reconstruction.image, model.reconstruction.reg_image_ids())}
    rotation = np.array([images[name].cam_from_world().rotation.matrix().T for name in names])
    return rotation, np.array([images[name].projection_center() for name in names])


def scores(model: Model, filmed: Filmed) -> dict[str, Any]:
    """Errors of a metric model, as it is written."""
    names, t_s = filmed.timing.names, filmed.timing.t_s
    rotation, centre = poses_of(model, names)
    scale, turn, shift = similarity(centre, filmed.centre_m)
    left = scale * centre @ turn.T + shift - filmed.centre_m
    third = len(centre) // 3
    first, last = (similarity(centre[p], filmed.centre_m[p])[0] for p in (slice(0, third), slice(-third, None)))
    off = so3_log(filmed.world_from_cam.transpose(0, 2, 1) @ turn @ rotation)
    gravity = gravity_in_model(model)
    assert gravity is not None and model.scale is not None
    down = turn @ gravity / np.linalg.norm(gravity)
    error_log, accepted = float(-np.log(scale)), model.scale.accepted
    out = {
        "path_mm": _rms_mm(left),
        "rotation_deg": np.degrees(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        "gravity_deg": np.degrees(np.arccos(np.clip(down @ filmed.down, -1, 1))),
        "drift_pct": 100 * (last / first - 1),
        "scale_pct": 100 * error_log,
        "scale_z": error_log / accepted.sigma_log,
        "inside": bool(abs(error_log) <= Z95 * accepted.sigma_log),
        "verdict": model.scale.verdict,
    }
    for span_s in SPANS_S:
        step = max(1, round(span_s / float(np.median(np.diff(t_s)))))
        moved = scale * np.einsum("nji,nj->ni", rotation[:-step], centre[step:] - centre[:-step])
        true = np.einsum("nji,nj->ni", filmed.world_from_cam[:-step], filmed.centre_m[step:] - filmed.centre_m[:-step])
        out[f"over_{span_s:g}_s_mm"] = _rms_mm(moved - true)
    return out


def covered(model: Model, filmed: Filmed) -> dict[str, float]:
    """Normalised squares of errors against covariances as they are written, a third; and of the velocity, mm/s."""
    poses, _ = trajectory_from_model(model.reconstruction, model.timing, covariances=model.motion is None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trajectory.tum"
        write_trajectory(path, model, metric_trajectory(poses), filmed.imu)
        written, motion = read_tum(path), read_record(motion_file(path), CameraMotion)
        with np.load(path.with_name("trajectory_cov.npz")) as file:
            told_s, cov, turned = file["t_s"], file["cov"], file["rotation_cov"]
    gravity = gravity_in_model(model)
    assert gravity is not None
    rotation = matrix_from_quat(written.cam_from_world_xyzw).transpose(0, 2, 1)
    off, position, turn = held(rotation, written.cam_in_world, filmed, gravity / np.linalg.norm(gravity))
    place = {round(1e4 * t): i for i, t in enumerate(filmed.timing.t_s.tolist())}
    of_cov = np.array([place[round(1e4 * t)] for t in told_s.tolist()])
    of_motion = np.array([place[round(1e4 * t)] for t in motion.t_s.tolist()])
    velocity = np.full_like(position, np.nan)
    velocity[of_motion] = motion.velocity_in_world_m_s - filmed.velocity_m_s[of_motion] @ turn.T
    known = (of_cov > 0) & np.isfinite(velocity[of_cov]).all(axis=1)
    at, cov = of_cov[known], cov[known]
    squares = {
        "position": nees(position[at], cov[:, :3, :3] + TRUTH_M**2 * np.eye(3)),
        "velocity": nees(velocity[at], cov[:, 3:6, 3:6]),
        "rotation": nees(off[at], turned[known]),
    }
    out = {"velocity_mm_s": _rms_mm(velocity[of_motion])}
    for name, one in squares.items():
        out |= {f"{name}_nees": float(np.mean(one)), f"{name}_inside": float(np.mean(3 * one < CHI2_95))}
    return out


def _rms_mm(error: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def held(rotation: Array, centre: Array, filmed: Filmed, down: Array) -> tuple[Array, Array, Array]:
    """Errors against the first camera's place and heading, the world's axes: rotation (rad), position, and its turn.

    The true world is turned so that gravity points down as the model has it and the first camera's heading is the
    model's.
    """
    turn = matrix_from_quat(rotation_between(filmed.down, down))
    for _ in range(5):
        turn = so3_exp(so3_log(rotation[0] @ (turn @ filmed.world_from_cam[0]).T) @ down * down) @ turn
    true = turn @ filmed.world_from_cam
    off = so3_log(rotation @ true.transpose(0, 2, 1))
    position = (centre - centre[0]) - (filmed.centre_m - filmed.centre_m[0]) @ turn.T
    return off, position, turn


def nees(error: Array, cov: Array) -> Array:
    """(N,) squares of (N, 3) errors over their covariances, a third."""
    return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0]) / 3)
