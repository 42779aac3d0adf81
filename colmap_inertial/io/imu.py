"""``read_imu``: one door for every kind of inertial recording, found by content.

A new family of files joins with one function and one :class:`ImuFormat`; see :func:`register_imu_format`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.errors import FormatError
from colmap_inertial.io import android, camm, dji, gcsv, gopro, imu_text, ios, rosbag, video_imu_capture
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.capture_tables import ImuPath
from colmap_inertial.io.mp4 import is_mp4, read_movie
from colmap_inertial.io.plausible import check_plausible
from colmap_inertial.io.units import Axes, DeclaredUnits
from colmap_inertial.types import FrameLog, ImuRecording


@dataclass(frozen=True, kw_only=True)
class ImuFormat:
    """One family of inertial recordings.

    Attributes
    ----------
    name
        What ``format =`` and ``--imu-format`` call it.
    layout
        What such a recording looks like, for messages.
    accepts
        Whether a path holds one. Looks at names and first bytes; cheap, never raises for a readable path.
    read
        Reads it, given the units that the user declared in place of the file's.
    frames
        Reads what it says about the frames of the video, where such recordings can say anything; gives ``None`` where
        this one does not.
    """

    name: str
    layout: str
    accepts: Callable[[Path], bool]
    read: Callable[[Path, DeclaredUnits], ImuRecording]
    frames: Callable[[Path], FrameLog | None] | None = None


def read_imu(path: Path, *, format: str = "auto") -> ImuRecording:
    """Read an inertial recording: SI units, sorted, checked for plausibility.

    Parameters
    ----------
    path
        A file or folder of one of :func:`imu_formats`, which includes a video with an IMU inside, or a ``capture.toml``
        (or a folder that holds one).
    format
        ``"auto"`` finds it by content; otherwise a name from :func:`imu_formats` or ``"capture"``.

    Returns
    -------
    The recording. ``repairs`` lists what was sorted, merged or dropped.

    Raises
    ------
    FormatError
        Where the recording cannot be read, or its numbers cannot be rad/s and m/s2 of a working IMU.
    TimingError
        Where its stamps run backwards or cannot be in the stated unit.
    """
    raw = read_raw_imu(path, format=format)
    raw.check()
    return raw.imu


@dataclass(frozen=True, eq=False, kw_only=True)
class RawImu:
    """A recording whose numbers nobody has checked.

    Attributes
    ----------
    imu
        In SI units, as far as the units are those that were declared.
    path, accel_path
        Where it came from, for messages.
    gyro_axes, accel_axes
        Mappings of axes that were applied.
    """

    imu: ImuRecording
    path: Path
    accel_path: Path
    gyro_axes: Axes | None = None
    accel_axes: Axes | None = None

    def check(self) -> None:
        """Refuse numbers that cannot be rad/s and m/s2 of a working IMU; see :func:`check_plausible`."""
        check_plausible(
            self.imu,
            self.path,
            accel_path=self.accel_path,
            gyro_axes=self.gyro_axes,
            accel_axes=self.accel_axes,
        )


def read_raw_imu(path: Path, *, format: str = "auto") -> RawImu:
    """As :func:`read_imu`, without looking whether the numbers are plausible: for those who look themselves."""
    path = Path(path)
    if format == "capture" or (format == "auto" and is_capture(path)):
        return read_raw_capture_imu(load_capture(path))
    return RawImu(imu=_read_plain(path, format, DeclaredUnits()), path=path, accel_path=path)


def read_frame_log(path: Path, *, format: str = "auto") -> FrameLog | None:
    """What a recording says about the frames of its video: times, exposure, readout, stabilisation, intrinsics.

    Parameters
    ----------
    path, format
        As for :func:`read_imu`, without captures.

    Returns
    -------
    ``None`` where the recording, or its kind, says nothing.

    Raises
    ------
    FormatError
        Where the recording is damaged or of no known kind.
    """
    path = Path(path)
    found = _format_of(path, format)
    return None if found.frames is None else found.frames(path)


def read_capture_imu(capture: Capture) -> ImuRecording:
    """The inertial recording of a capture, as :func:`read_imu` gives it."""
    raw = read_raw_capture_imu(capture)
    raw.check()
    return raw.imu


def read_raw_capture_imu(capture: Capture) -> RawImu:
    """The inertial recording of a capture, as :func:`read_raw_imu` gives it."""
    source = capture.imu
    if source is None:
        raise FormatError(capture.path, "describes no inertial recording; add [imu] with path = ...")
    if isinstance(source, ImuPath):
        path = accel_path = source.path
        imu = _read_plain(path, source.format, source.units)
    else:
        path = accel_path = source.gyro.file
        if source.accel is not None:
            accel_path = source.accel.file
        imu = imu_text.read_tables(source.gyro, source.accel)
    imu = replace(
        imu,
        gyro_rad_s=imu.gyro_rad_s if source.gyro_axes is None else source.gyro_axes.apply(imu.gyro_rad_s),
        accel_m_s2=imu.accel_m_s2 if source.accel_axes is None else source.accel_axes.apply(imu.accel_m_s2),
        noise=imu.noise if source.noise is None else source.noise,
    )
    return RawImu(imu=imu, path=path, accel_path=accel_path, gyro_axes=source.gyro_axes, accel_axes=source.accel_axes)


def is_capture(path: Path) -> bool:
    """Whether ``path`` is a capture.toml or a folder that holds one."""
    return path.suffix.lower() == ".toml" or (path / "capture.toml").is_file()


def imu_formats() -> tuple[ImuFormat, ...]:
    """The known families, in the order in which they are tried."""
    return tuple(_formats)


def register_imu_format(added: ImuFormat) -> None:
    """Make :func:`read_imu` know one more family; it is tried before those already known."""
    if added.name in ("auto", "capture") or any(known.name == added.name for known in _formats):
        raise ValueError(f'the IMU format "{added.name}" exists already')
    _formats.insert(0, added)


def _read_plain(path: Path, name: str, units: DeclaredUnits) -> ImuRecording:
    return _format_of(path, name).read(path, units)


def _format_of(path: Path, name: str) -> ImuFormat:
    if not path.exists():
        raise FormatError(path, "no such file or folder")
    if name == "auto":
        for candidate in _formats:
            if candidate.accepts(path):
                return candidate
        if path.is_file() and is_mp4(path):
            tracks = ", ".join(f"{track.handler} {track.entry}" for track in read_movie(path).tracks)
            raise FormatError(path, f"is a video without an IMU that is known here; its tracks: {tracks or 'none'}")
        known = "; ".join(candidate.layout for candidate in _formats)
        raise FormatError(
            path,
            f"not an inertial recording known here ({known}); describe its files under [imu.gyro] and [imu.accel] in a "
            "capture.toml",
        )
    for candidate in _formats:
        if candidate.name == name:
            return candidate
    names = ", ".join(["auto", *(candidate.name for candidate in _formats), "capture"])
    raise FormatError(path, f'unknown IMU format "{name}"; known are {names}')


_formats: list[ImuFormat] = [
    ImuFormat(
        name="euroc",
        layout="an ASL/EuRoC dataset with mav0/imu0/data.csv",
        accepts=imu_text.is_euroc,
        read=imu_text.read_euroc,
    ),
    ImuFormat(
        name="inertial-scale",
        layout="a folder with gyroscope.txt and accelerometer.txt",
        accepts=imu_text.is_inertial_scale,
        read=imu_text.read_inertial_scale_imu,
    ),
    ImuFormat(
        name="gopro",
        layout="a GoPro video (HERO5 and later, MAX, Fusion)",
        accepts=gopro.is_gopro,
        read=gopro.read_gopro,
        frames=gopro.read_gopro_frames,
    ),
    ImuFormat(
        name="camm",
        layout="a video with a CAMM track",
        accepts=camm.is_camm,
        read=camm.read_camm,
        frames=camm.read_camm_frames,
    ),
    ImuFormat(
        name="dji",
        layout="a DJI video, of which the message says what it can give",
        accepts=dji.is_dji,
        read=dji.read_dji,
    ),
    ImuFormat(
        name="gcsv",
        layout="a Gyroflow log (.gcsv)",
        accepts=gcsv.is_gcsv,
        read=gcsv.read_gcsv,
        frames=gcsv.read_gcsv_frames,
    ),
    ImuFormat(
        name="video-imu-capture",
        layout="a VideoIMUCapture folder with video_meta.pb3",
        accepts=video_imu_capture.is_video_imu_capture,
        read=video_imu_capture.read_video_imu_capture,
        frames=video_imu_capture.read_video_imu_capture_frames,
    ),
    ImuFormat(
        name="mars",
        layout="a MARS logger folder with gyro_accel.csv",
        accepts=android.is_mars,
        read=android.read_mars,
        frames=android.read_mars_frames,
    ),
    ImuFormat(
        name="opencamera",
        layout="an OpenCamera-Sensors folder with *gyro.csv and *accel.csv",
        accepts=android.is_opencamera,
        read=android.read_opencamera,
        frames=android.read_opencamera_frames,
    ),
    ImuFormat(
        name="stray-scanner",
        layout="a Stray Scanner folder with imu.csv",
        accepts=ios.is_stray_scanner,
        read=ios.read_stray_scanner,
        frames=ios.read_stray_scanner_frames,
    ),
    ImuFormat(
        name="sensor-logger",
        layout="a Sensor Logger zip or folder with Gyroscope.csv",
        accepts=ios.is_sensor_logger,
        read=ios.read_sensor_logger,
    ),
    ImuFormat(
        name="rosbag",
        layout="a ROS 1 bag or ROS 2 recording",
        accepts=rosbag.is_rosbag,
        read=rosbag.read_rosbag,
    ),
    ImuFormat(
        name="csv",
        layout='a CSV file with a header such as "t [ns],gx [rad/s],...,az [m/s2]"',
        accepts=imu_text.is_csv,
        read=imu_text.read_csv,
    ),
]
