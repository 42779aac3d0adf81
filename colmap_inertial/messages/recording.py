"""Words on recordings: repairs of samples and clocks, camera against gyroscope, and why a run stops or is doubted."""

from __future__ import annotations

from math import degrees

from colmap_inertial.messages import Said, message, state

# samples, as they were read


@message(example={"file": "imu.csv", "sensor": "gyroscope", "count": 20, "rows": 60})
def rows_without_sample(file: str, sensor: str, count: int, rows: int) -> str:
    return f"{file}: {count} of {rows} rows hold no {sensor} sample"


@message(example={"file": "imu.csv", "sensor": "gyroscope", "count": 2, "counted": "line", "first": 9})
def rows_without_value(file: str, sensor: str, count: int, counted: str, first: int) -> str:
    return f"{file}: dropped {count} {sensor} rows without a value (first: {counted} {first})"


@message(example={"file": "imu.csv", "sensor": "gyroscope", "count": 4})
def rows_sorted(file: str, sensor: str, count: int) -> str:
    return f"{file}: sorted {count} {sensor} rows that were out of order"


@message(example={"file": "imu.csv", "sensor": "gyroscope", "count": 1})
def rows_merged(file: str, sensor: str, count: int) -> str:
    return f"{file}: merged {count} repeated {sensor} rows"


@message(example={"file": "imu.csv", "sensor": "gyroscope", "count": 4})
def rows_averaged(file: str, sensor: str, count: int) -> str:
    return f"{file}: averaged {count} {sensor} rows that repeat a timestamp with other values"


@message(example={"file": "imu.csv", "line": 400})
def last_line_cut_off(file: str, line: int) -> str:
    return f"{file}: dropped the last line ({line}), which is cut off"


@message(example={"file": "imu.csv", "count": 2})
def comments_passed_over(file: str, count: int) -> str:
    return f"{file}: skipped {count} lines that start with # among the data"


@message(example={"attitudes": 12})
def imu_corrected(attitudes: int) -> str:
    return "the IMU's readings were corrected by its calibration" + (f" in {attitudes} attitudes" if attitudes else "")


@message(example={"accel_factor": 0.5, "compared": 4})
def imu_compared(accel_factor: float, compared: int) -> str:
    return (
        f"the accelerometer's contribution to the interval is {accel_factor:.2f} times that of an unknown device, "
        f"from {compared} results of this device with targets"
    )


@message(example={"clock_rate": 2.5e-4})
def imu_clock_stretched(clock_rate: float) -> str:
    return (
        f"the IMU's clock is {-1e6 * clock_rate:+.0f} ppm off the camera's; the IMU's timestamps were rescaled (if the "
        "camera's clock is wrong, as with a nominal frame rate, lengths are off by twice that)"
    )


state("model-metric-already", "this model is already metric: a scale of 1 confirms it")

# camera against gyroscope


@message(example={"frames_s": 20.0, "frame_hz": 30.0, "imu_s": 22.0, "imu_hz": 200.0})
def spans_and_rates(frames_s: float, frame_hz: float, imu_s: float, imu_hz: float) -> str:
    return f"the frames span {frames_s:.4g} s at {frame_hz:.3g} Hz, the gyroscope {imu_s:.4g} s at {imu_hz:.3g} Hz"


@message(example={"poses": 4})
def too_few_poses_to_align(poses: int) -> str:
    return f"{poses} poses are too few to compare with the gyroscope"


@message(advice="record ten seconds or more", joint=": ", example={"span_s": 0.5})
def poses_too_short(span_s: float) -> str:
    return f"{span_s:.2f} s of poses are too short to compare with the gyroscope"


state("too-few-intervals", "fewer than four frame intervals lie inside the IMU recording")
state(
    "no-overlap",
    "camera and IMU do not overlap at any allowed time offset",
    advice="check that the recordings belong together and that their clocks are as declared",
    joint=": ",
)
state(
    "camera-hardly-rotates",
    "the camera hardly rotates",
    advice="turn it about all three axes while recording",
    joint=": ",
)
state(
    "offset-ambiguous",
    "the rotations fit almost as well at another offset",
    advice="record longer, with rotation that does not repeat",
    joint=": ",
)


@message(
    advice="check that this IMU recording belongs to these images and that the gyroscope's columns, axes and unit are "
    "right, or record longer with rotation about all three axes",
    joint=": ",
    example={"explained": 0.2},
)
def no_offset_fits(explained: float) -> str:
    return (
        "no time offset clearly fits gyroscope and camera rotations (the gyroscope explains "
        f"{100 * max(explained, 0):.0f} % of them)"
    )


@message(advice="turn the camera about at least two axes while recording", joint=": ", example={"axis_sigma_rad": 0.5})
def rotation_axis_open(axis_sigma_rad: float) -> str:
    return f"only known to {degrees(axis_sigma_rad):.0f} deg about one axis"


state(
    "rotation-too-slow",
    "the rotation is too slow to align the clocks to a tenth of a second",
    advice="turn the camera more briskly",
    joint=": ",
)


@message(advice="record longer", joint=": ", example={"judged": 5})
def too_few_cameras_judged(judged: int) -> str:
    return f"cameras contradict the gyroscope, and with {judged} it cannot be determined which"


@message(
    advice="check that the IMU recording belongs to these images, and that the images are of one place",
    joint=": ",
    example={"largest": 20, "judged": 60},
)
def no_majority_of_cameras(largest: int, judged: int) -> str:
    return f"the gyroscope agrees with {largest} of {judged} cameras at most"


# the pixels' motion

state(
    "too-few-corners-shared",
    "consecutive frames share too few corners to track the camera's rotation",
    advice="film at a higher frame rate, or where there is more texture",
    joint=": ",
)
state("too-few-pairs-of-frames", "too few pairs of frames to compare with the gyroscope")
state("camera-hardly-turned", "the camera hardly rotated between frames")


@message(example={"explained": 0.4, "flipped": ("x",)})
def rotation_explained(explained: float, flipped: tuple[str, ...] = ()) -> str:
    said = f"the gyroscope explains {100 * max(explained, 0):.0f} % of the rotation between frames"
    if flipped:
        said += f"; the camera's {' and '.join(flipped)} axis turns the other way: check the axes"
    return said


state("frames-too-sparse", "too few frames are close in time to detect stabilisation")
state("gyroscope-elsewhere", "the gyroscope does not cover the frames")
state("camera-held-still", "the camera was held too still to detect stabilisation")


@message(example={"share": 0.95})
def quick_rotation_shown(share: float) -> str:
    return f"the frames show {100 * share:.0f} % of the fast rotation that the gyroscope measured"


@message(advice="switch stabilisation off and record again", example={"share": 0.2})
def pictures_stabilised(share: float) -> str:
    return f"{quick_rotation_shown(share)}: the video was stabilised in the camera"


@message(example={"pairs": 12})
def sign_open(pairs: int) -> str:
    return f"{pairs} pairs of frames do not determine the sign of the gyroscope"


state("neither-sign", "the frames rotate neither with the gyroscope nor against it")
state("sign-right", "the frames rotate with the gyroscope")
state(
    "sign-wrong",
    "the frames rotate against the gyroscope: its axes have the wrong sign",
    advice="check axes and rotation of [calibration] in capture.toml",
)


@message(
    advice="give [calibration] in capture.toml", joint=": ", example={"rotation_sigma_rad": 0.2, "offset_sigma_s": 0.05}
)
def calibration_too_loose(rotation_sigma_rad: float, offset_sigma_s: float) -> str:
    return (
        f"before the reconstruction it is only known to {degrees(rotation_sigma_rad):.1f} deg and "
        f"{1e3 * offset_sigma_s:.0f} ms"
    )


@message(
    example={
        "by_pixels": {"code": "camera-hardly-rotates", "values": {}},
        "quantity": "time offset",
        "by_model": {"code": "too-few-poses-to-align", "values": {"poses": 3}},
    }
)
def neither_by_pixels_nor_model(by_pixels: Said, quantity: str, by_model: Said) -> str:
    return f"{by_pixels.with_advice} (nor by a small model: {quantity} is not observable: {by_model.with_advice})"


# the readout


@message(advice="turn the camera quickly to and fro for some seconds", joint=": ", example={"readout_sigma_s": 0.004})
def readout_too_loose(readout_sigma_s: float) -> str:
    return f"the frames only determine the readout to +-{1e3 * readout_sigma_s:.1f} ms"


state(
    "readout-not-of-lines",
    "the distortion is neither along nor across the rows: the frames were warped, rotated or stabilised",
)


@message(advice="film two seconds or more of texture", joint=": ", example={"corners": 300, "pairs": 10})
def readout_of_few_corners(corners: int, pairs: int) -> str:
    return f"{corners} corners in {pairs} pairs of frames are too few"


@message(advice="turn the camera quickly to and fro for some seconds", joint=": ", example={"change_rad_s": 0.01})
def readout_of_even_rotation(change_rad_s: float) -> str:
    return f"the angular rate changes by {change_rad_s:.2g} rad/s from frame to frame, too little to estimate it"


state("readout-of-sparse-pictures", "images this far apart in time do not determine it; a video does")
state("exposure-without-images", "it needs the camera's intrinsics and images")
state("exposure-without-gyroscope", "it needs images as filmed and a gyroscope that fits them")


@message(example={"frames": 5})
def exposure_of_few_frames(frames: int) -> str:
    return f"{frames} frames with texture are too few"


@message(example={"longest_s": 0.08})
def exposure_not_bounded(longest_s: float) -> str:
    return f"any exposure up to {1e3 * longest_s:.0f} ms is possible: the camera hardly rotates, or texture is missing"


state("readout-without-gyroscope", "it needs a video and a gyroscope that fit each other")
state("readout-of-stabilised-video", "a stabilised video does not show it")

# stops and doubts


_POSES = {
    "code": "pose-convention",
    "values": {
        "read_as": ("world_from_camera", "xyzw", "centre"),
        "written_as": (("camera_from_world", "xyzw", "centre"),),
    },
}


@message(example={"found": _POSES})
def poses_of_another_convention(found: Said) -> str:
    return found.with_advice


_FOUND = {"code": "gyro-gain", "values": {"gain": 1.3}}
_OFFSET = {"declared_s": 0.01, "found_s": -0.0141, "sigma_s": 0.002, "likely": "sign"}
#: How to go on after a stop, and what that means.
_WAY_ON = "--force continues, with metres that are weak at most and may be wrong"


@message(example={"finding": _FOUND})
def found_beforehand(finding: Said) -> str:
    return f"{finding}; {finding.advice} ({finding.code})"


@message(example={"finding": _FOUND})
def stopped_by_finding(finding: Said) -> str:
    return f"{finding}; {finding.advice} ({finding.code}); {_WAY_ON}"


state("force-goes-on", f"stopped before the scale was estimated: {_WAY_ON}")


@message(example={"finding": {"code": "declared-offset", "values": _OFFSET}})
def declared_left_out(finding: Said) -> str:
    return f"{finding}; it is ignored; {finding.advice} ({finding.code})"


@message(example={"path": "accel.csv", "finding": {"code": "gravity-removed", "values": {"median_m_s2": 0.5}}})
def stopped_by_file(path: str, finding: Said) -> str:
    return f"{path}: {finding.with_advice}; --force continues without metres, using the gyroscope alone"


@message(example={"finding": _FOUND})
def forced_to_go_on(finding: Said) -> str:
    return f"{finding}; continued by --force"


@message(example={"doubts": ("its squares measure 3 % off",)})
def target_doubtful(doubts: tuple[str, ...]) -> str:
    return f"the target may differ from its description: {'; '.join(doubts)}"


@message(example={"file": "imu.csv", "times": 2})
def clock_began_anew(file: str, times: int) -> str:
    return f"{file}: the clock restarted {times} times; the timestamps were continued"
