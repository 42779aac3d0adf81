"""Sources of frames: a folder of images or a video, as tables of a ``capture.toml`` describe them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.images import SUFFIXES
from colmap_inertial.io.toml_section import Section
from colmap_inertial.io.units import TIME_UNITS_NS


@dataclass(frozen=True, kw_only=True)
class ImageFolder:
    """Frames as images in a folder.

    Attributes
    ----------
    folder, pattern
        Files that match; ``None`` takes every image in the folder itself.
    times
        ``"name"`` or a CSV file; ``None`` where nothing was said.
    time_unit
        Of the names, or of the CSV where its header does not say.
    video
        What the images were cut from, where known; only ``diagnose`` looks at it.
    """

    folder: Path
    pattern: str | None = None
    times: Literal["name"] | Path | None = None
    time_unit: str | None = None
    video: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Video:
    """Frames as a video.

    Attributes
    ----------
    file
        The video.
    frame_times, time_unit
        The recorder's own frame times, one for each frame, in place of the presentation stamps.
    frames_per_s
        Use about this many; ``None`` uses all.
    """

    file: Path
    frame_times: Path | None = None
    time_unit: str | None = None
    frames_per_s: float | None = None


IMAGES_KEYS = ("folder", "pattern", "times", "time_unit", "video")


def read_image_folder(table: Section) -> ImageFolder:
    """A folder of images, as a table describes it."""
    folder = table.require("folder", table.file("folder"))
    pattern = table.text("pattern")
    times: Literal["name"] | Path | None = "name" if table.text("times") == "name" else table.file("times")
    unit = table.choice("time_unit", TIME_UNITS_NS)
    if times == "name" and unit is None:
        table.fail("times", Fact("name-times-without-unit", units=tuple(TIME_UNITS_NS)))
    if pattern is not None and (Path(pattern).is_absolute() or ".." in Path(pattern).parts):
        table.fail("pattern", Fact("pattern-outside", found=repr(pattern)))
    return ImageFolder(folder=folder, pattern=pattern, times=times, time_unit=unit, video=table.file("video"))


def read_video(table: Section, key: str) -> Video:
    """A video, as a table describes it that names the file under ``key``."""
    return Video(
        file=table.require(key, table.file(key)),
        frame_times=table.file("frame_times"),
        time_unit=table.choice("time_unit", TIME_UNITS_NS),
        frames_per_s=table.positive("frames_per_s"),
    )


def image_names(source: ImageFolder) -> list[str]:
    """Names relative to the folder, with forward slashes, as COLMAP has them."""
    if not source.folder.is_dir():
        raise FormatError(source.folder, Fact("no-such-file", what="folder of pictures"))
    if source.pattern is not None and (Path(source.pattern).is_absolute() or ".." in Path(source.pattern).parts):
        raise FormatError(source.folder, Fact("pattern-leads-out", pattern=source.pattern))
    candidates = source.folder.iterdir() if source.pattern is None else source.folder.glob(source.pattern)
    paths = [path for path in candidates if path.suffix.lower() in SUFFIXES and path.is_file()]
    if not paths:
        raise FormatError(source.folder, Fact("no-pictures", pattern=source.pattern, endings=SUFFIXES))
    return sorted(path.relative_to(source.folder).as_posix() for path in paths)
