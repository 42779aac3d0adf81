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
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError
from colmap_inertial.io.gpmf import Entry, Stream, entries, read_streams
from colmap_inertial.io.imu_text import recording
from colmap_inertial.io.mp4 import Movie, has_track, read_movie
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.units import SENSOR_NAMES, SENSOR_UNITS, Axes, DeclaredUnits, Quantity, seconds, to_si, unit_of
from colmap_inertial.types import Array, FrameLog, ImuRecording

_SENSORS: dict[str, Quantity] = {"GYRO": "gyro", "ACCL": "accel"}
#: Streams with one sample for each frame, the best one first.
_OF_FRAMES = ("SHUT", "ISOE", "ISOG", "CORI", "GRAV")
_WANTED = {*_SENSORS, *_OF_FRAMES, "IORI", "SROT"}
#: Channel order by the firmware's first letters, where the stream does not say.
_ORDER = {"HD5": "ZXY", "FS1": "yXZ"}
_USUAL_ORDER = "YxZ"
#: An image that is turned by more than this against the camera was stabilised.
_TURNED_RAD = 0.005
#: Samples of the last payload may be missing for so many frames at the end; they take the last one's.
_MISSING_FRAMES = 2.5


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
    movie, payloads = _open(path)
    streams = _streams(movie, payloads)
    track = _telemetry(movie)
    shift_ns, _ = _video_minus_stamp_ns(movie, streams, track)
    found: dict[str, Samples] = {}
    for key, quantity in _SENSORS.items():
        if key not in streams:
            continue
        stream = streams[key]
        values = stream.values
        if values.shape[1] != 3:
            raise FormatError(path, f"the {key} stream has {values.shape[1]} channels, not 3")
        t_ns = _sample_times_ns(path, stream, track) + shift_ns
        declared = units.gyro if quantity == "gyro" else units.accel
        values = to_si(values @ _axes(path, movie, stream).T, quantity, declared or _unit(path, stream, quantity))
        found[key] = order_samples(path, SENSOR_NAMES[quantity], t_ns, values)
    if "GYRO" not in found:
        raise FormatError(
            path, "its telemetry holds no gyroscope (GYRO): HERO5 and later write one; older cameras have none"
        )
    return recording(found["GYRO"], found.get("ACCL"), device=_device(movie, payloads, streams["GYRO"]))


def read_gopro_frames(path: Path) -> FrameLog:
    """What a GoPro video's telemetry says about its frames.

    Raises
    ------
    FormatError
        Where the file is damaged or holds no video.
    """
    movie, payloads = _open(path)
    video = movie.track(handler="vide")
    if video is None or len(video.t_ns) == 0:
        raise FormatError(path, "holds no video")
    streams = _streams(movie, payloads)
    track = _telemetry(movie)
    shift_ns, _ = _video_minus_stamp_ns(movie, streams, track)
    frame_ns = video.shown_ns(path)

    def of_frames(key: str, channels: int) -> Array | None:
        if key not in streams or streams[key].values.shape[1] != channels:
            return None
        t_ns = _sample_times_ns(path, streams[key], track) + shift_ns
        found = _nearest(t_ns, streams[key].values, frame_ns)
        # directions and orientations have a length, exposures a bound; what has not is damaged
        good = found is not None and np.isfinite(found).all() and (channels == 1 or np.linalg.norm(found, axis=1).all())
        return found if good else None

    exposure, iso, iso_hundreds = (of_frames(key, 1) for key in ("SHUT", "ISOE", "ISOG"))
    if iso is None and iso_hundreds is not None:
        iso = 100 * iso_hundreds
    up = of_frames("GRAV", 3)
    orientation, image = of_frames("CORI", 4), of_frames("IORI", 4)
    settings = _settings(movie)
    stabilised, words = _stabilisation(settings, image)
    return FrameLog(
        t_s=seconds(frame_ns, int(frame_ns[0])),
        epoch_ns=int(frame_ns[0]),
        in_video_time=True,
        shared_clock=True,
        exposure_s=None if exposure is None or not ((exposure >= 0) & (exposure < 10)).all() else exposure[:, 0],
        iso=None if iso is None else iso[:, 0],
        readout_s=_readout_s(path, settings, streams),
        stabilised=stabilised,
        stabilisation=words,
        up_in_imu=None if up is None else _unit_length(up[:, [0, 2, 1]]),
        start_from_imu_xyzw=None if orientation is None else _unit_length(orientation[:, [1, 3, 2, 0]]),
        image_from_cam_xyzw=None if image is None else _unit_length(image[:, [1, 3, 2, 0]]),
    )


# --- the pieces ------------------------------------------------------------------------------------------------------


def _open(path: Path) -> tuple[Movie, list[bytes]]:
    movie = read_movie(path)
    track = movie.track(entry="gpmd")
    if track is None or len(track.size) == 0:
        raise FormatError(path, "holds no GoPro telemetry (a track of format gpmd)")
    return movie, movie.samples(track)


def _telemetry(movie: Movie) -> tuple[NDArray[np.int64], list[int]]:
    """Presentation times of the payloads, and where they lie in the file."""
    track = movie.track(entry="gpmd")
    assert track is not None
    return track.t_ns, track.offset.tolist()


def _streams(movie: Movie, payloads: list[bytes]) -> dict[str, Stream]:
    """The camera's streams by key: those of the device that has the gyroscope."""
    _, offsets = _telemetry(movie)
    found = read_streams(movie.path, payloads, offsets, _WANTED)
    camera = next((s.device for s in found if s.key == "GYRO"), None)
    own = [s for s in found if camera is None or s.device == camera]
    return {stream.key: stream for stream in reversed(own)}


def _sample_times_ns(path: Path, stream: Stream, track: tuple[NDArray[np.int64], list[int]]) -> NDArray[np.int64]:
    try:
        return stream.sample_times_ns(track[0])[0]
    except ValueError as error:
        raise FormatError(path, f"the {stream.key} stream cannot be timed: {error}") from None


def _video_minus_stamp_ns(
    movie: Movie, streams: dict[str, Stream], track: tuple[NDArray[np.int64], list[int]]
) -> tuple[int, str]:
    """What brings the streams' stamps to the video's clock, and the stream that tied them (empty: none)."""
    video = movie.track(handler="vide")
    gyro = streams.get("GYRO")
    kind = "" if gyro is None else gyro.stamps(track[0])[1]
    for key in _OF_FRAMES:
        if video is None or len(video.t_ns) == 0 or key not in streams or streams[key].stamps(track[0])[1] != kind:
            continue
        if kind == "track":
            break
        return int(video.t_ns.min() - _sample_times_ns(movie.path, streams[key], track)[0]), key
    if gyro is None or kind == "track":
        return 0, ""
    return int(track[0][gyro.payload[0]] - gyro.stamps(track[0])[0][0]), ""


def _unit(path: Path, stream: Stream, quantity: Quantity) -> str:
    """The unit that the stream states; the SI unit, which GoPro's description gives, where it states none."""
    text = stream.text("SIUN") or stream.text("UNIT")
    if not text:
        return next(iter(SENSOR_UNITS[quantity]))
    unit = unit_of(text)
    if unit not in SENSOR_UNITS[quantity]:
        raise FormatError(
            path, f"the {stream.key} stream is in {text!r}; known here are {', '.join(SENSOR_UNITS[quantity])}"
        )
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
        raise FormatError(path, f"the {stream.key} stream's axes are damaged: {error}") from None
    name = stream.text("STNM").lower()
    if "(z,x,y)" in name.replace(" ", "") or "up/down, right/left" in name:
        return _labels("ZXY")
    firmware = movie.user_data.get("FIRM", b"")[:3].decode("latin-1")
    return _labels(_ORDER.get(firmware, _USUAL_ORDER))


def _labels(letters: str) -> Array:
    """(3, 3) that sorts channels, named by letters such as ``YxZ``, into x, y, z; a small letter is the opposite."""
    if len(letters) != 3:
        raise ValueError(f"{letters!r} does not name three axes")
    axes = Axes.parse(",".join(("-" if letter.islower() else "") + letter.lower() for letter in letters))
    # Axes reads "channel from axis"; a signed permutation's inverse is its transpose
    return np.asarray(axes.matrix.T)


def _device(movie: Movie, payloads: list[bytes], gyro: Stream) -> str:
    settings = _settings(movie)
    if "MINF" in settings:
        return settings["MINF"].text()
    firmware = movie.user_data.get("FIRM", b"").split(b"\0")[0].decode("latin-1")
    return f"GoPro {firmware}" if firmware else gyro.device


def _settings(movie: Movie) -> dict[str, Entry]:
    """The global settings in the file's user data; empty before HERO8."""
    raw = movie.user_data.get("GPMF", b"")
    found: dict[str, Entry] = {}
    try:
        for device in entries(raw):
            if device.key == "DEVC":
                found = {**{entry.key: entry for entry in entries(device.data)}, **found}
    except ValueError as error:
        raise FormatError(movie.path, f"its user data (GPMF) is damaged: {error}") from None
    return found


def _readout_s(path: Path, settings: dict[str, Entry], streams: dict[str, Stream]) -> float | None:
    if "OREN" in settings and settings["OREN"].text() not in ("", "U"):
        # the camera hung upside down or on its side and turned the picture: which way its rows are read is not said
        return None
    try:
        if "SROT" in settings:
            found = settings["SROT"].numbers().ravel()
        elif "SROT" in streams:
            found = np.median(streams["SROT"].values, axis=0)
        else:
            return None
    except ValueError as error:
        raise FormatError(path, f"the readout time is damaged: {error}") from None
    readout_s = float(found[0]) * 1e-3 if len(found) else np.nan
    return readout_s if 0 < readout_s < 0.5 else None


def _stabilisation(settings: dict[str, Entry], image: Array | None) -> tuple[bool | None, str]:
    """Whether the picture was stabilised, and how the camera puts it."""
    words = " ".join(f"{key}={settings[key].text()}" for key in ("EISE", "EISA") if key in settings)
    flag = settings["EISE"].text().upper() if "EISE" in settings else ""
    if flag == "Y":
        return True, words
    if image is not None:
        # half the angle's sine is what the vector part of a quaternion holds
        turned = 2 * np.arcsin(np.clip(np.linalg.norm(_unit_length(image)[:, 1:], axis=1), 0, 1))
        if float(np.sqrt(np.mean(turned**2))) > _TURNED_RAD:
            return True, f"{words} IORI".strip()
        return False, words
    return (False if flag == "N" else None), words


def _nearest(t_ns: NDArray[np.int64], values: Array, frame_ns: NDArray[np.int64]) -> Array | None:
    """The sample nearest to each frame; ``None`` where frames lie outside the samples."""
    step_ns = float(np.median(np.diff(t_ns)))
    if frame_ns[0] < t_ns[0] - _MISSING_FRAMES * step_ns or frame_ns[-1] > t_ns[-1] + _MISSING_FRAMES * step_ns:
        return None
    after = np.clip(np.searchsorted(t_ns, frame_ns), 1, len(t_ns) - 1)
    return values[np.where(frame_ns - t_ns[after - 1] < t_ns[after] - frame_ns, after - 1, after)]


def _unit_length(rows: Array) -> Array:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(length > 0, length, 1.0))
