"""Recorders that hand on what iOS measures: Stray Scanner, and Sensor Logger (iOS and Android).

iOS states accelerations in g and with the sign of gravity: a phone that lies on its back reads z = -1, where the
specific force is +9.8 m/s2. Gyroscopes agree everywhere.

Stray Scanner writes a folder: ``imu.csv`` (``timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z``: seconds, what
CoreMotion gave, rad/s), ``odometry.csv`` with the time of each frame of ``rgb.mp4`` on the same clock and ARKit's
poses, ``camera_matrix.csv``. Versions of the app differ: one wrote CoreMotion's g as they are, one times 9.81, the
latest again as they are, and no file says of which it is (github.com/strayrobots/scanner, DatasetEncoder.swift).
Gravity tells these two apart; any other length is refused as ever.

ScanCapture of the LaMAR benchmark writes ``gyroscope.txt`` and ``accelerometer.txt`` with comments ``# timestamp, rx,
ry, rz`` and ``# timestamp, ax, ay, az``: microseconds since boot, rad/s, CoreMotion's g
(github.com/microsoft/lamar-benchmark).

Sensor Logger writes a zip, or the folder in it, with one table for each sensor: ``time`` (nanoseconds UTC), ``z``,
``y``, ``x`` in an order of its own. ``Accelerometer`` is without gravity, ``Gravity`` the rest; ``TotalAcceleration``
(Android) and ``AccelerometerUncalibrated`` hold both, the latter in g on iOS. ``Metadata.csv`` names the platform and
whether "Standardise Units & Frames" was on, which makes iOS write what Android does
(github.com/tszheichoi/awesome-sensor-logger).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import CameraModel, FrameLog, ImuRecording
from colmap_inertial.io.files import first_line, read_bytes
from colmap_inertial.io.frame_times import frame_log
from colmap_inertial.io.imu_text import build_recording, order_rows
from colmap_inertial.io.mp4 import is_mp4, read_movie
from colmap_inertial.io.plausible import PLAUSIBLE
from colmap_inertial.io.samples import Samples
from colmap_inertial.io.tables import Table, head_of, members_of, parse_table, read_table, text_of
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2, DeclaredUnits, seconds

# --- Stray Scanner ---------------------------------------------------------------------------------------------------

#: What one version of the app multiplied CoreMotion's g by; it is not the standard gravity.
_STRAY_FACTOR = 9.81


def is_stray_scanner(path: Path) -> bool:
    """Whether ``path`` is a Stray Scanner folder, or its imu.csv, whatever it is called: its columns tell it."""
    file = path if path.is_file() else path / "imu.csv"
    names = {cell.strip().strip("#").strip() for cell in first_line(file).split(",")}
    return {"a_x", "a_y", "a_z", "alpha_x", "alpha_y", "alpha_z"} <= names


def read_stray_scanner(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a Stray Scanner recording."""
    table = read_table(path if path.is_file() else path / "imu.csv")
    t_ns = table.stamps_ns(table.column("timestamp"), "s")
    gyro = table.numbers([table.column(f"alpha_{axis}") for axis in "xyz"])
    accel = -table.numbers([table.column(f"a_{axis}") for axis in "xyz"])
    if units.accel is None and _is_times_gravity(accel):
        accel = accel / _STRAY_FACTOR
    return build_recording(
        order_rows(table, "gyro", units.gyro or "rad/s", t_ns, gyro),
        order_rows(table, "accel", units.accel or "g", t_ns, accel),
        device="Stray Scanner",
    )


def _is_times_gravity(accel: Array) -> bool:
    """Whether accelerations are those of the version that multiplied g by 9.81."""
    length = float(np.nanmedian(np.linalg.norm(accel, axis=1))) if len(accel) else 0.0
    low, high = (
        limit / STANDARD_GRAVITY_M_S2 for limit in (PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2)
    )
    return low <= length / _STRAY_FACTOR <= high


def read_stray_scanner_frames(path: Path) -> FrameLog | None:
    """Frame times on the IMU's clock, and the intrinsics; ``None`` where there is no odometry.csv."""
    folder = path.parent if path.is_file() else path
    file = folder / "odometry.csv"
    if not file.is_file():
        return None
    table = read_table(file)
    return frame_log(file, table.stamps_ns(table.column("timestamp"), "s"), camera=_camera_matrix(folder))


def _camera_matrix(folder: Path) -> CameraModel | None:
    """ARKit's intrinsics; its pixels count from the centre of the top-left one."""
    file, video = folder / "camera_matrix.csv", folder / "rgb.mp4"
    if not file.is_file() or not video.is_file() or not is_mp4(video):
        return None
    table = read_table(file)
    matrix = table.numbers(range(table.width))
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or (np.diagonal(matrix) <= 0).any():
        raise FormatError(file, Fact("no-intrinsics-matrix"))
    track = read_movie(video).track(handler="vide")
    if track is None or min(track.width_px, track.height_px) < 1:
        return None
    centre = colmap_px_from_opencv(matrix[:2, 2])
    params = (matrix[0, 0], matrix[1, 1], float(centre[0]), float(centre[1]))
    return CameraModel(model="PINHOLE", width=track.width_px, height=track.height_px, params=params)


# --- ScanCapture -----------------------------------------------------------------------------------------------------


def is_scan_capture(path: Path) -> bool:
    """Whether ``path`` is a folder of LaMAR's ScanCapture: comments over its two tables name their columns."""
    names = {"gyroscope.txt": ("timestamp", "rx", "ry", "rz"), "accelerometer.txt": ("timestamp", "ax", "ay", "az")}
    return path.is_dir() and all(_read_comment(path / file) == cells for file, cells in names.items())


def _read_comment(path: Path) -> tuple[str, ...]:
    """The last comment before the first row, cell by cell."""
    if not path.is_file():
        return ()
    head = read_bytes(path, 2000).decode("utf-8-sig", errors="replace").splitlines()
    comments = [line for i, line in enumerate(head) if all(above.lstrip().startswith("#") for above in head[: i + 1])]
    return tuple(cell.strip() for cell in comments[-1].strip().lstrip("#").split(",")) if comments else ()


def read_scan_capture(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the two tables of ScanCapture: microseconds since boot, rad/s, CoreMotion's g."""
    samples = []
    for name, quantity, unit, sign in (
        ("gyroscope.txt", "gyro", units.gyro or "rad/s", 1.0),
        ("accelerometer.txt", "accel", units.accel or "g", -1.0),
    ):
        table = read_table(path / name)
        t_ns = table.stamps_ns(table.column("timestamp"), "us")
        values = sign * table.numbers([1, 2, 3])
        samples.append(order_rows(table, "gyro" if quantity == "gyro" else "accel", unit, t_ns, values))
    return build_recording(samples[0], samples[1], device="ScanCapture")


# --- Sensor Logger ---------------------------------------------------------------------------------------------------


_GYROSCOPES = ("Gyroscope.csv", "GyroscopeUncalibrated.csv")


def is_sensor_logger(path: Path) -> bool:
    """Whether ``path`` is a Sensor Logger zip or folder, or its JSON."""
    if path.is_file() and path.suffix.lower() in _JSON:
        return bool(re.search(rb'"sensor"\s*:|"payload"\s*:\s*\[', read_bytes(path, 4000)))
    members = members_of(path)
    return any(name in members and _is_its_table(path, members[name]) for name in _GYROSCOPES)


def _is_its_table(path: Path, member: str) -> bool:
    """Whether a table has the columns of Sensor Logger: phyphox has files of the same name."""
    header = head_of(path, member)
    # a damaged one is left to its reader
    return not header or "time" in {cell.strip().strip('"') for cell in header.split(",")}


def read_sensor_logger(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a Sensor Logger recording; the accelerometer may be missing.

    Raises
    ------
    FormatError
        Where nothing says on which platform it was recorded, on which the accelerometer's sign depends.
    """
    if path.is_file() and path.suffix.lower() in _JSON:
        return _read_json(path, units)
    members = members_of(path)
    name = next((n for n in _GYROSCOPES if n in members), None)
    if name is None:
        raise FormatError(path, Fact("sensor-logger-table-missing"))
    table, t_ns, values = _sensor(path, members, name)
    gyro = order_rows(table, "gyro", units.gyro or "rad/s", t_ns, values)
    return build_recording(gyro, _accelerometer(path, members, units), device="Sensor Logger")


_JSON = (".json", ".jsonl", ".ndjson")
#: Names of sensors in JSON, small and without blanks: the gyroscope's, and those with gravity and without.
_JSON_GYRO = ("gyroscope", "gyroscopeuncalibrated")
_JSON_WHOLE = ("totalacceleration", "accelerometeruncalibrated")


def _read_json(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the rows of an array, or of lines, in which each row names its sensor."""
    table = read_table(path)
    header = table.header or ()
    column = next((name for name in ("sensor", "name") if name in header), None)
    if column is None or not {"time", "x", "y", "z"} <= set(header):
        raise FormatError(path, Fact("sensor-logger-rows-missing"))
    names = np.array([re.sub(r"[^a-z]", "", name.lower()) for name in table.text(table.column(column))])

    gyro_name = next((name for name in _JSON_GYRO if name in names), None)
    if gyro_name is None:
        raise FormatError(path, Fact("sensor-logger-without-gyroscope"))
    part, t_ns, values = _json_rows(table, names, gyro_name)
    gyro = order_rows(part, "gyro", units.gyro or "rad/s", t_ns, values)
    whole = next((name for name in _JSON_WHOLE if name in names), None)
    if whole is None and not {"accelerometer", "gravity"} <= set(names):
        if "accelerometer" in names:
            raise FormatError(path, Fact("sensor-logger-without-gravity", table="accelerometer"))
        return build_recording(gyro, None, device="Sensor Logger")
    return build_recording(gyro, _json_accelerometer(path, table, names, whole, units), device="Sensor Logger")


def _json_rows(table: Table, names: Any, name: str) -> tuple[Table, Int64Array, Array]:
    """The rows of one sensor, their stamps and values."""
    kept = names == name
    lines = tuple(line for line, keep in zip(table.lines, kept, strict=True) if keep)
    part = replace(table, lines=lines, line_numbers=table.line_numbers[kept])
    return part, part.stamps_ns(part.column("time"), "ns"), part.numbers([part.column(axis) for axis in "xyz"])


def _json_accelerometer(path: Path, table: Table, names: Any, whole: str | None, units: DeclaredUnits) -> Samples:
    ios, standardised = _json_platform(path, table, names)
    unit = "g" if whole == "accelerometeruncalibrated" and ios and not standardised else "m/s2"
    part, t_ns, values = _json_rows(table, names, whole or "accelerometer")
    if whole is None:
        values = values + _at(_json_rows(table, names, "gravity"), t_ns)
    sign = -1.0 if ios and not standardised else 1.0
    return order_rows(part, "accel", units.accel or unit, t_ns, sign * values)


def _json_platform(path: Path, table: Table, names: Any) -> tuple[bool, bool]:
    """As of :func:`_platform`, by the row of metadata."""
    header = {name.lower(): i for i, name in enumerate(table.header or ())}
    row = int(np.argmax(names == "metadata"))
    if (names == "metadata").any() and "platform" in header:
        cells = [cell.strip().lower() for cell in table.lines[row].split(table.delimiter)]
        if cells[header["platform"]] in ("ios", "android"):
            standardised = cells[header["standardisation"]] == "true" if "standardisation" in header else False
            return cells[header["platform"]] == "ios", standardised
    raise FormatError(path, Fact("sensor-logger-platform-of-rows-unknown"))


def _at(rows: tuple[Table, Int64Array, Array], t_ns: Int64Array) -> Array:
    """Values of a sensor at other times."""
    _, own_ns, values = rows
    origin = min(int(t_ns[0]), int(own_ns[0]))
    at, known = seconds(t_ns, origin), seconds(own_ns, origin)
    return np.stack([np.interp(at, known, column) for column in values.T], axis=1)


def _accelerometer(path: Path, members: dict[str, str], units: DeclaredUnits) -> Samples | None:
    whole = next((n for n in ("TotalAcceleration.csv", "AccelerometerUncalibrated.csv") if n in members), None)
    parts = {"Accelerometer.csv", "Gravity.csv"} <= members.keys()
    if whole is None and not parts:
        if "Accelerometer.csv" in members:
            raise FormatError(path, Fact("sensor-logger-without-gravity", table="Accelerometer.csv"))
        return None
    ios, standardised = _platform(path, members)
    if whole is not None:
        table, t_ns, values = _sensor(path, members, whole)
        unit = "g" if whole == "AccelerometerUncalibrated.csv" and ios and not standardised else "m/s2"
    else:
        table, t_ns, values = _sensor(path, members, "Accelerometer.csv")
        values = values + _at(_sensor(path, members, "Gravity.csv"), t_ns)
        unit = "m/s2"
    sign = -1.0 if ios and not standardised else 1.0
    return order_rows(table, "accel", units.accel or unit, t_ns, sign * values)


def _platform(path: Path, members: dict[str, str]) -> tuple[bool, bool]:
    """Whether it was iOS, and whether units and frames were standardised."""
    if "Metadata.csv" in members:
        lines = [line.split(",") for line in text_of(path, members["Metadata.csv"]).splitlines() if line.strip()]
        if len(lines) >= 2:
            row = {key.strip().lower(): value.strip().lower() for key, value in zip(lines[0], lines[1], strict=False)}
            if row.get("platform") in ("ios", "android"):
                return row["platform"] == "ios", row.get("standardisation") == "true"
    raise FormatError(path, Fact("sensor-logger-platform-unknown"))


def _sensor(path: Path, members: dict[str, str], name: str) -> tuple[Table, Int64Array, Array]:
    table = parse_table(path / name if path.is_dir() else path, text_of(path, members[name]))
    values = table.numbers([table.column(axis) for axis in "xyz"])
    return table, table.stamps_ns(table.column("time"), "ns"), values
