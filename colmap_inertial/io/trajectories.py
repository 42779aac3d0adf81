"""Camera trajectories in text files: TUM format, and the poses of InertialScale folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_normalize
from colmap_inertial.core.types import CameraTrajectory, ImuRecording, SmoothedTrajectory
from colmap_inertial.io.files import reader, write_text
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.tables import Table, read_table
from colmap_inertial.io.units import seconds


@reader("a trajectory")
def read_tum(path: Path) -> CameraTrajectory:
    """Read a trajectory in TUM format.

    Parameters
    ----------
    path
        Rows ``t x y z qx qy qz qw``: seconds, the camera's centre (model units), rotation world_from_camera. Lines
        that start with ``#`` are comments.

    Raises
    ------
    FormatError
        For other columns, values that are not finite, or quaternions that are not of unit length.
    TimingError
        For times that do not increase.
    """
    return _read_poses(Path(path), "t x y z qx qy qz qw", "s", quat_conjugate)


def write_tum(path: Path, trajectory: CameraTrajectory | SmoothedTrajectory) -> None:
    """Write a trajectory in TUM format; see :func:`read_tum`. Times are exact to the nanosecond."""
    t_ns = np.rint(trajectory.t_s * 1e9).astype(np.int64)
    world_from_cam = quat_normalize(quat_conjugate(trajectory.cam_from_world_xyzw))
    lines = ["# t_s x y z qx qy qz qw: camera centre, world_from_camera"]
    for stamp, centre, xyzw in zip(t_ns.tolist(), trajectory.cam_in_world, world_from_cam, strict=True):
        total = trajectory.epoch_ns + stamp
        whole, rest = divmod(abs(total), 1_000_000_000)
        time = f"{'-' if total < 0 else ''}{whole}.{rest:09d}"
        # of places on a map, millimetres stand in the tenth digit
        lines.append(" ".join([time, *(f"{value:.15g}" for value in centre), *(f"{value:.12g}" for value in xyzw)]))
    write_text(Path(path), "\n".join(lines) + "\n")


@reader("an InertialScale folder")
def read_inertial_scale(folder: Path) -> tuple[CameraTrajectory, ImuRecording]:
    """Read an InertialScale folder: ``poses.txt``, ``gyroscope.txt``, ``accelerometer.txt``.

    Parameters
    ----------
    folder
        ``poses.txt`` has rows ``t_ns x y z qw qx qy qz``: the camera's centre (model units), rotation
        camera_from_world. The sensors have rows ``t_ns x y z`` in rad/s and m/s2, on a clock of their own. A
        capture.toml in the folder is heeded: ``[imu] path = "."`` with other units or axes corrects the sensors.

    Raises
    ------
    FormatError, TimingError
        As :func:`read_imu` and :func:`read_tum`.
    """
    folder = Path(folder)
    imu = read_imu(folder)
    return read_inertial_scale_poses(folder), imu


def read_inertial_scale_poses(folder: Path) -> CameraTrajectory:
    """The ``poses.txt`` of an InertialScale folder alone; see :func:`read_inertial_scale`."""
    return _read_poses(folder / "poses.txt", "t_ns x y z qw qx qy qz", "ns", np.asarray)


def _read_poses(path: Path, layout: str, time_unit: str, cam_from_world: Callable[[Array], Array]) -> CameraTrajectory:
    """Poses of a table with these columns; ``cam_from_world`` makes rotations of its quaternions."""
    table = read_table(path)
    table.require_width(layout)
    if len(table) < 2:
        raise FormatError(path, Fact("one-pose"))
    numbers = table.numbers([layout.split().index(name) for name in ["x", "y", "z", "qx", "qy", "qz", "qw"]])
    _require_rows(table, np.asarray(np.isfinite(numbers).all(axis=1)), lambda row: Fact("pose-not-finite"))
    t_ns = table.stamps_ns(0, time_unit)
    late = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(late):
        line = int(table.line_numbers[late[0] + 1])
        raise TimingError(Fact("pose-times-back", path=str(path), line=line))
    xyzw = numbers[:, 3:]
    norm = np.linalg.norm(xyzw, axis=1)
    _require_rows(
        table,
        np.abs(norm - 1) <= 1e-2,
        lambda row: Fact("quaternion-of-other-length", length=norm[row]),
    )
    return CameraTrajectory(
        names=tuple(map(str, range(len(t_ns)))),
        t_s=seconds(t_ns, int(t_ns[0])),
        cam_from_world_xyzw=cam_from_world(xyzw / norm[:, None]),
        cam_in_world=numbers[:, :3],
        epoch_ns=int(t_ns[0]),
    )


def _require_rows(table: Table, is_good: BoolArray, reason: Callable[[int], Fact]) -> None:
    """Refuse the first pose that is not good; ``reason`` of its row."""
    if not is_good.all():
        row = int(np.argmin(is_good))
        raise FormatError(table.path, reason(row), line=int(table.line_numbers[row]))
