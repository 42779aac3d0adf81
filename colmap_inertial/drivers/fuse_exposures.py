"""Captures of short and long exposures: what is decided before they are fused, and the pictures alone."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.errors import FormatError, OutputExistsError
from colmap_inertial.io.calibration import for_another_recording, read_calibration
from colmap_inertial.io.capture import Capture, ImageFolder, load_capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frames import image_names, read_frame_timing
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.options import ExposureOptions
from colmap_inertial.precalibrate.pairs import exposure_stage, for_pairs
from colmap_inertial.precalibrate.plan import ImagingPlan, with_stated_exposures
from colmap_inertial.run.progress import Progress
from colmap_inertial.run.session import keep_colmap_quiet
from colmap_inertial.run.workspace import full_disk_is_an_error
from colmap_inertial.stages.exposures import FusedPair, Fuser, lsd2_fuser
from colmap_inertial.stages.frame_folder import encode_image
from colmap_inertial.types import Frame, FrameTiming


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
