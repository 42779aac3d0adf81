"""Metric, gravity-aligned COLMAP reconstructions from the gyroscope and accelerometer that filmed along."""

from __future__ import annotations

__version__ = "0.1.0"
