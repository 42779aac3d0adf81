"""Smoothed camera paths: from positions alone, and from positions, orientations and the IMU together."""

from __future__ import annotations

from colmap_inertial.motion.smooth._attitude import Attitude, WorldAcceleration, smooth_attitude
from colmap_inertial.motion.smooth._positions import PositionSmoother, SmoothOptions, smooth_positions
from colmap_inertial.motion.smooth._trajectory import smooth_trajectory

__all__ = [
    "Attitude",
    "WorldAcceleration",
    "PositionSmoother",
    "SmoothOptions",
    "smooth_attitude",
    "smooth_positions",
    "smooth_trajectory",
]
