"""Metric, gravity-aligned COLMAP reconstructions from the gyroscope and accelerometer that filmed along.

The names in ``__all__`` load their modules when they are first used; importing the package itself costs nothing.
"""

from __future__ import annotations

import importlib

# pycolmap's wheel carries a zlib of its own; unless Python's is loaded first, a later zlib.compress aborts the process.
import zlib as _zlib  # noqa: F401
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from colmap_inertial.align import AlignOptions, align_camera_imu
    from colmap_inertial.errors import InertialError
    from colmap_inertial.imaging.wiener import deblur
    from colmap_inertial.io.capture import load_capture
    from colmap_inertial.io.frames import read_frames
    from colmap_inertial.io.imu import read_imu
    from colmap_inertial.model import apply_similarity
    from colmap_inertial.options import MappingOptions, ReconstructOptions, ScaleOptions, ValidateOptions
    from colmap_inertial.pipeline import DeblurStage, RollingShutterStage, reconstruct
    from colmap_inertial.scale import estimate_scale
    from colmap_inertial.smooth import smooth_trajectory
    from colmap_inertial.validate import validate_model

__version__ = "0.1.0"

_HOMES = {
    "AlignOptions": "align",
    "DeblurStage": "pipeline",
    "InertialError": "errors",
    "MappingOptions": "options",
    "ReconstructOptions": "options",
    "RollingShutterStage": "pipeline",
    "ScaleOptions": "options",
    "ValidateOptions": "options",
    "align_camera_imu": "align",
    "apply_similarity": "model",
    "deblur": "imaging.wiener",
    "estimate_scale": "scale",
    "load_capture": "io.capture",
    "read_frames": "io.frames",
    "read_imu": "io.imu",
    "reconstruct": "pipeline",
    "smooth_trajectory": "smooth",
    "validate_model": "validate",
}

__all__ = [
    "AlignOptions",
    "DeblurStage",
    "InertialError",
    "MappingOptions",
    "ReconstructOptions",
    "RollingShutterStage",
    "ScaleOptions",
    "ValidateOptions",
    "align_camera_imu",
    "apply_similarity",
    "deblur",
    "estimate_scale",
    "load_capture",
    "read_frames",
    "read_imu",
    "reconstruct",
    "smooth_trajectory",
    "validate_model",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
