"""``capture.toml``: one recording, described by the person who made it.

Paths count from the file's folder. Nothing is guessed: a unit, axis or time that a file does not state is asked for.
``docs/capture-toml.md`` describes every table and key.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types import CameraImuCalibration, CameraModel, FrameLog, ImuCalibration, ReadoutDirection
from colmap_inertial.io import sensor_yaml
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.camera_table import CAMERA_KEYS, read_camera_table
from colmap_inertial.io.capture_depth import (
    DEPTH_KEYS,
    POSES_KEYS,
    DescribedDepth,
    DevicePoses,
    read_depth_table,
    read_poses_table,
)
from colmap_inertial.io.capture_images import (
    EXPOSURES_KEYS,
    ApertureImages,
    LongExposures,
    read_apertures_table,
    read_exposures_table,
)
from colmap_inertial.io.capture_rig import RigCamera, read_rig_table
from colmap_inertial.io.capture_tables import (
    CALIBRATION_KEYS,
    IMU_KEYS,
    ImuPath,
    ImuTables,
    body_from_imu,
    read_calibration_table,
    read_imu_table,
)
from colmap_inertial.io.device_folders import export_frames, is_device_folder
from colmap_inertial.io.files import StrPath, reader, require_utf8
from colmap_inertial.io.frame_sources import IMAGES_KEYS, ImageFolder, Video, read_image_folder, read_video
from colmap_inertial.io.gcsv import is_gcsv, read_gcsv_frames
from colmap_inertial.io.imu_formats import RecorderOutput, find_recorder_output, refuse_video
from colmap_inertial.io.imu_text import is_inertial_scale
from colmap_inertial.io.toml_section import Section, read_toml
from colmap_inertial.io.video import readout_of_video


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """One recording: where its parts lie and what is known about them. Nothing is opened but sheets of numbers.

    Attributes
    ----------
    path
        The capture.toml, or the folder that was recognised without one.
    frames
        Images or video; ``None`` where there are none.
    exposure_s, readout_s
        ``None`` where unknown; a readout of 0 is a global shutter.
    readout_source
        Where the readout comes from, if neither the user nor the recorder said it.
    readout_direction
        In the stored image.
    shared_clock
        Whether frame times and IMU stamps come from one clock.
    camera
        ``None`` lets COLMAP calibrate.
    body_from_cam
        (4, 4) by the camera's sensor.yaml; ``None`` where there is none.
    clock_offset_s
        Camera time minus IMU stamp by the camera's sheet; ``None`` where it does not say.
    imu
        ``None`` where nothing inertial was recorded.
    calibration
        What is known about camera and IMU; wide where nothing is.
    imu_calibration
        The IMU's own, where known; the recording is read without it.
    device
        What recorded it; empty where nobody said.
    target
        Specification of a calibration target in the scene.
    frame_log
        What the recorder noted about the frames of the video; what the capture.toml says goes before it.
    apertures
        The sub-images that are fused to one frame; ``frames`` and ``camera`` are the reference aperture's.
    exposures
        The long exposures beside ``frames``, which are the short ones.
    rig
        Cameras that are fixed to the one of ``frames``.
    poses
        The path that the device computed by itself; ``None`` where there is none.
    depth
        Depth maps beside the frames; ``None`` where there are none but those of the export.
    """

    path: Path
    frames: ImageFolder | Video | None = None
    exposure_s: float | None = None
    readout_s: float | None = None
    readout_source: str = ""
    readout_direction: ReadoutDirection = "down"
    shared_clock: bool = False
    camera: CameraModel | None = None
    body_from_cam: Array | None = None
    clock_offset_s: float | None = None
    imu: ImuPath | ImuTables | None = None
    calibration: CameraImuCalibration
    imu_calibration: ImuCalibration | None = None
    device: str = ""
    target: str | None = None
    frame_log: FrameLog | None = None
    apertures: ApertureImages | None = None
    exposures: LongExposures | None = None
    rig: tuple[RigCamera, ...] = ()
    poses: DevicePoses | None = None
    depth: DescribedDepth | None = None

    @property
    def image_folder(self) -> Path | None:
        """The folder of the original file of each frame; ``None`` where frames come from a video."""
        return self.frames.folder if isinstance(self.frames, ImageFolder) else None


@reader("a capture")
def load_capture(path: StrPath) -> Capture:
    """Read a capture description.

    Parameters
    ----------
    path
        A ``.toml`` file, a folder with a ``capture.toml``, the root of an ASL/EuRoC dataset with one camera and one
        IMU that carry on (``cam0``, ``imu0``), an InertialScale folder, a video with an IMU inside (GoPro, CAMM), or
        the folder of a recorder that wrote down everything (VideoIMUCapture, MARS logger, OpenCamera-Sensors, Stray
        Scanner), or an export without an IMU (Record3D, Polycam raw, a nerfstudio dataset with depth).

    Raises
    ------
    FormatError
        For an unknown key (the nearest known one is named), a value that cannot be, or a folder of no known layout.
    """
    path = Path(path)
    require_utf8(path)
    if path.is_dir():
        if (path / "capture.toml").is_file():
            return _read_capture_toml(path / "capture.toml")
        return _recognise_folder(path)
    if not path.exists():
        raise FormatError(path, Fact("no-such-file", what="file or folder"))
    if path.suffix.lower() != ".toml":
        recording = find_recorder_output(path)
        if recording is not None:
            return _describe_recording(path, recording)
        refuse_video(path)
        raise FormatError(path, Fact("no-capture-file"))
    return _read_capture_toml(path)


# --- capture.toml -----------------------------------------------------------------------------------------------------


def _read_capture_toml(path: Path) -> Capture:
    root = read_toml(path)
    root.require_known(["device", *(section.name for section in SECTIONS)])
    capture = Capture(path=path, device=root.text("device") or "", calibration=calibration_prior())
    for section in SECTIONS:
        table = root.section(section.name, short=section.short)
        if table is None and section.is_always_read:
            table = root.table(section.name)
        if table is not None:
            if section.keys is not None:
                table.require_known(section.keys)
            capture = section.read(table, capture)
    if capture.frames is None and capture.imu is None:
        raise FormatError(path, Fact("capture-of-nothing"))
    if capture.poses is None and isinstance(capture.imu, ImuPath) and is_device_folder(capture.imu.path):
        # the recorder of the IMU kept the device's path, too
        capture = replace(capture, poses=DevicePoses(path=capture.imu.path))
    return capture


def _read_images(table: Section, capture: Capture) -> Capture:
    return replace(capture, frames=read_image_folder(table))


def _read_video(table: Section, capture: Capture) -> Capture:
    if capture.frames is not None:
        table.fail(None, Fact("tables-exclude-each-other", tables=("images", "video")))
    return replace(capture, frames=read_video(table, "file"))


def _read_imu(table: Section, capture: Capture) -> Capture:
    return replace(capture, imu=read_imu_table(table))


def _read_timing(table: Section, capture: Capture) -> Capture:
    """Read frame times: those of the user override those of the recorder, and these override published ones."""
    capture = _add_recorder_notes(capture)
    directions: tuple[ReadoutDirection, ...] = get_args(ReadoutDirection)
    exposure_s, readout_s = table.number("exposure_s", low=0, high=10), table.number("readout_s", low=0, high=0.5)
    direction, shared_clock = table.choice("readout_direction", directions), table.boolean("shared_clock")
    readout_s, source = capture.readout_s if readout_s is None else readout_s, ""
    if readout_s is None and isinstance(capture.frames, Video):
        published = readout_of_video(capture.frames.file)
        if published is not None:
            readout_s, source = published.readout_s, str(published)
    return replace(
        capture,
        exposure_s=exposure_s,
        readout_s=readout_s,
        readout_source=source,
        readout_direction=direction or capture.readout_direction,
        shared_clock=capture.shared_clock if shared_clock is None else shared_clock,
    )


def _add_recorder_notes(capture: Capture) -> Capture:
    """The IMU inside a video, and what its recorder noted about the frames."""
    if not isinstance(capture.frames, Video):
        return capture
    imu, video = capture.imu, capture.frames
    recording = find_recorder_output(video.file)
    log = None if recording is None else recording.log
    if recording is not None and imu is None:
        imu = ImuPath(path=recording.imu, format=recording.format)
    if recording is None and isinstance(imu, ImuPath) and is_gcsv(imu.path):
        log = read_gcsv_frames(imu.path)
    capture = replace(capture, imu=imu, frame_log=log)
    if log is None:
        return capture
    inside = isinstance(imu, ImuPath) and imu.path == video.file
    shared_clock = inside and video.frame_times is None and log.shared_clock
    return replace(capture, readout_s=log.readout_s, readout_direction=log.readout_direction, shared_clock=shared_clock)


def _read_camera(table: Section, capture: Capture) -> Capture:
    camera, body_from_cam, offset_s = read_camera_table(table)
    return replace(capture, camera=camera, body_from_cam=body_from_cam, clock_offset_s=offset_s)


def _read_apertures(table: Section, capture: Capture) -> Capture:
    if capture.camera is not None:
        table.fail(None, Fact("rig-gives-camera"))
    apertures = read_apertures_table(table, capture.image_folder)
    return replace(capture, apertures=apertures, camera=apertures.rig.reference.camera)


def _read_exposures(table: Section, capture: Capture) -> Capture:
    if capture.apertures is not None:
        table.fail(None, Fact("tables-exclude-each-other", tables=("apertures", "exposures")))
    return replace(capture, exposures=read_exposures_table(table, capture.image_folder))


def _read_rig(table: Section, capture: Capture) -> Capture:
    if capture.frames is None:
        table.fail(None, Fact("main-camera-missing"))
    if capture.apertures is not None or capture.exposures is not None:
        table.fail(None, Fact("tables-exclude-each-other", tables=("rig", "apertures", "exposures")))
    rig = read_rig_table(table, body_from_cam=capture.body_from_cam)
    if rig.reference is not None and capture.camera is not None:
        table.fail("calibration", Fact("rig-gives-main-camera"))
    sources = [capture.frames, *(camera.frames for camera in rig.cameras)]
    for camera in rig.cameras:
        if sources.count(camera.frames) > 1:
            table.table(camera.name).fail(None, Fact("images-of-other-camera"))
    return replace(capture, rig=rig.cameras, camera=rig.reference or capture.camera)


def _read_calibration(table: Section, capture: Capture) -> Capture:
    calibrations = read_calibration_table(
        table,
        body_from_cam=capture.body_from_cam,
        imu=capture.imu,
        readout_s=capture.readout_s,
        shared_clock=capture.shared_clock,
        clock_offset_s=capture.clock_offset_s,
    )
    prior = calibrations.camera_imu or calibration_prior(shared_clock=capture.shared_clock)
    return replace(capture, calibration=prior, imu_calibration=calibrations.imu)


def _read_poses(table: Section, capture: Capture) -> Capture:
    return replace(capture, poses=read_poses_table(table))


def _read_depth(table: Section, capture: Capture) -> Capture:
    return replace(capture, depth=read_depth_table(table))


def _read_target(table: Section, capture: Capture) -> Capture:
    return replace(capture, target=table.require("spec", table.text("spec")))


@dataclass(frozen=True, kw_only=True)
class CaptureSection:
    """One table of a capture.toml.

    Attributes
    ----------
    name, keys
        Of the table, and what it may hold; ``None`` where ``read`` says so.
    read
        Adds what the table says to the capture that the sections before it made.
    short
        The key that a text in place of the table is.
    is_always_read
        As an empty table where it is absent: other sections bear on what it makes.
    """

    name: str
    keys: tuple[str, ...] | None
    read: Callable[[Section, Capture], Capture]
    short: str | None = None
    is_always_read: bool = False


#: In the order in which they are read.
SECTIONS = (
    CaptureSection(name="images", keys=IMAGES_KEYS, read=_read_images),
    CaptureSection(
        name="video", keys=("file", "frame_times", "time_unit", "frames_per_s"), read=_read_video, short="file"
    ),
    CaptureSection(name="imu", keys=IMU_KEYS, read=_read_imu),
    CaptureSection(
        name="timing",
        keys=("exposure_s", "readout_s", "readout_direction", "shared_clock"),
        read=_read_timing,
        is_always_read=True,
    ),
    CaptureSection(name="camera", keys=CAMERA_KEYS, read=_read_camera),
    CaptureSection(name="apertures", keys=None, read=_read_apertures),
    CaptureSection(name="exposures", keys=EXPOSURES_KEYS, read=_read_exposures),
    CaptureSection(name="rig", keys=None, read=_read_rig),
    CaptureSection(name="calibration", keys=CALIBRATION_KEYS, read=_read_calibration, is_always_read=True),
    CaptureSection(name="poses", keys=POSES_KEYS, read=_read_poses, short="path"),
    CaptureSection(name="depth", keys=DEPTH_KEYS, read=_read_depth),
    CaptureSection(name="target", keys=("spec",), read=_read_target),
)


# --- captures without one -------------------------------------------------------------------------------------------


def _recognise_folder(path: Path) -> Capture:
    if is_inertial_scale(path):
        return Capture(path=path, imu=ImuPath(path=path, format="inertial-scale"), calibration=calibration_prior())
    base = path / "mav0" if (path / "mav0").is_dir() else path
    camera, imu = base / "cam0", base / "imu0"
    if all(part.exists() for part in (camera / "data.csv", camera / "data", imu / "data.csv")):
        return _describe_asl(path, camera, imu)
    recording = find_recorder_output(path)
    if recording is not None:
        return _describe_recording(path, recording)
    if is_device_folder(path):
        return _describe_export(path)
    if (path / "recipe.toml").is_file():
        raise FormatError(path, Fact("recipe-without-capture"))
    raise FormatError(path, Fact("no-capture-folder"))


def _describe_recording(path: Path, recording: RecorderOutput) -> Capture:
    """A recording that describes itself."""
    log = recording.log
    readout_s = None if log is None else log.readout_s
    shared_clock = log is not None and log.shared_clock
    return Capture(
        path=path,
        frames=None if recording.video is None else Video(file=recording.video),
        readout_s=readout_s,
        readout_direction="down" if log is None else log.readout_direction,
        shared_clock=shared_clock,
        camera=None if log is None else log.camera,
        imu=ImuPath(path=recording.imu, format=recording.format),
        calibration=calibration_prior(Declared(readout_s=readout_s), shared_clock=shared_clock),
        frame_log=log,
        poses=DevicePoses(path=path) if is_device_folder(path) else None,
    )


def _describe_export(path: Path) -> Capture:
    """An app's export with the device's own path, and without an IMU."""
    return Capture(path=path, frames=export_frames(path), calibration=calibration_prior(), poses=DevicePoses(path=path))


def _describe_asl(path: Path, camera: Path, imu: Path) -> Capture:
    """The first camera and IMU of an ASL/EuRoC dataset, which share a clock."""
    source = ImuPath(path=imu, format="euroc")
    model, cam_from_imu = None, None
    if (camera / "sensor.yaml").is_file():
        model = sensor_yaml.read_camera(camera / "sensor.yaml")
        cam_from_imu = np.linalg.inv(sensor_yaml.read_body_from_sensor(camera / "sensor.yaml")) @ body_from_imu(source)
    return Capture(
        path=path,
        frames=ImageFolder(folder=camera / "data", times=camera / "data.csv"),
        shared_clock=True,
        camera=model,
        imu=source,
        calibration=calibration_prior(
            Declared(
                cam_from_imu_xyzw=None if cam_from_imu is None else quat_from_matrix(cam_from_imu[:3, :3]),
                imu_in_cam_m=None if cam_from_imu is None else cam_from_imu[:3, 3],
            ),
            shared_clock=True,
        ),
    )
