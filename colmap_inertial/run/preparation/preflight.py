"""The checks before a reconstruction: what they look at, and the stop where the recording cannot give metres."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, Frame, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Diagnosis, FramesInVideo, Recorded, diagnose
from colmap_inertial.imaging.detail import is_blank
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import read_record, write_json, write_record
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.frames import decode_images, read_frames
from colmap_inertial.io.plausible import check_readings
from colmap_inertial.io.pose_convention import COLMAP, PoseConvention
from colmap_inertial.io.recording import Recording
from colmap_inertial.io.video import decode_grey, video_stamps_ns
from colmap_inertial.io.video_match import match_to_video
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import GreyFrame, VisualRotation
from colmap_inertial.motion.two_view_rotation import measure_two_view_rotations
from colmap_inertial.run.preparation.frame_reading import COMPARED, FOLLOWED, GLANCED_AT, GreyFrames
from colmap_inertial.run.preparation.sampling import (
    measure_sampled_rotation,
    names_at,
    sample_beginning,
    show_frames,
)
from colmap_inertial.run.steps.session import Session

log = logging.getLogger(__name__)
T = TypeVar("T")


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


def check_imu(imu: ImuRecording, *, force: bool) -> ImuRecording:
    """An inertial recording, refused where its numbers are implausible.

    Parameters
    ----------
    force
        Take one without gravity, too: its scale will be refused, its gyroscope still serves.

    Raises
    ------
    FormatError
        As :func:`~colmap_inertial.io.plausible.check_readings`.
    NotObservableError
        Where gravity was taken out.
    """
    try:
        return check_readings(imu)
    except FormatError as error:
        if error.code != "gravity-removed":
            raise
        if not force:
            raise NotObservableError(
                "scale", Fact("stopped-by-file", path=str(error.path), finding=error.fact)
            ) from None
        return imu


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckInputs:
    """The data of a recording that are checked before any work: the same for every command.

    Attributes
    ----------
    imu
        The IMU before any calibration of its own: the checks are about the sensor.
    capture
        What describes the images; ``None`` for poses that were not made from them, as those of a table.
    timing
        Of the images.
    trajectory, read_as
        Poses of a reconstruction, and the convention that they were read by; ``"untimed"`` where its images have no
        times. Without one, the images themselves are measured.
    prior, max_offset_s
        What is known of camera and IMU, and the largest offset between their clocks.
    refused
        What could not be read, and why.
    """

    imu: ImuRecording | None
    capture: Capture | None = None
    timing: FrameTiming | None = None
    trajectory: CameraTrajectory | Literal["untimed"] | None = None
    read_as: PoseConvention = COLMAP
    prior: CameraImuCalibration | None = None
    max_offset_s: float | None = None
    refused: tuple[InertialError, ...] = ()


class TolerantReader:
    """Reads what can be read, and keeps the reasons for what cannot."""

    def __init__(self, refused: Sequence[InertialError] = ()) -> None:
        self.refused = list(refused)

    def attempt(self, read: Callable[[], T]) -> T | None:
        """What ``read`` returns; ``None`` where the input is wrong."""
        try:
            return read()
        except (FormatError, TimingError) as error:
            self.refused.append(error)
            return None


def _decode_some(capture: Capture, timing: FrameTiming, places: Sequence[int]) -> Iterable[Frame]:
    """Some frames in full, by their places; of a folder, no other is opened."""
    if isinstance(capture.frames, ImageFolder):
        return decode_images(capture, timing, np.asarray(places, dtype=np.intp))
    return read_frames(capture, only=[timing.names[i] for i in places])[1]


def measure_recording(inputs: CheckInputs, progress: Progress, frames: GreyFrames | None = None) -> Recorded:
    """Measure what the checks look at: ``diagnose``, ``scale``, and each reconstruction before its work.

    Images that cannot be read are among what was refused; the rest is measured all the same. ``frames``: the images,
    where others are going to look at them, too.
    """
    reader = TolerantReader(inputs.refused)
    capture, timing, poses = inputs.capture, inputs.timing, inputs.trajectory
    log_ = None if capture is None else capture.frame_log
    rotation = in_video = None
    looked: dict[str, bool] = {}
    images: Callable[[Sequence[int]], Iterable[Frame]] | None = None

    if poses is None and capture is not None and timing is not None:
        # turns in images that the camera stabilised are not the camera's
        if log_ is None or not log_.stabilised:
            seen = frames or GreyFrames(capture, timing)
            rotation = reader.attempt(lambda: measure_images(seen, progress, looked))
        in_video = reader.attempt(lambda: find_in_video(capture, timing, progress))
        images = partial(_decode_some, capture, timing)
    return Recorded(
        refused=tuple(reader.refused),
        imu=inputs.imu,
        timing=timing,
        log=log_,
        is_capture=capture is not None and poses is None,
        rotation=rotation,
        looked_at=len(looked),
        blank=tuple(name for name, is_one in looked.items() if is_one),
        camera=None if capture is None else capture.camera,
        calibration=inputs.prior,
        trajectory=None if isinstance(poses, str) else poses,
        read_as=inputs.read_as,
        max_offset_s=inputs.max_offset_s,
        in_video=in_video,
        images=images,
    )


def run_preflight(
    session: Session,
    recording: Recording,
    imu: ImuRecording,
    findings: Callable[[Diagnosis], None],
    *,
    force: bool,
    frames: GreyFrames | None = None,
    model: CameraTrajectory | Literal["untimed"] | None = None,
) -> tuple[Fact, ...]:
    """The checks, written down and told to ``findings``; the doubts of a run that goes on, also of a forced one.

    ``frames``: the images, where others are going to look at them, too. Of a ``model``, its poses are checked in place
    of the images.

    Raises
    ------
    FormatError, TimingError
        Where images cannot be read.
    NotObservableError
        As :func:`stop_or_doubt`.
    """
    inputs = CheckInputs(
        imu=imu,
        capture=recording.capture,
        timing=recording.timing,
        trajectory=model,
        prior=recording.prior,
        max_offset_s=recording.max_offset_s,
    )
    record = session.workspace.stamps / "checked.json"

    def work(partial: Sequence[Path]) -> None:
        recorded = measure_recording(inputs, session.progress, frames)
        diagnosis = diagnose(recorded)
        if recorded.refused:
            write_json(session.workspace.diagnosis, diagnosis.as_json())
            raise recorded.refused[0]
        write_json(partial[0], diagnosis.as_json())
        write_record(partial[1], diagnosis)

    depends = {
        "imu": imu,
        "recording": {name: getattr(recording, name) for name in ("timing", "prior", "max_offset_s")},
        "capture": replace(recording.capture, target=None),
        "looked at": recording.inputs() if model is None else model,
    }
    session.runner.run("check", depends, [session.workspace.diagnosis, record], work)
    diagnosis = read_record(record, Diagnosis)
    findings(diagnosis)
    return stop_or_doubt(diagnosis, force=force)


def stop_or_doubt(diagnosis: Diagnosis, *, force: bool) -> tuple[Fact, ...]:
    """Stop where the recording cannot give metres; else, and when forced to go on, the reasons not to trust them.

    Raises
    ------
    NotObservableError
        With the finding.
    """
    for finding in diagnosis.findings:
        log.info("%s: %s: %s", finding.severity, finding.code, finding.evidence)
    stopping = diagnosis.stopping
    if stopping and not force:
        raise NotObservableError("scale", Fact("stopped-by-finding", finding=stopping[0].fact))
    for finding in stopping:
        log.warning("forced to go on: %s", finding.evidence)
    doubts = tuple(finding.reason for finding in diagnosis.doubting)
    return (*(Fact("forced-to-go-on", finding=finding.fact) for finding in stopping), *doubts)


def measure_images(frames: GreyFrames, progress: Progress, looked: dict[str, bool]) -> VisualRotation | None:
    """The rotation between images: those of a video are followed, those further apart compared; ``None`` for few.

    ``looked`` takes the names of those that were looked at, and whether they are blank.
    """
    timing = frames.timing
    is_video = len(timing.t_s) > 1 and float(np.median(np.diff(timing.t_s))) <= _EFFORT.video_step_s

    def look(frame: GreyFrame) -> None:
        [small] = frames.look(GLANCED_AT, [frame.name])
        looked[frame.name] = is_blank(small.grey)

    if is_video:
        indices = sample_beginning(timing, _EFFORT.frame_spacing_s, _EFFORT.frames)
    elif len(timing.t_s) < 5:
        return None
    else:
        first = max(0, (len(timing.t_s) - _EFFORT.compared) // 2)
        indices = list(range(first, min(first + _EFFORT.compared, len(timing.t_s))))
    names = names_at(timing, indices)
    frames.expect(GLANCED_AT, names)
    frames.expect(FOLLOWED if is_video else COMPARED, names)
    camera = frames.guess_camera()
    if is_video:
        return measure_sampled_rotation(frames, camera, indices, progress, stage="check", look=look)
    compared = report_each(frames.look(COMPARED, names), len(names), "check", progress)
    with one_blas_thread():
        return measure_two_view_rotations(show_frames(compared, look), colmap_camera(camera), timing)


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
