"""Streaming a long video: time and memory of selecting its frames and of decoding those that were selected.

``python scripts/bench_video.py --minutes 30`` makes a 1920x1080 video at 30 frames a second (a moving texture; one
minute is encoded, then repeated) with a gyroscope that turns as the picture moves, selects frames and decodes them.
Prints JSON; ``peak_rss_mb`` is the most that the process ever held, libraries included.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import tempfile
import time
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from colmap_inertial.core.options import FrameOptions
from colmap_inertial.core.types import CameraModel, ImuRecording
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, Video
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.reconstruction.preparation.selection import part_of, select_frames

WIDTH, HEIGHT, FPS, FOCAL_PX = 1920, 1080, 30, 1500.0
#: Of the texture's path, px and rad/s; both repeat after a minute.
REACH_PX = 400.0


def path_px(t_s: np.ndarray) -> np.ndarray:
    """(N, 2) where the picture is cut from the texture."""
    turns = 2 * np.pi * t_s[:, None] / 60
    x = 0.7 * np.sin(6 * turns) + 0.3 * np.sin(41 * turns)
    y = 0.7 * np.sin(10 * turns + 1) + 0.3 * np.sin(53 * turns + 2)
    return REACH_PX * (1 + np.concatenate([x, y], axis=1))


def write_minute(path: Path) -> None:
    rng = np.random.default_rng(0)
    size = (HEIGHT + int(2 * REACH_PX) + 2, WIDTH + int(2 * REACH_PX) + 2)
    small = rng.integers(0, 255, (size[0] // 12 + 1, size[1] // 12 + 1), dtype=np.uint8)
    texture = small.repeat(12, 0).repeat(12, 1)[: size[0], : size[1]]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"preset": "ultrafast", "crf": "30", "bf": "0", "g": "60"}
        for i, (x, y) in enumerate(np.rint(path_px(np.arange(60 * FPS) / FPS)).astype(int).tolist()):
            grey = np.ascontiguousarray(texture[y : y + HEIGHT, x : x + WIDTH])
            frame = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = i, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def repeat(minute: Path, path: Path, times: int) -> None:
    with av.open(str(path), "w") as out:
        target = None
        for k in range(times):
            with av.open(str(minute)) as source:
                stream = source.streams.video[0]
                if target is None:
                    target = out.add_stream_from_template(stream)
                shift = k * round(60 / stream.time_base)
                for packet in source.demux(stream):
                    if packet.dts is not None:
                        packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                        packet.stream = target
                        out.mux(packet)


def imu_of(minutes: int) -> ImuRecording:
    """A gyroscope that turns as the picture moves, 200 Hz; noise in place of an accelerometer."""
    t_s = np.arange(0, 60 * minutes, 0.005)
    velocity = np.gradient(path_px(t_s), t_s, axis=0) / FOCAL_PX
    rng = np.random.default_rng(1)
    gyro = np.column_stack([-velocity[:, 1], velocity[:, 0], np.zeros(len(t_s))]) + rng.normal(0, 0.002, (len(t_s), 3))
    accel = rng.normal([0, 0, 9.8], 0.1, (len(t_s), 3))
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=30)
    parser.add_argument("--video", type=Path, help="measure this video (made if it is not there)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        video = arguments.video or Path(scratch) / "long.mp4"
        if not video.exists():
            write_minute(Path(scratch) / "minute.mp4")
            repeat(Path(scratch) / "minute.mp4", video, arguments.minutes)
        measure(video, arguments.minutes)


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(video: Path, minutes: int) -> None:
    camera = CameraModel(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=(FOCAL_PX, WIDTH / 2, HEIGHT / 2))
    capture = Capture(
        path=video, frames=Video(file=video), exposure_s=0.01, readout_s=0.0, camera=camera,
        calibration=calibration_prior(shared_clock=True), shared_clock=True,
    )  # fmt: skip
    begin_mb = peak_mb()
    start = time.perf_counter()
    timing = read_frame_timing(capture)
    index_s = time.perf_counter() - start
    start = time.perf_counter()
    recording = Recording.of(capture, imu_of(minutes), timing, capture.calibration)
    selection = select_frames(recording, FrameOptions(), lambda *_: None)
    select_s, select_mb = time.perf_counter() - start, peak_mb()
    start = time.perf_counter()
    used = part_of(timing, selection.names)
    decoded = sum(1 for _ in read_frames(capture, only=used.names)[1])
    report = {
        "video": f"{WIDTH}x{HEIGHT}, {len(timing.names)} frames, {timing.t_s[-1] / 60:.1f} min",
        "machine": platform.processor() or platform.machine(),
        "index_s": round(index_s, 1),
        "select_s": round(select_s, 1),
        "selected": decoded,
        "note": selection.note,
        "decode_selected_s": round(time.perf_counter() - start, 1),
        "rss_mb": {"start": round(begin_mb), "after_selection": round(select_mb)},
        "peak_rss_mb": round(peak_mb()),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
