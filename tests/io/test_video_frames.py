"""Frames from video: presentation stamps to the microsecond, whatever the frame rate, and the recorder's own times."""

import itertools
import random
import re
import shutil
import struct
import tracemalloc
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.types import FrameLog
from colmap_inertial.io import video
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import decode_lazily, read_frame_timing, read_frames, thin
from colmap_inertial.io.video import decode_grey, decode_pictures, decode_video, video_stamps_ns
from tests.helpers.files import write_anew

VARIABLE_MS = (100, 133, 167, 250, 283, 400, 417, 450, 600, 633, 667, 700)


def write_video(
    path: Path,
    stamps_ms: tuple[int, ...] = VARIABLE_MS,
    *,
    size: tuple[int, int] = (64, 48),
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    b_frames: int = 2,
    faststart: bool = False,
) -> Path:
    """Frame i is a flat grey of 20 + 15 i, so that each can be told from the others."""
    options = {"movflags": "faststart"} if faststart else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, pix_fmt
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        if codec == "libx264":
            stream.options = {"crf": "10", "bf": str(b_frames), "g": "6"}
        for i, stamp in enumerate(stamps_ms):
            level = 20 + 15 * i % 220
            frame = av.VideoFrame.from_ndarray(np.full((size[1], size[0], 3), level, np.uint8), format="rgb24")
            frame = frame.reformat(format=pix_fmt)
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def capture_of(folder: Path, video: str, rest: str = "") -> Path:
    (folder / "capture.toml").write_text(f"[video]\n{video}\n{rest}\n")
    return folder


def test_variable_rate_and_container_start_are_exact_to_a_microsecond(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for suffix in ("mp4", "mkv", "mov"):
        for b_frames in (0, 2):
            with subtests.test(suffix=suffix, b_frames=b_frames):
                tmp_path = tmp_path_factory.mktemp("given")
                write_video(tmp_path / f"a.{suffix}", b_frames=b_frames)
                timing, frames = read_frames(capture_of(tmp_path, f'file = "a.{suffix}"'))
                assert timing.epoch_ns == 100_000_000
                np.testing.assert_allclose(
                    timing.t_s + timing.epoch_ns / 1e9, np.array(VARIABLE_MS) / 1e3, atol=1e-6, rtol=0
                )
                levels = []
                for i, frame in enumerate(frames):
                    assert frame.name == timing.names[i] == f"frame_{VARIABLE_MS[i] * 1000:012d}.png"
                    assert frame.t_s == timing.t_s[i] and frame.image.shape == (48, 64, 3)
                    levels.append(float(frame.image.mean()))
                np.testing.assert_allclose(levels, [20 + 15 * i for i in range(12)], atol=3)
                assert load_capture(tmp_path).image_folder is None


def test_a_recorders_own_frame_times_replace_the_stamps(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4")
    stamps = [10**15 + 33_333_333 * i for i in range(12)]
    (tmp_path / "bare.txt").write_text("\n".join(map(str, stamps)) + "\n")
    (tmp_path / "named.csv").write_text("frame,t_ns\n" + "".join(f"{i},{t}\n" for i, t in enumerate(stamps)))
    for log in ('frame_times = "bare.txt"\ntime_unit = "ns"', 'frame_times = "named.csv"'):
        timing, frames = read_frames(capture_of(tmp_path, f'file = "a.mp4"\n{log}'))
        assert [timing.epoch_ns + round(t * 1e9) for t in timing.t_s] == stamps
        assert [frame.t_s for frame in frames] == timing.t_s.tolist()
    with pytest.raises(TimingError, match="does not state the unit"):
        read_frame_timing(capture_of(tmp_path, 'file = "a.mp4"\nframe_times = "bare.txt"'))
    (tmp_path / "bare.txt").write_text("\n".join(map(str, stamps[:-1])) + "\n")
    with pytest.raises(TimingError, match=r"has 11 times, the video .* has 12 frames"):
        read_frame_timing(capture_of(tmp_path, 'file = "a.mp4"\nframe_times = "bare.txt"\ntime_unit = "ns"'))


def test_thinning_takes_the_frame_nearest_to_each_tick(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4")
    timing, frames = read_frames(capture_of(tmp_path, 'file = "a.mp4"\nframes_per_s = 10'))
    np.testing.assert_allclose(
        timing.t_s + 0.1, [0.1, 0.167, 0.283, 0.4, 0.45, 0.6, 0.7], atol=1e-9
    )  # the ticks at 0.2 and 0.5 s lie nearest to 0.167 and 0.45 s
    assert [frame.name for frame in frames] == list(timing.names)
    t_ns = np.arange(0, 10_000_000_000, 33_333_333)
    for rate in (0.3, 1.0, 7.0, 29.0, 30.0, 1000.0):
        kept = thin(t_ns, rate)
        assert len(kept) == min(len(t_ns), round(t_ns[-1] / 1e9 * rate - 0.5) + 1)


def test_frames_of_a_thinned_video_keep_the_exposures_that_the_recorder_noted(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4")
    capture = load_capture(capture_of(tmp_path, 'file = "a.mp4"\nframes_per_s = 5'))
    stamps_s = np.array(VARIABLE_MS) / 1e3
    log = FrameLog(t_s=stamps_s, in_video_time=True, exposure_s=stamps_s / 100)
    timing = read_frame_timing(replace(capture, frame_log=log))
    assert 2 < len(timing.names) < len(VARIABLE_MS)
    np.testing.assert_allclose(timing.exposure_s, (timing.t_s + 1e-9 * timing.epoch_ns) / 100, atol=1e-8)


def test_stamps_are_rounded_to_the_nearest_nanosecond(tmp_path: Path) -> None:
    base = Fraction(1, 30_000)
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(30_000, 1001))
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = stream.codec_context.time_base = base
        for i in range(6):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 40 * i, np.uint8), format="rgb24")
            frame = frame.reformat(format="yuv420p")
            frame.pts, frame.time_base = 1001 * i, base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert video_stamps_ns(tmp_path / "a.mp4").tolist() == [round(1001 * i * base * 10**9) for i in range(6)]


def test_grey_and_deep_video_keep_their_depth(tmp_path: Path) -> None:
    write_video(tmp_path / "grey.mkv", codec="ffv1", pix_fmt="gray")
    frame = next(read_frames(capture_of(tmp_path, 'file = "grey.mkv"'))[1])
    assert frame.image.shape == (48, 64) and frame.image.dtype == np.uint8
    write_video(tmp_path / "deep.mkv", codec="ffv1", pix_fmt="yuv420p10le")
    frame = next(read_frames(capture_of(tmp_path, 'file = "deep.mkv"'))[1])
    assert frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint16
    assert abs(frame.image.mean() / 257 - 20) < 3


def test_some_frames_are_decoded_alone(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4")
    capture = load_capture(capture_of(tmp_path, 'file = "a.mp4"'))
    timing, frames = read_frames(capture)
    every = list(frames)
    _, some = read_frames(capture, only=timing.names[2:9:3])
    for frame, expected in zip(some, every[2:9:3], strict=True):
        assert frame.name == expected.name and frame.t_s == expected.t_s
        np.testing.assert_array_equal(frame.image, expected.image)
    assert list(read_frames(capture, only=())[1]) == []
    small = [(frame.name, frame.luma(32)) for frame in decode_lazily(capture)]
    assert [name for name, _ in small] == list(timing.names)
    assert all(grey.shape == (24, 32) and grey.dtype == np.uint8 for _, grey in small)


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", tuple(range(0, 6000, 50)), size=(320, 240))
    _, frames = read_frames(capture_of(tmp_path, 'file = "a.mp4"'))
    tracemalloc.start()
    count = sum(1 for _ in frames)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 120 and peak < 4 * 320 * 240 * 3


def test_a_damaged_or_missing_video_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such video"):
        read_frame_timing(capture_of(tmp_path, 'file = "a.mp4"'))
    (tmp_path / "a.mp4").write_bytes(b"no video at all" * 100)
    with pytest.raises(FormatError, match=r"a\.mp4"):
        read_frame_timing(tmp_path)
    with av.open(str(tmp_path / "a.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(FormatError, match="no video stream"):
        read_frame_timing(capture_of(tmp_path, 'file = "a.wav"'))


def test_a_video_that_is_cut_off_is_named(tmp_path: Path) -> None:
    stamps = tuple(range(0, 2000, 40))
    whole = write_video(tmp_path / "a.mp4", stamps, size=(320, 240), faststart=True).read_bytes()
    for share in (0.5, 0.8, 0.95):
        (tmp_path / "a.mp4").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FormatError, match=r"a\.mp4: is cut off: it holds \d+ of the 50 frames"):
            read_frame_timing(capture_of(tmp_path, 'file = "a.mp4"'))


def test_a_frame_that_cannot_be_decoded_is_named(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", tuple(range(0, 2000, 40)), size=(320, 240), faststart=True)
    whole = bytearray(video.read_bytes())
    whole[-600:-300] = bytes(300)
    video.write_bytes(whole)
    timing, frames = read_frames(capture_of(tmp_path, 'file = "a.mp4"'))
    assert len(timing.names) == 50
    with pytest.raises(FormatError, match=r"a\.mp4"):
        list(frames)


def test_gopro_files_are_timed_by_their_own_stamps(shared_data: Path) -> None:
    for name in ("karma.mp4", "max-heromode.mp4"):
        t_ns = video_stamps_ns(shared_data / "gopro" / name)
        np.testing.assert_allclose(np.diff(t_ns), 1001 / 30000 * 1e9, atol=1)


def write_pattern(
    path: Path,
    count: int = 60,
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    size: tuple[int, int] = (320, 240),
    muxer: dict[str, str] | None = None,
) -> Path:
    """A pattern that moves by two pixels a frame, at 30 frames a second, with B-frames where the codec has them."""
    width, height = size
    tiles = np.random.default_rng(0).integers(0, 255, (height // 4 + 1, width // 4 + 1, 3), dtype=np.uint8)
    texture = tiles.repeat(8, 0).repeat(8, 1)
    with av.open(str(path), "w", options=muxer or {}) as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        if codec == "libx264":
            stream.options = {"crf": "20", "bf": "2", "g": "15"}
        if codec == "libx265":
            stream.options = {"x265-params": "log-level=none:keyint=15:bframes=3:crf=18"}
        for i in range(count):
            picture = np.ascontiguousarray(texture[i : i + height, 2 * i % width : 2 * i % width + width])
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pix_fmt)
            frame.pts, frame.time_base = i, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def patched(path: Path, box: bytes, offset: int, data: bytes) -> Path:
    """Overwrite what stands ``offset`` bytes after the four letters of a box."""
    raw = bytearray(path.read_bytes())
    at = raw.index(box) + 4 + offset
    raw[at : at + len(data)] = data
    path.write_bytes(raw)
    return path


def test_frames_before_an_edit_list_s_beginning_are_no_frames_of_the_video(tmp_path: Path) -> None:
    stamps = tuple(range(0, 1000, 40))
    video = write_video(tmp_path / "a.mp4", stamps, b_frames=0)
    with av.open(str(video)) as container:
        per_s = int(1 / container.streams.video[0].time_base)
    # one entry: version and flags, count, duration, media time
    patched(video, b"elst", 12, struct.pack(">i", per_s // 5))
    timing, frames = read_frames(capture_of(tmp_path, 'file = "a.mp4"'))
    np.testing.assert_allclose(timing.epoch_ns * 1e-9 + timing.t_s, np.array(stamps[5:]) / 1e3 - 0.2, atol=1e-6, rtol=0)
    levels = [float(frame.image.mean()) for frame in frames]
    np.testing.assert_allclose(levels, [20 + 15 * i % 220 for i in range(5, 25)], atol=3)


def test_a_cut_longer_than_a_group_of_pictures_leaves_a_whole_video(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """What phones write that trim without coding anew: all samples, and an edit list."""
    stamps = tuple(range(0, 4000, 40))
    written = {
        (suffix, faststart): write_video(tmp_path_factory.mktemp("whole") / f"a.{suffix}", stamps, faststart=faststart)
        for suffix, faststart in itertools.product(("mp4", "mov"), (True, False))
    }
    for (suffix, faststart), (from_start, from_end) in itertools.product(written, ((55, 0), (0, 45), (37, 28))):
        with subtests.test(suffix=suffix, faststart=faststart, from_start=from_start, from_end=from_end):
            tmp_path = tmp_path_factory.mktemp("given")
            video = shutil.copyfile(written[suffix, faststart], tmp_path / f"a.{suffix}")
            with av.open(str(video)) as container:
                ticks_per_frame = round(0.04 / container.streams.video[0].time_base)
            raw = video.read_bytes()
            # one entry: version and flags, count, duration (of the movie's clock, milliseconds), media time
            media_time = struct.unpack_from(">i", raw, raw.index(b"elst") + 16)[0] + from_start * ticks_per_frame
            entry = struct.pack(">ii", (100 - from_start - from_end) * 40, media_time)
            patched(video, b"elst", 8, entry)
            expected_s = np.array(stamps[: 100 - from_start - from_end]) / 1e3
            np.testing.assert_allclose(video_stamps_ns(video) * 1e-9, expected_s, atol=1e-6, rtol=0)
            _, frames = read_frames(capture_of(tmp_path, f'file = "a.{suffix}"'))
            levels = [float(frame.image.mean()) for frame in frames]
            np.testing.assert_allclose(levels, [20 + 15 * i % 220 for i in range(from_start, 100 - from_end)], atol=3)
            if faststart:
                whole = video.read_bytes()
                for share in (0.6, 0.9):
                    video.write_bytes(whole[: int(share * len(whole))])
                    with pytest.raises(FormatError, match=r"is cut off: it holds \d+ of the 100 frames"):
                        video_stamps_ns(video)


def test_frames_that_the_camera_dropped_do_not_cut_an_avi_file_off(tmp_path: Path) -> None:
    """They are empty chunks, which its header counts."""
    shown = [0, 1, 2, 5, 6, 9, 10, 15]
    video = tmp_path / "a.avi"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuvj420p"
        for place in shown:
            frame = av.VideoFrame.from_ndarray(np.full((240, 320, 3), 20 + 10 * place, np.uint8), format="rgb24")
            frame.pts, frame.time_base = place, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with av.open(str(video)) as container:
        assert container.streams.video[0].frames == 16
    np.testing.assert_allclose(video_stamps_ns(video) * 1e-9, np.array(shown) / 30, atol=1e-6, rtol=0)
    levels = [float(image.mean()) for _, image in decode_video(video, video_stamps_ns(video))]
    np.testing.assert_allclose(levels, 20 + 10 * np.array(shown), atol=3)
    whole = video.read_bytes()
    for share in (0.6, 0.9):
        video.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FormatError, match=r"is cut off: it holds \d of the 16 frames"):
            video_stamps_ns(video)


def test_a_change_of_size_is_refused_at_its_time(tmp_path: Path) -> None:
    for name, size in (("a", (320, 240)), ("b", (160, 120))):
        write_pattern(tmp_path / f"{name}.ts", 15, size=size, codec="mpeg2video")
    video = tmp_path / "both.ts"
    with av.open(str(video), "w") as container:
        target, shift = None, 0
        for name in ("a", "b"):
            with av.open(str(tmp_path / f"{name}.ts")) as part:
                source = part.streams.video[0]
                target = target or container.add_stream_from_template(source)
                for packet in part.demux(source):
                    if packet.dts is not None:
                        packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                        packet.stream = target
                        container.mux(packet)
            shift = 15 * 3000
    stamps = video_stamps_ns(video)
    assert len(stamps) == 30
    at = rf"from 320x240 to 160x120 at {stamps[15] * 1e-9:.3f} s"
    for decoded in (decode_video(video, stamps), decode_pictures(video, stamps)):
        with pytest.raises(FormatError, match=at):
            list(decoded)
    assert len(list(decode_pictures(video, stamps[:14]))) == 14


def test_a_rotation_mark_leaves_the_sensor_s_rows_alone(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for turn in (90, 180, 270):
        with subtests.test(turn=turn):
            tmp_path = tmp_path_factory.mktemp("given")
            video = write_pattern(tmp_path / "a.mp4", 6)
            before = [frame.image for frame in read_frames(capture_of(tmp_path, 'file = "a.mp4"'))[1]]
            c, s = round(np.cos(np.radians(turn))), round(np.sin(np.radians(turn)))
            matrix = struct.pack(">9i", *(int(v * 2**16) for v in (c, s, 0, -s, c, 0)), 0, 0, 2**30)
            patched(video, b"tkhd", 40, matrix)
            assert next(decode_grey(video))[1] % 360 == -turn % 360  # FFmpeg counts the other way round
            timing, frames = read_frames(capture_of(tmp_path, 'file = "a.mp4"', "[timing]\nreadout_s = 0.02"))
            assert timing.readout_direction == "down"
            for frame, expected in zip(frames, before, strict=True):
                np.testing.assert_array_equal(frame.image, expected)
            camera = '[camera]\nmodel = "SIMPLE_PINHOLE"\nwidth = 240\nheight = 320\nparams = [300, 120, 160]\n'
            camera += 'pixel_origin = "corner"'
            with pytest.raises(FormatError, match=r"is 320x240.* declared as 240x320.*not rotated by 90 deg"):
                list(read_frames(capture_of(tmp_path, 'file = "a.mp4"', camera))[1])


#: Weights of red and blue in the luma of FFmpeg's colour matrices 1 (BT.709), 5, 6 (BT.601), 9 (BT.2020).
LUMA = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}


def rgb_of(yuv: np.ndarray, matrix: int, full: bool, bits: int) -> np.ndarray:
    """By the definitions of ITU-R BT.601, BT.709, BT.2020; 0 to 1."""
    red, blue = LUMA[matrix]
    one = 2 ** (bits - 8)
    y, cb, cr = np.moveaxis(yuv.astype(np.float64), -1, 0)
    if full:
        top = 256 * one - 1
        y, cb, cr = y / top, (cb - 128 * one) / top, (cr - 128 * one) / top
    else:
        y, cb, cr = (y - 16 * one) / (219 * one), (cb - 128 * one) / (224 * one), (cr - 128 * one) / (224 * one)
    r, b = y + 2 * (1 - red) * cr, y + 2 * (1 - blue) * cb
    return np.clip(np.stack([r, (y - red * r - blue * b) / (1 - red - blue), b], axis=-1), 0, 1)


def test_colours_are_those_that_the_video_states(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for bits in (8, 10):
        for height in (240, 720):
            with subtests.test(bits=bits, height=height):
                tmp_path = tmp_path_factory.mktemp("given")
                width, one = 64, 2 ** (bits - 8)
                pix_fmt, kind = ("yuv444p", np.uint8) if bits == 8 else ("yuv444p10le", np.uint16)
                yuv = np.empty((height, width, 3), kind)
                yuv[..., 0] = np.linspace(16, 235, width) * one
                yuv[..., 1:] = 100 * one, 160 * one
                for matrix, stated_range in itertools.product((2, *LUMA), (0, 1, 2)):
                    with av.open(str(tmp_path / "a.mkv"), "w") as container:
                        stream = container.add_stream("ffv1", rate=30)
                        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
                        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, stated_range
                        frame = av.VideoFrame(width, height, pix_fmt)
                        for i, plane in enumerate(frame.planes):
                            rows = np.zeros((height, plane.line_size), np.uint8)
                            rows[:, : width * yuv.itemsize] = np.ascontiguousarray(yuv[..., i]).view(np.uint8)
                            plane.update(rows.tobytes())
                        frame.pts, frame.time_base = 0, Fraction(1, 30)
                        frame.colorspace, frame.color_range = matrix, stated_range
                        container.mux(stream.encode(frame))
                        container.mux(stream.encode())
                    [(_, image)] = decode_video(tmp_path / "a.mkv", np.array([0]))
                    # without a statement: limited range; high definition is BT.709, the rest BT.601
                    meant = matrix if matrix != 2 else (1 if height >= 720 else 6)
                    expected = rgb_of(yuv, meant, stated_range == 2, bits)
                    # FFmpeg takes white of 10 bit in limited range to 65280 of 65535
                    tolerance = 0.8 / 255 if bits == 8 else 1.0 / 255
                    assert image.dtype == kind and np.abs(image / np.iinfo(kind).max - expected).max() < tolerance
                    [picture] = decode_pictures(tmp_path / "a.mkv", np.array([0]))
                    assert np.array_equal(picture.luma(4000), yuv[..., 0] // one)


def test_codecs_depths_and_odd_sizes(subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory) -> None:
    written: dict[tuple[int, int], Path] = {}
    for codec, pix_fmt, size in (
        ("libx265", "yuv420p", (320, 240)),
        ("libx265", "yuv420p10le", (320, 240)),
        ("ffv1", "yuv420p", (321, 241)),
        ("libx264", "yuv444p", (321, 241)),
        ("libx264", "yuvj420p", (322, 242)),
        ("mjpeg", "yuvj422p", (320, 240)),
    ):
        with subtests.test(codec=codec, pix_fmt=pix_fmt, size=size):
            tmp_path = tmp_path_factory.mktemp("given")
            write_pattern(tmp_path / "a.mkv", 20, codec=codec, pix_fmt=pix_fmt, size=size)
            if size not in written:
                written[size] = write_pattern(tmp_path / "true.mkv", 20, codec="ffv1", pix_fmt="bgr0", size=size)
            else:
                shutil.copyfile(written[size], tmp_path / "true.mkv")
            timing, frames = read_frames(capture_of(tmp_path, 'file = "a.mkv"'))
            np.testing.assert_allclose(timing.t_s, np.arange(20) / 30, atol=5.1e-4)  # Matroska counts milliseconds
            _, truth = read_frames(capture_of(tmp_path, 'file = "true.mkv"'))
            for frame, true in zip(frames, truth, strict=True):
                assert frame.image.shape == true.image.shape == (size[1], size[0], 3)
                assert frame.image.dtype == (np.uint16 if "10" in pix_fmt else np.uint8)
                found = frame.image / (257 if "10" in pix_fmt else 1)
                grey, expected = (cv2.cvtColor(x.astype(np.float32), cv2.COLOR_RGB2GRAY) for x in (found, true.image))
                assert np.sqrt(np.mean((grey - expected) ** 2)) < 16


def test_most_damage_is_an_error_with_its_time(tmp_path: Path) -> None:
    """A decoder conceals what it cannot read; a picture that it made up must not pass for one that was filmed."""
    video = write_pattern(tmp_path / "a.mp4", muxer={"movflags": "faststart"})
    whole, stamps = video.read_bytes(), video_stamps_ns(video)
    truth = [image.astype(np.int16) for _, image in decode_video(video, stamps)]
    unnoticed = 0
    for seed in range(20):
        draw = random.Random(seed)
        damaged = bytearray(whole)
        at = draw.randrange(len(whole) // 4, len(whole) - 400)
        damaged[at : at + 200] = draw.randbytes(200)
        write_anew(video, damaged)
        try:
            images = [image for _, image in decode_video(video, stamps)]
        except FormatError as error:
            assert re.search(r"a\.mp4.*(\d\.\d+ s|cut off)", str(error))
        else:
            unnoticed += any(np.abs(i - t).mean() > 1 for i, t in zip(images, truth, strict=True))
    # some bits decode to something else without breaking a rule of the format
    assert unnoticed <= 8


def test_a_video_that_ends_early_says_where(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for kind in ("mp4", "mkv", "avi"):
        with subtests.test(kind=kind):
            tmp_path = tmp_path_factory.mktemp("given")
            video = write_pattern(tmp_path / f"a.{kind}", muxer={"movflags": "faststart"} if kind == "mp4" else {})
            whole = video.read_bytes()
            for share in (0.5, 0.9):
                video.write_bytes(whole[: int(share * len(whole))])
                with pytest.raises(FormatError, match=rf"a\.{kind}: is cut off: .*, the last at \d\.\d\d\d s"):
                    video_stamps_ns(video)


def test_a_recording_that_was_not_finished_has_no_index(tmp_path: Path) -> None:
    video = write_pattern(tmp_path / "a.mp4")
    video.write_bytes(video.read_bytes()[:-2000])
    with pytest.raises(FormatError, match=r"a\.mp4.*(cut off|not finished)"):
        video_stamps_ns(video)


def add_stream(path: Path, other: Path, *, cover: bool = False, first: bool = False) -> Path:
    """``path`` with the pictures of another file as a second stream, or as its cover picture."""
    out = path.with_stem("both")
    with av.open(str(path)) as a, av.open(str(other)) as b, av.open(str(out), "w") as container:
        pairs = [(a, a.streams.video[0]), (b, b.streams.video[0])]
        if first:
            pairs.reverse()
        targets = []
        for source, stream in pairs:
            targets.append(container.add_stream_from_template(stream))
            if cover and source is b:
                targets[-1].disposition = av.stream.Disposition.attached_pic
        for (source, stream), target in zip(pairs, targets, strict=True):
            for packet in source.demux(stream):
                if packet.dts is not None:
                    packet.stream = target
                    container.mux(packet)
    return out


def test_the_filmed_stream_is_found_among_others(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for first in (False, True):
        with subtests.test(first=first):
            tmp_path = tmp_path_factory.mktemp("given")
            video = write_video(tmp_path / "a.mp4")
            other = write_pattern(tmp_path / "small.mp4", 20, size=(32, 24))
            both = add_stream(video, other, first=first)
            assert np.array_equal(video_stamps_ns(both), video_stamps_ns(video))
            cover = write_pattern(tmp_path / "cover.mp4", 1, codec="mjpeg", pix_fmt="yuvj420p", size=(640, 480))
            both = add_stream(video, cover, cover=True, first=first)
            assert np.array_equal(video_stamps_ns(both), video_stamps_ns(video))
            same = write_pattern(tmp_path / "same.mp4", 20, size=(64, 48))
            with pytest.raises(FormatError, match=r"2 video streams of 64x48; .*-map"):
                video_stamps_ns(add_stream(video, same, first=first))


def test_an_avi_ends_inside_its_last_list_or_not(subtests, tmp_path_factory):
    for sizes, lacking, cut_off in (
        ([92], 0, False),
        ([100], 0, False),  # the head of 8 bytes counted, too
        ([101], 0, True),
        ([92, 92], 0, False),
        ([92, 92], 20, True),
        ([92, 92], 100, False),  # a whole list is gone, which nothing shows
        ([93], 0, False),
    ):
        with subtests.test(sizes=sizes, lacking=lacking, cut_off=cut_off):
            tmp_path = tmp_path_factory.mktemp("given")
            lists = [b"RIFF" + struct.pack("<I", size) + b"AVI " + bytes(88 + (size == 93) * 2) for size in sizes]
            (tmp_path / "a.avi").write_bytes(b"".join(lists)[: sum(map(len, lists)) - lacking])
            assert video._ends_inside_riff(tmp_path / "a.avi") == cut_off
