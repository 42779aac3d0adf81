"""Recordings in JSON: arrays, lines, messages with payloads, lists under names."""

import json

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.json_rows import rows_of_json
from colmap_inertial.io.tables import read_table
from tests.io.test_columns import ACCEL, COUNT, GYRO, T_S, G, check


def rows_of(values, name):
    return [
        {
            "sensor": name,
            "time": str(1_600_000_000_000_000_000 + round(1e9 * t)),
            "seconds_elapsed": f"{t:.6f}",
            **{axis: f"{v:.7f}" for axis, v in zip("zyx", row[::-1], strict=True)},
        }
        for t, row in zip(T_S, values, strict=True)
    ]


def recording(platform, standardised="false"):
    metadata = {"sensor": "Metadata", "version": "3", "platform": platform, "standardisation": standardised}
    return [metadata, *rows_of(GYRO, "Gyroscope")]


def test_sensor_logger_s_array_knows_its_platform(tmp_path):
    path = tmp_path / "recording.json"
    gravity = np.tile([0.0, 0.0, G], (COUNT, 1))
    for platform, extra in (
        ("android", rows_of(ACCEL, "TotalAcceleration")),
        ("ios", rows_of(-ACCEL / G, "AccelerometerUncalibrated")),
        ("ios", [*rows_of(-(ACCEL - gravity), "Accelerometer"), *rows_of(-gravity, "Gravity")]),
    ):
        path.write_text(json.dumps([*recording(platform), *extra]))
        check(read_imu(path))
    path.write_text(json.dumps([*recording("ios"), *rows_of(ACCEL, "Accelerometer")]))
    with pytest.raises(FormatError, match="without gravity"):
        read_imu(path)


def test_messages_on_lines_ask_for_the_platform(tmp_path):
    path = tmp_path / "push.jsonl"
    lines = []
    for i in range(0, COUNT, 10):
        payload = [
            {"name": name, "time": 10**18 + round(1e9 * T_S[k]), "values": dict(zip("xyz", values[k], strict=True))}
            for name, values in (("gyroscope", GYRO), ("totalacceleration", ACCEL))
            for k in range(i, i + 10)
        ]
        lines.append(json.dumps({"messageId": i, "sessionId": "a", "payload": payload}))
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(FormatError) as refused:
        read_imu(path)
    assert refused.value.code == "sensor-logger-platform-of-rows-unknown"
    sensors = (("gyro", "gyroscope", "rad/s"), ("accel", "totalacceleration", "m/s2"))
    toml = "\n".join(
        f'[imu.{sensor}]\nfile = "push.jsonl"\nwhere = ["name", "{name}"]\ntime = "time"\ntime_unit = "ns"\n'
        f'columns = ["x", "y", "z"]\nunit = "{unit}"'
        for sensor, name, unit in sensors
    )
    (tmp_path / "capture.toml").write_text(toml)
    check(read_imu(tmp_path / "capture.toml"))


def test_objects_and_lists_are_tables(tmp_path):
    names = [*(f"gyro_{a}_rad_s" for a in "xyz"), *(f"accel_{a}_m_s2" for a in "xyz")]
    columns = [*GYRO.T.tolist(), *ACCEL.T.tolist()]
    rows = [{"t_s": t, **dict(zip(names, row, strict=True))} for t, *row in zip(T_S, *columns, strict=True)]
    path = tmp_path / "log.json"
    for text in (
        json.dumps(rows),
        "\n".join(map(json.dumps, rows)),
        json.dumps({"t_s": T_S.tolist(), **dict(zip(names, columns, strict=True))}),
    ):
        path.write_text(text)
        check(read_imu(path))


@pytest.mark.parametrize("text", ["", "{", "[1,2]", '{"a": 1}', "[" * 100_000, '{"a": [1, 2]}', '[{"a": 1}, x]', "x"])
def test_what_is_no_json_of_rows_is_none(text):
    assert rows_of_json(text) is None


def test_rows_under_a_list_of_names():
    rows = {"columns": ["t_s", "gx"], "data": [[0.01 * i, i] for i in range(6)]}
    assert rows_of_json(json.dumps(rows)).splitlines()[:2] == ["t_s,gx", "0.0,0"]


def test_json_without_rows_says_so(tmp_path):
    broken = '{"columns": ["t", "x"], "data": [[1], [2], [3]]}'
    for text in ('{"version": 3, "files": ["a"]}', "[1, 2, 3]", broken):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(FormatError) as caught:
            read_table(tmp_path / "a.json")
        assert caught.value.fact.code == "json-without-rows"
