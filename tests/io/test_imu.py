"""Inertial readers: exact stamps, units, repairs, refusals, and agreement with an independent parser."""

import re
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact, sentences
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.units import stamps_ns as stamps_of_text
from tests.helpers.asl_imu import EPOCH_NS, HEADER, handheld, rows, write_csv
from tests.helpers.cases import loop_over


@pytest.fixture
def clean(tmp_path: Path) -> tuple[Path, list[str]]:
    lines = rows(*handheld())
    return write_csv(tmp_path / "imu.csv", lines), lines


def test_euroc_dataset_is_read_exactly_from_each_of_its_doors(shared_data: Path) -> None:
    root = shared_data / "euroc_v101"
    table = np.loadtxt(root / "mav0/imu0/data.csv", delimiter=",", skiprows=1)
    with open(root / "mav0/imu0/data.csv") as file:
        stamps = [int(line.split(",")[0]) for line in file if line[0] != "#"]
    for door in (root, root / "mav0", root / "mav0/imu0", root / "mav0/imu0/data.csv"):
        imu = read_imu(door)
        np.testing.assert_array_equal(imu.gyro_rad_s, table[:, 1:4])
        np.testing.assert_array_equal(imu.accel_m_s2, table[:, 4:7])
        assert [imu.epoch_ns + round(t * 1e9) for t in imu.gyro_t_s.tolist()] == stamps
        assert imu.repairs == ()
        assert imu.noise is not None and imu.noise.accel_density_m_s2_rthz == 2e-3


def test_no_real_recording_is_refused_or_repaired(shared_data: Path) -> None:
    folders = sorted((shared_data / "inertial_scale").iterdir())
    assert len(folders) == 8
    for folder in folders:
        imu = read_imu(folder)
        assert imu.repairs == ()
        with open(folder / "gyroscope.txt") as file:
            stamps = [int(line.split()[0]) for line in file]
        assert [imu.epoch_ns + round(t * 1e9) for t in imu.gyro_t_s.tolist()] == stamps


def test_csv_units_are_converted_once(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld()
    table = [
        f"{(int(t) - EPOCH_NS) / 1e6:.6f},{','.join(map(repr, np.degrees(g).tolist()))},"
        f"{','.join(map(repr, (a / 9.80665).tolist()))}"
        for t, g, a in zip(t_ns, gyro, accel, strict=True)
    ]
    for header in (
        "t [ms],gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]",
        "time_ms,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_g,acc_y_g,acc_z_g",
        "timestamp (ms),wx (°/s),wy (°/s),wz (°/s),accel_x (g),accel_y (g),accel_z (g)",
    ):
        imu = read_imu(write_csv(tmp_path / "units.csv", table, header))
        np.testing.assert_allclose(imu.gyro_rad_s, gyro, rtol=1e-12)
        np.testing.assert_allclose(imu.accel_m_s2, accel, rtol=1e-12)
        np.testing.assert_allclose(np.diff(imu.gyro_t_s), 0.005, atol=2e-9)


def test_stamps_keep_every_nanosecond(subtests: pytest.Subtests) -> None:
    for unit, token, nanoseconds in (
        ("s", "1403715273.262142976", 1403715273262142976),
        ("s", "-1.5", -1500000000),
        ("ms", "4.328040426741000265e+06", 4328040426741),
        ("us", "1403715273262142.9764", 1403715273262142976),
        ("ns", "9007199254740993", 9007199254740993),
    ):
        with subtests.test(unit=unit, token=token, nanoseconds=nanoseconds):
            from colmap_inertial.io.units import stamps_ns

            assert stamps_ns(Path("x"), [token], unit).tolist() == [nanoseconds]


def test_columns_of_any_order_and_delimiter_are_found(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld(50)
    header = "az_m_s2;ay_m_s2;ax_m_s2;note;wz_rad_s;wy_rad_s;wx_rad_s;t_ns"
    lines = [
        ";".join(map(str, [*a[::-1].tolist(), "7", *g[::-1].tolist(), int(t)]))
        for t, g, a in zip(t_ns, gyro, accel, strict=True)
    ]
    imu = read_imu(write_csv(tmp_path / "odd.csv", lines, header))
    np.testing.assert_array_equal(imu.gyro_rad_s, gyro)
    np.testing.assert_array_equal(imu.accel_m_s2, accel)
    tabs = read_imu(write_csv(tmp_path / "tabs.csv", [x.replace(";", "\t") for x in lines], header.replace(";", "\t")))
    np.testing.assert_array_equal(tabs.accel_m_s2, accel)


def test_sensors_of_two_rates_in_one_table_keep_their_own_times(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld(60)
    lines = []
    for i, row in enumerate(rows(t_ns, gyro, accel)):
        cells = row.split(",")
        lines.append(",".join([*cells[:4], "", "", ""]) if i % 3 else ",".join([cells[0], "", "", "", *cells[4:]]))
    imu = read_imu(write_csv(tmp_path / "mixed.csv", lines))
    assert (len(imu.gyro_t_s), len(imu.accel_t_s)) == (40, 20)
    np.testing.assert_array_equal(imu.accel_m_s2, accel[::3])
    assert sentences(imu.repairs) == (
        "mixed.csv: 20 of 60 rows hold no gyroscope sample",
        "mixed.csv: 40 of 60 rows hold no accelerometer sample",
    )


@loop_over(
    ("header", "said"),
    [
        (HEADER.replace("[rad s^-1]", "[turns]"), "turns"),
        ("t,gx,gy,gz,ax,ay,az", "no single unit"),
        ("t [ns],gx [rad/s],gy [rad/s],gz [deg/s],ax [g],ay [g],az [g]", "no single unit"),
        ("t [ns],foo,bar,baz,ax [g],ay [g],az [g]", "which columns hold the gyroscope"),
        ("t [ns],gx [m/s2],gy [m/s2],gz [m/s2],ax [g],ay [g],az [g]", "m/s2"),
        ("t [ns],gx [rad/s],gx [rad/s],gz [rad/s],ax [g],ay [g],az [g]", "the same quantity"),
        (None, "no header"),
    ],
)
def test_an_unclear_header_is_shown_with_what_to_write(tmp_path: Path, header: str | None, said: str) -> None:
    path = write_csv(tmp_path / "unclear.csv", rows(*handheld(10)), header)
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    message = str(caught.value)
    assert said in message and "[imu.gyro]" in message and 'file = "unclear.csv"' in message
    assert header is None or header.strip("#") in message or said in message
    if said == "no header":
        assert "time = 1\n" in message and 'time_unit = "?"  # s, ms, us, ns' in message and "ns would be" in message
        assert 'columns = [2, 3, 4]\nunit = "?"  # rad/s or deg/s' in message
        assert 'columns = [5, 6, 7]\nunit = "?"  # m/s2 or g' in message


def test_the_hint_for_a_table_names_its_columns_and_no_unit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    accel, rate = rng.normal([0, 0, 9.8], 0.3, (50, 3)), rng.normal(0, 40, (50, 3))
    lines = [
        f"{i},{7 + i * 5.0:.3f},{','.join(f'{v:.4f}' for v in (*a, *w))}"
        for i, (a, w) in enumerate(zip(accel, rate, strict=True))
    ]
    path = write_csv(tmp_path / "own.csv", lines, "row,clock,ux,uy,uz,rx,ry,rz")
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    message = str(caught.value)
    assert 'time = "clock"\ntime_unit = "?"' in message and "ms would be 200 Hz" in message
    assert message.count('columns = ["?", "?", "?"]') == 2 and message.count('unit = "?"') == 4
    path = write_csv(tmp_path / "words.csv", ["1,2,x", "2,3,y"], "a,b,c")
    with pytest.raises(FormatError, match=re.escape('time = "?"')):
        read_imu(path)


def test_a_cut_off_last_line_is_dropped_and_listed(clean: tuple[Path, list[str]]) -> None:
    path, _ = clean
    text = path.read_text()
    for cut in (20, 60, len(text.rstrip().rsplit("\n", 1)[1]) - 1):
        path.write_text(text.rstrip()[:-cut])
        imu = read_imu(path)
        assert len(imu.gyro_t_s) == 399
        assert [repair.code for repair in imu.repairs] == ["last-line-cut-off"]


def test_small_disorder_is_sorted_and_listed(clean: tuple[Path, list[str]]) -> None:
    path, lines = clean
    lines[100:104] = lines[100:104][::-1]
    imu = read_imu(write_csv(path, lines))
    np.testing.assert_array_equal(imu.gyro_rad_s, handheld()[1])
    assert {repair.code for repair in imu.repairs} == {"rows-sorted"}


def test_repeated_rows_are_merged_and_listed(clean: tuple[Path, list[str]]) -> None:
    path, lines = clean
    imu = read_imu(write_csv(path, lines[:50] + lines[49:52] + lines[50:]))
    np.testing.assert_array_equal(imu.gyro_rad_s, handheld()[1])
    assert "rows-merged" in {repair.code for repair in imu.repairs}


def test_rows_of_one_stamp_become_their_average(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld()
    # a pair and two triples; in the second one, two rows are equal and count each
    again = np.array([50, 100, 100, 200, 200])
    t_ns, gyro, accel = (np.insert(values, again, values[again], axis=0) for values in (t_ns, gyro, accel))
    same = {50: slice(50, 52), 100: slice(101, 104), 200: slice(203, 206)}
    assert all(len(set(t_ns[rows])) == 1 for rows in same.values())
    gyro[50:52, 0], gyro[101:104, 1] = (0.1, 0.3), (0.1, 0.2, 0.6)
    gyro[203:206, 2], accel[203:206, 0] = (0.4, 0.4, 0.1), (0.0, 0.0, 3.0)
    imu = read_imu(write_csv(tmp_path / "imu.csv", rows(t_ns, gyro, accel)))
    assert len(imu.gyro_t_s) == len(imu.accel_t_s) == 400
    assert (np.diff(imu.gyro_t_s) > 0).all()
    for index, three in same.items():
        np.testing.assert_allclose(imu.gyro_rad_s[index], gyro[three].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(imu.accel_m_s2[index], accel[three].mean(axis=0), rtol=1e-12)
    assert imu.gyro_rad_s[100, 1] == pytest.approx(0.3)
    assert imu.gyro_rad_s[200, 2] == pytest.approx(0.3)
    assert imu.accel_m_s2[200, 0] == pytest.approx(1.0)
    others = np.setdiff1d(np.arange(400), list(same))
    np.testing.assert_array_equal(imu.gyro_rad_s[others], handheld()[1][others])
    assert Fact("rows-averaged", file="imu.csv", sensor="gyroscope", count=4) in imu.repairs
    assert Fact("rows-merged", file="imu.csv", sensor="gyroscope", count=1) in imu.repairs


def test_rows_without_a_value_are_dropped_and_listed(clean: tuple[Path, list[str]]) -> None:
    path, lines = clean
    cells = lines[7].split(",")
    lines[7] = ",".join([*cells[:2], "nan", *cells[3:]])
    imu = read_imu(write_csv(path, lines))
    assert (len(imu.gyro_t_s), len(imu.accel_t_s)) == (399, 400)
    assert [(repair.code, repair.values["first"]) for repair in imu.repairs] == [("rows-without-value", 9)]


@loop_over(
    ("change", "error", "said"),
    [
        (lambda lines: [*lines[:10], lines[10] + ",1", *lines[11:]], FormatError, "line 12"),
        (lambda lines: [*lines[:10], lines[10].rsplit(",", 1)[0], *lines[11:]], FormatError, "line 12"),
        (lambda lines: [*lines[:10], lines[10].replace(".", "x", 1), *lines[11:]], FormatError, "line 12"),
        (lambda lines: [*lines[:10], "oops," + lines[10].split(",", 1)[1], *lines[11:]], FormatError, "line 12"),
        (lambda lines: [line.rsplit(",", 1)[0] + ",nan" for line in lines], FormatError, "NaN"),
        (lambda lines: lines[:1], FormatError, "at least two"),
        (lambda lines: [], FormatError, "no rows"),
        (lambda lines: lines[::-1], TimingError, "backwards"),
        (lambda lines: lines[200:] + lines[:200], TimingError, "line 202"),
        (lambda lines: [lines[i - i % 2][:19] + line[19:] for i, line in enumerate(lines)], TimingError, "repeat"),
        (lambda lines: ["9" * 30 + lines[0][19:], *lines[1:]], TimingError, "time unit"),
        (lambda lines: ["1e400" + lines[0][19:], *lines[1:]], TimingError, "time unit"),
    ],
)
def test_damage_is_named_with_its_line(clean: tuple[Path, list[str]], change, error, said: str) -> None:
    path, lines = clean
    write_csv(path, change(lines))
    with pytest.raises(error) as caught:
        read_imu(path)
    assert said in str(caught.value) and "imu.csv" in str(caught.value)


def test_stamps_in_a_smaller_unit_than_declared_are_refused(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for unit in ("s", "ms", "us"):
        with subtests.test(unit=unit):
            tmp_path = tmp_path_factory.mktemp("given")
            path = write_csv(tmp_path / "unit.csv", rows(*handheld()), HEADER.replace("[ns]", f"[{unit}]"))
            with pytest.raises(TimingError, match="unit"):
                read_imu(path)


def test_milliseconds_read_as_nanoseconds_are_refused(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld()
    path = write_csv(tmp_path / "unit.csv", rows(t_ns // 1_000_000, gyro, accel))
    with pytest.raises(TimingError, match="time_unit"):
        read_imu(path)


def test_a_damaged_stamp_far_away_is_refused(clean: tuple[Path, list[str]]) -> None:
    path, lines = clean
    lines[-1] = "2" + lines[-1][1:]
    with pytest.raises(TimingError, match="pauses"):
        read_imu(write_csv(path, lines))


def test_no_path_and_no_known_layout_are_format_errors(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such"):
        read_imu(tmp_path / "absent")
    with pytest.raises(FormatError, match="not an inertial recording"):
        read_imu(tmp_path)
    (tmp_path / "a.csv").write_text("x")
    with pytest.raises(FormatError, match="known: auto, euroc"):
        read_imu(tmp_path / "a.csv", format="eurok")


@loop_over(
    ("kind", "lacks"),
    [
        ("euroc", "mav0/imu0/data.csv"),
        ("inertial-scale", "gyroscope.txt and accelerometer.txt"),
        ("mars", "of MARS logger"),
        ("opencamera", r"0 files \*gyro.csv of OpenCamera-Sensors \(none\)"),
        ("sensor-logger", "Gyroscope.csv of Sensor Logger"),
        ("gcsv", "Is a directory"),
        ("gopro", "Is a directory"),
        ("camm", "Is a directory"),
        ("stray-scanner", "imu.csv: no such file"),
        ("phyphox", "no gyroscope of phyphox"),
        ("video-imu-capture", "video_meta.pb3: no such file"),
        ("csv", "Is a directory"),
    ],
)
def test_a_folder_that_is_not_of_the_kind_that_was_named_is_refused_by_what_it_lacks(
    tmp_path: Path, kind: str, lacks: str
) -> None:
    folder = tmp_path / kind
    folder.mkdir()
    with pytest.raises(FormatError, match=lacks) as caught:
        read_imu(folder, format=kind)
    assert str(folder) in str(caught.value)


def test_a_dataset_with_several_imus_asks_which(tmp_path: Path) -> None:
    for name in ("imu0", "imu1"):
        folder = tmp_path / "mav0" / name
        folder.mkdir(parents=True)
        write_csv(folder / "data.csv", rows(*handheld()), HEADER.replace("w_", "w_RS_S_").replace("a_", "a_RS_S_"))
    with pytest.raises(FormatError, match="imu0, mav0/imu1"):
        read_imu(tmp_path)
    assert len(read_imu(tmp_path / "mav0/imu1").gyro_t_s) == 400


@loop_over(
    ("accel_unit", "gyro_factor", "accel_factor", "guilty", "said"),
    [
        ("g", 1.0, 1.0, "a.txt", 'unit = "m/s2" under [imu.accel]'),
        ("m/s2", 1.0, 1.0 / 9.80665, "a.txt", 'unit = "g" under [imu.accel]'),
        ("m/s2", 1.0, np.array([1.0, 0.0, 1.0]), "a.txt", "y axis never changes"),
        ("m/s2", np.array([1.0, 0.0, 1.0]), 1.0, "g.txt", "y axis never changes"),
        ("m/s2", 2000.0, 1.0, "g.txt", "set unit under [imu.gyro], and for raw counts"),
    ],
)
def test_a_fault_of_one_sensor_names_its_own_file(
    tmp_path: Path, accel_unit: str, gyro_factor, accel_factor, guilty: str, said: str
) -> None:
    t_ns, gyro, accel = handheld()
    text = ""
    for sensor, name, values, unit in (
        ("gyro", "g.txt", gyro * gyro_factor, "rad/s"),
        ("accel", "a.txt", accel * accel_factor, accel_unit),
    ):
        lines = [f"{t} {x!r} {y!r} {z!r}\n" for t, (x, y, z) in zip(t_ns.tolist(), values.tolist(), strict=True)]
        (tmp_path / name).write_text("".join(lines))
        text += f'[imu.{sensor}]\nfile = "{name}"\ntime = 1\ntime_unit = "ns"\ncolumns = [2, 3, 4]\nunit = "{unit}"\n'
    (tmp_path / "capture.toml").write_text(text)
    with pytest.raises(FormatError) as caught:
        read_imu(tmp_path)
    assert caught.value.path == tmp_path / guilty
    assert said in str(caught.value)


@loop_over(
    ("token", "unit", "nanoseconds"),
    [
        ("1.5", "s", 1_500_000_000),
        ("1.5e3", "ms", 1_500_000_000),
        ("-2.25", "us", -2250),
        ("0.4", "ns", 0),
        ("0.6", "ns", 1),
        ("1" + "0" * 63 + "E-63", "s", None),
        ("00000000000000000000012", "ns", 12),
        ("4500000000", "s", None),
        ("4400000000", "s", 4_400_000_000_000_000_000),
    ],
)
def test_stamps_are_decimal_numbers_of_any_form(token: str, unit: str, nanoseconds: int | None) -> None:
    if nanoseconds is None:
        with pytest.raises((FormatError, TimingError), match=r"line 7|beyond 142 years"):
            stamps_of_text(Path("a"), ["1", token], unit, [6, 7])
    else:
        assert stamps_of_text(Path("a"), [token, "3"], unit)[0] == nanoseconds


@loop_over("token", ["", "x", "nan", "inf", "-Infinity", "1_000", "1" * 65, "0x10", "1,5"])
def test_what_is_no_decimal_number_is_no_stamp(token: str) -> None:
    with pytest.raises(FormatError, match=r"line 5.*is not a number") as caught:
        stamps_of_text(Path("a"), ["1", token, "2"], "s", [4, 5, 6])
    assert len(str(caught.value)) < 120
