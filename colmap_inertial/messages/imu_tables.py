"""Words of tables and logs that cannot be read: cells, columns, stamps, samples."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import message, state


@message(example={"width": 6, "layout": "t x y z"})
def other_columns(width: int, layout: str) -> str:
    return f"{width} columns; expected {layout}"


@message(example={"number": 9, "width": 7})
def no_column_number(number: int, width: int) -> str:
    return f"column {number} does not exist: columns are counted from 1 to {width}"


@message(advice="give its number, counted from 1", example={"name": "t"})
def no_header_for_column(name: str) -> str:
    return f'has no header, so no column "{name}"'


@message(example={"name": "t", "header": "time,x,y,z"})
def no_column(name: str, header: str) -> str:
    return f'has no column "{name}"; the header is: {header}'


@message(example={"cell": "abc", "column": 3})
def cell_not_a_number(cell: str, column: int) -> str:
    return f"{cell!r} in column {column} is not a number"


state("header-alone", "holds a header and no rows")
state("no-rows-of-numbers", "holds no rows of numbers")


@message(example={"member": "Gyroscope.csv", "largest_gib": 4.0})
def member_too_large(member: str, largest_gib: float) -> str:
    return f"its {member} unpacks to more than {largest_gib:g} GiB (--limits.file-gib)"


@message(
    advice="if it is meant, unpack it and give the folder",
    example={"member": "Gyroscope.csv", "size_mb": 900, "packed": 90000},
)
def member_out_of_proportion(member: str, size_mb: int, packed: int) -> str:
    return f"its {member} unpacks to {size_mb} MB and more, out of proportion to {packed} packed bytes"


@message(advice="unpack it and give the folder", example={"member": "Gyroscope.csv", "method": 12})
def member_packed_otherwise(member: str, method: int) -> str:
    return f"its {member} is packed by method {method}, not by deflate"


@message(example={"column": "t"})
def no_counts(column: str) -> str:
    return f'column "{column}" holds values that are not whole counts'


@message(example={"text": "3.4.2024"})
def no_date_with_time(text: str) -> str:
    return f"{text!r} is not a date with a time"


@message(example={"text": "31.2.2024 10:00:00", "detail": "day is out of range for month"})
def not_a_date(text: str, detail: str) -> str:
    return f"{text!r} is not a date ({detail})"


@message(example={"stamp": "abc"})
def stamp_not_a_number(stamp: str) -> str:
    return f"timestamp {stamp!r} is not a number"


@message(advice="check the time unit", example={"path": "imu.csv", "line": 7, "stamp": "9e99", "unit": "ns"})
def stamp_too_far(path: str, line: int | None, stamp: str, unit: str) -> str:
    place = "" if line is None else f", line {line}"
    return f"{path}{place}: timestamp {stamp} {unit} is beyond 142 years"


@message(example={"count": 1, "sensor": "gyroscope"})
def too_few_samples(count: int, sensor: str) -> str:
    return f"holds {count} {sensor} samples; at least two are needed"


@message(example={"path": "imu.csv", "sensor": "gyroscope"})
def one_stamp_for_all(path: str, sensor: str) -> str:
    return f"{path}: all {sensor} samples have one timestamp; this is not the time column"


state("gcsv-times-damaged", "a time is not a number, or beyond 142 years", advice="check tscale")


@message(example={"readout_ms": 900.0})
def gcsv_readout_long(readout_ms: float) -> str:
    return f"frame_readout_time is {readout_ms:g} ms"


@message(example={"text": "7"})
def gcsv_direction_unknown(text: str) -> str:
    return f"frame_readout_direction is {text!r}; expected 0, 1, 2 or 3"


@message(example={"expected": "GYROFLOW IMU LOG"})
def gcsv_first_line(expected: str) -> str:
    return f"does not begin with {expected}"


@message(example={"line": "t,x,y,z"})
def gcsv_without_columns(line: str) -> str:
    return f"names no columns gx, gy, gz: {line}"


state("gcsv-without-header", "has no line that names its columns (t,gx,gy,gz,...)")


@message(example={"key": "tscale", "text": "abc"})
def gcsv_not_a_factor(key: str, text: str) -> str:
    return f"{key} is {text!r}, not a number to multiply by"


@message(example={"text": "abc"})
def gcsv_orientation(text: str) -> str:
    return f"orientation is {text!r}; expected three letters such as YxZ"


state(
    "phyphox-without-gyroscope",
    "holds no gyroscope of phyphox",
    advice="record Gyroscope (and Accelerometer) in one experiment",
)
state(
    "phyphox-linear-acceleration",
    "its Linear Acceleration is without gravity",
    advice="record Accelerometer (acceleration with g) instead",
)


@message(example={"pattern": "gyroscope x", "header": "Time (s),x,y,z"})
def no_column_like(pattern: str, header: str) -> str:
    return f"has no column like {pattern!r}; the header is: {header}"


@message(example={"value": "GYRO", "column": "1"})
def no_row_of_sensor(value: str, column: str) -> str:
    return f'no row has "{value}" in its column {column}'


@message(example={"count": 5, "header_count": 4, "header": "t,x,y,z"})
def cells_unlike_header(count: int, header_count: int, header: str) -> str:
    return f"{count} cells under a header of {header_count}: {header}"


@message(example={"count": 5, "others": 4})
def cells_unlike_others(count: int, others: int) -> str:
    return f"{count} cells where the other lines have {others}"


@message(example={"most": 10000})
def too_many_columns(most: int) -> str:
    return f"has more than {most} columns; such a table is not read (raise --limits.table-columns)"


@message(example={"member": "Gyroscope.csv"})
def member_not_unpacked(member: str) -> str:
    return f"its {member} cannot be unpacked"


@message(example={"count": 900, "rows": 1000, "sensor": "gyroscope"})
def rows_lack_values(count: int, rows: int, sensor: str) -> str:
    return f"{count} of {rows} {sensor} rows lack a value (NaN or empty)"


@message(example={"column": "gyro_x [rpm]", "unit": "rpm", "known": ("rad/s", "deg/s")})
def column_of_unknown_unit(column: str, unit: str, known: Sequence[str]) -> str:
    return f'column "{column}" has the unit [{unit}]; known: {", ".join(known)}'


state("no-time-of-day", "no time of day")


@message(example={"text": "x,x,z"})
def not_axes(text: str) -> str:
    return f'"{text}" must name x, y and z once each, with optional signs, like "y,-x,z"'
