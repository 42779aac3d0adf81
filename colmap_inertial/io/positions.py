"""Positions of a satellite receiver that a capture carries: in its video's telemetry, or in its images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import PositionFixes
from colmap_inertial.io.camm import is_camm, read_camm_positions
from colmap_inertial.io.exif import HEAD_BYTES, position_of
from colmap_inertial.io.files import path_in, read_bytes
from colmap_inertial.io.gopro import is_gopro, read_gopro_positions


def positions_in_video(video: Path) -> PositionFixes:
    """Positions in a video's telemetry, on the video's clock.

    Raises
    ------
    FormatError
        Where there are none, or the file is damaged.
    """
    positions = None
    if is_gopro(video):
        positions = read_gopro_positions(video)
    elif is_camm(video):
        positions = read_camm_positions(video)
    if positions is None:
        raise FormatError(video, Fact("no-positions-in-telemetry"))
    return positions


def positions_in_pictures(folder: Path, names: Sequence[str]) -> PositionFixes:
    """Positions in the EXIF of images; those without one are left out.

    Raises
    ------
    FormatError
        Where none has a position, or an image is missing.
    """
    rows, named = [], []
    for name in names:
        path = path_in(folder, name)
        if (position := position_of(read_bytes(path, HEAD_BYTES, what="picture"))) is not None:
            rows.append(position)
            named.append(name)
    if not rows:
        raise FormatError(folder, Fact("no-positions-in-exif", count=len(names)))
    latitude, longitude, height, sigma = np.array([row[:4] for row in rows]).T
    return PositionFixes(
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        sigma_m=sigma,
        names=tuple(named),
        height_above=Counter(row[4] for row in rows).most_common(1)[0][0],
        source=f"EXIF of {len(named)} of {len(names)} pictures",
    )
