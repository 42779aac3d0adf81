"""Recordings that describe themselves: video, IMU and what the recorder noted about the frames, found from one path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.types import FrameLog
from colmap_inertial.io.imu_formats import imu_formats


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


def find_recording(path: Path) -> Recording | None:
    """The recording at ``path``: a video with an IMU inside, or a recorder's folder; ``None`` where it is neither.

    Raises
    ------
    FormatError
        Where it is one of these, and damaged.
    """
    for one in imu_formats():
        if one.video is not None and bool(one.video) == path.is_dir() and one.accepts(path):
            video = _video(path, one.video) if one.video else path
            noted = None if one.frames is None else one.frames(path)
            return Recording(format=one.name, imu=path, video=video, log=noted)
    return None


def _video(folder: Path, places: tuple[str, ...]) -> Path | None:
    """The one video in the first of the places that has one."""
    for place in places:
        found = sorted(file for file in folder.glob(place.format(name=folder.name)) if file.is_file())
        if len(found) == 1:
            return found[0]
    return None
