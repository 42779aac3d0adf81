"""The families of inertial recordings that are known: those of this package, and of other installed ones.

A package adds a family by an entry point in the group ``colmap_inertial.imu_formats`` that leads to an
:class:`ImuFormat`; in its ``pyproject.toml``::

    [project.entry-points."colmap_inertial.imu_formats"]
    mylog = "my_package:FORMAT"

Every process finds it, wherever the package is installed. Families of other packages are tried before this package's
own: whoever installs one means it, and the last one of ours accepts any CSV file whose header it can read. They cannot
take the name of another one.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.io import (
    android,
    camm,
    gcsv,
    gopro,
    imu_text,
    ios,
    phyphox,
    rosbag,
    telemetry,
    video_imu_capture,
)
from colmap_inertial.io.files import read_bytes, require_regular
from colmap_inertial.io.mp4 import has_track, is_mp4, read_movie
from colmap_inertial.io.units import DeclaredUnits

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


log = logging.getLogger(__name__)

#: The group of entry points that other packages use.
ENTRY_POINTS = "colmap_inertial.imu_formats"
#: What ``format =`` may also say.
_RESERVED = ("auto", "capture")


@dataclass(frozen=True, kw_only=True)
class ImuFormat:
    """One family of inertial recordings.

    Attributes
    ----------
    name
        What ``format =`` in a capture.toml calls it.
    layout
        What such a recording looks like, for messages.
    accepts
        Whether a path holds one. Looks at names and first bytes; cheap, never raises for a readable path.
    read
        Reads it, given the units that the user declared in place of the file's; a damaged recording is a
        :class:`FormatError` or :class:`TimingError`.
    frames
        Reads what it says about the frames of the video, where such recordings can say anything; gives ``None`` where
        this one does not.
    video
        Where the video lies of a recording that describes itself: patterns in its folder, of which the first counts
        that fits one file, with ``{name}`` for the folder's name; empty where the recording is the video. ``None``:
        such a recording is no capture without a capture.toml.
    """

    name: str
    layout: str
    accepts: Callable[[Path], bool]
    read: Callable[[Path, DeclaredUnits], ImuRecording]
    frames: Callable[[Path], FrameLog | None] | None = None
    video: tuple[str, ...] | None = None


def imu_formats() -> tuple[ImuFormat, ...]:
    """The known families, in the order in which they are tried."""
    return (*_load_other_packages(), *_OWN)


def find_imu_format(path: Path, name: str = "auto") -> ImuFormat:
    """The family of a recording.

    Parameters
    ----------
    path
        A file or folder.
    name
        Of the family; ``"auto"`` finds it by content.

    Raises
    ------
    FormatError
        Where there is none.
    """
    if not path.exists():
        raise FormatError(path, Fact("no-such-file", what="file or folder"))
    require_regular(path)
    known = imu_formats()
    for family in known:
        if family.accepts(path) if name == "auto" else family.name == name:
            return family
    if name != "auto":
        names = ("auto", *(family.name for family in known), "capture")
        raise FormatError(path, Fact("imu-format-unknown", name=name, known=names))
    refuse_video(path)
    raise FormatError(path, Fact("no-known-recording", layouts=tuple(family.layout for family in known)))


#: What names of videos end with.
_VIDEOS = (".mp4", ".mov", ".m4v", ".360", ".lrv", ".insv", ".avi", ".mkv")


def refuse_video(path: Path) -> None:
    """Say what is missing where a video holds no IMU that is known here, or is none but in name.

    Raises
    ------
    FormatError
        For such a file; nothing is said of others.
    """
    if not path.is_file():
        return
    if is_mp4(path):
        tracks = tuple(f"{track.handler} {track.entry}" for track in read_movie(path).tracks)
        raise FormatError(path, Fact("video-without-imu", tracks=tracks))
    if path.suffix.lower() in _VIDEOS:
        begins = read_bytes(path, 16)
        text = bool(begins) and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in begins)
        fault = Fact("begins-with-text" if text else "no-mp4-index" if begins else "is-empty")
        raise FormatError(path, Fact("named-like-a-video", fault=fault))


@functools.cache
def _load_other_packages() -> tuple[ImuFormat, ...]:
    from importlib.metadata import entry_points

    names = {*_RESERVED, *(family.name for family in _OWN)}
    packages = []
    for entry in entry_points(group=ENTRY_POINTS):
        package = entry.dist.name if entry.dist is not None else entry.module
        try:
            family = _load(entry)
            if family.name in names:
                raise ValueError(f'the name "{family.name}" is taken')
        except Exception as error:  # whatever another package does when it is imported
            log.warning("the IMU format %s of the package %s is left out: %s", entry.name, package, _reason(error))
            continue
        names.add(family.name)
        packages.append(_guard(family, package))
    return tuple(packages)


def _load(entry: EntryPoint) -> ImuFormat:
    family = entry.load()
    if not isinstance(family, ImuFormat):
        raise TypeError(f"{entry.value} is no ImuFormat")
    return family


def _guard(family: ImuFormat, package: str) -> ImuFormat:
    """The same family; where its functions raise what they should not, the message names the package."""
    log_name = f"the IMU format {family.name} of the package {package}"

    def accepts(path: Path) -> bool:
        try:
            return bool(family.accepts(path))
        except Exception as error:
            log.warning("%s: %s cannot tell whether it is one: %s", path, log_name, _reason(error))
            return False

    def read(path: Path, units: DeclaredUnits) -> ImuRecording:
        with _convert_errors(path, family.name, package):
            recording = family.read(path, units)
            if not isinstance(recording, ImuRecording):
                raise TypeError(f"read gives a {type(recording).__name__}, not an ImuRecording")
            return recording

    def frames(path: Path) -> FrameLog | None:
        assert family.frames is not None
        with _convert_errors(path, family.name, package):
            return family.frames(path)

    return replace(family, accepts=accepts, read=read, frames=None if family.frames is None else frames)


@contextlib.contextmanager
def _convert_errors(path: Path, name: str, package: str) -> Iterator[None]:
    try:
        yield
    except InertialError:
        raise
    except Exception as error:
        fact = Fact("imu-format-failed", name=name, package=package, detail=_reason(error))
        raise FormatError(path, fact) from error


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _is_dji(path: Path) -> bool:
    """Whether ``path`` is a video with DJI's track of orientations."""
    return has_track(path, "djmd")


def _read_dji(path: Path, units: DeclaredUnits) -> NoReturn:
    """Say what a DJI video can and cannot give.

    Its ``djmd`` track holds orientations that the camera computed, no accelerometer and no raw gyroscope. Without an
    accelerometer nothing gives metres or the direction of gravity. The orientations would do for deblurring and the
    rolling shutter; their layout differs between products and firmware, and Gyroflow reads them all.

    Raises
    ------
    FormatError
        Always.
    """
    raise FormatError(path, Fact("dji-video"))


_OWN: tuple[ImuFormat, ...] = (
    ImuFormat(
        name="euroc",
        layout="an ASL/EuRoC dataset with mav0/imu0/data.csv",
        accepts=imu_text.is_euroc,
        read=imu_text.read_euroc,
    ),
    ImuFormat(
        name="scan-capture",
        layout="a folder of LaMAR's ScanCapture",
        accepts=ios.is_scan_capture,
        read=ios.read_scan_capture,
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
        video=(),
    ),
    ImuFormat(
        name="camm",
        layout="a video with a CAMM track",
        accepts=camm.is_camm,
        read=camm.read_camm,
        frames=camm.read_camm_frames,
        video=(),
    ),
    ImuFormat(
        name="dji",
        layout="a DJI video, of which the message says what it can give",
        accepts=_is_dji,
        read=_read_dji,
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
        video=("video_recording.mp4",),
    ),
    ImuFormat(
        name="mars",
        layout="a MARS logger folder with gyro_accel.csv",
        accepts=android.is_mars,
        read=android.read_mars,
        frames=android.read_mars_frames,
        video=("movie.mp4", "movie.mov", "movie.MOV"),
    ),
    ImuFormat(
        name="opencamera",
        layout="an OpenCamera-Sensors folder with *gyro.csv and *accel.csv",
        accepts=android.is_opencamera,
        read=android.read_opencamera,
        frames=android.read_opencamera_frames,
        video=("*.mp4", "../VID_{name}.mp4"),
    ),
    ImuFormat(
        name="stray-scanner",
        layout="a Stray Scanner folder with imu.csv",
        accepts=ios.is_stray_scanner,
        read=ios.read_stray_scanner,
        frames=ios.read_stray_scanner_frames,
        video=("rgb.mp4",),
    ),
    ImuFormat(
        name="sensor-logger",
        layout="a Sensor Logger zip or folder with Gyroscope.csv",
        accepts=ios.is_sensor_logger,
        read=ios.read_sensor_logger,
    ),
    ImuFormat(
        name="phyphox",
        layout="a phyphox export (zip or folder) with a gyroscope",
        accepts=phyphox.is_phyphox,
        read=phyphox.read_phyphox,
    ),
    ImuFormat(
        name="rosbag",
        layout="a ROS 1 bag or ROS 2 recording",
        accepts=rosbag.is_rosbag,
        read=rosbag.read_rosbag,
    ),
    ImuFormat(
        name="telemetry",
        layout="a log of a RunCam, iFlight, Thumb or Mobius camera, or an Insta360 video",
        accepts=telemetry.is_telemetry,
        read=telemetry.read_telemetry,
        frames=telemetry.read_telemetry_frames,
    ),
    ImuFormat(
        name="tables",
        layout="a folder with one table of a gyroscope and one of an accelerometer, whose headers name the units",
        accepts=imu_text.has_separate_tables,
        read=imu_text.read_separate_tables,
    ),
    ImuFormat(
        name="csv",
        layout='a CSV file with a header such as "t [ns],gx [rad/s],...,az [m/s2]"',
        accepts=imu_text.is_csv,
        read=imu_text.read_csv,
    ),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class RecorderOutput:
    """Files that a recorder left: of a recording that describes itself.

    Attributes
    ----------
    format, imu
        What ``read_imu`` takes.
    video
        The images; ``None`` where they do not lie where the recorder puts them.
    log
        What the recorder noted about the frames.
    """

    format: str
    imu: Path
    video: Path | None
    log: FrameLog | None


def find_recorder_output(path: Path) -> RecorderOutput | None:
    """The files of a video with an IMU inside, or of a recorder's folder; ``None`` where ``path`` is neither.

    Raises
    ------
    FormatError
        Where it is one of these, and damaged.
    """
    for family in imu_formats():
        if family.video is not None and bool(family.video) == path.is_dir() and family.accepts(path):
            video = _find_video(path, family.video) if family.video else path
            noted = None if family.frames is None else family.frames(path)
            return RecorderOutput(format=family.name, imu=path, video=video, log=noted)
    return None


def _find_video(folder: Path, places: tuple[str, ...]) -> Path | None:
    """The one video in the first of the places that has one."""
    for place in places:
        videos = sorted(file for file in folder.glob(place.format(name=folder.name)) if file.is_file())
        if len(videos) == 1:
            return videos[0]
    return None
