"""Data for the report, and the report itself: of finished runs, and of those that the recording stopped.

A report that fails never costs a result, nor hides why a run stopped: the log says what went wrong with it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import platform
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import MappingError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReferenceOptions
from colmap_inertial.core.threads import usable_processors
from colmap_inertial.core.types import CameraTrajectory, ImuRecording, Keypoints
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import write_json
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import Model
from colmap_inertial.report import write_report
from colmap_inertial.report.folders import model_file, recording_file
from colmap_inertial.report.photogrammetry import photogrammetry_record, scene_record
from colmap_inertial.report.series import round_values, stride_indices
from colmap_inertial.report.signals import signal_record
from colmap_inertial.run.commands.project_output import withdraw
from colmap_inertial.run.commands.result import ReconstructResult, result_as_json
from colmap_inertial.run.preparation.frame_reading import GreyFrames
from colmap_inertial.run.stages.metric import gravity_in_model
from colmap_inertial.run.steps.session import Session
from colmap_inertial.run.steps.workspace import Workspace

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReportLimits:
    """Sizes of the report's data."""

    #: Frames for which the movement by the rolling shutter is computed, and points across an image.
    shutter_frames: int = 300
    grid: int = 9


_LIMITS = ReportLimits()


def write_recording(
    session: Session,
    recording: Recording,
    stages: Sequence[KeypointStage] = (),
    rectified: Collection[str] = (),
) -> None:
    """Keep what the report says of the recording: rates, times of the frames, how ``stages`` rectified keypoints."""
    workspace, imu, timing = session.workspace, recording.imu, recording.timing

    def rate_hz(t_s: Array) -> float | None:
        return float(1 / np.median(np.diff(t_s))) if len(t_s) > 1 else None

    with _failures_logged("what the report says of the recording"):
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
                "exposure_s": None if timing.exposure_s is None else round_values(timing.exposure_s, 4),
                "readout_s": timing.readout_s,
            },
            "rolling_shutter": _shutter_record(stages, recording, rectified),
            "made": {
                "date": time.strftime("%Y-%m-%d"),
                "machine": f"{platform.system()} {platform.machine()}",
                "processors": usable_processors(),
            },
        }
        workspace.report_data.mkdir(exist_ok=True)
        write_json(recording_file(workspace.root), record, indent=None)


def _shutter_record(
    stages: Sequence[KeypointStage], recording: Recording, rectified: Collection[str]
) -> dict[str, Any] | None:
    """Shift of keypoints: the largest of some frames, and that of the worst one over the image."""
    if not rectified:
        return None
    timing, camera = recording.timing, GreyFrames(recording.capture, recording.timing).guess_camera()
    x = (np.arange(_LIMITS.grid) + 0.5) * camera.width / _LIMITS.grid
    y = (np.arange(_LIMITS.grid) + 0.5) * camera.height / _LIMITS.grid
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shifts = []
    those = [i for i, name in enumerate(timing.names) if name in rectified]
    for i in (those[k] for k in stride_indices(len(those), _LIMITS.shutter_frames).tolist()):
        moved = Keypoints(name=timing.names[i], xy_px=grid)
        try:
            for stage in stages:
                moved = stage(moved)
        except Exception as error:  # a point far outside, or a visitor's stage that knows its own keypoints only
            log.info("no movement of keypoints of %s for the report: %r", moved.name, error)
            continue
        if moved.rectified:
            shifts.append((i, moved.xy_px - grid))
    if not shifts:
        return None
    largest = np.array([np.linalg.norm(shift, axis=1).max() for _, shift in shifts])
    middle = np.array([np.median(np.linalg.norm(shift, axis=1)) for _, shift in shifts])
    worst, field = shifts[int(np.argmax(largest))]
    return {
        "t_s": np.round(timing.t_s[[i for i, _ in shifts]] - timing.t_s[0], 3).tolist(),
        "median_px": round_values(middle, 4),
        "largest_px": round_values(largest, 4),
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
    index: int,
    model: Model,
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    keeps_intrinsics: bool,
) -> None:
    """Keep what the report draws of one model: its scene, and camera against IMU."""
    if model.scale is None:
        raise ValueError("a model without a scale estimate has nothing to report")
    with _failures_logged(f"what the report draws of model {index}"):
        gravity, first_frame_s = gravity_in_model(model), float(model.timing.t_s[0])
        scene = scene_record(model.reconstruction, trajectory, gravity, first_frame_s=first_frame_s)
        record = {
            "scene": scene,
            "photogrammetry": photogrammetry_record(
                model.reconstruction,
                np.array(scene["display_from_model_xyzw"]),
                unit=scene["unit"],
                keeps_intrinsics=keeps_intrinsics,
            ),
            "signals": signal_record(trajectory, imu, model.scale, gravity, first_frame_s=first_frame_s),
        }
        workspace.report_data.mkdir(exist_ok=True)
        write_json(model_file(workspace.root, index), record, indent=None)


def report_result(
    session: Session,
    result: ReconstructResult,
    capture: Capture,
    calibration_files: Sequence[dict[str, str]] = (),
    project: ProjectOptions | None = None,
    reference: ReferenceOptions = ReferenceOptions(),
) -> ReconstructResult:
    """Write the report, and then ``result.json``, whose presence says that the run is finished.

    Returns
    -------
    The result with the path of its report, ``None`` where that failed, and whether there was nothing to do.
    """
    workspace = result.workspace
    content = {**result_as_json(result, capture), "calibration_files": list(calibration_files)}
    if project is not None:
        content["project"] = {
            key: value.resolve() if isinstance(value, Path) else value
            for key, value in dataclasses.asdict(project).items()
        }
    if reference != ReferenceOptions():
        content["reference"] = dataclasses.asdict(reference)

    def write() -> None:
        with _failures_logged("the report"):
            # what a stopped run left there must not stand for this one
            pages = workspace.report, workspace.report.with_suffix(".json")
            for old in pages:
                remove(old)
            write_report(workspace.root, result=content)
            session.runner.record_files("report", pages)

    unchanged = session.finish(content, write)
    report = workspace.report if workspace.report.is_file() else None
    return dataclasses.replace(result, report=report, unchanged=unchanged)


@contextlib.contextmanager
def reporting_stops(session: Session, capture: Capture, recording: Recording | None = None) -> Iterator[None]:
    """Write a report where the recording gives no scale, or COLMAP no model; for other errors there is none.

    What an earlier run made metric no longer stands, unless that is a finished result that is to stay. The error
    carries a note that names the page.
    """
    try:
        yield
    except (NotObservableError, MappingError) as error:
        if session.runner.keeps_result:
            raise
        workspace = session.workspace
        workspace.unfinish()
        withdraw(workspace)
        if recording is not None:
            write_recording(session, recording)
        with _failures_logged("the report of the stop"):
            page = write_report(workspace.root, stopped=str(error), capture=str(capture.path.resolve()))
            error.add_note(str(Fact("found-on-page", page=str(page))))
        raise


@contextlib.contextmanager
def _failures_logged(what: str) -> Iterator[None]:
    """Nothing that goes wrong with a report may cost what the run has found."""
    try:
        yield
    except Exception:
        log.exception("%s failed", what)
