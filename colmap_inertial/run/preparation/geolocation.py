"""Positions on Earth that a capture carries, met with where its frames were taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory, PositionFixes
from colmap_inertial.inertial.georeference import Georeference, georeference, georeference_of_json
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import a_record_of_ours, read_json
from colmap_inertial.io.frame_sources import ImageFolder, Video
from colmap_inertial.io.positions import positions_in_pictures, positions_in_video

#: A position between two images that are farther apart than this has no place on the path.
_FARTHEST_S = 2.0
#: By images so far apart the pace before the first and after the last one is known: nearer, noise makes much of it.
_PACE_S = 0.3


def positions_of(capture: Capture, names: Sequence[str], images: Path | None = None) -> PositionFixes:
    """The positions that a capture carries.

    Parameters
    ----------
    capture
        Of the recording.
    names
        Of the frames.
    images
        Where an existing project has its pictures.

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


def located(fixes: PositionFixes, path: CameraTrajectory) -> tuple[PositionFixes, Array, Array]:
    """The positions that belong to a path, where the camera was at each (N, 3), and when (N,) seconds."""
    if fixes.names is not None:
        place = {name: i for i, name in enumerate(path.names)}
        here = np.array([name in place for name in fixes.names], dtype=bool)
        fixes = fixes.select(here)
        at = np.array([place[name] for name in fixes.names or ()], dtype=np.intp)
        return fixes, path.cam_in_world[at], path.t_s[at]
    assert fixes.t_ns is not None
    t_s = (fixes.t_ns - path.epoch_ns) * 1e-9
    after = np.clip(np.searchsorted(path.t_s, t_s), 1, len(path.t_s) - 1)
    near = path.t_s[after] - path.t_s[after - 1] <= _FARTHEST_S
    here = near & (t_s >= path.t_s[0]) & (t_s <= path.t_s[-1])
    t_s = t_s[here]
    centres = np.stack([np.interp(t_s, path.t_s, path.cam_in_world[:, k]) for k in range(3)], axis=1)
    return fixes.select(here), centres, t_s


def georeference_path(
    fixes: PositionFixes, path: CameraTrajectory, up_in_world: Array, *, timed: bool = True
) -> Georeference:
    """Georeference a metric path; raises :class:`NotObservableError` where the positions leave it open.

    ``timed``: whether the path's times are true; without, nothing tells where the camera was a moment before.
    """
    here, centres, t_s = located(fixes, path)
    return georeference(here, centres, t_s, up_in_world, path_at=path_at(path) if timed else None)


def path_at(path: CameraTrajectory) -> Callable[[Array], Array]:
    """Positions (T, 3) of a camera at any instants (T,), linear between its images and beyond them."""

    def at(t_s: Array) -> Array:
        within = np.clip(t_s, path.t_s[0], path.t_s[-1])
        centres = np.stack([np.interp(within, path.t_s, path.cam_in_world[:, k]) for k in range(3)], axis=1)
        for end, inner in ((0, _after(path, 0)), (-1, _after(path, -1))):
            pace = (path.cam_in_world[inner] - path.cam_in_world[end]) / (path.t_s[inner] - path.t_s[end])
            beyond_s = np.maximum(t_s - within, 0) if end else np.minimum(t_s - within, 0)
            centres += beyond_s[:, None] * pace
        return centres

    return at


def _after(path: CameraTrajectory, end: int) -> int:
    """The image nearest to an end of the path that is so far from it that the two tell the pace there."""
    far = np.abs(path.t_s - path.t_s[end]) >= min(_PACE_S, path.t_s[-1] - path.t_s[0])
    return int(np.flatnonzero(far)[0 if end == 0 else -1])


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
