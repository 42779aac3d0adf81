"""What is known of the columns of a table of samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from colmap_inertial.io.stamps import TimeColumns
from colmap_inertial.io.units import Quantity

OpenPoint = Literal["columns", "choice", "unit", "counts", "time", "time_unit", "rows", "axes"]

#: Rows that are looked at.
ROWS = 2000
#: What stands for a value that is to be filled in.
OPEN = "?"


@dataclass(frozen=True, kw_only=True)
class SensorColumns:
    """Three columns of a sensor, and what is known of them.

    Attributes
    ----------
    columns
        Indices from 0; ``None`` where they are unknown.
    unit
        ``None`` where it is unknown.
    counts_per_unit
        ``None`` where it is unknown.
    axes
        As in a capture.toml; empty where they are the file's, ``"?"`` where they are open.
    time
        ``None`` where it is unknown; units are empty where they are.
    about
        What a person has to know or confirm.
    others
        Names of other columns that could be meant.
    where
        Column and value of the rows that are this sensor's; ``None`` for all.
    file
        Another table beside this one; empty for this one.
    names
        Of the columns in that other table.
    """

    columns: tuple[int, int, int] | None = None
    unit: str | None = None
    counts_per_unit: float | None = 1.0
    axes: str = ""
    time: TimeColumns | None = None
    about: str = ""
    others: tuple[str, ...] = ()
    where: tuple[str | int, str] | None = None
    file: str = ""
    names: tuple[str | int, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether nothing is open."""
        return not self.open_points

    @property
    def open_points(self) -> tuple[OpenPoint, ...]:
        """What is open."""
        time = self.time
        points: dict[OpenPoint, bool] = {
            "columns": self.columns is None,
            "choice": bool(self.others),
            "unit": self.unit is None,
            "counts": self.counts_per_unit is None,
            "time": time is None,
            "time_unit": time is not None and not (time.units or time.rate_hz or time.counts_per_second),
            "axes": self.axes == OPEN,
            "rows": self.where is not None and self.where[1] == OPEN,
        }
        return tuple(point for point, is_open in points.items() if is_open)


@dataclass(frozen=True, kw_only=True)
class Columns:
    """What a table was taken for.

    Attributes
    ----------
    gyro, accel
        Its sensors.
    source
        The export that it is, or empty.
    is_sure
        Whether it can be read without a person's word.
    why
        What this rests on, in words.
    kinds
        What each column was taken for.
    """

    gyro: SensorColumns
    accel: SensorColumns
    source: str = ""
    is_sure: bool = False
    why: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    @property
    def open_points(self) -> tuple[tuple[Quantity, OpenPoint], ...]:
        """What is open, by sensor."""
        parts: tuple[tuple[Quantity, SensorColumns], ...] = (("gyro", self.gyro), ("accel", self.accel))
        return tuple((quantity, point) for quantity, part in parts for point in part.open_points)
