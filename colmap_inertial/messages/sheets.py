"""Words of sheets of numbers about cameras and sensors, and of calibrations."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import message, state


@message(example={"key": "intrinsics", "found": "'a'"})
def key_not_numbers(key: str, found: str) -> str:
    return f"{key}: {found} is not a list of numbers"


@message(example={"key": "intrinsics"})
def key_not_finite(key: str) -> str:
    return f"{key}: numbers must be finite"


@message(example={"key": "intrinsics", "count": 4, "found": 3})
def key_of_other_count(key: str, count: int, found: int) -> str:
    return f"{key} must hold {count} numbers, found {found}"


@message(example={"what": "T_BS"})
def no_rotation(what: str) -> str:
    return f"{what} holds no rotation"


state("no-body-pose", "holds no T_BS with rows, cols and data")


@message(example={"key": "camera_model", "found": "'fisheye'", "known": ("pinhole",)})
def value_not_known(key: str, found: str, known: Sequence[str]) -> str:
    listed = " and ".join(known) if len(known) == 2 else ", ".join(known)
    return f"{key} {found} is not supported (supported: {listed})"


@message(example={"missing": ("cov",), "unknown": ()})
def calibration_fields(missing: Sequence[str], unknown: Sequence[str]) -> str:
    stated = (("missing:", missing), ("unknown:", unknown))
    what = "; ".join(f"{label} {', '.join(names)}" for label, names in stated if names)
    return f"the fields are not those of such a calibration ({what})"


@message(example={"name": "device", "expected": "text"})
def field_of_other_type(name: str, expected: str) -> str:
    what = {"text": "a text", "integer": "a whole number", "numbers": "numbers"}[expected]
    return f"{name}: expected {what}"


@message(example={"name": "clock_rate"})
def field_not_single(name: str) -> str:
    return f"{name} must be a single number"


@message(example={"kind": "lens", "known": ("camera-imu", "imu"), "writers": ("align", "calibrate-imu")})
def calibration_kind_unknown(kind: str, known: Sequence[str], writers: Sequence[str]) -> str:
    listed = ", ".join(f'"{name}" ({command})' for name, command in zip(known, writers, strict=True))
    return f"unknown kind of calibration {kind!r}; known: {listed}"


@message(example={"name": "cam2", "cameras": ("cam0", "cam1")})
def no_camera_of_name(name: str, cameras: tuple[str, ...]) -> str:
    return f"has no camera {name!r}; it has {', '.join(cameras)}"


state("kalibr-pose-missing", "T_cn_cnm1 (its pose against the camera before it) is missing")
state("sheet-without-intrinsics", "holds no intrinsics")
state("lens-model-unknown-to-colmap", "COLMAP has no camera model with prism or tilt coefficients")
state("calibration-of-another-kind", "holds no calibration of a camera and an IMU (it is of another kind)")
state("calibration-cov-order", "cov_parameters: the order of cov is not the one of this version")
state("no-imu-calibration", "holds no calibration of an IMU (colmap-inertial calibrate-imu writes one)")


@message(advice="give one of them", example={"other": "a.json", "kind": "imu"})
def calibrations_say_the_same(other: str, kind: str) -> str:
    what = {"camera-imu": "the rotation and time offset between camera and IMU", "imu": "the IMU's own gains"}[kind]
    return f"and {other} both give {what}"


@message(example={"name": "cam2", "cameras": ("cam0", "cam1")})
def camera_not_calibrated(name: str, cameras: tuple[str, ...]) -> str:
    return f"calibrates no camera {name!r}; it has {', '.join(cameras)}"


state(
    "no-rig-calibration",
    "is not a calibration of several cameras",
    advice="give Kalibr's or OpenCV's YAML, COLMAP's rig_config.json, or the folder of a COLMAP model with rigs.bin",
    joint=": ",
)
state("kalibr-in-metres", "Kalibr writes metres", advice="leave out unit")
state(
    "calibration-without-cameras",
    (
        "holds no calibration of several cameras: neither Kalibr's cam0, cam1 with intrinsics, nor OpenCV's "
        "maps with camera_matrix, nor M1, M2"
    ),
)
state(
    "pose-of-second-camera-missing",
    "R and T of the second camera are missing",
    advice="put intrinsics and extrinsics in one file",
    joint=": ",
)
state("rotation-without-translation", "R and T must be given together; one is missing")
state("not-a-rig-config", "not a rig_config.json: expected a list of rigs")


@message(example={"count": 2})
def several_rigs_described(count: int) -> str:
    return f"describes {count} rigs; a multi-aperture camera is one"


state("camera-model-missing", "camera_model_name and camera_params are missing")


@message(example={"model": "'PINHOLES'"})
def camera_model_unknown(model: str) -> str:
    return f"camera model {model} is unknown"


state("cam-from-rig-not-a-quaternion", "cam_from_rig_rotation is not a unit quaternion")
state("rig-file-missing", "is missing: the calibration must be a COLMAP model in binary format with rigs")


@message(example={"camera": 2})
def camera_without_pose_in_rig(camera: int) -> str:
    return f"camera {camera} has no pose in its rig"


@message(example={"count": 2})
def not_one_rig(count: int) -> str:
    return f"holds {count} rigs of several cameras; one is needed"


@message(example={"camera": 2})
def camera_of_rig_missing(camera: int) -> str:
    return f"camera {camera} of the rig is missing"
