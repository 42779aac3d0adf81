"""Times of frames by their names, by a table, and by a recorder's log."""

from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.io.frame_times import frame_log, stamps_in_order, stamps_of_csv, stamps_of_log, stamps_of_pattern

HERE = Path("frames")


def test_names_hold_times_as_a_pattern_says(subtests):
    for pattern, names, times_ns in (
        ("ns", ["b_12.png", "a_7.png"], {"a_7.png": 7, "b_12.png": 12}),
        ("ms", ["cam0_1500.25.png"], {"cam0_1500.25.png": 1_500_250_000}),
        ("cam0_{us}_*", ["cam0_5_x.png", "cam0_3_7.png"], {"cam0_3_7.png": 3000, "cam0_5_x.png": 5000}),
        ("*_{s}", ["a_b_2.5.png"], {"a_b_2.5.png": 2_500_000_000}),
        ("{ns}.png", ["12.jpg"], {"12.jpg": 12}),
        ("cam0/{ns}", ["cam1/5.png", "cam0/9.png"], {"cam0/9.png": 9}),
        ("cam?/{ns}", ["cam1/5.png", "x/9.png"], {"cam1/5.png": 5}),
        ("PXL_%Y%m%d_%H%M%S%f", ["PXL_20240501_123015250.jpg"], {"PXL_20240501_123015250.jpg": 1714566615250000000}),
        ("%Y%j%H%M%S%f", ["2024122123015000001.jpg"], {"2024122123015000001.jpg": 1714566615000001000}),
    ):
        with subtests.test(pattern=pattern, names=names, times_ns=times_ns):
            found = stamps_of_pattern(HERE, names, pattern)
            assert dict(zip(found.names, found.t_ns.tolist(), strict=True)) == times_ns
            assert (np.diff(found.t_ns) > 0).all()


def test_a_name_or_pattern_without_a_time_is_named(subtests):
    for pattern, name, said in (
        ("ns", "frame.png", "the name holds no number"),
        ("ns", "12_34.png", "several numbers of one length"),
        ("cam0_{ns}", "cam1_5.png", r"cam1_5.png: the name does not fit"),
        ("cam0_{ns}", "cam0_5_6.png", "does not fit"),
        ("{ns}_{ms}", "5_6.png", "does not describe how names hold times"),
        ("{min}", "5.png", "does not describe how names hold times"),
        ("%Y%m%d_%H%M%S", "20240501_123015.png", "does not describe how names hold times"),
        ("%H%M%S%f", "123015250.png", "does not describe how names hold times"),
        ("%Y%m%d_%H%M%S%f", "20241301_123015250.png", "does not fit"),
        ("cam0/ns", "cam1/5.png", "no image lies in a folder 'cam0'"),
    ):
        with subtests.test(pattern=pattern, name=name, said=said), pytest.raises(TimingError, match=said):
            stamps_of_pattern(HERE, [name], pattern)


def test_a_log_has_a_time_for_each_frame(subtests, tmp_path_factory):
    for text, unit, times_ns in (
        ("t_ns\n5\n7\n", None, [5, 7]),
        ("frame,timestamp [ms]\n0,1.5\n1,2.5\n", None, [1_500_000, 2_500_000]),
        ("5\n7\n", "us", [5000, 7000]),
        ("t_s,x\n1,2\n3,4\n", "s", [10**9, 3 * 10**9]),
    ):
        with subtests.test(text=text, unit=unit, times_ns=times_ns):
            tmp_path = tmp_path_factory.mktemp("given")
            (tmp_path / "log.csv").write_text(text)
            assert stamps_of_log(tmp_path / "log.csv", unit).tolist() == times_ns


def test_a_log_without_clear_times_is_named(subtests, tmp_path_factory):
    for text, unit, error, said in (
        ("5,6\n7,8\n", "ns", TimingError, "2 columns and no header; name the time column"),
        ("5\n7\n", None, TimingError, "does not state the unit of its times"),
        ("t_ns,t_ms\n5,6\n7,8\n", None, TimingError, "several columns of times"),
        ("x,y\n5,6\n7,8\n", None, TimingError, "no column of times"),
        ("t_ns\n5\n7\n", "ms", TimingError, "the header says ns, time_unit says ms"),
        ("timestamp [weeks]\n5\n7\n", None, FormatError, "weeks"),
    ):
        with subtests.test(text=text, unit=unit, error=error, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            (tmp_path / "log.csv").write_text(text)
            with pytest.raises(error, match=said):
                stamps_of_log(tmp_path / "log.csv", unit)


def test_frames_of_a_log_follow_each_other():
    log = frame_log(HERE, np.array([5, 7, 12], dtype=np.int64) * 10**9, readout_s=0.02)
    assert log.t_s.tolist() == [0, 2, 7] and log.epoch_ns == 5 * 10**9 and log.shared_clock and log.readout_s == 0.02
    for times, frame in (([5, 7, 7], 3), ([5, 4, 9], 2)):
        with pytest.raises(FormatError, match=f"the time of frame {frame} is not after the previous one"):
            frame_log(HERE, np.array(times, dtype=np.int64))


def test_stamps_are_sorted_with_what_belongs_to_them_and_each_name_comes_once():
    found = stamps_in_order(HERE, ["b", "a", "c"], np.array([7, 5, 6]), exposure_s=np.array([0.2, 0.1, 0.3]))
    assert found.names == ("a", "c", "b") and found.t_ns.tolist() == [5, 6, 7]
    assert found.exposure_s.tolist() == [0.1, 0.3, 0.2]
    for names, said in ((["a", "b", "a"], "the frame a appears twice"), (["a", "b", ""], "a row has no name")):
        with pytest.raises(FormatError, match=said) as caught:
            stamps_in_order(HERE, names, np.array([7, 5, 6]), np.array([2, 3, 9]))
        assert caught.value.line == 9


def test_a_table_of_frames_has_exposures_in_their_unit(tmp_path):
    path = tmp_path / "frames.csv"
    path.write_text("name,t_ms,exposure_us\nb.png,2,4000\na.png,1,5000\n")
    found = stamps_of_csv(path)
    assert found.names == ("a.png", "b.png") and found.t_ns.tolist() == [10**6, 2 * 10**6]
    assert found.exposure_s == pytest.approx([0.005, 0.004])
    for header, value, said in (
        ("exposure_s", "10", "an exposure must be from 0 to 10 s"),
        ("exposure_s", "-1", "an exposure must be from 0 to 10 s"),
        ("exposure", "1", "needs a unit"),
    ):
        path.write_text(f"name,t_ms,{header}\nb.png,2,0\na.png,1,{value}\n")
        with pytest.raises(FormatError, match=said):
            stamps_of_csv(path)
