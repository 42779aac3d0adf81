"""Tables of text: their header, lines and columns, and which of these are whose without a header."""

from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io import descriptions
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.tables import parse_table


def table(*groups):
    return np.column_stack([np.arange(400) / 100.0, *groups])


@pytest.fixture
def readings():
    """A gyroscope, and an accelerometer whose length changes more than that of its first two axes."""
    rng = np.random.default_rng(5)
    gyro = 0.3 * rng.standard_normal((400, 3))
    gyro[:, 2] *= 0.01
    accel = np.column_stack([np.full(400, 6.9), np.full(400, 6.9), np.zeros(400)])
    accel[:, :2] += 0.005 * rng.standard_normal((400, 2))
    accel[:, 2] = 2.5 * rng.standard_normal(400)
    return gyro, accel


def test_the_accelerometer_leaves_three_columns_for_the_gyroscope(readings):
    """Though a column of the gyroscope and two of the accelerometer have a steadier length."""
    gyro, accel = readings
    steadier = np.column_stack([gyro[:, 2], accel[:, :2]])
    assert np.ptp(np.linalg.norm(steadier, axis=1)) < 0.1 * np.ptp(np.linalg.norm(accel, axis=1))
    assert descriptions._accel(table(gyro, accel), 0) == 4
    assert descriptions._accel(table(gyro, accel / 9.80665), 0) == 4
    assert descriptions._accel(table(accel, gyro), 0) == 1


def test_a_table_that_is_none_is_named_with_its_line(subtests):
    for text, line, said in (
        ("", None, "holds no rows of numbers"),
        ("# t, x\n\n", None, "holds no rows of numbers"),
        ("t,x\n", None, "holds a header and no rows"),
        ("t,x\n\n# more\n", None, "holds a header and no rows"),
        ("t,x\n1,2,3\n4,5,6\n", 2, "3 cells under a header of 2: t,x"),
        ("# file\nt;x\n\n1;2;3\n", 4, "3 cells under a header of 2: t;x"),
        ("1,2\n4,5\n3\n", 3, "1 cells where the other lines have 2"),
        ("t,x\n1,2\n\n3,4,5\n6,7\n", 4, "3 cells where the other lines have 2"),
        (",".join("1" * 20_000) + "\n", 1, "has more than .* columns"),
        ("t,x\n" + ",".join("1" * 20_000) + "\n", 1, "has more than .* columns"),
    ):
        with subtests.test(text=text[:40], line=line, said=said):
            with pytest.raises(FormatError, match=said) as caught:
                parse_table(Path("a.csv"), text)
            assert caught.value.line == line


def test_a_table_has_its_header_numbers_and_lines(subtests):
    for delimiter in (",", ";", "\t", " "):
        with subtests.test(delimiter=delimiter):
            text = "t,x,y\n1,2,3\r\n\n4,5,6\n# inside\n7,8,9\n1,2".replace(",", delimiter)
            table = parse_table(Path("a.csv"), text)
            assert table.header == ("t", "x", "y") and table.width == 3 and table.line_numbers.tolist() == [2, 4, 6]
            assert table.numbers([0, 2]).tolist() == [[1, 3], [4, 6], [7, 9]]
            # a comment, and a last line that was cut off
            passed, cut = table.repairs
            assert passed == Fact("comments-passed-over", file="a.csv", count=1)
            assert cut == Fact("last-line-cut-off", file="a.csv", line=7)
            assert (table.column(1), table.column(3), table.column("y")) == (0, 2, 2)
            for name, said in (
                (0, "column 0 does not exist: columns are counted from 1 to 3"),
                (4, "column 4 does not exist"),
                ("z", 'no column "z"'),
            ):
                with pytest.raises(FormatError, match=said):
                    table.column(name)
            table.require_width("t x y")
            with pytest.raises(FormatError, match="3 columns; expected t x"):
                table.require_width("t x")
            alone = parse_table(Path("a.csv"), "1 2\n3 4\n")
            with pytest.raises(FormatError, match="has no header"):
                alone.column("t")
            assert alone.header is None and parse_table(Path("a.csv"), "# t x\n1 2\n3 4\n").header == ("t", "x")


def test_samples_of_one_stamp_are_no_recording(tmp_path):
    path = tmp_path / "imu.csv"
    header = "timestamp [ns],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]\n"
    path.write_text(header + "7,0.1,0.2,0.3,1,2,9\n" * 40)
    with pytest.raises(TimingError) as refused:
        read_imu(path)
    assert refused.value.code == "one-stamp-for-all"
