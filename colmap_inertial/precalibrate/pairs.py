"""Pairs of a short and a long exposure: what is decided before they are fused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from colmap_inertial.errors import InertialError, NotObservableError
from colmap_inertial.io.calibration import SHARED_CLOCK_OFFSET_S
from colmap_inertial.io.capture import Capture, ImageFolder
from colmap_inertial.io.exposures import LongExposures
from colmap_inertial.io.frames import image_names
from colmap_inertial.options import ExposureOptions
from colmap_inertial.precalibrate.calibrate import look_first
from colmap_inertial.precalibrate.plan import ImagingPlan
from colmap_inertial.run.progress import Progress
from colmap_inertial.stages.exposures import ExposureStage, Fuser, lsd2_fuser
from colmap_inertial.stages.gyro_view import GyroView
from colmap_inertial.types import CameraImuCalibration, FrameTiming, ImuRecording


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
