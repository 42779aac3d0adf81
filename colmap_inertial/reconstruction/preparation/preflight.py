"""The checks before a reconstruction: what they look at, and the stop where the recording cannot give metres."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from colmap_inertial.checks.diagnose import Diagnosis, Recorded, diagnose
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.plausible import RawImu
from colmap_inertial.io.pose_convention import COLMAP
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import VisualRotation
from colmap_inertial.motion.two_view_rotation import measure_two_view_rotations
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.pipeline.run.progress import Progress, counted
from colmap_inertial.pipeline.run.session import Session
from colmap_inertial.reconstruction.preparation.sampling import (
    guess_camera,
    measure_sampled_rotation,
    sample_beginning,
    some_frames,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FollowingLimits:
    """Which images a check of the recording follows."""

    #: Frames that are followed by their pixels come at least so often; how many are, before a reconstruction and when
    #: asked to diagnose, and how far apart at least.
    video_step_s: float = 0.13
    few: int = 90
    few_spacing_s: float = 0.09
    #: Pictures further apart that are compared two by two.
    compared: int = 60


_LIMITS = FollowingLimits()


def check_imu(raw: RawImu, *, force: bool) -> RawImu:
    """An inertial recording, refused where its numbers are implausible.

    Parameters
    ----------
    force
        Take one without gravity, too: its scale will be refused, its gyroscope still serves.

    Raises
    ------
    FormatError
        As ``RawImu.check``.
    NotObservableError
        Where gravity was taken out.
    """
    try:
        raw.check()
    except FormatError as error:
        if error.code != "gravity-removed":
            raise
        if not force:
            raise NotObservableError("scale", f"{error} (--force goes on)") from None
    return raw


def preflight(
    recording: Recording,
    raw: RawImu,
    progress: Progress,
    *,
    model: CameraTrajectory | Literal["untimed"] | None = None,
) -> Diagnosis:
    """The checks before a reconstruction, or of a ``model`` by its trajectory: all but what needs many images."""
    capture, timing = recording.capture, recording.timing
    rotation = None
    if model is None and (capture.frame_log is None or not capture.frame_log.stabilised):
        rotation = follow_video(capture, timing, _LIMITS.few, _LIMITS.few_spacing_s, progress)
    return diagnose(
        Recorded(
            imu=raw.imu,
            gyro_axes=raw.gyro_axes,
            accel_axes=raw.accel_axes,
            timing=timing,
            log=capture.frame_log,
            is_capture=model is None,
            rotation=rotation,
            camera=capture.camera,
            calibration=recording.prior,
            trajectory=None if isinstance(model, str) else model,
            read_as=COLMAP,
            max_offset_s=recording.max_offset_s,
        )
    )


def run_preflight(
    session: Session,
    recording: Recording,
    raw: RawImu,
    findings: Callable[[Diagnosis], None],
    *,
    force: bool,
    model: CameraTrajectory | Literal["untimed"] | None = None,
) -> tuple[str, ...]:
    """The checks, written down and told to ``findings``; the doubts of a run that is forced to go on.

    Raises
    ------
    NotObservableError
        As :func:`stop_or_doubt`.
    """
    diagnosis = preflight(recording, raw, session.progress, model=model)
    write_json(session.workspace.diagnosis, diagnosis.as_json())
    findings(diagnosis)
    return stop_or_doubt(diagnosis, force=force)


def stop_or_doubt(diagnosis: Diagnosis, *, force: bool) -> tuple[str, ...]:
    """Stop where the recording cannot give metres; when forced to go on, the reasons not to trust them.

    Raises
    ------
    NotObservableError
        With the finding's words.
    """
    for finding in diagnosis.findings:
        log.info("%s: %s: %s", finding.severity, finding.code, finding.evidence)
    stopping = diagnosis.stopping
    if stopping and not force:
        first = stopping[0]
        raise NotObservableError("scale", f"{first.evidence}; {first.advice} (--force goes on)")
    for finding in stopping:
        log.warning("forced to go on: %s", finding.evidence)
    return tuple(f"{finding.evidence}; forced to go on" for finding in stopping)


def follow_video(
    capture: Capture, timing: FrameTiming, most: int, spacing_s: float, progress: Progress
) -> VisualRotation | None:
    """The rotation between frames from the beginning of a video; ``None`` for pictures further apart.

    Of ``most`` frames, at least ``spacing_s`` apart.
    """
    if len(timing.t_s) < 2 or float(np.median(np.diff(timing.t_s))) > _LIMITS.video_step_s:
        return None
    indices = sample_beginning(timing, spacing_s, most)
    return measure_sampled_rotation(capture, timing, guess_camera(capture, timing), indices, progress)


def compare_pictures(capture: Capture, timing: FrameTiming, progress: Progress) -> VisualRotation | None:
    """The rotation between pictures that are too far apart in time to be followed; ``None`` for fewer than five."""
    if len(timing.t_s) < 5:
        return None
    first = max(0, (len(timing.t_s) - _LIMITS.compared) // 2)
    indices = range(first, min(first + _LIMITS.compared, len(timing.t_s)))
    frames = counted(some_frames(capture, timing, indices), len(indices), "motion", progress)
    camera = colmap_camera(guess_camera(capture, timing))
    with one_blas_thread():
        return measure_two_view_rotations(frames, camera, timing)
