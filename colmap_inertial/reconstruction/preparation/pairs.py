"""Pairs of a short and a long exposure: what is decided before they are fused."""

from __future__ import annotations

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import ExposureOptions
from colmap_inertial.io.capture import Capture, ImageFolder
from colmap_inertial.io.exposures import LongTiming
from colmap_inertial.io.frames import image_names
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.pipeline.stages.exposures import ExposureStage, Fuser
from colmap_inertial.pipeline.stages.gyro_view import GyroView


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


def exposure_stage(
    recording: Recording, options: ExposureOptions, view: GyroView | None, fuser: Fuser
) -> ExposureStage:
    """The stage for a recording with pairs.

    Parameters
    ----------
    view
        Of the short exposures; ``None`` where the pixels alone align pairs.
    fuser
        What makes one picture of two.

    Raises
    ------
    TimingError
        As ``LongExposures.timing``.
    """
    timing = recording.timing
    return pair_stage(
        recording.capture,
        options,
        fuser,
        view=None if timing.exposure_s is None else view,
        long=None if recording.capture.exposures is None else recording.capture.exposures.timing(timing),
    )


def pair_stage(
    capture: Capture,
    options: ExposureOptions,
    fuser: Fuser,
    *,
    view: GyroView | None = None,
    long: LongTiming | None = None,
) -> ExposureStage:
    """The same for a capture of which the times may be unknown."""
    assert capture.exposures is not None and isinstance(capture.frames, ImageFolder)
    return ExposureStage(
        pictures=capture.exposures,
        folder=capture.frames.folder,
        fuser=fuser,
        fusion=options.fusion,
        view=view,
        long=long,
    )
