"""Commands that treat frames alone, without a reconstruction: ``deblur``, ``fuse-apertures``, ``fuse-exposures``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import check_pair_names
from colmap_inertial.core.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import (
    BlurRemover,
    DeblurPurpose,
    ExposureOptions,
    FuseAperturesOptions,
    ReconstructOptions,
)
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.hooks import FrameStage
from colmap_inertial.imaging.multi_aperture import refocus, require_colours
from colmap_inertial.io.calibration import CalibrationFiles, list_paths
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import StrPath, path_in, read_json, structured, write_json
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import ImageFolder, image_names
from colmap_inertial.io.frames import picture_folders, read_frame_timing
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.recording import Recording, correct_imu, prior_calibration
from colmap_inertial.run.commands.frames import run_frames, run_images, write_contact_sheet
from colmap_inertial.run.commands.result import DeblurResult, frame_as_json, imaging_as_json
from colmap_inertial.run.preparation.frame_reading import FullFrames, GreyFrames
from colmap_inertial.run.preparation.plan import Treatments, add_stated_exposures, expect_plan, run_plan
from colmap_inertial.run.stages.apertures import ApertureStage, write_maps
from colmap_inertial.run.stages.deblur import require_method
from colmap_inertial.run.stages.defaults import default_frame_stages, default_keypoint_stages
from colmap_inertial.run.stages.exposures import ExposureStage, FusedPair
from colmap_inertial.run.stages.frame_folder import (
    FramePaths,
    FrameRecord,
    encode_image,
    note_rectified,
    read_frame_records,
    rectifiable,
    write_frames,
)
from colmap_inertial.run.stages.imaging_plan import ImagingPlan, note_as_json
from colmap_inertial.run.stages.inputs import Fuser, StageInputs, lsd2_fuser
from colmap_inertial.run.steps.session import Session, open_session
from colmap_inertial.run.steps.workspace import Workspace

_SHEET = "sheet.json"


def _open_session(
    out: StrPath, capture: Capture, options: object, command: str, *, overwrite: bool, progress: Progress
) -> contextlib.AbstractContextManager[Session]:
    context, pictures = RunContext(progress=progress), picture_folders(capture)
    return open_session(
        Path(out), capture.path, options, context, pictures=pictures, command=command, overwrite=overwrite
    )


def _write_result(session: Session, capture: Capture, content: Mapping[str, object]) -> bool:
    """Write ``result.json``; returns whether it stood already."""
    source = capture.image_folder
    return session.finish(
        {
            "versions": {"colmap_inertial": __version__},
            "capture": str(capture.path.resolve()),
            "source": None if source is None else str(source.resolve()),
            **content,
            "seconds": session.runner.seconds,
        }
    )


def _run_fusion(
    session: Session,
    folder: Path,
    frames: Iterator[Frame],
    names: Sequence[str],
    make_stage: Callable[[Sequence[Path]], FrameStage],
    depends: Mapping[str, object],
    outputs: Sequence[Path] = (),
) -> tuple[FrameRecord, ...]:
    """Frames of a folder through a stage, which is made of the paths in place of further ``outputs``."""

    def work(partial: Sequence[Path]) -> None:
        write_frames(
            frames,
            names,
            [make_stage(partial[2:])],
            FramePaths(source=folder, images=partial[0], records=partial[1]),
            lambda _, done, total: session.progress("fusing", done, total),
            least=1,
        )

    workspace = session.workspace
    session.runner.run("frames", depends, [workspace.images, workspace.frames, *outputs], work)
    return read_frame_records(workspace.frames)


def _load_frames(path: Path) -> Capture:
    """A capture whose frames can be deblurred: of short and long exposures, the short ones alone."""
    loaded = replace(load_capture(path), exposures=None)
    if loaded.frames is None:
        raise FormatError(path, Fact("capture-has-no-frames"))
    if loaded.rig:
        raise FormatError(path, Fact("frames-of-rig-not-deblurred"))
    return loaded


def deblur_capture(
    capture: StrPath,
    out: StrPath,
    *,
    method: BlurRemover = "wiener",
    purpose: DeblurPurpose = "viewing",
    calibration: CalibrationFiles = None,
    rectify: bool = False,
    sheet: Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> DeblurResult:
    """Write the frames of a capture deblurred, with their names, sizes, formats and metadata.

    Parameters
    ----------
    capture
        As for ``reconstruct``.
    out
        A folder that does not exist, or holds a run of the same capture, which is then continued. No frame is left
        out: those that cannot be deblurred are copied.
    method
        How blur is undone.
    purpose
        For viewing, or for feature extraction: then deblurred frames are smoothed as ``reconstruct`` smooths them.
    calibration
        Calibration files of this device, as of ``ReconstructOptions``.
    rectify
        Write the images without their rolling shutter, and beside them, in ``colmap/images/``, with it.
    sheet
        Where to write a PNG with parts of the most blurred frames before and after.
    overwrite, progress
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
    loaded = _load_frames(Path(capture))
    if sheet is not None:
        _require_free_sheet(sheet, Path(out))
    imu = read_capture_imu(loaded)
    timing = add_stated_exposures(loaded, read_frame_timing(loaded))
    check_pair_names(timing.names)
    options = ReconstructOptions(
        deblur=method, rolling_shutter="rectify" if rectify else "off", calibration=list_paths(calibration)
    )
    imu = correct_imu(loaded, imu, calibration)
    recording = Recording.of(loaded, imu, timing, prior_calibration(loaded, calibration))
    with _open_session(out, loaded, options, "deblur", overwrite=overwrite, progress=progress) as session:
        workspace, asked = session.workspace, Treatments(deblur=method, rolling_shutter=options.rolling_shutter)
        frames, plan = _plan(session, recording, asked)
        for_matching = purpose == "matching"
        inputs = StageInputs(recording=recording, options=options, plan=plan, maps=False, matching=for_matching)
        deblurred = workspace.colmap_images if rectify else workspace.images
        if not rectify:
            session.runner.discard(workspace.colmap)
            session.runner.forget("images")
        records = run_frames(session, recording, frames, default_frame_stages(inputs), deblurred)
        movers = default_keypoint_stages(inputs)
        rectified = rectifiable(movers, timing.names)
        if rectify:
            run_images(session, records, rectified, movers, smoothed=for_matching)
        shown = _list_deblurred(records)
        if sheet is not None and shown and plan.view is not None:
            write_json(workspace.stamps / _SHEET, {"sheet": str(sheet.resolve())})
            write_contact_sheet(sheet, frames, plan, deblurred, shown)
        frames.close()
        content = {
            "imaging": imaging_as_json(plan, rectified),
            "frames": [frame_as_json(record, plan, rectified) for record in records],
        }
        unchanged = _write_result(session, loaded, content)
        return DeblurResult(
            workspace=workspace,
            frames=note_rectified(records, rectified),
            imaging=plan,
            sheet=sheet if sheet is not None and shown else None,
            unchanged=unchanged,
            rectified=rectified,
        )


def _require_free_sheet(sheet: Path, out: Path) -> None:
    """Raise where a contact sheet cannot be written; the one of an earlier run in the same folder is written over."""
    record = Workspace(out).stamps / _SHEET
    ours = False
    with contextlib.suppress(FormatError):
        ours = read_json(record).get("sheet") == str(sheet.resolve())
    if sheet.exists() and not ours:
        raise OutputExistsError(Fact("contact-sheet-exists", path=str(sheet)))
    if not sheet.parent.is_dir():
        raise OutputError(Fact("no-parent-folder", folder=str(sheet.parent)))
    if sheet.suffix.lower() != ".png":
        raise InertialError(Fact("contact-sheet-is-png", path=str(sheet)))


def _list_deblurred(records: Sequence[FrameRecord]) -> list[str]:
    """Names of the deblurred frames, the most blurred first."""
    deblurred = [record for record in records if record.sharpened]
    return [record.name for record in sorted(deblurred, key=lambda record: -(record.value("blur_px") or 0.0))]


def fuse_aperture_capture(
    capture: StrPath,
    out: StrPath,
    options: FuseAperturesOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[Path, ...]:
    """Fuse every exposure of a capture, for images alone: no times and no IMU are needed.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[apertures]``, or its folder.
    out
        A folder that does not exist, or holds a run of the same capture, which is then continued: ``images/``, and
        where asked for ``refocused/``, ``disparity/``, ``depth/``.
    options
        Defaults serve.
    overwrite
        As for ``reconstruct``.
    progress
        Called with stage, exposures done and exposures in all.

    Returns
    -------
    The fused images.

    Raises
    ------
    FormatError, InertialError
        For what cannot be read or does not fit together.
    OutputExistsError
        Where ``out`` holds something else.
    """
    options = options or FuseAperturesOptions()
    loaded = load_capture(Path(capture))
    if loaded.apertures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, Fact("no-multi-aperture-camera"))
    names, folder = image_names(loaded.frames), loaded.frames.folder
    stage = ApertureStage(pictures=loaded.apertures, options=options.fusion)
    require_colours(loaded.apertures.rig)
    canvas = stage.canvas()
    kinds = [
        *(["disparity", "depth"] if options.fusion.depth else []),
        *(["refocused"] if options.refocus is not None else []),
    ]

    def fuse_into(folders: Sequence[Path], frames: Iterator[Frame]) -> Iterator[Frame]:
        maps = dict(zip(kinds, folders, strict=True))
        for frame in frames:
            fused = stage.fused(frame.name, frame.image)
            if options.fusion.depth:
                write_maps(maps["disparity"], maps["depth"], frame.name, fused)
            if options.refocus is not None:
                shift_px = canvas.disparity(options.refocus)
                image = refocus(fused.image, fused.disparity_px, shift_px, strength=options.lens_width)
                target = path_in(maps["refocused"], frame.name)
                target.parent.mkdir(parents=True, exist_ok=True)
                encode_image(target, image, path_in(folder, frame.name))
            yield replace(frame, image=fused.image)

    inputs = [
        fingerprint(path) for path in (*(path_in(folder, name) for name in names), *loaded.apertures.files(names))
    ]
    with _open_session(out, loaded, options, "fuse-apertures", overwrite=overwrite, progress=progress) as session:
        root = session.workspace.root
        session.runner.discard(*(root / kind for kind in ("depth", "disparity", "refocused") if kind not in kinds))
        frames = (Frame(name=name, image=read_image(path_in(folder, name)), t_s=0.0) for name in names)
        depends = {"capture": loaded, "options": options, "inputs": inputs}
        outputs = [root / kind for kind in kinds]
        records = _run_fusion(session, folder, frames, names, lambda to: partial(fuse_into, to), depends, outputs)
        _write_result(session, loaded, {"frames": [record.name for record in records]})
        return tuple(session.workspace.images / name for name in names)


def fuse_exposure_capture(
    capture: StrPath,
    out: StrPath,
    options: ExposureOptions | None = None,
    *,
    calibration: CalibrationFiles = None,
    fuser: Fuser | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[FusedPair, ...]:
    """Fuse every pair of a capture; without times or an IMU, the pixels alone align them.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[exposures]``, or its folder.
    out
        A folder that does not exist, or holds a run of the same capture, which is then continued: ``images/`` with
        the short ones' names, formats and metadata, and ``result.json``.
    options
        Defaults serve.
    calibration
        Calibration files of this device, as of ``ReconstructOptions``.
    fuser
        In place of the network that comes with the package.
    overwrite
        As for ``reconstruct``.
    progress
        Called with stage, pairs done and pairs in all.

    Raises
    ------
    FormatError, TimingError, InertialError
        For what cannot be read or does not fit together.
    MissingExtraError
        Where the network cannot run.
    OutputExistsError
        Where ``out`` holds something else.
    OutputError
        Where the disk is full.
    """
    options = options or ExposureOptions()
    loaded = load_capture(Path(capture))
    if loaded.exposures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, Fact("no-pairs-of-exposures"))
    folder, names, timing = loaded.frames.folder, image_names(loaded.frames), None
    prior = prior_calibration(loaded, calibration)
    fuser = fuser or lsd2_fuser(options)
    long = loaded.exposures.files(names)
    if loaded.frames.times is not None:
        timing = add_stated_exposures(loaded, read_frame_timing(loaded))
        names = list(timing.names)
    no_gyro = Fact("frames-without-times" if timing is None else "no-gyroscope")
    recording = None
    if timing is not None and loaded.imu is not None:
        imu = correct_imu(loaded, read_capture_imu(loaded), calibration)
        recording = Recording.of(loaded, imu, timing, prior)
    inputs = [fingerprint(path) for path in (*(path_in(folder, name) for name in names), *long)]
    with _open_session(out, loaded, options, "fuse-exposures", overwrite=overwrite, progress=progress) as session:
        plan = ImagingPlan(deblur_note=Fact("exposures-aligned", no_gyro=no_gyro))
        if recording is not None:
            _, plan = _plan(session, recording, Treatments(deblur="off", rolling_shutter="off", pairs=True))
        stage = ExposureStage.of_capture(
            loaded,
            options,
            fuser,
            view=None if timing is None or timing.exposure_s is None else plan.view,
            long=None if timing is None else loaded.exposures.timing(timing),
        )
        depends = {
            "capture": loaded,
            "timing": timing,
            "stage": stage,
            "inputs": inputs,
        }
        frames = _read_short_exposures(loaded, timing, names)
        records = _run_fusion(session, folder, frames, names, lambda _: stage, depends)
        pairs = tuple(structured(FusedPair, record.value("pair")) for record in records)
        content = {
            **note_as_json("note", plan.deblur_note),
            "fuser": fuser.identity,
            "fusion": options.fusion,
            "frames": [with_sentences(vars(pair)) for pair in pairs],
        }
        _write_result(session, loaded, content)
        return pairs


def _plan(session: Session, recording: Recording, asked: Treatments) -> tuple[FullFrames, ImagingPlan]:
    """Plan the treatment of all frames; returns these, too."""
    capture, timing, scratch = recording.capture, recording.timing, session.context.scratch
    full = FullFrames(capture, timing, scratch)
    with contextlib.closing(GreyFrames(capture, timing, scratch)) as grey:
        expect_plan(grey, recording, asked)
        return full, run_plan(session, recording, grey, full, asked)


def _read_short_exposures(capture: Capture, timing: FrameTiming | None, names: Sequence[str]) -> Iterator[Frame]:
    assert isinstance(capture.frames, ImageFolder)
    for i, name in enumerate(names):
        exposures_s = None if timing is None else timing.exposure_s
        yield Frame(
            name=name,
            image=read_image(path_in(capture.frames.folder, name)),
            t_s=0.0 if timing is None else float(timing.t_s[i]),
            exposure_s=capture.exposure_s if exposures_s is None else float(exposures_s[i]),
            camera=capture.camera,
        )
