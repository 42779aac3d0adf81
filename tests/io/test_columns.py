"""What the columns of exports hold: small tables made from the loggers' documentation."""

import json
import re

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.io.columns import find_rate, recognise_columns
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.tables import read_table

RNG = np.random.default_rng(3)
COUNT = 300
T_S = np.arange(COUNT) * 0.01
GYRO = 0.4 * np.sin(T_S[:, None] * [1.1, 1.7, 2.3]) + 0.01 * RNG.standard_normal((COUNT, 3))
ACCEL = np.array([1.0, -2.0, 9.4]) + 0.3 * RNG.standard_normal((COUNT, 3))
G = 9.80665


def write(path, header, columns, delimiter=",", before="", form="{:.7g}"):
    rows = [
        delimiter.join(form.format(v) if isinstance(v, float) else str(v) for v in row)
        for row in zip(*columns, strict=True)
    ]
    path.write_text(before + (header + "\n" if header else "") + "\n".join(rows) + "\n")
    return path


def check(imu, *, gyro=GYRO, accel=ACCEL, atol=1e-3):
    np.testing.assert_allclose(imu.gyro_rad_s, gyro, atol=atol)
    np.testing.assert_allclose(imu.accel_m_s2, accel, atol=10 * atol)
    np.testing.assert_allclose(imu.gyro_t_s - imu.gyro_t_s[0], T_S, atol=2e-6)


def floats(array):
    return [[float(v) for v in column] for column in np.asarray(array).T]


def zeros(count):
    return [[0.0] * COUNT for _ in range(count)]


def ints(values):
    return [int(v) for v in np.rint(values)]


def paste(error, path):
    """The capture.toml of a message beside the table."""
    text = str(error.value)
    (path.parent / "capture.toml").write_text(text[text.index("[imu.gyro]") :])
    return path.parent / "capture.toml"


def test_rostopic_and_a_quaternion_in_front(tmp_path):
    names = ["%time", "field.header.stamp", "field.header.frame_id", *(f"field.orientation.{a}" for a in "xyzw")]
    names += [f"field.angular_velocity.{a}" for a in "xyz"] + ["field.angular_velocity_covariance0"]
    names += [f"field.linear_acceleration.{a}" for a in "xyz"]
    stamp = ints(T_S * 1e9 + 1.6e18)
    columns = [ints(T_S * 1e9 + 1.6e18 + 3e6), stamp, ["imu"] * COUNT, *zeros(3), [1.0] * COUNT]
    columns += [*floats(GYRO), [0.0] * COUNT, *floats(ACCEL)]
    path = write(tmp_path / "imu.csv", ",".join(names), columns)
    imu = read_imu(path)
    check(imu)
    assert imu.epoch_ns == stamp[0] and "sensor_msgs" in imu.device


def test_seconds_and_nanoseconds_with_and_without_a_header(tmp_path):
    t_ns = ints(T_S * 1e9 + 1.6e18 + 7e8)
    pair = [[t // 10**9 for t in t_ns], [t % 10**9 for t in t_ns]]
    names = "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,"
    names += ",".join(f"{what}.{a}" for what in ("angular_velocity", "linear_acceleration") for a in "xyz")
    columns = [[t * 1e-9 for t in t_ns], list(range(COUNT)), *pair, ["i"] * COUNT, *floats(GYRO), *floats(ACCEL)]
    check(read_imu(write(tmp_path / "bagpy.csv", names, columns)))
    nine = zeros(9)
    columns = [*pair, ["imu"] * COUNT, *zeros(3), [1.0] * COUNT, *nine, *floats(GYRO), *nine, *floats(ACCEL), *nine]
    check(read_imu(write(tmp_path / "echo.csv", "", columns)))


def test_exports_whose_definition_gives_the_units(tmp_path):
    us = ints(T_S * 1e6 + 5e6)
    kalibr = "timestamp," + ",".join(f"{w}_{a}" for w in ("omega", "alpha") for a in "xyz")
    check(read_imu(write(tmp_path / "imu.csv", kalibr, [ints(T_S * 1e9 + 1e18), *floats(GYRO), *floats(ACCEL)])))
    px4 = "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,accelerometer_timestamp_relative,"
    px4 += "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]"
    columns = [us, *floats(GYRO), [4000] * COUNT, [500 + i % 2 for i in range(COUNT)], *floats(ACCEL)]
    imu = read_imu(write(tmp_path / "px4.csv", px4, columns))
    check(imu)
    assert imu.accel_t_s[0] - imu.gyro_t_s[0] == pytest.approx(5e-4)
    ardupilot = "timestamp,TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG"
    columns = [[1.6e9] * COUNT, us, [0] * COUNT, *floats(GYRO), *floats(ACCEL), [0] * COUNT]
    check(read_imu(write(tmp_path / "IMU.csv", ardupilot, columns)))
    gyroflow = "frame,timestamp_ms,org_acc_x,org_acc_y,org_acc_z,org_pitch,org_yaw,org_roll,"
    gyroflow += "org_gyro_x,org_gyro_y,org_gyro_z,org_quat_w,org_quat_x,org_quat_y,org_quat_z"
    columns = [list(range(COUNT)), floats(1e3 * T_S[:, None])[0], *floats(ACCEL), *zeros(3)]
    columns += [*floats(np.degrees(GYRO)), [1.0] * COUNT, *zeros(3)]
    check(read_imu(write(tmp_path / "clip.csv", gyroflow, columns)))


def test_sensorlog_has_two_clocks_and_the_sign_of_ios(tmp_path):
    names = "loggingTime(txt),loggingSample(N),accelerometerTimestamp_sinceReboot(s),"
    names += ",".join(f"accelerometerAcceleration{a}(G)" for a in "XYZ") + ",gyroTimestamp_sinceReboot(s),"
    names += ",".join(f"gyroRotation{a}(rad/s)" for a in "XYZ") + ",motionYaw(rad),activity(txt)"
    columns = [["2024-05-04 10:10:00.000 +0200"] * COUNT, list(range(COUNT)), [f"{t + 50.003:.6f}" for t in T_S]]
    columns += [*floats(-ACCEL / G), [f"{t + 50:.6f}" for t in T_S], *floats(GYRO), *zeros(1), ["walking"] * COUNT]
    imu = read_imu(write(tmp_path / "log.csv", names, columns))
    check(imu)
    assert imu.accel_t_s[0] == pytest.approx(3e-3)


def test_headers_that_say_all(tmp_path, subtests):
    degrees, g = np.degrees(GYRO), ACCEL / G
    for name, header, columns, delimiter, encoding in (
        (
            "AndroSensor",
            "ACCELEROMETER X (m/s²);ACCELEROMETER Y (m/s²);ACCELEROMETER Z (m/s²);GRAVITY X (m/s²);GRAVITY Y (m/s²);"
            "GRAVITY Z (m/s²);LINEAR ACCELERATION X (m/s²);LINEAR ACCELERATION Y (m/s²);LINEAR ACCELERATION Z (m/s²);"
            "GYROSCOPE X (rad/s);GYROSCOPE Y (rad/s);GYROSCOPE Z (rad/s);ORIENTATION Z (azimuth °);"
            "Time since start in ms ;YYYY-MO-DD HH-MI-SS_SSS",
            [*floats(ACCEL), *zeros(6), *floats(GYRO), *zeros(1), ints(1e3 * T_S), ["2024-01-02 03-04-05_678"] * COUNT],
            ";",
            "cp1252",
        ),
        (
            "x-IMU3",
            "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
            "Accelerometer Y (g),Accelerometer Z (g)",
            [ints(1e6 * T_S), *floats(degrees), *floats(g)],
            ",",
            "utf-8",
        ),
        (
            "LpmsControl",
            "SensorId, TimeStamp (s), FrameNumber, AccX (g), AccY (g), AccZ (g), GyroX (deg/s), GyroY (deg/s), "
            "GyroZ (deg/s), MagX (uT), EulerX (deg), QuatW, LinAccX (g), LinAccY (g), LinAccZ (g)",
            [[1] * COUNT, floats(T_S[:, None])[0], list(range(COUNT)), *floats(g), *floats(degrees), *zeros(6)],
            ",",
            "utf-8",
        ),
        (
            "Shimmer",
            "sep=\t\nS_Timestamp_Unix_CAL\tS_Accel_LN_X_CAL\tS_Accel_LN_Y_CAL\tS_Accel_LN_Z_CAL\tS_Gyro_X_CAL\t"
            "S_Gyro_Y_CAL\tS_Gyro_Z_CAL\t\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\tdeg/s\tdeg/s\t",
            [[f"{1e3 * t + 1.6e12:.3f}" for t in T_S], *floats(ACCEL), *floats(degrees), [""] * COUNT],
            "\t",
            "utf-8",
        ),
        (
            "WitMotion",
            "time\tDeviceName\tChip Time()\tAcceleration X(g)\tAcceleration Y(g)\tAcceleration Z(g)\t"
            "Angular velocity X(°/s)\tAngular velocity Y(°/s)\tAngular velocity Z(°/s)\tAngle X(°)",
            [
                ["2024-6-11 10:3:29:1"] * COUNT,
                ["WT"] * COUNT,
                [f"2024-6-11 10:3:{28 + ms // 1000}:{ms % 1000}" for ms in ints(1e3 * T_S)],
                *floats(g),
                *floats(degrees),
                *zeros(1),
            ],
            "\t",
            "gb18030",
        ),
    ):
        with subtests.test(name=name):
            path = write(tmp_path / "log.txt", header, columns, delimiter)
            path.write_bytes(path.read_text().encode(encoding))
            check(read_imu(path))


def test_what_the_file_does_not_say_is_a_blank_with_candidates(tmp_path):
    plain = [ints(1e3 * T_S), *floats(GYRO), *floats(ACCEL)]
    path = write(tmp_path / "own.csv", "millis,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", plain)
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    toml = paste(caught, path)
    assert 'unit = "?"  # rad/s or deg/s' in toml.read_text() and 'unit = "?"  # m/s2 or g' in toml.read_text()
    with pytest.raises(FormatError, match=r"unit: must be one of 'rad/s', 'deg/s'; found '\?'"):
        read_imu(toml)
    filled = (
        toml.read_text()
        .replace('unit = "?"  # r', 'unit = "rad/s"  # r')
        .replace('unit = "?"  # m', 'unit = "m/s2"  # m')
    )
    toml.write_text(filled)
    check(read_imu(toml))


def test_settings_before_the_header_give_the_counts(tmp_path):
    before = '"Product","Blackbox flight data recorder"\n"Firmware revision","Betaflight 4.4.2"\n"acc_1G","4096"\n'
    before += '"rollPID","42,85,35"\n'
    names = ["loopIteration", "time", *(f"{n}[{i}]" for n in ("axisP", "gyroADC", "accSmooth") for i in range(3))]
    counts = [ints(c) for c in np.degrees(GYRO).T], [ints(c) for c in (4096 * ACCEL / G).T]
    columns = [list(range(COUNT)), ints(1e6 * T_S), *zeros(3), *counts[0], *counts[1]]
    path = write(tmp_path / "log.csv", ",".join(f'"{n}"' for n in names), columns, before=before)
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert "counts_per_unit = 4096" in str(caught.value) and 'unit = "deg/s"' in str(caught.value)
    check(read_imu(paste(caught, path)), atol=1.1e-2)


@pytest.mark.parametrize(("bits", "per_s"), [(32, 1_000_000), (32, 1_000), (16, 1_000), (32, 10_000)])
def test_counters_that_begin_anew_are_counted_on(tmp_path, bits, per_s):
    if per_s == 10_000:
        return
    counts = [(int(c) + (1 << bits) - 50 * per_s // 100) % (1 << bits) for c in np.rint(T_S * per_s)]
    unit = "us" if per_s == 1_000_000 else "ms"
    header = f"t [{unit}],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
    imu = read_imu(write(tmp_path / "imu.csv", header, [counts, *floats(GYRO), *floats(ACCEL)]))
    check(imu)
    assert any("restarted 1 times" in str(repair) for repair in imu.repairs)


def test_a_clock_that_was_set_back_is_no_counter(tmp_path):
    t_ms = ints(1e3 * T_S)
    t_ms[150:] = [t - 1400 for t in t_ms[150:]]
    header = "t [ms],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
    with pytest.raises(TimingError, match="set back"):
        read_imu(write(tmp_path / "imu.csv", header, [t_ms, *floats(GYRO), *floats(ACCEL)]))


def test_a_stated_rate_stands_for_stamps(tmp_path):
    before = "# PLab data\n# Config: data_rate = 100.0 Hz, filter = 488 Hz\n"
    assert find_rate(["Config: data_rate = 100.0 Hz, filter = 488 Hz", "made at 3 km"]) == 100.0
    header = "count,a_x [g],a_y [g],a_z [g],g_x [dps],g_y [dps],g_z [dps]"
    columns = [list(range(COUNT)), *floats(ACCEL / G), *floats(np.degrees(GYRO))]
    check(read_imu(write(tmp_path / "quake.csv", header, columns, before="Logger\n" + before[2:])))


def test_rows_of_several_sensors(tmp_path):
    lines = [
        "# Header",
        "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2",
    ]
    lines += [
        "# UncalGyro,utcTimeMillis,elapsedRealtimeNanos,UncalGyroXRadPerSec,UncalGyroYRadPerSec,UncalGyroZRadPerSec,D"
    ]
    lines += ["# Fix,Provider,LatitudeDegrees"]
    for i in range(COUNT):
        t_ns = round(T_S[i] * 1e9) + 10**12
        lines.append(f"UncalAccel,{1_600_000_000_000 + 10 * i},{t_ns}," + ",".join(f"{v:.6f}" for v in ACCEL[i]))
        lines.append(f"UncalGyro,{1_600_000_000_000 + 10 * i},{t_ns}," + ",".join(f"{v:.6f}" for v in GYRO[i]) + ",0")
        if i % 50 == 0:
            lines.append("Fix,GPS,47.1")
    path = tmp_path / "gnss_log.txt"
    path.write_text("\n".join(lines) + "\n")
    check(read_imu(path))
    lines = ["timestamp_ms,type,x,y,z"]
    for i in range(COUNT):
        lines.append(f"{10 * i},accel," + ",".join(f"{v:.6f}" for v in ACCEL[i]))
        lines.append(f"{10 * i},gyro," + ",".join(f"{v:.6f}" for v in GYRO[i]))
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    toml = paste(caught, path)
    assert 'where = [2, "gyro"]' in toml.read_text()
    text = (
        toml.read_text()
        .replace('unit = "?"  # r', 'unit = "rad/s"  # r')
        .replace('unit = "?"  # m', 'unit = "m/s2"  # m')
    )
    toml.write_text(text)
    check(read_imu(toml))


@pytest.mark.parametrize(
    ("dates", "said"),
    [
        ([f"3/4/2024 23:59:{58 + i // 100}.{i % 100:02d}" for i in range(200)], None),
        ([f"{'13' if i < 100 else '14'}.4.24 10:00:0{i // 100}.{i % 100:02d}" for i in range(200)], "14.4.24"),
        ([f"2024/04/03 11:59:{58 + i // 100}.{i % 100:02d} PM" for i in range(200)], None),
        ([f"2024-04-03T10:00:0{i // 100}.{i % 100:02d}+02:00" for i in range(200)], None),
    ],
)
def test_dates_are_times(tmp_path, dates, said):
    header = "date,gx [rad/s],gy [rad/s],gz [rad/s],ax [g],ay [g],az [g]"
    path = write(tmp_path / "log.csv", header, [dates, *floats(GYRO[:200]), *floats(ACCEL[:200] / G)])
    if said:  # 24 hours lie between
        with pytest.raises(TimingError, match="pauses"):
            read_imu(path)
    else:
        np.testing.assert_allclose(read_imu(path).gyro_t_s, T_S[:200], atol=1e-6)


def test_dates_without_an_order_are_asked_for(tmp_path):
    dates = [f"{3 + i // 100}/4/2024 10:00:00.{i % 100:02d}" for i in range(200)]
    header = "date,gx [rad/s],gy [rad/s],gz [rad/s],ax [g],ay [g],az [g]"
    path = write(tmp_path / "log.csv", header, [dates, *floats(GYRO[:200]), *floats(ACCEL[:200] / G)])
    with pytest.raises(TimingError, match="date_order"):
        read_imu(path)


def test_names_that_mean_something_else_are_not_taken(tmp_path):
    header = "t_ms,mag_x,mag_y,mag_z,euler_x,euler_y,euler_z,linear_acc_x,linear_acc_y,linear_acc_z,gyro_bias_x,note"
    path = write(tmp_path / "log.csv", header, [ints(1e3 * T_S), *zeros(9), *zeros(1), ["a"] * COUNT])
    found = recognise_columns(read_table(path))
    assert found.gyro.columns is None and found.accel.columns is None
    assert found.kinds[7] == "linear" and found.kinds[0] == "time" and found.kinds[10] == "other"


def test_a_table_for_each_sensor(tmp_path):
    ns = ints(T_S * 1e9 + 6e17)
    phone = [f"2026-06-10T22:00:{i // 100:02d}.{i % 100:03d}" for i in range(COUNT)]
    write(
        tmp_path / "Polar_ACC.txt",
        "Phone timestamp;sensor timestamp [ns];X [mg];Y [mg];Z [mg]",
        [phone, ns, *floats(1e3 * ACCEL / G)],
        ";",
    )
    path = write(
        tmp_path / "Polar_GYRO.txt",
        "Phone timestamp;sensor timestamp [ns];X [dps];Y [dps];Z [dps]",
        [phone, ns, *floats(np.degrees(GYRO))],
        ";",
    )
    check(read_imu(tmp_path))
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert 'file = "Polar_ACC.txt"' in str(caught.value)
    check(read_imu(paste(caught, path)))


def test_columns_without_a_name_are_proposed_and_stay_open(tmp_path):
    path = write(tmp_path / "a.csv", "time,x,y,z,ax,ay,az", [ints(1e3 * T_S), *floats(GYRO), *floats(ACCEL)])
    with pytest.raises(FormatError, match=r'columns = \["x", "y", "z"\]\nunit = "\?"'):
        read_imu(path)


def test_seconds_are_never_read_without_their_parts(tmp_path):
    us = ints(1e6 * T_S)
    names = "{}," + ",".join(f"gyro_{a} [rad/s]" for a in "xyz") + "," + ",".join(f"acc_{a} [m/s2]" for a in "xyz")
    sensors = [*floats(GYRO), *floats(ACCEL)]
    for first, second, part in (("stamp_sec", "stamp_nanosec", 1000), ("tv_sec", "tv_usec", 1)):
        columns = [[u // 10**6 for u in us], [u % 10**6 * part for u in us], *sensors]
        check(read_imu(write(tmp_path / "log.csv", names.format(f"{first},{second}"), columns)))


def test_numbers_of_sensors_are_blanks_with_what_they_measure(tmp_path):
    lines = []
    for i in range(COUNT):
        for number, values in ((1, ACCEL), (4, GYRO)):
            lines.append(f"{10 * i},{number}," + ",".join(f"{v:.6f}" for v in values[i]))
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert 'where = [2, "?"]  # sensors: 1 (300 rows, mean length 9.' in str(caught.value)
    gyro, accel = paste(caught, path).read_text().split("[imu.accel]")
    filled = [
        part.replace('where = [2, "?"]', f'where = [2, "{number}"]')
        .replace('time_unit = "?"', 'time_unit = "ms"')
        .replace('\nunit = "?"', f'\nunit = "{unit}"')
        for part, number, unit in ((gyro, 4, "rad/s"), (accel, 1, "m/s2"))
    ]
    (tmp_path / "capture.toml").write_text("[imu.accel]".join(filled))
    check(read_imu(tmp_path / "capture.toml"))


def test_rows_of_several_devices_are_a_blank_with_their_names(tmp_path):
    twice = [v for t in T_S for v in (t, t)]
    both = [np.repeat(values, 2, axis=0) for values in (GYRO, ACCEL)]
    both[0][1::2] += 1  # the other device turns otherwise
    names = [["left", "right"][i % 2] for i in range(2 * COUNT)]
    header = "Time (s),DeviceName," + ",".join(f"Gyro {a} (rad/s)" for a in "XYZ")
    header += "," + ",".join(f"Acc {a} (m/s2)" for a in "XYZ")
    path = write(tmp_path / "two.csv", header, [twice, names, *floats(both[0]), *floats(both[1])])
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert f'where = ["DeviceName", "?"]  # left ({COUNT} rows), right ({COUNT} rows)' in str(caught.value)
    toml = paste(caught, path)
    toml.write_text(toml.read_text().replace('"DeviceName", "?"', '"DeviceName", "left"'))
    check(read_imu(toml))
    flags = [3 if i % 7 else 2 for i in range(2 * COUNT)]  # a status that flickers is no device
    path = write(tmp_path / "one.csv", header.replace("DeviceName", "status"), [twice, flags, *floats(both[0])])
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert "where" not in str(caught.value)


def test_rows_and_columns_name_units_within(tmp_path):
    t_ms = ints(1e3 * T_S)
    rows = [f"{t},gyro_dps,{x:.5f},{y:.5f},{z:.5f}" for t, (x, y, z) in zip(t_ms, np.degrees(GYRO), strict=True)]
    rows += [f"{t},accel_g,{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(t_ms, ACCEL / G, strict=True)]
    path = tmp_path / "rows.csv"
    path.write_text("epoch_ms,sensor,x,y,z\n" + "\n".join(sorted(rows, key=lambda row: int(row.split(",")[0]))) + "\n")
    check(read_imu(path))
    objects = [
        {
            "t_ns": t * 10**6,
            "acc_m_s2": dict(zip("xyz", a, strict=True)),
            "gyro_rad_s": dict(zip("xyz", g, strict=True)),
        }
        for t, a, g in zip(t_ms, ACCEL.tolist(), GYRO.tolist(), strict=True)
    ]
    (tmp_path / "rows.jsonl").write_text("\n".join(map(json.dumps, objects)) + "\n")
    check(read_imu(tmp_path / "rows.jsonl"))


def test_chinese_names_and_the_axis_in_front(tmp_path):
    stamps = [f"2024-05-04 10:00:{t:06.3f}" for t in T_S]
    header = "时间\t设备名称\t" + "\t".join(f"加速度{a}(g)" for a in "XYZ")
    header += "\t" + "\t".join(f"角速度{a}(°/s)" for a in "XYZ") + "\t角度X(°)"
    columns = [stamps, ["WT(1)"] * COUNT, *floats(ACCEL / G), *floats(np.degrees(GYRO)), *zeros(1)]
    path = write(tmp_path / "wit.txt", header, columns, "\t")
    path.write_bytes(path.read_text().encode("gb18030"))
    check(read_imu(path))
    header = "time_s," + ",".join(f"{a}gyro_rad_s" for a in "xyz") + "," + ",".join(f"{a}acc_g" for a in "xyz")
    check(read_imu(write(tmp_path / "mav.csv", header, [floats(T_S[:, None])[0], *floats(GYRO), *floats(ACCEL / G)])))


def test_a_clock_that_stands_still_is_no_time(tmp_path):
    header = "Time(s)\tChipTime\tax(g)\tay(g)\taz(g)\twx(deg/s)\twy(deg/s)\twz(deg/s)"
    columns = [floats(T_S[:, None])[0], ["2024-05-04 10:00:00.000"] * COUNT]
    check(read_imu(write(tmp_path / "a.txt", header, [*columns, *floats(ACCEL / G), *floats(np.degrees(GYRO))], "\t")))
    nine = zeros(9)
    columns = [[0] * COUNT, [0] * COUNT, ["imu"] * COUNT, *zeros(3), [1.0] * COUNT]
    path = write(tmp_path / "echo.csv", "", [*columns, *nine, *floats(GYRO), *nine, *floats(ACCEL), *nine])
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert caught.value.fact.values["open"] == (("gyro", "time"), ("accel", "time"))
    toml = paste(caught, path)
    rate = re.sub(r'time = "\?".*\ntime_unit = "\?".*', "rate_hz = 100", toml.read_text())
    toml.write_text(rate)
    check(read_imu(toml))


def test_dates_open_the_sign_of_an_app_of_two_systems(tmp_path):
    header, values = "time,gFx,gFy,gFz,wx,wy,wz", [*floats(-ACCEL / G), *floats(GYRO)]
    stamps = [f"2024-05-04 10:00:{t:07.4f}" for t in T_S]
    path = write(tmp_path / "ios.csv", header, [stamps, *values])
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert caught.value.fact.values["open"] == (("accel", "axes"),)
    toml = paste(caught, path)
    toml.write_text(toml.read_text().replace('axes = "?"', 'axes = "-x,-y,-z"\nmirrored = true'))
    check(read_imu(toml))


def test_minus_signs_of_typesetters_are_read(tmp_path):
    header = "t (s);" + ";".join(f"gyro {a} (rad/s)" for a in "xyz") + ";" + ";".join(f"acc {a} (m/s2)" for a in "xyz")
    path = write(
        tmp_path / "a.csv", header, [floats(T_S[:, None])[0], *floats(GYRO), *floats(ACCEL)], ";", form="{:.6f}"
    )
    path.write_text(path.read_text().replace(".", ",").replace("-", "\u2212"))
    check(read_imu(path))


def test_tables_named_for_their_sensor_are_described_together(tmp_path):
    folder = tmp_path / "berlin_user"
    folder.mkdir()
    for name, values in (("gyro", GYRO), ("accel", ACCEL), ("linear_accel", ACCEL - ACCEL.mean(0))):
        write(folder / f"{name}.csv", "timestamp,x,y,z", [floats(1e3 * T_S[:, None])[0], *floats(values)])
    with pytest.raises(FormatError) as caught:
        read_imu(folder)
    text = str(caught.value)
    assert 'file = "gyro.csv"' in text and 'file = "accel.csv"' in text and "linear" not in text
    for unit in ("rad/s", "m/s2"):
        text = text.replace('unit = "?"  # ' + unit, f'unit = "{unit}"  # ' + unit)
    text = text.replace('time_unit = "?"', 'time_unit = "ms"')
    (folder / "capture.toml").write_text(text[text.index("[imu.gyro]") :])
    check(read_imu(folder / "capture.toml"))


def test_a_name_s_unit_is_asked_for_where_the_stamps_are_written_otherwise(tmp_path):
    names = "timestamp," + ",".join(f"{w}_{a}" for w in ("omega", "alpha") for a in "xyz")
    stamps = [f"{t + 1.4e9:.3f}" for t in T_S]
    path = write(tmp_path / "imu.csv", names, [stamps, *floats(GYRO), *floats(ACCEL)])
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    assert caught.value.fact.values["open"] == (("gyro", "time_unit"), ("accel", "time_unit"))
    toml = paste(caught, path)
    toml.write_text(toml.read_text().replace('time_unit = "?"', 'time_unit = "s"'))
    check(read_imu(toml))


def test_a_header_with_another_unit_of_time_is_not_our_own_layout(tmp_path):
    for name, values in (("gyroscope", GYRO), ("accelerometer", ACCEL)):
        write(tmp_path / f"{name}.txt", "timestamp_ms,x,y,z", [floats(1e3 * T_S[:, None])[0], *floats(values)])
    with pytest.raises(FormatError) as caught:
        read_imu(tmp_path)
    assert caught.value.fact.values["open"] == (("gyro", "unit"), ("accel", "unit"))


def test_a_clock_that_moves_with_the_rows_goes_before_a_coarse_date(tmp_path):
    header = "datetime,ms," + ",".join(f"g{a} (rad/s)" for a in "xyz") + "," + ",".join(f"a{a} (g)" for a in "xyz")
    dates = [f"2024-05-04 10:00:{int(t):02d}" for t in T_S]
    columns = [dates, ints(1e3 * T_S + 70), *floats(GYRO), *floats(ACCEL / G)]
    check(read_imu(write(tmp_path / "a.csv", header, columns)))


def test_acceleration_without_gravity_alone_is_named(tmp_path):
    header = "motionTimestamp_sinceReboot(s)," + ",".join(f"motionRotationRate{a}(rad/s)" for a in "XYZ")
    header += "," + ",".join(f"motionUserAcceleration{a}(G)" for a in "XYZ")
    columns = [floats(T_S[:, None] + 50)[0], *floats(GYRO), *floats(ACCEL / G - [0, 0, 1])]
    with pytest.raises(FormatError) as caught:
        read_imu(write(tmp_path / "a.csv", header, columns, form="{:.9g}"))
    text = str(caught.value)
    assert caught.value.fact.values["open"] == (("accel", "columns"), ("accel", "unit"))
    assert "without gravity" in text and 'time = "motionTimestamp_sinceReboot(s)"\ntime_unit = "s"' in text


def test_german_names_are_read(tmp_path):
    header = "Zeit (s);" + ";".join(f"Drehrate {a} (°/s)" for a in "XYZ")
    header += ";" + ";".join(f"Lineare Beschleunigung {a} (m/s²)" for a in "XYZ")
    header += ";" + ";".join(f"Beschleunigung {a} (m/s²)" for a in "XYZ")
    columns = [floats(T_S[:, None])[0], *floats(np.degrees(GYRO)), *zeros(3), *floats(ACCEL)]
    check(read_imu(write(tmp_path / "a.csv", header, columns, ";")))
