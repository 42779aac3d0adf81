"""Damaged recordings of cameras and apps: an error of ours that names the file, never a crash, never a hang."""

import contextlib
import dataclasses
import resource
import sqlite3
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.imu import read_frame_log, read_imu
from colmap_inertial.io.tables import text_of
from tests.helpers import imu_files
from tests.helpers.damage import mutated
from tests.helpers.files import write_anew
from tests.helpers.simulated_imu import FRAME_NS, recorded

MUTATIONS = 100
#: Sizes that a damaged box or entry may state.
SIZES = (0, 1, 7, 8, 9, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


@pytest.fixture(scope="module")
def imu() -> ImuRecording:
    """Two seconds of both sensors at the same stamps."""
    whole = recorded(100.0, 100.0)
    n = 200
    return ImuRecording(
        gyro_t_s=whole.accel_t_s[:n],
        gyro_rad_s=whole.gyro_rad_s[:n],
        accel_t_s=whole.accel_t_s[:n],
        accel_m_s2=whole.accel_m_s2[:n],
        epoch_ns=whole.epoch_ns,
    )


def damaged(data: bytes, rng: np.random.Generator, *, binary: bool) -> bytes:
    """The text fuzzer's mutations; in binary files mostly wrong sizes and counts, near the end where the index is."""
    if not binary or rng.random() < 0.3:
        return mutated(data, rng)
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        tail = rng.random() < 0.7
        at = int(rng.integers(max(0, len(out) - 1200) if tail else 0, len(out) - 4))
        match rng.integers(0, 3):
            case 0:
                out[at : at + 4] = struct.pack(">I", SIZES[rng.integers(0, len(SIZES))])
            case 1:
                out[at] = int(rng.integers(0, 256))
            case 2:
                names = [
                    i for i in (out.find(n) for n in (b"stbl", b"stsz", b"stco", b"STRM", b"GYRO", b"SCAL")) if i > 4
                ]
                if names:
                    place = names[rng.integers(0, len(names))] + int(rng.choice([-4, 4]))
                    out[place : place + 4] = struct.pack(">I", SIZES[rng.integers(0, len(SIZES))])
    return bytes(out)


def in_folder(write: Callable, name: str) -> Callable[[Path, ImuRecording], tuple[Path, Path]]:
    """A writer of a folder: what to read, and the file in it to damage."""
    return lambda folder, imu: (write(folder, imu, FRAME_NS[:40]), folder / name)


def alone(write: Callable, name: str, *args: object) -> Callable[[Path, ImuRecording], tuple[Path, Path]]:
    return lambda folder, imu: (write(folder / name, imu, *args),) * 2


def zipped(folder: Path, imu: ImuRecording) -> tuple[Path, Path]:
    return (imu_files.write_sensor_logger(folder, imu),) * 2


def ros2(folder: Path, imu: ImuRecording) -> tuple[Path, Path]:
    path = imu_files.write_rosbag(folder / "recording", imu, kind="mcap")
    return path, next(path.glob("*.mcap"))


RECORDERS = {
    "gopro max": (alone(imu_files.write_gopro, "a.mp4"), True),
    "gopro hero5": (alone(imu_files.write_gopro, "a.mp4", imu_files.HERO5), True),
    "camm": (alone(imu_files.write_camm, "a.mp4"), True),
    "gcsv": (alone(imu_files.write_gcsv, "a.gcsv"), False),
    "video-imu-capture": (in_folder(imu_files.write_video_imu_capture, "video_meta.pb3"), True),
    "opencamera": (in_folder(imu_files.write_opencamera, "VID_20260101_120000_gyro.csv"), False),
    "opencamera times": (in_folder(imu_files.write_opencamera, "VID_20260101_120000_timestamps.csv"), False),
    "mars": (in_folder(imu_files.write_mars, "gyro_accel.csv"), False),
    "mars frames": (in_folder(imu_files.write_mars, "movie_metadata.csv"), False),
    "stray": (in_folder(imu_files.write_stray_scanner, "imu.csv"), False),
    "stray odometry": (in_folder(imu_files.write_stray_scanner, "odometry.csv"), False),
    "stray matrix": (in_folder(imu_files.write_stray_scanner, "camera_matrix.csv"), False),
    "sensor-logger": (zipped, True),
    "ros 1": (alone(imu_files.write_rosbag, "a.bag"), True),
    "ros 2": (ros2, True),
}


PACKED = [("ros1", "bz2"), ("ros1", "lz4"), ("mcap", "zstd"), ("sqlite3", "zstd")]


def write_packed(folder: Path, imu: ImuRecording, kind: str, packed_by: str, more: bytes = b"") -> Path:
    name = "a.bag" if kind == "ros1" else "a"
    return imu_files.write_rosbag(folder / name, imu, kind=kind, packed_by=packed_by, more=more)


def test_packed_ros_recordings_are_read_as_others(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, imu: ImuRecording
) -> None:
    for kind, packed_by in PACKED:
        with subtests.test(kind=kind, packed_by=packed_by):
            tmp_path = tmp_path_factory.mktemp("given")
            (tmp_path / "packed").mkdir()
            whole = read_imu(write_packed(tmp_path, imu, kind, ""))
            packed = read_imu(write_packed(tmp_path / "packed", imu, kind, packed_by))
            for field in dataclasses.fields(ImuRecording):
                if field.name == "source":  # where the files are
                    continue
                np.testing.assert_array_equal(getattr(packed, field.name), getattr(whole, field.name))


@pytest.mark.parametrize(("kind", "packed_by"), PACKED)
def test_ros_recordings_that_unpack_to_much_more_are_refused(
    tmp_path: Path, imu: ImuRecording, kind: str, packed_by: str
) -> None:
    path = write_packed(tmp_path, imu, kind, packed_by, bytes(100 << 20))
    size = sum(file.stat().st_size for file in path.iterdir()) if path.is_dir() else path.stat().st_size
    assert size < 3e6
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as refused:
            read_imu(path)
        assert refused.value.code == "bag-out-of-proportion"
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()


def test_a_bag_whose_index_names_a_chunk_twice_is_refused(tmp_path: Path, imu: ImuRecording) -> None:
    path = write_packed(tmp_path, imu, "ros1", "")
    data = path.read_bytes()
    (index,) = struct.unpack_from("<Q", data, data.index(b"index_pos=") + 10)
    at = index  # of the one connection, then of the one chunk
    for _ in range(2):
        at += 4 + struct.unpack_from("<I", data, at)[0]
    many = data.replace(b"chunk_count=\1", b"chunk_count=\5") + 4 * data[at:]
    write_anew(path, many)
    with pytest.raises(FormatError) as refused:
        read_imu(path)
    assert refused.value.code == "bag-index-repeats"


@pytest.mark.parametrize("name", RECORDERS)
def test_only_errors_of_our_own_escape(tmp_path: Path, imu: ImuRecording, name: str) -> None:
    write, binary = RECORDERS[name]
    path, victim = write(tmp_path, imu)
    whole = victim.read_bytes()
    read_imu(path)
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    refused = 0
    for i in range(MUTATIONS if "ros" not in name else MUTATIONS // 4):
        data = damaged(whole, rng, binary=binary)
        write_anew(victim, data)
        failed = False
        for read in (read_imu, read_frame_log, load_capture):
            try:
                read(path)
            except InertialError as error:
                failed = True
                assert str(tmp_path) in str(error) and "\n\n" not in str(error)
            except Exception as error:
                error.add_note(f"mutation {i} of {name}, read by {read.__name__}")
                victim.with_suffix(".damaged").write_bytes(data)
                raise
        refused += failed
    assert refused > 0


# --- damage that has a name ------------------------------------------------------------------------------------------


@pytest.fixture
def gopro(tmp_path: Path, imu: ImuRecording) -> Path:
    return imu_files.write_gopro(tmp_path / "GX010001.MP4", imu)


def refused(path: Path) -> str:
    with pytest.raises(FormatError) as caught:
        read_imu(path)
    return str(caught.value)


def with_size(path: Path, name: bytes, size: int) -> None:
    data = path.read_bytes()
    at = data.index(name) - 4
    path.write_bytes(data[:at] + struct.pack(">I", size) + data[at + 4 :])


def test_a_recording_that_was_not_finished_says_so(gopro: Path) -> None:
    data = gopro.read_bytes()
    gopro.write_bytes(data[: data.index(b"moov") - 4])
    assert "the recording was not finished" in refused(gopro)


@pytest.mark.parametrize("size", [1, 7, 0xFFFFFFFF])
def test_a_box_of_a_wrong_size_is_named_with_its_byte(gopro: Path, size: int) -> None:
    at = gopro.read_bytes().index(b"stbl") - 4
    with_size(gopro, b"stbl", size)
    assert f"is damaged at byte {at}: the box 'stbl' states a size of" in refused(gopro)


def test_a_box_that_ends_beyond_the_file_is_named(gopro: Path) -> None:
    at = gopro.read_bytes().index(b"moov") - 4
    with_size(gopro, b"moov", 1 << 20)
    assert f"its index at byte {at} ends beyond the file" in refused(gopro)


def test_a_box_of_size_zero_cannot_hold_the_reader(gopro: Path) -> None:
    with_size(gopro, b"stsz", 0)
    refused(gopro)


def test_samples_beyond_the_file_are_named(gopro: Path) -> None:
    data = bytearray(gopro.read_bytes())
    at = data.rindex(b"stco") + 12
    data[at : at + 4] = struct.pack(">I", 1 << 30)
    gopro.write_bytes(data)
    assert "sample 1 of the gpmd track at byte 1073741824 ends beyond the file" in refused(gopro)


def test_an_entry_of_a_wrong_size_names_payload_and_byte(gopro: Path) -> None:
    data = bytearray(gopro.read_bytes())
    at = data.index(b"GYROs")
    data[at + 6 : at + 8] = b"\xff\xff"
    gopro.write_bytes(data)
    assert "is damaged in telemetry payload 1 at byte" in refused(gopro)


def test_a_truncated_protobuf_names_the_byte(tmp_path: Path, imu: ImuRecording) -> None:
    imu_files.write_video_imu_capture(tmp_path, imu, FRAME_NS[:40])
    file = tmp_path / "video_meta.pb3"
    file.write_bytes(file.read_bytes()[:-3])
    message = refused(tmp_path)
    assert "video_meta.pb3: is damaged at byte" in message and "are left" in message


def test_text_that_is_not_utf_8_names_the_line(tmp_path: Path, imu: ImuRecording) -> None:
    path = imu_files.write_gcsv(tmp_path / "a.gcsv", imu)
    lines = path.read_bytes().split(b"\n")
    lines[20] = b"1,\xff\xfe,3,4,5,6,7"
    path.write_bytes(b"\n".join(lines))
    assert "line 21" in refused(path)


def test_a_table_said_to_be_larger_than_its_zip_takes_no_more_memory(tmp_path: Path, imu: ImuRecording) -> None:
    path, _ = zipped(tmp_path, imu)
    with zipfile.ZipFile(path) as archive:
        info = next(info for info in archive.infolist() if info.filename.endswith(".csv"))
    whole = text_of(path, info.filename)
    data = path.read_bytes()
    at = data.index(b"PK\1\2")  # the first entry of the directory; at 20 its compressed size
    path.write_bytes(data[: at + 20] + struct.pack("<I", 2**31 - 2) + data[at + 24 :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        assert text_of(path, info.filename) == whole
    except FormatError as error:  # some versions of Python refuse it themselves
        assert "Overlapped entries" in str(error)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_view_in_place_of_messages_is_refused(tmp_path: Path, imu: ImuRecording) -> None:
    path = imu_files.write_rosbag(tmp_path / "a", imu, kind="sqlite3")
    with contextlib.closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.executescript("""
            DROP TABLE messages;
            CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 1000000000000)
            SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(300) AS data FROM n""")
    with pytest.raises(FormatError, match="it holds the view 'messages', which is not run"):
        read_imu(path)
