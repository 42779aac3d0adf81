"""Android recorders that write text: OpenCamera-Sensors and MARS logger. Sensors and frames share the phone's clock.

OpenCamera-Sensors writes ``{name}gyro.csv`` and ``{name}accel.csv`` without a header, rows ``x,y,z,t_ns`` in rad/s and
m/s2, and ``{name}timestamps.csv`` with one ``t_ns`` for each frame of the video
(github.com/prime-slam/OpenCamera-Sensors).

MARS logger writes ``gyro_accel.csv``, whose header names units, the accelerometer interpolated at the gyroscope's
times; ``frame_timestamps.txt`` with the time of each frame of the video, rounded to microseconds;
``movie_metadata.csv`` with exposure, readout, focal length in pixels and ISO of what the sensor took, which may be more
than the frames. The iOS version writes ``Timestamp[sec]`` and a first line ``#Recording starts at``
(github.com/OSUPCVLab/mobile-ar-sensor-logger).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.io.files import first_line
from colmap_inertial.io.frame_times import frame_log, stamps_of_log
from colmap_inertial.io.imu_text import SensorTable, read_csv, read_tables
from colmap_inertial.io.samples import nearest
from colmap_inertial.io.stamps import TimeColumns
from colmap_inertial.io.tables import Table, read_table, split_unit
from colmap_inertial.io.units import TIME_UNITS_NS, DeclaredUnits, unit_of

_MARS_TABLES = ("gyro_accel.csv", "raw_accel_gyro.csv")
#: Frames that the sensor took within this of a frame's rounded time are that frame.
_SAME_FRAME_NS = 2_000_000


def is_opencamera(path: Path) -> bool:
    """Whether ``path`` is an OpenCamera-Sensors folder, or the gyroscope's file in one."""
    files = _gyro_files(path)
    return bool(files) and all(_has_bare_rows(file) for file in files)


def read_opencamera(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read ``{name}gyro.csv`` and ``{name}accel.csv``; the accelerometer may be missing.

    Raises
    ------
    FormatError
        Also where a folder holds several recordings: give the gyroscope's file of one.
    """
    gyro_file = _one_gyro_file(path)
    accel_file = _sibling(gyro_file, "accel.csv")
    time = TimeColumns(columns=(4,), units=("ns",))
    gyro, accel = (
        SensorTable(file=file, time=time, columns=(1, 2, 3), unit=unit)
        for file, unit in ((gyro_file, units.gyro or "rad/s"), (accel_file, units.accel or "m/s2"))
    )
    return read_tables(gyro, accel if accel_file.is_file() else None, layout="x y z t_ns")


def read_opencamera_frames(path: Path) -> FrameLog | None:
    """The time of each frame of the video, on the IMU's clock; ``None`` where they were not recorded."""
    file = _sibling(_one_gyro_file(path), "timestamps.csv")
    return frame_log(file, stamps_of_log(file, "ns")) if file.is_file() else None


def is_mars(path: Path) -> bool:
    """Whether ``path`` is a MARS logger folder, or the table of its IMU."""
    return _mars_table(path) is not None


def read_mars(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read MARS logger's table of gyroscope and accelerometer."""
    table = _mars_table(path)
    if table is None:
        raise FormatError(path, Fact("mars-table-missing", table=_MARS_TABLES[0]))
    return read_csv(table, units)


def read_mars_frames(path: Path) -> FrameLog | None:
    """Times, exposures, ISO and focal lengths of the video's frames; ``None`` where they were not recorded."""
    folder = path.parent if path.is_file() else path
    times, details = folder / "frame_timestamps.txt", folder / "movie_metadata.csv"
    if not times.is_file() and not details.is_file():
        return None
    if not details.is_file():
        return frame_log(times, stamps_of_log(times))
    table = read_table(details)
    taken_ns = stamps_of_log(details)
    frame_ns = stamps_of_log(times) if times.is_file() else taken_ns
    order = np.argsort(taken_ns, kind="stable")
    row = order[nearest(taken_ns[order], frame_ns)]
    matched = bool((np.abs(taken_ns[row] - frame_ns) <= _SAME_FRAME_NS).all())

    def column(pattern: str, *, time: bool = False) -> Array | None:
        """One column at the frames: seconds of a time."""
        index = _find(table, pattern)
        if index is None or not matched:
            return None
        values = table.numbers([index])[row, 0]
        if time:
            assert table.header is not None
            unit = unit_of(split_unit(table.header[index])[1] or "")
            if unit not in TIME_UNITS_NS:
                return None
            values = values * (TIME_UNITS_NS[unit] / 1e9)
        return values if np.isfinite(values).all() and (values >= 0).all() else None

    readout = column("framereadouttime|rollingshutterskew", time=True)
    readout_s = None if readout is None else float(np.median(readout))
    return frame_log(
        times if times.is_file() else details,
        frame_ns,
        exposure_s=column("exposuretime|exposure", time=True),
        iso=column("iso"),
        focal_px=column("fx"),
        readout_s=readout_s if readout_s is not None and 0 < readout_s < 0.5 else None,
    )


# --- OpenCamera-Sensors ----------------------------------------------------------------------------------------------


def _gyro_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.name.endswith("gyro.csv") else []
    return sorted(file for file in path.glob("*gyro.csv") if file.is_file())


def _one_gyro_file(path: Path) -> Path:
    files = _gyro_files(path)
    if len(files) != 1:
        names = [file.name for file in files[:5]]
        raise FormatError(path, Fact("not-one-gyro-file", count=len(files), files=names))
    return files[0]


def _sibling(gyro_file: Path, ending: str) -> Path:
    return gyro_file.with_name(gyro_file.name.removesuffix("gyro.csv") + ending)


def _has_bare_rows(path: Path) -> bool:
    """Whether a file begins with a row of four numbers."""
    cells = first_line(path).split(",")
    return len(cells) == 4 and all(re.fullmatch(r"[-+.\deE]+", cell.strip()) for cell in cells)


# --- MARS logger -----------------------------------------------------------------------------------------------------


def _mars_table(path: Path) -> Path | None:
    candidates = [path] if path.is_file() else [path / name for name in _MARS_TABLES]
    return next((file for file in candidates if file.name in _MARS_TABLES and file.is_file()), None)


def _find(table: Table, pattern: str) -> int | None:
    """The column whose name, small and without blanks and unit, is ``pattern``."""
    flat = [re.sub(r"[\s_.]", "", split_unit(cell)[0]).lower() for cell in table.header or ()]
    return next((i for i, name in enumerate(flat) if re.fullmatch(pattern, name)), None)
