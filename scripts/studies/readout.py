"""Readout estimation on points filmed with a rolling shutter: error and coverage.

    python -m scripts.studies.readout [--motions orbit roam walk pure_rotation] [--readouts-ms 0 10 20 33] [--seeds 3]
                                    [--first-seed 0] [--seconds 5] [--hz 30] [--direction down]
                                    [--axes-sigma-deg 0.6] [--distortion 0] [--json study.json]

The simulator's motion, a desk or a room of points, corners to a fifth of a pixel of 640, one in twenty of them wrong; a
gyroscope of 200 Hz with noise, bias and gain, axes and clock as an alignment leaves them (where a camera moves as much
as it turns: ``--axes-sigma-deg 8``). ``--distortion`` of the lens is not known to the estimate. Prints errors in
milliseconds and in the standard deviations that were stated.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import ReadoutDirection
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.motion.flow import Tracks, VisualRotation
from colmap_inertial.motion.shutter import ReadoutEstimate, estimate_readout
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.motion import MotionKind
from scripts.common.bench_report import write_report

#: Focal length as a share of the width, height as one; corners of a pair, and how well they are seen.
FOCAL, ASPECT, CORNERS, CORNER_PX, LONG_SIDE_PX, WRONG, WRONG_PX = 0.8, 0.75, 60, 0.2, 640, 0.05, 5.0
POINTS, GYRO_HZ = 1500, 200.0
CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))


@dataclass(frozen=True, kw_only=True)
class Film:
    """What is filmed."""

    motion: MotionKind
    readout_s: float
    seed: int
    seconds: float = 5.0
    frames_hz: float = 30.0
    vigour: float = 1.0
    direction: ReadoutDirection = "down"
    axes_sigma_deg: float = 0.6
    #: Radial distortion that nobody knows of.
    distortion: float = 0.0

    def run(self) -> ReadoutEstimate:
        return estimate_readout(*self.seen())

    def seen(self) -> tuple[VisualRotation, GyroCamera]:
        rng = np.random.default_rng(self.seed)
        options = MotionOptions(kind=self.motion, duration_s=self.seconds, vigour=self.vigour)
        motion = make_motion(options, rng)
        points = world(self.motion, rng)
        if self.motion == "pure_rotation":
            points = points + motion.cam_in_world_m(np.array([1.0]))
        t_s = np.arange(0.3, self.seconds - 0.3, 1 / self.frames_hz)
        noise = CORNER_PX / LONG_SIDE_PX / FOCAL
        tracks: list[Tracks] = []
        before = self.picture(motion, points, t_s[0])
        for time_s in t_s[1:]:
            now = self.picture(motion, points, time_s)
            both = rng.permutation(np.flatnonzero(np.isfinite(before + now).all(axis=1)))[:CORNERS]
            rays = np.stack([before[both], now[both]], axis=1)
            rays += noise * rng.standard_normal(rays.shape)
            wrong = rng.random(len(rays)) < WRONG
            rays[wrong, 1] += WRONG_PX / CORNER_PX * noise * rng.standard_normal((int(wrong.sum()), 2))
            tracks.append(Tracks(place=(rays * FOCAL / [1, ASPECT])[..., ::-1], rays=rays))
            before = now
        none = np.zeros((len(tracks), 3))
        rotation = VisualRotation(
            names=tuple(map(str, range(len(t_s)))),
            t_s=t_s,
            turn_rad=none,
            sigma_rad=np.ones(len(none)),
            support=np.zeros(len(none), dtype=np.intp),
            tracks=tuple(tracks),
        )
        gyro_s = np.arange(-1, self.seconds + 1, 1 / GYRO_HZ)
        rate = 1.003 * motion.rate_in_cam_rad_s(gyro_s) @ matrix_from_quat(CAM_FROM_IMU)
        rate = rate + 0.003 * (rng.standard_normal(3) + rng.standard_normal(rate.shape))
        turned = quat_multiply(quat_exp(np.radians(self.axes_sigma_deg) * rng.standard_normal(3)), CAM_FROM_IMU)
        path = GyroPath(gyro_s, rate, np.zeros(3))
        return rotation, GyroCamera(path=path, cam_from_imu_xyzw=turned, offset_s=0.003 * rng.standard_normal())

    def picture(self, motion: Motion, points: Array, t_s: float) -> Array:
        """(N, 2) rays of the points, each as its line saw it; NaN outside of the picture."""
        at_s = np.full(len(points), t_s)
        for _ in range(4):
            state = motion.at(at_s)
            seen = np.einsum("nji,nj->ni", matrix_from_quat(state.world_from_cam_xyzw), points - state.cam_in_world_m)
            rays = seen[:, :2] / np.where(seen[:, 2:] > 0.1, seen[:, 2:], np.nan)
            place = rays * FOCAL / [1, ASPECT]
            line = place[:, int(self.direction in ("down", "up"))] * (1 if self.direction in ("down", "right") else -1)
            at_s = t_s + self.readout_s * np.clip(np.nan_to_num(line, nan=9.0), -0.7, 0.7)
        bent = rays * (1 + self.distortion * np.sum(rays**2, axis=1, keepdims=True))
        return np.where((np.abs(place) < 0.5).all(axis=1, keepdims=True), bent, np.nan)


def world(motion: MotionKind, rng: np.random.Generator) -> Array:
    """(N, 3) points about the origin: a desk in a room, a room, a corridor, or far away."""
    if motion == "pure_rotation":
        return 50 * rng.standard_normal((POINTS, 3))
    points = rng.uniform(-1, 1, (POINTS, 3))
    axis = rng.integers(0, 3, POINTS)
    points[np.arange(POINTS), axis] = rng.choice([-1.0, 1.0], POINTS)
    if motion == "orbit":
        desk = rng.uniform(-1, 1, (POINTS // 2, 3)) * [0.8, 0.55, 0.15]
        return np.concatenate([desk, 2.5 * points[: POINTS // 2]])
    return points * [19.0 if motion == "walk" else 3.2, 2.8, 1.4]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", nargs="+", default=["orbit", "roam", "walk", "pure_rotation"])
    parser.add_argument("--readouts-ms", nargs="+", type=float, default=[0.0, 10.0, 20.0, 33.0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--hz", type=float, default=30.0, help="frames a second")
    parser.add_argument("--direction", choices=get_args(ReadoutDirection), default="down")
    parser.add_argument("--axes-sigma-deg", type=float, default=0.6)
    parser.add_argument("--distortion", type=float, default=0.0)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    rows = []
    print(f"{'motion':<14} {'readout':>8} {'found':>3} error ms (rms)  stated ms (median)  rms z  worst z")
    for motion in asked.motions:
        for readout_ms in asked.readouts_ms:
            some = []
            for seed in range(asked.first_seed, asked.first_seed + asked.seeds):
                film = Film(
                    motion=motion,
                    readout_s=1e-3 * readout_ms,
                    seed=seed,
                    seconds=asked.seconds,
                    frames_hz=asked.hz,
                    direction=asked.direction,
                    axes_sigma_deg=asked.axes_sigma_deg,
                    distortion=asked.distortion,
                )
                try:
                    found = film.run()
                except NotObservableError as error:
                    rows.append({**asdict(film), "refused": error.hint})
                    continue
                some.append((found.readout_s - film.readout_s, found.sigma_s))
                rows.append({**asdict(film), "found": asdict(found)})
            errors, sigmas = np.array(some).reshape(-1, 2).T
            z = errors / sigmas
            share = f"{len(some)}/{asked.seeds}"
            print(f"{motion:<14} {readout_ms:>5.1f} ms {share:>5}", end=" ")
            if len(some):
                rms = 1e3 * np.sqrt(np.mean(errors**2))
                print(f"{rms:>14.2f} {1e3 * np.median(sigmas):>19.2f}", end=" ")
                print(f"{np.sqrt(np.mean(z**2)):>6.1f} {np.abs(z).max():>8.1f}", end="", flush=True)
            print()
    if asked.json is not None:
        write_report(asked.json, {"rows": rows})


if __name__ == "__main__":
    main()
