"""What is given beside an existing project: its IMU recording, its images, and when these were taken."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.core.progress import Progress
from colmap_inertial.core.types import (
    CameraImuCalibration,
    FrameTiming,
    ImuRecording,
    ReadoutDirection,
)
from colmap_inertial.io.calibration import calibration_prior, describe_files
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.exif import read_exposures_s, stamps_of_exif
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.frame_times import FrameStamps, stamps_of_pattern
from colmap_inertial.io.frames import read_frame_times, read_frame_timing
from colmap_inertial.io.imu import is_capture, read_unchecked_capture_imu, read_unchecked_imu
from colmap_inertial.io.imu_formats import find_recorder_output
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.recording import correct_imu, prior_calibration
from colmap_inertial.io.video import video_stamps_ns
from colmap_inertial.io.video_match import match_to_video
from colmap_inertial.model.rigs import frames_of_rigs
from colmap_inertial.run.preparation.preflight import check_imu
from colmap_inertial.run.steps.session import Session

if TYPE_CHECKING:
    import pycolmap

#: With fewer of the images found in the video, it is not theirs.
_LEAST_SHARE = 0.5
#: Digits of EXIF's fraction of a second that are as good as milliseconds.
_FINE_DIGITS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class ProjectSources:
    """Inputs given beside the project.

    Attributes
    ----------
    capture
        What is known of the recording, in a capture's terms; its frames are those of a capture that was given.
    raw, imu
        The IMU as it was recorded, and as its own calibration corrects it.
    prior
        Calibration of camera and IMU that is known beforehand.
    calibration_files
        What the result says of them.
    """

    source: ProjectOptions
    capture: Capture
    raw: ImuRecording
    imu: ImuRecording
    prior: CameraImuCalibration
    calibration_files: list[dict[str, str]]


def _require_recording(project: Path, source: ProjectOptions) -> Path:
    if source.imu is None:
        stated = (source.frame_times, source.name_times, source.video, source.exif_times or None)
        is_timed = any(times is not None for times in stated)
        raise FormatError(project, Fact("project-needs-imu" if is_timed else "project-needs-imu-and-times"))
    if source.frame_times is not None and not source.frame_times.exists():
        raise FormatError(source.frame_times, Fact("no-such-file", what="file or folder"))
    return source.imu


def read_sources(project: Path, source: ProjectOptions, options: ReconstructOptions) -> ProjectSources:
    """Read what was given beside the project, before any work."""
    imu, times = _require_recording(project, source), source.frame_times
    described = [p for p in (imu, times) if p is not None and (is_capture(p) or find_recorder_output(p) is not None)]
    captures = [load_capture(path) for path in described]
    raw = read_unchecked_capture_imu(captures[0]) if described[:1] == [imu] else read_unchecked_imu(imu)
    capture = captures[0] if captures else Capture(path=project, calibration=calibration_prior())
    frames = next((c.frames for c in captures if c.frames is not None), None)
    own_clock = source.exif_times or (source.video is not None and not isinstance(frames, Video))
    shared = any(c.shared_clock for c in captures) and not own_clock
    capture = dataclasses.replace(capture, path=project, frames=frames, shared_clock=shared)
    if source.video is not None:
        capture = _add_video(capture, source.video, None if times in described else times)
    elif frames is None and not (times or source.name_times is not None or source.exif_times):
        raise TimingError(Fact("project-untimed", project=str(project)))
    raw = check_imu(raw, force=options.force)
    return ProjectSources(
        source=source,
        capture=capture,
        raw=raw,
        calibration_files=describe_files(options.calibration),
        prior=prior_calibration(capture, options.calibration),
        imu=correct_imu(capture, raw, options.calibration),
    )


def _add_video(capture: Capture, video: Path, times: Path | None) -> Capture:
    """The capture with all frames of a video; what the recorder noted about them counts where it is the recorder's."""
    frames = Video(file=video) if not isinstance(capture.frames, Video) else capture.frames
    if not isinstance(capture.frames, Video) and (recording := find_recorder_output(video)) is not None:
        log_ = recording.log
        capture = dataclasses.replace(capture, frame_log=log_)
        if log_ is not None and capture.readout_s is None:
            capture = dataclasses.replace(capture, readout_s=log_.readout_s, readout_direction=log_.readout_direction)
    frames = dataclasses.replace(frames, file=video, frames_per_s=None)
    return dataclasses.replace(
        capture, frames=frames if times is None else dataclasses.replace(frames, frame_times=times)
    )


def find_images(project: Path, source: ProjectOptions, *, needed: bool) -> Path | None:
    folder = project / "images" if source.images is None else source.images
    if folder.is_dir():
        return folder
    if source.images is not None or needed:
        raise FormatError(folder, Fact("no-folder-of-pictures"))
    return None


@dataclass(frozen=True, eq=False, kw_only=True)
class _TimedImages:
    """Times of the images, with notes for the user."""

    timing: FrameTiming
    notes: tuple[Fact, ...]


def run_times(
    session: Session,
    given: ProjectSources,
    models: dict[int, Path],
    images: Path | None,
    read: Callable[[Path], pycolmap.Reconstruction],
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    """Read the times of the images, with notes for the user."""

    def work(partial: Sequence[Path]) -> None:
        first_of = frames_of_rigs(read(folder) for folder in models.values())
        timing, notes = _read_times(given, list_registered(models, read), first_of, images, session.progress)
        write_record(partial[0], _TimedImages(timing=timing, notes=notes))

    frames = given.capture.frames
    stated = frames.frame_times if isinstance(frames, Video) else None if frames is None else frames.times
    inputs = [given.source.frame_times, given.source.video, images, stated if isinstance(stated, Path) else None]
    depends = {
        "source": dataclasses.replace(given.source, keep=(), link=False),
        "capture": dataclasses.replace(given.capture, target=None),
        "models": [fingerprint(folder) for folder in models.values()],
        "inputs": [fingerprint(path) for path in inputs if path is not None],
    }
    session.runner.run("times", depends, [session.workspace.frames], work)
    times = read_record(session.workspace.frames, _TimedImages)
    return times.timing, times.notes


def list_registered(models: dict[int, Path], read: Callable[[Path], pycolmap.Reconstruction]) -> list[str]:
    """Names of all images of the models."""
    reconstructions = [read(folder) for folder in models.values()]
    return sorted({model.image(i).name for model in reconstructions for i in model.reg_image_ids()})


def _read_times(
    given: ProjectSources, names: Sequence[str], first_of: Mapping[str, str], images: Path | None, progress: Progress
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    source, capture = given.source, given.capture
    notes: tuple[Fact, ...] = ()
    if source.video is not None:
        assert images is not None
        timing, notes = _read_video_times(capture, source.video, images, names, progress)
    elif source.exif_times:
        assert images is not None
        stamps, digits = stamps_of_exif(images, names)
        timing = _time_frames(capture, stamps.one_per_frame(first_of))
        if digits < _FINE_DIGITS:
            notes = (Fact("exif-times-coarse", digits=digits),)
    elif source.name_times is not None:
        timing = _time_frames(
            capture, stamps_of_pattern(images or Path(), names, source.name_times).one_per_frame(first_of)
        )
    elif source.frame_times is not None:
        timing = read_frame_times(source.frame_times, first_of)
        if timing.readout_s is None:
            timing = dataclasses.replace(
                timing, readout_s=capture.readout_s, readout_direction=capture.readout_direction
            )
    else:
        timing = read_frame_timing(capture, first_of)
    # an exposure that the images state belongs to the frames; one that they do not is no reason to stop
    if timing.exposure_s is None and images is not None:
        paths = [picture_in(images, name) for name in timing.names]
        if all(path.is_file() for path in paths):
            timing = dataclasses.replace(timing, exposure_s=read_exposures_s(paths))
    return timing, notes


def _time_frames(capture: Capture, stamps: FrameStamps) -> FrameTiming:
    timing = stamps.timing(exposure_s=capture.exposure_s, readout_s=capture.readout_s)
    return dataclasses.replace(timing, readout_direction=capture.readout_direction)


def _read_video_times(
    capture: Capture, video: Path, images: Path, names: Sequence[str], progress: Progress
) -> tuple[FrameTiming, tuple[Fact, ...]]:
    stamps_ns = video_stamps_ns(video)
    every = read_frame_timing(capture)
    match = match_to_video(video, images, names, progress=lambda done: progress("video", done, len(stamps_ns)))
    if len(match.t_ns) < max(2, _LEAST_SHARE * len(names)):
        name, why = next(iter(match.doubtful.items()), ("", None))
        found, images_ = len(match.t_ns), len(names)
        raise TimingError(
            Fact("video-of-other-images", video=str(video), found=found, images=images_, name=name, why=why)
        )
    name_of = {t_ns: name for name, t_ns in match.t_ns.items()}
    kept = [i for i, t_ns in enumerate(stamps_ns.tolist()) if t_ns in name_of]
    # counterclockwise, as the images were turned against the frames
    directions: tuple[ReadoutDirection, ...] = ("down", "right", "up", "left")
    assert set(directions) == set(get_args(ReadoutDirection))
    turned = (directions.index(every.readout_direction) + match.quarter_turns) % 4
    timing = FrameTiming(
        names=tuple(name_of[int(stamps_ns[i])] for i in kept),
        t_s=every.t_s[kept],
        exposure_s=None if every.exposure_s is None else every.exposure_s[kept],
        readout_s=every.readout_s,
        readout_direction=directions[turned],
        epoch_ns=every.epoch_ns,
    )
    notes = []
    for why in sorted(set(match.doubtful.values()), key=str):
        those = [name for name, reason in match.doubtful.items() if reason == why]
        notes.append(Fact("images-untimed-by-video", count=len(those), images=len(names), why=why, first=those[0]))
    return timing, tuple(notes)
