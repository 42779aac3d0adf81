"""Recordings written in the exact layouts of cameras and phone apps, for the tests of their readers."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from colmap_inertial.core.types import ImuRecording

GRAVITY_M_S2 = 9.80665


def stamps_ns(imu: ImuRecording, t_s: np.ndarray) -> np.ndarray:
    return imu.epoch_ns + np.rint(t_s * 1e9).astype(np.int64)


# --- MP4 -------------------------------------------------------------------------------------------------------------


@dataclass
class Mp4Track:
    """A track to be written: its samples, and how long each lasts in ticks."""

    handler: bytes
    entry: bytes
    samples: Sequence[bytes]
    durations: Sequence[int]
    timescale: int = 90000
    edit: tuple[int, int] | None = None  # empty ticks of the movie (1000 a second), media time
    chunk: int = 1
    size_px: tuple[int, int] = (64, 48)
    long_offsets: bool = False


def box(name: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), name) + body


def full_box(name: bytes, *parts: bytes) -> bytes:
    return box(name, bytes(4), *parts)


def table(name: bytes, row: str, rows: Sequence[tuple[int, ...]]) -> bytes:
    return full_box(name, struct.pack(">I", len(rows)), *(struct.pack(row, *values) for values in rows))


def runs(values: Sequence[int]) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    for value in values:
        if found and found[-1][1] == value:
            found[-1] = (found[-1][0] + 1, value)
        else:
            found.append((1, value))
    return found


def write_mp4(path: Path, tracks: Sequence[Mp4Track], user_data: Sequence[tuple[bytes, bytes]] = ()) -> Path:
    """``ftyp``, the samples track by track in ``mdat``, and ``moov`` at the end, as cameras write it."""
    head = box(b"ftyp", b"mp41", bytes(4), b"mp41")
    at, media, traks = len(head) + 8, [], []
    for track in tracks:
        chunks = [track.samples[i : i + track.chunk] for i in range(0, len(track.samples), track.chunk)]
        offsets = []
        for chunk in chunks:
            offsets.append((at,))
            media.extend(chunk)
            at += sum(map(len, chunk))
        traks.append(_trak(track, offsets, [len(chunk) for chunk in chunks]))
    movie = full_box(b"mvhd", struct.pack(">4I", 0, 0, 1000, 0), bytes(80))
    data = [box(b"udta", *(box(name, body) for name, body in user_data))] if user_data else []
    path.write_bytes(head + box(b"mdat", *media) + box(b"moov", movie, *data, *traks))
    return path


def _trak(track: Mp4Track, offsets: list[tuple[int]], per_chunk: list[int]) -> bytes:
    entry = struct.pack(">I4s6xH", 0, track.entry, 1)
    if track.handler == b"vide":
        entry += bytes(16) + struct.pack(">HH", *track.size_px) + bytes(50)
    entry = struct.pack(">I", len(entry)) + entry[4:]
    first = [1, *(i + 1 for i in range(1, len(per_chunk)) if per_chunk[i] != per_chunk[i - 1])]
    stbl = box(
        b"stbl",
        full_box(b"stsd", struct.pack(">I", 1), entry),
        table(b"stts", ">II", runs(track.durations)),
        table(b"stsc", ">III", [(chunk, per_chunk[chunk - 1], 1) for chunk in first]),
        full_box(
            b"stsz", struct.pack(">II", 0, len(track.samples)), *(struct.pack(">I", len(s)) for s in track.samples)
        ),
        table(b"co64", ">Q", offsets) if track.long_offsets else table(b"stco", ">I", offsets),
    )
    mdia = box(
        b"mdia",
        full_box(b"mdhd", struct.pack(">4I", 0, 0, track.timescale, sum(track.durations)), bytes(4)),
        full_box(b"hdlr", b"mhlr", track.handler, bytes(13)),
        box(b"minf", stbl),
    )
    edits = b""
    if track.edit is not None:
        rows = [(track.edit[0], -1, 0x10000)] if track.edit[0] else []
        edits = box(b"edts", table(b"elst", ">iiI", [*rows, (1000, track.edit[1], 0x10000)]))
    return box(b"trak", full_box(b"tkhd", bytes(80)), edits, mdia)


def video_track(frames: int, *, edit: tuple[int, int] | None = None) -> Mp4Track:
    """A track at 29.97 frames a second whose pictures nobody decodes."""
    return Mp4Track(b"vide", b"avc1", [b"\0\0\0\1"] * frames, [3003] * frames, edit=edit, chunk=7)


# --- GoPro -----------------------------------------------------------------------------------------------------------


def klv(key: bytes, kind: bytes, size: int, body: bytes) -> bytes:
    return struct.pack(">4scBH", key, kind, size, len(body) // size) + body + bytes(-len(body) % 4)


def nest(key: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">4scBH", key, b"\0", 1, len(body)) + body + bytes(-len(body) % 4)


def text(key: bytes, value: bytes) -> bytes:
    return klv(key, b"c", 1, value)


@dataclass
class GoPro:
    """How a GoPro writes: order of the channels, clock, scales, global settings."""

    order: str = "XzY"
    says_order: bool = True
    clock: str = "STMP"
    gyro_scale: int = 939
    accel_scale: int = 417
    firmware: bytes = b"H19.03.01.30.00"
    names: tuple[bytes, bytes] = (b"Gyroscope", b"Accelerometer")
    settings: bytes = b""
    extra: bytes = b""
    late_s: float = 0.0
    readout_ms: float | None = None
    temperature_c: float | None = None
    temperature_as: tuple[bytes, int] = (b"f", 4)


HERO5 = GoPro(
    order="ZXY",
    says_order=False,
    clock="TICK",
    gyro_scale=3755,
    accel_scale=418,
    firmware=b"HD5.02.02.00.00",
    names=(b"Gyroscope (z,x,y)", b"Accelerometer (up/down, right/left, forward/back)"),
)
HERO6 = GoPro(order="YxZ", says_order=False, clock="", firmware=b"HD6.01.02.01.00")
FUSION = GoPro(order="yXZ", says_order=False, firmware=b"FS1.04.01.80.00")
MAX = GoPro(
    settings=nest(
        b"DEVC",
        text(b"MINF", b"GoPro Max"),
        klv(b"SROT", b"f", 4, struct.pack(">f", 20.6)),
        text(b"EISE", b"N"),
        text(b"EISA", b"N/A"),
    )
)


def channels(values: np.ndarray, order: str) -> np.ndarray:
    """x, y, z samples as the channels that ``order`` names."""
    sign = [-1.0 if letter.islower() else 1.0 for letter in order]
    return values[:, ["XYZ".index(letter.upper()) for letter in order]] * sign


def write_gopro(
    path: Path,
    imu: ImuRecording,
    style: GoPro = MAX,
    *,
    frames: int | None = None,
    gps: tuple[bytes, np.ndarray, np.ndarray, int] | None = None,
) -> Path:
    """A GoPro video whose first frame is at the first gyroscope stamp; payloads last 1.001 s.

    ``gps``: GPS5 or GPS9, times, (N, 3) latitude, longitude, height, and which payload has no fix.
    """
    t0, end = float(imu.gyro_t_s[0]), float(imu.gyro_t_s[-1])
    frames = round((end - t0) * 30000 / 1001) if frames is None else frames
    counts = max(2, int(np.ceil((end - t0) / 1.001)))
    edges = t0 + 1.001 * np.arange(counts + 1)
    edges[-1] = np.inf
    frame_t = t0 + np.arange(frames) * 1001 / 30000
    exposure = 1e-3 * (1 + np.arange(frames) % 7)
    series: list[tuple[bytes, np.ndarray, np.ndarray, bytes]] = [
        (b"ACCL", imu.accel_t_s, np.rint(channels(imu.accel_m_s2, style.order) * style.accel_scale), b"m/s\xb2"),
        (b"GYRO", imu.gyro_t_s, np.rint(channels(imu.gyro_rad_s, style.order) * style.gyro_scale), b"rad/s"),
        (b"SHUT", frame_t, exposure[:, None], b"s"),
    ]
    if style.readout_ms is not None:
        series.append((b"SROT", frame_t, np.full((frames, 1), style.readout_ms), b"ms"))
    payloads = []
    for begin, stop in pairwise(edges):
        streams = []
        for key, t_s, values, unit in series:
            inside = np.flatnonzero((t_s >= begin) & (t_s < stop)) if begin > t0 else np.flatnonzero(t_s < stop)
            if len(inside):
                streams.append(_gopro_stream(key, t_s[inside[0]], values[inside], unit, inside[-1] + 1, style))
        if gps is not None:
            inside = (gps[1] >= begin) & (gps[1] < stop)
            streams.append(_gopro_gps(gps[0], gps[1][inside], gps[2][inside], len(payloads) != gps[3]))
        about = [klv(b"DVID", b"L", 4, b"\0\0\0\1"), text(b"DVNM", b"Camera")]
        if style.clock == "DEVC":
            about.append(klv(b"TICK", b"L", 4, struct.pack(">I", round((begin + 1000) * 1e3))))
        payloads.append(nest(b"DEVC", *about, *streams) + style.extra)
    data = [(b"FIRM", style.firmware)]
    if style.settings:
        data.append((b"GPMF", style.settings + bytes(64)))
    telemetry = Mp4Track(b"meta", b"gpmd", payloads, [1001] * len(payloads), timescale=1000)
    return write_mp4(path, [video_track(frames), telemetry], data)


def _gopro_gps(key: bytes, t_s: np.ndarray, place: np.ndarray, fix: bool) -> bytes:
    head = klv(b"STMP", b"J", 8, struct.pack(">Q", round((float(t_s[0]) + 1000) * 1e6)))
    whole = np.rint(place * [1e7, 1e7, 1e3]).astype(int)
    if key == b"GPS9":
        head += text(b"TYPE", b"lllllllSS")
        head += klv(b"SCAL", b"l", 4, struct.pack(">9l", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1))
        rows = b"".join(struct.pack(">7l2H", *row, 0, 0, 9000, 0, 140, 3 if fix else 0) for row in whole.tolist())
        return nest(b"STRM", head, klv(b"GPS9", b"?", 32, rows))
    head += klv(b"GPSF", b"L", 4, struct.pack(">I", 3 if fix else 0)) + klv(b"GPSP", b"S", 2, struct.pack(">H", 140))
    head += text(b"GPSA", b"MSLV") + klv(b"SCAL", b"l", 4, struct.pack(">5l", 10**7, 10**7, 1000, 1000, 100))
    rows = b"".join(struct.pack(">5l", *row, 0, 0) for row in whole.tolist())
    return nest(b"STRM", head, klv(b"GPS5", b"l", 20, rows))


def _gopro_stream(key: bytes, t_s: float, values: np.ndarray, unit: bytes, total: int, style: GoPro) -> bytes:
    parts = []
    if style.clock == "STMP":
        parts.append(klv(b"STMP", b"J", 8, struct.pack(">Q", round((t_s + style.late_s + 1000) * 1e6))))
    parts.append(klv(b"TSMP", b"L", 4, struct.pack(">I", total)))
    if style.clock == "TICK":
        parts.append(klv(b"TICK", b"L", 4, struct.pack(">I", round((t_s + style.late_s + 1000) * 1e3))))
    if style.late_s and key in (b"GYRO", b"ACCL"):
        parts.append(klv(b"TIMO", b"f", 4, struct.pack(">f", style.late_s)))
    if key in (b"SHUT", b"SROT"):
        return nest(
            b"STRM", *parts, klv(b"SIUN", b"c", len(unit), unit), klv(key, b"f", 4, values.astype(">f4").tobytes())
        )
    gyro = key == b"GYRO"
    parts.append(text(b"STNM", style.names[0 if gyro else 1]))
    if style.says_order:
        matrix = np.zeros((3, 3))
        for row, axis in enumerate("ZXY"):
            column = style.order.upper().index(axis)
            matrix[row, column] = -1.0 if style.order[column].islower() else 1.0
        parts.append(klv(b"MTRX", b"f", 36, matrix.astype(">f4").tobytes()))
        parts += [klv(b"ORIN", b"c", 3, style.order.encode()), text(b"ORIO", b"ZXY")]
    if style.temperature_c is not None:
        parts.append(klv(b"TMPC", *style.temperature_as, struct.pack(">f", style.temperature_c)))
    parts.append(klv(b"SIUN", b"c", len(unit), unit))
    parts.append(klv(b"SCAL", b"s", 2, struct.pack(">h", style.gyro_scale if gyro else style.accel_scale)))
    return nest(b"STRM", *parts, klv(key, b"s", 6, values.astype(">i2").tobytes()))


# --- other videos ----------------------------------------------------------------------------------------------------


def write_camm(path: Path, imu: ImuRecording, *, frames: int = 60, fixes: np.ndarray | None = None) -> Path:
    """Gyroscope, accelerometer and one exposure for each frame, in one track with a tick of a microsecond.

    ``fixes``: (N, 4) seconds, latitude, longitude, height.
    """
    t0 = float(imu.gyro_t_s[0])
    packets = [(t, 2, struct.pack("<3f", *v)) for t, v in zip(imu.gyro_t_s - t0, imu.gyro_rad_s, strict=True)]
    packets += [
        (t, 3, struct.pack("<3f", *v)) for t, v in zip(imu.accel_t_s - t0, imu.accel_m_s2, strict=True) if t >= 0
    ]
    packets += [(i * 1001 / 30000, 1, struct.pack("<ii", 4_000_000, 21_000_000)) for i in range(frames)]
    packets += [(0.0, 7, struct.pack("<3f", 20.0, 0.0, 40.0))]
    for t, lat, lon, up in np.zeros((0, 4)) if fixes is None else fixes:
        packets.append((t, 6, struct.pack("<diddfff4f", 1e9 + t, 3, lat, lon, up, 2.5, 4.0, 0, 0, 0, 1)))
    packets.sort(key=lambda packet: packet[0])
    ticks = np.rint(np.array([t for t, _, _ in packets]) * 1e6).astype(int)
    samples = [struct.pack("<HH", 0, kind) + body for _, kind, body in packets]
    durations = [*np.diff(ticks).tolist(), 1]
    track = Mp4Track(b"meta", b"camm", samples, durations, timescale=1_000_000, chunk=50, long_offsets=True)
    return write_mp4(path, [video_track(frames), track])


def write_dji(path: Path) -> Path:
    return write_mp4(path, [video_track(10), Mp4Track(b"meta", b"djmd", [b"\n\2\n\0"] * 10, [3003] * 10)])


# --- text ------------------------------------------------------------------------------------------------------------


def write_gcsv(path: Path, imu: ImuRecording, *, order: str = "YxZ", header: str = "") -> Path:
    """One clock for both sensors."""
    gscale, ascale, t0 = 0.0002, 0.00012, float(imu.gyro_t_s[0])
    # out[i] = column named by order[i]: the file's columns are the transpose of that
    gyro, accel = (_inverse(values, order) for values in (imu.gyro_rad_s, imu.accel_m_s2 / GRAVITY_M_S2))
    rows = [
        ",".join(map(str, [round((t - t0) * 1e5), *np.rint(g / gscale).astype(int), *np.rint(a / ascale).astype(int)]))
        for t, g, a in zip(imu.gyro_t_s, gyro, accel, strict=True)
    ]
    head = ["GYROFLOW IMU LOG", "version,1.3", "id,mycam_v2", "vendor,simulated", f"orientation,{order}", "note,a, b"]
    head += ["tscale,0.00001", f"gscale,{gscale}", f"ascale,{ascale}", *header.splitlines(), "t,gx,gy,gz,ax,ay,az"]
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


def _inverse(values: np.ndarray, order: str) -> np.ndarray:
    out = np.empty_like(values)
    for row, letter in enumerate(order):
        out[:, "XYZ".index(letter.upper())] = values[:, row] * (-1.0 if letter.islower() else 1.0)
    return out


#: Letters by which ``telemetry-parser`` reads each camera's axes, and the name and columns of its log.
RUNCAMS = {
    "Runcam 5 Orange": ("RC_GyroData0001.csv", "time,rx,ry,rz,ax,ay,az", "xzY"),
    "GOCam GR": ("gyroData0001.csv", "time,x,y,z,ax,ay,az", "xZy"),
    "Thumb": ("Thumb0001.csv", "time,x,y,z,ax,ay,az", "Yxz"),
    "Mobius Maxi 4K": ("IMU0001.csv", "time,rx,ry,rz,ax,ay,az,temp", "yxz"),
}


def write_runcam(folder: Path, imu: ImuRecording, camera: str) -> Path:
    """Counts of 500 deg/s (Thumb: 1000) and 2 g; one clock for both sensors, in milliseconds."""
    name, header, order = RUNCAMS[camera]
    range_rad_s = np.deg2rad(1000 if camera == "Thumb" else 500)
    gyro = _inverse(imu.gyro_rad_s, order) / range_rad_s * 32768
    accel = _inverse(imu.accel_m_s2, order) / (2 * GRAVITY_M_S2) * 32768
    if camera == "Runcam 5 Orange":
        accel = np.column_stack([-accel[:, 2], accel[:, 0], accel[:, 1]])
    last = [25] if header.endswith("temp") else []
    rows = [
        ",".join(
            map(str, [f"{1e3 * (t - imu.gyro_t_s[0]):.3f}", *np.rint(g).astype(int), *np.rint(a).astype(int), *last])
        )
        for t, g, a in zip(imu.gyro_t_s, gyro, accel, strict=True)
    ]
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


#: The same of Insta360's cameras.
INSTA360S = {
    "Insta360 Go": "xyZ",
    "Insta360 GO 2": "yXZ",
    "Insta360 OneR": "yXZ",
    "Insta360 OneRS": "yxz",
}


def write_insta360(path: Path, imu: ImuRecording, camera: str, *, counts: bool, readout_ms: float = 0.0) -> Path:
    """A video's end: records one after another, each with its kind and size behind it, and the mark."""
    order = INSTA360S[camera]
    gyro, accel = (_inverse(values, order) for values in (imu.gyro_rad_s, imu.accel_m_s2))
    samples = b""
    for t, g, a in zip(imu.gyro_t_s, gyro, accel, strict=True):
        samples += struct.pack("<Q", round((1e6 if counts else 1e3) * (t - imu.gyro_t_s[0])))
        if counts:
            whole = np.rint([*a / (16 * GRAVITY_M_S2) * 32768, *np.rad2deg(g) / 2000 * 32768]) + 32768
            samples += struct.pack("<6H", *whole.astype(int))
        else:
            samples += struct.pack("<6d", *a / GRAVITY_M_S2, *g)
    said = message(2, camera.encode()) + varint(25 << 3 | 1) + struct.pack("<d", readout_ms)
    said += number(62, 1) if counts else b""
    records = b"".join(
        data + bytes([1, kind]) + struct.pack("<I", len(data)) for kind, data in ((3, samples), (1, said))
    )
    end = bytes(32) + struct.pack("<II", len(records) + 72, 3) + b"8db42d694ccc418790edff439fe026bf"
    path.write_bytes(bytes(4096) + records + end)
    return path


def write_opencamera(folder: Path, imu: ImuRecording, frame_ns: np.ndarray, name: str = "VID_20260101_120000_") -> Path:
    for ending, t_s, values in (("gyro", imu.gyro_t_s, imu.gyro_rad_s), ("accel", imu.accel_t_s, imu.accel_m_s2)):
        lines = [f"{x:.8f},{y:.8f},{z:.8f},{t}" for t, (x, y, z) in zip(stamps_ns(imu, t_s), values, strict=True)]
        (folder / f"{name}{ending}.csv").write_text("\n".join(lines) + "\n")
    (folder / f"{name}timestamps.csv").write_text("".join(f"{t}\n" for t in frame_ns))
    return folder


def write_mars(folder: Path, imu: ImuRecording, frame_ns: np.ndarray) -> Path:
    """The Android version; one clock for both sensors; the sensor took two pictures before the video began."""
    units = "gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2]"
    lines = [
        f"{t}," + ",".join(f"{v:.7f}" for v in (*g, *a)) + f",{1_700_000_000_000 + t // 1_000_000}000000"
        for t, g, a in zip(stamps_ns(imu, imu.gyro_t_s), imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    ]
    (folder / "gyro_accel.csv").write_text("\n".join([f"Timestamp[nanosec],{units},Unix time[nanosec]", *lines]) + "\n")
    rows = [f"{t // 1000 * 1000},{1_700_000_000_000_000_000 + t}" for t in frame_ns]
    (folder / "frame_timestamps.txt").write_text(
        "\n".join(["Frame timestamp[nanosec],Unix time[nanosec]", *rows]) + "\n"
    )
    step = int(frame_ns[1] - frame_ns[0])
    taken = [int(frame_ns[0]) - 2 * step, int(frame_ns[0]) - step, *frame_ns.tolist()]
    head = (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode,Unix time[nanosec]"
    )
    rows = [
        f"{t},1500.5,1500.5,{i},{5_000_000 + 1000 * i},33333333,25000000,{100 + i},4.25,0.5,3,0"
        for i, t in enumerate(taken)
    ]
    (folder / "movie_metadata.csv").write_text("\n".join([head, *rows]) + "\n")
    return folder


def write_mars_ios(folder: Path, imu: ImuRecording) -> Path:
    head = "Timestamp[sec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]"
    lines = [
        f"{t:.7f}, " + ", ".join(f"{v:.5f}" for v in (*g, *a))
        for t, g, a in zip(imu.gyro_t_s + imu.epoch_ns * 1e-9, imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    ]
    (folder / "gyro_accel.csv").write_text("\n".join(["#Recording starts at Thu_01_01_2026", head, *lines]) + "\n")
    return folder


def write_stray_scanner(folder: Path, imu: ImuRecording, frame_ns: np.ndarray) -> Path:
    """One clock for both sensors; accelerations as CoreMotion gives them: g, the sign of gravity."""
    lines = [
        ", ".join(map(repr, [t * 1e-9, *(-a / GRAVITY_M_S2).tolist(), *g.tolist()]))
        for t, g, a in zip(stamps_ns(imu, imu.gyro_t_s).tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    ]
    head = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"
    (folder / "imu.csv").write_text("\n".join([head, *lines]) + "\n")
    rows = [f"{t * 1e-9!r}, {i:06}, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0" for i, t in enumerate(frame_ns.tolist())]
    (folder / "odometry.csv").write_text("\n".join(["timestamp, frame, x, y, z, qx, qy, qz, qw", *rows]) + "\n")
    (folder / "camera_matrix.csv").write_text("1591.5, 0.0, 959.5\n0.0, 1592.5, 719.5\n0.0, 0.0, 1.0")
    track = video_track(len(frame_ns))
    track.size_px = (1920, 1440)
    write_mp4(folder / "rgb.mp4", [track])
    return folder


def write_sensor_logger(
    folder: Path, imu: ImuRecording, *, platform: str = "ios", standardised: bool = False, tables: str = "total"
) -> Path:
    """A zip; ``tables`` is ``total``, ``uncalibrated`` or ``parts`` (linear acceleration and gravity)."""
    sign = -1.0 if platform == "ios" and not standardised else 1.0
    accel = sign * imu.accel_m_s2
    members = {"Gyroscope.csv": (imu.gyro_t_s, imu.gyro_rad_s)}
    if tables == "total":
        members["TotalAcceleration.csv"] = (imu.accel_t_s, accel)
    elif tables == "uncalibrated":
        unit = GRAVITY_M_S2 if platform == "ios" and not standardised else 1.0
        members["AccelerometerUncalibrated.csv"] = (imu.accel_t_s, accel / unit)
    else:
        gravity = np.tile(accel.mean(axis=0), (len(accel), 1))
        members["Gravity.csv"], members["Accelerometer.csv"] = (
            (imu.accel_t_s, gravity),
            (imu.accel_t_s, accel - gravity),
        )
    path = folder / "2026-01-01_12-00-00.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (t_s, values) in members.items():
            rows = [
                f"{t},{(t - imu.epoch_ns) * 1e-9:.7f},{z:.9f},{y:.9f},{x:.9f}"
                for t, (x, y, z) in zip(stamps_ns(imu, t_s).tolist(), values, strict=True)
            ]
            archive.writestr(name, "\n".join(["time,seconds_elapsed,z,y,x", *rows]) + "\n")
        head = "version,device name,recording time,platform,appVersion,device id,sensors,sampleRateMs,standardisation"
        row = (
            f"3,phone,2026-01-01_12-00-00,{platform},1.30,abc,Gyroscope|Accelerometer,10|10,{str(standardised).lower()}"
        )
        archive.writestr("Metadata.csv", f"{head}\n{row}\n")
    return path


def write_phyphox(
    folder: Path, imu: ImuRecording, *, delimiter: str = ",", decimal: str = ".", linear: bool = False
) -> Path:
    """A zip as phyphox exports it; ``linear`` leaves out the acceleration with gravity."""
    sensors = {
        "Gyroscope.csv": ("Gyroscope {} (rad/s)", imu.gyro_t_s, imu.gyro_rad_s),
        "Linear Acceleration.csv" if linear else "Accelerometer.csv": (
            "Linear Acceleration {} (m/s^2)" if linear else "Acceleration {} (m/s^2)",
            imu.accel_t_s,
            imu.accel_m_s2,
        ),
    }
    path = folder / "Experiment 2026-01-01 12-00-00.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (title, t_s, values) in sensors.items():
            lines = [delimiter.join(f'"{cell}"' for cell in ("Time (s)", *(title.format(axis) for axis in "xyz")))]
            for t, row in zip(t_s, values, strict=True):
                lines.append(delimiter.join(f"{v:.9E}".replace(".", decimal) for v in (t, *row)))
            archive.writestr(name, "\n".join(lines) + "\n")
        archive.writestr("meta/device.csv", '"property","value"\n"deviceModel","phone"\n')
        archive.writestr("meta/time.csv", '"event","experiment time","system time"\n"START",0.0E0,1.7E9\n')
    return path


# --- protobuf --------------------------------------------------------------------------------------------------------


def varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def number(field_number: int, value: int) -> bytes:
    return varint(field_number << 3) + varint(value)


def message(field_number: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return varint(field_number << 3 | 2) + varint(len(body)) + body


def floats(field_number: int, values: Sequence[float]) -> bytes:
    return message(field_number, struct.pack(f"<{len(values)}f", *values))


def write_video_imu_capture(folder: Path, imu: ImuRecording, frame_ns: np.ndarray) -> Path:
    """One clock for both sensors, as the app interpolates the accelerometer."""
    parts = [message(2, floats(1, [1500, 1500, 960, 540, 0]), number(4, 1), number(6, 1))]
    for t, g, a in zip(stamps_ns(imu, imu.gyro_t_s).tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        drift, bias = floats(3, [0.01, 0.02, 0.03]), floats(5, [0.1, 0.2, 0.3])
        parts.append(message(4, number(1, t), floats(2, g), drift, floats(4, a), bias, number(6, 3)))
    for i, t in enumerate(frame_ns.tolist()):
        times = number(1, t) + number(2, i) + number(3, 5_000_000 + i) + number(4, 33_333_333) + number(5, 21_000_000)
        focal = varint(8 << 3 | 5) + struct.pack("<f", 1500.25)
        shift = message(10, number(1, t), varint(2 << 3 | 5) + struct.pack("<f", 0.5))
        parts.append(message(5, times, number(6, 200), focal, shift))
    (folder / "video_meta.pb3").write_bytes(b"".join(parts))
    return folder


# --- ROS -------------------------------------------------------------------------------------------------------------


def write_rosbag(
    path: Path, imu: ImuRecording, *, kind: str = "ros1", apart: bool = False, packed_by: str = "", more: bytes = b""
) -> Path:
    """``kind`` is ros1, sqlite3 or mcap; ``apart``: one topic for each sensor, the other sensor zero.

    ``packed_by`` is bz2 or lz4 for ros1, else zstd, of each chunk (mcap) or message (sqlite3); ``more``: a last message
    of these bytes.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    imu_type, header, time = (
        store.types[name] for name in ("sensor_msgs/msg/Imu", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    vector, rotation = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Quaternion"]

    def packed(t: int, g: Sequence[float], a: Sequence[float]) -> bytes:
        sequence = {"seq": 0} if kind == "ros1" else {}
        content = imu_type(
            header=header(stamp=time(sec=t // 10**9, nanosec=t % 10**9), frame_id="imu", **sequence),
            orientation=rotation(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(x=float(g[0]), y=float(g[1]), z=float(g[2])),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(x=float(a[0]), y=float(a[1]), z=float(a[2])),
            linear_acceleration_covariance=np.zeros(9),
        )
        serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
        return bytes(serialize(content, imu_type.__msgtype__))

    series = [("/imu", imu.gyro_t_s, imu.gyro_rad_s, imu.accel_m_s2)]
    if apart:
        zeros = np.zeros((len(imu.accel_t_s), 3))
        series = [
            ("/gyro/sample", imu.gyro_t_s, imu.gyro_rad_s, np.zeros((len(imu.gyro_t_s), 3))),
            ("/accel/sample", imu.accel_t_s, zeros, imu.accel_m_s2),
        ]
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    opened = Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=plugin)
    if packed_by and kind == "ros1":
        opened.set_compression(getattr(Writer1.CompressionFormat, packed_by.upper()))
    elif packed_by:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode as modes

        opened.set_compression(modes.STORAGE if kind == "mcap" else modes.MESSAGE, CompressionFormat.ZSTD)
    with opened as writer:
        for topic, t_s, gyro, accel in series:
            connection = writer.add_connection(topic, imu_type.__msgtype__, typestore=store)
            for t, g, a in zip(stamps_ns(imu, t_s).tolist(), gyro, accel, strict=True):
                writer.write(connection, t, packed(t, g, a))
        if more:
            writer.write(connection, t, more)
    return path
