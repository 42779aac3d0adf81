"""Gyroflow's text format (``.gcsv``).

The first line is ``GYROFLOW IMU LOG`` (or ``CAMERA IMU LOG``). Then ``key,value`` lines, then a header ``t,gx,gy,gz``
with optional ``ax,ay,az`` and ``mx,my,mz``, then rows of raw numbers: ``tscale`` seconds, ``gscale`` rad/s and
``ascale`` g (each 1, a missing ``tscale`` 0.001) make one of them. ``orientation`` such as ``YxZ`` says which column,
or with a small letter which column's opposite, is x, y, z. ``frame_readout_time`` is in milliseconds;
``frame_readout_direction`` 0, 1, 2, 3 is from the top, the bottom, the left, the right. Times count from the start of
the recording (docs.gyroflow.xyz, gcsv format).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording, ReadoutDirection
from colmap_inertial.io.files import first_line, read_limits, read_text
from colmap_inertial.io.imu_text import build_recording, order_rows
from colmap_inertial.io.samples import Samples
from colmap_inertial.io.tables import Table, parse_table, too_wide
from colmap_inertial.io.units import DeclaredUnits, Quantity

_FIRST_LINES = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_DIRECTIONS: dict[str, ReadoutDirection] = {
    **dict.fromkeys(("0", "toptobottom"), "down"),
    **dict.fromkeys(("1", "180", "bottomtotop"), "up"),
    **dict.fromkeys(("2", "270", "lefttoright"), "right"),
    **dict.fromkeys(("3", "90", "righttoleft"), "left"),
}
#: Lines that a header may have; the rows begin before.
_LONGEST_HEADER = 1000


def is_gcsv(path: Path) -> bool:
    """Whether ``path`` is a Gyroflow log."""
    return first_line(path).strip().startswith(_FIRST_LINES)


def read_gcsv(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a Gyroflow log; the accelerometer may be missing.

    Raises
    ------
    FormatError
        Where a scale, the orientation or a row is damaged.
    """
    header, rows = _read(path)
    assert rows.header is not None
    names = [name.lower() for name in rows.header]
    axes = _orientation(path, header)
    t_ns = np.rint(rows.numbers([0])[:, 0] * (_number(path, header, "tscale", 1e-3) * 1e9))
    if not np.isfinite(t_ns).all() or np.abs(t_ns).max() > 4e18:
        raise FormatError(path, Fact("gcsv-times-damaged"))
    stamps = t_ns.astype(np.int64)

    def samples(quantity: Quantity, unit: str) -> Samples:
        letter = quantity[0]
        values = rows.numbers([names.index(f"{letter}{axis}") for axis in "xyz"])
        values = axes.apply(values * _number(path, header, f"{letter}scale", 1.0))
        return order_rows(rows, quantity, unit, stamps, values)

    gyro = samples("gyro", units.gyro or "rad/s")
    has_accel = all(f"a{axis}" in names for axis in "xyz")
    device = " ".join(header[key][0] for key in ("vendor", "id") if header.get(key, ("",))[0])
    return build_recording(gyro, samples("accel", units.accel or "g") if has_accel else None, device=device)


def read_gcsv_frames(path: Path) -> FrameLog:
    """The readout of the frames, where the log states it; it holds no frame times.

    Raises
    ------
    FormatError
        Where the header is damaged.
    """
    header, _ = _read(path)
    readout_s = None
    direction: ReadoutDirection = "down"
    if "frame_readout_time" in header:
        readout_s = abs(_number(path, header, "frame_readout_time", 0.0)) * 1e-3
        if readout_s >= 0.5:
            raise FormatError(
                path, Fact("gcsv-readout-long", readout_ms=1e3 * readout_s), line=header["frame_readout_time"][1]
            )
        text, line = header.get("frame_readout_direction", ("0", 1))
        if text.lower() not in _DIRECTIONS:
            raise FormatError(path, Fact("gcsv-direction-unknown", text=text[:40]), line=line)
        direction = _DIRECTIONS[text.lower()]
    return FrameLog(t_s=np.zeros(0), readout_s=readout_s, readout_direction=direction)


def _read(path: Path) -> tuple[dict[str, tuple[str, int]], Table]:
    """The header's values with their lines, and the rows."""
    lines = read_text(path).splitlines()
    if not lines or not lines[0].strip().startswith(_FIRST_LINES):
        raise FormatError(path, Fact("gcsv-first-line", expected=_FIRST_LINES[0]), line=1)
    header: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(lines[1:_LONGEST_HEADER], start=2):
        if line.count(",") >= read_limits().table_columns:
            raise too_wide(path, number)
        cells = [cell.strip() for cell in line.split(",")]
        if cells[0].lower() in ("t", "time") and len(cells) > 3:
            names = [cell.lower() for cell in cells]
            if not all(f"g{axis}" in names for axis in "xyz"):
                raise FormatError(path, Fact("gcsv-without-columns", line=line[:100]), line=number)
            # blank lines in front keep the line numbers of messages right
            return header, parse_table(path, "\n" * (number - 1) + "\n".join(lines[number - 1 :]) + "\n")
        if len(cells) >= 2:
            header[cells[0].lower()] = (",".join(cells[1:]), number)
    raise FormatError(path, Fact("gcsv-without-header"))


def _number(path: Path, header: dict[str, tuple[str, int]], key: str, default: float) -> float:
    text, line = header.get(key, (str(default), 1))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (key != "frame_readout_time" and value == 0):
        raise FormatError(path, Fact("gcsv-not-a-factor", key=key, text=text[:40]), line=line)
    return value


def _orientation(path: Path, header: dict[str, tuple[str, int]]) -> Axes:
    """Map of columns to axes; as written where the log does not state it."""
    text, line = header.get("orientation", ("XYZ", 1))
    try:
        return Axes.of_letters(text)
    except ValueError:
        raise FormatError(path, Fact("gcsv-orientation", text=text[:40]), line=line) from None
