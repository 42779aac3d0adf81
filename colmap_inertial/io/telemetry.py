"""RunCam and its kin, which write counts; Insta360, which the package ``telemetry-parser`` (extra ``devices``) reads.

Of the latter only raw samples, units, scales and orientations are taken; the conversion is ours. A reading's letters
say which of the file's axes is x, y, z, a small letter its opposite. RunCam 5, iFlight and
Thumb write counts into a CSV that only its name tells from others; Mobius adds a temperature. Insta360 appends records
to its video: six numbers
a sample, either counts, or rad/s and g. None of these makers documents its axes: where gyroscope and accelerometer do
not turn
together, the checks of every recording say so.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.io.files import first_line
from colmap_inertial.io.imu_text import build_recording, order_rows
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.tables import read_table
from colmap_inertial.io.units import SENSOR_NAMES, DeclaredUnits, Quantity

#: Names of logs of counts, and the columns with which they begin; the columns that tell Mobius by itself.
_NAMES = re.compile(r"(RC_GyroData|gyroDat[ae]|Thumb).*\.csv", re.IGNORECASE)
_COLUMNS = re.compile(r"time,r?x,r?y,r?z(,ax,ay,az)?$")
_MOBIUS = "time,rx,ry,rz,ax,ay,az,temp"
#: Cameras by the beginning of the name: range of the gyroscope (deg/s of 32768 counts), and axes.
_CAMERAS = {
    "rc_": ("Runcam 5 Orange", 500.0, "xzY"),
    "gyrodat": ("iFlight GOCam GR", 500.0, "xZy"),
    "thumb": ("Runcam Thumb", 1000.0, "Yxz"),
}
_MOBIUS_CAMERA = ("Mobius Maxi 4K", 500.0, "yxz")
#: Counts of the accelerometer for one g.
_COUNTS_PER_G = 16384.0
#: An Insta360 video ends with this.
_INSTA360 = b"8db42d694ccc418790edff439fe026bf"
#: Its units in our spelling.
_UNITS = {"deg/s": "deg/s", "rad/s": "rad/s", "g": "g", "m/s²": "m/s2"}
#: The parser's own process.
_PARSE = """
import json, os, resource, sys
import telemetry_parser
out = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what the parser prints is no result
hard = resource.getrlimit(resource.RLIMIT_AS)[1]
most = int(sys.argv[2]) if hard == resource.RLIM_INFINITY else min(int(sys.argv[2]), hard)
resource.setrlimit(resource.RLIMIT_AS, (most, hard))
parser = telemetry_parser.Parser(sys.argv[1])
names = [str(name or "") for name in (parser.camera, parser.model)]
json.dump([*names, parser.telemetry()], out, default=str)
"""


@dataclass(frozen=True, kw_only=True)
class TelemetryLimits:
    """Limits of the parser's process, and of what it reads."""

    #: Memory that it may take, and more for each byte of the file: readings become objects of ten times their text.
    memory_bytes: int = 1 << 30
    memory_of_a_byte: int = 20
    #: Longer readouts are ignored.
    readout_s: float = 0.5


_LIMITS = TelemetryLimits()


def is_telemetry(path: Path) -> bool:
    """Whether ``path`` is a log of a RunCam, iFlight, Thumb or Mobius camera, or a video of an Insta360."""
    if not path.is_file():
        return False
    if path.suffix.lower() == ".csv":
        header = first_line(path).strip().replace(" ", "")
        return header == _MOBIUS or (_NAMES.fullmatch(path.name) is not None and _COLUMNS.match(header) is not None)
    with path.open("rb") as file:
        if file.seek(0, 2) < len(_INSTA360):
            return False
        file.seek(-len(_INSTA360), 2)
        return file.read() == _INSTA360


def read_telemetry(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of such a recording; the accelerometer may be missing.

    Raises
    ------
    MissingExtraError
        Where ``telemetry-parser`` is not installed.
    FormatError
        Where it cannot read the recording, or finds no gyroscope in it.
    """
    if path.suffix.lower() == ".csv":
        return _read_counts(path, units)
    camera, groups = _parse_telemetry(path)
    gyro = _samples(path, groups, "gyro", units.gyro)
    if gyro is None:
        raise FormatError(path, Fact("telemetry-without-gyroscope", camera=camera))
    return build_recording(gyro, _samples(path, groups, "accel", units.accel), device=camera)


def _read_counts(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read a log of counts: milliseconds, gyroscope, accelerometer."""
    table = read_table(path)
    header = ",".join(table.header or ()).lower().replace(" ", "")
    known = [camera for begin, camera in _CAMERAS.items() if path.name.lower().startswith(begin)]
    name, range_deg_s, letters = _MOBIUS_CAMERA if header == _MOBIUS or not known else known[0]
    if table.width < 4:
        raise FormatError(path, Fact("counts-without-gyroscope"))
    t_ns = table.stamps_ns(0, "ms")
    axes = Axes.of_letters(letters)
    rates = axes.apply(table.numbers([1, 2, 3]) * (range_deg_s / 32768.0))
    gyro = order_rows(table, "gyro", units.gyro or "deg/s", t_ns, rates)
    if table.width < 7:
        return build_recording(gyro, None, device=name)
    force = table.numbers([4, 5, 6]) / _COUNTS_PER_G
    if name == "Runcam 5 Orange":
        force = Axes.parse("y,z,-x").apply(force)
    accel = order_rows(table, "accel", units.accel or "g", t_ns, axes.apply(force))
    return build_recording(gyro, accel, device=name)


def read_telemetry_frames(path: Path) -> FrameLog | None:
    """The readout that an Insta360 states of its frames; ``None`` where it states none."""
    if path.suffix.lower() == ".csv":
        return None
    _, groups = _parse_telemetry(path)
    metadata = groups.get("Default", {}).get("Metadata")
    readout_s = 1e-3 * float(metadata.get("rolling_shutter_time") or 0.0) if isinstance(metadata, dict) else 0.0
    if not 0 < readout_s < _LIMITS.readout_s:
        return None
    return FrameLog(t_s=np.zeros(0), readout_s=readout_s)


def _parse_telemetry(path: Path) -> tuple[str, dict[str, dict[str, Any]]]:
    """The camera's name, and what telemetry-parser found, by group and tag.

    It runs in a process of its own: on damaged files it may abort, which no exception tells of.
    """
    if find_spec("telemetry_parser") is None:
        raise MissingExtraError("devices", Fact("needs-telemetry-parser", path=str(path)))
    most_bytes = _LIMITS.memory_bytes + _LIMITS.memory_of_a_byte * path.stat().st_size
    command = [sys.executable, "-P", "-c", _PARSE, str(path.absolute()), str(most_bytes)]
    done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        last_words, code = lines[-1] if lines else "", done.returncode
        ended = {"signal": -code if code < 0 else None, "exit_code": code if code > 0 else None}
        raise FormatError(path, Fact("telemetry-parser-failed", last_words=last_words, **ended))
    camera, model, parts = json.loads(done.stdout)
    groups: dict[str, dict[str, Any]] = {}
    for part in parts:
        for group, tags in part.items():
            groups.setdefault(group, {}).update(tags)
    return model if model.lower().startswith(camera.lower()) else f"{camera} {model}".strip(), groups


def _samples(path: Path, groups: dict[str, dict[str, Any]], quantity: Quantity, declared: str | None) -> Samples | None:
    tags = groups.get({"gyro": "Gyroscope", "accel": "Accelerometer"}[quantity], {})
    rows = tags.get("Data")
    if not rows:
        return None
    try:
        t_s = np.array([row["t"] for row in rows], dtype=np.float64)
        values: Array = np.array([[row[axis] for axis in "xyz"] for row in rows], dtype=np.float64)
        unit = _UNITS[tags["Unit"]]
        scale = tags.get("Scale")
        axes = Axes.of_letters(tags["Orientation"])
    except (KeyError, TypeError, ValueError) as error:
        what = SENSOR_NAMES[quantity]
        raise FormatError(path, Fact("telemetry-not-understood", sensor=what, detail=str(error))) from None
    # a damaged stamp stays one: the checks of samples name it
    t_ns = np.rint(np.nan_to_num(np.clip(t_s, -4e9, 4e9), nan=4e9) * 1e9).astype(np.int64)
    return order_samples(path, quantity, declared or unit, t_ns, axes.apply(values / (scale or 1.0)))
