"""What would take all memory, or never end, is refused before it does."""

import os
import resource
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from colmap_inertial.errors import FormatError, InertialError
from colmap_inertial.io.files import LARGEST_BYTES, first_line, read_bytes, read_json, read_yaml
from colmap_inertial.io.frame_times import stamps_of_csv
from colmap_inertial.io.images import MOST_PIXELS, _stated_size, read_image
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.tables import MOST_COLUMNS, read_table
from colmap_inertial.io.video import video_stamps_ns
from colmap_inertial.options import ReconstructOptions
from colmap_inertial.run.config import read_config
from colmap_inertial.view.images import read_preview


def png(width, height):
    """All chunks of a black picture of this size, its rows packed to almost nothing."""
    packer, rows = zlib.compressobj(9), []
    line = bytes(1 + (width + 7) // 8)
    for _ in range(height // 100):
        rows.append(packer.compress(line * 100))
    data = b"".join(rows) + packer.flush()

    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def jpeg(width, height):
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


@pytest.mark.parametrize(("encode", "side"), [(png, 20000), (jpeg, 20000), (jpeg, 65535)])
def test_a_picture_of_too_many_pixels_is_not_decoded(tmp_path, encode, side):
    path = tmp_path / "large.png"
    path.write_bytes(encode(side, side))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FormatError, match=r"large\.png: has \d+ x \d+ pixels; more than 250 million are not decoded"):
        read_image(path)
    assert read_preview(path, 100)[0] is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


KINDS = [(suffix, np.uint8) for suffix in (".png", ".jpg", ".bmp", ".pgm", ".tif")]


@pytest.mark.parametrize(("suffix", "dtype"), [*KINDS, (".png", np.uint16), (".pgm", np.uint16), (".tif", np.uint16)])
def test_the_size_is_told_by_the_header(tmp_path, suffix, dtype):
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), np.zeros((37, 53), dtype))
    assert _stated_size(path.read_bytes()) == (53, 37)
    assert read_image(path).shape == (37, 53)
    for cut in range(0, 40):
        _stated_size(path.read_bytes()[:cut])  # whatever is missing


def test_the_limit_is_above_any_camera():
    assert MOST_PIXELS > 200e6


@pytest.mark.parametrize("delimiter", [",", " ", "\t", ";"])
@pytest.mark.parametrize("head", ["", "name,t_s\n", "# comment\n"])
def test_a_table_of_too_many_columns(tmp_path, delimiter, head):
    path = tmp_path / "wide.csv"
    path.write_text(head + delimiter.join(["1"] * 1_000_000) + "\n")
    with pytest.raises(FormatError, match=r"wide\.csv, line \d: has more than 10000 columns"):
        read_table(path)
    path.write_text("# " + delimiter.join(["a"] * 1_000_000) + "\n1,2\n3,4\n")
    assert read_table(path).header is None
    path.write_text(delimiter.join(["1"] * MOST_COLUMNS) + "\n")
    assert read_table(path).width == MOST_COLUMNS


def test_a_gcsv_of_too_many_columns(tmp_path):
    path = tmp_path / "wide.gcsv"
    path.write_text("GYROFLOW IMU LOG\nversion,1.3\n" + "t," * 1_000_000 + "\n")
    with pytest.raises(FormatError, match="has more than 10000 columns"):
        read_imu(path)


READERS = [
    read_bytes,
    read_json,
    lambda path: read_yaml(path, "a calibration"),
    read_table,
    read_image,
    stamps_of_csv,
    read_imu,
    video_stamps_ns,
    lambda path: read_config(path, ReconstructOptions),
]


@pytest.mark.parametrize("reader", READERS)
def test_devices_and_pipes_are_no_files(tmp_path, reader):
    fifo = tmp_path / "pipe.csv"
    os.mkfifo(fifo)
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    for path in (fifo, tmp_path / "zero.csv"):
        with pytest.raises(FormatError, match="is a device, a pipe or a socket, not a file"):
            reader(path)
        assert first_line(path) == ""


def test_a_capture_that_names_them(tmp_path):
    (tmp_path / "images").mkdir()
    assert cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((8, 8), np.uint8))
    os.mkfifo(tmp_path / "pipe")
    code = (
        "import sys, resource\nresource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))\n"
        "from colmap_inertial.io.frames import read_frames\n"
        "from colmap_inertial.errors import FormatError\n"
        "try: read_frames(sys.argv[1])\nexcept FormatError as error: sys.exit(str(error))"
    )
    for times in ("/dev/zero", "pipe"):
        toml = tmp_path / "capture.toml"
        toml.write_text(f'[images]\nfolder = "images"\ntimes = "{times}"\n')
        done = subprocess.run([sys.executable, "-c", code, str(toml)], capture_output=True, text=True, timeout=60)
        assert done.stderr.strip().endswith("not a file; copy what it gives into one"), done.stderr


def test_a_file_too_large_to_be_read_whole(tmp_path):
    path = tmp_path / "sparse.csv"
    with open(path, "wb") as file:
        file.truncate(LARGEST_BYTES + 1)
    with pytest.raises(InertialError, match="is larger than 4 GiB"):
        read_table(path)
    assert read_bytes(path, 4) == bytes(4)
