"""Messages of VideoIMUCapture, written byte by byte as protobuf's wire format has them."""

import struct

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.units import DeclaredUnits
from colmap_inertial.io.video_imu_capture import read_video_imu_capture, read_video_imu_capture_frames


def number(value):
    """Seven bits a byte, the lowest first."""
    value &= (1 << 64) - 1
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def whole(field, value):
    return number(field << 3) + number(value)


def floats(field, *values):
    """Packed, as lists of numbers are."""
    return message(field, struct.pack(f"<{len(values)}f", *values))


def single(field, value):
    return number(field << 3 | 5) + struct.pack("<f", value)


def message(field, content):
    return number(field << 3 | 2) + number(len(content)) + content


def sample(k, *, accel=True, **changed):
    parts = {
        "t": whole(1, 5_000_000_000 + 10_000_000 * k),
        "gyro": floats(2, 0.1 * k, -0.2, 0.3),
        "drift": floats(3, 9.0, 9.0, 9.0),
        "accel": floats(4, 0.5, 9.7, 0.1 * k) if accel else b"",
    }
    return message(4, b"".join((parts | changed).values()))


def frame(k, **changed):
    parts = {
        "t": whole(1, 5_000_000_000 + 33_000_000 * k),
        "exposure": whole(3, 4_000_000 + 1000 * k),
        "duration": whole(4, 33_000_000),
        "readout": whole(5, 20_000_000),
        "iso": whole(6, 200),
        "focal": single(8, 1500.5),
        "unknown": number(15 << 3 | 1) + bytes(8),
    }
    return message(5, b"".join((parts | changed).values()))


def recorded(folder, *content):
    (folder / "video_meta.pb3").write_bytes(b"".join(content))
    return folder


def test_samples_are_numbers_as_they_were_sent(tmp_path):
    imu = read_video_imu_capture(recorded(tmp_path, *(sample(k) for k in range(60))), DeclaredUnits())
    assert imu.gyro_t_s == pytest.approx(0.01 * np.arange(60)) and imu.epoch_ns == 5_000_000_000
    assert imu.gyro_rad_s == pytest.approx(np.column_stack([0.1 * np.arange(60), np.full(60, -0.2), np.full(60, 0.3)]))
    assert imu.accel_m_s2[:, 2] == pytest.approx(0.1 * np.arange(60), abs=1e-6)
    alone = read_video_imu_capture(recorded(tmp_path, *(sample(k, accel=False) for k in range(60))), DeclaredUnits())
    assert not alone.has_accel and len(alone.gyro_t_s) == 60
    # lists that come number by number are none of its; a clock may be below zero
    split = {"gyro": single(2, 1.0) + single(2, 2.0) + single(2, 3.0)}
    with pytest.raises(FormatError, match="a sample that is not three numbers"):
        read_video_imu_capture(recorded(tmp_path, sample(0), sample(1, **split)), DeclaredUnits())
    before = [sample(k, t=whole(1, -7_000_000_000 + 10_000_000 * k)) for k in range(60)]
    assert read_video_imu_capture(recorded(tmp_path, *before), DeclaredUnits()).epoch_ns == -7_000_000_000


def test_what_cannot_be_samples_is_named(subtests, tmp_path_factory):
    for content, said in (
        ([sample(0, gyro=b""), sample(1, gyro=b"")], "holds no gyroscope samples"),
        ([sample(0), sample(1), sample(2, gyro=floats(2, 1.0, 2.0))], "IMU sample 3 has 8 bytes"),
        ([sample(0, gyro=whole(2, 7))], "not three numbers"),
        ([sample(0), number(3 << 3 | 3)], "wire type 3"),
        ([sample(0), sample(1)[:-1]], "are left"),
        ([sample(0), b"\x80"], "a number that does not end"),
        ([sample(0), b"\xff" * 11 + b"\x01"], "a number that does not end"),
    ):
        with subtests.test(last=content[-1][:16], said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            with pytest.raises(FormatError, match=said):
                read_video_imu_capture(recorded(tmp_path, *content), DeclaredUnits())


def test_frames_have_their_times_and_all_that_the_phone_says_of_them(tmp_path):
    log = read_video_imu_capture_frames(recorded(tmp_path, *(frame(k) for k in range(5)), sample(0)))
    assert log.t_s == pytest.approx(0.033 * np.arange(5)) and log.epoch_ns == 5_000_000_000
    assert log.exposure_s == pytest.approx(0.004 + 1e-6 * np.arange(5)) and log.readout_s == pytest.approx(0.02)
    assert log.iso == pytest.approx(np.full(5, 200)) and log.focal_px == pytest.approx(np.full(5, 1500.5))
    assert log.stabilised is None
    # what one frame does not say, or says out of all reason, is not known
    for changed in ({"exposure": b""}, {"exposure": whole(3, 10_000_000_000)}, {"exposure": whole(3, -1)}):
        assert read_video_imu_capture_frames(recorded(tmp_path, frame(0), frame(1, **changed))).exposure_s is None
    for changed in ({"readout": whole(5, 500_000_000)}, {"readout": whole(5, 0)}):
        assert read_video_imu_capture_frames(recorded(tmp_path, frame(0), frame(1, **changed))).readout_s is None
    assert read_video_imu_capture_frames(recorded(tmp_path, frame(0), frame(1, iso=whole(6, 0)))).iso is None


def test_a_moving_lens_or_the_camera_s_facts_tell_of_a_stabilised_picture(tmp_path):
    moved = {"unknown": single(10, 0.5)}
    for content, stabilised, words in (
        ([frame(0, **moved)], True, "optical"),
        ([message(2, whole(3, 1)), frame(0)], True, "optical"),
        ([message(2, whole(4, 1)), frame(0)], True, "electronic"),
        ([message(2, whole(3, 1) + whole(4, 1)), frame(0)], True, "optical and electronic"),
        ([message(2, whole(1, 9)), frame(0, **moved)], False, ""),
    ):
        log = read_video_imu_capture_frames(recorded(tmp_path, *content, frame(1)))
        assert (log.stabilised, log.stabilisation) == (stabilised, words)


def test_what_cannot_be_frames_is_named(subtests, tmp_path_factory):
    for content, said in (
        ([sample(0)], "holds no frames"),
        ([frame(0), frame(1, t=b"")], "a frame has no time"),
        ([frame(0), frame(1, iso=message(6, b"1"))], "a frame's number"),
    ):
        with subtests.test(said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            with pytest.raises(FormatError, match=said):
                read_video_imu_capture_frames(recorded(tmp_path, *content))
