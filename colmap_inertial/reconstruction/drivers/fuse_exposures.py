"""``fuse-exposures``: the pictures of pairs of a short and a long exposure alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.options import ExposureOptions
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.io.calibration import CalibrationFiles
from colmap_inertial.io.capture import Capture, ImageFolder, load_capture
from colmap_inertial.io.files import StrPath, path_in, structured
from colmap_inertial.io.frames import image_names, picture_folders, read_frame_timing
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.pipeline.run.context import Recording, RunContext, corrected_imu, prior_calibration
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.pipeline.run.runner import fingerprint
from colmap_inertial.pipeline.run.session import open_session
from colmap_inertial.pipeline.stages.exposures import ExposureStage, FusedPair
from colmap_inertial.pipeline.stages.frame_folder import FramePaths, read_frame_records, write_frames
from colmap_inertial.pipeline.stages.fusers import Fuser, lsd2_fuser
from colmap_inertial.pipeline.stages.imaging_plan import ImagingPlan
from colmap_inertial.reconstruction.drivers.frames import run_plan
from colmap_inertial.reconstruction.preparation.plan import Treatments, with_stated_exposures


def fuse_exposures_captured(
    capture: StrPath,
    out: StrPath,
    options: ExposureOptions | None = None,
    *,
    calibration: CalibrationFiles = None,
    fuser: Fuser | None = None,
    progress: Progress = silent,
) -> tuple[FusedPair, ...]:
    """Fuse every pair of a capture; without times or an IMU, the pixels alone align them.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[exposures]``, or its folder.
    out
        A folder that does not exist, or holds a run of the same capture, which is then gone on with: ``images/`` with
        the short ones' names, formats and metadata, and ``result.json``.
    options
        Defaults serve.
    calibration
        Calibration files of this device, as of ``ReconstructOptions``.
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
        Where ``out`` holds something else.
    OutputError
        Where the disk is full.
    """
    options = options or ExposureOptions()
    loaded = load_capture(Path(capture))
    if loaded.exposures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, "describes no pairs of exposures: add [images] and [exposures]")
    folder, names, timing = loaded.frames.folder, image_names(loaded.frames), None
    prior = prior_calibration(loaded, calibration)
    fuser = fuser or lsd2_fuser(options)
    long = loaded.exposures.files(names)
    if loaded.frames.times is not None:
        timing = with_stated_exposures(loaded, read_frame_timing(loaded))
        names = list(timing.names)
    note = "short and long exposures are fused, aligned by the pixels alone: no gyroscope"
    recording = None
    if timing is None:
        note = note.replace("no gyroscope", "the frames have no times")
    elif loaded.imu is not None:
        imu = corrected_imu(loaded, read_capture_imu(loaded), calibration)
        recording = Recording.of(loaded, imu, timing, prior)
    pictures = picture_folders(loaded)
    with open_session(
        Path(out), loaded.path, options, RunContext(progress=progress), pictures=pictures, command="fuse-exposures"
    ) as session:
        workspace = session.workspace
        plan = ImagingPlan(deblur_note=note)
        if recording is not None:
            plan = run_plan(session, recording, Treatments(deblur="off", rolling_shutter="off", pairs=True))
        stage = ExposureStage.of_capture(
            loaded,
            options,
            fuser,
            view=None if timing is None or timing.exposure_s is None else plan.view,
            long=None if timing is None else loaded.exposures.timing(timing),
        )

        def work(partial: Sequence[Path]) -> None:
            write_frames(
                _frames(loaded, timing, names),
                names,
                [stage],
                FramePaths(source=folder, images=partial[0], records=partial[1]),
                lambda _, done, total: progress("fusing", done, total),
                least=1,
            )

        depends = {
            "capture": loaded,
            "timing": timing,
            "stage": stage,
            "inputs": [fingerprint(path) for path in (*(path_in(folder, name) for name in names), *long)],
        }
        session.runner.run("frames", depends, [workspace.images, workspace.frames], work)
        pairs = tuple(structured(FusedPair, record.value("pair")) for record in read_frame_records(workspace.frames))
        session.finish(
            {
                "versions": {"colmap_inertial": __version__},
                "capture": str(loaded.path),
                "source": str(folder),
                "note": plan.deblur_note,
                "fuser": fuser.identity,
                "fusion": options.fusion,
                "frames": [asdict(pair) for pair in pairs],
                "seconds": session.runner.seconds,
            }
        )
        return pairs


def _frames(capture: Capture, timing: FrameTiming | None, names: Sequence[str]) -> Iterator[Frame]:
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
