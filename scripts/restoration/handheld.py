"""How hands move cameras: turning and moving, from recordings or from the package's simulator."""

from __future__ import annotations

import lzma
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_normalize
from colmap_inertial.tools.simulate import MotionOptions, make_motion

#: Motion capture's places at 120 Hz are smoothed by this many samples: what lies above 15 Hz is its noise.
_SMOOTHED_SAMPLES = 1.2
_LONGEST_STEP_S, _SHORTEST_PIECE_S = 0.02, 3.0
_SIMULATED_HZ, _SIMULATED_S = 200.0, 60.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Handheld:
    """A stretch of motion without a gap: (N,) times, (N, 3) turning rad/s and velocity m/s, both in the body frame."""

    t_s: Array
    rate_rad_s: Array
    velocity_m_s: Array

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Rate and velocity at times of any shape."""
        flat = t_s.ravel()
        out = [
            np.stack([np.interp(flat, self.t_s, column) for column in values.T], axis=-1).reshape(*t_s.shape, 3)
            for values in (self.rate_rad_s, self.velocity_m_s)
        ]
        return out[0], out[1]


def recorded(folder: Path, name: str) -> list[Handheld]:
    """A recording's pieces without a gap: turning by its gyroscope, velocity by motion capture.

    TUM-VI's layout: ``NAME_imu.csv.xz`` t_ns, rate x, y, z, ... and ``NAME_gt.csv.xz`` t_ns, x, y, z, qw, qx, qy, qz.
    """
    imu, table = (_table(folder / f"{name}_{kind}.csv.xz") for kind in ("imu", "gt"))
    begin_ns = imu[0, 0]
    imu_s, t_s = (imu[:, 0] - begin_ns) * 1e-9, (table[:, 0] - begin_ns) * 1e-9
    cuts = np.flatnonzero(np.diff(t_s) > _LONGEST_STEP_S) + 1
    pieces = []
    for i in np.split(np.arange(len(t_s)), cuts):
        if t_s[i[-1]] - t_s[i[0]] < _SHORTEST_PIECE_S:
            continue
        place = gaussian_filter1d(table[i, 1:4], _SMOOTHED_SAMPLES, axis=0)
        world_from_body = table[i][:, [5, 6, 7, 4]]
        between = quat_normalize(world_from_body[:-1] + _same_side(world_from_body[:-1], world_from_body[1:]))
        body_from_world = np.swapaxes(matrix_from_quat(between), -1, -2)
        velocity = np.einsum("nij,nj->ni", body_from_world, np.diff(place, axis=0) / np.diff(t_s[i])[:, None])
        middle_s = 0.5 * (t_s[i][:-1] + t_s[i][1:])
        inside = (imu_s >= middle_s[0]) & (imu_s <= middle_s[-1])
        pieces.append(
            Handheld(
                t_s=imu_s[inside],
                rate_rad_s=imu[inside, 1:4],
                velocity_m_s=np.stack([np.interp(imu_s[inside], middle_s, v) for v in velocity.T], axis=-1),
            )
        )
    return pieces


def _table(path: Path) -> Array:
    with lzma.open(path, "rt") as file:
        return np.loadtxt([line for line in file if line[0] != "#"], delimiter=",")


def simulated(count: int, seed: int) -> list[Handheld]:
    """Walks through rooms by the simulator, a minute each."""
    out = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        motion = make_motion(MotionOptions(kind="roam", duration_s=_SIMULATED_S), rng)
        t_s = np.arange(0, _SIMULATED_S, 1 / _SIMULATED_HZ)
        state = motion.at(t_s)
        cam_from_world = np.swapaxes(matrix_from_quat(state.world_from_cam_xyzw), -1, -2)
        velocity = np.einsum("nij,nj->ni", cam_from_world, state.velocity_in_world_m_s)
        out.append(Handheld(t_s=t_s, rate_rad_s=state.rate_in_cam_rad_s, velocity_m_s=velocity))
    return out


def _same_side(a: Array, b: Array) -> Array:
    """Quaternions ``b`` with the sign that brings them close to ``a``."""
    return np.where((a * b).sum(axis=-1, keepdims=True) < 0, -b, b)
