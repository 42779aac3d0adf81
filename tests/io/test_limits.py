"""What would take all memory, or never end, is refused before it does."""

import json
import os
import resource
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from dataclasses import fields

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import COMMANDS, main
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.options import ReadLimits, ReconstructOptions
from colmap_inertial.core.threads import map_in_order
from colmap_inertial.io.files import first_line, read_bytes, read_json, read_limits, read_yaml, reading_within
from colmap_inertial.io.frame_times import stamps_of_csv
from colmap_inertial.io.images import _read_size, read_image, require_modest
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.tables import read_table
from colmap_inertial.io.toml_section import read_toml
from colmap_inertial.io.video import video_stamps_ns
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.steps.config import read_config
from colmap_inertial.tools.view.images import read_preview
from tests.helpers.cases import loop_over
from tests.helpers.desk_scene import copy_scene


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


def test_a_text_of_yaml_is_no_longer_than_calibrations_are(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: [" + "1," * 300_000 + "1]\n")
    with pytest.raises(FormatError, match="is not a calibration: its 600007 characters are too many"):
        read_yaml(path, "a calibration")


PARTS = ".".join(["a"] * 6000)


def test_keys_of_toml_have_few_parts(subtests, tmp_path_factory):
    for read in (read_toml, lambda path: read_config(path, ReconstructOptions)):
        for text in (
            f"{PARTS} = 1",
            f"[{PARTS}]",
            f"[[{PARTS}]]",
            f"x = {{y = 1, {PARTS} = 1}}",
            ". ".join(['"a"', "'b'"] * 3000) + " = 1",
            f'x = {{a = """b"""", {PARTS} = 1}}',
            f"x = {{a = '''b''''', {PARTS} = 1}}",
            f'x = "#" # "\n{PARTS} = 1',
            f'x = "\\""\n{PARTS} = 1',
            f'x = """\\""" """\n{PARTS} = 1',
        ):
            with subtests.test(read=read.__name__, text=text[:20]):
                tmp_path = tmp_path_factory.mktemp("given")
                path = tmp_path / "capture.toml"
                path.write_text(text)
                tracemalloc.start()
                try:
                    with pytest.raises(FormatError, match="has a key of more than 32 dotted parts"):
                        read(path)
                    assert tracemalloc.get_traced_memory()[1] < 4e6
                finally:
                    tracemalloc.stop()


def test_dots_in_texts_and_numbers_of_toml_are_no_parts(subtests, tmp_path_factory):
    for quote in ('"', "'", '"""', "'''"):
        with subtests.test(quote=quote):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "capture.toml"
            many = ", ".join(["1.5"] * 500)
            path.write_text(f'a = {quote}{PARTS}{quote}\nb.c."d.e" = [{many}] # {PARTS}\nt = 1979-05-27 07:32:00.999\n')
            section = read_toml(path)
            assert section.text("a") == PARTS and section.names() == ["a", "b", "t"]


def test_a_text_of_toml_is_refused_soon(subtests, tmp_path_factory):
    for text in ("[" + "a." * 150_000 + "a]", "a" * 500_000, '"\\"' * 200_000, "'''" * 170_001, "[" * 500_000):
        with subtests.test(text=text[:10]):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "capture.toml"
            path.write_text(text)
            start_s = time.thread_time()
            with pytest.raises(FormatError):
                read_toml(path)
            assert time.thread_time() - start_s < 5.0
            path.write_text("#" * 2_100_000)
            with pytest.raises(FormatError, match="has 2100000 characters; such a file has at most 2097152"):
                read_toml(path)


def test_pixels_of_more_bytes_count_more(subtests, tmp_path_factory):
    for depth, kind, million in ((8, 2, 125), (16, 2, 62.5), (8, 6, 53.6), (16, 6, 26.8), (1, 3, 250)):
        with subtests.test(depth=depth, kind=kind, million=million):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "a.png"
            path.write_bytes(png(16000, 16000).replace(b"\x01\x00\x00\x00\x00", bytes([depth, kind, 0, 0, 0]), 1))
            with pytest.raises(FormatError, match=f"more than {million} million are not decoded"):
                read_image(path)


def jpeg(width, height, *, progressive=False, scans=False):
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)])[
        1
    ].tobytes()
    at = data.index(b"\xff\xc2" if progressive else b"\xff\xc0") + 5
    data = data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]
    at = data.index(b"\xff\xda")
    # the first of the colours alone
    return data[:at] + b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00" + data[at + 14 :] if scans else data


def jpeg_in_scans(width, height):
    return jpeg(width, height, scans=True)


def jpeg_progressive(width, height):
    return jpeg(width, height, progressive=True)


def test_a_picture_of_too_many_pixels_is_not_decoded(subtests, tmp_path_factory):
    for encode, side, million in (
        (png, 20000, 250),
        (jpeg, 12000, 125),
        (jpeg, 65535, 125),
        (jpeg_progressive, 10000, 83.3),
        (jpeg_in_scans, 10000, 83.3),
    ):
        with subtests.test(encode=encode.__name__, side=side, million=million):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "large.png"
            path.write_bytes(encode(side, side))
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            with pytest.raises(
                FormatError, match=rf"large\.png: has \d+ x \d+ pixels; more than {million} million are not decoded"
            ):
                read_image(path)
            assert read_preview(path, 100)[0] is None
            assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_photograph_of_200_million_pixels_is_no_flat_one(subtests):
    for encode in (jpeg, jpeg_progressive, jpeg_in_scans):
        with subtests.test(encode=encode.__name__):
            data = encode(16384, 12288)
            with pytest.raises(FormatError, match="pixels"):
                require_modest("flat.jpg", data)
            require_modest("photograph.jpg", data + bytes(20_000_000))  # 0.8 bits a pixel


KINDS = [(suffix, np.uint8) for suffix in (".png", ".jpg", ".bmp", ".pgm", ".tif")]


@loop_over(("suffix", "dtype"), [*KINDS, (".png", np.uint16), (".pgm", np.uint16), (".tif", np.uint16)])
def test_the_size_is_told_by_the_header(tmp_path, suffix, dtype):
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), np.zeros((37, 53), dtype))
    assert _read_size(path.read_bytes()) == (53, 37)
    assert read_image(path).shape == (37, 53)
    for cut in range(0, 40):
        _read_size(path.read_bytes()[:cut])  # whatever is missing


def test_the_limit_is_above_any_camera():
    assert ReadLimits().megapixels > 200


@loop_over("delimiter", [",", " ", "\t", ";"])
@loop_over("head", ["", "name,t_s\n", "# comment\n"])
def test_a_table_of_too_many_columns(tmp_path, delimiter, head):
    path = tmp_path / "wide.csv"
    path.write_text(head + delimiter.join(["1"] * 1_000_000) + "\n")
    with pytest.raises(FormatError, match=r"wide\.csv, line \d: has more than 10000 columns"):
        read_table(path)
    path.write_text("# " + delimiter.join(["a"] * 1_000_000) + "\n1,2\n3,4\n")
    assert read_table(path).header is None
    path.write_text(delimiter.join(["1"] * ReadLimits().table_columns) + "\n")
    assert read_table(path).width == ReadLimits().table_columns


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


@loop_over("reader", READERS)
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
        "from colmap_inertial.core.errors import FormatError\n"
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
        file.truncate(int(ReadLimits().file_gib * 2**30) + 1)
    with pytest.raises(InertialError, match=r"is larger than 4 GiB; such a file is not read \(raise --limits"):
        read_table(path)
    assert read_bytes(path, 4) == bytes(4)


@pytest.fixture
def large(tmp_path):
    """A picture, a table and a text that are too large for small limits, and their readers."""
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((30, 40), np.uint8))
    (tmp_path / "a.csv").write_text("1,2,3,4\n5,6,7,8\n")
    (tmp_path / "a.gcsv").write_text("GYROFLOW IMU LOG\nversion,1.3\n" + "t," * 20 + "\n")
    (tmp_path / "a.json").write_text(json.dumps({"rows": list(range(2000))}))
    return [
        (lambda: read_image(tmp_path / "a.png"), ReadLimits(megapixels=0.0011), "--limits.megapixels"),
        (lambda: read_table(tmp_path / "a.csv"), ReadLimits(table_columns=3), "--limits.table-columns"),
        (lambda: read_imu(tmp_path / "a.gcsv"), ReadLimits(table_columns=19), "--limits.table-columns"),
        (lambda: read_json(tmp_path / "a.json"), ReadLimits(file_gib=2e-6), "--limits.file-gib"),
    ]


def test_limits_hold_where_they_are_set_and_nowhere_else(large):
    for read, limits, option in large:
        with reading_within(limits):
            with pytest.raises(FormatError, match=option):
                read()
            # also in the threads that work for the caller
            with pytest.raises(FormatError, match=option):
                list(map_in_order(lambda _, read=read: read(), [1], workers=2))
        assert read_limits() == ReadLimits()


def test_the_same_files_are_read_without_them(large):
    for i in (0, 1, 3):  # the gcsv has columns alone
        large[i][0]()


def test_a_raised_limit_lets_larger_files_in(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(",".join(["1"] * 10_001) + "\n")
    with pytest.raises(FormatError, match="columns"):
        read_table(path)
    with reading_within(ReadLimits(table_columns=10_001)):
        assert read_table(path).width == 10_001
    (tmp_path / "large.png").write_bytes(png(16000, 16000))
    with reading_within(ReadLimits(megapixels=256)):
        assert read_image(tmp_path / "large.png").shape == (16000, 16000)


@pytest.mark.parametrize("kind", ["tif", "webp"])
def test_small_files_of_many_pixels_take_little_memory(tmp_path, kind):
    path = tmp_path / "a.tif"
    image = np.zeros((8300, 8000, 3), np.uint16 if kind == "tif" else np.uint8)
    path.write_bytes(cv2.imencode(f".{kind}", image, [cv2.IMWRITE_TIFF_COMPRESSION, 5] * (kind == "tif"))[1].tobytes())
    with reading_within(ReadLimits(megapixels=50)), pytest.raises(FormatError, match=r"--limits\.megapixels"):
        read_image(path)


def test_every_command_takes_them(tmp_path, capsys):
    scene = copy_scene(tmp_path / "capture", first=3)
    (tmp_path / "config.toml").write_text("[limits]\ntable_columns = 3\n")
    out, imu = str(tmp_path / "out"), str(scene / "gyro.csv")
    for args in (
        ["reconstruct", str(scene), out, "--limits.table-columns", "3"],
        ["reconstruct", str(scene), out, "--config", str(tmp_path / "config.toml")],
        ["deblur", str(scene), out, "--limits.table-columns", "3"],
        ["diagnose", imu, "--limits.table-columns", "3"],
    ):
        with pytest.raises(SystemExit) as stopped:
            main(args)
        told = " ".join(capsys.readouterr().err.split())
        assert stopped.value.code == 2 and "has more than 3 columns; such a table is not read" in told, told
    assert not (tmp_path / "out").exists()
    # as in the processes of a batch, which read what their capture is given
    with pytest.raises(FormatError, match="more than 3 columns"):
        reconstruct(scene, out, ReconstructOptions(limits=ReadLimits(table_columns=3)))
    for command in COMMANDS.values():
        assert hasattr(command, "limits") or "limits" in {f.name for f in fields(command)}


def test_impossible_limits_are_refused(subtests):
    for values in ({"megapixels": 0}, {"table_columns": -1}, {"file_gib": 0.0}, {"megapixels": 2000}):
        with subtests.test(values=values), pytest.raises(ValueError, match=next(iter(values))):
            ReadLimits(**values)
