"""What apps export of a device that computes its own path: poses, depth maps, and the IMU where it was recorded.

Stray Scanner: ``odometry.csv`` has camera centres in metres and world_from_camera with the camera's axes as COLMAP has
them (its source turns ARKit's by half a turn about x); ``depth/`` millimetres, ``confidence/`` 0 to 2, both named by
the frame's number (github.com/strayrobots/scanner, OdometryEncoder.swift); ``imu.csv`` may be missing.

Record3D: ``metadata`` (JSON) has ``poses`` (qx qy qz qw x y z, world_from_camera, the camera's y up and z back), ``K``
by columns, ``rgbd/N.depth`` (LZFSE, float32, metres) and ``N.conf``. An ``.r3d`` is a zip of that folder.

Polycam raw: ``keyframes/cameras/T.json`` with ``t_00`` to ``t_23`` (rows of world_from_camera, ARKit's axes), ``fx``
and so on; ``depth/T.png`` millimetres, ``confidence/T.png`` grey.

nerfstudio: ``transforms.json`` with ``transform_matrix`` (world_from_camera, y up and z back), ``depth_file_path`` of
each frame: millimetres where an image, metres where an array. Its poses may be of any unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_from_matrix, quat_multiply
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.depth import DepthMaps, PinholeGrid
from colmap_inertial.io.depth_maps import MILLIMETRES, DepthFiles, grid_of_matrix
from colmap_inertial.io.files import first_line, path_in, read_json, reader
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.ios import is_stray_scanner
from colmap_inertial.io.tables import read_table
from colmap_inertial.io.units import seconds

#: Half a turn about x: between a camera whose y is up and z back (ARKit, OpenGL) and one of COLMAP.
_HALF_TURN_XYZW = np.array([1.0, 0.0, 0.0, 0.0])
#: ARKit's worlds: y against gravity.
_ARKIT_UP = (0.0, 1.0, 0.0)
#: ARKit's images of which Stray Scanner writes the intrinsics, where its video is not there to tell.
_ARKIT_PX = (1920, 1440)


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceFolder:
    """What an app exported.

    Attributes
    ----------
    app
        Which one.
    trajectory
        The device's own path.
    is_metric
        Whether the path counts in the device's metres; else in any unit.
    imu
        Where its IMU recording lies, on the clock of the path; ``None`` where there is none.
    on_clock_of_images
        Whether times of the path are on the clock that frames of this recording have; else names tell which is which.
    depth
        Its depth maps; ``None`` where there are none.
    up_in_world
        (3,) against gravity in the path's world; ``None`` where nobody says.
    """

    app: str
    trajectory: CameraTrajectory
    is_metric: bool = True
    imu: Path | None = None
    on_clock_of_images: bool = False
    depth: DepthMaps | None = None
    up_in_world: tuple[float, float, float] | None = None


def is_device_folder(path: Path) -> bool:
    """Whether a folder is an export with the device's own path."""
    return path.is_dir() and any(layout.accepts(path) for layout in LAYOUTS)


@reader("a device's export")
def read_device_folder(path: Path) -> DeviceFolder:
    """Read an export; depth maps are read later, one by one.

    Raises
    ------
    FormatError, TimingError
        For one of no known layout, and for poses that cannot be read.
    """
    for layout in LAYOUTS:
        if layout.accepts(path):
            return layout.read(path)
    raise FormatError(path, Fact("no-device-folder", layouts=tuple(layout.name for layout in LAYOUTS)))


def _files(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder by their names without ending."""
    if not folder.is_dir():
        return {}
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes}


def _trajectory(path: Path, names: tuple[str, ...], t_ns: Int64Array, xyzw: Array, centres: Array) -> CameraTrajectory:
    """A path by world_from_camera with COLMAP's axes."""
    if len(names) < 2:
        raise FormatError(path, Fact("one-pose"))
    good = np.isfinite(xyzw).all(axis=1) & np.isfinite(centres).all(axis=1)
    norm = np.linalg.norm(xyzw, axis=1)
    good &= np.abs(norm - 1) <= 1e-2
    if not good.all():
        raise FormatError(path, Fact("pose-not-finite"))
    late = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(late):
        raise FormatError(path, Fact("frame-time-not-after", frame=int(late[0] + 2)))
    return CameraTrajectory(
        names=names,
        t_s=seconds(t_ns, int(t_ns[0])),
        cam_from_world_xyzw=quat_conjugate(xyzw / norm[:, None]),
        cam_in_world=centres,
        epoch_ns=int(t_ns[0]),
        length_unit="m",
    )


def export_frames(path: Path) -> ImageFolder | None:
    """The images of an export, named as its poses but for endings and folders; ``None`` where it has none."""
    return next((layout.frames(path) for layout in LAYOUTS if layout.frames is not None and layout.accepts(path)), None)


# --- Stray Scanner ---------------------------------------------------------------------------------------------------


def _is_stray(path: Path) -> bool:
    names = {cell.strip() for cell in first_line(path / "odometry.csv").split(",")}
    return {"timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"} <= names


def _read_stray(path: Path) -> DeviceFolder:
    file = path / "odometry.csv"
    table = read_table(file)
    numbers = table.numbers([table.column(name) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
    names = tuple(table.text(table.column("frame")))
    t_ns = table.stamps_ns(table.column("timestamp"), "s")
    trajectory = _trajectory(file, names, t_ns, numbers[:, 3:], numbers[:, :3])
    return DeviceFolder(
        app="Stray Scanner",
        trajectory=trajectory,
        imu=path if is_stray_scanner(path) else None,
        on_clock_of_images=True,
        depth=_stray_depth(path),
        up_in_world=_ARKIT_UP,
    )


def _stray_depth(path: Path) -> DepthMaps | None:
    depth, intrinsics = _files(path / "depth", (".png",)), path / "camera_matrix.csv"
    if not depth or not intrinsics.is_file():
        return None
    table = read_table(intrinsics)
    matrix = table.numbers(range(table.width))
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or (np.diagonal(matrix) <= 0).any():
        raise FormatError(intrinsics, Fact("no-intrinsics-matrix"))
    width, height = _picture_px(path, matrix)
    return DepthFiles(
        depth=depth,
        confidence=_files(path / "confidence", (".png",)),
        view=grid_of_matrix(width, height, matrix),
        metres=MILLIMETRES,
        source="Stray Scanner",
        is_fused=True,
    ).maps()


def _picture_px(path: Path, matrix: Array) -> tuple[int, int]:
    """Size of the images that intrinsics are of: the video's, else ARKit's own, where the centre fits."""
    from colmap_inertial.io.mp4 import is_mp4, read_movie

    video = path / "rgb.mp4"
    if video.is_file() and is_mp4(video):
        track = read_movie(video).track(handler="vide")
        if track is not None and min(track.width_px, track.height_px) > 0:
            return track.width_px, track.height_px
    width, height = _ARKIT_PX
    if abs(matrix[0, 2] / width - 0.5) > 0.1 or abs(matrix[1, 2] / height - 0.5) > 0.1:
        raise FormatError(path / "camera_matrix.csv", Fact("intrinsics-of-unknown-size"))
    return width, height


# --- Record3D --------------------------------------------------------------------------------------------------------


def _is_record3d(path: Path) -> bool:
    return (path / "metadata").is_file() and (path / "rgbd").is_dir()


def _read_record3d(path: Path) -> DeviceFolder:
    file = path / "metadata"
    known = read_json(file)
    poses = np.array(known["poses"], dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise FormatError(file, Fact("pose-not-finite"))
    if "frameTimestamps" in known:
        t_ns = np.rint(1e9 * np.array(known["frameTimestamps"], dtype=np.float64)).astype(np.int64)
    else:
        t_ns = np.rint(1e9 / float(known["fps"]) * np.arange(len(poses))).astype(np.int64)
    xyzw = quat_multiply(poses[:, :4], np.broadcast_to(_HALF_TURN_XYZW, (len(poses), 4)))
    trajectory = _trajectory(file, tuple(map(str, range(len(poses)))), t_ns[: len(poses)], xyzw, poses[:, 4:])
    matrix = np.array(known["K"], dtype=np.float64).reshape(3, 3).T
    depth = _files(path / "rgbd", (".depth",))
    maps = DepthFiles(
        depth=depth,
        confidence=_files(path / "rgbd", (".conf",)),
        view=grid_of_matrix(int(known["w"]), int(known["h"]), matrix),
        metres=1.0,
        source="Record3D",
        is_fused=True,
    ).maps()
    return DeviceFolder(app="Record3D", trajectory=trajectory, depth=maps if depth else None, up_in_world=_ARKIT_UP)


def _record3d_frames(path: Path) -> ImageFolder | None:
    return _images_in(path / "rgbd")


def _images_in(folder: Path, *, time_unit: str | None = None) -> ImageFolder | None:
    """The images of a folder, where there are some; ``time_unit`` of their names, where these are times."""
    if not _files(folder, (".jpg", ".jpeg", ".png")):
        return None
    return ImageFolder(folder=folder, times=None if time_unit is None else "name", time_unit=time_unit)


# --- Polycam ---------------------------------------------------------------------------------------------------------


def _is_polycam(path: Path) -> bool:
    return (path / "keyframes" / "cameras").is_dir()


def _read_polycam(path: Path) -> DeviceFolder:
    base = path / "keyframes"
    cameras = sorted(_files(base / "cameras", (".json",)).items(), key=lambda item: _stamp(item[1]))
    names = tuple(name for name, _ in cameras)
    read = [read_json(file) for _, file in cameras]
    rows = np.array([[one[f"t_{i}{j}"] for i in range(3) for j in range(4)] for one in read], dtype=np.float64)
    rows = rows.reshape(-1, 3, 4)
    t_ns = np.array([1000 * _stamp(file) for _, file in cameras], dtype=np.int64)
    xyzw = _turn_half(rows[:, :, :3])
    views = {name: _polycam_view(one) for name, one in zip(names, read, strict=True)}
    depth = {name: file for name, file in _files(base / "depth", (".png",)).items() if name in views}
    maps = DepthFiles(
        depth=depth,
        confidence=_files(base / "confidence", (".png",)),
        view=views,
        metres=MILLIMETRES,
        source="Polycam",
        is_fused=True,
    ).maps()
    trajectory = _trajectory(base / "cameras", names, t_ns, xyzw, rows[:, :, 3])
    return DeviceFolder(app="Polycam", trajectory=trajectory, depth=maps if depth else None, up_in_world=_ARKIT_UP)


def _polycam_frames(path: Path) -> ImageFolder | None:
    return _images_in(path / "keyframes" / "images", time_unit="us")


def _stamp(file: Path) -> int:
    """Microseconds that a keyframe is named by."""
    if not file.stem.isdecimal() or len(file.stem) > 18:
        raise FormatError(file, Fact("keyframe-name-no-number"))
    return int(file.stem)


def _polycam_view(camera: Mapping[str, Any]) -> PinholeGrid:
    matrix = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
    return grid_of_matrix(int(camera["width"]), int(camera["height"]), matrix)


def _turn_half(world_from_camera: Array) -> Array:
    """(N, 4) of rotations (N, 3, 3) of cameras whose y is up and z back, as of COLMAP's."""
    quaternions = np.array([quat_from_matrix(rotation) for rotation in world_from_camera])
    return quat_multiply(quaternions, np.broadcast_to(_HALF_TURN_XYZW, quaternions.shape))


# --- nerfstudio ------------------------------------------------------------------------------------------------------


def _is_nerfstudio(path: Path) -> bool:
    file = path / "transforms.json"
    if not file.is_file():
        return False
    try:
        frames = read_json(file).get("frames")
    except FormatError:
        return False
    return isinstance(frames, list) and any(isinstance(one, dict) and "depth_file_path" in one for one in frames)


def _read_nerfstudio(path: Path) -> DeviceFolder:
    file = path / "transforms.json"
    known = read_json(file)
    frames = sorted(known["frames"], key=lambda one: str(one["file_path"]))
    names = tuple(str(one["file_path"]) for one in frames)
    rows = np.array([one["transform_matrix"] for one in frames], dtype=np.float64)[:, :3]
    scale = np.linalg.norm(rows[:, :, 0], axis=1)
    rotations = rows[:, :, :3] / scale[:, None, None]
    # frames of a dataset have no times: their order is all that is known
    t_ns = np.arange(len(names), dtype=np.int64) * 1_000_000_000
    trajectory = replace(_trajectory(file, names, t_ns, _turn_half(rotations), rows[:, :, 3]), length_unit="model")
    depth = {
        name: path_in(path, str(one["depth_file_path"]))
        for name, one in zip(names, frames, strict=True)
        if "depth_file_path" in one
    }
    views = {}
    for name, one in zip(names, frames, strict=True):
        values = {**known, **one}
        matrix = np.array(
            [[values["fl_x"], 0, values["cx"] - 0.5], [0, values["fl_y"], values["cy"] - 0.5], [0, 0, 1.0]]
        )
        views[name] = grid_of_matrix(int(values["w"]), int(values["h"]), matrix)
    arrays = [file for file in depth.values() if file.suffix.lower() == ".npy"]
    metres = 1.0 if len(arrays) == len(depth) else MILLIMETRES
    maps = DepthFiles(depth=depth, confidence={}, view=views, metres=metres, source="nerfstudio", is_fused=False).maps()
    return DeviceFolder(app="nerfstudio", trajectory=trajectory, is_metric=False, depth=maps)


def _nerfstudio_frames(path: Path) -> ImageFolder | None:
    folders = {str(Path(str(one["file_path"])).parent) for one in read_json(path / "transforms.json")["frames"]}
    return _images_in(path_in(path, folders.pop())) if len(folders) == 1 else None


@dataclass(frozen=True, kw_only=True)
class _Layout:
    name: str
    accepts: Callable[[Path], bool]
    read: Callable[[Path], DeviceFolder]
    frames: Callable[[Path], ImageFolder | None] | None = None


LAYOUTS = (
    _Layout(name="Stray Scanner", accepts=_is_stray, read=_read_stray),
    _Layout(name="Record3D", accepts=_is_record3d, read=_read_record3d, frames=_record3d_frames),
    _Layout(name="Polycam raw", accepts=_is_polycam, read=_read_polycam, frames=_polycam_frames),
    _Layout(name="nerfstudio with depth", accepts=_is_nerfstudio, read=_read_nerfstudio, frames=_nerfstudio_frames),
)
