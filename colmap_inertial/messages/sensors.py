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


@message(example={"maps": 230, "images": 90})
def depth_without_images(maps: int, images: int) -> str:
    return f"none of the {maps} depth maps belongs to one of the model's {images} images"


@message(
    advice="give depth maps with the rotation and crop of the images",
    example={"name": "000012.jpg", "width": 256, "height": 192, "of_width": 1080, "of_height": 1920},
)
def depth_of_other_images(name: str, width: int, height: int, of_width: int, of_height: int) -> str:
    return (
        f"the depth map of {name} is {width} x {height}, but the image {of_width} x {of_height}, of another aspect "
        "ratio"
    )


@message(
    advice="film matt, opaque surfaces within five metres",
    example={"count": 2, "needed": 4},
)
def depth_images_too_few(count: int, needed: int) -> str:
    return f"only {count} images have depth at enough of their points, and {needed} are needed"


@message(
    advice="give poses on the clock of the frames, or of the frames' names",
    example={"count": 2, "needed": 8},
)
def device_poses_too_few(count: int, needed: int) -> str:
    return f"only {count} images of the model have a pose of the device, and {needed} are needed"


state("device-stands-still", "the device did not move")
state(
    "device-path-of-other-shape",
    "the device's path and the model's differ in shape",
    advice="check that its times are those of the frames",
)


@message(
    advice="check the model there: either COLMAP placed images wrongly, or the device lost track",
    example={"at_s": 12.3, "jump_m": 0.42, "turn_deg": 6.0},
)
def device_path_breaks(at_s: float, jump_m: float, turn_deg: float) -> str:
    return (
        f"at about {at_s:.1f} s, the model's path and the device's jump apart by {jump_m:.2g} m "
        f"and {turn_deg:.2g} degrees within a second"
    )


@message(
    advice="close loops, or use --refine inertial; the device's heading drifts by itself, its vertical hardly",
    example={"turn_deg": 7.0, "tilt_deg": 4.0},
)
def device_path_bends(turn_deg: float, tilt_deg: float | None) -> str:
    tilt = "" if tilt_deg is None else f", its vertical by {tilt_deg:.2g}"
    return f"the model's path bends against the device's by {turn_deg:.2g} degrees from start to end{tilt}"


@message(example={"ratio": 1.2, "sigma": 2.0})
def positions_say_no_length(ratio: float, sigma: float) -> str:
    return f"the positions do not determine the length of the path ({ratio:.2g} +- {sigma:.2g} times)"


state("positions-stand-still", "the camera or its positions did not move")
state("positions-without-heights", "the positions have no heights, by which up would be known")


@message(
    advice="move over an area, not along a line, larger than the errors of the positions",
    example={"across_m": 2.0, "error_m": 3.0},
)
def positions_leave_up_open(across_m: float, error_m: float) -> str:
    wide = f"the path is {across_m:.2g} m wide, and they are off by {error_m:.2g} m"
    return f"the positions do not determine which way is up: {wide}"


@message(example={"half_width": 0.6})
def sensor_tells_little(half_width: float) -> str:
    return f"determines the scale only to +-{100 * half_width:.2g} %"


@message(
    advice="add a sensor that knows the scale better, or a target of known size",
    example={"half_width": 0.05},
)
def combined_interval_wide(half_width: float) -> str:
    return f"the 95 % interval of all sensors is +-{100 * half_width:.2g} %"


state("sensor-not-asked", "is not used (--scale-from)")


@message(example={"sensor": "depth", "capture": "capture.toml"})
def sensor_not_there(sensor: str, capture: str) -> str:
    return f"{capture} has no {name_of(sensor)}, which --scale-from names"


@message(example={"sensor": "device", "half_width_deg": 2.0})
def up_by_sensor(sensor: str, half_width_deg: float) -> str:
    return f"up is known by the {name_of(sensor)} to {half_width_deg:.2g} degrees"


def _name_distance(sensors: Sequence[str]) -> str:
    together = " ".join(f"--scale-from {sensor}" for sensor in (*(sensors or ("imu",)), "distance"))
    return f"give {together} to take all together, or --scale-from distance for the distance alone"


@message(advice=_name_distance, example={"sensors": ()})
def distance_not_named(sensors: Sequence[str]) -> str:
    return "--distance is given beside an IMU, and not named by --scale-from"


state("between-of-one-kind", "--between beside an IMU needs two markers, or two points")
state(
    "points-of-another-model",
    "--between with points, beside an IMU, needs a project of one model whose shape stays as it is",
    advice="give --refine off and a project of one model, or two markers",
)
state(
    "target-before-images",
    "a target or markers give metres together with the IMU only where the refinement leaves the rectified images as "
    "they are",
    advice="give --refine off, or --rolling-shutter off",
)


@message(example={"found": "'depth.png'"})
def depth_pattern_without_stem(found: str) -> str:
    return f"must name a file by {{stem}}, the image's name without ending, not {found}"


@message(example={"units": ("m", "cm", "mm")})
def depth_without_unit(units: Sequence[str]) -> str:
    return f"state the unit of the depth maps once: unit = {', '.join(units)}, or metres_per_step"
