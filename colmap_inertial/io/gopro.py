"""GoPro cameras: the IMU in an MP4's ``gpmd`` track, and what else it says about the frames.

``GYRO`` and ``ACCL`` are read each at its own rate (HERO5: 400 and 200 Hz) and brought to the video's clock: where a
stream belongs to the frames (``SHUT``, the exposure; else ``ISOE``, ``ISOG``, ``WBAL``), its first stamp is the first
frame's presentation time; without one, payloads begin at their own presentation times.

The IMU frame is GoPro's: x and y lie in the horizontal plane of a camera that stands upright, y along the optical axis,
z up. HERO5 and Session write z, x, y; Fusion -y, x, z; HERO6 and later y, -x, z, unless the stream has ``ORIN`` or
``MTRX``. All of these are rotations, none mirrors.

Of the frames: exposure (``SHUT``), ISO (``ISOE``; ``ISOG`` times 100), readout (``SROT``, milliseconds; global since
HERO8, per frame before; only where the camera stood upright, ``OREN``), stabilisation (``EISE``, ``EISA``, or an image
orientation ``IORI`` that moves), gravity (``GRAV``), camera orientation (``CORI``). The vectors are written x, z, y and
the quaternions w, x, z, y.

Of the place: ``GPS5`` (latitude, longitude, height; two speeds), with the fix (``GPSF``: 2 or 3) and the dilution of
precision times 100 (``GPSP``) of each payload, or ``GPS9`` (HERO11), with both for each sample. ``GPSA`` says what
heights count from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, HeightDatum, ImuRecording, PositionFixes
from colmap_inertial.io.frame_times import frame_log
from colmap_inertial.io.gpmf import Entry, Stream, entries, read_streams
from colmap_inertial.io.imu_text import build_recording
from colmap_inertial.io.mp4 import Movie, has_track, read_movie
from colmap_inertial.io.samples import Samples, nearest, order_samples
from colmap_inertial.io.units import SENSOR_UNITS, DeclaredUnits, Quantity, unit_of

_SENSORS: dict[str, Quantity] = {"GYRO": "gyro", "ACCL": "accel"}
#: Streams with one sample for each frame, the best one first.
_OF_FRAMES = ("SHUT", "ISOE", "ISOG", "CORI", "GRAV")
_POSITIONS = ("GPS9", "GPS5")
_WANTED = {*_SENSORS, *_OF_FRAMES, *_POSITIONS, "GPSF", "GPSP", "IORI", "SROT", "TMPC"}
#: Channel order by the firmware's first letters, where the stream does not say.
_ORDER = {"HD5": "ZXY", "FS1": "yXZ"}
_USUAL_ORDER = "YxZ"


@dataclass(frozen=True, kw_only=True)
class _GoproLimits:
    """Limits for a GoPro's telemetry."""

    #: Standard deviation of a position where the dilution of precision is 1; beyond the largest one, a position says
    #: nothing.
    undiluted_sigma_m: float = 1.5
    #: Standard deviation of a position where the dilution of precision is 1; beyond the largest one, a position says
    #: nothing.
    largest_dilution: float = 10.0
    #: No sensor works at more, nor below its opposite.
    hottest_c: float = 150.0
    #: An image that is rotated by more than this against the camera was stabilised.
    rotated_rad: float = 0.005
    #: Samples of the last payload may be missing for so many frames at the end; they take the last one's.
    missing_frames: float = 2.5


_LIMITS = _GoproLimits()


def is_gopro(path: Path) -> bool:
    """Whether ``path`` is an MP4 file with GoPro telemetry."""
    return has_track(path, "gpmd")


def read_gopro(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the IMU of a GoPro video; stamps are on the video's clock.

    Raises
    ------
    FormatError
        Where there is no gyroscope, or the file is damaged.
    """
    telemetry = _Telemetry.of(path)
    samples_of: dict[Quantity, Samples] = {}
    for key, quantity in _SENSORS.items():
        stream = telemetry.streams.get(key)
        if stream is None:
            continue
        values = stream.values
        if values.shape[1] != 3:
            raise FormatError(path, Fact("gopro-channels", key=key, channels=values.shape[1]))
        values = values @ _axes(path, telemetry.movie, stream).T
        unit = getattr(units, quantity) or _unit(path, stream, quantity)
        samples_of[quantity] = order_samples(path, quantity, unit, telemetry.times_ns(key), values)
    if "gyro" not in samples_of:
        raise FormatError(path, Fact("gopro-without-gyroscope"))
    device = _device(telemetry.movie, telemetry.streams["GYRO"])
    read = build_recording(samples_of["gyro"], samples_of.get("accel"), device=device)
    return replace(read, temperature_c=_temperature_c(telemetry.streams))


def read_gopro_frames(path: Path) -> FrameLog:
    """Notes of a GoPro video's telemetry on its frames.

    Raises
    ------
    FormatError
        Where the file is damaged or holds no video.
    """
    telemetry = _Telemetry.of(path)
    frame_ns = telemetry.movie.frame_times_ns()

    def of_frames(key: str, channels: int) -> Array | None:
        stream = telemetry.streams.get(key)
        if stream is None or stream.values.shape[1] != channels:
            return None
        nearest = _find_nearest(telemetry.times_ns(key), stream.values, frame_ns)
        # directions and orientations have a length, exposures a bound; what has not is damaged
        good = (
            nearest is not None
            and np.isfinite(nearest).all()
            and (channels == 1 or np.linalg.norm(nearest, axis=1).all())
        )
        return nearest if good else None

    exposure, iso, iso_hundreds = (of_frames(key, 1) for key in ("SHUT", "ISOE", "ISOG"))
    if iso is None and iso_hundreds is not None:
        iso = 100 * iso_hundreds
    up = of_frames("GRAV", 3)
    orientation, image = of_frames("CORI", 4), of_frames("IORI", 4)
    settings = _settings(telemetry.movie)
    stabilised, words = _stabilisation(settings, image)
    return frame_log(
        path,
        frame_ns,
        in_video_time=True,
        exposure_s=None if exposure is None or not ((exposure >= 0) & (exposure < 10)).all() else exposure[:, 0],
        iso=None if iso is None else iso[:, 0],
        readout_s=_readout_s(path, settings, telemetry.streams),
        stabilised=stabilised,
        stabilisation=words,
        up_in_imu=None if up is None else _unit_length(up[:, [0, 2, 1]]),
        start_from_imu_xyzw=None if orientation is None else _unit_length(orientation[:, [1, 3, 2, 0]]),
    )


def read_gopro_positions(path: Path) -> PositionFixes | None:
    """Positions of a GoPro's receiver, on the video's clock; ``None`` without telemetry of it, or without a fix.

    Raises
    ------
    FormatError
        Where the file is damaged.
    """
    telemetry = _Telemetry.of(path)
    key = next((key for key in _POSITIONS if key in telemetry.streams), None)
    if key is None:
        return None
    stream = telemetry.streams[key]
    if stream.values.shape[1] < (9 if key == "GPS9" else 3):
        raise FormatError(path, Fact("gopro-positions-channels", key=key, channels=stream.values.shape[1]))
    values, t_ns = stream.values, telemetry.times_ns(key)
    if key == "GPS9":
        diluted, fix = values[:, 7], values[:, 8]
    else:
        fix = _repeat_for_samples(telemetry.streams.get("GPSF"), stream, default=3.0)
        diluted = _repeat_for_samples(telemetry.streams.get("GPSP"), stream, default=100.0) / 100
    inside = (np.abs(values[:, 0]) <= 90) & (np.abs(values[:, 1]) <= 180) & np.isfinite(values[:, :3]).all(axis=1)
    good = inside & (fix >= 2) & (diluted > 0) & (diluted <= _LIMITS.largest_dilution)
    if not good.any():
        return None
    datum = {"MSLV": "sea", "WGS8": "ellipsoid"}.get(stream.text("GPSA")[:4], "unknown")
    return PositionFixes(
        latitude_deg=values[good, 0],
        longitude_deg=values[good, 1],
        height_m=np.where(fix[good] >= 3, values[good, 2], np.nan),
        sigma_m=_LIMITS.undiluted_sigma_m * diluted[good],
        t_ns=t_ns[good],
        height_above=cast(HeightDatum, datum),
        source=f"{key} of {path.name}",
    )


# --- the pieces ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _Telemetry:
    """Telemetry of the camera that has the gyroscope.

    Attributes
    ----------
    streams
        By key.
    payload_ns
        (P,) presentation times of the payloads.
    shift_ns
        What brings the streams' stamps to the video's clock.
    """

    movie: Movie
    streams: dict[str, Stream]
    payload_ns: Int64Array
    shift_ns: int = 0

    @classmethod
    def of(cls, path: Path) -> _Telemetry:
        movie = read_movie(path)
        track = movie.telemetry("gpmd", "GoPro telemetry")
        streams = read_streams(path, movie.samples(track), track.offset.tolist(), _WANTED)
        camera = next((s.device for s in streams if s.key == "GYRO"), None)
        own = {s.key: s for s in reversed(streams) if camera is None or s.device == camera}
        plain = cls(movie=movie, streams=own, payload_ns=track.t_ns)
        return replace(plain, shift_ns=plain._video_minus_stamp_ns())

    def times_ns(self, key: str) -> Int64Array:
        """(N,) when a stream's samples were taken, on the video's clock."""
        try:
            return self.streams[key].sample_times_ns(self.payload_ns) + self.shift_ns
        except ValueError as error:
            raise FormatError(self.movie.path, Fact("gopro-stream-untimed", key=key, detail=str(error))) from None

    def _video_minus_stamp_ns(self) -> int:
        video, gyro = self.movie.track(handler="vide"), self.streams.get("GYRO")
        stamps, kind = (None, "") if gyro is None else gyro.stamps(self.payload_ns)
        if kind == "track":
            return 0
        for key in _OF_FRAMES:
            stream = self.streams.get(key)
            if video is not None and len(video.t_ns) and stream and stream.stamps(self.payload_ns)[1] == kind:
                return int(video.t_ns.min() - self.times_ns(key)[0])
        return 0 if gyro is None or stamps is None else int(self.payload_ns[gyro.payload[0]] - stamps[0])


def _temperature_c(streams: dict[str, Stream]) -> float | None:
    """Temperature beside the sensors' readings, degrees Celsius; ``None`` where missing or impossible."""
    stream = streams.get("TMPC")
    readings = np.empty(0) if stream is None or not stream.data else stream.values[:, 0]
    readings = readings[np.abs(readings) < _LIMITS.hottest_c]
    return float(np.median(readings)) if len(readings) else None


def _repeat_for_samples(about: Stream | None, stream: Stream, default: float) -> Array:
    """(N,) what is said once a payload, for each sample of a stream."""
    stated = {} if about is None else {p: float(rows[0, 0]) for p, rows in zip(about.payload, about.data, strict=True)}
    return np.repeat([stated.get(payload, default) for payload in stream.payload], stream.count)


def _unit(path: Path, stream: Stream, quantity: Quantity) -> str:
    """The unit that the stream states; the SI unit, which GoPro's description gives, where it states none."""
    text = stream.text("SIUN") or stream.text("UNIT")
    if not text:
        return next(iter(SENSOR_UNITS[quantity]))
    unit = unit_of(text)
    if unit not in SENSOR_UNITS[quantity]:
        raise FormatError(path, Fact("gopro-unit", key=stream.key, unit=text, known=tuple(SENSOR_UNITS[quantity])))
    return unit


def _axes(path: Path, movie: Movie, stream: Stream) -> Array:
    """(3, 3) what turns the stream's channels into x, y, z of the IMU frame."""
    into, out = stream.text("ORIN"), stream.text("ORIO")
    try:
        if "MTRX" in stream.about and out:
            matrix = stream.about["MTRX"].numbers().reshape(3, 3)
            if np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
                return _labels(out) @ matrix
        if into:
            return _labels(into)
    except ValueError as error:
        raise FormatError(path, Fact("gopro-axes-damaged", key=stream.key, detail=str(error))) from None
    name = stream.text("STNM").lower()
    if "(z,x,y)" in name.replace(" ", "") or "up/down, right/left" in name:
        return _labels("ZXY")
    firmware = movie.user_data.get("FIRM", b"")[:3].decode("latin-1")
    return _labels(_ORDER.get(firmware, _USUAL_ORDER))


def _labels(letters: str) -> Array:
    """(3, 3) that sorts channels, named by letters such as ``YxZ``, into x, y, z; a small letter is the opposite."""
    if len(letters) != 3:
        raise ValueError(Fact("not-three-axes", letters=letters))
    axes = Axes.of_letters(letters)
    # Axes reads "channel from axis"; a signed permutation's inverse is its transpose
    return np.asarray(axes.matrix.T)


def _device(movie: Movie, gyro: Stream) -> str:
    settings = _settings(movie)
    if "MINF" in settings:
        return settings["MINF"].text()
    firmware = movie.user_data.get("FIRM", b"").split(b"\0")[0].decode("latin-1")
    return f"GoPro {firmware}" if firmware else gyro.device


def _settings(movie: Movie) -> dict[str, Entry]:
    """The global settings in the file's user data; empty before HERO8."""
    raw = movie.user_data.get("GPMF", b"")
    settings: dict[str, Entry] = {}
    try:
        for device in entries(raw):
            if device.key == "DEVC":
                settings = {**{entry.key: entry for entry in entries(device.data)}, **settings}
    except ValueError as error:
        raise FormatError(movie.path, Fact("gopro-settings-damaged", detail=str(error))) from None
    return settings


def _readout_s(path: Path, settings: dict[str, Entry], streams: dict[str, Stream]) -> float | None:
    if "OREN" in settings and settings["OREN"].text() not in ("", "U"):
        # the camera hung upside down or on its side and rotated the image: which way its rows are read is not said
        return None
    try:
        if "SROT" in settings:
            readout = settings["SROT"].numbers().ravel()
        elif "SROT" in streams:
            readout = np.median(streams["SROT"].values, axis=0)
        else:
            return None
    except ValueError as error:
        raise FormatError(path, Fact("gopro-readout-damaged", detail=str(error))) from None
    readout_s = float(readout[0]) * 1e-3 if len(readout) else np.nan
    return readout_s if 0 < readout_s < 0.5 else None


def _stabilisation(settings: dict[str, Entry], image: Array | None) -> tuple[bool | None, str]:
    """Whether the image was stabilised, and how the camera puts it."""
    words = " ".join(f"{key}={settings[key].text()}" for key in ("EISE", "EISA") if key in settings)
    flag = settings["EISE"].text().upper() if "EISE" in settings else ""
    if flag == "Y":
        return True, words
    if image is not None:
        # half the angle's sine is what the vector part of a quaternion holds
        angle_rad = 2 * np.arcsin(np.clip(np.linalg.norm(_unit_length(image)[:, 1:], axis=1), 0, 1))
        if float(np.sqrt(np.mean(angle_rad**2))) > _LIMITS.rotated_rad:
            return True, f"{words} IORI".strip()
        return False, words
    return (False if flag == "N" else None), words


def _find_nearest(t_ns: Int64Array, values: Array, frame_ns: Int64Array) -> Array | None:
    """The sample nearest to each frame; ``None`` where frames lie outside the samples."""
    slack_ns = _LIMITS.missing_frames * float(np.median(np.diff(t_ns)))
    if frame_ns[0] < t_ns[0] - slack_ns or frame_ns[-1] > t_ns[-1] + slack_ns:
        return None
    return values[nearest(t_ns, frame_ns)]


def _unit_length(rows: Array) -> Array:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(length > 0, length, 1.0))
