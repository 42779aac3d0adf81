"""Words of what is found in tables, bags and calibrations."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state


@message(
    advice='state date_order = "dmy" or "mdy" in the table of the sensor',
    example={"path": "log.csv", "example": "3/4/2024"},
)
def date_order_unknown(path: str, example: str) -> str:
    return f"{path}: day and month cannot be told apart in dates such as {example}"


state("rows-of-several-sensors", "has rows of several sensors")
state("no-header-of-columns", "has no header that names its columns")


@message(example={"first": "gyro x", "second": "wx"})
def columns_alike(first: str, second: str) -> str:
    return f'two columns hold the same quantity: "{first}" and "{second}"'


@message(example={"columns": ("gx", "gy", "gz")})
def no_single_unit(columns: Sequence[str]) -> str:
    listed = ", ".join(f'"{column}"' for column in columns)
    return f"no single unit is given for {listed}"


@message(
    advice=lambda why, header, hint: f"describe it in a capture.toml, with ? for what the file does not state:\n{hint}",
    example={"why": {"code": "no-header-of-columns", "values": {}}, "header": None, "hint": "[imu.gyro]\n..."},
)
def table_unclear(why: Said, header: str | None, hint: str) -> str:
    return str(why) if header is None else f"{why}; the header is: {header}"


@message(
    advice="write an array of objects, an object on each line, or lists of equal length under their names: a time, and "
    "three numbers of each sensor"
)
def json_without_rows() -> str:
    return "is JSON without samples in a known layout"


_POINTS = {
    "columns": "which columns hold the {}",
    "choice": "which of several columns to take for the {}",
    "unit": "the unit of the {}",
    "counts": "how many counts of the {} make one unit",
    "time": "when the {} was read",
    "time_unit": "the unit of the times of the {}",
    "rows": "which rows of the {} to take",
    "axes": "the sign of the {}",
}
_SENSORS = {"gyro": "gyroscope", "accel": "accelerometer"}


@message(
    advice=lambda hint, **_: f"describe it in a capture.toml, with ? for what the file does not state:\n{hint}",
    example={"source": "", "open": (("gyro", "unit"), ("accel", "unit")), "header": "t,gx", "hint": "[imu.gyro]\n..."},
)
def table_open(source: str, open: Sequence[tuple[str, str]], header: str | None, hint: str) -> str:
    points: dict[str, list[str]] = {}
    for sensor, point in open:
        points.setdefault(point, []).append(_SENSORS[sensor])
    said = [_POINTS[point].format(" and ".join(sensors)) for point, sensors in points.items()]
    begin = f"it does not state {', '.join(said)}"
    if not said:
        begin = (
            f"it must be confirmed that this is from {source}"
            if source
            else "holds one sensor; a table beside it holds the other"
        )
    return begin + (f"; the header is: {header}" if header else "")


def _arrival_advice(jitter_ms: float, hint: str, **_: object) -> str:
    return (
        f"let the driver timestamp its messages, or use their arrival times (jitter {jitter_ms:.2g} ms; delays "
        f"remain) with a capture.toml:\n{hint}"
    )


_BAG = {"path": "imu.bag", "topic": "/imu", "count": 2000, "total": 2000, "jitter_ms": 0.6, "hint": "[imu]\n..."}


@message(advice=_arrival_advice, example=_BAG)
def bag_stamps_empty(path: str, topic: str, count: int, total: int, jitter_ms: float, hint: str) -> str:
    if not count:
        return f"{path}: header.stamp is the same in all {total} messages of {topic}"
    return f"{path}: the driver left header.stamp empty in {count} of {total} messages of {topic}"


@message(advice=_arrival_advice, example={**_BAG, "count": 240})
def bag_stamps_repeated(path: str, topic: str, count: int, total: int, jitter_ms: float, hint: str) -> str:
    return (
        f"{path}: {count} of {total} messages of {topic} repeat the header.stamp of another one: its clock is too "
        "coarse, or two drivers publish on the topic"
    )


@message(advice=_arrival_advice, example={**_BAG, "count": 7})
def bag_stamps_jump_back(path: str, topic: str, count: int, total: int, jitter_ms: float, hint: str) -> str:
    return (
        f"{path}: the header.stamp of {count} of {total} messages of {topic} is more than half a second before that "
        "of an earlier message: the driver's clock was set, or drivers with two clocks publish on the topic"
    )


@message(
    advice=_arrival_advice,
    example={"path": "imu.bag", "topic": "/imu", "count": 1, "jump_s": 7.0, "jitter_ms": 0.6, "hint": "[imu]\n..."},
)
def bag_stamps_jump_ahead(path: str, topic: str, count: int, jump_s: float, jitter_ms: float, hint: str) -> str:
    return (
        f"{path}: the header.stamp of {count} messages of {topic} jumps ahead by up to {jump_s:.3g} s against their "
        "times of arrival: the driver's clock was set"
    )


@message(
    advice=_arrival_advice,
    example={
        "path": "imu.bag",
        "topics": ("/gyro/sample", "/accel/sample"),
        "apart_s": 1.7e9,
        "jitter_ms": 0.6,
        "hint": "[imu]\n...",
    },
)
def bag_of_two_clocks(path: str, topics: Sequence[str], apart_s: float, jitter_ms: float, hint: str) -> str:
    return f"{path}: the header.stamp of {' and '.join(topics)} come from two clocks, {apart_s:.3g} s apart"


@message(
    advice="record one of them, or select one by its node (rosbag filter with m._connection_header['callerid'])",
    example={"path": "imu.bag", "topic": "/imu", "nodes": ("/driver", "/filter")},
)
def bag_of_two_drivers(path: str, topic: str, nodes: Sequence[str]) -> str:
    return f"{path}: {len(nodes)} drivers publish on {topic} ({', '.join(nodes)}): these are not the samples of one IMU"


@message(example={"topic": "/imu", "topics": ("/imu0", "/imu1")})
def bag_without_topic(topic: str, topics: Sequence[str]) -> str:
    return f"has no IMU topic {topic}; it has {', '.join(topics)}"


@message(
    advice="give Kalibr's camchain-imucam, a configuration of OpenVINS, VINS-Mono, VINS-Fusion or ORB-SLAM, or a JSON "
    "file that align wrote"
)
def calibration_unknown() -> str:
    return "is not a supported calibration of a camera and an IMU"


@message(
    advice="name one (camera under [camera]), or copy its block into a file of its own",
    example={"cameras": ("cam0", "cam1")},
)
def calibration_of_several(cameras: Sequence[str]) -> str:
    return f"calibrates several cameras ({', '.join(cameras)})"


@message(advice="give Kalibr's camchain-imucam (with T_cam_imu), or cam_from_imu under [calibration]")
def calibration_without_imu() -> str:
    return "calibrates the camera alone, without an IMU, as sensor_yaml under [camera] expects"
