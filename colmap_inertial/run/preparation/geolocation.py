"""Positions on Earth that a capture carries, met with where its frames were taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import PositionFixes
from colmap_inertial.inertial.georeference import Georeference, georeference_of_json
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import a_record_of_ours, read_json
from colmap_inertial.io.frame_sources import ImageFolder, Video
from colmap_inertial.io.positions import positions_in_pictures, positions_in_video


def positions_of(capture: Capture, names: Sequence[str], images: Path | None = None) -> PositionFixes:
    """The positions that a capture carries.

    Parameters
    ----------
    capture
        Of the recording.
    names
        Of the frames.
    images
        Where an existing project has its images.

    Raises
    ------
    FormatError
        Where it has none, or none on its frames' clock.
    """
    frames = capture.frames
    if isinstance(frames, Video):
        if frames.frame_times is not None:
            raise FormatError(frames.frame_times, Fact("frames-on-another-clock"))
        return positions_in_video(frames.file)
    folder = images if images is not None else frames.folder if isinstance(frames, ImageFolder) else None
    if folder is None:
        raise FormatError(capture.path, Fact("nothing-with-positions"))
    return positions_in_pictures(folder, names)


def read_georeference(path: Path, index: int) -> Georeference | None:
    """Read the georeference of one of a run's models; ``None`` where it was not asked for.

    Raises
    ------
    NotObservableError
        Where it could not say.
    """
    if not path.is_file():
        return None
    with a_record_of_ours(path):
        entry = next((candidate for candidate in read_json(path)["models"] if candidate["model"] == index), None)
        if entry is None:
            return None
        if "error" in entry:
            raise NotObservableError("heading", Fact.stated(str(entry["error"])))
        return georeference_of_json(entry)


def cameras_as_json(georeference: Georeference, names: Sequence[str], centres: Array) -> list[dict[str, object]]:
    """Positions of all images."""
    return [
        {"name": name, "latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
        for name, (latitude, longitude, height) in zip(names, georeference.geodetic(centres).tolist(), strict=True)
    ]
