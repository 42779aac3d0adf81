"""What ``diagnose`` shows of a table, and the capture.toml that it writes."""

import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.table_report import report_table
from colmap_inertial.run.commands.diagnose import describe_table
from colmap_inertial.run.commands.scale import ScaleSource
from tests.io.test_columns import ACCEL, COUNT, GYRO, T_S, check, floats, ints, write


def run(*words):
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return ended.value.code


@pytest.fixture
def table(tmp_path):
    header = "row,t_ms,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,linear_acc_x,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2,note"
    columns = [list(range(COUNT)), ints(1e3 * T_S), *floats(GYRO), [0.5] * COUNT, *floats(ACCEL), ["a"] * COUNT]
    return write(tmp_path / "log.csv", header, columns)


def test_each_column_has_its_kind_mean_scatter_and_rate(table):
    report = report_table(table)
    kinds = [column.kind for column in report.columns]
    assert kinds == ["other", "time", *["gyro"] * 3, "linear", *["accel"] * 3, "other"] and not report.is_open
    gyro, accel = report.columns[2], report.columns[8]
    assert gyro.unit == "rad/s" and gyro.rate_hz == pytest.approx(100)
    assert (accel.mean, accel.scatter) == pytest.approx((ACCEL[:, 2].mean(), ACCEL[:, 2].std()), abs=1e-5)
    assert report.columns[9].mean is None
    assert report_table(table.parent) is None


def test_the_capture_toml_that_is_written_is_read(table, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    toml = tmp_path / "there" / "capture.toml"
    assert run("diagnose", str(table), "--capture", str(toml)) == 0
    assert "accelerometer" in capsys.readouterr().out
    check(read_imu(toml))
    assert run("diagnose", str(table), "--capture", str(toml)) == 2
    np.testing.assert_allclose(read_imu(toml).accel_m_s2, read_imu(table).accel_m_s2)


def test_an_open_table_is_shown_and_refused(tmp_path, capsys):
    path = write(tmp_path / "a.csv", "t,gx,gy,gz,ax,ay,az", [ints(1e3 * T_S), *floats(GYRO), *floats(ACCEL)])
    assert run("diagnose", str(path)) == 2
    said = capsys.readouterr()
    assert 'unit = "?"' in said.out and "the capture.toml above describes it" in said.err


def test_the_hint_names_the_table_of_the_other_sensor(tmp_path, capsys):
    t = floats(T_S[:, None])[0]
    (tmp_path / "log").mkdir()
    gyro = write(tmp_path / "log" / "berlin_1.csv", "t (s),x (rad/s),y (rad/s),z (rad/s)", [t, *floats(GYRO)])
    write(tmp_path / "log" / "berlin_2.csv", "t (s),x (m/s2),y (m/s2),z (m/s2)", [t, *floats(ACCEL)])
    run("diagnose", str(gyro), "--capture", str(tmp_path / "capture.toml"))
    assert "a table beside it" in capsys.readouterr().err
    check(read_imu(tmp_path / "capture.toml"))


def test_a_folder_of_open_tables_is_described(tmp_path, capsys):
    (tmp_path / "log").mkdir()
    for name, values in (("Gyroscope", GYRO), ("Accelerometer", ACCEL)):
        write(tmp_path / "log" / f"{name}.csv", "t_s,x,y,z", [floats(T_S[:, None])[0], *floats(values)])
    assert run("diagnose", str(tmp_path / "log"), "--capture", str(tmp_path / "capture.toml")) == 2
    assert "accelerometer" in capsys.readouterr().out
    text = (tmp_path / "capture.toml").read_text()
    text = text.replace('"?"  # rad/s', '"rad/s"  #').replace('"?"  # m/s2', '"m/s2"  #')
    (tmp_path / "capture.toml").write_text(text)
    check(read_imu(tmp_path / "capture.toml"))


def test_tables_that_a_capture_describes_are_not_asked_about(tmp_path):
    t = floats(T_S[:, None])[0]
    write(tmp_path / "gyro.csv", "t,x,y,z", [t, *floats(GYRO)])
    write(tmp_path / "accel.csv", "t,x,y,z", [t, *floats(ACCEL)])
    alone = describe_table(ScaleSource(source=tmp_path))
    assert alone is not None and alone.is_open
    (tmp_path / "capture.toml").write_text('[imu.gyro]\nfile = "gyro.csv"\n')
    assert describe_table(ScaleSource(source=tmp_path)) is None
