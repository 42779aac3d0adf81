"""The checks before a reconstruction: what they look at, and the stop where the recording cannot give metres."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from colmap_inertial.checks.diagnose import Diagnosis, FramesInVideo, Recorded, diagnose
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.plausible import RawImu
from colmap_inertial.io.pose_convention import COLMAP
from colmap_inertial.io.video import decode_grey, video_stamps_ns
from colmap_inertial.io.video_match import match_to_video
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
class PreflightEffort:
    """Effort of the check, before a reconstruction and by ``diagnose``."""

    #: Frames of a video that are followed by their pixels, how far apart at least, and how often they must come.
    frames: int = 400
    frame_spacing_s: float = 0.03
    video_step_s: float = 0.13
    #: Images further apart that are compared two by two.
    compared: int = 60
    #: Images that are looked for in the video they were cut from.
    images_in_video: int = 60


_EFFORT = PreflightEffort()


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
    """The checks before a reconstruction, which are those of ``diagnose``; of a ``model``, by its trajectory."""
    capture, timing = recording.capture, recording.timing
    rotation = in_video = None
    if model is None and (capture.frame_log is None or not capture.frame_log.stabilised):
        rotation = measure_images(capture, timing, progress)
        in_video = find_in_video(capture, timing, progress)
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
            in_video=in_video,
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
        raise NotObservableError("scale", f"{stopping[0].sentence} (--force goes on)")
    for finding in stopping:
        log.warning("forced to go on: %s", finding.evidence)
    return tuple(f"{finding.evidence}; forced to go on" for finding in stopping)


def measure_images(capture: Capture, timing: FrameTiming, progress: Progress) -> VisualRotation | None:
    """The rotation between images: those of a video are followed, those further apart compared; ``None`` for few."""
    if len(timing.t_s) > 1 and float(np.median(np.diff(timing.t_s))) <= _EFFORT.video_step_s:
        indices = sample_beginning(timing, _EFFORT.frame_spacing_s, _EFFORT.frames)
        return measure_sampled_rotation(
            capture, timing, guess_camera(capture, timing), indices, progress, stage="check"
        )
    if len(timing.t_s) < 5:
        return None
    first = max(0, (len(timing.t_s) - _EFFORT.compared) // 2)
    few = range(first, min(first + _EFFORT.compared, len(timing.t_s)))
    frames = counted(some_frames(capture, timing, few), len(few), "check", progress)
    camera = colmap_camera(guess_camera(capture, timing))
    with one_blas_thread():
        return measure_two_view_rotations(frames, camera, timing)


def find_in_video(capture: Capture, timing: FrameTiming, progress: Progress) -> FramesInVideo | None:
    """Some of a capture's images in the video that they were cut from; ``None`` where none is named."""
    if not isinstance(capture.frames, ImageFolder) or capture.frames.video is None:
        return None
    video = capture.frames.video
    stamps_ns = video_stamps_ns(video)
    index = np.unique(np.linspace(0, len(timing.names) - 1, _EFFORT.images_in_video).astype(np.intp))
    names = [timing.names[i] for i in index]
    match = match_to_video(
        video, capture.frames.folder, names, progress=lambda seen: progress("video", seen, len(stamps_ns))
    )
    stated_ns = {timing.names[i]: timing.epoch_ns + round(float(timing.t_s[i]) * 1e9) for i in index}
    matched = [name for name in names if name in match.t_ns]
    return FramesInVideo(
        stated_ns=np.array([stated_ns[name] for name in matched], dtype=np.int64),
        found_ns=np.array([match.t_ns[name] for name in matched], dtype=np.int64),
        video_start_ns=int(stamps_ns[0]),
        quarter_turns=match.quarter_turns,
        container_turn_deg=next(decode_grey(video))[1],
        doubtful=len(match.doubtful),
    )
