"""Frames from video: presentation stamps to the microsecond, whatever the frame rate, and the recorder's own times."""

import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from colmap_inertial.errors import FormatError, TimingError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import frame_source, read_frame_timing, read_frames, thin
from colmap_inertial.io.video import video_stamps_ns

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


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "mov"])
@pytest.mark.parametrize("b_frames", [0, 2])
def test_variable_rate_and_container_start_are_exact_to_a_microsecond(
    tmp_path: Path, suffix: str, b_frames: int
) -> None:
    write_video(tmp_path / f"a.{suffix}", b_frames=b_frames)
    timing, frames = read_frames(capture_of(tmp_path, f'file = "a.{suffix}"'))
    assert timing.epoch_ns == 100_000_000
    np.testing.assert_allclose(timing.t_s + timing.epoch_ns / 1e9, np.array(VARIABLE_MS) / 1e3, atol=1e-6, rtol=0)
    levels = []
    for i, frame in enumerate(frames):
        assert frame.name == timing.names[i] == f"frame_{VARIABLE_MS[i] * 1000:012d}.png"
        assert frame.t_s == timing.t_s[i] and frame.image.shape == (48, 64, 3)
        levels.append(float(frame.image.mean()))
    np.testing.assert_allclose(levels, [20 + 15 * i for i in range(12)], atol=3)
    assert frame_source(load_capture(tmp_path)) is None


def test_a_recorders_own_frame_times_replace_the_stamps(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4")
    stamps = [10**15 + 33_333_333 * i for i in range(12)]
    (tmp_path / "bare.txt").write_text("\n".join(map(str, stamps)) + "\n")
    (tmp_path / "named.csv").write_text("frame,t_ns\n" + "".join(f"{i},{t}\n" for i, t in enumerate(stamps)))
    for log in ('frame_times = "bare.txt"\ntime_unit = "ns"', 'frame_times = "named.csv"'):
        timing, frames = read_frames(capture_of(tmp_path, f'file = "a.mp4"\n{log}'))
        assert [timing.epoch_ns + round(t * 1e9) for t in timing.t_s] == stamps
        assert [frame.t_s for frame in frames] == timing.t_s.tolist()
    with pytest.raises(TimingError, match="does not say the unit"):
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


def test_grey_and_deep_video_keep_their_depth(tmp_path: Path) -> None:
    write_video(tmp_path / "grey.mkv", codec="ffv1", pix_fmt="gray")
    frame = next(read_frames(capture_of(tmp_path, 'file = "grey.mkv"'))[1])
    assert frame.image.shape == (48, 64) and frame.image.dtype == np.uint8
    write_video(tmp_path / "deep.mkv", codec="ffv1", pix_fmt="yuv420p10le")
    frame = next(read_frames(capture_of(tmp_path, 'file = "deep.mkv"'))[1])
    assert frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint16
    assert abs(frame.image.mean() / 257 - 20) < 3


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
