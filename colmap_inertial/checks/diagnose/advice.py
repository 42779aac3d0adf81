"""Advice for each finding: one table by code, which the terminal, the report and ``diagnosis.json`` share."""

from __future__ import annotations

from collections.abc import Mapping

_BOTH_MIRRORED = (
    'give the axes of both sensors in capture.toml, for example axes = "-x,y,z" and mirrored = true under '
    '[imu.gyro] and [imu.accel]; where the gyroscope alone measures the opposite, axes = "-x,-y,-z" and '
    "mirrored = true under [imu.gyro]"
)
_ACCELERATE = (
    "record a clip in which the camera itself speeds up and slows down: swing it back and forth by 20 cm or more, "
    "a few times a second or so, for ten seconds or longer"
)
_TURN = "turn the camera about all three axes while recording"
_MAP_AGAIN = (
    "look at these images: repeated texture, blur, or something that moved; leave them out, or map again with more "
    "overlap between images"
)
_READ_AGAIN = "correct this and run diagnose again: checks that depend on it were skipped"
_REPAIRED = "nothing: it was repaired while reading; if there is much of it, look at the logger"
_COUNTS = "zero and counts_per_unit, by the sensor's data sheet"
_PAUSES = "the scale bridges it, less surely; close other apps, or log to a faster card, and record again"
_TIMES = "give the presentation stamps of the frames, or the video itself as [video]"

#: Advice by code. Where only a description or a file is wrong, it never says to record again. A finding may say it in
#: more detail, with the values that the data show, and never something else.
ADVICE: Mapping[str, str] = {
    # the inertial samples
    "gyro-in-deg": 'set unit = "deg/s" under [imu.gyro] in capture.toml',
    "gyro-not-in-deg": 'set unit = "rad/s" under [imu.gyro] in capture.toml',
    "gyro-unit": f"set unit under [imu.gyro] in capture.toml, and for raw counts {_COUNTS}",
    "accel-in-g": 'set unit = "g" under [imu.accel] in capture.toml',
    "accel-not-in-g": 'set unit = "m/s2" under [imu.accel] in capture.toml',
    "accel-unit": f"set unit under [imu.accel] in capture.toml, and for raw counts {_COUNTS}",
    "gravity-doubled": "give the accelerometer as it was logged",
    "gravity-removed": "give the accelerometer with gravity in [imu.accel]",
    "sensors-exchanged": "exchange the columns or files of [imu.gyro] and [imu.accel]",
    "axes-turned": "correct axes under [imu.gyro] or [imu.accel] in capture.toml",
    "axes-mirrored": "correct axes under [imu.gyro] or [imu.accel] in capture.toml",
    "dead-sensor": "record again, or give another file in capture.toml",
    "dead-axis": "check columns of the sensor in capture.toml",
    "no-accelerometer": (
        "record the accelerometer too, gravity included; without it there is deblurring, but no scale"
    ),
    "saturated": "move less violently, or give the sensor a wider range",
    "rate-too-low": "log at 100 Hz or more, at the app's or sensor's highest rate",
    "low-passed": "record the raw sensor, without the app's or the device's smoothing or fusion",
    "coarse-resolution": "log the sensor's full resolution; write more digits into the file",
    "sensors-offset": "stamp both sensors by one clock, when they were sampled and not when they were written",
    "sensors-apart": "give two files of one recording, stamped by one clock",
    "short-gap": _PAUSES,
    "long-gap": _PAUSES,
    # motion
    "no-motion": _ACCELERATE,
    "pure-rotation": _ACCELERATE,
    "constant-velocity": _ACCELERATE,
    "no-acceleration": _ACCELERATE,
    "rotation-too-little": (
        f"record again and {_TURN}, all through; the axes of camera and gyroscope cannot be compared without, unless a "
        "livelier recording of the device gives them (align, then --calibration)"
    ),
    "offset-undecided": "record ten seconds or more, with rotation about all three axes",
    # stamps
    "time-unit": (
        "name the unit of the frames' times: name,t_s or t_ms, t_us, t_ns in the CSV's header, or time_unit in "
        "capture.toml"
    ),
    "stamps-reversed": _READ_AGAIN,
    "stamps-jump-back": _READ_AGAIN,
    "stamps-damaged": _READ_AGAIN,
    "stamps-too-coarse": _READ_AGAIN,
    "stamps-repeated": _REPAIRED,
    "stamps-reordered": _REPAIRED,
    "empty-cells": _REPAIRED,
    "samples-missing": _REPAIRED,
    "repaired": _REPAIRED,
    "unreadable": _READ_AGAIN,
    "untimed": _READ_AGAIN,
    "clock-offset": (
        "leave out shared_clock = true under [timing] in capture.toml (and any time offset), or correct the stamps; a "
        "known offset goes under [calibration]"
    ),
    "clock-rate": (
        "give frame times as the recorder stamped them, not a frame number divided by a nominal rate; then check the "
        "stamps of the IMU; up to 1 % is corrected"
    ),
    "frame-rate": "give the video itself as [video], or times as the recorder stamped them",
    "imu-too-short": "start the IMU before the video and stop it after; the scale rests on what both recorded",
    # camera against gyroscope
    "stabilised": "switch stabilisation off in the camera and record again; the scale of such a video is wrong",
    "imu-does-not-fit": (
        "check that this IMU recording belongs to these images, both time stamps and their units, and the "
        "gyroscope's columns, axes and unit"
    ),
    "cameras-turned": _MAP_AGAIN,
    "pictures-too-few": "take pictures closer together, or film; after a reconstruction diagnose its model",
    "pose-convention": "read the poses by the convention that the message names",
    "gyro-gain": (
        "check the gyroscope's unit and counts_per_unit in capture.toml, and the focal length under [camera]; "
        "calibrate-imu measures the gain"
    ),
    "gyro-mirrored": _BOTH_MIRRORED,
    "declared-rotation": (
        "correct cam_from_imu under [calibration]; frames that were turned upright are not in the sensor's "
        "orientation: cut them without (ffmpeg -noautorotate)"
    ),
    "focal-length": "leave out [camera] to let COLMAP calibrate, or give the intrinsics of this very video mode",
    "accel-flipped": 'set axes = "-x,-y,-z" and mirrored = true under [imu.accel] in capture.toml',
    # frames
    "frame-times-uneven": (
        "time frames by the video's presentation stamps or the recorder's own times, never by counting; frames that "
        "were dropped or repeated must not shift the rest"
    ),
    "frame-times-counted": _TIMES,
    "container-start-ignored": "add the container's start to the times, or give the video itself as [video]",
    "frames-turned": (
        "where readout, intrinsics or a calibration are declared, cut the pictures without turning them upright "
        "(ffmpeg -noautorotate): these refer to the sensor's rows"
    ),
    "rotation-ignored": (
        "nothing: readout, calibration and the IMU's axes refer to the sensor's rows; intrinsics must, too"
    ),
    "frames-not-in-video": "name the video that the pictures were cut from",
    "frames-dropped": "nothing, where the times are right; record to a faster card or at a smaller size",
    "frames-repeated": "cut frames without filling up to a constant rate (ffmpeg -fps_mode passthrough)",
    "exposure-too-long": (
        "film with a shorter exposure (1/200 s or less) and more light; what is blurred is deblurred"
    ),
    "readout-unknown": "give readout_s under [timing] in capture.toml (0 for a global shutter), so that it is undone",
}
