"""``colmap-inertial deblur``: the images alone, as a reconstruction would see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.colmap.sparse import check_names
from colmap_inertial.drivers.capture import fusing, run_frames, run_plan, run_rectified
from colmap_inertial.drivers.contact_sheet import write_contact_sheet
from colmap_inertial.drivers.result import frame_as_json, imaging_as_json
from colmap_inertial.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frames import frame_source, read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.options import BlurRemover, ReconstructOptions
from colmap_inertial.precalibrate.plan import ImagingPlan, with_stated_exposures
from colmap_inertial.run.progress import Progress
from colmap_inertial.run.runner import StageRunner
from colmap_inertial.run.session import logging_to
from colmap_inertial.run.workspace import Workspace
from colmap_inertial.stages.deblur import require_method
from colmap_inertial.stages.frame_folder import FrameRecord, read_frame_records
from colmap_inertial.stages.protocols import FrameStage


@dataclass(frozen=True, eq=False, kw_only=True)
class DeblurResult:
    """What ``deblur_capture`` made; the same as ``result.json``.

    Attributes
    ----------
    workspace
        ``images/``, with ``rectify`` also ``images_rectified/``.
    frames
        What happened to each frame.
    imaging
        What was decided beforehand, and why.
    sheet
        The contact sheet; ``None`` where none was asked for or no frame was deblurred.
    """

    workspace: Workspace
    frames: tuple[FrameRecord, ...]
    imaging: ImagingPlan
    sheet: Path | None = None


def deblur_capture(
    capture: Path,
    out: Path,
    *,
    method: BlurRemover = "wiener",
    calibration: Path | None = None,
    rectify: bool = False,
    sheet: Path | None = None,
    progress: Progress,
) -> DeblurResult:
    """Write the frames of a capture deblurred, with their names, sizes, formats and metadata.

    Parameters
    ----------
    capture
        As for ``reconstruct``.
    out
        A folder that does not exist, or holds an unfinished run of the same capture. No frame is left out: those that
        cannot be deblurred are copied.
    method
        How blur is undone.
    calibration
        A calibration file of this device.
    rectify
        Also write the images without their rolling shutter.
    sheet
        Where to write a PNG with parts of the most blurred frames before and after.
    progress
        As for ``reconstruct``.

    Raises
    ------
    NotObservableError
        Where the gyroscope does not belong to the pixels, as in stabilised video.
    MissingExtraError
        Where the method is a network, and onnxruntime is not installed.
    InertialError
        For what cannot be read or written.
    """
    require_method(method)
    # of short and long exposures, the short ones alone
    loaded = replace(load_capture(capture), exposures=None)
    if loaded.frames is None:
        raise FormatError(loaded.path, "has no frames: add [images] or [video]")
    if sheet is not None and sheet.exists():
        raise OutputExistsError(f"{sheet} exists; choose another name for the contact sheet")
    if sheet is not None and not sheet.parent.is_dir():
        raise OutputError(f"{sheet.parent} is no folder; create it first")
    if sheet is not None and sheet.suffix.lower() != ".png":
        raise InertialError(f"{sheet}: the contact sheet is a PNG; name it so")
    imu = read_capture_imu(loaded)
    timing, frames = read_frames(loaded)
    timing = with_stated_exposures(loaded, timing)
    check_names(timing.names)
    options = ReconstructOptions(
        deblur=method, rolling_shutter="rectify" if rectify else "off", calibration=calibration
    )
    workspace = Workspace(out)
    workspace.open(loaded.path)
    with workspace.locked(), logging_to(workspace.log):
        runner = StageRunner(workspace)
        plan = run_plan(runner, workspace, loaded, imu, timing, options, progress)
        stages: list[FrameStage] = [
            *fusing(loaded, workspace, options.apertures),
            *plan.frame_stages(drop=False),
        ]
        run_frames(runner, workspace, loaded, timing, frames, stages, progress)
        records = read_frame_records(workspace.frames)
        run_rectified(runner, workspace, records, plan.keypoint_stages(), progress)
        shown = _shown(records)
        if sheet is not None and shown and plan.view is not None:
            write_contact_sheet(sheet, loaded, plan, workspace.images, shown)
        written = sheet if sheet is not None and shown else None
        write_json(
            workspace.result,
            {
                "versions": {"colmap_inertial": __version__},
                "capture": str(loaded.path),
                "source": None if (source := frame_source(loaded)) is None else str(source),
                "imaging": imaging_as_json(plan),
                "frames": [frame_as_json(record, plan) for record in records],
                "seconds": runner.seconds,
            },
        )
    return DeblurResult(workspace=workspace, frames=records, imaging=plan, sheet=written)


def _shown(records: Sequence[FrameRecord]) -> list[str]:
    """Names of the deblurred frames, the most blurred first."""
    deblurred = [r for r in records if r.action == "deblurred" and r.treatment is not None]
    return [r.name for r in sorted(deblurred, key=lambda r: -((r.treatment and r.treatment.blur_px) or 0.0))]
