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
from colmap_inertial.core.types import CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Diagnosis, FramesInVideo, Recorded, diagnose
from colmap_inertial.diagnose.camera import TOO_LITTLE_ROTATION
from colmap_inertial.imaging.detail import is_blank
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import read_record, write_json, write_record
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.plausible import check_readings
from colmap_inertial.io.pose_convention import COLMAP
from colmap_inertial.io.recording import Recording
from colmap_inertial.io.video import decode_grey, video_stamps_ns
from colmap_inertial.io.video_match import match_to_video
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.flow import GreyFrame, VisualRotation
from colmap_inertial.motion.two_view_rotation import measure_two_view_rotations
from colmap_inertial.run.preparation.frame_reading import COMPARED, FOLLOWED, GLANCED_AT, WHOLE, GreyFrames
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
    #: Images further apart that are compared two by two; those of a video that are, and how far apart at least.
    compared: int = 60
    compared_in_video: int = 100
    compared_spacing_s: float = 0.1
    #: Of images that are looked at, so many are kept in full, where an exposure that nobody states is estimated by
    #: them: 0.2 GB of HD.
    in_full: int = 100
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


def add_images(recorded: Recorded, capture: Capture, progress: Progress, frames: GreyFrames | None = None) -> Recorded:
    """What was recorded, with what the images of a capture show; where there are poses, those are checked instead.

    Images that cannot be read are among what was refused; the rest is measured all the same. ``frames``: the images,
    where others are going to look at them, too.
    """
    timing = recorded.timing
    if not recorded.is_capture or timing is None:
        return recorded
    reader = TolerantReader(recorded.refused)
    rotation = None
    looked: dict[str, bool] = {}
    images: Callable[[Sequence[str]], Iterable[GreyFrame]] | None = None
    in_full: Sequence[str] = ()
    # turns in images that the camera stabilised are not the camera's
    if recorded.log is None or not recorded.log.stabilised:
        seen = frames or GreyFrames(capture, timing)
        images, in_full = partial(seen.look, WHOLE), _choose_in_full(timing)
        if recorded.imu is not None and recorded.camera is not None and timing.exposure_s is None:
            seen.expect(WHOLE, in_full)
        rotation = reader.attempt(lambda: measure_images(seen, progress, looked))
        if rotation is not None and _is_video(timing) and _is_doubtful(replace(recorded, rotation=rotation)):
            compared = reader.attempt(lambda: _compare_images(seen, _choose_compared(timing), progress, lambda _: None))
            if compared is not None and isinstance(replace(recorded, rotation=compared).aligned, Alignment):
                rotation = compared
    in_video = reader.attempt(lambda: find_in_video(capture, timing, progress))
    return replace(
        recorded,
        refused=tuple(reader.refused),
        rotation=rotation,
        looked_at=len(looked),
        blank=tuple(name for name, is_one in looked.items() if is_one),
        in_video=in_video,
        images=images,
        in_full=in_full,
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
    capture = recording.capture
    known = Recorded(
        imu=imu,
        timing=recording.timing,
        log=capture.frame_log,
        is_capture=model is None,
        trajectory=None if isinstance(model, str) else model,
        read_as=COLMAP,
        camera=capture.camera,
        calibration=recording.prior,
        max_offset_s=recording.max_offset_s,
    )
    record = session.workspace.stamps / "checked.json"

    def work(partial: Sequence[Path]) -> None:
        recorded = add_images(known, capture, session.progress, frames)
        diagnosis = diagnose(recorded)
        if recorded.refused:
            write_json(session.workspace.diagnosis, diagnosis.as_json())
            raise recorded.refused[0]
        write_json(partial[0], diagnosis.as_json())
        write_record(partial[1], diagnosis)

    depends = {
        "imu": imu,
        "recording": {name: getattr(recording, name) for name in ("timing", "prior", "max_offset_s")},
        "capture": replace(capture, target=None),
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
    is_video = _is_video(timing)

    def look(frame: GreyFrame) -> None:
        [small] = frames.look(GLANCED_AT, [frame.name])
        looked[frame.name] = is_blank(small.grey)

    if not is_video and len(timing.t_s) < 5:
        return None
    indices = _choose_images(timing)
    names = names_at(timing, indices)
    frames.expect(GLANCED_AT, names)
    frames.expect(FOLLOWED if is_video else COMPARED, names)
    if is_video:
        frames.expect(COMPARED, _choose_compared(timing))  # where the gyroscope does not fit
        return measure_sampled_rotation(frames, frames.guess_camera(), indices, progress, stage="check", look=look)
    return _compare_images(frames, names, progress, look)


def _compare_images(
    frames: GreyFrames, names: Sequence[str], progress: Progress, look: Callable[[GreyFrame], None]
) -> VisualRotation:
    """The rotation between images by two views each."""
    compared = report_each(frames.look(COMPARED, names), len(names), "check", progress)
    with one_blas_thread():
        camera = colmap_camera(frames.guess_camera())
        return measure_two_view_rotations(show_frames(compared, look), camera, frames.timing)


def _is_doubtful(recorded: Recorded) -> bool:
    """Whether the gyroscope does not fit frames that were followed, which take a moving camera's parallax for rotation.

    The geometry of two views knows it apart.
    """
    failed = recorded.aligned
    return isinstance(failed, NotObservableError) and failed.code not in TOO_LITTLE_ROTATION


def _choose_compared(timing: FrameTiming) -> list[str]:
    """Names of the frames of a video that are compared two by two."""
    indices = sample_beginning(timing, _EFFORT.compared_spacing_s, _EFFORT.compared_in_video)
    return names_at(timing, indices)


def _is_video(timing: FrameTiming) -> bool:
    return len(timing.t_s) > 1 and float(np.median(np.diff(timing.t_s))) <= _EFFORT.video_step_s


def _choose_images(timing: FrameTiming) -> list[int]:
    """Indices of the images to look at: of a video from its beginning, of others those in the middle."""
    if _is_video(timing):
        return sample_beginning(timing, _EFFORT.frame_spacing_s, _EFFORT.frames)
    first = max(0, (len(timing.t_s) - _EFFORT.compared) // 2)
    return list(range(first, min(first + _EFFORT.compared, len(timing.t_s))))


def _choose_in_full(timing: FrameTiming) -> list[str]:
    """Names of the images to keep in full, evenly among those that are looked at."""
    names = names_at(timing, _choose_images(timing))
    if not names:
        return []
    return [names[i] for i in np.unique(np.linspace(0, len(names) - 1, _EFFORT.in_full).astype(np.intp))]


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
