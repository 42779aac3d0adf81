"""Cameras that telemetry-parser reads: units, axes, and what is refused."""

import sys
from itertools import product

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io import telemetry
from colmap_inertial.io.imu import read_frame_log, read_imu
from colmap_inertial.io.imu_formats import find_imu_format
from tests.helpers.asl_imu import handheld
from tests.helpers.imu_files import INSTA360S, RUNCAMS, write_insta360, write_runcam


def assert_read(path, imu, *, gyro_rad_s, accel_m_s2):
    found = read_imu(path)
    np.testing.assert_allclose(found.gyro_t_s, imu.gyro_t_s - imu.gyro_t_s[0], atol=1e-3)
    np.testing.assert_allclose(found.gyro_rad_s, imu.gyro_rad_s, atol=gyro_rad_s)
    np.testing.assert_allclose(found.accel_m_s2, imu.accel_m_s2, atol=accel_m_s2)
    return found


@pytest.fixture(scope="module")
def imu():
    t_ns, gyro, accel = handheld()
    t_s = (t_ns - t_ns[0]) * 1e-9
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel)


def test_a_log_of_counts_is_read_in_the_camera_s_axes(subtests, tmp_path_factory, imu):
    for camera in RUNCAMS:
        with subtests.test(camera=camera):
            tmp_path = tmp_path_factory.mktemp("given")
            found = assert_read(write_runcam(tmp_path, imu, camera), imu, gyro_rad_s=6e-4, accel_m_s2=4e-4)
            assert camera in found.device


def test_an_insta360_s_records_are_read_in_the_camera_s_axes(subtests, tmp_path_factory, imu):
    pytest.importorskip("telemetry_parser")
    for camera, counts in product(INSTA360S, (True, False)):
        with subtests.test(camera=camera, counts=counts):
            tmp_path = tmp_path_factory.mktemp("given")
            path = write_insta360(tmp_path / "VID.mp4", imu, camera, counts=counts, readout_ms=16.5)
            found = assert_read(path, imu, gyro_rad_s=1e-3, accel_m_s2=5e-3)
            assert found.device == camera
            log = read_frame_log(path)
            assert log is not None and log.readout_s == pytest.approx(0.0165)
            assert read_frame_log(write_insta360(tmp_path / "none.mp4", imu, camera, counts=counts)) is None


def test_a_gyroscope_alone_is_for_imaging(tmp_path, imu):
    path = write_runcam(tmp_path, imu, "GOCam GR")
    path.write_text("\n".join(",".join(line.split(",")[:4]) for line in path.read_text().splitlines()) + "\n")
    assert not read_imu(path).has_accel


def test_an_insta360_is_known_by_the_end_of_its_file(tmp_path):
    mark, path = b"8db42d694ccc418790edff439fe026bf", tmp_path / "VID.mp4"
    for content, known in (
        (mark, True),
        (b"video" + mark, True),
        (mark + b"0", False),
        (mark[1:], False),
        (b"", False),
    ):
        path.write_bytes(content)
        assert telemetry.is_telemetry(path) == known
    assert not telemetry.is_telemetry(tmp_path)


def test_damage_is_an_error_of_ours(tmp_path, imu):
    path = write_runcam(tmp_path, imu, "Thumb")
    path.write_text(path.read_text() + "1,2,three,4,5,6,7\n")
    with pytest.raises(FormatError, match="'three' in column 3 is not a number"):
        read_imu(path)
    pytest.importorskip("telemetry_parser")
    cut = write_insta360(tmp_path / "cut.mp4", imu, "Insta360 OneR", counts=False)
    cut.write_bytes(cut.read_bytes()[-300:])
    with pytest.raises(FormatError, match="telemetry-parser cannot read it"):
        read_imu(cut)


def test_a_parser_that_aborts_ends_in_a_sentence(tmp_path, imu, monkeypatch):
    pytest.importorskip("telemetry_parser")
    monkeypatch.setattr(telemetry, "_PARSE", "import os; os.abort()")
    with pytest.raises(FormatError, match="telemetry-parser cannot read it: it ended with signal 6"):
        read_imu(write_insta360(tmp_path / "VID.mp4", imu, "Insta360 OneR", counts=False))


def test_a_parser_takes_no_more_than_its_memory(tmp_path, imu, monkeypatch):
    pytest.importorskip("telemetry_parser")
    path = write_insta360(tmp_path / "VID.mp4", imu, "Insta360 OneR", counts=False)
    monkeypatch.setattr(telemetry, "_LIMITS", telemetry.TelemetryLimits(memory_bytes=1 << 20))
    with pytest.raises(FormatError, match="telemetry-parser cannot read it"):
        read_imu(path)


def test_without_the_package_it_says_what_to_install(tmp_path, imu, monkeypatch):
    path = write_insta360(tmp_path / "VID.mp4", imu, "Insta360 OneR", counts=False)
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)
    with pytest.raises(MissingExtraError, match="extra `devices`: pip install 'telemetry-parser"):
        read_imu(path)


def test_a_table_of_anybody_else_s_is_none_of_theirs(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("time,x,y,z,ax,ay,az\n0,1,2,3,4,5,6\n")
    assert find_imu_format(path).name == "csv"


def test_counts_of_a_log_with_another_name_are_asked_for(tmp_path, imu):
    path = write_runcam(tmp_path, imu, "Runcam 5 Orange").rename(tmp_path / "flight.csv")
    wanted = r'(?s)columns = \["rx", "ry", "rz"\].*counts_per_unit = "\?"  # 65.536 where'
    with pytest.raises(FormatError, match=wanted):
        read_imu(path)
