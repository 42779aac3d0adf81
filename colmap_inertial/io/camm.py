"""CAMM, the camera motion metadata that phones and street cameras write into MP4 files (track ``camm``).

Each sample of the track, little-endian: two reserved bytes, a 16-bit type, the data. Type 1 holds the exposure of a
pixel and the rolling shutter's skew (nanoseconds, 32 bit each), 2 the gyroscope (rad/s), 3 the accelerometer (m/s2),
both three floats along the camera's axes; 5 latitude, longitude (degrees) and height (metres) as doubles; 6 the same
with the time, the kind of fix and accuracies; 0, 4 and 7 are orientations and the magnetometer. A sample's
time is the track's, on the movie's clock (Google's Camera Motion Metadata Spec).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording, PositionFixes
from colmap_inertial.io.frame_times import frame_log
from colmap_inertial.io.imu_text import build_recording
from colmap_inertial.io.mp4 import Movie, Track, has_track, read_movie
from colmap_inertial.io.samples import Samples, nearest, order_samples
from colmap_inertial.io.units import DeclaredUnits, Quantity

_EXPOSURE, _GYRO, _ACCEL, _PLACE, _FIX = 1, 2, 3, 5, 6
_FIX_ROW = np.dtype(
    [
        ("t", "<f8"),
        ("kind", "<i4"),
        ("lat", "<f8"),
        ("lon", "<f8"),
        ("height", "<f4"),
        ("sigma", "<f4"),
        ("rest", "V20"),
    ]
)
#: Bytes of each type's data; a sample may hold several packets.
_LENGTHS = {0: 12, 1: 8, 2: 12, 3: 12, 4: 12, 5: 24, 6: 56, 7: 12}


def is_camm(path: Path) -> bool:
    """Whether ``path`` is an MP4 file with a CAMM track."""
    return has_track(path, "camm")


def read_camm(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a video with a CAMM track; stamps are on the video's clock.

    Raises
    ------
    FormatError
        Where there is no gyroscope, or the file is damaged.
    """
    packets = _packets(*_open_movie(path))
    samples_of: dict[int, Samples] = {}
    sensors: tuple[tuple[int, Quantity, str], ...] = (
        (_GYRO, "gyro", units.gyro or "rad/s"),
        (_ACCEL, "accel", units.accel or "m/s2"),
    )
    for kind, quantity, unit in sensors:
        t_ns, data = packets[kind]
        if len(t_ns):
            with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
                values = data.view("<f4").astype(np.float64)
            samples_of[kind] = order_samples(path, quantity, unit, t_ns, values)
    if _GYRO not in samples_of:
        raise FormatError(path, Fact("camm-without-gyroscope"))
    return build_recording(samples_of[_GYRO], samples_of.get(_ACCEL))


def read_camm_frames(path: Path) -> FrameLog:
    """Exposure and readout of the frames, where the CAMM track has them.

    Raises
    ------
    FormatError
        Where the file is damaged or holds no video.
    """
    movie, track = _open_movie(path)
    frame_ns = movie.frame_times_ns()
    t_ns, data = _packets(movie, track)[_EXPOSURE]
    exposure_s = readout_s = None
    if len(t_ns):
        times = data.view("<i4").astype(np.float64) * 1e-9
        exposure, skew = times[nearest(t_ns, frame_ns), 0], float(np.median(times[:, 1]))
        exposure_s = exposure if ((exposure >= 0) & (exposure < 10)).all() else None
        readout_s = skew if 0 <= skew < 0.5 else None
    return frame_log(path, frame_ns, in_video_time=True, exposure_s=exposure_s, readout_s=readout_s)


def read_camm_positions(path: Path) -> PositionFixes | None:
    """Positions of the receiver, on the video's clock; ``None`` where the track has none.

    Raises
    ------
    FormatError
        Where the file is damaged.
    """
    packets = _packets(*_open_movie(path))
    t_ns, data = packets[_FIX]
    sigma: Array
    with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
        if len(t_ns):
            rows = data.view(_FIX_ROW)[:, 0]
            place = np.stack([rows["lat"], rows["lon"], rows["height"].astype(np.float64)], axis=1)
            place[rows["kind"] < 3, 2] = np.nan
            sigma, good = rows["sigma"].astype(np.float64), rows["kind"] >= 2
        else:
            t_ns, data = packets[_PLACE]
            place = data.view("<f8").astype(np.float64)
            sigma, good = np.full(len(place), np.nan), np.ones(len(place), dtype=bool)
        good = good & (np.abs(place[:, 0]) <= 90) & (np.abs(place[:, 1]) <= 180) & ~np.isinf(place[:, 2])
    if not good.any():
        return None
    return PositionFixes(
        latitude_deg=place[good, 0],
        longitude_deg=place[good, 1],
        height_m=place[good, 2],
        sigma_m=np.where((sigma[good] > 0) & np.isfinite(sigma[good]), sigma[good], np.nan),
        t_ns=t_ns[good],
        height_above="ellipsoid",
        source=f"CAMM track of {path.name}",
    )


def _open_movie(path: Path) -> tuple[Movie, Track]:
    movie = read_movie(path)
    return movie, movie.telemetry("camm", "camera motion metadata")


def _packets(movie: Movie, track: Track) -> dict[int, tuple[Int64Array, UInt8Array]]:
    """Times (N,) and data (N, bytes) of the packets of the types that are used."""
    raw, begin = movie.contents(track)
    data = np.frombuffer(raw, np.uint8)
    at, end, t_ns = begin, begin + track.size, track.t_ns
    lengths = np.full(65536, -1)
    lengths[list(_LENGTHS)] = list(_LENGTHS.values())
    parts: dict[int, list[tuple[Int64Array, UInt8Array]]] = {
        kind: [] for kind in (_EXPOSURE, _GYRO, _ACCEL, _PLACE, _FIX)
    }
    while len(at):
        if (at + 4 > end).any():
            raise FormatError(movie.path, Fact("camm-sample-short"))
        kind = data[at + 2].astype(np.int64) | data[at + 3].astype(np.int64) << 8
        length = lengths[kind]
        wrong = (at + 4 + np.maximum(length, 0) > end) & (length >= 0)
        if wrong.any():
            first = int(np.argmax(wrong))
            raise FormatError(movie.path, Fact("camm-packet-cut-off", packet=first + 1, type=kind[first]))
        for wanted, packets in parts.items():
            rows = np.flatnonzero(kind == wanted)
            packets.append((t_ns[rows], data[at[rows, None] + 4 + np.arange(_LENGTHS[wanted])]))
        # an unknown type ends its sample
        more = np.flatnonzero((length >= 0) & (at + 4 + length < end))
        at, end, t_ns = (at + 4 + length)[more], end[more], t_ns[more]
    return {
        kind: (
            np.concatenate([t for t, _ in packets] or [np.zeros(0, dtype=np.int64)]),
            np.ascontiguousarray(np.concatenate([d for _, d in packets] or [np.zeros((0, _LENGTHS[kind]), np.uint8)])),
        )
        for kind, packets in parts.items()
    }
