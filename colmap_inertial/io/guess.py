"""What a table that nobody described most likely holds: to fill in the lines that describe it, never to read it by."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.plausible import PLAUSIBLE
from colmap_inertial.io.tables import Table
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2, TIME_UNITS_NS

#: Steps between readings of an IMU, in seconds; rows that are looked at.
_STEP_S, _ROWS = (2.5e-4, 0.2), 2000


def how_to_describe(table: Table) -> str:
    """The lines of a capture.toml for a table, as its numbers look; "..." stands for what they do not tell."""
    try:
        values = table.numbers(range(table.width))[:_ROWS]
    except FormatError:
        values = np.full((0, table.width), np.nan)
    time, time_unit = _time(values)
    accel, accel_unit = _accel(values, time)
    gyro, gyro_unit = _gyro(values, time, accel)

    def column(i: int | None) -> str:
        if i is None:
            return "..."
        return str(i + 1) if table.header is None else f'"{table.header[i]}"'

    def sensor(first: int | None, unit: str) -> str:
        columns = "..." if first is None else ", ".join(column(first + k) for k in range(3))
        return f'columns = [{columns}], unit = "{unit}"'

    own = f'file = "{table.path.name}", time = {column(time)}, time_unit = "{time_unit}", '
    return (
        f"describe the file in a capture.toml, as its numbers look (check them): [imu.gyro] {own}"
        f"{sensor(gyro, gyro_unit)}; [imu.accel] {own}{sensor(accel, accel_unit)} (each key on a line of its own; "
        "columns by name, or by number from 1; time_unit s, ms, us or ns; unit rad/s or deg/s, m/s2 or g)"
    )


def _time(values: Array) -> tuple[int | None, str]:
    """The first column that never falls, and the unit in which its steps are those of an IMU."""
    if len(values) < 3:
        return None, "..."
    for i, column in enumerate(values.T):
        steps = np.diff(column)
        if not (np.isfinite(steps).all() and (steps >= 0).all() and (steps > 0).any()) or (steps == 1).all():
            continue  # the last is a column that counts the rows
        step = float(np.median(steps[steps > 0]))
        units = [unit for unit, ns in TIME_UNITS_NS.items() if _STEP_S[0] <= step * ns * 1e-9 <= _STEP_S[1]]
        if len(units) == 1:
            return i, units[0]
    return None, "..."


def _triples(values: Array, without: set[int | None]) -> list[int]:
    """First columns of three neighbours that hold numbers which change."""
    changes = np.isfinite(values).all(axis=0) & (np.ptp(values, axis=0) > 0) if len(values) else np.zeros(0, bool)
    usable = [bool(change) and i not in without for i, change in enumerate(changes)]
    return [i for i in range(len(usable) - 2) if all(usable[i : i + 3])]


def _accel(values: Array, time: int | None) -> tuple[int | None, str]:
    """Three columns whose length stays near gravity, and which leave three for the gyroscope where they can."""
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    found: list[tuple[bool, float, int, str]] = []
    for i in _triples(values, {time}):
        few, median = (float(v) for v in np.percentile(np.linalg.norm(values[:, i : i + 3], axis=1), [5, 50]))
        if few > PLAUSIBLE.steady_share * median:
            others = bool(_triples(values, {time, i, i + 1, i + 2}))
            units = (("m/s2", 1.0), ("g", STANDARD_GRAVITY_M_S2))
            found += [(others, few / median, i, unit) for unit, factor in units if low <= median * factor <= high]
    if not found:
        return None, "..."
    _, _, first, unit = max(found)
    return first, unit


def _gyro(values: Array, time: int | None, accel: int | None) -> tuple[int | None, str]:
    """The first three other columns; in deg/s where they are too large for rad/s."""
    taken = {time} if accel is None else {time, accel, accel + 1, accel + 2}
    triples = _triples(values, taken)
    if accel is None or not triples:
        return None, "..."
    median = float(np.median(np.linalg.norm(values[:, triples[0] : triples[0] + 3], axis=1)))
    return triples[0], "rad/s" if median <= PLAUSIBLE.largest_median_rate_rad_s else "deg/s"
