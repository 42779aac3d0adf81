"""What is known of the columns of a table of samples."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_inertial.io.stamps import TimeColumns

#: Rows that are looked at.
ROWS = 2000


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
        As in a capture.toml; empty where they are the file's.
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
        time = self.time
        timed = time is not None and bool(time.units or time.rate_hz or time.counts_per_second)
        return self.columns is not None and None not in (self.unit, self.counts_per_unit) and timed and not self.others


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
