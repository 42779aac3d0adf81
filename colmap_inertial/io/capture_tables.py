"""The tables of a capture.toml that describe sensors: camera, IMU, calibration."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.types import ImuNoise
from colmap_inertial.io import sensor_yaml
from colmap_inertial.io.calibration import (
    Calibrations,
    Declared,
    calibration_prior,
    holds_imu_alone,
    read_for_recording,
)
from colmap_inertial.io.camera_table import check_transform
from colmap_inertial.io.imu_text import SensorTable
from colmap_inertial.io.stamps import DATE_ORDERS, TimeColumns
from colmap_inertial.io.toml_section import Section
from colmap_inertial.io.units import SENSOR_UNITS, TIME_UNITS_NS, DeclaredUnits, Quantity


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuPath:
    """An inertial recording that :func:`read_imu` finds its way in.

    Attributes
    ----------
    path, format
        As for ``read_imu``.
    units
        Stated in place of the file's.
    gyro_axes, accel_axes
        Applied to what the reader delivers; ``None`` leaves it.
    noise
        Stated in place of the file's; ``None`` leaves it.
    """

    path: Path
    format: str = "auto"
    units: DeclaredUnits = field(default_factory=DeclaredUnits)
    gyro_axes: Axes | None = None
    accel_axes: Axes | None = None
    noise: ImuNoise | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuTables:
    """An inertial recording in described tables; attributes as in :class:`ImuPath`."""

    gyro: SensorTable
    accel: SensorTable | None = None
    gyro_axes: Axes | None = None
    accel_axes: Axes | None = None
    noise: ImuNoise | None = None


IMU_KEYS = ("path", "format", "stamps", "topic", "gyro", "accel", "noise")
_CORRECTION_KEYS = ("unit", "axes", "mirrored")
_TIME_KEYS = ("time", "time_unit", "time_counts_per_s", "date_order", "rate_hz")
_SENSOR_KEYS = ("file", *_TIME_KEYS, "columns", "where", "zero", "counts_per_unit", *_CORRECTION_KEYS)


def read_imu_table(table: Section) -> ImuPath | ImuTables:
    """The ``[imu]`` table with its sub-tables."""
    path, fmt = table.file("path"), table.text("format")
    stamps, topic = table.choice("stamps", ("header", "arrival")), table.text("topic")
    gyro, accel = table.section("gyro"), table.section("accel")
    noise = _read_noise(table.section("noise"))
    if path is not None:
        if path.suffix.lower() == ".toml" or fmt == "capture":
            table.fail("path", Fact("imu-path-is-capture"))
        gyro_unit, gyro_axes = _read_correction(gyro, "gyro")
        accel_unit, accel_axes = _read_correction(accel, "accel")
        return ImuPath(
            path=path,
            format=fmt or "auto",
            units=DeclaredUnits(gyro=gyro_unit, accel=accel_unit, stamps=stamps, topic=topic),
            gyro_axes=gyro_axes,
            accel_axes=accel_axes,
            noise=noise,
        )
    for key, value in (("format", fmt), ("stamps", stamps), ("topic", topic)):
        if value is not None:
            table.fail(key, Fact("belongs-to-missing", key="path"))
    if gyro is None:
        table.fail(None, Fact("imu-table-needs-path"))
    gyro_table, gyro_axes = _read_sensor_table(gyro, "gyro")
    accel_table, accel_axes = (None, None) if accel is None else _read_sensor_table(accel, "accel")
    return ImuTables(gyro=gyro_table, accel=accel_table, gyro_axes=gyro_axes, accel_axes=accel_axes, noise=noise)


_SIGMA_KEYS = ("rotation_sigma_rad", "imu_in_cam_sigma_m", "time_offset_sigma_s", "gyro_bias_sigma_rad_s")
CALIBRATION_KEYS = (
    *("file", "cam_from_imu", "cam_from_imu_xyzw", "imu_in_cam_m", "gyro_time_offset_s", "accel_time_offset_s"),
    *("gyro_bias_rad_s", *_SIGMA_KEYS),
)


def read_calibration_table(
    table: Section,
    *,
    body_from_cam: Array | None,
    imu: ImuPath | ImuTables | None,
    readout_s: float | None,
    shared_clock: bool,
    clock_offset_s: float | None = None,
) -> Calibrations:
    """The ``[calibration]`` table, completed by the sheets of camera and IMU and by ``[timing]``.

    ``clock_offset_s`` is what the camera's sheet says, in place of what the table does not.
    """
    files = table.files("file")
    if any(key in table for key in CALIBRATION_KEYS[1:]) and not all(holds_imu_alone(file) for file in files):
        table.fail("file", Fact("file-gives-calibration"))
    calibrations = read_for_recording(files, shared_clock=shared_clock, readout_s=readout_s)
    if calibrations.camera_imu is not None:
        return calibrations
    rotation, lever = _read_pose(table)
    if body_from_cam is not None and rotation is None:
        body = body_from_imu(imu) if isinstance(imu, ImuPath) else np.eye(4)
        cam_from_imu = np.linalg.inv(body_from_cam) @ body
        rotation = quat_from_matrix(cam_from_imu[:3, :3])
        lever = cam_from_imu[:3, 3] if lever is None else lever
    sigmas = {key: value for key in _SIGMA_KEYS if (value := table.positive(key)) is not None}
    gyro_offset_s, accel_offset_s = table.number("gyro_time_offset_s"), table.number("accel_time_offset_s")
    declared = Declared(
        cam_from_imu_xyzw=rotation,
        imu_in_cam_m=lever,
        gyro_time_offset_s=gyro_offset_s if gyro_offset_s is not None or accel_offset_s is not None else clock_offset_s,
        accel_time_offset_s=accel_offset_s,
        gyro_bias_rad_s=table.numbers("gyro_bias_rad_s", 3),
        readout_s=readout_s,
        **sigmas,
    )
    return replace(calibrations, camera_imu=calibration_prior(declared, shared_clock=shared_clock))


def _read_pose(table: Section) -> tuple[ArrayLike | None, ArrayLike | None]:
    """Rotation (quaternion xyzw) and lever arm that a ``[calibration]`` table states; ``None`` for what it does not."""
    matrix, xyzw = table.matrix("cam_from_imu"), table.numbers("cam_from_imu_xyzw", 4)
    lever = table.numbers("imu_in_cam_m", 3)
    if matrix is None:
        if xyzw is not None and abs(np.linalg.norm(xyzw) - 1) > 1e-3:
            table.fail("cam_from_imu_xyzw", Fact("not-a-unit-quaternion"))
        return xyzw, lever
    if xyzw is not None:
        table.fail("cam_from_imu_xyzw", Fact("said-twice", other="cam_from_imu"))
    cam_from_imu = check_transform(table, "cam_from_imu", matrix)
    if len(matrix) > 3 and lever is not None:
        table.fail("imu_in_cam_m", Fact("translation-said-twice"))
    return quat_from_matrix(cam_from_imu[:3, :3]), cam_from_imu[:3, 3] if len(matrix) > 3 else lever


def body_from_imu(imu: ImuPath) -> Array:
    """(4, 4) body_from_imu: the T_BS of the sensor.yaml beside the IMU's data, or the identity where there is none."""
    folder = imu.path.parent if imu.path.is_file() else imu.path
    sheets = [folder / part / "sensor.yaml" for part in ("mav0/imu0", "imu0")]
    if (folder / "data.csv").is_file():
        sheets.insert(0, folder / "sensor.yaml")
    sheet = next((sheet for sheet in sheets if sheet.is_file()), None)
    if sheet is None:
        return np.eye(4)
    return sensor_yaml.read_body_from_sensor(sheet)


def _read_noise(table: Section | None) -> ImuNoise | None:
    if table is None:
        return None
    names = [f.name for f in fields(ImuNoise)]
    table.require_known(names)
    return ImuNoise(**{name: table.require(name, table.number(name, low=0)) for name in names})


def _read_correction(table: Section | None, quantity: Quantity) -> tuple[str | None, Axes | None]:
    """Read the corrections that a sensor's table may have beside ``[imu] path``."""
    if table is None:
        return None, None
    if "file" in table:
        table.fail("file", Fact("said-twice", other="[imu] path"))
    table.require_known(_CORRECTION_KEYS)
    return table.choice("unit", SENSOR_UNITS[quantity]), _read_axes(table)


def _read_sensor_table(table: Section, quantity: Quantity) -> tuple[SensorTable, Axes | None]:
    table.require_known(_SENSOR_KEYS)
    file = table.require("file", table.file("file"))
    time = _read_time(table)
    columns = table.require("columns", table.raw("columns"))
    unit = table.require("unit", table.choice("unit", SENSOR_UNITS[quantity]))
    if not isinstance(columns, list) or len(columns) != 3 or not all(map(_is_column, columns)):
        table.fail("columns", Fact("not-three-columns", found=repr(columns)))
    if len({*time.columns, *columns}) != len(time.columns) + 3:
        table.fail("columns", Fact("columns-repeated"))
    x, y, z = columns
    described = SensorTable(
        file=file,
        time=time,
        columns=(x, y, z),
        unit=unit,
        where=_read_where(table),
        zero=table.number("zero") or 0.0,
        counts_per_unit=table.positive("counts_per_unit") or 1.0,
    )
    return described, _read_axes(table)


def _read_time(table: Section) -> TimeColumns:
    """Where the time stands: ``time`` with ``time_unit`` or ``time_counts_per_s``, or ``rate_hz``."""
    rate_hz, counts = table.positive("rate_hz"), table.positive("time_counts_per_s")
    time, unit = table.raw("time"), table.raw("time_unit")
    if rate_hz is not None:
        for key in _TIME_KEYS[:-1]:
            if key in table:
                table.fail(key, Fact("said-twice", other="rate_hz"))
        return TimeColumns(rate_hz=rate_hz)
    columns = table.require("time", time) if isinstance(time, list) else [table.require("time", time)]
    if not columns or not all(map(_is_column, columns)) or len(set(columns)) != len(columns):
        table.fail("time", Fact("not-a-column", found=repr(time)))
    if counts is not None:
        if unit is not None or len(columns) > 1:
            table.fail("time_counts_per_s", Fact("counts-need-one-column"))
        return TimeColumns(columns=tuple(columns), counts_per_second=counts)
    units = table.require("time_unit", unit) if isinstance(unit, list) else [table.require("time_unit", unit)]
    if units == ["date"]:
        return TimeColumns(columns=tuple(columns), units=("date",), date_order=table.choice("date_order", DATE_ORDERS))
    if any(name not in TIME_UNITS_NS for name in units) or len(units) != len(columns):
        allowed = (*TIME_UNITS_NS, "date")
        table.fail("time_unit", Fact("not-a-time-unit", units=allowed, columns=len(columns), found=repr(unit)))
    return TimeColumns(columns=tuple(columns), units=tuple(units))


def _read_where(table: Section) -> tuple[str | int, str] | None:
    """Which rows are this sensor's: a column, and what it says in them."""
    where = table.raw("where")
    if where is None:
        return None
    if not isinstance(where, list) or len(where) != 2 or not _is_column(where[0]) or isinstance(where[1], list | dict):
        table.fail("where", Fact("not-a-row-choice", found=repr(where)))
    return where[0], str(where[1])


def _is_column(value: object) -> bool:
    return (isinstance(value, int) and not isinstance(value, bool) and value > 0) or (
        isinstance(value, str) and bool(value)
    )


def _read_axes(table: Section) -> Axes | None:
    text, mirrored = table.text("axes"), table.boolean("mirrored")
    if text is None:
        if mirrored is not None:
            table.fail("mirrored", Fact("belongs-to-missing", key="axes"))
        return None
    try:
        axes = Axes.parse(text)
    except ValueError as error:
        table.fail("axes", Fact("invalid-values", detail=str(error)))
    if axes.is_mirrored and not mirrored:
        table.fail("axes", Fact("axes-mirror", axes=text))
    if mirrored and not axes.is_mirrored:
        table.fail("mirrored", Fact("axes-do-not-mirror", axes=text))
    return axes
