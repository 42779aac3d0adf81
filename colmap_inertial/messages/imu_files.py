"""Words of inertial recordings: files of recorders, and what they lack."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state

state("not-readable-as-described", "cannot be read as described")
state("frames-not-readable", "describes frames that cannot be read")


@message(example={"name": "gopro", "known": ("auto", "gopro")})
def imu_format_unknown(name: str, known: Sequence[str]) -> str:
    return f'unknown IMU format "{name}"; known: {", ".join(known)}'


@message(
    advice="describe its files under [imu.gyro] and [imu.accel] in a capture.toml",
    example={"layouts": ("a table of samples", "a GoPro video")},
)
def no_known_recording(layouts: Sequence[str]) -> str:
    return f"not an inertial recording in a known format ({'; '.join(layouts)})"


@message(
    advice="where the IMU was recorded beside it, describe both in a capture.toml ([video] and [imu]); without one, a "
    "target or a known distance gives metres (reconstruct VIDEO OUT --scale-from target)",
    example={"tracks": ("vide avc1", "soun mp4a")},
)
def video_without_imu(tracks: Sequence[str]) -> str:
    return f"is a video without an IMU track in a known format; its tracks: {', '.join(tracks) or 'none'}"


state("begins-with-text", "begins with text")
state("no-mp4-index", "has no index of an MP4 or QuickTime file")


@message(example={"fault": {"code": "begins-with-text", "values": {}}})
def named_like_a_video(fault: Said) -> str:
    return f"has the name of a video, but not a known video format: it {fault}"


@message(example={"name": "mine", "package": "my-formats", "detail": "KeyError: 'a'"})
def imu_format_failed(name: str, package: str, detail: str) -> str:
    return f"the IMU format {name} of the package {package} failed: {detail}"


@message(advice="give the folder of one", example={"folders": ("imu0", "imu1")})
def several_imus(folders: Sequence[str]) -> str:
    return f"holds several IMUs ({', '.join(folders)})"


state("pose-not-finite", "a pose has a value that is not finite")


@message(example={"length": 2.0})
def quaternion_of_other_length(length: float) -> str:
    return f"the quaternion has length {length:.4g}, not 1; are these the columns of a rotation?"


state(
    "dji-video",
    (
        "is a DJI video: it holds orientations but no accelerometer, so it can give no scale and no gravity. "
        "What still works: COLMAP's own reconstruction, in its arbitrary units; deblurring and the rolling "
        "shutter, with a gyroscope log of another device in the same housing. For metres, record an IMU "
        "beside it, or film a target of known size"
    ),
)
state("inertial-scale-files-missing", "holds no gyroscope.txt and accelerometer.txt")
state("euroc-files-missing", "holds no mav0/imu0/data.csv, imu0/data.csv or data.csv")
state(
    "no-separate-tables",
    "does not hold exactly one table of a gyroscope and one of an accelerometer, each with its unit",
)
state("one-pose", "holds one pose; a trajectory needs at least two")


@message(advice="poses must be in order of time", example={"path": "poses.txt", "line": 7})
def pose_times_back(path: str, line: int) -> str:
    return f"{path}, line {line}: the time does not increase"


@message(advice="give the one to read", example={"count": 0, "files": ()})
def not_one_gyro_file(count: int, files: Sequence[str]) -> str:
    return f"holds {count} files *gyro.csv of OpenCamera-Sensors ({', '.join(files) or 'none'})"


@message(
    advice="export TotalAcceleration.csv, Gravity.csv or AccelerometerUncalibrated.csv as well (in the app: Total "
    "Acceleration, Gravity, or Accelerometer Uncalibrated)",
    example={"table": "Accelerometer.csv"},
)
def sensor_logger_without_gravity(table: str) -> str:
    return f"its {table} is without gravity"


@message(example={"kind": "ValueError", "detail": "bad magic"})
def bag_not_readable(kind: str, detail: str) -> str:
    return f"cannot be read as a ROS recording: {kind} {detail}"


@message(
    advice=lambda sensor, topics, name: (
        f'keep one: topic = "{topics[0]}" under [imu] in a capture.toml, or rosbags-convert --src {name} --dst one '
        f"--include-topic {topics[0]}"
    ),
    example={"sensor": "gyroscope", "topics": ("/imu", "/imu2"), "name": "a.bag"},
)
def bag_of_several_topics(sensor: str, topics: Sequence[str], name: str) -> str:
    return f"holds several topics with a {sensor} ({', '.join(topics)})"


@message(example={"last_words": "", "signal": 6, "exit_code": None})
def telemetry_parser_failed(last_words: str, signal: int | None, exit_code: int | None) -> str:
    ended = f"exit code {exit_code}" if signal is None else f"signal {signal}"
    return f"telemetry-parser cannot read it: {last_words or f'it ended with {ended}'}"


state("no-frames", "holds no frames")
state("frame-without-time", "a frame has no time")
state("sample-not-three-numbers", "a sample that is not three numbers")
state("frame-number-not-one", "a frame's number is not a number")
state("number-without-end", "a number that does not end")


@message(example={"type": 7})
def wire_type(type: int) -> str:
    return f"wire type {type}"


@message(example={"length": 100, "left": 12})
def field_beyond_message(length: int, left: int) -> str:
    return f"a field of {length} bytes where {left} are left"


# what is wrong with an entry of GoPro's telemetry


@message(example={"key": "GYRO", "size": 5, "type": "b's'"})
def gpmf_samples_of_type(key: str, size: int, type: str) -> str:
    return f"{key} holds samples of {size} bytes of type {type}"


@message(example={"key": "GPS9", "size": 5, "types": "'lls'"})
def gpmf_samples_of_types(key: str, size: int, types: str) -> str:
    return f"{key} holds samples of {size} bytes of the types {types}"


@message(example={"key": "b'GYRO'", "byte": 100, "length": 5000, "left": 40})
def gpmf_entry_beyond_payload(key: str, byte: int, length: int, left: int) -> str:
    return f"the entry {key} at byte {byte} of the payload states {length} bytes; {left} left"


@message(example={"key": "GYRO", "channels": 3, "scale": (0.0,)})
def gpmf_scale(key: str, channels: int, scale: Sequence[float]) -> str:
    return f"{key} has {channels} channels and the scale {list(scale)}"


@message(example={"key": "GYRO", "old": 3, "new": 6})
def gpmf_channels_change(key: str, old: int, new: int) -> str:
    return f"{key} changes from {old} to {new} channels"


@message(example={"letters": "YY"})
def not_three_axes(letters: str) -> str:
    return f"{letters!r} does not name three axes"


state("gpmf-one-payload", "a single payload does not give the sampling rate")
state("gpmf-stamps-do-not-increase", "the timestamps of the payloads do not increase")


@message(example={"table": "gyro_accel.csv"})
def mars_table_missing(table: str) -> str:
    return f"holds no {table} of MARS logger"


state("camm-without-gyroscope", "its CAMM track holds no gyroscope samples (type 2)")
state("camm-sample-short", "is damaged: a sample of the camm track is shorter than its header")


@message(example={"packet": 3, "type": 2})
def camm_packet_cut_off(packet: int, type: int) -> str:
    return f"is damaged: packet {packet} of type {type} of its camm track is cut off"


@message(example={"key": "GYRO", "channels": 2})
def gopro_channels(key: str, channels: int) -> str:
    return f"the {key} stream has {channels} channels, not 3"


state(
    "gopro-without-gyroscope",
    "its telemetry holds no gyroscope (GYRO)",
    advice="HERO5 and later write one; older cameras have none",
    joint=": ",
)


@message(example={"key": "GPS5", "channels": 2})
def gopro_positions_channels(key: str, channels: int) -> str:
    return f"the {key} stream has {channels} channels"


@message(example={"key": "GYRO", "detail": "the timestamps of the payloads do not increase"})
def gopro_stream_untimed(key: str, detail: str) -> str:
    return f"the {key} stream cannot be timed: {detail}"


@message(example={"key": "GYRO", "unit": "rpm", "known": ("rad/s", "deg/s")})
def gopro_unit(key: str, unit: str, known: tuple[str, ...]) -> str:
    return f"the {key} stream is in {unit!r}; known: {', '.join(known)}"


@message(example={"key": "GYRO", "detail": "'YY' does not name three axes"})
def gopro_axes_damaged(key: str, detail: str) -> str:
    return f"the {key} stream's axes are damaged: {detail}"


@message(example={"detail": "x"})
def gopro_settings_damaged(detail: str) -> str:
    return f"its user data (GPMF) is damaged: {detail}"


@message(example={"detail": "x"})
def gopro_readout_damaged(detail: str) -> str:
    return f"the readout time is damaged: {detail}"


@message(example={"payload": 3, "byte": 4000, "detail": "x"})
def gpmf_payload_damaged(payload: int, byte: int, detail: str) -> str:
    return f"is damaged in telemetry payload {payload} at byte {byte}: {detail}"


state("no-intrinsics-matrix", "is no 3x3 matrix of intrinsics")
state("sensor-logger-table-missing", "holds no Gyroscope.csv of Sensor Logger")
state("sensor-logger-rows-missing", "holds no rows of Sensor Logger with sensor, time, x, y, z")
state("sensor-logger-without-gyroscope", "holds no gyroscope of Sensor Logger")
state(
    "sensor-logger-platform-of-rows-unknown",
    "the row of metadata that states iOS or Android is missing; the accelerometer's sign differs between the two",
    advice=(
        'describe its rows under [imu.gyro] and [imu.accel] in a capture.toml, with where = ["sensor", '
        '"Gyroscope"] (["name", "gyroscope"] in messages), time = "time", time_unit = "ns", columns = ["x", '
        '"y", "z"], and for iOS axes = "-x,-y,-z" with mirrored = true under [imu.accel]'
    ),
)
state(
    "sensor-logger-platform-unknown",
    "Metadata.csv, which states iOS or Android, is missing; the accelerometer's sign differs between the two",
    advice="add it, or describe the tables under [imu.gyro] and [imu.accel] in a capture.toml",
)
state("bag-without-imu", "holds no sensor_msgs/Imu messages")


@message(example={"topics": ("/imu", "/imu2")})
def bag_without_moving_gyroscope(topics: tuple[str, ...]) -> str:
    return f"none of its IMU topics ({', '.join(topics)}) has a gyroscope that moves"


state(
    "bag-files-packed",
    "its files are compressed as a whole",
    advice="decompress them (zstd -d) and change metadata.yaml accordingly",
)
state("bag-messages-packed", "its messages are compressed individually", advice="convert it with rosbags-convert")
state("bag-index-repeats", "is damaged: its index lists chunks more than once")


@message(
    advice="if this is intended, convert it with rosbags-convert, without compression and with its IMU topics only",
    example={"most_mb": 500, "size": 100000},
)
def bag_out_of_proportion(most_mb: int, size: int) -> str:
    return f"unpacks from {size} bytes to more than {most_mb} MB"


@message(example={"compression": "snappy"})
def bag_compression_unknown(compression: str) -> str:
    return f"is compressed by {compression!r}, which is not supported"


state("bag-chunk-followed", "is damaged: bytes follow the end of a chunk")


@message(example={"camera": "Insta360 OneR"})
def telemetry_without_gyroscope(camera: str) -> str:
    return f"holds no gyroscope; {camera} writes one where gyro data is switched on"


state("counts-without-gyroscope", "holds no gyroscope; its camera writes one if gyro data is switched on")


@message(example={"sensor": "gyroscope", "detail": "'Unit'"})
def telemetry_not_understood(sensor: str, detail: str) -> str:
    return f"telemetry-parser gives {sensor} data in an unknown form: {detail}"


state("no-gyroscope-samples", "holds no gyroscope samples")


@message(example={"sample": 3, "bytes": 8})
def imu_sample_bytes(sample: int, bytes: int) -> str:
    return f"IMU sample {sample} has {bytes} bytes where three floats have 12"


# what needs an extra


@message(example={"path": "imu.bag"})
def ros_recording(path: str) -> str:
    return f"{path} is a ROS recording"


@message(example={"path": "a.insv"})
def needs_telemetry_parser(path: str) -> str:
    return f"{path} needs telemetry-parser"
