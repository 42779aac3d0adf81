"""The accelerometer in the world frame, integrated once and twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.core.sampling import Coverage
from colmap_inertial.motion.smooth._attitude import Attitude


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldAcceleration:
    """Acceleration of the IMU in the world, linear between samples, with its integrals from the first sample.

    Attributes
    ----------
    t_s
        (M,) camera clock.
    accel_m_s2, velocity_m_s, position_m
        (M, 3).
    """

    t_s: Array
    accel_m_s2: Array
    velocity_m_s: Array
    position_m: Array

    @classmethod
    def of(
        cls,
        timed: CameraTimedImu,
        attitude: Attitude,
        *,
        bias_m_s2: Array,
        gravity_in_world_m_s2: Array,
    ) -> WorldAcceleration:
        """Turn the readings into the world, without their bias and gravity."""
        world_from_imu, _ = attitude.at(timed.accel_t_s)
        accel = quat_rotate(world_from_imu, timed.imu.accel_m_s2 - bias_m_s2) + gravity_in_world_m_s2
        return cls.integrated(timed.accel_t_s, accel)

    @classmethod
    def integrated(cls, t_s: Array, accel_m_s2: Array) -> WorldAcceleration:
        """Integrate an acceleration (M, 3) that is linear between its samples."""
        step = np.diff(t_s)[:, None]
        gained = step * 0.5 * (accel_m_s2[1:] + accel_m_s2[:-1])
        velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])
        moved = step * velocity[:-1] + step**2 / 6 * (2 * accel_m_s2[:-1] + accel_m_s2[1:])
        position = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
        return cls(t_s=t_s, accel_m_s2=accel_m_s2, velocity_m_s=velocity, position_m=position)

    @property
    def step_s(self) -> float:
        """Usual interval between samples."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def variance(self) -> float:
        """Of the motion itself, each axis (m2/s4)."""
        return float(np.mean(np.var(self.accel_m_s2, axis=0)))

    @property
    def sample_variance(self) -> float:
        """Of one sample's noise, each axis, by what does not even follow a straight line (m2/s4)."""
        bend = self.accel_m_s2[2:] - 2 * self.accel_m_s2[1:-1] + self.accel_m_s2[:-2]
        # median of the square of a normal variable: 0.455; a second difference has six times the variance
        return float(np.median(bend**2)) / 0.455 / 6

    def covers(self, t_s: Array) -> BoolArray:
        """(T-1,) which intervals between these times have samples throughout."""
        return Coverage(self.t_s).covers(t_s[:-1], t_s[1:])

    def at(self, t_s: Array) -> tuple[Array, BoolArray]:
        """Acceleration (T, 3), zero where there are no samples, and whether there are."""
        here = self.covers(np.append(t_s, t_s[-1]) if len(t_s) == 1 else t_s)
        sampled = np.append(here, False) | np.append(False, here)
        accel = np.stack([np.interp(t_s, self.t_s, self.accel_m_s2[:, k]) for k in range(3)], axis=1)
        return np.where(sampled[:, None], accel, 0.0), sampled

    def sums(self, t_s: Array) -> Array:
        """(T, 2, 3) position and velocity gained since the first sample."""
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        step = self.t_s[i + 1] - self.t_s[i]
        since = np.clip(t_s - self.t_s[i], 0.0, step)[:, None]
        start, slope = self.accel_m_s2[i], (self.accel_m_s2[i + 1] - self.accel_m_s2[i]) / step[:, None]
        velocity = self.velocity_m_s[i] + since * start + since**2 / 2 * slope
        position = self.position_m[i] + since * self.velocity_m_s[i] + since**2 / 2 * start + since**3 / 6 * slope
        return np.stack([position, velocity], axis=1)
