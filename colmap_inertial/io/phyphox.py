"""phyphox: what its "Export data" writes as CSV, a zip or the folder in it, with one table for each sensor.

``Gyroscope.csv`` and ``Accelerometer.csv`` have ``Time (s)`` and columns such as ``Gyroscope x (rad/s)`` and
``Acceleration x (m/s^2)``, on one clock that starts with the experiment. ``Linear Acceleration`` is without gravity.
Simple experiments of iOS have ``X (rad/s)`` and ``X (m/s^2)``, and the sensor is the name of the table.
Delimiters and the decimal sign are as chosen when exporting (phyphox.org). The sign is Android's.
"""

from __future__ import annotations

import re
from pathlib import Path

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.imu_text import build_recording, order_rows
from colmap_inertial.io.samples import Samples
from colmap_inertial.io.tables import Table, head_of, members_of, parse_text, text_of
from colmap_inertial.io.units import DeclaredUnits

#: A line of the header of a table of phyphox, and of what sensor it is.
_TIME = re.compile(r'^"?Time \(s\)"?', re.IGNORECASE)
_GYRO, _ACCEL = r"(?:gyroscope )?{} \(rad/s\)", r"(?:(?:linear )?acceleration )?{} \(m/s(?:\^2|²)\)"


def is_phyphox(path: Path) -> bool:
    """Whether ``path`` is an export of phyphox with a gyroscope: the first column of its tables is a time in
    seconds.
    """
    members = members_of(path)
    return any(_kind(head_of(path, members[name]), name) == "gyro" for name in sorted(members) if _may_be(name))


def read_phyphox(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read an export of phyphox; the accelerometer may be missing.

    Raises
    ------
    FormatError
        Where there is no gyroscope, or an accelerometer without gravity alone.
    """
    members = members_of(path)
    samples_of: dict[str, Samples] = {}
    linear = False
    for name in sorted(members):
        if not _may_be(name):
            continue
        kind = _kind(head_of(path, members[name]), name)
        linear = linear or kind == "linear"
        if kind == "gyro" and "gyro" not in samples_of:
            samples_of["gyro"] = _samples(path, members[name], name, "gyro", _GYRO, units.gyro or "rad/s")
        elif kind == "accel" and "accel" not in samples_of:
            samples_of["accel"] = _samples(path, members[name], name, "accel", _ACCEL, units.accel or "m/s2")
    if "gyro" not in samples_of:
        raise FormatError(path, Fact("phyphox-without-gyroscope"))
    if "accel" not in samples_of and linear:
        raise FormatError(path, Fact("phyphox-linear-acceleration"))
    return build_recording(samples_of["gyro"], samples_of.get("accel"), device="phyphox")


def _may_be(name: str) -> bool:
    """Whether a table may hold samples: those in meta/ describe the experiment."""
    return name.lower() not in ("device.csv", "time.csv")


def _kind(header: str, name: str) -> str | None:
    """Which sensor a table is, by its header and, where that is silent on gravity, its name."""
    header = header.lower()
    if not _TIME.match(header):
        return None
    if re.search(r"\b" + _GYRO.format("x"), header):
        return "gyro"
    if re.search(r"\b" + _ACCEL.format("x"), header):
        is_linear = "linear" in (header if "acceleration" in header else name.lower())
        return "linear" if is_linear else "accel"
    return None


def _samples(path: Path, member: str, name: str, quantity: str, pattern: str, unit: str) -> Samples:
    table = parse_text(path / name if path.is_dir() else path, text_of(path, member))
    columns = [_column(table, pattern.format(axis)) for axis in "xyz"]
    values: Array = table.numbers(columns)
    t_ns = table.stamps_ns(_column(table, r"time \(s\)"), "s")
    return order_rows(table, "gyro" if quantity == "gyro" else "accel", unit, t_ns, values)


def _column(table: Table, pattern: str) -> int:
    for place, cell in enumerate(table.header or ()):
        if re.fullmatch(pattern, cell.strip().lower()):
            return place
    raise FormatError(table.path, Fact("no-column-like", pattern=pattern, header=table.header_text[:200]))
