"""DJI videos: the ``djmd`` track holds orientations that the camera computed, no accelerometer and no raw gyroscope.

Without an accelerometer nothing gives metres or the direction of gravity. The orientations would do for deblurring and
the rolling shutter; their layout differs between products and firmware, and Gyroflow reads them all.
"""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.mp4 import has_track
from colmap_inertial.io.units import DeclaredUnits


def is_dji(path: Path) -> bool:
    """Whether ``path`` is a video with DJI's track of orientations."""
    return has_track(path, "djmd")


def read_dji(path: Path, units: DeclaredUnits) -> NoReturn:
    """Say what such a video can and cannot give.

    Raises
    ------
    FormatError
        Always.
    """
    raise FormatError(
        path,
        "is a DJI video: it holds orientations but no accelerometer, so it can give no scale and no gravity. What "
        "still works: COLMAP's own reconstruction, in its arbitrary units; deblurring and the rolling shutter, with a "
        "gyroscope log (.gcsv) that Gyroflow exports from it. For metres, record an IMU beside it, or film a target of "
        "known size",
    )
