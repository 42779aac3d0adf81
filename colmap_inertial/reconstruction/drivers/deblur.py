"""``colmap-inertial deblur``: the images alone, as a reconstruction would see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.colmap.sparse import check_pair_names
from colmap_inertial.core.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.core.options import BlurRemover, ReconstructOptions
from colmap_inertial.io.calibration import CalibrationFiles, list_paths
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import StrPath, read_json, write_json
from colmap_inertial.io.frames import picture_folders, read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.pipeline.run.context import Recording, RunContext, corrected_imu, prior_calibration
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.pipeline.run.runner import remove
from colmap_inertial.pipeline.run.session import open_session
from colmap_inertial.pipeline.run.workspace import Workspace
from colmap_inertial.pipeline.stages.deblur import require_method
from colmap_inertial.pipeline.stages.defaults import default_frame_stages, default_keypoint_stages
from colmap_inertial.pipeline.stages.frame_folder import FrameRecord
from colmap_inertial.pipeline.stages.imaging_plan import ImagingPlan
from colmap_inertial.pipeline.stages.inputs import StageInputs
from colmap_inertial.pipeline.stages.rectified import rectifiable
from colmap_inertial.reconstruction.drivers.contact_sheet import write_contact_sheet
from colmap_inertial.reconstruction.drivers.frames import run_frames, run_images, run_plan
from colmap_inertial.reconstruction.drivers.result import frame_as_json, imaging_as_json
from colmap_inertial.reconstruction.preparation.plan import Treatments, with_stated_exposures

_SHEET = "sheet.json"


@dataclass(frozen=True, eq=False, kw_only=True)
class DeblurResult:
    """What ``deblur_capture`` made; the same as ``result.json``.

    Attributes
    ----------
    workspace
        ``images/``; with ``rectify`` also ``colmap/images/``, what they were rectified from.
    frames
        What happened to each frame.
    imaging
        What was decided beforehand, and why.
    sheet
        The contact sheet; ``None`` where none was asked for or no frame was deblurred.
    unchanged
        Whether there was nothing to do: the folder held this result already.
    rectified
        Names of the images that were rectified, too.
    """

    workspace: Workspace
    frames: tuple[FrameRecord, ...]
    imaging: ImagingPlan
    sheet: Path | None = None
    unchanged: bool = False
    rectified: frozenset[str] = frozenset()


def deblur_capture(
    capture: StrPath,
    out: StrPath,
    *,
    method: BlurRemover = "wiener",
    calibration: CalibrationFiles = None,
    rectify: bool = False,
    sheet: Path | None = None,
    progress: Progress = silent,
) -> DeblurResult:
    """Write the frames of a capture deblurred, with their names, sizes, formats and metadata.

    Parameters
    ----------
    capture
        As for ``reconstruct``.
    out
        A folder that does not exist, or holds a run of the same capture, which is then gone on with. No frame is left
        out: those that cannot be deblurred are copied.
    method
        How blur is undone.
    calibration
        Calibration files of this device, as of ``ReconstructOptions``.
    rectify
        Write the images without their rolling shutter, and beside them, in ``colmap/images/``, with it.
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
    loaded = replace(load_capture(Path(capture)), exposures=None)
    if loaded.frames is None:
        raise FormatError(loaded.path, "has no frames: add [images] or [video]")
    if sheet is not None and sheet.exists() and not _is_ours(sheet, Path(out)):
        raise OutputExistsError(f"{sheet} exists; choose another name for the contact sheet")
    if sheet is not None and not sheet.parent.is_dir():
        raise OutputError(f"{sheet.parent} is no folder; create it first")
    if sheet is not None and sheet.suffix.lower() != ".png":
        raise InertialError(f"{sheet}: the contact sheet is a PNG; name it so")
    imu = read_capture_imu(loaded)
    timing, frames = read_frames(loaded)
    timing = with_stated_exposures(loaded, timing)
    check_pair_names(timing.names)
    options = ReconstructOptions(
        deblur=method, rolling_shutter="rectify" if rectify else "off", calibration=list_paths(calibration)
    )
    imu = corrected_imu(loaded, imu, calibration)
    recording = Recording.of(loaded, imu, timing, prior_calibration(loaded, calibration))
    pictures = picture_folders(loaded)
    with open_session(
        Path(out), loaded.path, options, RunContext(progress=progress), pictures=pictures, command="deblur"
    ) as session:
        workspace = session.workspace
        plan = run_plan(session, recording, Treatments(deblur=method, rolling_shutter=options.rolling_shutter))
        inputs = StageInputs(recording=recording, options=options, plan=plan, maps=False)
        deblurred = workspace.colmap_images if rectify else workspace.images
        if not rectify:
            remove(workspace.colmap)
            session.runner.forget("images")
        records = run_frames(session, recording, frames, default_frame_stages(inputs), deblurred)
        movers = default_keypoint_stages(inputs)
        rectified = rectifiable(movers, timing.names)
        if rectify:
            run_images(session, records, rectified, movers)
        shown = _shown(records)
        if sheet is not None and shown and plan.view is not None:
            write_json(workspace.stamps / _SHEET, {"sheet": str(sheet.resolve())})
            write_contact_sheet(sheet, loaded, plan, deblurred, shown)
        unchanged = session.finish(
            {
                "versions": {"colmap_inertial": __version__},
                "capture": str(loaded.path),
                "source": None if (source := loaded.image_folder) is None else str(source),
                "imaging": imaging_as_json(plan, rectified),
                "frames": [frame_as_json(record, plan, rectified) for record in records],
                "seconds": session.runner.seconds,
            }
        )
        return DeblurResult(
            workspace=workspace,
            frames=records,
            imaging=plan,
            sheet=sheet if sheet is not None and shown else None,
            unchanged=unchanged,
            rectified=rectified,
        )


def _is_ours(sheet: Path, out: Path) -> bool:
    """Whether an earlier run in the same folder wrote a contact sheet."""
    record = Workspace(out).stamps / _SHEET
    return record.is_file() and read_json(record).get("sheet") == str(sheet.resolve())


def _shown(records: Sequence[FrameRecord]) -> list[str]:
    """Names of the deblurred frames, the most blurred first."""
    deblurred = [record for record in records if record.action == "deblurred"]
    return [record.name for record in sorted(deblurred, key=lambda record: -(record.value("blur_px") or 0.0))]
