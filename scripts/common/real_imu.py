"""Recordings of real IMUs with motion capture, made into what a reconstruction gives: for
``scripts/studies/scale_real.py``.

The poses of the motion capture stand for those of a reconstruction: moved to the camera, thinned to the rate of a
video, with errors such as a reconstruction has, in units and axes of their own and on a clock of their own.
"""

from __future__ import annotations

import functools
import lzma
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_exp
from colmap_inertial.core.types import CameraTrajectory, ImuRecording

#: Camera in the body (the IMU) of the two rigs: rotation, position in metres.
HANDHELD = (
    np.array([[-0.99953, 0.02962, -0.00852], [0.00750, -0.03440, -0.99938], [-0.02989, -0.99897, 0.03416]]),
    np.array([0.04723, -0.04744, -0.06820]),
)
FLOWN = (
    np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    ),
    np.array([-0.0216401454975, -0.064676986768, 0.00981073058949]),
)
#: Name, rig, every how many poses of the motion capture there is a frame (20 to 30 a second).
RECORDINGS = {
    "room1": (HANDHELD, 5),
    "room3": (HANDHELD, 5),
    "room5": (HANDHELD, 5),
    "V102": (FLOWN, 8),
    "V201": (FLOWN, 8),
    "MH03": (FLOWN, 8),
}
#: Errors of rotations: a correlated part and half as much white.
ROTATION_RAD = float(np.radians(0.07))
#: Largest difference of the clocks, and how much of the IMU is recorded before and after the video.
LARGEST_OFFSET_S, MARGIN_S = 900.0, 5.0


@dataclass(frozen=True, kw_only=True)
class Window:
    """A part of a recording, and the errors that its poses get. ``length_s`` is infinite for the whole of it."""

    recording: str
    length_s: float
    begin_s: float
    end_s: float
    noise_m: float
    correlation_s: float
    seed: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A recording as it is: camera poses in metres, and the IMU on the same clock (seconds since its first sample)."""

    t_s: Array
    world_from_cam: Array
    cam_in_world_m: Array
    imu_t_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array


def _lines(path: Path) -> list[str]:
    """A table's rows, without its comments."""
    with lzma.open(path, "rt") as file:
        return [line for line in file if line[0] != "#"]


@functools.lru_cache
def read(folder: Path, name: str, *, whole: bool = False) -> Motion:
    """One of ``RECORDINGS`` below a folder; ``whole`` with every pose of the motion capture."""
    (body_from_cam, cam_in_body_m), every = RECORDINGS[name]
    every = 1 if whole else every
    lines = _lines(folder / f"{name}_imu.csv.xz")
    imu = np.loadtxt(lines, delimiter=",")
    stamps = np.array([int(line.partition(",")[0]) for line in lines])
    origin_ns = int(stamps[0])
    table = folder / f"{name}_gt.csv.xz"
    if table.exists():
        lines = _lines(table)
        rows = np.loadtxt(lines, delimiter=",")
        nanoseconds = np.array([int(line.partition(",")[0]) for line in lines])
        quat = rows[:, [5, 6, 7, 4]]
    else:
        lines = _lines(folder / f"{name}_gt.txt.xz")
        rows = np.loadtxt(lines)
        whole, part = np.array([line.split()[0].split(".") for line in lines]).T
        nanoseconds = whole.astype(np.int64) * 10**9 + np.array([int(p.ljust(9, "0")) for p in part])
        quat = rows[:, 4:8]
    t_s = (nanoseconds - origin_ns) * 1e-9
    t_s, quat, position = t_s[::every], quat[::every], rows[::every, 1:4]
    imu_t_s = (stamps - origin_ns) * 1e-9
    inside = (t_s > imu_t_s[0] + 0.1) & (t_s < imu_t_s[-1] - 0.1)
    t_s, position = t_s[inside], position[inside]
    world_from_imu = matrix_from_quat(quat[inside] / np.linalg.norm(quat[inside], axis=1)[:, None])
    return Motion(
        t_s=t_s,
        world_from_cam=world_from_imu @ body_from_cam,
        cam_in_world_m=position + world_from_imu @ cam_in_body_m,
        imu_t_s=imu_t_s,
        gyro_rad_s=imu[:, 1:4],
        accel_m_s2=imu[:, 4:7],
    )


def windows(
    folder: Path, lengths_s: tuple[float, ...], noises_m: tuple[float, ...], *, most: int = 10, first: int = 0
) -> list[Window]:
    """Windows of each length spread over each recording, no two overlapping, at most so many, at each noise."""
    out = []
    for name in RECORDINGS:
        t_s = read(folder, name).t_s
        for length_s in lengths_s:
            span_s = t_s[-1] - t_s[0]
            count = 1 if np.isinf(length_s) else min(most, int(span_s // length_s))
            begins = [t_s[0]] if np.isinf(length_s) else t_s[0] + np.linspace(0, span_s - length_s, count)
            for i, begin_s in enumerate(begins):
                frames = np.sum((t_s >= begin_s) & (t_s < begin_s + length_s))
                usual = np.median(np.diff(t_s))
                if not np.isinf(length_s) and frames < 0.7 * length_s / usual:
                    continue  # the motion capture lost the rig
                for j, noise_m in enumerate(noises_m):
                    number = len(out) + first
                    out.append(
                        Window(
                            recording=name,
                            length_s=length_s,
                            begin_s=float(begin_s),
                            end_s=float(min(begin_s + length_s, t_s[-1] + 1e-6)),
                            noise_m=noise_m,
                            correlation_s=(0.1, 0.35, 1.0)[(i + j) % 3],
                            seed=number,
                        )
                    )
    return out


def correlated(rng: np.random.Generator, t_s: Array, correlation_s: float) -> Array:
    """(N, 3) errors of unit variance that are alike over ``correlation_s`` (first-order Gauss-Markov)."""
    drawn = rng.standard_normal((len(t_s), 3))
    step_s = np.diff(t_s)
    keep = np.exp(-step_s / correlation_s)
    out = np.empty_like(drawn)
    out[0] = drawn[0]
    for i in range(1, len(t_s)):
        out[i] = keep[i - 1] * out[i - 1] + np.sqrt(1 - keep[i - 1] ** 2) * drawn[i]
    return out


def recorded(folder: Path, window: Window) -> tuple[CameraTrajectory, ImuRecording, float]:
    """What the estimator gets of a window, and the true metres per unit."""
    return reconstructed(read(folder, window.recording), window)


def reconstructed(
    motion: Motion, window: Window, *, margin_s: float = MARGIN_S
) -> tuple[CameraTrajectory, ImuRecording, float]:
    """The same of any motion, with so much of the IMU before and after the frames."""
    rng = np.random.default_rng([7, window.seed])
    keep = (motion.t_s >= window.begin_s) & (motion.t_s < window.end_s)
    t_s, n = motion.t_s[keep], int(keep.sum())
    metres_per_unit = float(np.exp(rng.uniform(np.log(0.1), np.log(10.0))))
    model_from_world = so3_exp(rng.standard_normal(3) * 2)
    offset_s = float(rng.uniform(-LARGEST_OFFSET_S, LARGEST_OFFSET_S))
    centre = motion.cam_in_world_m[keep]
    rotation = motion.world_from_cam[keep]
    if window.noise_m > 0:
        white = 0.5 * rng.standard_normal((n, 3))
        centre = centre + window.noise_m * (correlated(rng, t_s, window.correlation_s) + white)
        white = 0.5 * rng.standard_normal((n, 3))
        rotation = rotation @ so3_exp(ROTATION_RAD * (correlated(rng, t_s, window.correlation_s) + white))
    centre = (centre @ model_from_world.T) / metres_per_unit + rng.standard_normal(3)
    cam_from_world = (model_from_world @ rotation).transpose(0, 2, 1)
    names = tuple(map(str, range(n)))
    trajectory = CameraTrajectory(
        names=names, t_s=t_s, cam_from_world_xyzw=quat_from_matrix(cam_from_world), cam_in_world=centre
    )
    near = (motion.imu_t_s >= t_s[0] - margin_s) & (motion.imu_t_s <= t_s[-1] + margin_s)
    imu = ImuRecording(
        gyro_t_s=motion.imu_t_s[near] - offset_s,
        gyro_rad_s=motion.gyro_rad_s[near],
        accel_t_s=motion.imu_t_s[near] - offset_s,
        accel_m_s2=motion.accel_m_s2[near],
    )
    return trajectory, imu, metres_per_unit
