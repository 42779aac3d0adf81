"""ROS 1 bags and ROS 2 recordings (sqlite3, mcap), by the package ``rosbags`` (extra ``ros``).

``sensor_msgs/Imu`` is in rad/s and m/s2, gravity included; times are the headers', or those of arrival where the
user says so. A driver that publishes gyroscope
and accelerometer apart fills the other one with zeros, or sets the first number of its covariance to -1.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray, Int64Array
from colmap_inertial.core.errors import FormatError, MissingExtraError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.imu_text import build_recording
from colmap_inertial.io.rosbag_chunks import require_modest_recording
from colmap_inertial.io.samples import LIMITS, Samples, order_samples
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
        raise MissingExtraError("ros", Fact("ros-recording", path=str(path))) from None
    require_modest_recording(path)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = _topics(reader)
    # the readers below raise whatever a damaged file leads them to: sqlite, struct, lz4, yaml, index errors
    except Exception as error:
        reason = str(error).strip().splitlines()
        detail = reason[0][:200] if reason else ""
        raise FormatError(path, Fact("bag-not-readable", kind=type(error).__name__, detail=detail)) from None
    if not topics:
        raise FormatError(path, Fact("bag-without-imu"))
    if units.topic is not None:
        if units.topic not in topics:
            raise FormatError(path, Fact("bag-without-topic", topic=units.topic, topics=tuple(topics)))
        topics = {units.topic: topics[units.topic]}
    sensors: tuple[tuple[Quantity, str], ...] = (("gyro", units.gyro or "rad/s"), ("accel", units.accel or "m/s2"))
    samples_of: dict[str, Samples] = {}
    taken: dict[str, _Topic] = {}
    for quantity, unit in sensors:
        with_it = {name: topic for name, topic in topics.items() if quantity in topic.parts}
        if len(with_it) > 1:
            several = {"sensor": SENSOR_NAMES[quantity], "topics": tuple(with_it), "name": path.name}
            raise FormatError(path, Fact("bag-of-several-topics", **several))
        for name, topic in with_it.items():
            taken[name] = topic
            if len(topic.publishers) > 1:
                raise TimingError(Fact("bag-of-two-drivers", path=str(path), topic=name, nodes=topic.publishers))
            t_ns = topic.arrival_ns
            if units.stamps != "arrival":
                t_ns = topic.stamp_ns
                _check_stamps(path, name, topic)
            samples_of[quantity] = order_samples(path, quantity, unit, t_ns, topic.parts[quantity])
    if units.stamps != "arrival":
        _require_one_clock(path, taken)
    if "gyro" not in samples_of:
        raise FormatError(path, Fact("bag-without-moving-gyroscope", topics=tuple(topics)))
    return build_recording(samples_of["gyro"], samples_of.get("accel"))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Topic:
    """Messages of one topic.

    Attributes
    ----------
    stamp_ns, arrival_ns
        Of the headers, and when the recorder got them.
    parts
        Samples of the sensors; one that is declared absent, or all zero, is left out.
    publishers
        Nodes whose messages come in turn.
    """

    stamp_ns: Int64Array
    arrival_ns: Int64Array
    parts: dict[str, Array]
    publishers: tuple[str, ...] = ()


def _check_stamps(path: Path, name: str, topic: _Topic) -> None:
    """Refuse header stamps that are no times of samples, in the words of bags.

    Raises
    ------
    TimingError
        For empty or repeated ones, and those of a clock that was set.
    """
    stamps, count = topic.stamp_ns, len(topic.stamp_ns)
    hint = f"[imu]\npath = {json.dumps(path.name, ensure_ascii=False)}\n"
    jitter = _jitter_ms(topic.arrival_ns)
    arrival = {"jitter_ms": jitter, "hint": hint + 'stamps = "arrival"'}
    empty = int((stamps == 0).sum())
    if empty > LIMITS.harmless_share * count or len(np.unique(stamps)) < 2:
        raise TimingError(Fact("bag-stamps-empty", path=str(path), topic=name, count=empty, total=count, **arrival))
    repeated = count - len(np.unique(stamps))
    if repeated > LIMITS.harmless_share * count:
        raise TimingError(
            Fact("bag-stamps-repeated", path=str(path), topic=name, count=repeated, total=count, **arrival)
        )
    late = np.maximum.accumulate(stamps) - stamps
    back = int((late > LIMITS.latest_arrival_ns).sum())
    if back:
        raise TimingError(Fact("bag-stamps-jump-back", path=str(path), topic=name, count=back, total=count, **arrival))
    ahead = np.diff(stamps) - np.diff(topic.arrival_ns)  # a gap of the sensor is one of arrival as well
    jumps = int((ahead > LIMITS.latest_arrival_ns).sum())
    if jumps:
        raise TimingError(
            Fact("bag-stamps-jump-ahead", path=str(path), topic=name, count=jumps, jump_s=ahead.max() * 1e-9, **arrival)
        )


def _require_one_clock(path: Path, topics: dict[str, _Topic]) -> None:
    """Refuse topics whose header stamps are of clocks with different zeros, by how far they are from arrival.

    Raises
    ------
    TimingError
        Where they are.
    """
    late_ns = {name: float(np.median(topic.arrival_ns - topic.stamp_ns)) for name, topic in topics.items()}
    apart_s = (max(late_ns.values()) - min(late_ns.values())) * 1e-9 if late_ns else 0.0
    if apart_s > LIMITS.latest_arrival_ns * 1e-9:
        hint = f'[imu]\npath = {json.dumps(path.name, ensure_ascii=False)}\nstamps = "arrival"'
        jitter_ms = max(_jitter_ms(topic.arrival_ns) for topic in topics.values())
        raise TimingError(
            Fact(
                "bag-of-two-clocks",
                path=str(path),
                topics=tuple(late_ns),
                apart_s=apart_s,
                jitter_ms=jitter_ms,
                hint=hint,
            )
        )


def _jitter_ms(arrival_ns: Int64Array) -> float:
    """How far the times of arrival are from an even rate, as half of them."""
    steps = np.diff(np.sort(arrival_ns))
    return float(np.median(np.abs(steps - np.median(steps)))) * 1e-6 if len(steps) else 0.0


def _topics(reader: AnyReader) -> dict[str, _Topic]:
    """The messages of each topic."""
    stamps: dict[str, list[int]] = {}
    arrivals: dict[str, list[int]] = {}
    nodes: dict[str, list[int]] = {}
    rows: dict[str, list[tuple[float, ...]]] = {}
    absent: dict[str, set[str]] = {}
    connections = [c for c in reader.connections if c.msgtype == _IMU]
    names = [_node(connection) for connection in connections]
    for connection, arrival, raw in reader.messages(connections=connections) if connections else ():
        message: Any = reader.deserialize(raw, connection.msgtype)
        gyro, accel, stamp = message.angular_velocity, message.linear_acceleration, message.header.stamp
        stamps.setdefault(connection.topic, []).append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        arrivals.setdefault(connection.topic, []).append(arrival)
        nodes.setdefault(connection.topic, []).append(connections.index(connection))
        rows.setdefault(connection.topic, []).append((gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z))
        if len(stamps[connection.topic]) == 1:
            covariances = {"gyro": message.angular_velocity_covariance, "accel": message.linear_acceleration_covariance}
            absent[connection.topic] = {name for name, cov in covariances.items() if cov[0] == -1}
    topics: dict[str, _Topic] = {}
    for topic, values in rows.items():
        numbers = np.array(values)
        parts = {"gyro": numbers[:, :3], "accel": numbers[:, 3:]}
        topics[topic] = _Topic(
            stamp_ns=np.array(stamps[topic], dtype=np.int64),
            arrival_ns=np.array(arrivals[topic], dtype=np.int64),
            parts={n: part for n, part in parts.items() if n not in absent[topic] and np.any(part != 0)},
            publishers=_find_publishers(np.array(nodes[topic]), names),
        )
    return topics


def _node(connection: Any) -> str:
    """The node that published, where the bag says."""
    return str(getattr(connection.ext, "callerid", None) or f"connection {connection.id}")


def _find_publishers(sources: IndexArray, names: list[str]) -> tuple[str, ...]:
    """The nodes of a topic whose messages come in turn, not one recording after another."""
    several = np.unique(sources)
    turns = int((np.diff(sources) != 0).sum())
    return tuple(names[i] for i in several) if len(several) > 1 and turns > 4 * len(several) else ()
