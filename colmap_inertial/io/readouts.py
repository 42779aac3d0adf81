"""Readout times of cameras as others published them, for videos that do not say theirs.

A readout belongs to one camera in one mode: model, picture size and frame rate must all be those of the table
(``readouts.csv``, with the source of each figure). Where two sources contradict each other, none of them is in it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.video import VideoMode, video_mode

#: Rates that differ by less are one mode: 29.97 and 30.
_SAME_RATE = 0.02


@dataclass(frozen=True, kw_only=True)
class PublishedReadout:
    """One line of the table.

    Attributes
    ----------
    make, model, width, height, rate_hz
        The camera and its mode.
    readout_s, sigma_s
        From the first row to one past the last, and its standard deviation.
    source
        Who published it.
    """

    make: str
    model: str
    width: int
    height: int
    rate_hz: float
    readout_s: float
    sigma_s: float
    source: str

    def is_of(self, mode: VideoMode) -> bool:
        """Whether a video was filmed by this camera in this mode."""
        return (
            mode.make.strip().lower() == self.make.lower()
            and mode.model.strip().lower() == self.model.lower()
            and (mode.width, mode.height) == (self.width, self.height)
            and abs(mode.rate_hz / self.rate_hz - 1) < _SAME_RATE
        )

    def __str__(self) -> str:
        mode = f"{self.make} {self.model} at {self.width}x{self.height}, {self.rate_hz:g} a second"
        return f"from the table: {mode}, +-{1e3 * self.sigma_s:.2g} ms ({self.source})"


@cache
def published_readouts() -> tuple[PublishedReadout, ...]:
    """The whole table."""
    with files("colmap_inertial.io").joinpath("readouts.csv").open(encoding="utf-8") as table:
        return tuple(
            PublishedReadout(
                make=row["make"],
                model=row["model"],
                width=int(row["width"]),
                height=int(row["height"]),
                rate_hz=float(row["rate_hz"]),
                readout_s=float(row["readout_ms"]) * 1e-3,
                sigma_s=float(row["sigma_ms"]) * 1e-3,
                source=row["source"],
            )
            for row in csv.DictReader(table)
        )


def readout_of_video(path: Path) -> PublishedReadout | None:
    """What was published of the camera and mode that a video names; ``None`` where it names none, or none known."""
    try:
        mode = video_mode(path)
    except FormatError:
        return None  # whoever reads its frames says what is wrong with it
    return None if mode is None else next((one for one in published_readouts() if one.is_of(mode)), None)
