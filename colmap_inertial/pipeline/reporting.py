"""What the pipeline keeps for the report, and the report itself, written when a run ends, however it ends."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.errors import MappingError, NotObservableError
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import write_json
from colmap_inertial.model import Model, colmap_camera
from colmap_inertial.options import ProjectOptions
from colmap_inertial.pipeline.imaging import ImagingPlan
from colmap_inertial.pipeline.metric import gravity_in_model
from colmap_inertial.pipeline.result import ReconstructResult, result_as_json
from colmap_inertial.pipeline.workspace import Workspace
from colmap_inertial.report import write_report
from colmap_inertial.report.content import model_file, recording_file
from colmap_inertial.report.scene import scene_record
from colmap_inertial.report.series import rounded, strided
from colmap_inertial.report.signals import signal_record
from colmap_inertial.types import Array, CameraTrajectory, FrameTiming, ImuRecording

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Frames for which the movement by the rolling shutter is computed, and points across an image.
_SHUTTER_FRAMES, _GRID = 300, 9


def write_recording(
    workspace: Workspace, imu: ImuRecording, timing: FrameTiming, plan: ImagingPlan | None = None
) -> None:
    """Keep what the report says of the recording: rates, times of the frames, what the rolling shutter does."""

    def rate_hz(t_s: Array) -> float | None:
        return float(1 / np.median(np.diff(t_s))) if len(t_s) > 1 else None

    record: dict[str, Any] = {
        "imu": {
            "device": imu.device,
            "gyro_hz": rate_hz(imu.gyro_t_s),
            "accel_hz": rate_hz(imu.accel_t_s),
            "duration_s": float(imu.gyro_t_s[-1] - imu.gyro_t_s[0]),
        },
        "frames": {
            "count": len(timing.names),
            "duration_s": float(timing.t_s[-1] - timing.t_s[0]),
            "interval_s": float(np.median(np.diff(timing.t_s))) if len(timing.t_s) > 1 else None,
            "names": list(timing.names),
            "t_s": np.round(timing.t_s - timing.t_s[0], 4).tolist(),
            "exposure_s": None if timing.exposure_s is None else rounded(timing.exposure_s, 4),
            "readout_s": timing.readout_s,
        },
        "rolling_shutter": None if plan is None else _shutter_record(plan, timing),
    }
    workspace.report_data.mkdir(exist_ok=True)
    write_json(recording_file(workspace.root), record, indent=None)


def _shutter_record(plan: ImagingPlan, timing: FrameTiming) -> dict[str, Any] | None:
    """By how much keypoints move: of some frames the largest shift, and that of the worst one over the image."""
    stages = plan.keypoint_stages()
    if not stages or plan.view is None:
        return None
    stage, camera = stages[0], colmap_camera(plan.view.camera)
    x = (np.arange(_GRID) + 0.5) * camera.width / _GRID
    y = (np.arange(_GRID) + 0.5) * camera.height / _GRID
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shifts = []
    for i in strided(len(timing.names), _SHUTTER_FRAMES).tolist():
        if stage.covers(timing.names[i]):
            shift = stage(timing.names[i], grid) - grid
            if np.isfinite(shift).all():
                shifts.append((i, shift))
    if not shifts:
        return None
    largest = np.array([np.linalg.norm(shift, axis=1).max() for _, shift in shifts])
    middle = np.array([np.median(np.linalg.norm(shift, axis=1)) for _, shift in shifts])
    worst, field = shifts[int(np.argmax(largest))]
    return {
        "t_s": np.round(timing.t_s[[i for i, _ in shifts]] - timing.t_s[0], 3).tolist(),
        "median_px": rounded(middle, 4),
        "largest_px": rounded(largest, 4),
        "worst": {
            "name": timing.names[worst],
            "width": camera.width,
            "height": camera.height,
            "at_px": np.round(grid, 1).tolist(),
            "shift_px": np.round(field, 3).tolist(),
        },
    }


def write_model_record(
    workspace: Workspace,
    model: Model,
    reconstruction: pycolmap.Reconstruction,
    trajectory: CameraTrajectory,
    imu: ImuRecording,
) -> None:
    """Keep what the report draws of one model: its scene, and camera against IMU."""
    if model.scale is None:
        raise ValueError("a model without a scale estimate has nothing to report")
    gravity = gravity_in_model(model)
    record = {
        "scene": scene_record(reconstruction, trajectory, gravity),
        "signals": signal_record(trajectory, imu, model.scale, gravity),
    }
    workspace.report_data.mkdir(exist_ok=True)
    write_json(model_file(workspace.root, model.index), record, indent=None)


def report_result(result: ReconstructResult, capture: Capture, project: ProjectOptions | None = None) -> None:
    """Write the report, and then ``result.json``, whose presence says that the run is finished."""
    content = result_as_json(result, capture)
    if project is not None:
        content["project"] = dataclasses.asdict(project)
    write_report(result.workspace.root, result=content)
    write_json(result.workspace.result, content)


@contextlib.contextmanager
def reporting_stops(workspace: Workspace, capture: Capture) -> Iterator[None]:
    """Where a run stops without a result because of the recording, the report says why and what to do."""
    try:
        yield
    except (NotObservableError, MappingError) as error:
        write_report(workspace.root, stopped=str(error), capture=str(capture.path))
        log.info("report: %s", workspace.report)
        raise


__all__ = ["report_result", "reporting_stops", "write_model_record", "write_recording"]
