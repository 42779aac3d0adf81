"""What is said of sensors beside the IMU that know of metres: depth, the device's own path, positions, references."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from colmap_inertial.messages import message, state

_WALK = "move the device sideways by a tenth of the distance to the scene or more, and keep the scene in view"


@message(advice="keep the names of depth maps and poses as the app wrote them", example={"maps": 230, "poses": 900})
def depth_without_poses(maps: int, poses: int) -> str:
    return f"at most one of the {maps} depth maps belongs to one of the {poses} poses"


@message(advice=_WALK, example={"count": 3, "needed": 6})
def depth_pairs_too_few(count: int, needed: int) -> str:
    return (
        f"only {count} pairs of depth maps show the same surfaces from different places; {needed} are needed: "
        "bare walls, glass and surfaces beyond five metres do not count"
    )


#: Sensors by their names in ``ScaleEvidence.sensor``.
NAMES = {
    "imu": "IMU",
    "depth": "depth sensor",
    "device": "device's own path",
    "positions": "satellite positions",
    "target": "target",
    "distance": "known distance",
}


def name_of(sensor: str) -> str:
    """What a sensor is called."""
    return NAMES[sensor]


@message(example={"reasons": ()})
def no_sensor_gives_scale(reasons: Sequence[Any]) -> str:
    said = "; ".join(str(reason) for reason in reasons)
    return f"no sensor gives a scale{': ' if said else ''}{said}"


@message(example={"sensor": "imu", "why": "the camera does not move"})
def sensor_in_doubt(sensor: str, why: Any) -> str:
    return f"{name_of(sensor)}: {why}"


def _advise_on_culprit(culprit: str, **_: Any) -> str:
    return {
        "imu": "calibrate the IMU once (calibrate-imu), and check that the frame times are the recorder's",
        "depth": "film matt, opaque surfaces within five metres",
        "device": "its scale drifts: use the other sensors",
        "positions": "record under open sky, over a longer path",
        "target": "measure the printed target again",
        "distance": "measure the distance again",
    }[culprit]


@message(
    advice=_advise_on_culprit,
    example={
        "first": "imu",
        "second": "depth",
        "ratio": 1.06,
        "chance": 0.0004,
        "culprit": "depth",
        "probability": 0.7,
    },
)
def sensors_contradict(first: str, second: str, ratio: float, chance: float, culprit: str, probability: float) -> str:
    return (
        f"{name_of(first)} and {name_of(second)} contradict each other: their lengths differ by "
        f"{100 * abs(ratio - 1):.2g} % (p = {chance:.1g}); most likely wrong: {name_of(culprit)} "
        f"({100 * probability:.0f} %)"
    )


# Depth maps and exports.


@message(example={"shape": (192, 256, 3)})
def depth_not_one_channel(shape: Sequence[int]) -> str:
    return f"holds an array of {' x '.join(map(str, shape))}; depth has one number for each pixel"


@message(example={"width": 256, "height": 192, "of_width": 1080, "of_height": 1920})
def depth_of_other_shape(width: int, height: int, of_width: int, of_height: int) -> str:
    return (
        f"is {width} x {height}, which is not the aspect ratio of images of {of_width} x {of_height}: depth maps, "
        "intrinsics and images must have the same rotation and crop"
    )


@message(example={"shape": (96, 128), "depth": (192, 256)})
def confidence_of_other_size(shape: Sequence[int], depth: Sequence[int]) -> str:
    return f"is {' x '.join(map(str, shape))}, but its depth map is {' x '.join(map(str, depth))}"


@message(example={"dtype": "object"})
def depth_no_numbers(dtype: str) -> str:
    return f"is not a depth map: it holds {dtype} values, or too many of them"


state("not-lzfse", "is not compressed by LZFSE, as Record3D writes depth")


@message(example={"path": "capture/rgbd/0.depth"})
def lzfse_needs_package(path: str) -> str:
    return f"{path} is compressed by LZFSE"


@message(example={"layouts": ("Stray Scanner", "Record3D")})
def no_device_folder(layouts: Sequence[str]) -> str:
    return f"is not a supported export of a device's own path ({', '.join(layouts)})"


state(
    "intrinsics-of-unknown-size",
    "states no image size, there is no video, and its principal point does not fit 1920 x 1440",
)
state("keyframe-name-no-number", "a keyframe is named by microseconds, such as 104563217.json")
