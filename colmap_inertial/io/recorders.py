"""Recordings that describe themselves: video, IMU and what the recorder noted about the frames, found from one path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.io import android, camm, gopro, ios, video_imu_capture
from colmap_inertial.types import FrameLog


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What was found.

    Attributes
    ----------
    format, imu
        What ``read_imu`` takes.
    video
        The pictures; ``None`` where they do not lie where the recorder puts them.
    log
        What the recorder noted about the frames.
    """

    format: str
    imu: Path
    video: Path | None
    log: FrameLog | None


#: Name, test, reader of the frame log, and the video's place in a recorder's folder.
_VIDEOS: tuple[tuple[str, Callable[[Path], bool], Callable[[Path], FrameLog]], ...] = (
    ("gopro", gopro.is_gopro, gopro.read_gopro_frames),
    ("camm", camm.is_camm, camm.read_camm_frames),
)
_FOLDERS: tuple[tuple[str, Callable[[Path], bool], Callable[[Path], FrameLog | None], tuple[str, ...]], ...] = (
    (
        "video-imu-capture",
        video_imu_capture.is_video_imu_capture,
        video_imu_capture.read_video_imu_capture_frames,
        ("video_recording.mp4",),
    ),
    ("mars", android.is_mars, android.read_mars_frames, ("movie.mp4", "movie.mov", "movie.MOV")),
    ("opencamera", android.is_opencamera, android.read_opencamera_frames, ("*.mp4", "../VID_{name}.mp4")),
    ("stray-scanner", ios.is_stray_scanner, ios.read_stray_scanner_frames, ("rgb.mp4",)),
)


def find_recording(path: Path) -> Recording | None:
    """The recording at ``path``: a video with an IMU inside, or a recorder's folder; ``None`` where it is neither.

    Raises
    ------
    FormatError
        Where it is one of these, and damaged.
    """
    if path.is_file():
        for name, is_one, read in _VIDEOS:
            if is_one(path):
                return Recording(format=name, imu=path, video=path, log=read(path))
        return None
    if path.is_dir():
        for name, accepts, read_log, places in _FOLDERS:
            if accepts(path):
                return Recording(format=name, imu=path, video=_video(path, places), log=read_log(path))
    return None


def _video(folder: Path, places: tuple[str, ...]) -> Path | None:
    """The one video in the first of the places that has one."""
    for place in places:
        found = sorted(file for file in folder.glob(place.format(name=folder.name)) if file.is_file())
        if len(found) == 1:
            return found[0]
    return None
