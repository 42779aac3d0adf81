"""ROS 1 bags and ROS 2 recordings (sqlite3, mcap), by the package ``rosbags`` (extra ``ros``).

``sensor_msgs/Imu`` is in rad/s and m/s2, gravity included; times are the headers'. A driver that publishes gyroscope
and accelerometer apart fills the other one with zeros, or sets the first number of its covariance to -1.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.imu_text import build_recording
from colmap_inertial.io.rosbag_chunks import require_modest_recording
from colmap_inertial.io.samples import Samples, order_samples
from colmap_inertial.io.units import SENSOR_NAMES, DeclaredUnits, Quantity

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_MAGIC = (b"#ROSBAG V2", b"\x89MCAP0\r\n")
_IMU = "sensor_msgs/msg/Imu"


def is_rosbag(path: Path) -> bool:
    """Whether ``path`` is a ROS 1 bag, a ROS 2 recording's folder, or the one file in it."""
    if path.is_dir():
        files = (path / "metadata.yaml").is_file()
        return files and any(file.suffix in (".db3", ".mcap") for file in path.iterdir())
    if not path.is_file():
        return False
    try:
        with open(path, "rb") as file:
            head = file.read(16)
    except OSError:
        return False
    return head.startswith(_MAGIC) or (head.startswith(b"SQLite format 3\0") and path.suffix == ".db3")


def read_rosbag(path: Path, units: DeclaredUnits) -> ImuRecording:
    """Read the ``sensor_msgs/Imu`` messages of a recording.

    Raises
    ------
    MissingExtraError
        Where the package rosbags is not installed.
    FormatError
        Where the recording is damaged, unpacks to much more than it is, or holds no IMU or several.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("ros", f"{path} is a ROS recording") from None
    require_modest_recording(path)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = _topics(reader)
    # the readers below raise whatever a damaged file leads them to: sqlite, struct, lz4, yaml, index errors
    except Exception as error:
        reason = str(error).strip().splitlines()
        raise FormatError(
            path, f"cannot be read as a ROS recording: {type(error).__name__} {reason[0][:200] if reason else ''}"
        ) from None
    if not topics:
        raise FormatError(path, "holds no sensor_msgs/Imu messages")
    sensors: tuple[tuple[Quantity, str], ...] = (("gyro", units.gyro or "rad/s"), ("accel", units.accel or "m/s2"))
    samples_of: dict[str, Samples] = {}
    for quantity, unit in sensors:
        with_it = {name: topic[quantity] for name, topic in topics.items() if quantity in topic}
        if len(with_it) > 1:
            raise FormatError(
                path,
                f"holds several topics with a {SENSOR_NAMES[quantity]} ({', '.join(with_it)}); keep one: "
                f"rosbags-convert --src {path.name} --dst one --include-topic {next(iter(with_it))}",
            )
        for t_ns, values in with_it.values():
            samples_of[quantity] = order_samples(path, quantity, unit, t_ns, values)
    if "gyro" not in samples_of:
        raise FormatError(path, f"none of its IMU topics ({', '.join(topics)}) has a gyroscope that moves")
    return build_recording(samples_of["gyro"], samples_of.get("accel"))


_Series = tuple[Int64Array, Array]


def _topics(reader: AnyReader) -> dict[str, dict[str, _Series]]:
    """Times and samples of each topic's sensors; a sensor that is declared absent, or all zero, is left out."""
    stamps: dict[str, list[int]] = {}
    rows: dict[str, list[tuple[float, ...]]] = {}
    absent: dict[str, set[str]] = {}
    connections = [c for c in reader.connections if c.msgtype == _IMU]
    for connection, _, raw in reader.messages(connections=connections) if connections else ():
        message: Any = reader.deserialize(raw, connection.msgtype)
        gyro, accel, stamp = message.angular_velocity, message.linear_acceleration, message.header.stamp
        stamps.setdefault(connection.topic, []).append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        rows.setdefault(connection.topic, []).append((gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z))
        if len(stamps[connection.topic]) == 1:
            covariances = {"gyro": message.angular_velocity_covariance, "accel": message.linear_acceleration_covariance}
            absent[connection.topic] = {name for name, cov in covariances.items() if cov[0] == -1}
    topics: dict[str, dict[str, _Series]] = {}
    for topic, values in rows.items():
        t_ns, numbers = np.array(stamps[topic], dtype=np.int64), np.array(values)
        parts = {"gyro": numbers[:, :3], "accel": numbers[:, 3:]}
        topics[topic] = {
            name: (t_ns, part) for name, part in parts.items() if name not in absent[topic] and np.any(part != 0)
        }
    return topics
