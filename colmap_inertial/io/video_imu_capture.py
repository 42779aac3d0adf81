"""VideoIMUCapture (Android): ``video_meta.pb3``, one protobuf message beside ``video_recording.mp4``.

``VideoCaptureData`` holds the camera's facts (2), IMU samples (4) and frames (5). A sample: time in ns (1), gyroscope
(2) with the phone's estimate of its drift (3), accelerometer (4) with its bias (5), rad/s and m/s2. A frame: start of
exposure in ns (1), exposure (3), duration (4) and readout (5) in ns, ISO (6), focal length in px (8), shifts of the
stabilised lens (10). Frames and samples are stamped by one clock. Drift and bias are not subtracted: the phone changes
them in steps, a bias of ours is one for the recording (github.com/DavidGillsjo/VideoIMUCapture-Android).

Protobuf's wire format: each field begins with a number, ``field << 3 | type``; type 0 is a number of 7 bits a byte, the
lowest first, type 1 eight bytes, 2 a length and as many bytes, 5 four bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.frame_times import frame_log
from colmap_inertial.io.imu_text import build_recording
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.units import DeclaredUnits, Quantity

_FILE = "video_meta.pb3"
#: Two's complement of 64-bit numbers.
_SIGN, _WRAP = 1 << 63, 1 << 64


def is_video_imu_capture(path: Path) -> bool:
    """Whether ``path`` is a VideoIMUCapture folder, or its video_meta.pb3."""
    return _file(path).is_file()


def read_video_imu_capture(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a VideoIMUCapture recording; the accelerometer may be missing.

    Raises
    ------
    FormatError
        Where the file is damaged (the message names the byte), or holds no gyroscope samples.
    """
    file, data = _load(path)
    t_ns: list[int] = []
    rows: dict[str, list[bytes]] = {"gyro": [], "accel": []}
    for begin, end in _messages(file, data, 4):
        stamp, parts = 0, {2: b"", 4: b""}
        for number, value, at in _fields(file, data, begin, end):
            if number == 1 and isinstance(value, int):
                stamp = value
            elif number in parts and isinstance(value, tuple):
                parts[number] += data[value[0] : value[1]]
            elif number in parts:
                raise _damage_error(file, at, Fact("sample-not-three-numbers"))
        t_ns.append(_convert_to_signed(stamp))
        rows["gyro"].append(parts[2])
        rows["accel"].append(parts[4])
    stamps = np.array(t_ns, dtype=np.int64)
    gyro = _samples(file, stamps, rows["gyro"], "gyro", units.gyro or "rad/s")
    accel = _samples(file, stamps, rows["accel"], "accel", units.accel or "m/s2")
    if gyro is None:
        raise FormatError(file, Fact("no-gyroscope-samples"))
    return build_recording(gyro, accel)


def read_video_imu_capture_frames(path: Path) -> FrameLog:
    """Times, exposures, readout, ISO and focal lengths of the video's frames.

    Raises
    ------
    FormatError
        Where the file is damaged, or frames are not in order of time.
    """
    file, data = _load(path)
    wanted = {1: "t", 3: "exposure", 5: "readout", 6: "iso", 8: "focal"}
    rows: list[dict[str, float]] = []
    t_ns: list[int] = []
    lens_moves = False
    for begin, end in _messages(file, data, 5):
        row: dict[str, float] = {}
        for number, value, at in _fields(file, data, begin, end):
            if number == 10:
                lens_moves = True
            if number not in wanted:
                continue
            if isinstance(value, tuple):
                raise _damage_error(file, at, Fact("frame-number-not-one"))
            row[wanted[number]] = _float32(value) if number == 8 else float(_convert_to_signed(value))
            if number == 1:
                t_ns.append(_convert_to_signed(value))
        rows.append(row)
    if len(t_ns) != len(rows) or not rows:
        raise FormatError(file, Fact("frame-without-time" if rows else "no-frames"))

    def column(name: str, factor: float, high: float) -> Array | None:
        values = np.array([row.get(name, np.nan) for row in rows]) * factor
        return values if ((values > 0) & (values < high)).all() else None

    readout = column("readout", 1e-9, 0.5)
    stabilised, words = _stabilisation(file, data, lens_moves)
    return frame_log(
        file,
        np.array(t_ns, dtype=np.int64),
        exposure_s=column("exposure", 1e-9, 10.0),
        iso=column("iso", 1.0, 1e7),
        focal_px=column("focal", 1.0, 1e6),
        readout_s=None if readout is None else float(np.median(readout)),
        stabilised=stabilised,
        stabilisation=words,
    )


def _stabilisation(file: Path, data: bytes, lens_moves: bool) -> tuple[bool | None, str]:
    """Stabilisation in the camera's facts (field 2): 3 optical, 4 electronic; proto3 leaves out what is false."""
    for begin, end in _messages(file, data, 2):
        flags = {number: value for number, value, _ in _fields(file, data, begin, end) if number in (3, 4)}
        words = [name for number, name in ((3, "optical"), (4, "electronic")) if flags.get(number)]
        return bool(words), " and ".join(words)
    return (True, "optical") if lens_moves else (None, "")


def _samples(file: Path, t_ns: Int64Array, rows: list[bytes], quantity: Quantity, unit: str) -> Samples | None:
    """Samples of one sensor; messages without it are passed over."""
    has = np.array([len(row) > 0 for row in rows], dtype=bool)
    if not has.any():
        return None
    wrong = next((i for i, row in enumerate(rows) if len(row) not in (0, 12)), None)
    if wrong is not None:
        raise FormatError(file, Fact("imu-sample-bytes", sample=wrong + 1, bytes=len(rows[wrong])))
    with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
        values = np.frombuffer(b"".join(rows), "<f4").astype(np.float64).reshape(-1, 3)
    return order_samples(file, quantity, unit, t_ns[has], values)


# --- protobuf --------------------------------------------------------------------------------------------------------


def _messages(file: Path, data: bytes, wanted: int) -> list[tuple[int, int]]:
    """Location of each message of one field of the outermost message."""
    return [
        value for number, value, _ in _fields(file, data, 0, len(data)) if number == wanted and isinstance(value, tuple)
    ]


def _fields(file: Path, data: bytes, begin: int, end: int) -> Iterator[tuple[int, int | tuple[int, int], int]]:
    """Number, value and place of each field; what has a length is where it begins and ends."""
    at = begin
    while at < end:
        start = at
        key, at = _varint(file, data, at, end)
        kind = key & 7
        if kind == 0:
            value, at = _varint(file, data, at, end)
            yield key >> 3, value, start
            continue
        if kind == 2:
            length, at = _varint(file, data, at, end)
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
        else:
            raise _damage_error(file, start, Fact("wire-type", type=kind))
        if at + length > end:
            raise _damage_error(file, start, Fact("field-beyond-message", length=length, left=end - at))
        yield key >> 3, (at, at + length) if kind == 2 else int.from_bytes(data[at : at + length], "little"), start
        at += length


def _varint(file: Path, data: bytes, at: int, end: int) -> tuple[int, int]:
    value = shift = 0
    start = at
    while at < end and shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (_WRAP - 1), at
        shift += 7
    raise _damage_error(file, start, Fact("number-without-end"))


def _convert_to_signed(value: int) -> int:
    return value - _WRAP if value >= _SIGN else value


def _float32(bits: int) -> float:
    return float(np.array([bits & 0xFFFFFFFF], dtype=np.uint32).view(np.float32)[0])


def _damage_error(file: Path, at: int, fault: Fact) -> FormatError:
    return FormatError(file, Fact("damaged-at-byte", byte=at, fault=fault))


def _file(path: Path) -> Path:
    return path if path.name == _FILE else path / _FILE


def _load(path: Path) -> tuple[Path, bytes]:
    file = _file(path)
    return file, read_bytes(file)
