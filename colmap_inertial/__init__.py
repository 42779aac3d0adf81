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
    from colmap_inertial.batch import BatchCapture, BatchResult, CaptureStatus, read_manifest, run_batch
    from colmap_inertial.errors import InertialError
    from colmap_inertial.imaging.wiener import deblur
    from colmap_inertial.io.calibration import read_calibration, write_calibration
    from colmap_inertial.io.capture import load_capture
    from colmap_inertial.io.frames import read_frame_times, read_frames
    from colmap_inertial.io.imu import read_frame_log, read_imu
    from colmap_inertial.model import apply_similarity, find_models, read_model, trajectory_from_model
    from colmap_inertial.model.project import apply_to_project, undo_project
    from colmap_inertial.model.similarities import ModelScale, read_scales, read_similarity
    from colmap_inertial.options import (
        MappingOptions,
        ProjectOptions,
        ReconstructOptions,
        ScaleOptions,
        ValidateOptions,
    )
    from colmap_inertial.pipeline import (
        DeblurStage,
        ReadoutStage,
        RollingShutterStage,
        default_model_stages,
        reconstruct,
    )
    from colmap_inertial.pipeline.config import read_config
    from colmap_inertial.pipeline.existing import reconstruct_project
    from colmap_inertial.report import write_report
    from colmap_inertial.scale import estimate_scale
    from colmap_inertial.smooth import smooth_trajectory
    from colmap_inertial.types import (
        CameraImuCalibration,
        CameraModel,
        CameraTrajectory,
        Frame,
        FrameLog,
        FrameTiming,
        ImuRecording,
        ScaleEstimate,
        Similarity,
    )
    from colmap_inertial.validate import validate_model

__version__ = "0.1.0"

_HOMES = {
    "AlignOptions": "align",
    "BatchCapture": "batch",
    "BatchResult": "batch",
    "CameraImuCalibration": "types",
    "CameraModel": "types",
    "CameraTrajectory": "types",
    "CaptureStatus": "batch",
    "DeblurStage": "pipeline",
    "Frame": "types",
    "FrameLog": "types",
    "FrameTiming": "types",
    "ImuRecording": "types",
    "InertialError": "errors",
    "MappingOptions": "options",
    "ModelScale": "model.similarities",
    "ProjectOptions": "options",
    "ReadoutStage": "pipeline",
    "ReconstructOptions": "options",
    "RollingShutterStage": "pipeline",
    "ScaleEstimate": "types",
    "ScaleOptions": "options",
    "Similarity": "types",
    "ValidateOptions": "options",
    "align_camera_imu": "align",
    "apply_similarity": "model",
    "apply_to_project": "model.project",
    "deblur": "imaging.wiener",
    "default_model_stages": "pipeline",
    "estimate_scale": "scale",
    "find_models": "model",
    "load_capture": "io.capture",
    "read_calibration": "io.calibration",
    "read_config": "pipeline.config",
    "read_frame_log": "io.imu",
    "read_frame_times": "io.frames",
    "read_frames": "io.frames",
    "read_imu": "io.imu",
    "read_manifest": "batch",
    "read_model": "model",
    "read_scales": "model.similarities",
    "read_similarity": "model.similarities",
    "reconstruct": "pipeline",
    "reconstruct_project": "pipeline.existing",
    "run_batch": "batch",
    "smooth_trajectory": "smooth",
    "trajectory_from_model": "model",
    "undo_project": "model.project",
    "validate_model": "validate",
    "write_report": "report",
    "write_calibration": "io.calibration",
}

__all__ = [
    "AlignOptions",
    "BatchCapture",
    "BatchResult",
    "CameraImuCalibration",
    "CameraModel",
    "CameraTrajectory",
    "CaptureStatus",
    "DeblurStage",
    "Frame",
    "FrameLog",
    "FrameTiming",
    "ImuRecording",
    "InertialError",
    "MappingOptions",
    "ModelScale",
    "ProjectOptions",
    "ReadoutStage",
    "ReconstructOptions",
    "RollingShutterStage",
    "ScaleEstimate",
    "ScaleOptions",
    "Similarity",
    "ValidateOptions",
    "align_camera_imu",
    "apply_similarity",
    "apply_to_project",
    "deblur",
    "default_model_stages",
    "estimate_scale",
    "find_models",
    "load_capture",
    "read_calibration",
    "read_config",
    "read_frame_log",
    "read_frame_times",
    "read_frames",
    "read_imu",
    "read_manifest",
    "read_model",
    "read_scales",
    "read_similarity",
    "reconstruct",
    "reconstruct_project",
    "run_batch",
    "smooth_trajectory",
    "trajectory_from_model",
    "undo_project",
    "validate_model",
    "write_calibration",
    "write_report",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
