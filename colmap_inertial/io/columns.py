"""What the header of a CSV file says about its columns: quantity, axis and unit, or nothing."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from colmap_inertial.io.units import SENSOR_UNITS, TIME_UNITS_NS, Quantity, unit_of

_TIME_NAMES = {"t", "time", "timestamp", "stamp", "ts", "timestamps", "frametimestamp"}
_GYRO_NAMES = {"g", "w", "gyr", "gyro", "gyroscope", "omega", "angularvelocity", "angvel", "wrss"}
_ACCEL_NAMES = {"a", "acc", "acce", "accel", "accelerometer", "acceleration", "arss"}
# A unit at the end of a name without brackets: "t_ns", "gyro_x_rad_s", "acc_x_m_s2".
_UNIT_SUFFIX = re.compile(r"[_ ](rad_s|deg_s|dps|m_s2|mps2|g|s|ms|us|ns)$", re.IGNORECASE)
_BRACKETS = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")


@dataclass(frozen=True, kw_only=True)
class Column:
    """One recognised column.

    Attributes
    ----------
    kind
        ``"time"``, ``"gyro"`` or ``"accel"``.
    axis
        0, 1, 2 of a sensor column; 0 for time.
    unit
        As in :mod:`colmap_inertial.io.units`; ``None`` where the header does not say.
    """

    kind: Literal["time", "gyro", "accel"]
    axis: int
    unit: str | None


def split_unit(cell: str) -> tuple[str, str | None]:
    """The name and the unit text of a header cell: ``"gx [rad/s]"`` and ``"gx_rad_s"`` give ``("gx", "rad/s")``."""
    match = _BRACKETS.search(cell)
    if match:
        return cell[: match.start()].strip(), match[1].strip()
    match = _UNIT_SUFFIX.search(cell)
    if match:
        return cell[: match.start()].strip(), match[1]
    return cell.strip(), None


def recognise(cell: str) -> Column | None:
    """What a header cell names, or ``None``.

    Raises
    ------
    ValueError
        Where the name is clear and its unit is not one for that quantity.
    """
    name, unit_text = split_unit(cell)
    flat = re.sub(r"[\s_.\-/]", "", name).lower()
    if flat in _TIME_NAMES:
        return Column(kind="time", axis=0, unit=_unit(cell, unit_text, tuple(TIME_UNITS_NS)))
    if not flat or flat[-1] not in "xyz":
        return None
    axis, stem = "xyz".index(flat[-1]), flat[:-1]
    quantity: Quantity
    if stem in _GYRO_NAMES:
        quantity = "gyro"
    elif stem in _ACCEL_NAMES:
        quantity = "accel"
    else:
        return None
    return Column(kind=quantity, axis=axis, unit=_unit(cell, unit_text, tuple(SENSOR_UNITS[quantity])))


def _unit(cell: str, text: str | None, allowed: tuple[str, ...]) -> str | None:
    if text is None:
        return None
    unit = unit_of(text)
    if unit not in allowed:
        raise ValueError(f'column "{cell}" has the unit [{text}]; known here are {", ".join(allowed)}')
    return unit
