"""Words on findings of ``diagnose``, and on what readers refuse or repair for the same reasons: one message a code.

Where only a description or a file is wrong, no advice says to record again.
"""

from __future__ import annotations

from math import degrees, pi

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.recording import spans_and_rates

_ACCELERATE = (
    "record a clip in which the camera accelerates: swing it back and forth by 20 cm or more, about once a second or "
    "faster, for ten seconds or longer"
)
_TURN_THROUGHOUT = (
    "record again and rotate the camera about all three axes throughout; camera and gyroscope cannot be aligned "
    "without rotation, unless another recording of the device gives their alignment (align, then --calibration)"
)
_MAP_AGAIN = (
    "look at these images: repeated texture, blur, or something that moved; leave them out, or map again with more "
    "overlap between images"
)
_READ_AGAIN = "correct this and run diagnose again: checks that depend on it were skipped"
_REPAIRED = "none (repaired while reading); if it is frequent, check the logger"
_PAUSES = "the scale bridges it with a larger uncertainty; close other apps or log to a faster card, and record again"
_COUNTS = "for raw counts zero and counts_per_unit, by the sensor's data sheet, in capture.toml"
_IN_G = 'set unit = "g" under [imu.accel] in capture.toml'
_IN_M_S2 = 'set unit = "m/s2" under [imu.accel] in capture.toml'
_IN_DEG = 'set unit = "deg/s" under [imu.gyro] in capture.toml'
_IN_RAD = 'set unit = "rad/s" under [imu.gyro] in capture.toml'
#: Units of readings of each sensor.
_UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s2"}

# the inertial samples


def _rates(largest_rad_s: float, median_rad_s: float, sensor_ends_rad_s: float) -> str:
    return (
        f"the gyroscope's rate is up to {largest_rad_s:.4g} rad/s, with a median of {median_rad_s:.3g} (hand-held "
        f"motion reaches about 5, sensors measure up to {sensor_ends_rad_s:g})"
    )


_GRAVITY_MOVES = "gravity, rotated by the gyroscope, is not constant, but would be"


def _advise_deg(seen_in: str, **_: float) -> str:
    return f"{_IN_DEG}, if they are" if seen_in == "usual" else _IN_DEG


def _advise_rad(seen_in: str, **_: float) -> str:
    return f"{_IN_RAD}, if the camera was hand-held" if seen_in == "scatter" else _IN_RAD


def _join_by(seen_in: str, **_: float) -> str:
    return ": " if seen_in == "gravity" else "; "


@message(
    advice=_advise_deg,
    joint=_join_by,
    example={"seen_in": "rates", "largest_rad_s": 200.0, "median_rad_s": 30.0, "sensor_ends_rad_s": 70.0},
)
def gyro_in_deg(
    seen_in: str,
    largest_rad_s: float = 0.0,
    median_rad_s: float = 0.0,
    sensor_ends_rad_s: float = 0.0,
    gain: float = 1.0,
) -> str:
    if seen_in == "rates":
        return f"{_rates(largest_rad_s, median_rad_s, sensor_ends_rad_s)}: the values are in deg/s"
    if seen_in == "gravity":
        return f"{_GRAVITY_MOVES} if the gyroscope's values were in deg/s"
    if seen_in == "camera":
        return f"the gyroscope follows the camera's rotation at {gain:.1f} times its rate: its values are in deg/s"
    return (
        f"the gyroscope's median rate is {median_rad_s:.2g} rad/s, too fast for filming: the values are probably in "
        "deg/s"
    )


@message(advice=_advise_rad, example={"seen_in": "camera", "gain": pi / 180})
def gyro_not_in_deg(seen_in: str, gain: float = 1.0, turning_rad_s: float = 0.0, scatter_rad_s: float = 0.0) -> str:
    if seen_in == "gravity":
        return f"{_GRAVITY_MOVES} at 57.3 times the rate: rad/s were converted as if they were deg/s"
    if seen_in == "camera":
        return (
            f"the gyroscope follows the camera's rotation at 1/{1 / gain:.1f} of its rate: rad/s were converted as if "
            "they "
            "were deg/s"
        )
    return (
        f"the gyroscope's rate is {turning_rad_s:.2g} rad/s with a noise of {scatter_rad_s:.1g} rad/s, less than any "
        "sensor has: rad/s were probably converted as if they were deg/s"
    )


@message(
    advice=f"set unit under [imu.gyro], and {_COUNTS}",
    example={"largest_rad_s": 9000.0, "median_rad_s": 800.0, "sensor_ends_rad_s": 70.0},
)
def gyro_unit(largest_rad_s: float, median_rad_s: float, sensor_ends_rad_s: float) -> str:
    return f"{_rates(largest_rad_s, median_rad_s, sensor_ends_rad_s)}, too large even for deg/s: these are raw counts"


def _length(median_m_s2: float) -> str:
    return f"the accelerometer's median magnitude is {median_m_s2:.4g}; gravity is about 9.8 m/s2"


@message(advice=_IN_G, example={"median_m_s2": 1.0})
def accel_in_g(median_m_s2: float) -> str:
    return f"{_length(median_m_s2)}: the values are in g"


@message(advice=_IN_M_S2, example={"median_m_s2": 96.2})
def accel_not_in_g(median_m_s2: float) -> str:
    return f"{_length(median_m_s2)}: m/s2 were converted as if they were g"


@message(advice=f"set unit under [imu.accel], and {_COUNTS}", example={"median_m_s2": 16384.0})
def accel_unit(median_m_s2: float) -> str:
    return f"{_length(median_m_s2)}: the unit is wrong, or these are raw counts"


@message(advice="give the accelerometer as it was logged", example={"median_m_s2": 19.6})
def gravity_doubled(median_m_s2: float) -> str:
    return f"{_length(median_m_s2)}: gravity was added twice, or the readings are doubled"


@message(advice="give the accelerometer with gravity in [imu.accel]", example={"median_m_s2": 0.5})
def gravity_removed(median_m_s2: float) -> str:
    return f"{_length(median_m_s2)}: gravity was taken out (a phone's linear acceleration)"


@message(
    advice="exchange the columns or files of [imu.gyro] and [imu.accel] in capture.toml",
    example={"gyro_median": 9.81, "accel_median": 0.3},
)
def sensors_exchanged(gyro_median: float, accel_median: float) -> str:
    return (
        f"the gyroscope's median magnitude is {gyro_median:.2f} and the accelerometer's {accel_median:.2f}: the two "
        "sensors are exchanged"
    )


@message(
    advice=lambda table, **_: f"record again, or give another file in [imu.{table}]",
    example={"sensor": "gyroscope", "table": "gyro", "reading": (0.0, 0.0, 0.0)},
)
def dead_sensor(sensor: str, table: str, reading: tuple[float, ...]) -> str:
    return (
        f"the {sensor} never changes ({_describe_vector(reading)} throughout): the sensor is dead or was not recorded"
    )


@message(
    advice=lambda table, **_: f"check columns of [imu.{table}] in capture.toml",
    example={"sensor": "gyroscope", "table": "gyro", "axes": ("z",), "reading": 0.0},
)
def dead_axis(sensor: str, table: str, axes: tuple[str, ...], reading: float) -> str:
    return (
        f"the {sensor}'s {' and '.join(axes)} axis never changes ({reading:.6g} throughout): the axis is dead "
        "or the wrong column"
    )


def _describe_vector(values: tuple[float, ...]) -> str:
    from numpy import array, array2string

    return array2string(array(values), precision=4)


#: Axes as capture.toml has them, and whether they are mirrored.
Setting = tuple[str, bool]


def _describe_setting(table: str, setting: Setting) -> str:
    axes, mirrored = setting
    return f'axes = "{axes}"{" and mirrored = true" if mirrored else ""} under [imu.{table}]'


def _describe_others(others: tuple[tuple[Setting, ...], ...]) -> str:
    """What is almost as likely: axes of the gyroscope, or of the accelerometer where there is a second setting."""
    said = ""
    for settings in others:
        named = (_describe_setting(table, one) for table, one in zip(("gyro", "accel"), settings, strict=False))
        said += f"; almost as likely: {', or '.join(named)}"
    return said


def _describe_accel_mirroring(axes: str) -> str:
    """What was done to an accelerometer: one of its axes mirrored, two exchanged, or neither of both."""
    if len(axes) == 1:
        return f"it is the accelerometer's {axes} axis that is mirrored"
    if len(axes) == 2:
        return f"it is the accelerometer's {axes[0]} and {axes[1]} columns that are exchanged"
    return "it is the accelerometer's axes that are mirrored"


def _advise_turned(
    gyro: Setting, accel: Setting, accel_mirroring: str, others: tuple[tuple[Setting, ...], ...] = ()
) -> str:
    return (
        f"set {_describe_setting('gyro', gyro)} in capture.toml, or, if {_describe_accel_mirroring(accel_mirroring)}, "
        f"set instead {_describe_setting('accel', accel)}{_describe_others(others)}"
    )


@message(
    advice=_advise_turned,
    joint=": ",
    example={"gyro": ("y,-x,z", False), "accel": ("-y,x,-z", True), "accel_mirroring": "", "others": ()},
)
def axes_turned(
    gyro: Setting, accel: Setting, accel_mirroring: str, others: tuple[tuple[Setting, ...], ...] = ()
) -> str:
    return f"{_GRAVITY_MOVES} if the gyroscope's axes are turned against the accelerometer's"


@message(
    advice=lambda gyro, others: f"set {_describe_setting('gyro', gyro)} in capture.toml{_describe_others(others)}",
    joint=": ",
    example={"gyro": ("-x,y,z", True), "others": ((("x,-y,z", True),),)},
)
def axes_mirrored(gyro: Setting, others: tuple[tuple[Setting, ...], ...]) -> str:
    return f"{_GRAVITY_MOVES} if the gyroscope's axes are mirrored"


state(
    "no-accelerometer",
    "the recording has a gyroscope but no accelerometer",
    advice="record the accelerometer too, gravity included; without it, frames can be deblurred but not scaled",
)


@message(
    advice="move less violently, or give the sensor a wider range",
    example={"sensor": "gyroscope", "samples": 5, "of": 4000, "axes": "xz", "counts": (2, 3), "share": 0.00125},
)
def saturated(sensor: str, samples: int, of: int, axes: str, counts: tuple[int, ...], share: float) -> str:
    by_axis = ", ".join(f"{axis}: {count}" for axis, count in zip(axes, counts, strict=True))
    return f"{samples} of {of} {sensor} samples are saturated ({by_axis})"


@message(
    advice="log at 100 Hz or more, at the app's or sensor's highest rate",
    example={"sensor": "gyroscope", "rate_hz": 25},
)
def rate_too_low(sensor: str, rate_hz: float) -> str:
    return f"the {sensor} is sampled at {rate_hz:.3g} Hz; hand motion reaches about 10 Hz"


@message(
    advice="record the raw sensor, without the app's or the device's smoothing or fusion",
    example={"sensor": "gyroscope", "scatter": 0.0001, "moving": 0.5},
)
def low_passed(sensor: str, scatter: float, moving: float) -> str:
    return (
        f"the {sensor}'s noise is only {scatter:.1g} {_UNITS[sensor]} while the device moves: its readings were "
        "smoothed"
    )


@message(
    advice="log the sensor's full resolution; write more digits into the file",
    example={"sensor": "gyroscope", "step": 0.01, "different_on_x": 40, "rounding_share_of_signal": 0.02},
)
def coarse_resolution(sensor: str, step: float, different_on_x: int, rounding_share_of_signal: float) -> str:
    return f"the {sensor}'s values have steps of {step:.3g} {_UNITS[sensor]} ({different_on_x} different values on x)"


@message(
    advice="timestamp both sensors with one clock, when they are sampled and not when they are written",
    example={"delay_s": 0.08, "delay_sigma_s": 0.004, "correlation": 0.8},
)
def sensors_offset(delay_s: float, delay_sigma_s: float, correlation: float) -> str:
    return (
        f"the accelerometer's timestamps are {1e3 * delay_s:+.0f} +- {1e3 * delay_sigma_s:.0f} ms off the gyroscope's "
        f"(gravity follows the gyroscope with a correlation of {correlation:.2f} there)"
    )


@message(
    advice="give two files of one recording, timestamped with one clock", example={"together_s": 3.0, "shorter_s": 20.0}
)
def sensors_apart(together_s: float, shorter_s: float) -> str:
    return f"gyroscope and accelerometer overlap for {max(together_s, 0):.1f} s of {shorter_s:.1f} s"


def _pauses(sensor: str, pauses: int, longest_s: float, total_s: float, step_s: float, share: float) -> str:
    return (
        f"the {sensor} pauses {pauses} times (longest {longest_s:.3f} s, {total_s:.2f} s in all; sampled every "
        f"{1e3 * step_s:.1f} ms)"
    )


for _code, _longest_s in (("short-gap", 0.2), ("long-gap", 1.5)):
    message(
        code=_code,
        advice=_PAUSES,
        example={
            "sensor": "gyroscope",
            "pauses": 3,
            "longest_s": _longest_s,
            "total_s": 2 * _longest_s,
            "step_s": 0.005,
            "share": 0.02,
        },
    )(_pauses)

# repairs: what a reader did to samples


def _each(repairs: int, each: tuple[Said, ...]) -> str:
    return "; ".join(map(str, each))


_MERGED = {"code": "rows-merged", "values": {"file": "imu.csv", "sensor": "gyroscope", "count": 2}}
for _code in ("stamps-repeated", "stamps-reordered", "empty-cells", "samples-missing", "repaired"):
    message(code=_code, advice=_REPAIRED, example={"repairs": 1, "each": (_MERGED,)})(_each)

# motion


def _acceleration(acceleration_rms_m_s2: float) -> str:
    return f"the camera's acceleration without gravity is {acceleration_rms_m_s2:.3f} m/s2 (rms)"


@message(advice=_ACCELERATE, example={"acceleration_rms_m_s2": 0.02, "turning_rms_rad_s": 0.01})
def no_motion(acceleration_rms_m_s2: float, turning_rms_rad_s: float) -> str:
    return (
        f"{_acceleration(acceleration_rms_m_s2)}, its rotation {turning_rms_rad_s:.3f} rad/s: it stood still, as on a "
        "tripod"
    )


@message(advice=_ACCELERATE, example={"acceleration_rms_m_s2": 0.02, "turning_rms_rad_s": 0.5})
def pure_rotation(acceleration_rms_m_s2: float, turning_rms_rad_s: float) -> str:
    return f"{_acceleration(acceleration_rms_m_s2)}; the camera only rotates ({turning_rms_rad_s:.2f} rad/s)"


@message(advice=_ACCELERATE, example={"acceleration_rms_m_s2": 0.02, "turning_rms_rad_s": 0.5})
def constant_velocity(acceleration_rms_m_s2: float, turning_rms_rad_s: float) -> str:
    return f"{_acceleration(acceleration_rms_m_s2)}; the camera moves at constant speed"


@message(advice=_ACCELERATE, example={"acceleration_rms_m_s2": 0.02, "turning_rms_rad_s": 0.5})
def no_acceleration(acceleration_rms_m_s2: float, turning_rms_rad_s: float) -> str:
    return (
        f"{_acceleration(acceleration_rms_m_s2)}; the camera rotates ({turning_rms_rad_s:.2f} rad/s), but stays "
        f"in place or "
        "moves at constant speed"
    )


@message(advice=_TURN_THROUGHOUT, example={"why": {"code": "camera-hardly-rotates", "values": {}}})
def rotation_too_little(
    why: Said | None = None, median_rad_s: float = 0.0, fastest_s: float = 0.0, rotation_sigma_rad: float = 0.0
) -> str:
    if why is not None:
        return str(why)
    return (
        f"the camera hardly rotates (median {median_rad_s:.3f} rad/s, fastest at {fastest_s:.0f} s), so the rotation "
        f"between camera and gyroscope is uncertain by {degrees(rotation_sigma_rad):.0f} deg"
    )


@message(advice="record ten seconds or more, with rotation about all three axes", example={"seconds": 5.0})
def offset_undecided(seconds: float) -> str:
    return f"{seconds:.1f} s are too short to find the time offset between camera and gyroscope"


# stamps


@message(advice=_READ_AGAIN, example={"path": "imu.csv", "sensor": "gyroscope"})
def stamps_reversed(path: str, sensor: str) -> str:
    return f"{path}: {sensor} timestamps run backwards; is the file written in reverse order?"


@message(
    advice=_READ_AGAIN,
    example={"path": "imu.csv", "counted": "line", "number": 30, "sensor": "gyroscope", "behind_s": 2.0},
)
def stamps_jump_back(path: str, counted: str, number: int, sensor: str, behind_s: float) -> str:
    return (
        f"{path}, {counted} {number}: the {sensor} timestamp is {behind_s:.3f} s before an earlier one; the "
        "clock was set back or a timestamp is damaged: split or correct the file there"
    )


@message(
    advice=_READ_AGAIN,
    example={"path": "imu.csv", "counted": "line", "number": 30, "sensor": "gyroscope", "repeated": 40, "samples": 400},
)
def stamps_too_coarse(path: str, counted: str, number: int, sensor: str, repeated: int, samples: int) -> str:
    return (
        f"{path}, {counted} {number}: {repeated} of {samples} {sensor} samples repeat the previous timestamp "
        "with other values; the timestamps are too coarse, or this is not the time column"
    )


@message(advice=_READ_AGAIN, example={"path": "imu.csv", "sensor": "gyroscope", "pause_s": 4000.0, "after_s": 3.0})
def stamps_damaged(path: str, sensor: str, pause_s: float, after_s: float) -> str:
    return (
        f"{path}: the {sensor} pauses for {pause_s:.0f} s after {after_s:.3f} s; a timestamp is damaged, or this is "
        "more "
        "than one recording"
    )


_TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


@message(
    advice="name the unit of the frames' times: name,t_s or t_ms, t_us, t_ns in the CSV's header, or time_unit in "
    "capture.toml",
    example={"frames_s": 2e4, "frame_hz": 0.03, "imu_s": 22.0, "imu_hz": 200.0, "factor": 1e3},
)
def time_unit(
    frames_s: float = 0.0,
    frame_hz: float = 0.0,
    imu_s: float = 0.0,
    imu_hz: float = 0.0,
    factor: float = 0.0,
    path: str = "",
    sensor: str = "",
    step_s: float = 0.0,
    slowest_s: float = 0.0,
) -> str:
    if sensor:
        direction = "smaller" if step_s > slowest_s else "larger"
        return (
            f"{path}: {sensor} samples are {step_s:.3g} s apart, which is implausible; the timestamps are probably "
            "in a "
            f"{direction} unit: set time_unit in capture.toml"
        )
    return (
        f"{spans_and_rates(frames_s, frame_hz, imu_s, imu_hz)}: the frames' times are {factor:g} times too "
        f"{'long' if factor > 1 else 'short'}: they are in {_TIME_UNITS.get(factor, 'another unit')}, but were read "
        "as seconds"
    )


@message(advice=_READ_AGAIN, example={"detail": "imu.csv, line 3: 'x' in column 2 is not a number"})
def unreadable(detail: str) -> str:
    return detail


@message(advice=_READ_AGAIN, example={"detail": "frames.csv has no header"})
def untimed(detail: str) -> str:
    return detail


@message(
    advice="leave out shared_clock = true under [timing] in capture.toml (and any time offset), or correct the "
    "timestamps; "
    "a known offset goes under [calibration]",
    example={"offset_s": 12.3, "max_offset_s": 1.0, "clocks": None},
)
def clock_offset(offset_s: float, max_offset_s: float | None, clocks: Said | None) -> str:
    if max_offset_s is not None:
        stated = f"more than the {max_offset_s:g} s of one shared clock"
    else:
        stated = "which contradicts the given time offset"
    return (
        f"camera and gyroscope agree at a time offset of {offset_s:+.3f} s, {stated}"
        f"{'' if clocks is None else f'; {clocks}'}"
    )


@message(
    advice="give frame times as the recorder timestamped them, not a frame number divided by a nominal rate; then "
    "check the timestamps of the IMU; up to 1 % is corrected",
    example={"rate": 0.004},
)
def clock_rate(rate: float) -> str:
    return (
        f"the camera's clock runs {100 * rate:+.2f} % faster than the IMU's; if the camera's is wrong, lengths "
        f"are off by "
        "twice as much"
    )


@message(advice="give the video itself as [video], or times as the recorder timestamped them", example={"rate": 1.25})
def frame_rate(rate: float) -> str:
    return (
        f"the frames fit the gyroscope at {rate:.3g} times the stated frame rate: they were timed at another frame "
        "rate than that of filming"
    )


@message(
    advice="start the IMU before the video and stop it after; the scale is estimated from what both recorded",
    example={"share": 0.8, "frames_s": 20.0, "imu_s": 16.0},
)
def imu_too_short(share: float, frames_s: float, imu_s: float, sensor: str = "") -> str:
    other = {"accelerometer": "gyroscope", "gyroscope": "accelerometer"}.get(sensor)
    alone = f"; the {other} covers the rest" if other else ""
    return f"{sensor or 'IMU'} data cover {100 * share:.0f} % of the frames' {frames_s:.1f} s{alone}"


# camera against gyroscope


@message(
    advice="switch stabilisation off in the camera and record again; the scale of such a video is wrong",
    example={"share": 0.2},
)
def stabilised(share: float | None = None, recorder_notes: str = "") -> str:
    if share is None:
        return f"the recorder notes that the video was stabilised in the camera ({recorder_notes})"
    return (
        f"the frames show {100 * share:.0f} % of the fast rotation that the gyroscope measured: the video was "
        "stabilised in the camera"
    )


@message(
    advice="check that this IMU recording belongs to these images, both timestamps and their units, and the "
    "gyroscope's columns, axes and unit",
    example={"seconds": 20.0, "why": {"code": "no-offset-fits", "values": {"explained": 0.2}}, "clocks": None},
)
def imu_does_not_fit(seconds: float, why: Said, clocks: Said | None) -> str:
    return f"{why}{'' if clocks is None else f'; {clocks}'}"


_TORN = {"code": "no-majority-of-cameras", "values": {"largest": 20, "judged": 60}}


@message(advice=_MAP_AGAIN, example={"why": (_TORN,)})
def cameras_turned(
    why: tuple[Said, ...],
    wrong: int = 0,
    seams: int = 0,
    left_out: int = 0,
    judged: int = 0,
    median_deg: float = 0.0,
) -> str:
    return "; ".join(fact.with_advice for fact in why)


@message(
    advice="take images closer together, or film; after a reconstruction, diagnose its model", example={"pairs": 5}
)
def pictures_too_few(pairs: int) -> str:
    return (
        f"only {pairs} pairs of consecutive images overlap enough to be compared with the gyroscope, and no time "
        "offset fits them"
    )


#: Rotation, order and position of a convention of poses.
Convention = tuple[str, str, str]


def describe_convention(rotation: str, order: str, position: str) -> str:
    """A convention of poses in words."""
    place = "camera centre" if position == "centre" else "translation of camera_from_world"
    return f"{rotation} quaternion in the order {' '.join(order)}, {place}"


def _describe_difference(read_as: Convention, written_as: Convention) -> str:
    """Difference between a table of poses and its reading."""
    differences = []
    if written_as[0] != read_as[0]:
        differences.append(f"the quaternions are inverted ({written_as[0]}, not {read_as[0]})")
    if written_as[1] != read_as[1]:
        differences.append(f"the quaternions are in the order {' '.join(written_as[1])}, not {' '.join(read_as[1])}")
    if written_as[2] != read_as[2]:
        centre, translation = "the camera's centre", "the translation of camera_from_world"
        stands, read = (translation, centre) if written_as[2] == "translation" else (centre, translation)
        differences.append(f"the positions are {stands}, not {read} (centre = -R' translation)")
    return " and ".join(differences)


@message(
    advice=lambda read_as, **_: f"write each pose as {describe_convention(*read_as)}",
    joint=": ",
    example={
        "read_as": ("world_from_camera", "xyzw", "centre"),
        "written_as": (("camera_from_world", "xyzw", "centre"),),
        "log_likelihood": 40.0,
    },
)
def pose_convention(
    read_as: Convention, written_as: tuple[Convention, ...], log_likelihood: float | None = None
) -> str:
    fits = "the IMU fits the camera's motion if"
    if len(written_as) > 1:
        fits = "the gyroscope fits the camera's rotations if"
    return f"{fits} {', or '.join(_describe_difference(read_as, convention) for convention in written_as)}"


@message(
    advice="check the gyroscope's unit and counts_per_unit in capture.toml, and the focal length under [camera]; "
    "calibrate-imu measures the gain",
    example={"gain": 1.31},
)
def gyro_gain(gain: float) -> str:
    return (
        f"the gyroscope measures {gain:.2f} times the rotation that the images show; a sensor's gain is right to a few "
        "per cent"
    )


def _advise_mirrored(gyro: Setting | None = None) -> str:
    if gyro is not None:
        return f"set {_describe_setting('gyro', gyro)} in capture.toml; the accelerometer is right as it is"
    return (
        'give the axes of both sensors in capture.toml, for example axes = "-x,y,z" and mirrored = true under '
        '[imu.gyro] and [imu.accel]; where the gyroscope alone measures the opposite, axes = "-x,-y,-z" and '
        "mirrored = true under [imu.gyro]"
    )


@message(advice=_advise_mirrored, example={"gyro": ("-x,y,z", True)})
def gyro_mirrored(gyro: Setting | None = None) -> str:
    return "the gyroscope fits the camera's rotation better when it is mirrored"


_ROTATIONS = {
    "inverse": (
        "; its inverse fits",
        "cam_from_imu transforms coordinates of the IMU to those of the camera (T_cam_imu of Kalibr): give the "
        "inverse of "
        "the declared one, with the translation of the inverse",
    ),
    "order": (
        "; it fits if w comes first, and was taken for last",
        "cam_from_imu_xyzw has w last: move the first number to the end",
    ),
    "axes": (
        "; it fits with the camera's y and z axes reversed",
        "the camera's axes are x right, y down and z forward: the declared rotation is to axes x right, y up and z "
        "back",
    ),
    "": (
        "",
        "correct cam_from_imu under [calibration], or leave it out to have it estimated; frames that were rotated "
        "upright are not in the sensor's orientation: extract them with ffmpeg -noautorotate",
    ),
}


@message(
    advice=lambda likely, **_: _ROTATIONS[likely][1],
    example={"angle_deg": 120.0, "sigma_deg": 0.6, "likely": "inverse"},
)
def declared_rotation(angle_deg: float, sigma_deg: float, likely: str) -> str:
    return (
        f"the declared rotation between camera and IMU is off by {angle_deg:.{0 if angle_deg >= 10 else 1}f} deg "
        f"(+-{2 * sigma_deg:.1f}){_ROTATIONS[likely][0]}"
    )


def _advise_offset(declared_s: float, likely: str, **_: float) -> str:
    if likely == "sign":
        return (
            "time offsets are those of the camera's clock minus the sensor's (the negative of Kalibr's "
            "timeshift_cam_imu): give "
            f"{-declared_s:.9g}"
        )
    if likely == "milliseconds":
        return f"time offsets are in seconds: give {1e-3 * declared_s:.9g}"
    return "leave out gyro_time_offset_s and accel_time_offset_s to have them estimated"


@message(
    advice=_advise_offset,
    example={"declared_s": 0.0641, "found_s": -0.0705, "sigma_s": 0.002, "likely": "sign"},
)
def declared_offset(declared_s: float, found_s: float, sigma_s: float, likely: str) -> str:
    other = {"sign": "; it fits with the other sign", "milliseconds": "; it fits in milliseconds"}.get(likely, "")
    return (
        f"the declared time offset is {declared_s:.4f} s, but the recording shows {found_s:.4f} s "
        f"(+-{2e3 * sigma_s:.0f} ms){other}"
    )


@message(
    advice="leave out [camera] to let COLMAP calibrate, or give the intrinsics of this video mode",
    example={"gain": 1.3, "gain_sigma": 0.02, "focal_px": 1500.0},
)
def focal_length(gain: float, gain_sigma: float, focal_px: float) -> str:
    return (
        f"with the declared focal length of {focal_px:.0f} px, the images rotate {gain:.2f} times as far as "
        f"the gyroscope "
        f"measured; about {focal_px * gain:.0f} px would fit"
    )


@message(
    advice='set axes = "-x,-y,-z" and mirrored = true under [imu.accel] in capture.toml',
    example={"correlation": -0.8, "correlation_sigma": 0.05},
)
def accel_flipped(correlation: float, correlation_sigma: float) -> str:
    return (
        "the accelerometer measures the opposite of the camera's acceleration (correlation "
        f"{correlation:.2f}): its sign is flipped"
    )


# frames

_TIMES = "give the presentation timestamps of the frames, or the video itself as [video]"


@message(
    advice="time frames by the video's presentation timestamps or the recorder's own times, never by counting; frames "
    "that were dropped or repeated must not shift the rest",
    example={"wander_s": 0.2, "worst_s": 12.0, "parts": 6, "sigmas": 8.0},
)
def frame_times_uneven(wander_s: float, worst_s: float, parts: int, sigmas: float) -> str:
    return (
        f"the frame times drift by up to {1e3 * wander_s:.0f} ms against the gyroscope, most {worst_s:.0f} s after the "
        "first frame"
    )


@message(advice=_TIMES, example={"wander_s": 0.02})
def frame_times_counted(wander_s: float) -> str:
    return (
        f"the frame times drift by up to {1e3 * wander_s:.0f} ms against the video's presentation timestamps, as "
        f"times counted "
        "at a nominal frame rate do"
    )


@message(
    advice="add the container's start to the times, or give the video itself as [video]", example={"start_s": 0.033}
)
def container_start_ignored(start_s: float) -> str:
    return f"the frame times lack the video container's start time ({1e3 * start_s:+.0f} ms)"


@message(
    advice="where readout, intrinsics or a calibration are declared, extract the frames without rotating them upright "
    "(ffmpeg -noautorotate): these refer to the sensor's rows",
    example={"angle_deg": 90},
)
def frames_turned(angle_deg: float) -> str:
    return f"the frames are rotated by {angle_deg:.0f} deg against the sensor's rows"


@message(
    advice="nothing: readout, calibration and the IMU's axes refer to the sensor's rows; intrinsics must, too",
    example={"angle_deg": 90},
)
def rotation_ignored(angle_deg: float) -> str:
    return f"the video is to be shown rotated by {angle_deg:.0f} deg; the frames are used as the sensor saw them"


@message(advice="name the video that the images were extracted from", example={"pictures": 3, "looked_for": 60})
def frames_not_in_video(pictures: int, looked_for: int) -> str:
    return f"{pictures} of {looked_for} images match no frame of the video, or several"


@message(
    advice="none if the times are right; otherwise record to a faster card or at a smaller size",
    example={"lost": 4, "frames": 600, "step_s": 0.033, "longest_s": 0.13},
)
def frames_dropped(lost: int, frames: int, step_s: float, longest_s: float) -> str:
    return (
        f"{lost} frames are missing among {frames} with a period of {1e3 * step_s:.1f} ms; the longest pause is "
        f"{longest_s:.2f} s"
    )


@message(
    advice="extract frames without filling up to a constant rate (ffmpeg -fps_mode passthrough)",
    example={"repeated": 20, "looked_at": 400},
)
def frames_repeated(repeated: int, looked_at: int) -> str:
    return f"{repeated} of {looked_at} frames repeat the one before them"


@message(
    advice="such frames get no pose and are not deblurred: leave them out, or light the scene and uncover the lens",
    example={"blank": 12, "looked_at": 300, "example": "0007.jpg"},
)
def frames_blank(blank: int, looked_at: int, example: str) -> str:
    return f"{blank} of {looked_at} examined frames are black or without texture ({example})"


@message(
    advice="film with a shorter exposure (1/200 s or less) and more light",
    example={"share": 0.7, "blur_limit_of_long_side": 0.004, "median_blur_of_long_side": 0.006, "exposure_s": 0.02},
)
def exposure_too_long(
    share: float, blur_limit_of_long_side: float, median_blur_of_long_side: float, exposure_s: float
) -> str:
    return (
        f"{100 * share:.0f} % of the frames are blurred by more than {100 * blur_limit_of_long_side:g} % of the "
        f"image's long side (median {100 * median_blur_of_long_side:.2f} %, exposure {1e3 * exposure_s:.1f} ms)"
    )


@message(
    advice="readout_s is the time from the first line to one past the last, readout_direction the direction "
    "in which the "
    "exposed line moves in the stored image: correct them under [timing], or leave both out",
    example={
        "declared_s": 0.0,
        "declared_direction": "down",
        "readout_s": 0.021,
        "sigma_s": 0.0008,
        "direction": "down",
    },
)
def declared_readout(
    declared_s: float, declared_direction: str, readout_s: float, sigma_s: float, direction: str
) -> str:
    declared = f"{1e3 * declared_s:.1f} ms, {declared_direction}" if declared_s else "0 (global shutter)"
    return (
        f"the declared readout is {declared}, but the frames show {1e3 * readout_s:.1f} ms "
        f"(+-{2e3 * sigma_s:.1f}), {direction}"
    )


def _advise_exposure(exposure_s: float | None = None, **_: object) -> str:
    if exposure_s is None:
        return "give exposure_s under [timing] in capture.toml where the recorder knows it"
    return f"write exposure_s = {exposure_s:.4f} under [timing] in capture.toml, so that frames can be deblurred"


@message(
    advice=_advise_exposure,
    example={"exposure_s": 0.0312, "exposure_sigma_s": 0.0021, "most_s": 0.0364, "most_px": 21.0, "frames": 30},
)
def exposure_unstated(
    exposure_s: float | None, exposure_sigma_s: float | None, most_s: float, most_px: float, frames: int
) -> str:
    if exposure_s is None or exposure_sigma_s is None:
        return (
            f"no exposure is stated; the blur of {frames} frames shows that it is at most {1e3 * most_s:.1f} ms, in "
            f"which the fastest rotation blurs {most_px:.1f} px"
        )
    return (
        f"no exposure is stated; the blur of {frames} frames shows {1e3 * exposure_s:.1f} +- "
        f"{1e3 * exposure_sigma_s:.1f} ms, in which the fastest rotation blurs {most_px:.1f} px"
    )


def _advise_readout(readout_s: float | None = None, direction: str = "down", **_: object) -> str:
    if readout_s is None:
        return "give readout_s under [timing] in capture.toml (0 for a global shutter), so that it is corrected"
    lines = f"readout_s = {readout_s:.4f}"
    if direction != "down":
        lines += f' and readout_direction = "{direction}"'
    return f"write {lines} under [timing] in capture.toml, so that it is corrected"


@message(
    advice=_advise_readout, example={"readout_s": 0.0213, "readout_sigma_s": 0.0004, "direction": "down", "pairs": 90}
)
def readout_unknown(
    why: Said | None = None,
    readout_s: float = 0.0,
    readout_sigma_s: float = 0.0,
    direction: str = "down",
    pairs: int = 0,
) -> str:
    said = "it is not declared whether the camera has a rolling shutter, as nearly all phones have"
    if why is not None:
        return f"{said}; {why}"
    return (
        f"{said}; frames and gyroscope show a readout of {1e3 * readout_s:.1f} +- "
        f"{1e3 * readout_sigma_s:.1f} ms{'' if readout_s else ' (global shutter)'}"
    )
