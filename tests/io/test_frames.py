"""Frames from folders: order, times, pixels as COLMAP sees them, and what is refused."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_times, read_frame_timing, read_frames
from colmap_inertial.io.images import SUFFIXES, read_image
from tests.helpers.cases import loop_over
from tests.helpers.files import write_anew

EPOCH_NS = 1403715273262142976


def picture(seed: int, shape: tuple[int, ...] = (24, 32, 3)) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (3, 4, *shape[2:])).astype(np.uint8)
    return cv2.resize(coarse, shape[1::-1], interpolation=cv2.INTER_LINEAR)


def folder_of(tmp_path: Path, names: list[str]) -> Path:
    (tmp_path / "frames").mkdir()
    for i, name in enumerate(names):
        (tmp_path / "frames" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "frames" / name), picture(i))
    return tmp_path


def capture_of(folder: Path, images: str, rest: str = "") -> Path:
    (folder / "capture.toml").write_text(f'[images]\nfolder = "frames"\n{images}\n{rest}\n')
    return folder


def test_names_that_are_nanoseconds_time_frames_exactly_and_in_order(tmp_path: Path) -> None:
    stamps = [EPOCH_NS + step for step in (300_000_001, 0, 50_000_128)]
    folder = folder_of(tmp_path, [f"{t}_0.png" for t in stamps] + [f"{t}_1.png" for t in stamps])
    capture = load_capture(capture_of(folder, 'pattern = "*_0.png"\ntimes = "name"\ntime_unit = "ns"'))
    timing, frames = read_frames(capture)
    assert timing.names == tuple(f"{t}_0.png" for t in sorted(stamps))
    assert [timing.epoch_ns + round(t * 1e9) for t in timing.t_s] == sorted(stamps)
    read = list(frames)
    assert tuple(frame.name for frame in read) == timing.names
    assert [frame.t_s for frame in read] == timing.t_s.tolist()
    np.testing.assert_array_equal(read[0].image, picture(1)[:, :, ::-1])
    assert capture.image_folder == tmp_path / "frames"


def test_the_number_in_a_name_is_its_time(subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory) -> None:
    for name, unit, t_ns in (
        ("frame_000123.png", "ms", 123_000_000),
        ("cam0_1403715273262142976.png", "ns", EPOCH_NS),
        ("12.345678.png", "s", 12_345_678_000),
        ("a/b2/000007.png", "us", 7_000),
    ):
        with subtests.test(name=name, unit=unit, t_ns=t_ns):
            tmp_path = tmp_path_factory.mktemp("given")
            folder = folder_of(tmp_path, [name])
            timing = read_frame_timing(
                capture_of(folder, f'pattern = "**/*.png"\ntimes = "name"\ntime_unit = "{unit}"')
            )
            assert (timing.names, timing.epoch_ns) == ((name,), t_ns)


def test_names_that_cannot_be_times_are_refused(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for names, said in (
        (["a.png", "1.png"], "no number"),
        (["2024_1200.png"], "several numbers"),
        (["a_10.png", "b_10.png"], "same time"),
    ):
        with subtests.test(names=names, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            folder = folder_of(tmp_path, names)
            with pytest.raises(TimingError, match=said):
                read_frame_timing(capture_of(folder, 'times = "name"\ntime_unit = "ms"'))


def test_pictures_without_times_say_how_to_give_them(tmp_path: Path) -> None:
    with pytest.raises(TimingError, match=r'times under \[images\].*"name,t_s"'):
        read_frame_timing(capture_of(folder_of(tmp_path, ["1.png"]), ""))


def test_a_csv_times_frames(subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory) -> None:
    for text, t_ns, unit in (
        ("name,t_s\nb.png,0.5\na.png,0.25\n", [250_000_000, 500_000_000], ""),
        (f"#timestamp [ns],filename\n{EPOCH_NS},a.png\n{EPOCH_NS + 1},b.png\n", [EPOCH_NS, EPOCH_NS + 1], ""),
        ("filename;time [ms]\na.png;1.5\nb.png;2.5\nabsent.png;9\n", [1_500_000, 2_500_000], ""),
        ("image timestamp\na.png 1000\nb.png 2000\n", [1_000_000, 2_000_000], 'time_unit = "us"'),
    ):
        with subtests.test(text=text, t_ns=t_ns, unit=unit):
            tmp_path = tmp_path_factory.mktemp("given")
            folder = folder_of(tmp_path, ["a.png", "b.png"])
            (tmp_path / "t.csv").write_text(text)
            timing = read_frame_timing(capture_of(folder, f'times = "t.csv"\n{unit}'))
            assert timing.names == ("a.png", "b.png")
            assert [timing.epoch_ns + round(t * 1e9) for t in timing.t_s] == t_ns


@loop_over(
    ("text", "said"),
    [
        ("name,t_s\na.png,0.5\n", "no row for 1 of 2 images .first: b.png"),
        ("name,t\na.png,0.5\nb.png,1\n", "does not state the unit"),
        ("a.png,0.5\nb.png,1\n", "no header"),
        ("name,when\na.png,0.5\nb.png,1\n", "no column of times"),
        ("who,t_s\na.png,0.5\nb.png,1\n", "no column of names"),
        ("name,t_s\na.png,0.5\na.png,1\n", "line 3: the frame a.png appears twice"),
        ("name,t_s\na.png,0.5\nb.png,0.5\n", "same time"),
        ("name,t_s\na.png,0.5\nb.png,x\n", "line 3: timestamp 'x'"),
        ("name,t_s,exposure\na.png,0.5,1\nb.png,1,1\n", "exposure_s or exposure_ns"),
        ("name,t_s,exposure_s\na.png,0.5,1\nb.png,1,100\n", "line 3"),
    ],
)
def test_an_unclear_csv_is_refused(tmp_path: Path, text: str, said: str) -> None:
    folder = folder_of(tmp_path, ["a.png", "b.png"])
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises((FormatError, TimingError), match=said):
        read_frame_timing(capture_of(folder, 'times = "t.csv"'))


def test_a_header_and_a_declared_unit_must_agree(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["a.png"])
    (tmp_path / "t.csv").write_text("name,t_s\na.png,1\n")
    with pytest.raises(TimingError, match="header says s, time_unit says ms"):
        read_frame_timing(capture_of(folder, 'times = "t.csv"\ntime_unit = "ms"'))


def test_exposures_come_from_the_csv_or_from_the_capture(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["a.png", "b.png"])
    rest = '[timing]\nexposure_s = 0.01\nreadout_s = 0.02\nreadout_direction = "up"\n'
    (tmp_path / "t.csv").write_text("name,t_s,exposure_ms\nb.png,2,4\na.png,1,2\n")
    timing, frames = read_frames(capture_of(folder, 'times = "t.csv"', rest))
    assert timing.exposure_s is not None and timing.exposure_s.tolist() == [0.002, 0.004]
    assert (timing.readout_s, timing.readout_direction) == (0.02, "up")
    assert [frame.exposure_s for frame in frames] == [0.002, 0.004]
    (tmp_path / "t.csv").write_text("name,t_s\nb.png,2\na.png,1\n")
    timing = read_frame_timing(folder)
    assert timing.exposure_s is not None and timing.exposure_s.tolist() == [0.01, 0.01]


def test_frame_times_alone_come_from_a_csv_or_a_capture(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["1.png", "2.png"])
    capture_of(folder, 'times = "name"\ntime_unit = "s"')
    (tmp_path / "t.csv").write_text("name,t_ns\nx.png,7\n")
    assert read_frame_times(tmp_path / "t.csv").names == ("x.png",)
    assert read_frame_times(tmp_path / "capture.toml").names == ("1.png", "2.png")
    assert read_frame_times(tmp_path).names == ("1.png", "2.png")


def test_pixels_are_what_colmap_reads(subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory) -> None:
    for suffix, shape in [
        (suffix, shape)
        for suffix in SUFFIXES
        for shape in ((24, 32, 3), (24, 32))
        if (suffix, len(shape)) not in ((".pgm", 3), (".ppm", 2))
    ]:
        with subtests.test(suffix=suffix, shape=shape):
            tmp_path = tmp_path_factory.mktemp("given")
            import pycolmap

            path = tmp_path / f"a{suffix}"
            cv2.imwrite(str(path), picture(5, shape))
            ours = read_image(path)
            theirs = pycolmap.Bitmap.read(str(path), ours.ndim == 3).to_array()
            assert ours.shape[:2] == theirs.shape[:2]
            # two JPEG decoders may round differently
            allowed = 2 if suffix in (".jpg", ".jpeg") else 0
            assert np.abs(ours.astype(int) - theirs.reshape(ours.shape)).max() <= allowed


def test_sixteen_bits_stay_and_alpha_goes(tmp_path: Path) -> None:
    deep = np.random.default_rng(0).integers(0, 65535, (8, 9, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), deep[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([picture(1), np.full((24, 32), 7, np.uint8)]))
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), picture(1)[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "float.tif"), deep.astype(np.float32))
    with pytest.raises(FormatError, match="8 or 16 bit"):
        read_image(tmp_path / "float.tif")


def test_exif_orientation_is_left_alone_as_colmap_leaves_it(tmp_path: Path) -> None:
    import pycolmap

    cv2.imwrite(str(tmp_path / "a.jpg"), picture(2))
    data = (tmp_path / "a.jpg").read_bytes()
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    (tmp_path / "turned.jpg").write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert cv2.imread(str(tmp_path / "turned.jpg")).shape == (32, 24, 3)  # the tag is there
    np.testing.assert_array_equal(read_image(tmp_path / "turned.jpg"), read_image(tmp_path / "a.jpg"))
    assert pycolmap.Bitmap.read(str(tmp_path / "turned.jpg"), True).to_array().shape == (24, 32, 3)


def test_a_picture_that_is_cut_off_is_named(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory, capfd: pytest.CaptureFixture[str]
) -> None:
    for suffix in SUFFIXES:
        with subtests.test(suffix=suffix):
            tmp_path = tmp_path_factory.mktemp("given")
            capfd.readouterr()
            path = tmp_path / f"a{suffix}"
            cv2.imwrite(str(path), picture(3, (240, 320) if suffix == ".pgm" else (240, 320, 3)))
            whole = path.read_bytes()
            for share in (0.0, 0.01, 0.3, 0.9, 0.999):
                path.write_bytes(whole[: int(share * len(whole))])
                with pytest.raises(FormatError, match=path.name):
                    read_image(path)


def test_a_flipped_bit_in_a_png_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), picture(3))
    whole = bytearray(path.read_bytes())
    for at in np.random.default_rng(0).integers(0, len(whole), 50).tolist():
        damaged = whole.copy()
        damaged[at] ^= 1 << (at % 8)
        write_anew(path, damaged)
        with pytest.raises(FormatError, match=r"a\.png"):
            read_image(path)


def test_what_is_no_picture_is_refused_when_its_turn_comes(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["1.png", "2.png"])
    (tmp_path / "frames/2.png").write_text("hello")
    timing, frames = read_frames(capture_of(folder, 'times = "name"\ntime_unit = "s"'))
    assert len(timing.names) == 2 and next(frames).name == "1.png"
    with pytest.raises(FormatError, match=r"2\.png"):
        next(frames)


def test_pictures_of_another_size_than_the_camera_are_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["1.png"])
    camera = 'model = "PINHOLE"\nwidth = 24\nheight = 32\nparams = [9, 9, 12, 16]\npixel_origin = "corner"'
    _, frames = read_frames(capture_of(folder, 'times = "name"\ntime_unit = "s"', f"[camera]\n{camera}"))
    with pytest.raises(FormatError, match="is 32x24, but the camera is declared as 24x32"):
        next(frames)


def test_an_empty_or_missing_folder_is_named(tmp_path: Path) -> None:
    capture_of(tmp_path, 'times = "name"\ntime_unit = "s"')
    with pytest.raises(FormatError, match="no such folder"):
        read_frame_timing(tmp_path)
    (tmp_path / "frames").mkdir()
    with pytest.raises(FormatError, match="holds no images"):
        read_frame_timing(tmp_path)
    (tmp_path / "capture.toml").write_text('[imu]\npath = "a"\n')
    with pytest.raises(FormatError, match=r"\[images\] or \[video\]"):
        read_frame_timing(tmp_path)


def test_euroc_keyframes_are_read(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "euroc_v101/keyframes"
    os.symlink(source, tmp_path / "frames")
    timing, frames = read_frames(capture_of(tmp_path, 'pattern = "*_0.jpg"\ntimes = "name"\ntime_unit = "ns"'))
    assert len(timing.names) == 100
    assert timing.epoch_ns == EPOCH_NS
    first = next(frames)
    assert first.image.shape == (480, 752) and first.image.dtype == np.uint8
    gaps = np.diff(timing.t_s)
    assert gaps.min() > 0.04 and gaps.max() < 7.5
