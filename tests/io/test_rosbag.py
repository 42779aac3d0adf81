"""Bags whose header stamps are no times: refused in words of topics; times of arrival may stand for them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import TimingError
from colmap_inertial.io.imu import read_imu

pytest.importorskip("rosbags")
COUNT = 600
T_NS = np.arange(COUNT) * 5_000_000
T_S = T_NS * 1e-9
GYRO = 0.5 * np.sin(T_S[:, None] * [1.1, 1.7, 2.3] + [0, 1, 2])
ACCEL = np.array([1.0, -2.0, 9.4]) + 0.3 * np.sin(T_S[:, None] * [5.0, 4.0, 3.0])
ARRIVAL = T_NS + 1_700_000_000 * 10**9 + np.random.default_rng(1).integers(0, 200_000, COUNT)
STAMPS = T_NS + 1_700_000_000 * 10**9 - 3_000_000
NONE = np.zeros((COUNT, 3))


def write_bag(
    path: Path,
    series: Iterable[tuple[str, str, np.ndarray, np.ndarray, np.ndarray]],
    kept: Sequence[int] | np.ndarray = range(COUNT),
) -> Path:
    """A ROS 1 bag of series: topic, node, stamps, rad/s, m/s2; all arrive at :data:`ARRIVAL`, one after another."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    names = ("sensor_msgs/msg/Imu", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    imu, header, time = (store.types[name] for name in names)
    vector, rotation = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Quaternion"]
    with Writer(path) as writer:
        rows = []
        for late, (topic, node, stamps, gyro, accel) in enumerate(series):
            connection = writer.add_connection(topic, imu.__msgtype__, typestore=store, callerid=node)
            rows += [(int(ARRIVAL[i]) + 1000 * late, connection, int(stamps[i]), gyro[i], accel[i]) for i in kept]
        for arrival, connection, stamp, gyro, accel in sorted(rows, key=lambda row: row[0]):
            message = imu(
                header=header(seq=0, stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="imu"),
                orientation=rotation(x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.zeros(9),
                angular_velocity=vector(*map(float, gyro)),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector(*map(float, accel)),
                linear_acceleration_covariance=np.zeros(9),
            )
            writer.write(connection, arrival, bytes(store.serialize_ros1(message, imu.__msgtype__)))
    return path


def refused(path: Path) -> TimingError:
    with pytest.raises(TimingError) as caught:
        read_imu(path)
    return caught.value


def by_arrival(path: Path) -> Path:
    toml = path.with_suffix(".toml")
    toml.write_text(f'[imu]\npath = "{path.name}"\nstamps = "arrival"\n')
    return toml


@pytest.mark.parametrize(
    ("code", "stamps"),
    [
        ("bag-stamps-empty", np.zeros(COUNT, dtype=np.int64)),
        ("bag-stamps-repeated", STAMPS[np.arange(COUNT) // 2 * 2]),
        ("bag-stamps-jump-back", STAMPS - 7 * 10**9 * (np.arange(COUNT) > 300)),
        ("bag-stamps-jump-ahead", STAMPS + 7 * 10**9 * (np.arange(COUNT) > 300)),
    ],
)
def test_stamps_that_are_no_times_give_way_to_arrival(tmp_path, code, stamps):
    path = write_bag(tmp_path / "a.bag", [("/imu", "/driver", stamps, GYRO, ACCEL)])
    error = refused(path)
    assert error.fact.code == code and "/imu" in str(error) and "column" not in str(error)
    imu = read_imu(by_arrival(path))
    np.testing.assert_allclose(imu.gyro_t_s - imu.gyro_t_s[0], (ARRIVAL - ARRIVAL[0]) * 1e-9, atol=1e-9)
    np.testing.assert_allclose(imu.accel_m_s2, ACCEL)


def test_two_drivers_are_one_imu_by_no_clock(tmp_path):
    series = [("/imu", "/driver", STAMPS, GYRO, ACCEL), ("/imu", "/filter", STAMPS + 900_000, GYRO + 1, ACCEL + 1)]
    path = write_bag(tmp_path / "a.bag", series)
    for source in (path, by_arrival(path)):
        error = refused(source)
        assert error.fact.code == "bag-of-two-drivers" and error.fact.values["nodes"] == ("/driver", "/filter")


def test_topics_of_two_clocks_are_joined_by_arrival(tmp_path):
    series = [("/gyro", "/camera", STAMPS, GYRO, NONE), ("/accel", "/camera", T_NS + 5 * 10**12, NONE, ACCEL)]
    path = write_bag(tmp_path / "a.bag", series)
    error = refused(path)
    assert error.fact.code == "bag-of-two-clocks" and error.fact.values["topics"] == ("/gyro", "/accel")
    imu = read_imu(by_arrival(path))
    np.testing.assert_allclose(imu.accel_t_s - imu.gyro_t_s, 1e-6, atol=1e-9)


def test_a_gap_is_no_other_clock(tmp_path):
    kept = np.r_[0:200, 400:COUNT]
    imu = read_imu(write_bag(tmp_path / "a.bag", [("/imu", "/driver", STAMPS, GYRO, ACCEL)], kept))
    np.testing.assert_allclose(imu.gyro_t_s, T_S[kept], atol=1e-12)
