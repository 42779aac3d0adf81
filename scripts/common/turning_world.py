"""What a camera that only turns sees of a wall at infinity, by its own reckoning: for the benchmarks of imaging.

Nothing here uses the package's blur, gyroscope or rolling shutter: rates are integrated in small steps (SciPy's
rotations), the camera is a pinhole, and a frame is the mean of many instants, each line of each of them by the
orientation of its own moment, in linear light and gathered by bicubic interpolation. With 112 instants of 30 px of blur
they are a quarter of a pixel apart.
"""

from __future__ import annotations

import lzma
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.tools.simulate import MotionOptions, make_motion

#: Camera in the body of the hand-held recordings (TUM-VI), whose motion the benchmarks use.
BODY_FROM_CAM = np.array([[-0.99953, 0.02962, -0.00852], [0.00750, -0.03440, -0.99938], [-0.02989, -0.99897, 0.03416]])
#: Steps of the integration to each sample, and between nodes of the exact mapping, px.
_SUBSTEPS, _NODE_PX = 8, 16
_SIMULATED_HZ = 400.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Turning:
    """How a camera turned: (N,) seconds and (N, 3) rad/s about its own axes, linear in between."""

    t_s: Array
    rate_rad_s: Array

    @classmethod
    def recorded(cls, folder: Path, name: str) -> Turning:
        """By the gyroscope of ``NAME_imu.csv.xz``: ``t_ns, gyro x y z rad/s, ...`` in the body's axes."""
        with lzma.open(folder / f"{name}_imu.csv.xz", "rt") as file:
            rows = np.loadtxt([line for line in file if line[0] != "#"], delimiter=",")
        u, _, vt = np.linalg.svd(BODY_FROM_CAM)
        return cls(t_s=(rows[:, 0] - rows[0, 0]) * 1e-9, rate_rad_s=rows[:, 1:4] @ (u @ vt))

    @classmethod
    def simulated(cls, seed: int, *, duration_s: float = 60.0) -> Turning:
        """By the package's simulator of hands, where no recording is at hand."""
        options = MotionOptions(kind="pure_rotation", duration_s=duration_s)
        motion = make_motion(options, np.random.default_rng([seed, 5]))
        t_s = np.arange(0.0, duration_s, 1 / _SIMULATED_HZ)
        return cls(t_s=t_s, rate_rad_s=motion.rate_in_cam_rad_s(t_s))

    @cached_property
    def _orientation(self) -> Slerp:
        share = (np.arange(_SUBSTEPS) + 0.5) / _SUBSTEPS
        step_s = np.diff(self.t_s)[:, None, None] / _SUBSTEPS
        before, after = self.rate_rad_s[:-1, None], self.rate_rad_s[1:, None]
        turns = (step_s * (before + (after - before) * share[:, None])).reshape(-1, 3)
        steps = Rotation.from_rotvec(turns).as_quat()
        quats = np.empty((len(steps) + 1, 4))
        quats[0] = [0, 0, 0, 1]
        for i, (bx, by, bz, bw) in enumerate(steps):
            ax, ay, az, aw = quats[i]
            quats[i + 1] = (
                aw * bx + ax * bw + ay * bz - az * by,
                aw * by - ax * bz + ay * bw + az * bx,
                aw * bz + ax * by - ay * bx + az * bw,
                aw * bw - ax * bx - ay * by - az * bz,
            )
        fine = np.interp(np.arange(len(quats)) / _SUBSTEPS, np.arange(len(self.t_s)), self.t_s)
        return Slerp(fine, Rotation.from_quat(quats))

    def world_from_cam(self, t_s: Array) -> Array:
        """(..., 3, 3) at times of any shape."""
        flat = np.asarray(t_s, dtype=np.float64)
        return np.asarray(self._orientation(flat.ravel()).as_matrix()).reshape(*flat.shape, 3, 3)


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When one frame is exposed: rows from the top down, seconds; ``t_s`` is the start of the first."""

    t_s: float
    exposure_s: float
    readout_s: float

    def middle_s(self, row_px: Array, height: int) -> Array:
        """Mid-exposure of lines by their OpenCV row."""
        return self.t_s + 0.5 * self.exposure_s + self.readout_s / height * np.asarray(row_px, dtype=np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class TurningCamera:
    """A pinhole of (width, height) before a wall of linear light, (H, W) or (H, W, 3), one of its pixels to one of
    the camera's where it looks straight at it."""

    wall: Float32Array
    wall_from_world: Array
    turning: Turning
    size: tuple[int, int]
    focal_px: float

    def facing(self, *moments: Moment) -> Array:
        """(3, 3) the ``wall_from_world`` of a wall that stands where these frames look at in the mean."""
        turn = self.turning.world_from_cam(
            np.array([m.middle_s(np.array(self.size[1] / 2), self.size[1]) for m in moments])
        )
        forward = turn[:, :, 2].sum(axis=0)
        forward /= np.linalg.norm(forward)
        right = np.cross(turn[0][:, 1], forward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def frame(
        self, moment: Moment, samples: int, *, moved: Callable[[Array, Array], tuple[Array, Array]] | None = None
    ) -> Float32Array:
        """The light that a frame gathers; the same instant for all of a line's exposure where ``samples`` is 1.

        Parameters
        ----------
        moved
            Of pixels of the wall: where they are instead, as parallax has it.
        """
        width, height = self.size
        rows, columns = (-(-(n - 1) // _NODE_PX) + 1 for n in (height, width))
        y, x = _NODE_PX * np.arange(float(rows)), _NODE_PX * np.arange(float(columns))
        rays = self._rays(np.stack(np.meshgrid(x, y), axis=-1))
        at = moment.middle_s(y, height)
        shares = (np.arange(samples) + 0.5) / samples - 0.5
        turns = self.wall_from_world @ self.turning.world_from_cam(at + moment.exposure_s * shares[:, None])
        across, down = _between_nodes(width, columns), _between_nodes(height, rows)
        total = np.zeros((height, width, *self.wall.shape[2:]), dtype=np.float32)
        for turn in turns:
            u, v = self._on_wall(np.einsum("yij,yxj->yxi", turn, rays))
            if moved is not None:
                u, v = moved(u, v)
            maps = [down @ a.astype(np.float32) @ across.T for a in (u, v)]
            total += cv2.remap(self.wall, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        return total / np.float32(samples)

    def transferred(self, points_px: Array, source: Moment, target: Moment) -> Array:
        """(N, 2) where (N, 2) OpenCV points of one frame truly are in another; nan where out of its sight."""
        width, height = self.size
        points = np.asarray(points_px, dtype=np.float64)
        turn = self.turning.world_from_cam(source.middle_s(points[:, 1], height))
        world = np.einsum("nij,nj->ni", turn, self._rays(points))
        found = np.tile([0.5 * width, 0.5 * height], (len(world), 1))
        for _ in range(12):
            turn = self.turning.world_from_cam(target.middle_s(np.clip(found[:, 1], -height, 2 * height), height))
            seen = np.einsum("nji,nj->ni", turn, world)
            with np.errstate(divide="ignore", invalid="ignore"):
                found = self.focal_px * seen[:, :2] / seen[:, 2:] + self._centre
            found[seen[:, 2] < 0.1] = np.nan
        inside = (found > -0.5).all(axis=1) & (found < [width - 0.5, height - 0.5]).all(axis=1)
        found[~inside] = np.nan
        return found

    @property
    def _centre(self) -> Array:
        return 0.5 * np.array(self.size, dtype=np.float64) - 0.5

    def _rays(self, points_px: Array) -> Array:
        xy = (points_px - self._centre) / self.focal_px
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def _on_wall(self, rays: Array) -> tuple[Array, Array]:
        height, width = self.wall.shape[:2]
        x, y = (self.focal_px * rays[..., k] / rays[..., 2] for k in (0, 1))
        return x + 0.5 * (width - 1), y + 0.5 * (height - 1)


def _between_nodes(count: int, nodes: int) -> Float32Array:
    """(count, nodes) weights that bring values at nodes to every pixel, linearly."""
    distance = np.abs(np.arange(count)[:, None] / _NODE_PX - np.arange(nodes))
    return np.maximum(1 - distance, 0).astype(np.float32)
