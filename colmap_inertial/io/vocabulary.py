"""What columns of inertial recordings are called: words, and the exports whose columns have a meaning by definition.

Facts from the documentation and the sources of the loggers; ``docs/devices/loggers.csv`` names them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# --- words ------------------------------------------------------------------------------------------------------------

#: Words that name a sensor by themselves, small letters, and those that do in pairs.
GYRO = {"pqr", "gyro", "gyr", "gyros", "gyroscope", "omega", "angvel", "angularvelocity", "angularrate", "rotationrate"}
GYRO |= {"drehrate", "winkelgeschwindigkeit", "gyroskop", "角速度", "陀螺仪"}
ACCEL = {"acc", "acce", "accel", "accels", "accelerometer", "acceleration", "accs", "specificforce", "加速度"}
ACCEL |= {"beschleunigung"}
GYRO_PAIRS = {("angular", "velocity"), ("angular", "rate"), ("ang", "vel"), ("rotation", "rate"), ("rot", "rate")}
ACCEL_PAIRS = {("specific", "force"), ("g", "force")}
#: How copies of sensor_msgs/Imu call both, whose linear acceleration holds gravity.
ROS_PAIRS = {
    (("angular", "velocity"), ("linear", "acceleration")),
    (("ang", "vel"), ("lin", "acc")),
    (("ang", "vel"), ("lin", "accel")),
}
#: Letters that do where nothing but an axis stands beside them.
SHORT_GYRO, SHORT_ACCEL = {"g", "w"}, {"a", "f"}

#: Words that make an acceleration one without gravity, or gravity alone, or one in a frame that does not turn along.
NO_GRAVITY = {"linear", "lineare", "lin", "user", "free", "dynamic", "linacc", "linaccel", "freeacc", "usracc"}
GRAVITY = {"gravity", "grav", "gravityvector"}
WORLD = {"world", "earth", "global", "ned", "enu", "nav"}
#: Words that make a column something else.
OTHER = {
    *("mag", "magn", "magnet", "magnetic", "magnetometer", "compass", "quat", "quaternion", "euler", "roll", "pitch"),
    *("yaw", "angle", "angles", "orient", "orientation", "attitude", "temp", "temperature", "bias", "drift", "offset"),
    *("covariance", "cov", "std", "var", "variance", "sigma", "integral", "delta", "pressure", "baro", "lat", "lon"),
    *("latitude", "longitude", "altitude", "position", "pos", "norm", "magnitude", "setpoint", "accuracy", "clip"),
    *("clipping", "status", "err", "error", "jerk", "uncertainty", "dt", "convariance", "acceptance", "battery"),
    *("relative", "interval", "heading", "speed", "rms", "mean", "calibration", "motor", "rc", "axis p"),
}
#: Words of columns that are taken only where there is nothing better, and of no consequence.
LESSER = {
    "uncal",
    "uncalibrated",
    "raw",
    "filt",
    "filtered",
    "unfilt",
    "unfiltered",
    "lowpass",
    "smoothed",
    "stab",
    "wr",
}

TIME = {
    *("t", "time", "timestamp", "timestamps", "stamp", "ts", "elapsed", "clock", "epoch", "tick", "ticks", "utc"),
    *("sampletimefine", "timesec", "timens", "timeus", "timems", "timecode", "datetime", "millis", "micros", "date"),
    *("sensortime", "zeit", "tiempo", "tijd", "时间", "時間", "片上时间"),
}
NO_TIME = {"zone", "timezone", "uncertainty", "exposure", "bias", "leap", "week", "relative", "interval", "delta"}
#: Words of clocks that are read where the sensor was, and of those that are read later.
NEAR_CLOCK = {"sensor", "sample", "hardware", "device", "chip", "boot", "reboot", "header", "stamp", "fine", "start"}
NEAR_CLOCK |= {"片上时间"}
LATE_CLOCK = {"app", "phone", "host", "system", "logging", "arrival", "received", "rx", "gps", "utc", "backend", "txt"}
LATE_CLOCK |= {"motion"}
COUNTERS = {"counter", "count", "sample", "index", "frame", "row", "packet", "iteration", "seq", "number", "id", "n"}
#: Parts of a time in two columns, by unit.
PARTS = {
    "s": {"sec", "secs", "seconds"},
    "ns": {"nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"},
    "us": {"usec", "usecs", "microsec", "microsecs", "microseconds"},
    "ms": {"msec", "msecs", "millisec", "millisecs", "milliseconds"},
}

#: Words that say nothing of what was measured.
VALUES = ("measurement", "value", "values", "data", "reading", "v")
#: What rows of several sensors in one table are called in their column of sensors, small letters and digits alone.
GYRO_ROWS = {"gyro", "gyr", "gyroscope", "uncalgyro", "gyroscopeuncalibrated", "androidsensorgyroscope"}
ACCEL_ROWS = {"accel", "acce", "acc", "accelerometer", "uncalaccel", "accelerometeruncalibrated", "totalacceleration"}

#: Names of columns that tell one device's rows from another's, where a table holds several.
INSTANCES = {
    *("i", "instance", "imu", "imuid", "sensor", "sensorid", "device", "deviceid", "devicename", "address", "mac"),
    *("node", "nodename", "设备名称"),
}

#: A sampling rate that lines before the header state.
RATE = r"(?:rate|freq\w*|odr|sampling|\bat)\b\W{0,3}(?:\w+\W{1,3}){0,2}?(\d+(?:\.\d+)?)\s*(?:Hz|samples/s|sps)\b"


# --- exports ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Times:
    """Columns whose sum is the time, and the unit of each."""

    columns: tuple[str, ...]
    units: tuple[str, ...]
    counts_per_second: float | None = None


@dataclass(frozen=True, kw_only=True)
class Part:
    """Columns of one sensor; ``{}`` stands for the axis.

    Attributes
    ----------
    columns
        Pattern of the three names.
    unit
        By the definition of the export; ``None`` where its settings decide.
    times
        The first whose columns are there counts.
    counts_per_unit
        ``None`` where only the recording knows.
    axes
        As in a capture.toml.
    are_dated_otherwise
        Whether exports whose stamps are dates may have other axes, which stay open.
    about
        What the recording does not say, in words.
    """

    columns: str
    unit: str | None
    times: tuple[Times, ...]
    counts_per_unit: float | None = 1.0
    axes: str = ""
    are_dated_otherwise: bool = False
    about: str = ""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Columns that one program writes.

    Attributes
    ----------
    name
        Of the program.
    gyro, accel
        Its sensors.
    letters
        How axes are written.
    needs, preamble
        More columns, or a text before the header, that tell it from others.
    is_defined
        Whether its definition leaves nothing open; otherwise it is a proposal that a person confirms.
    preamble_counts
        The key before the header that says how many counts make one g.
    """

    name: str
    gyro: Part
    accel: Part
    letters: tuple[str, str, str] = ("x", "y", "z")
    needs: tuple[str, ...] = ()
    preamble: str = ""
    is_defined: bool = True
    preamble_counts: str = ""


_ROS_TIMES = (
    Times(columns=("field.header.stamp",), units=("ns",)),
    Times(columns=("header.stamp.secs", "header.stamp.nsecs"), units=("s", "ns")),
    Times(columns=("header.stamp.sec", "header.stamp.nanosec"), units=("s", "ns")),
    Times(columns=("header/stamp/sec", "header/stamp/nanosec"), units=("s", "ns")),
    Times(columns=("stamp.sec", "stamp.nanosec"), units=("s", "ns")),
    Times(columns=("header.stamp",), units=("s",)),
    Times(columns=("%time",), units=("ns",)),
    Times(columns=("__time",), units=("s",)),
)
_US, _NS, _MS = (
    (Times(columns=(name,), units=(unit,)),) for name, unit in (("timestamp", "us"), ("timestamp", "ns"), ("t", "ms"))
)
_BLACKBOX_TIMES = (Times(columns=("time (us)",), units=("us",)), Times(columns=("time",), units=("us",)))
_BETAFLIGHT = "Betaflight and INAV write gyroADC in deg/s, Cleanflight and Baseflight counts"


def _ros(name: str, before: str, dot: str) -> Layout:
    return Layout(
        name=name,
        gyro=Part(columns=f"{before}angular_velocity{dot}{{}}", unit="rad/s", times=_ROS_TIMES),
        accel=Part(columns=f"{before}linear_acceleration{dot}{{}}", unit="m/s2", times=_ROS_TIMES),
    )


def _blackbox(preamble: str, unit: str | None) -> Layout:
    return Layout(
        name="Blackbox",
        preamble=preamble,
        letters=("0", "1", "2"),
        needs=("loopiteration",),
        gyro=Part(columns="gyroadc[{}]", unit=unit, times=_BLACKBOX_TIMES, about="" if unit else _BETAFLIGHT),
        accel=Part(
            columns="accsmooth[{}]",
            unit="g",
            times=_BLACKBOX_TIMES,
            counts_per_unit=None,
            about="acc_1G of the log's header: 2048 on most boards, 512 or 4096 on others",
        ),
        is_defined=False,
        preamble_counts="acc_1G",
    )


_SENSORLOG = "accelerometeracceleration{}(g)"
LAYOUTS = (
    _ros("sensor_msgs/Imu (rostopic)", "field.", "."),
    _ros("sensor_msgs/Imu", "", "."),
    _ros("sensor_msgs/Imu", "", "/"),
    Layout(
        name="Gyroflow",
        gyro=Part(columns="org_gyro_{}", unit="deg/s", times=(Times(columns=("timestamp_ms",), units=("ms",)),)),
        accel=Part(columns="org_acc_{}", unit="m/s2", times=(Times(columns=("timestamp_ms",), units=("ms",)),)),
    ),
    Layout(
        name="Kalibr",
        gyro=Part(columns="omega_{}", unit="rad/s", times=_NS),
        accel=Part(columns="alpha_{}", unit="m/s2", times=_NS),
    ),
    Layout(
        name="PX4",
        letters=("0", "1", "2"),
        gyro=Part(columns="gyro_rad[{}]", unit="rad/s", times=_US),
        accel=Part(
            columns="accelerometer_m_s2[{}]",
            unit="m/s2",
            times=(Times(columns=("timestamp", "accelerometer_timestamp_relative"), units=("us", "us")), *_US),
        ),
    ),
    Layout(
        name="ArduPilot",
        gyro=Part(columns="gyr{}", unit="rad/s", times=(Times(columns=("timeus",), units=("us",)),)),
        accel=Part(columns="acc{}", unit="m/s2", times=(Times(columns=("timeus",), units=("us",)),)),
        needs=("timeus",),
    ),
    Layout(
        name="SensorLog",
        gyro=Part(
            columns="gyrorotation{}(rad/s)",
            unit="rad/s",
            times=(Times(columns=("gyrotimestamp_sincereboot(s)",), units=("s",)),),
        ),
        accel=Part(
            columns=_SENSORLOG,
            unit="g",
            axes="-x,-y,-z",
            times=(Times(columns=("accelerometertimestamp_sincereboot(s)",), units=("s",)),),
        ),
    ),
    Layout(  # in JSON
        name="SensorLog",
        gyro=Part(
            columns="gyrorotation{}", unit="rad/s", times=(Times(columns=("gyrotimestamp_sincereboot",), units=("s",)),)
        ),
        accel=Part(
            columns="accelerometeracceleration{}",
            unit="g",
            axes="-x,-y,-z",
            times=(Times(columns=("accelerometertimestamp_sincereboot",), units=("s",)),),
        ),
    ),
    Layout(
        name="Movella DOT",
        preamble=r"DeviceTag|Movella|Xsens DOT|Measurement Mode",
        needs=("packetcounter",),
        gyro=Part(columns="gyr_{}", unit="deg/s", times=(Times(columns=("sampletimefine",), units=("us",)),)),
        accel=Part(columns="acc_{}", unit="m/s2", times=(Times(columns=("sampletimefine",), units=("us",)),)),
    ),
    Layout(
        name="MT Manager",
        needs=("packetcounter",),
        gyro=Part(
            columns="gyr_{}",
            unit=None,
            times=(Times(columns=("sampletimefine",), units=(), counts_per_second=10_000),),
            about="MT Manager writes rad/s or deg/s, as set on export",
        ),
        accel=Part(
            columns="acc_{}",
            unit="m/s2",
            times=(Times(columns=("sampletimefine",), units=(), counts_per_second=10_000),),
        ),
        is_defined=False,
    ),
    Layout(
        name="Physics Toolbox",
        gyro=Part(columns="w{}", unit="rad/s", times=(Times(columns=("time",), units=("s",)),)),
        accel=Part(
            columns="gf{}",
            unit="g",
            times=(Times(columns=("time",), units=("s",)),),
            are_dated_otherwise=True,
            about="x,y,z of Android; -x,-y,-z, with mirrored = true, of iOS, whose sign is that of gravity",
        ),
        is_defined=False,
    ),
    Layout(
        name="RunCam and its kin",
        preamble="",
        needs=("time",),
        gyro=Part(
            columns="r{}",
            unit="deg/s",
            counts_per_unit=None,
            times=(Times(columns=("time",), units=("ms",)),),
            about="65.536 where the range is 500 deg/s (RunCam 5 Orange, iFlight, Mobius), 32.768 for 1000 (Thumb)",
        ),
        accel=Part(columns="a{}", unit="g", counts_per_unit=16384.0, times=(Times(columns=("time",), units=("ms",)),)),
        is_defined=False,
    ),
    Layout(
        name="OpenLog Artemis",
        needs=("imu_degc",),
        gyro=Part(columns="g{}", unit="deg/s", times=(Times(columns=("rtcdate", "rtctime"), units=("date",)),)),
        accel=Part(
            columns="a{}",
            unit="g",
            counts_per_unit=1000.0,
            times=(Times(columns=("rtcdate", "rtctime"), units=("date",)),),
        ),
        is_defined=False,
    ),
    Layout(
        name="PicoQuake",
        preamble="PicoQuake",
        needs=("count",),
        gyro=Part(columns="g_{}", unit="deg/s", times=()),
        accel=Part(columns="a_{}", unit="g", times=()),
    ),
    _blackbox(r"(?i)betaflight|inav|emuflight|rotorflight", "deg/s"),
    _blackbox("", None),
)


@dataclass(frozen=True, kw_only=True)
class Bare:
    """A table without header that its rows tell.

    Attributes
    ----------
    name
        Of the program.
    width
        Of a row.
    time, units, gyro, accel
        Numbers of columns from 1.
    texts
        Columns that hold words.
    """

    name: str
    width: int
    time: tuple[int, ...]
    units: tuple[str, ...]
    gyro: tuple[int, int, int]
    accel: tuple[int, int, int]
    gyro_unit: str = "rad/s"
    accel_unit: str = "m/s2"
    texts: tuple[int, ...] = field(default=())


#: ``ros2 topic echo --csv`` of sensor_msgs/Imu: stamp, frame, orientation (4, 9), velocity (3, 9), acceleration (3, 9).
ROS2_ECHO = Bare(
    name="sensor_msgs/Imu (ros2 topic echo --csv)",
    width=40,
    time=(1, 2),
    units=("s", "ns"),
    gyro=(17, 18, 19),
    accel=(29, 30, 31),
    texts=(3,),
)
