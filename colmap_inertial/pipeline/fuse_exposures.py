"""Captures of short and long exposures: what is decided before they are fused, and the pictures alone."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.errors import FormatError, InertialError, NotObservableError, OutputExistsError
from colmap_inertial.io.calibration import SHARED_CLOCK_OFFSET_S, for_another_recording, read_calibration
from colmap_inertial.io.capture import Capture, ImageFolder, load_capture
from colmap_inertial.io.exposures import LongExposures
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frames import image_names, read_frame_timing
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.options import ExposureOptions
from colmap_inertial.pipeline.colmap import Progress, keep_colmap_quiet
from colmap_inertial.pipeline.exposures import ExposureStage, FusedPair, Fuser, lsd2_fuser
from colmap_inertial.pipeline.first_look import look_first
from colmap_inertial.pipeline.frames import encode_image
from colmap_inertial.pipeline.imaging import ImagingPlan, with_stated_exposures
from colmap_inertial.pipeline.stages import GyroView
from colmap_inertial.pipeline.workspace import full_disk_is_an_error
from colmap_inertial.types import CameraImuCalibration, Frame, FrameTiming, ImuRecording


def fuses_pairs(capture: Capture, options: ExposureOptions, *, deblur: str | None) -> bool:
    """Whether frames are made of pairs; what stands against it is said before any work.

    Raises
    ------
    InertialError
        Where deblurring was asked for by name, too.
    FormatError
        Where a long exposure is missing.
    """
    if capture.exposures is None or not options.fuse:
        return False
    if deblur not in (None, "off"):
        raise InertialError(
            f"--deblur {deblur}: frames of short and long exposures are fused, and not deblurred then; leave it out, "
            "or leave out the long ones by --exposures.no-fuse"
        )
    assert isinstance(capture.frames, ImageFolder)
    capture.exposures.files(image_names(capture.frames))
    return True


def for_pairs(
    plan: ImagingPlan,
    capture: Capture,
    imu: ImuRecording,
    timing: FrameTiming,
    prior: CameraImuCalibration,
    *,
    scratch: Path,
    max_offset_s: float | None = None,
    num_threads: int = -1,
    seed: int = 0,
    progress: Progress,
) -> ImagingPlan:
    """The plan of a capture whose frames are fused: with a view by which pairs are aligned, where there can be one.

    Parameters
    ----------
    plan
        Without deblurring.
    capture, imu, timing, prior, scratch, max_offset_s, num_threads, seed, progress
        As for ``plan_imaging``.
    """
    assert capture.exposures is not None
    view, why_not = plan.view, _no_gyro(capture.exposures, timing)
    if view is None and not why_not:
        if max_offset_s is None and capture.shared_clock:
            max_offset_s = SHARED_CLOCK_OFFSET_S
        try:
            view = look_first(
                capture,
                imu,
                timing,
                prior,
                max_offset_s=max_offset_s,
                scratch=scratch,
                num_threads=num_threads,
                seed=seed,
                progress=progress,
            ).view
        except NotObservableError as error:
            why_not = str(error)
    note = "short and long exposures are fused, aligned by the "
    note += f"pixels alone: {why_not}" if why_not or view is None else "gyroscope and the pixels"
    return replace(plan, view=view, deblur_note=note)


def _no_gyro(exposures: LongExposures, timing: FrameTiming) -> str:
    """Why a gyroscope cannot align pairs; empty where it may."""
    if timing.exposure_s is None:
        return (
            "the short ones' exposure time is unknown; give exposure_s under [timing] in capture.toml, or a column of "
            "it in the frame times"
        )
    if exposures.timing(timing) is None:
        return (
            "start or length of the long exposures is unknown; give times with a column exposure_s, or long_delay_s "
            "and long_exposure_s, under [exposures] in capture.toml"
        )
    return ""


def exposure_stage(
    capture: Capture,
    options: ExposureOptions,
    *,
    timing: FrameTiming | None,
    view: GyroView | None,
    fuser: Fuser | None = None,
) -> ExposureStage:
    """The stage for a capture with pairs.

    Parameters
    ----------
    timing
        Of the short exposures, where it is known.
    view
        Of the same; ``None`` where the pixels alone align pairs.
    fuser
        In place of the network that comes with the package.

    Raises
    ------
    TimingError
        As ``LongExposures.timing``.
    MissingExtraError, FormatError, InertialError
        As ``imaging.restoration.load_network``.
    """
    assert capture.exposures is not None and isinstance(capture.frames, ImageFolder)
    return ExposureStage(
        pictures=capture.exposures,
        folder=capture.frames.folder,
        fuser=fuser or lsd2_fuser(options),
        fusion=options.fusion,
        view=None if timing is None or timing.exposure_s is None else view,
        long=None if timing is None else capture.exposures.timing(timing),
    )


def fuse_exposures_captured(
    capture: Path,
    out: Path,
    options: ExposureOptions | None = None,
    *,
    calibration: Path | None = None,
    fuser: Fuser | None = None,
    progress: Progress,
) -> tuple[FusedPair, ...]:
    """Fuse every pair of a capture; without times or an IMU, the pixels alone align them.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[exposures]``, or its folder.
    out
        A folder that does not exist: ``images/`` with the short ones' names, formats and metadata, and ``result.json``.
    options
        Defaults serve.
    calibration
        A calibration file of this device.
    fuser
        In place of the network that comes with the package.
    progress
        Called with stage, pairs done and pairs in all.

    Raises
    ------
    FormatError, TimingError, InertialError
        For what cannot be read or does not fit together.
    MissingExtraError
        Where the network cannot run.
    OutputExistsError
        Where ``out`` exists.
    OutputError
        Where the disk is full.
    """
    options = options or ExposureOptions()
    loaded = load_capture(capture)
    if loaded.exposures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, "describes no pairs of exposures: add [images] and [exposures]")
    if out.exists():
        raise OutputExistsError(f"{out} exists already; name a new folder")
    prior = loaded.calibration
    if calibration is not None:
        prior = for_another_recording(read_calibration(calibration), shared_clock=loaded.shared_clock)
    fuser = fuser or lsd2_fuser(options)
    timing, names = None, image_names(loaded.frames)
    loaded.exposures.files(names)
    if loaded.frames.times is not None:
        timing = with_stated_exposures(loaded, read_frame_timing(loaded))
        names = list(timing.names)
    plan = ImagingPlan(deblur_note="short and long exposures are fused, aligned by the pixels alone: no gyroscope")
    if timing is None:
        plan = replace(plan, deblur_note=plan.deblur_note.replace("no gyroscope", "the frames have no times"))
    elif loaded.imu is not None:
        imu = read_capture_imu(loaded)
        keep_colmap_quiet()
        with tempfile.TemporaryDirectory() as scratch:
            plan = for_pairs(plan, loaded, imu, timing, prior, scratch=Path(scratch), progress=progress)
    stage = exposure_stage(loaded, options, timing=timing, view=plan.view, fuser=fuser)
    fused = stage(_frames(loaded, timing, names))
    with full_disk_is_an_error(out, "make room, remove the folder and start again"):
        for done, frame in enumerate(fused, start=1):
            source, target = loaded.frames.folder / frame.name, out / "images" / frame.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if stage.pairs()[-1].fused:
                encode_image(target, frame.image, source)
            else:
                target.write_bytes(source.read_bytes())
            progress("fusing", done, len(names))
        write_json(
            out / "result.json",
            {
                "versions": {"colmap_inertial": __version__},
                "capture": str(loaded.path),
                "source": str(loaded.frames.folder),
                "note": plan.deblur_note,
                "fuser": fuser.identity,
                "fusion": options.fusion,
                "frames": [asdict(pair) for pair in stage.pairs()],
            },
        )
    return stage.pairs()


def _frames(capture: Capture, timing: FrameTiming | None, names: Sequence[str]) -> Iterator[Frame]:
    assert isinstance(capture.frames, ImageFolder)
    for i, name in enumerate(names):
        exposures_s = None if timing is None else timing.exposure_s
        yield Frame(
            name=name,
            image=read_image(capture.frames.folder / name),
            t_s=0.0 if timing is None else float(timing.t_s[i]),
            exposure_s=capture.exposure_s if exposures_s is None else float(exposures_s[i]),
            camera=capture.camera,
        )


__all__ = ["exposure_stage", "for_pairs", "fuse_exposures_captured", "fuses_pairs"]
