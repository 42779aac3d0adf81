"""Cameras and phone apps: one simulated recording, written in each one's layout, is read back as it was."""

import builtins
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, MissingExtraError, TimingError
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.capture import ImuPath, load_capture
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.io.imu import read_capture_imu, read_frame_log, read_imu
from colmap_inertial.io.imu_formats import imu_formats
from colmap_inertial.tools.simulate import RecordingOptions, SimulatedRecording, simulate_recording
from colmap_inertial.tools.simulate.motion import MotionOptions
from tests.helpers import imu_files
from tests.helpers.cases import loop_over
from tests.helpers.simulated_imu import FRAME_NS, at_one_clock, recorded


@pytest.fixture(scope="module")
def imu() -> ImuRecording:
    """Gyroscope and accelerometer on time bases of their own, 2 to 1 as in a HERO5."""
    return recorded(400.0, 200.0)


@pytest.fixture(scope="module")
def one_clock() -> ImuRecording:
    """Both sensors at the same stamps: what apps with one table write."""
    return at_one_clock(recorded(200.0, 200.0))


@dataclass(frozen=True)
class Layout:
    """How a format is written, and what it keeps: seconds, rad/s, m/s2; whether it keeps the clock's reading."""

    write: Callable[[Path, ImuRecording], Path]
    format: str
    t_s: float = 2e-9
    gyro: float = 1e-6
    accel: float = 1e-5
    one_clock: bool = False
    absolute: bool = True


def gopro(style: imu_files.GoPro) -> Callable[[Path, ImuRecording], Path]:
    return lambda folder, imu: imu_files.write_gopro(folder / "GX010001.MP4", imu, style)


def logger(**how: object) -> Callable[[Path, ImuRecording], Path]:
    return lambda folder, imu: imu_files.write_sensor_logger(folder, imu, **how)


def ros(name: str, **how: object) -> Callable[[Path, ImuRecording], Path]:
    return lambda folder, imu: imu_files.write_rosbag(folder / name, imu, **how)


LAYOUTS = {
    # stamps are smoothed: 2 us of quantisation, or 2 ms of ticks and of whole samples a payload, stay as errors
    "gopro max": Layout(gopro(imu_files.MAX), "gopro", 3e-6, 0.6 / 939, 0.6 / 417, absolute=False),
    "gopro hero5": Layout(gopro(imu_files.HERO5), "gopro", 1e-3, 0.6 / 3755, 0.6 / 418, absolute=False),
    "gopro hero6": Layout(gopro(imu_files.HERO6), "gopro", 5e-3, 0.6 / 939, 0.6 / 417, absolute=False),
    "gopro fusion": Layout(gopro(imu_files.FUSION), "gopro", 3e-6, 0.6 / 939, 0.6 / 417, absolute=False),
    "gopro late": Layout(
        gopro(replace(imu_files.MAX, late_s=0.125)), "gopro", 3e-6, 0.6 / 939, 0.6 / 417, absolute=False
    ),
    "camm": Layout(
        lambda folder, imu: imu_files.write_camm(folder / "a.mp4", imu), "camm", 1.1e-6, 1e-6, 1e-5, absolute=False
    ),
    "gcsv": Layout(
        lambda folder, imu: imu_files.write_gcsv(folder / "a.gcsv", imu), "gcsv", 1.1e-5, 1.1e-4, 6e-4, True, False
    ),
    "opencamera": Layout(lambda folder, imu: imu_files.write_opencamera(folder, imu, FRAME_NS), "opencamera"),
    "mars": Layout(lambda folder, imu: imu_files.write_mars(folder, imu, FRAME_NS), "mars", one_clock=True),
    "mars ios": Layout(imu_files.write_mars_ios, "mars", 1e-6, 6e-6, 6e-6, True),
    "video-imu-capture": Layout(
        lambda folder, imu: imu_files.write_video_imu_capture(folder, imu, FRAME_NS),
        "video-imu-capture",
        one_clock=True,
    ),
    # seconds in double precision resolve 0.24 us at the size of 1.7e9
    "stray": Layout(
        lambda folder, imu: imu_files.write_stray_scanner(folder, imu, FRAME_NS), "stray-scanner", 5e-7, one_clock=True
    ),
    "sensor-logger ios": Layout(logger(), "sensor-logger"),
    "sensor-logger android": Layout(logger(platform="android"), "sensor-logger"),
    "sensor-logger standardised": Layout(logger(standardised=True, tables="uncalibrated"), "sensor-logger"),
    "sensor-logger g": Layout(logger(tables="uncalibrated"), "sensor-logger"),
    "sensor-logger parts": Layout(logger(tables="parts"), "sensor-logger"),
    "ros 1": Layout(ros("a.bag"), "rosbag", one_clock=True),
    "ros 2 sqlite3": Layout(ros("recording", kind="sqlite3"), "rosbag", one_clock=True),
    "ros 2 mcap": Layout(ros("recording", kind="mcap"), "rosbag", one_clock=True),
    "ros apart": Layout(ros("a.bag", apart=True), "rosbag"),
}


def test_the_same_recording_comes_back_from_every_layout(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, imu: ImuRecording, one_clock: ImuRecording
) -> None:
    for name in LAYOUTS:
        with subtests.test(name=name):
            tmp_path = tmp_path_factory.mktemp("given")
            layout = LAYOUTS[name]
            truth = one_clock if layout.one_clock else imu
            path = layout.write(tmp_path, truth)
            accepting = [candidate.name for candidate in imu_formats() if candidate.accepts(path)]
            assert accepting[0] == layout.format
            read = read_imu(path)
            assert read.repairs == ()
            # sensors of a video count from its first frame: only their times against each other are the recording's
            start = (
                truth.epoch_ns
                if layout.absolute
                else read.epoch_ns + round((read.gyro_t_s[0] - truth.gyro_t_s[0]) * 1e9)
            )
            shift = (read.epoch_ns - start) * 1e-9
            np.testing.assert_allclose(read.gyro_t_s + shift, truth.gyro_t_s, atol=layout.t_s, rtol=0)
            accel = truth.accel_t_s >= (truth.gyro_t_s[0] if name == "camm" else -1.0)
            np.testing.assert_allclose(read.accel_t_s + shift, truth.accel_t_s[accel], atol=layout.t_s, rtol=0)
            np.testing.assert_allclose(read.gyro_rad_s, truth.gyro_rad_s, atol=layout.gyro, rtol=0)
            np.testing.assert_allclose(read.accel_m_s2, truth.accel_m_s2[accel], atol=layout.accel, rtol=0)


@pytest.fixture(scope="module")
def filmed() -> tuple[SimulatedRecording, ImuRecording, float]:
    """A recording of 20 s, its IMU with both sensors at the same stamps, and the scale with that."""
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=20.0)), seed=3)
    together = replace(at_one_clock(recording.imu), epoch_ns=10**12)
    return recording, together, scale(recording, together)


def scale(recording: SimulatedRecording, imu: ImuRecording) -> float:
    found = estimate_scale(recording.trajectory, imu).metres_per_unit
    assert found is not None
    return found


@pytest.mark.parametrize(
    "name",
    [name for name in LAYOUTS if name not in ("gopro fusion", "sensor-logger android", "sensor-logger parts", "ros 1")],
)
def test_every_layout_gives_the_same_scale(tmp_path: Path, filmed, name: str) -> None:
    recording, together, expected = filmed
    # the interval's half-width is 1.2 %; what layouts round or smooth away is nothing beside it
    assert scale(recording, read_imu(LAYOUTS[name].write(tmp_path, together))) == pytest.approx(expected, rel=5e-4)


# --- what the recorders say about the frames ------------------------------------------------------------------------


def log_of(path: Path) -> FrameLog:
    log = read_frame_log(path)
    assert log is not None
    return log


def frame_times_ns(log: FrameLog) -> np.ndarray:
    return log.epoch_ns + np.rint(log.t_s * 1e9).astype(np.int64)


def test_video_imu_capture_gives_times_exposure_readout_and_lens(tmp_path: Path, one_clock: ImuRecording) -> None:
    log = log_of(imu_files.write_video_imu_capture(tmp_path, one_clock, FRAME_NS))
    np.testing.assert_array_equal(frame_times_ns(log), FRAME_NS)
    np.testing.assert_allclose(log.exposure_s, 5e-3 + 1e-9 * np.arange(200), atol=1e-12)
    assert log.readout_s == pytest.approx(0.021) and log.shared_clock and not log.in_video_time
    assert log.stabilised is True and log.stabilisation == "electronic"
    assert log.iso is not None and log.focal_px is not None
    assert set(log.iso) == {200.0} and set(log.focal_px) == {1500.25}


def test_mars_pairs_what_the_sensor_took_with_the_frames_of_the_video(tmp_path: Path, one_clock: ImuRecording) -> None:
    log = log_of(imu_files.write_mars(tmp_path, one_clock, FRAME_NS))
    np.testing.assert_array_equal(frame_times_ns(log), FRAME_NS // 1000 * 1000)
    # the first two pictures came before the video
    np.testing.assert_allclose(log.exposure_s, 5e-3 + 1e-6 * np.arange(2, 202), atol=1e-12)
    assert log.readout_s == pytest.approx(0.025)
    assert log.iso is not None and log.iso[0] == 102
    (tmp_path / "movie_metadata.csv").unlink()
    log = log_of(tmp_path)
    assert log.exposure_s is None and log.readout_s is None and len(log.t_s) == 200


def test_opencamera_and_stray_scanner_give_frame_times(tmp_path: Path, one_clock: ImuRecording) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    log = log_of(imu_files.write_opencamera(tmp_path / "a", one_clock, FRAME_NS))
    np.testing.assert_array_equal(frame_times_ns(log), FRAME_NS)
    log = log_of(imu_files.write_stray_scanner(tmp_path / "b", one_clock, FRAME_NS))
    np.testing.assert_allclose(frame_times_ns(log) - FRAME_NS, 0, atol=250)
    assert log.camera is not None
    # OpenCV's pixels become COLMAP's
    assert log.camera.params == (1591.5, 1592.5, 960.0, 720.0)
    assert (log.camera.width, log.camera.height) == (1920, 1440)


def test_gcsv_gives_the_readout(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, one_clock: ImuRecording
) -> None:
    for header, readout_s, direction in (
        ("", None, "down"),
        ("frame_readout_time,18.5", 0.0185, "down"),
        ("frame_readout_time,18.5\nframe_readout_direction,1", 0.0185, "up"),
        ("frame_readout_time,18.5\nframe_readout_direction,2", 0.0185, "right"),
        ("frame_readout_time,18.5\nframe_readout_direction,RightToLeft", 0.0185, "left"),
    ):
        with subtests.test(header=header, readout_s=readout_s, direction=direction):
            tmp_path = tmp_path_factory.mktemp("given")
            path = imu_files.write_gcsv(tmp_path / "a.gcsv", one_clock, header=header)
            log = log_of(path)
            assert (log.readout_s, log.readout_direction, len(log.t_s)) == (readout_s, direction, 0)
            assert read_imu(path).device == "simulated mycam_v2"


def test_camm_gives_exposure_and_readout(tmp_path: Path, imu: ImuRecording) -> None:
    log = log_of(imu_files.write_camm(tmp_path / "a.mp4", imu))
    assert log.in_video_time and log.shared_clock
    assert log.exposure_s is not None and set(log.exposure_s) == {0.004}
    assert log.readout_s == pytest.approx(0.021)


# --- whole captures -------------------------------------------------------------------------------------------------


def test_a_recorder_s_folder_is_a_capture(tmp_path: Path, one_clock: ImuRecording) -> None:
    from tests.io.test_video_frames import VARIABLE_MS, write_video

    frame_ns = FRAME_NS[: len(VARIABLE_MS)]
    imu_files.write_video_imu_capture(tmp_path, one_clock, frame_ns)
    write_video(tmp_path / "video_recording.mp4")
    capture = load_capture(tmp_path)
    assert isinstance(capture.frames, Video) and capture.shared_clock and capture.readout_s == pytest.approx(0.021)
    timing, frames = read_frames(capture)
    # the recorder's times, not the container's
    np.testing.assert_array_equal(timing.epoch_ns + np.rint(timing.t_s * 1e9).astype(np.int64), frame_ns)
    np.testing.assert_allclose(timing.exposure_s, 5e-3, atol=1e-7)
    assert [frame.exposure_s for frame in frames][:2] == [timing.exposure_s[0], timing.exposure_s[1]]
    assert len(read_capture_imu(capture).gyro_t_s) == len(one_clock.gyro_t_s)

    imu_files.write_video_imu_capture(tmp_path, one_clock, frame_ns[:-1])
    with pytest.raises(TimingError, match="has 12 frames, but its recorder logged the times of 11"):
        read_frame_timing(tmp_path)


def test_a_gopro_video_alone_is_a_capture(tmp_path: Path, imu: ImuRecording) -> None:
    video = imu_files.write_gopro(tmp_path / "GX010001.MP4", imu)
    (tmp_path / "capture.toml").write_text('video = "GX010001.MP4"\n')
    for path in (video, tmp_path):
        capture = load_capture(path)
        assert isinstance(capture.imu, ImuPath) and capture.imu.path == video and capture.imu.format == "gopro"
        assert capture.shared_clock and capture.readout_s == pytest.approx(0.0206)
        assert capture.frame_log is not None and capture.frame_log.stabilised is False
        assert capture.calibration.readout_s == capture.readout_s
    (tmp_path / "capture.toml").write_text(
        '[video]\nfile = "GX010001.MP4"\n[timing]\nreadout_s = 0.01\nshared_clock = false\n'
    )
    stated = load_capture(tmp_path)
    assert stated.readout_s == 0.01 and not stated.shared_clock
    # frame times of another clock: the IMU's stamps are on the video's
    (tmp_path / "capture.toml").write_text('[video]\nfile = "GX010001.MP4"\nframe_times = "t.csv"\n')
    assert not load_capture(tmp_path).shared_clock


def test_an_opencamera_folder_finds_its_video_beside_it(tmp_path: Path, imu: ImuRecording) -> None:
    folder = tmp_path / "20260101_120000"
    folder.mkdir()
    imu_files.write_opencamera(folder, imu, FRAME_NS)
    assert load_capture(folder).frames is None
    video = imu_files.write_mp4(tmp_path / "VID_20260101_120000.mp4", [imu_files.video_track(200)])
    found = load_capture(folder).frames
    assert isinstance(found, Video) and found.file.resolve() == video.resolve()


def test_a_gyroflow_log_beside_a_video_gives_the_readout(tmp_path: Path, one_clock: ImuRecording) -> None:
    header = "frame_readout_time,18.5\nframe_readout_direction,1"
    imu_files.write_gcsv(tmp_path / "a.gcsv", one_clock, header=header)
    stated = '[video]\nfile = "a.mp4"\n[imu]\npath = "a.gcsv"\n'
    (tmp_path / "capture.toml").write_text(stated)
    capture = load_capture(tmp_path)
    assert (capture.readout_s, capture.readout_direction, capture.shared_clock) == (0.0185, "up", False)
    (tmp_path / "capture.toml").write_text(stated + "[timing]\nreadout_s = 0.02\n")
    capture = load_capture(tmp_path)
    assert (capture.readout_s, capture.readout_direction) == (0.02, "up")


# --- refusals -------------------------------------------------------------------------------------------------------


def test_dji_says_what_still_works(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"no accelerometer.*no scale and no gravity.*still works.*deblurring"):
        read_imu(imu_files.write_dji(tmp_path / "DJI_0001.MP4"))


def test_a_gyroscope_alone_is_read_without_an_accelerometer(tmp_path: Path, imu: ImuRecording) -> None:
    folder = imu_files.write_opencamera(tmp_path, imu, FRAME_NS)
    next(folder.glob("*accel.csv")).unlink()
    assert not read_imu(folder).has_accel


def test_a_video_without_an_imu_says_so(tmp_path: Path) -> None:
    path = imu_files.write_mp4(tmp_path / "a.mp4", [imu_files.video_track(5)])
    with pytest.raises(FormatError) as refused:
        read_imu(path)
    assert refused.value.code == "video-without-imu"


def test_phyphox_is_read_whatever_delimiter_was_chosen(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, imu: ImuRecording
) -> None:
    for delimiter, decimal in ((",", "."), (";", ","), ("\t", ".")):
        with subtests.test(delimiter=delimiter, decimal=decimal):
            tmp_path = tmp_path_factory.mktemp("given")
            import zipfile

            path = imu_files.write_phyphox(tmp_path, imu, delimiter=delimiter, decimal=decimal)
            assert [one.name for one in imu_formats() if one.accepts(path)] == ["phyphox"]
            found = read_imu(path)
            assert found.device == "phyphox"
            np.testing.assert_allclose(found.gyro_rad_s, imu.gyro_rad_s, rtol=1e-8, atol=1e-12)
            np.testing.assert_allclose(found.accel_m_s2, imu.accel_m_s2, rtol=1e-8)
            np.testing.assert_allclose(np.diff(found.gyro_t_s), np.diff(imu.gyro_t_s), atol=2e-8)
            with zipfile.ZipFile(path) as archive:
                archive.extractall(tmp_path / "unpacked")
            np.testing.assert_array_equal(read_imu(tmp_path / "unpacked").accel_m_s2, found.accel_m_s2)


def test_phyphox_without_gravity_says_what_to_record(tmp_path: Path, imu: ImuRecording) -> None:
    with pytest.raises(FormatError, match=r"without gravity; record Accelerometer"):
        read_imu(imu_files.write_phyphox(tmp_path, imu, linear=True))


def test_sensor_logger_without_its_platform_or_gravity_is_refused(tmp_path: Path, imu: ImuRecording) -> None:
    import zipfile

    path = imu_files.write_sensor_logger(tmp_path, imu, tables="parts")
    folder = tmp_path / "unpacked"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    assert read_imu(folder).has_accel
    (folder / "Gravity.csv").unlink()
    with pytest.raises(FormatError, match=r"Accelerometer\.csv is without gravity"):
        read_imu(folder)
    (folder / "Accelerometer.csv").rename(folder / "TotalAcceleration.csv")
    (folder / "Metadata.csv").unlink()
    with pytest.raises(FormatError) as refused:
        read_imu(folder)
    assert refused.value.code == "sensor-logger-platform-unknown"


def test_stray_scanner_is_read_in_g_and_in_g_times_9_81_and_in_no_other_unit(tmp_path: Path, one_clock) -> None:
    folder = imu_files.write_stray_scanner(tmp_path, one_clock, FRAME_NS)
    lines = (folder / "imu.csv").read_text().splitlines()
    rows = [line.split(", ") for line in lines[1:]]

    def write(factor: float) -> None:
        scaled = [", ".join([t, *(repr(factor * float(a)) for a in row[:3]), *row[3:]]) for t, *row in rows]
        (folder / "imu.csv").write_text("\n".join([lines[0], *scaled]) + "\n")

    write(9.81)
    np.testing.assert_allclose(read_imu(folder).accel_m_s2, one_clock.accel_m_s2, atol=1e-9)
    write(9.80665)
    toml = tmp_path / "capture.toml"
    toml.write_text('[imu]\npath = "imu.csv"\n[imu.accel]\nunit = "m/s2"\n')
    np.testing.assert_allclose(read_imu(toml).accel_m_s2, one_clock.accel_m_s2, atol=1e-9)
    toml.unlink()
    write(3.0)
    with pytest.raises(FormatError, match=r"9\.8 m/s2"):
        read_imu(folder)


def test_a_rosbag_without_rosbags_names_the_extra(tmp_path: Path, monkeypatch, one_clock: ImuRecording) -> None:
    path = imu_files.write_rosbag(tmp_path / "a.bag", one_clock)
    real = builtins.__import__

    def without(name: str, *args: object, **kwargs: object) -> object:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match="extra `ros`: pip install 'rosbags"):
        read_imu(path)


def test_a_rosbag_with_two_imus_names_them(tmp_path: Path, one_clock: ImuRecording) -> None:
    from rosbags.rosbag1 import Reader, Writer

    one = imu_files.write_rosbag(tmp_path / "one.bag", one_clock)
    with Reader(one) as reader, Writer(tmp_path / "two.bag") as writer:
        messages = list(reader.messages())
        source = reader.connections[0]
        for topic in ("/a", "/b"):
            connection = writer.add_connection(topic, source.msgtype, msgdef=source.msgdef.data, md5sum=source.digest)
            for _, t_ns, data in messages:
                writer.write(connection, t_ns, data)
    with pytest.raises(FormatError, match=r"several topics with a gyroscope \(/a, /b\); keep one"):
        read_imu(tmp_path / "two.bag")


@loop_over(
    ("old", "new", "message"),
    [
        ("orientation,YxZ", "orientation,YyZ", r"line 5: orientation is 'YyZ'"),
        ("gscale,0.0002", "gscale,x", r"line 8: gscale is 'x'"),
        ("gscale,0.0002", "gscale,0", r"line 8: gscale is '0'"),
        ("tscale,0.00001", "tscale,1e30", "check tscale"),
        ("t,gx,gy,gz,ax,ay,az", "t,a,b,c,d,e,f", "line 10: names no columns gx, gy, gz"),
        ("t,gx,gy,gz,ax,ay,az", "", "no line that names its columns"),
    ],
)
def test_damage_in_a_gcsv_names_its_line(tmp_path: Path, one_clock: ImuRecording, old, new, message) -> None:
    path = imu_files.write_gcsv(tmp_path / "a.gcsv", one_clock)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises((FormatError, TimingError), match=message):
        read_imu(path)


def test_a_gcsv_of_a_gyroscope_alone_is_read(tmp_path: Path) -> None:
    t_ms = np.arange(400) * 5
    gyro_rad_s = np.random.default_rng(0).normal(size=(400, 3)).round(3)
    head = ["GYROFLOW IMU LOG", "version,1.3", "id,x", "orientation,XYZ", "tscale,0.001", "gscale,0.5", "t,gx,gy,gz"]
    rows = [f"{t},{x},{y},{z}" for t, (x, y, z) in zip(t_ms.tolist(), gyro_rad_s, strict=True)]
    (tmp_path / "a.gcsv").write_text("\n".join([*head, *rows]) + "\n")
    imu = read_imu(tmp_path / "a.gcsv")
    np.testing.assert_allclose(np.abs(imu.gyro_rad_s), np.abs(0.5 * gyro_rad_s))
    assert len(imu.accel_t_s) == 0
