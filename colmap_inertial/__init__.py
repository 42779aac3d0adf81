"""Metric, gravity-aligned COLMAP reconstructions from the gyroscope and accelerometer that filmed along."""

from __future__ import annotations

# pycolmap's wheel carries a zlib of its own; unless Python's is loaded first, a later zlib.compress aborts the process.
import zlib as _zlib  # noqa: F401

__version__ = "0.1.0"
