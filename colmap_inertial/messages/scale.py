"""What is said of a scale estimate: what refuses it or makes it doubtful, what was undone, what else to know."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from colmap_inertial.messages import message, state

_RECORD_INSTEAD = (
    "move the camera itself back and forth by 20 cm or more, in several directions and briskly, for 10 s or longer, "
    "with texture in view; panning, walking straight at constant speed, or a tripod cannot give a scale"
)
_SWING = "swing the camera back and forth by 20 cm or more, for 10 s or longer, with texture in view"
_TURN = "turn the camera about all of its axes while it moves"
_LONGER = "record longer, with brisker movements of the camera itself in several directions"
_CLOSE_LOOPS = "close loops while recording, or scale its parts separately"
#: So many places where poses jump, and so many cameras, are said by themselves.
_MOST_JUMPS, _MOST_CAMERAS = 5, 5
#: Intervals wider than this are none.
_KNOWN_AT_ALL = 10

#: Every part of an interval, by its key in ``ScaleEstimate.parts``: what it is, and what removes it.
PARTS: dict[str, tuple[str, str]] = {
    "accel_gain": ("the accelerometer's gain", "calibrate the IMU once (calibrate-imu)"),
    "lens": (
        "the lens and the model's shape",
        "film a target of known size, or measure the distance of two points, and scale by it",
    ),
    "accel_noise": ("the accelerometer's noise", _LONGER),
    "lost_readings": ("missing readings", "record without pauses and within the sensors' ranges"),
    "accel_bias": ("the accelerometer's bias", _TURN),
    "camera_path": (
        "the camera's path",
        f"{_LONGER}; sharper frames, more texture and more frames per second improve the path",
    ),
    "gyro": ("the gyroscope", _TURN),
    "camera_imu": (
        "the camera-IMU alignment",
        "calibrate camera and IMU once (align), or declare the known calibration",
    ),
    "clocks": (
        "the camera's or the IMU's clock rate",
        "time frames and IMU with one clock, not by a nominal frame rate",
    ),
    "gravity": ("the strength of gravity", "give the latitude"),
    "accel_faults": ("the corrected accelerometer faults", "record without the faults named in the notes"),
    "model_shape": ("the corrected shape of the model", "close loops, and film with more overlap"),
    "rolling_shutter": (
        "a rolling shutter that the model ignores",
        "declare readout_s before mapping, or refine it (--refine inertial)",
    ),
    "noise_levels": ("uncertainty of the noise estimate", "record longer"),
}


def _number(value: float | None) -> float:
    """A number that may be infinite, which JSON does not know."""
    return math.inf if value is None else value


def _advise_on_part(parts: Sequence[str], half_widths: Sequence[float]) -> str:
    return PARTS[parts[0]][1]


@message(advice=_advise_on_part, example={"parts": ("lens", "accel_gain"), "half_widths": (0.004, 0.002)})
def scale_parts(parts: Sequence[str], half_widths: Sequence[float]) -> str:
    said = [f"{PARTS[part][0]} +-{100 * width:.2g} %" for part, width in zip(parts, half_widths, strict=True)]
    return f"{', '.join(said)}; they combine as root sum of squares"


@message(example={"half_width": 0.42})
def scale_unknown(half_width: float | None) -> str:
    is_known = half_width is not None and half_width < _KNOWN_AT_ALL
    known = f"known to no better than +-{100 * (half_width or 0):.0f} %" if is_known else "not known at all"
    return (
        f"the scale is {known}: record a clip in which the camera itself speeds up and slows down "
        "(swing it back and forth by 20 cm or more, for 10 s or longer) with texture in view"
    )


@message(example={"half_width": 0.05})
def scale_interval_wide(half_width: float) -> str:
    return f"the 95 % interval is +-{100 * half_width:.1f} %: more vigorous or longer motion would narrow it"


@message(example={"rate": 0.002})
def clocks_run_apart(rate: float) -> str:
    return (
        f"the clock rates of camera and IMU differ by {100 * rate:.2g} %; if the camera's is wrong, lengths are "
        f"{200 * rate:.2g} % off: check first that frame times are those of the recorder, not "
        "counted at a nominal frame rate, then the timestamps of the IMU"
    )


# What the data cannot give.


@message(example={"quantity": "camera rotation", "why": "cameras contradict the gyroscope"})
def not_observable(quantity: str, why: Any) -> str:
    return f"{quantity}: {why.with_advice if hasattr(why, 'with_advice') else why}"


state("scale-without-accelerometer", "the recording has no accelerometer, which a metric scale needs; record it too")
state("scale-not-estimated", "not estimated")
state("fit-singular", f"camera and IMU together do not determine the scale: {_RECORD_INSTEAD}")
state("motion-not-determined", "camera and IMU do not determine its motion")
state("camera-still", "the camera does not move in the model: move it, do not only turn it")
state("recording-too-short", "the recording is too short: record at least five seconds")
state("camera-still-in-spectra", f"the camera does not move: {_SWING}")
state("motion-not-felt", f"the camera's motion is not visible in the accelerometer: {_SWING}")
state("frames-too-few", "fewer than six frames were taken while the accelerometer recorded")


@message(example={"sensor": "accelerometer"})
def sensor_saturated(sensor: str) -> str:
    return (
        f"nearly all of the {sensor}'s readings are saturated: move less violently, or set a wider range of the sensor"
    )


@message(example={"count": 3, "needed": 8})
def poses_too_few(count: int, needed: int) -> str:
    return (
        f"only {count} camera poses, an eighth of a second or more apart, lie inside the IMU recording and at least "
        f"{needed} are needed: record a longer clip, or check that both recordings belong together"
    )


@message(example={"step_s": 0.5})
def frames_too_sparse_to_differentiate(step_s: float) -> str:
    return f"frames {step_s:.2g} s apart are too sparse to differentiate positions: use the joint method"


@message(example={"needed_s": 5.0})
def never_covered(needed_s: float) -> str:
    needed = f"camera and accelerometer never overlap for {needed_s:g} s without a pause"
    return f"{needed}: record longer"


@message(example={"faults": ("the accelerometer was low-passed at about 5 Hz",)})
def path_with_faults(faults: Sequence[Any]) -> str:
    return f"these faults affect the path across a gap: {'; '.join(map(str, faults))}"


@message(example={"accel_m_s2": 0.98, "likely": "g"})
def accel_implausible(accel_m_s2: float, likely: str) -> str:
    hint = {
        "without gravity": "gravity was removed: record the raw accelerometer",
        "g": "it is in g: multiply it by 9.80665",
        "counts": "it is in mg or raw counts: convert it to m/s2",
    }[likely]
    return f"the accelerometer's median magnitude is {accel_m_s2:.3g} m/s2 instead of about 9.8; {hint}"


@message(example={"rate_rad_s": 45.0})
def gyro_in_degrees(rate_rad_s: float) -> str:
    return f"the gyroscope's median rate is {rate_rad_s:.3g} rad/s; it is in deg/s: multiply it by pi / 180"


@message(example={"poses_s": 60000.0, "imu_s": 60.0, "factor": 1000.0})
def poses_not_in_seconds(poses_s: float, imu_s: float, factor: float) -> str:
    return (
        f"the poses span {poses_s:.4g} s and the IMU {imu_s:.4g} s: the poses' times are in ms, us or ns, but were "
        f"read as seconds; divide them by {factor:g}"
    )


# What makes a fit worthless or doubtful.

state(
    "fit-not-converged",
    "the fit of camera and IMU does not converge: check that the timestamps are the sampling times, to a millisecond, "
    f"or {_RECORD_INSTEAD}",
)


@message(example={"bias_m_s2": 3.5})
def accel_bias_impossible(bias_m_s2: float) -> str:
    return (
        f"the fit needs an accelerometer bias of {bias_m_s2:.1f} m/s2, which no working sensor has: check its "
        "unit (m/s2), its sign (at rest it reads +9.8 away from the ground) and its axes"
    )


@message(example={"gain": 0.4})
def accel_gain_impossible(gain: float) -> str:
    return (
        f"the fit needs an accelerometer gain or axis error of {100 * gain:.0f} %, which no working sensor has: "
        "check its unit (m/s2), its sign (at rest it reads +9.8 away from the ground) and its axes"
    )


@message(example={"unexplained_m_s2": 1.2, "motion_m_s2": 1.5})
def accel_contradicts_motion(unexplained_m_s2: float, motion_m_s2: float) -> str:
    return (
        f"the accelerometer and the camera's motion disagree by {unexplained_m_s2:.2f} m/s2 (the motion itself is "
        f"{motion_m_s2:.2f} m/s2): check the accelerometer's sign and axes and that both recordings belong "
        f"together, or {_RECORD_INSTEAD}"
    )


@message(example={"span_s": 4.2, "needed_s": 6.0})
def clip_short(span_s: float, needed_s: float) -> str:
    return f"the clip is short ({span_s:.1f} s), so its noise is poorly known; record {needed_s:.0f} s or more"


@message(example={"gains": (0.02, 0.03, -0.02)})
def accel_gain_large(gains: Sequence[float]) -> str:
    said = ", ".join(f"{100 * gain:+.1f}" for gain in gains)
    return (
        f"the accelerometer's gain error is {said} % (x, y, z), more than usual, and is corrected: "
        "check its unit and the strength of gravity, or calibrate it (calibrate-imu)"
    )


@message(example={"gains": (0.02, 0.03, -0.02)})
def calibrated_gain_contradicted(gains: Sequence[float]) -> str:
    return (
        "the motion contradicts the IMU's calibration, which leaves the accelerometer's gain off by "
        f"{', '.join(f'{100 * gain:+.1f}' for gain in gains)} % (x, y, z): "
        "calibrate it again (calibrate-imu), or leave its calibration out"
    )


_LEVERS = {
    "inverse": "the inverse fits: imu_in_cam_m, and the last column of cam_from_imu, is the IMU in the "
    "camera's frame (T_cam_imu)",
    "sign": "it fits with the other sign: imu_in_cam_m points from the camera to the IMU",
    "millimetres": "it fits in millimetres: imu_in_cam_m, and the last column of cam_from_imu, is in metres",
    "": "correct it, or leave it out to have it estimated",
}


@message(
    example={
        "declared_m": (0.006, 0.0, 0.024),
        "found_m": (0.025, 0.005, 0.001),
        "sigma_m": 0.004,
        "likely": "inverse",
    },
)
def declared_lever_arm(declared_m: Sequence[float], found_m: Sequence[float], sigma_m: float, likely: str) -> str:
    declared, found = ("(" + ", ".join(f"{1e3 * value:.0f}" for value in arm) + ")" for arm in (declared_m, found_m))
    return (
        f"the declared lever arm is {declared} mm, but the recording shows {found} mm (+-{2e3 * sigma_m:.0f}), which "
        f"is used: {_LEVERS[likely]}"
    )


_AGAINST_TARGETS = {
    "camera": "most likely the declared intrinsics, which the images contradict, too, are wrong",
    "readout": "most likely the declared readout, which the images contradict, too, is wrong",
    "declared": "most likely a declared value of the IMU, which the recording contradicts, too, is wrong",
    "target": "most likely the target's stated size is wrong: measure its squares, and compare them with [target]",
    "accelerometer": "most likely the accelerometer's gain is off: calibrate it (calibrate-imu)",
    "": "measure the target's squares, compare them with [target], and see the other reasons",
}


@message(example={"target": "checkerboard:8x6:0.04", "error_pct": -24.1, "sigmas": 18.0, "likely": "camera"})
def target_contradicts_scale(target: str, error_pct: float, sigmas: float, likely: str) -> str:
    return (
        f"the target in the images ({target}) contradicts the scale: its lengths are {error_pct:+.1f} % off, "
        f"{sigmas:.0f} standard deviations of both: {_AGAINST_TARGETS[likely]}"
    )


@message(example={"gain": 0.02, "excess": 0.015})
def accel_gain_doubtful(gain: float, excess: float) -> str:
    strong = "too strong" if excess > 0 else "too weak"
    gains, lengths = ("high", "too long") if gain > 0 else ("low", "too short")
    return (
        f"measured gravity is {100 * abs(excess):.1f} % {strong} (gain or bias error); the accelerometer's gain may be "
        f"{100 * abs(gain):.1f} % {gains}, and lengths {lengths} by as much: check its unit, turn the camera about all "
        "axes while it moves, or calibrate it (calibrate-imu)"
    )


@message(example={"found": {"code": "accel-gain-large", "values": {"gains": (0.01, 0.015, -0.01)}}})
def counted_in_interval(found: object) -> str:
    return f"{found} (included in the interval)"


@message(example={"lag_s": 0.04})
def accel_lags_as_filtered(lag_s: float) -> str:
    return (
        f"the accelerometer lags by {1e3 * lag_s:.0f} ms, as if low-passed at about "
        f"{1 / (2 * math.pi * lag_s):.2g} Hz (included in the interval): record it unfiltered (raw)"
    )


@message(example={"moves_log": 0.012})
def fit_hardly_converged(moves_log: float) -> str:
    return (
        f"the fit of camera and IMU converges slowly: the scale still moves by {100 * moves_log:.1f} % (included in "
        "the interval): check that the timestamps are the sampling times, to a millisecond"
    )


@message(example={"delay_s": 0.06})
def accel_delay_undone(delay_s: float) -> str:
    return (
        f"the accelerometer's timestamps are {1e3 * delay_s:+.0f} ms off the gyroscope's (corrected by the fit): "
        "timestamp "
        "both sensors when they are sampled"
    )


@message(example={"sensor": "gyroscope", "share": 0.02})
def readings_cut_off(sensor: str, share: float) -> str:
    return (
        f"{100 * share:.2g} % of the {sensor}'s readings are saturated and count as missing: "
        "move less violently, or set a wider range of the sensor"
    )


@message(example={"bias_m_s2": 2.1})
def spectral_bias_large(bias_m_s2: float) -> str:
    return f"the fit needs an accelerometer bias of {bias_m_s2:.1f} m/s2: check its axes, sign and unit"


state("half-without-scale", "each half of the recording must give a scale by itself, and one does not")


@message(example={"difference": 0.05})
def halves_differ(difference: float) -> str:
    return f"the scale of the recording's second half differs by {100 * difference:+.1f} % from that of the first"


# What is wrong with the accelerometer's readings.


@message(example={"cutoff_hz": 5.0})
def accel_low_passed(cutoff_hz: float) -> str:
    return (
        f"the accelerometer was low-passed at about {cutoff_hz:.2g} Hz, which is corrected as far as possible: record "
        "it unfiltered (raw)"
    )


@message(example={"cutoff_hz": 5.0})
def path_smoothed(cutoff_hz: float) -> str:
    return (
        "the camera's path is smoother than the accelerometer's, as if low-passed at about "
        f"{cutoff_hz:.2g} Hz: give unsmoothed poses, and all readings of the accelerometer (under vibration, held or "
        "dropped readings look the same)"
    )


@message(example={"delays_s": (0.002, -0.001, -0.001)})
def accel_axes_apart(delays_s: Sequence[float]) -> str:
    delays = ", ".join(f"{axis} {1e3 * d:+.1f}" for axis, d in zip("xyz", delays_s, strict=True))
    return (
        f"the accelerometer's axes are sampled at different times ({delays} ms from their mean), which was "
        "corrected: give the timestamps of each axis, or a recording that was not resampled axis by axis"
    )


@message(example={"rate": 2e-4})
def accel_clock_apart(rate: float) -> str:
    return (
        f"the accelerometer's clock rate is {1e6 * rate:+.0f} ppm off the gyroscope's (corrected): timestamp both "
        "sensors with one clock"
    )


# What is wrong with the model's shape.


@message(example={"stretch": 0.02, "axis": (1.0, 0.0, 0.0)})
def model_stretched(stretch: float, axis: Sequence[float]) -> str:
    x, y, z = axis
    return (
        f"the reconstruction is stretched by {100 * stretch:.1f} % along ({x:.2f}, "
        f"{y:.2f}, {z:.2f}); lengths are right on average: check the focal "
        "length and the lens, and film from more sides"
    )


def _describe_growth(growth: float, sigma: float) -> str:
    return f"{100 * abs(growth):.1f} +- {196 * sigma:.1f} % {'longer' if growth > 0 else 'shorter'}"


@message(example={"growth": 0.03, "sigma": 0.004})
def scale_grows(growth: float, sigma: float) -> str:
    return (
        f"the reconstruction's scale drifts: lengths are {_describe_growth(growth, sigma)} at the end than at the "
        f"beginning: {_CLOSE_LOOPS}"
    )


@message(example={"growth": 0.03, "sigma": 0.004, "since_s": 12.0, "first": True})
def scale_breaks(growth: float, sigma: float, since_s: float, first: bool) -> str:
    return (
        f"the reconstruction's scale jumps: lengths are {_describe_growth(growth, sigma)} "
        f"{'before' if first else 'after'} {since_s:.0f} s than in the rest, whose scale is used, as it is better "
        f"known: {_CLOSE_LOOPS}"
    )


@message(example={"lowest": -0.02, "highest": 0.03, "part_s": 10.0})
def scale_varies(lowest: float, highest: float, part_s: float) -> str:
    return (
        f"the reconstruction's scale varies from {100 * lowest:+.1f} to {100 * highest:+.1f} % in "
        f"parts of {part_s:.0f} s (see drift in the JSON): {_CLOSE_LOOPS}"
    )


# What else one should know.


@message(example={"since_s": (1.5, 7.2)})
def poses_jump(since_s: Sequence[float]) -> str:
    places = "one place" if len(since_s) == 1 else f"{len(since_s)} places"
    since = ", ".join(f"{at_s:.1f}" for at_s in since_s[:_MOST_JUMPS])
    more = " s, ..." if len(since_s) > _MOST_JUMPS else " s"
    return f"poses jump at {places} ({since}{more}); negligible"


@message(example={"offset_s": 120.5})
def clocks_without_common_time(offset_s: float) -> str:
    return f"camera and IMU clocks do not overlap; the rotations give an offset of {offset_s:.2f} s"


@message(example={"sensor": "gyroscope", "count": 3, "total_s": 0.5, "longest_s": 0.2})
def sensor_pauses(sensor: str, count: int, total_s: float, longest_s: float) -> str:
    times = "once" if count == 1 else f"{count} times"
    longest = "" if count == 1 else f", at most {longest_s:.2f} s at once"
    return f"the {sensor} pauses {times}, for {total_s:.2f} s in all{longest}"


@message(example={"covered": 280, "frames": 300})
def frames_without_imu(covered: int, frames: int) -> str:
    return f"IMU data cover {covered} of {frames} frames; the scale is estimated from those"


@message(example={"calibrated_c": 20.0, "recorded_c": 41.0, "gain_change": 0.004})
def imu_warmer(calibrated_c: float, recorded_c: float, gain_change: float) -> str:
    return (
        f"the IMU was calibrated at {calibrated_c:.0f} °C and recorded at {recorded_c:.0f} °C: its gains may have "
        f"changed by {100 * gain_change:.1f} % (included in the interval); calibrate it at the temperature of use"
    )


@message(example={"sensor": "gyroscope", "scatter_s": 0.002})
def stamps_scatter(sensor: str, scatter_s: float) -> str:
    return (
        f"the {sensor}'s timestamps jitter by {1e3 * scatter_s:.1f} ms: timestamp samples when they are taken, not "
        "when they "
        "arrive"
    )


@message(example={"sensor": "accelerometer", "share": 0.5})
def readings_repeat(sensor: str, share: float) -> str:
    return (
        f"{100 * share:.0f} % of the {sensor}'s readings repeat the previous one (held, or read faster than the sensor "
        "samples): record at the sensor's own rate"
    )


# What cameras are, against the gyroscope.


def _name_some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_CAMERAS} more" if len(names) > _MOST_CAMERAS else ""
    return f"{', '.join(names[:_MOST_CAMERAS])}{more}"


@message(example={"names": ("0007.jpg", "0031.jpg"), "deviations_deg": (12.0, 31.0), "cameras": 60})
def cameras_left_out(names: Sequence[str], deviations_deg: Sequence[float], cameras: int) -> str:
    named = [f"{name} ({deg:.0f} deg)" for name, deg in zip(names, deviations_deg, strict=True)]
    return f"{len(names)} of {cameras} cameras contradict the gyroscope and were left out: {_name_some(named)}"


@message(example={"names": ("0007.jpg",), "cameras": 60})
def cameras_misplaced(names: Sequence[str], cameras: int) -> str:
    return (
        f"the positions of {len(names)} of {cameras} cameras contradict the accelerometer; these were left "
        f"out: {_name_some(names)}"
    )


@message(example={"before": "0030.jpg", "after": "0031.jpg", "turn_deg": 25.0})
def model_torn(before: str, after: str, turn_deg: float) -> str:
    return f"the model breaks between {before} and {after}: its parts are rotated by {turn_deg:.0f} deg to each other"


@message(example={"joined": 20, "kept": 40, "cameras": 60})
def torn_parts_joined(joined: int, kept: int, cameras: int) -> str:
    return f"the IMU joined {joined} cameras of other parts to the largest, {kept} of {cameras}"


@message(example={"kept": 40, "cameras": 60})
def largest_part_kept(kept: int, cameras: int) -> str:
    return f"the scale is that of the largest part, {kept} of {cameras} cameras; the other parts were left out"


state("other-parts-left-out", "the other parts were left out")


@message(example={"names": ("0007.jpg",)})
def cameras_registered_again(names: Sequence[str]) -> str:
    return f"registered again, now consistent: {', '.join(names)}"


@message(example={"reasons": ("the camera hardly accelerates",)})
def scale_refused(reasons: Sequence[Any]) -> str:
    return "; ".join(map(str, reasons))


state("rigs-not-registered-again", "images of several cameras are not registered again")


@message(example={"facts": ("a model is torn", "the other parts were left out")})
def cameras_judged(facts: Sequence[Any]) -> str:
    return "; ".join(map(str, facts))


# What a refinement, a rolling shutter and joined models make of a scale.


@message(example={"gains": (0.02, 0.03, -0.02)})
def refinement_gain_large(gains: Sequence[float]) -> str:
    said = ", ".join(f"{100 * gain:+.1f}" for gain in gains)
    return f"the refinement finds accelerometer gain errors of {said} % (x, y, z): calibrate it"


@message(example={"difference": 0.05, "half_width": 0.02})
def refined_scale_differs(difference: float, half_width: float) -> str:
    return (
        f"the refinement changes the scale by {100 * difference:+.1f} %, beyond the +-{100 * half_width:.1f} % of the "
        "first estimate: the reconstruction bends or drifts, or the accelerometer's gain is off; a target or a known "
        "distance tells which is right"
    )


@message(example={"declared_px": 700.0, "found_px": 530.0, "sigma_px": 4.0})
def declared_focal_length(declared_px: float, found_px: float, sigma_px: float) -> str:
    return (
        f"the declared focal length is {declared_px:.0f} px, but the images fit {found_px:.0f} "
        f"+-{2 * sigma_px:.0f} px better; a wrong one bends the model and changes its size: leave out [camera] to let "
        "COLMAP calibrate, or give the intrinsics of this video mode"
    )


@message(
    example={
        "declared": "PINHOLE",
        "found": "OPENCV",
        "distortion": [0.06, -0.11, 0.0, 0.001],
        "shift_px": 3.2,
    }
)
def declared_distortion(declared: str, found: str, distortion: Sequence[float], shift_px: float) -> str:
    numbers = ", ".join(f"{value:.3f}" for value in distortion)
    return (
        f"the declared camera ({declared}) has no distortion, but the images show {shift_px:.1f} px of it "
        f"({found} with about {numbers}), which bends the model and changes its size: declare it, or leave out "
        "[camera] to let COLMAP calibrate"
    )


@message(example={"readout_s": 0.02, "sigma_s": 0.001, "direction": "down"})
def rolling_shutter_ignored(readout_s: float, sigma_s: float, direction: str, declared_global: bool = False) -> str:
    found = f"read out line by line in {1e3 * readout_s:.1f} +- {1e3 * sigma_s:.1f} ms ({direction})"
    if declared_global:
        return (
            f"the declared readout is 0 (global shutter), but the images were {found}: correct readout_s and "
            "readout_direction, or leave them out"
        )
    return (
        f"the images were {found}, which the model ignores: declare readout_s and readout_direction before mapping, or "
        "refine it (--refine inertial)"
    )


@message(example={"readout_s": 0.03, "half_width": 0.4})
def rolling_shutter_possible(readout_s: float, half_width: float | None) -> str:
    return (
        f"a rolling shutter of up to {1e3 * readout_s:.0f} ms cannot be ruled out, which makes the scale uncertain by "
        f"{100 * _number(half_width):.0f} %: declare readout_s (0 for a global shutter)"
    )


state(
    "rolling-shutter-unknown",
    "the images show too little to detect a rolling shutter: declare readout_s (0 for a global shutter)",
)


@message(example={"colmap_index": 2, "images": 30, "why": ("its scale is known to +-12.0 % only",)})
def joined_part_weak(colmap_index: int, images: int, why: Sequence[Any]) -> str:
    return f"its part of {images} images, COLMAP's model {colmap_index}: {'; '.join(map(str, why))}"


@message(example={"half_width": 0.12})
def part_scale_wide(half_width: float | None) -> str:
    return f"its scale is only known to +-{100 * _number(half_width):.1f} %"


@message(example={"images": 12, "frames": 60})
def images_without_time(images: int, frames: int) -> str:
    return f"{images} of the model's {frames} images have no frame time and were left out"


@message(example={"timed": 1, "frames": 60, "example": "a.jpg", "named": "0001.jpg"})
def names_disagree(timed: int, frames: int, example: str, named: str) -> str:
    return (
        f"{timed} of the model's {frames} images have a frame time; "
        f"names must agree (the model has {example!r}, the frame times {named!r})"
    )


state("fragment", "a fragment of few images")


@message(example={"images": 4})
def fragment_too_small(images: int) -> str:
    return f"a fragment of {images} images: too small to be made metric (--fragments scales it anyway)"


# Static calibration of an IMU.

_LAY_STILL = (
    "lay the device still on its six sides, then leaning on six of its edges, five seconds each, on something solid, "
    "and turn it over in between"
)


def _list_axes(axes: Sequence[str]) -> str:
    return axes[0] if len(axes) == 1 else ", ".join(axes[:-1]) + " and " + axes[-1]


state("no-accelerometer-for-gravity", "the recording has no accelerometer; record it along with the gyroscope")
state("rests-without-accelerometer", "the recording has no accelerometer; record it, too")


@message(example={"attitudes": 4, "needed": 6})
def attitudes_too_few(attitudes: int, needed: int) -> str:
    rested = (
        "no rest was found" if attitudes == 0 else f"the device rested in {attitudes} attitude{'s' * (attitudes > 1)}"
    )
    return f"{rested}; at least {needed} are needed (twelve are good): {_LAY_STILL}"


@message(example={"axes": ("x", "z")})
def attitudes_alike(axes: Sequence[str]) -> str:
    return (
        f"the attitudes are too similar to determine the accelerometer's gain along {_list_axes(axes)}. Each "
        f"axis must point up once and down once: {_LAY_STILL}"
    )


@message(example={"attitudes": 7, "misalignment": 0.01, "needed": 9})
def misalignments_unknown(attitudes: int, misalignment: float, needed: int) -> str:
    return (
        f"{attitudes} attitudes determine the accelerometer's gains and biases, not its misalignments (known to "
        f"{100 * misalignment:.1f} %); {needed} attitudes would"
    )


state("misalignment-unknown", f"the attitudes leave a misalignment of the accelerometer unknown: {_LAY_STILL}")


@message(example={"axis": "x", "sigma": 0.004})
def accel_gain_unsure(axis: str, sigma: float) -> str:
    return f"the accelerometer's gain along {axis} is only known to +-{196 * sigma:.2g} %: {_LAY_STILL}"


state(
    "gyro-contradicts-rests",
    "the gyroscope contradicts the rests whatever its gains: its axes or its unit are wrong "
    "(run colmap-inertial diagnose); it was not calibrated",
)


@message(example={"axes": ("y",)})
def gyro_gain_unsure(axes: Sequence[str]) -> str:
    return (
        f"the rotations between the rests do not determine the gyroscope's gain about {_list_axes(axes)}, "
        f"which keeps its "
        "prior; rotate the device about that axis, lying on its side, from one rest to the next"
    )


@message(example={"of": "turns", "times": 5.0})
def rests_disagree(of: str, times: float) -> str:
    return (
        f"{of} scatter {times:.0f} times more than the sensor's noise: the device moved or the support gave "
        f"way, or the "
        "sensor clips or warms up (included in the intervals)"
    )


@message(example={"drift_m_s2": 0.02})
def accel_bias_drifted(drift_m_s2: float) -> str:
    return (
        f"the accelerometer's bias drifted by {drift_m_s2:.2g} m/s2 during the recording, probably while "
        f"warming up: let "
        "the device warm up for some minutes, then record again"
    )


@message(example={"sigma": 0.001})
def gravity_assumed(sigma: float) -> str:
    return (
        f"the strength of gravity is assumed, which makes the gains uncertain by +-{196 * sigma:.1g} %: give the "
        "latitude (and height) of the place"
    )


# What smoothing and comparing with targets need.

state("no-result-with-target", "no result was compared with a target")

state("imu-in-no-interval", "the IMU recorded during none of the frame intervals")


@message(example={"count": 3})
def poses_too_few_to_smooth(count: int) -> str:
    return f"{count} poses are too few to tell motion from noise"
