"""GoPro telemetry: real recordings against what is known of them, clocks, axes, and what is said about the frames."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import FrameLog, ImuRecording
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.gpmf import entries, spread
from colmap_inertial.io.imu import read_frame_log, read_imu
from colmap_inertial.io.mp4 import read_movie
from colmap_inertial.io.video import video_stamps_ns
from tests.helpers import imu_files
from tests.helpers.simulated_imu import recorded
from tests.io.test_video_frames import write_video


@pytest.fixture(scope="module")
def imu() -> ImuRecording:
    return recorded(200.0, 200.0)


@pytest.fixture(scope="module")
def karma(shared_data: Path) -> Path:
    return shared_data / "gopro" / "karma.mp4"


@pytest.fixture(scope="module")
def max_heromode(shared_data: Path) -> Path:
    return shared_data / "gopro" / "max-heromode.mp4"


def log_of(path: Path) -> FrameLog:
    log = read_frame_log(path)
    assert log is not None
    return log


def rate_hz(t_s: np.ndarray) -> float:
    return float((len(t_s) - 1) / (t_s[-1] - t_s[0]))


# --- real recordings ------------------------------------------------------------------------------------------------


def stream_bodies(path: Path, key: bytes) -> list[tuple[int, np.ndarray]]:
    """An independent, naive look at a stream: stamp in ms of each payload, and its raw rows."""
    movie = read_movie(path)
    track = movie.track(entry="gpmd")
    assert track is not None
    found = []
    for payload in movie.samples(track):
        at = payload.find(key + b"s")
        tick = payload.rfind(b"TICKL", 0, at)
        count = struct.unpack_from(">H", payload, at + 6)[0]
        rows = np.frombuffer(payload, ">i2", 3 * count, at + 8).reshape(-1, 3)
        found.append((struct.unpack_from(">I", payload, tick + 8)[0], rows))
    return found


def test_karma_s_sensors_are_each_at_their_own_rate_and_time(karma: Path) -> None:
    imu = read_imu(karma)
    assert imu.device == "GoPro HD5.02.02.00.00" and imu.repairs == ()
    assert rate_hz(imu.gyro_t_s) == pytest.approx(397.54, abs=0.05)
    assert rate_hz(imu.accel_t_s) == pytest.approx(198.77, abs=0.05)
    # both sensors run from the first payload to the end of the last; HERO5's ticks jitter by two milliseconds
    assert imu.accel_t_s[0] - imu.gyro_t_s[0] == pytest.approx(0, abs=2e-3)
    assert imu.accel_t_s[-1] - imu.gyro_t_s[-1] == pytest.approx(0, abs=8e-3)
    for key, scale, t_s, values in (
        (b"GYRO", 3755, imu.gyro_t_s, imu.gyro_rad_s),
        (b"ACCL", 418, imu.accel_t_s, imu.accel_m_s2),
    ):
        bodies = stream_bodies(karma, key)
        np.testing.assert_allclose(values, np.concatenate([rows for _, rows in bodies])[:, [1, 2, 0]] / scale)
        starts = np.cumsum([0, *(len(rows) for _, rows in bodies[:-1])])
        off_s = (t_s[starts] - t_s[0]) - (np.array([tick for tick, _ in bodies]) - bodies[0][0]) * 1e-3
        assert np.abs(off_s).max() < 3.5e-3
    # upright, hovering: gravity along +z
    assert np.median(imu.accel_m_s2, axis=0) == pytest.approx([0, 0, 9.7], abs=0.3)


def test_the_temperature_beside_the_samples_is_the_recording_s(karma: Path, max_heromode: Path) -> None:
    for path in (karma, max_heromode):
        content = path.read_bytes()
        said = [content[at + 8 : at + 12] for at in range(len(content)) if content.startswith(b"TMPCf\x04\x00\x01", at)]
        assert len(said) > 20
        median = np.median([struct.unpack(">f", four)[0] for four in said])
        assert read_imu(path).temperature_c == pytest.approx(median, abs=0.5)


def test_an_impossible_temperature_is_none(tmp_path: Path, imu: ImuRecording) -> None:
    for name, degrees, read in (("warm", 41.5, 41.5), ("none", None, None), ("odd", float("nan"), None)):
        path = tmp_path / f"{name}.mp4"
        imu_files.write_gopro(path, imu, imu_files.GoPro(temperature_c=degrees))
        assert read_imu(path).temperature_c == read


def test_a_temperature_that_is_no_number_spoils_no_recording(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, imu: ImuRecording
) -> None:
    for kind in (b"c", b"F", b"?"):
        with subtests.test(kind=kind):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "text.mp4"
            imu_files.write_gopro(path, imu, imu_files.GoPro(temperature_c=41.5, temperature_as=(kind, 4)))
            found = read_imu(path)
            assert found.temperature_c is None and len(found.gyro_t_s) == len(imu.gyro_t_s)


def test_karma_s_frames_have_exposures_and_no_readout(karma: Path) -> None:
    log = log_of(karma)
    np.testing.assert_array_equal(log.epoch_ns + np.rint(log.t_s * 1e9).astype(np.int64), video_stamps_ns(karma))
    assert log.exposure_s is not None and len(log.exposure_s) == 362
    assert log.exposure_s[0] == pytest.approx(4.87029e-3, abs=1e-8)
    assert log.iso is not None and log.iso[0] == pytest.approx(141.4, abs=0.1)
    assert log.readout_s is None and log.stabilised is None
    timing = read_frame_timing(karma)
    np.testing.assert_array_equal(timing.exposure_s, log.exposure_s)


def test_max_s_clock_is_in_microseconds_and_leads_the_video_by_five_milliseconds(max_heromode: Path) -> None:
    imu = read_imu(max_heromode)
    assert imu.device == "GoPro Max"
    assert rate_hz(imu.gyro_t_s) == pytest.approx(197.455, abs=0.001)
    np.testing.assert_array_equal(imu.gyro_t_s, imu.accel_t_s)
    assert imu.epoch_ns == pytest.approx(-5.03e6, abs=5e4)
    assert np.median(np.linalg.norm(imu.accel_m_s2, axis=1)) == pytest.approx(9.64, abs=0.01)


def test_max_says_readout_exposure_and_stabilisation(max_heromode: Path) -> None:
    log = log_of(max_heromode)
    assert log.readout_s == pytest.approx(20.6008e-3, abs=1e-7)
    assert log.exposure_s is not None and log.exposure_s[0] == pytest.approx(1.0078e-3, abs=1e-7)
    assert log.stabilised is True and "EISE=Y" in log.stabilisation


def test_max_s_gravity_and_orientation_are_in_the_axes_of_its_imu(max_heromode: Path) -> None:
    from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
    from colmap_inertial.core.gyro import GyroPath

    imu, log = read_imu(max_heromode), log_of(max_heromode)
    assert log.up_in_imu is not None and log.start_from_imu_xyzw is not None
    shift_s = (imu.epoch_ns - log.epoch_ns) * 1e-9
    smooth = np.stack([np.convolve(column, np.ones(100) / 100, "same") for column in imu.accel_m_s2.T], axis=1)
    force = np.stack([np.interp(log.t_s, imu.accel_t_s + shift_s, column) for column in smooth.T], axis=1)[20:-20]
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    angle_deg = np.degrees(np.arccos(np.sum(force * log.up_in_imu[20:-20], axis=1)))
    assert np.median(angle_deg) < 3
    path = GyroPath(imu.gyro_t_s + shift_s, imu.gyro_rad_s, np.zeros(3))
    felt = path.at(log.t_s)[0]
    turns = [quat_log(quat_multiply(quat_conjugate(q[:-1]), q[1:])) for q in (felt, log.start_from_imu_xyzw)]
    for axis in range(3):
        assert np.corrcoef(turns[0][:, axis], turns[1][:, axis])[0, 1] > 0.9


@pytest.mark.slow
def test_karma_turns_as_its_gyroscope_says(karma: Path) -> None:
    import pycolmap

    from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
    from colmap_inertial.core.gyro import GyroPath
    from colmap_inertial.io.frames import read_frames
    from colmap_inertial.motion.flow import measure_rotation, reduce_frames

    timing, frames = read_frames(karma)
    # the drone hovers until the last second, and turns in it
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 450.0, 854, 480)
    seen = measure_rotation(reduce_frames(frame for i, frame in enumerate(frames) if i >= 310), camera, timing)
    imu = read_imu(karma)
    path = GyroPath(imu.gyro_t_s + (imu.epoch_ns - timing.epoch_ns) * 1e-9, imu.gyro_rad_s, np.zeros(3))

    def agreement(offset_s: float) -> float:
        """Correlation about the vertical, the one axis that the gimballed drone turns about: camera y is down."""
        q = path.at(seen.t_s - offset_s)[0]
        felt = quat_log(quat_multiply(quat_conjugate(q[:-1]), q[1:]))
        known = np.isfinite(seen.turn_rad).all(axis=1)
        return float(np.corrcoef(seen.turn_rad[known, 1], -felt[known, 2])[0, 1])

    offsets_s = np.arange(-0.2, 0.2, 0.004)
    found = [agreement(offset) for offset in offsets_s]
    # HERO5 ties its telemetry to the video to within two frames; that much is left to the alignment
    assert agreement(0.0) >= 0.95 and max(found) >= 0.995
    assert abs(offsets_s[int(np.argmax(found))]) < 0.08


# --- layouts --------------------------------------------------------------------------------------------------------


def test_any_stated_channel_order_gives_the_same_axes(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, imu: ImuRecording
) -> None:
    for order in ("XzY", "YxZ", "ZXY", "yXZ", "zYX"):
        for with_matrix in (True, False):
            with subtests.test(order=order, with_matrix=with_matrix):
                tmp_path = tmp_path_factory.mktemp("given")
                path = imu_files.write_gopro(tmp_path / "a.mp4", imu, replace(imu_files.MAX, order=order))
                if not with_matrix:
                    path.write_bytes(path.read_bytes().replace(b"MTRX", b"mtrx"))
                np.testing.assert_allclose(read_imu(path).gyro_rad_s, imu.gyro_rad_s, atol=0.6 / 939)


def test_samples_that_were_lost_leave_a_gap_and_nothing_else(tmp_path: Path, imu: ImuRecording) -> None:
    path = imu_files.write_gopro(tmp_path / "a.mp4", imu)
    whole = read_imu(path)
    lost = (imu.gyro_t_s > 5.30) & (imu.gyro_t_s < 5.40)
    holed = replace(imu, gyro_t_s=imu.gyro_t_s[~lost], gyro_rad_s=imu.gyro_rad_s[~lost])
    read = read_imu(imu_files.write_gopro(path, holed))
    steps = np.diff(read.gyro_t_s)
    assert (steps > 0.05).sum() == 1 and steps.max() == pytest.approx(0.105, abs=0.006)
    # payloads before and after keep their times
    for side in (whole.gyro_t_s < 4.0, whole.gyro_t_s > 7.5):
        np.testing.assert_allclose(read.gyro_t_s[side[~lost]], whole.gyro_t_s[side], atol=2e-5)


def test_jitter_of_stamps_is_smoothed_and_drift_of_the_clock_is_followed() -> None:
    rng = np.random.default_rng(3)
    count = np.full(1800, 200)
    index = np.arange(360_001)
    # a clock that is 0.4 % fast and drifts by 30 ppm over half an hour
    true_ns = 1e9 / 200.8 * (index + 30e-6 * index**2 / 360_000)
    stamps = np.rint(true_ns[:-1:200] / 1e6 + rng.uniform(-1.5, 1.5, 1800)) * 1e6
    off_ns = spread(stamps.astype(np.int64), count, 15, 0.02) - true_ns[:-1]
    assert np.abs(off_ns).max() < 2e6 and np.std(off_ns) < 0.25e6


def test_payloads_without_stamps_are_timed_by_how_many_samples_they_hold() -> None:
    rng = np.random.default_rng(4)
    # a payload is closed every 1.001 s, a few samples early or late; the first holds 17 from before the recording
    closed = np.arange(1, 61) * 1.001 + rng.uniform(-0.01, 0.01, 60)
    count = np.diff(np.floor(closed * 201.9).astype(np.int64), prepend=-17)
    spread_ns = spread(np.rint(np.arange(60) * 1.001e9).astype(np.int64), count, 15, 0.05)
    off_s = spread_ns * 1e-9 - (np.arange(count.sum()) - 17) / 201.9
    assert np.abs(off_s).max() < 0.012 and (np.diff(spread_ns) > 0).all()
    assert spread_ns[0] == pytest.approx(-17e9 / 201.9, abs=12e6)


def test_settings_decide_readout_and_stabilisation(tmp_path: Path, imu: ImuRecording) -> None:
    def settings(*parts: bytes) -> FrameLog:
        style = replace(imu_files.MAX, settings=imu_files.nest(b"DEVC", *parts))
        return log_of(imu_files.write_gopro(tmp_path / "a.mp4", imu, style))

    assert settings(imu_files.text(b"EISE", b"Y"), imu_files.text(b"EISA", b"HS Boost")).stabilised is True
    assert settings(imu_files.text(b"EISE", b"N")).stabilised is False
    srot = imu_files.klv(b"SROT", b"f", 4, struct.pack(">f", 15.5))
    assert settings(srot, imu_files.text(b"OREN", b"U")).readout_s == pytest.approx(15.5e-3)
    # upside down the picture is turned, and nothing says which way its rows are read
    assert settings(srot, imu_files.text(b"OREN", b"D")).readout_s is None
    nothing = settings(imu_files.text(b"MINF", b"HERO9 Black"))
    assert nothing.stabilised is None and nothing.readout_s is None


def test_the_readout_may_be_noted_frame_by_frame(tmp_path: Path, imu: ImuRecording) -> None:
    style = replace(imu_files.HERO6, readout_ms=15.25)
    assert log_of(imu_files.write_gopro(tmp_path / "a.mp4", imu, style)).readout_s == pytest.approx(15.25e-3)


def test_a_device_s_tick_stamps_streams_without_one(tmp_path: Path, imu: ImuRecording) -> None:
    own = read_imu(imu_files.write_gopro(tmp_path / "a.mp4", imu, imu_files.HERO5))
    read = read_imu(imu_files.write_gopro(tmp_path / "b.mp4", imu, replace(imu_files.HERO5, clock="DEVC")))
    np.testing.assert_allclose(read.gyro_t_s, own.gyro_t_s, atol=3e-3)


def test_exposures_belong_to_frames_by_time(tmp_path: Path, imu: ImuRecording) -> None:
    log = log_of(imu_files.write_gopro(tmp_path / "a.mp4", imu))
    np.testing.assert_allclose(log.exposure_s, 1e-3 * (1 + np.arange(len(log.t_s)) % 7), atol=1e-9)


def test_telemetry_of_another_device_beside_the_camera_is_left_alone(tmp_path: Path, imu: ImuRecording) -> None:
    other = imu_files.nest(
        b"DEVC",
        imu_files.klv(b"DVID", b"L", 4, b"\0\0\1\1"),
        imu_files.text(b"DVNM", b"Heart rate belt"),
        imu_files.nest(b"STRM", imu_files.klv(b"ACCL", b"s", 6, bytes(60))),
    )
    read = read_imu(imu_files.write_gopro(tmp_path / "a.mp4", imu, replace(imu_files.MAX, extra=other)))
    assert len(read.accel_t_s) == len(imu.accel_t_s)


def test_a_video_without_a_gyroscope_is_refused(tmp_path: Path, imu: ImuRecording) -> None:
    path = imu_files.write_gopro(tmp_path / "a.mp4", imu)
    path.write_bytes(path.read_bytes().replace(b"GYRO", b"XXXX"))
    with pytest.raises(FormatError, match=r"no gyroscope \(GYRO\): HERO5 and later write one"):
        read_imu(path)


def test_an_entry_beyond_its_payload_names_the_byte() -> None:
    with pytest.raises(ValueError, match=r"entry b'GYRO' at byte 0 of the payload states 600 bytes; 12 left"):
        list(entries(struct.pack(">4scBH", b"GYRO", b"s", 6, 100) + bytes(12)))


def test_numbers_are_read_by_their_type(subtests) -> None:
    for kind, packed, values in (
        ("b", "b", (-3, 100)),
        ("B", "B", (3, 200)),
        ("s", "h", (-300, 30000)),
        ("S", "H", (300, 60000)),
        ("l", "i", (-70000, 2**30)),
        ("L", "I", (70000, 2**31)),
        ("j", "q", (-(2**40), 5)),
        ("J", "Q", (2**40, 5)),
        ("f", "f", (-0.25, 1e6)),
        ("d", "d", (-0.1, 1e300)),
    ):
        with subtests.test(kind=kind, packed=packed, values=values):
            data = struct.pack(f">{2 * packed}", *values)
            (alone,) = entries(
                struct.pack(">4scBH", b"DATA", kind.encode(), len(data) // 2, 2) + data + bytes(-len(data) % 4)
            )
            assert alone.numbers().tolist() == [[value] for value in values]
            (both,) = entries(struct.pack(">4scBH", b"DATA", b"?", len(data), 1) + data + bytes(-len(data) % 4))
            assert both.numbers(2 * kind).tolist() == [list(values)]


def test_fixed_point_numbers_are_fractions_also_among_others() -> None:
    """Sixteen bits behind the point, or thirty-two."""
    for kind, packed, one in ((b"q", "i", 2**16), (b"Q", "q", 2**32)):
        size = struct.calcsize(packed)
        data = struct.pack(f">2{packed}", -3 * one // 4, 5 * one)
        (alone,) = entries(struct.pack(">4scBH", b"DATA", kind, 2 * size, 1) + data)
        assert alone.numbers().tolist() == [[-0.75, 5.0]]
    data = struct.pack(">hiq", 7, 2**15, 2**33)
    (mixed,) = entries(struct.pack(">4scBH", b"DATA", b"?", len(data), 1) + data + bytes(2))
    assert mixed.numbers("sqQ").tolist() == [[7, 0.5, 2]]


def test_samples_of_no_known_type_or_another_size_are_refused(subtests) -> None:
    for kind, members in ((b"x", ""), (b"s", ""), (b"?", "s"), (b"?", "sx"), (b"?", "")):
        with subtests.test(kind=kind, members=members):
            (entry,) = entries(struct.pack(">4scBH", b"DATA", kind, 3, 1) + bytes(4))
            with pytest.raises(ValueError, match="DATA holds samples of 3 bytes"):
                entry.numbers(members)


# --- the container --------------------------------------------------------------------------------------------------


def test_frame_times_of_the_index_are_ffmpeg_s(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for suffix in ("mp4", "mov"):
        for b_frames in (0, 2):
            with subtests.test(suffix=suffix, b_frames=b_frames):
                tmp_path = tmp_path_factory.mktemp("given")
                path = write_video(tmp_path / f"a.{suffix}", b_frames=b_frames)
                track = read_movie(path).track(handler="vide")
                assert track is not None and (track.width_px, track.height_px) == (64, 48)
                # the edit list's delay is in ticks of the movie's clock: a millisecond
                np.testing.assert_allclose(np.sort(track.t_ns), video_stamps_ns(path), atol=1_000_000)


def test_chunks_offsets_and_edit_lists_are_followed(tmp_path: Path) -> None:
    samples = [bytes([i]) * (3 + i % 5) for i in range(23)]
    for chunk, long_offsets in ((1, False), (4, True), (23, False)):
        track = imu_files.Mp4Track(b"meta", b"test", samples, [10] * 23, 1000, (250, 20), chunk, (0, 0), long_offsets)
        path = imu_files.write_mp4(tmp_path / "a.mp4", [imu_files.video_track(9), track])
        movie = read_movie(path)
        read = movie.track(entry="test")
        assert read is not None and movie.samples(read) == samples
        # 250 ms of nothing, then from 20 ms into the media
        np.testing.assert_array_equal(read.t_ns, (np.arange(23) * 10 + 230) * 1_000_000)


def test_sound_is_passed_over_and_a_track_of_endless_samples_refused(tmp_path: Path) -> None:
    sound = imu_files.Mp4Track(b"soun", b"sowt", [b"1234"] * 5, [1] * 5, 48000)
    path = imu_files.write_mp4(tmp_path / "a.mp4", [sound, imu_files.video_track(3)])
    assert [track.handler for track in read_movie(path).tracks] == ["vide"]
    data = bytearray(path.read_bytes())
    at = data.rindex(b"stsz") + 8
    data[at : at + 8] = struct.pack(">II", 1, 1 << 31)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="2147483648 samples of 1 bytes"):
        read_movie(path)


def test_boxes_with_64_bit_sizes_are_read(tmp_path: Path) -> None:
    path = imu_files.write_mp4(tmp_path / "a.mp4", [imu_files.video_track(3)])
    data = path.read_bytes()
    at = data.index(b"mdat") - 4
    moov = data[data.index(b"moov") - 4 :]
    body = data[at + 8 : len(data) - len(moov)]
    path.write_bytes(data[:at] + struct.pack(">I4sQ", 1, b"mdat", 16 + len(body)) + body + moov)
    assert read_movie(path).tracks[0].entry == "avc1"
