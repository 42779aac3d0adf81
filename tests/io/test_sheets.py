"""Sheets about sensors entry by entry, and a video's stamps packet by packet."""

import json
from collections.abc import Callable
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.io import video
from colmap_inertial.io.sensor_yaml import read_body_from_sensor, read_camera, read_imu_noise

NOISE = {
    "gyroscope_noise_density": 1e-4,
    "gyroscope_random_walk": 2e-5,
    "accelerometer_noise_density": 3e-3,
    "accelerometer_random_walk": 4e-4,
}
CAMERA = {
    "camera_model": "pinhole",
    "distortion_model": "radial-tangential",
    "intrinsics": [400.0, 410.0, 320.0, 240.0],
    "distortion_coefficients": [0.1, 0.2, 0.3, 0.4],
    "resolution": [640, 480],
}
POSE = np.eye(4)
POSE[:3, 3] = 1.0, 2.0, 3.0


def test_a_sheet_about_a_sensor_entry_by_entry(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"

    def sheet(of: dict[str, Any], **changes: Any) -> Path:
        path.write_text(json.dumps({key: value for key, value in {**of, **changes}.items() if value != "left out"}))
        return path

    noise = read_imu_noise(sheet(NOISE))
    assert noise is not None
    assert (noise.gyro_density_rad_s_rthz, noise.gyro_walk_rad_s2_rthz) == (1e-4, 2e-5)
    assert (noise.accel_density_m_s2_rthz, noise.accel_walk_m_s3_rthz) == (3e-3, 4e-4)
    assert read_imu_noise(sheet({"rate_hz": 200})) is None
    for model, name in (("radial-tangential", "OPENCV"), ("equidistant", "OPENCV_FISHEYE"), ("none", "PINHOLE")):
        camera = read_camera(sheet(CAMERA, distortion_model=model))
        assert (camera.model, camera.width, camera.height) == (name, 640, 480)
        more = () if model == "none" else (0.1, 0.2, 0.3, 0.4)
        assert camera.params == (400.0, 410.0, 320.5, 240.5, *more)
    body_from_sensor = read_body_from_sensor(sheet({"T_BS": {"rows": 4, "cols": 4, "data": POSE.ravel().tolist()}}))
    np.testing.assert_array_equal(body_from_sensor, POSE)

    mirrored, stretched = np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 1.01, 1])
    refused: tuple[tuple[Callable[[Path], object], dict[str, Any], dict[str, Any], str], ...] = (
        (read_imu_noise, NOISE, {"gyroscope_random_walk": "left out"}, "gyroscope_random_walk is missing"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": None}, "gyroscope_random_walk is missing"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": "low"}, "'low' is not a list of numbers"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": {"of": 1}}, "is not a list of numbers"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": [1, 2]}, "must hold 1 numbers, found 2"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": float("nan")}, "not a list of numbers|must be finite"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": "1e999"}, "numbers must be finite"),
        (read_imu_noise, NOISE, {"gyroscope_random_walk": -1.0}, "sensor.yaml"),
        (read_camera, CAMERA, {"camera_model": "left out"}, "camera_model None is not supported"),
        (read_camera, CAMERA, {"distortion_model": "left out"}, "distortion_model None .*radial-tangential, radtan"),
        (read_camera, CAMERA, {"intrinsics": [1.0, 2, 3]}, "intrinsics must hold 4 numbers, found 3"),
        (read_camera, CAMERA, {"distortion_coefficients": [0.1] * 5}, "coefficients must hold 4 numbers, found 5"),
        (read_camera, CAMERA, {"distortion_coefficients": "left out"}, "distortion_coefficients is missing"),
        (read_camera, CAMERA, {"resolution": [640, 0]}, "resolution: "),
        (read_body_from_sensor, {}, {"T_BS": [1.0] * 16}, "no T_BS with rows, cols and data"),
        (read_body_from_sensor, {}, {"T_BS": {"data": [1.0] * 15}}, "data must hold 16 numbers, found 15"),
        (read_body_from_sensor, {}, {"T_BS": {"data": mirrored.tolist()}}, "T_BS holds no rotation"),
        (read_body_from_sensor, {}, {"T_BS": {"data": stretched.tolist()}}, "T_BS holds no rotation"),
    )
    for read, of, changes, said in refused:
        with pytest.raises(FormatError, match=said):
            read(sheet(of, **changes))


def test_a_video_s_stamps_packet_by_packet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def stamps(
        packets: list[int | None],
        *,
        cut: tuple[int, ...] = (),
        listed: int = 0,
        duration_s: float | None = None,
        base: Fraction | None = Fraction(1, 1000),
    ) -> list[int]:
        demuxed = [SimpleNamespace(pts=pts, size=9, is_discard=i in cut) for i, pts in enumerate(packets)]
        demuxed.append(SimpleNamespace(pts=None, size=0, is_discard=False))  # FFmpeg's end is a packet of nothing
        container = nullcontext()
        container.demux = lambda stream: iter(demuxed)  # type: ignore[attr-defined]
        container.format = SimpleNamespace(name="matroska,webm")  # type: ignore[attr-defined]
        monkeypatch.setattr(video, "_open", lambda path: (container, SimpleNamespace(frames=listed, time_base=base)))
        monkeypatch.setattr(video, "_read_duration_s", lambda stream: duration_s)
        return [t_ns // 1_000_000 for t_ns in video.video_stamps_ns(tmp_path / "film.mkv").tolist()]

    assert stamps([0, 40, 20, 60]) == [0, 20, 40, 60]
    assert stamps([0, 20, 40, 60], cut=(0, 1)) == [40, 60]
    assert stamps([0, 20], listed=2, duration_s=0.14) == [0, 20]
    refused: tuple[tuple[list[int | None], dict[str, Any], type[InertialError], str], ...] = (
        ([], {}, FormatError, "holds no video frames"),
        ([0, 20], {"cut": (0, 1)}, FormatError, "holds no video frames"),
        ([0, None, 40], {}, TimingError, "no presentation timestamps; give frame_times"),
        ([0, 20, 40], {"base": None}, TimingError, "no presentation timestamps; give frame_times"),
        ([0, 20, 40, 20], {}, TimingError, "two frames have the presentation timestamp 0.020000 s"),
        ([0, 20], {"listed": 5}, FormatError, "is cut off: it holds 2 of the 5 frames .*, the last at 0.020 s"),
        ([0, 20], {"duration_s": 0.17}, FormatError, "is cut off: it states 0.170 s, but holds 2 frames"),
    )
    for packets, given, kind, said in refused:
        with pytest.raises(kind, match=said):
            stamps(packets, **given)


def test_a_film_without_a_wanted_frame_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def frame(pts: int, width: int = 64) -> SimpleNamespace:
        return SimpleNamespace(pts=pts, time_base=Fraction(1, 1000), is_corrupt=pts == 77, width=width, height=48)

    def wanted(frames: list[SimpleNamespace], *wanted_ms: int) -> list[int]:
        container = nullcontext()
        container.decode = lambda stream: iter(frames)  # type: ignore[attr-defined]
        container.seek = lambda *args, **kwargs: None  # type: ignore[attr-defined]
        stream = SimpleNamespace(time_base=Fraction(1, 1000), start_time=0, frames=0, thread_type="")
        monkeypatch.setattr(video, "_open", lambda path: (container, stream))
        wanted_ns = np.array(wanted_ms, np.int64) * 1_000_000
        return [t_ns // 1_000_000 for t_ns, _ in video._decode_wanted(tmp_path / "film.mkv", wanted_ns)]

    film = [frame(pts) for pts in (0, 20, 40, 60)]
    assert wanted(film) == []
    assert wanted(film, 20, 60) == [20, 60]
    assert wanted([frame(77), frame(90)], 90) == [90]  # none that is wanted is made from it
    assert wanted([frame(20), frame(40, 32)], 20) == [20]
    for frames, times, said in (
        (film, (20, 50, 70), "2 of 3 frames cannot be decoded .first: at 0.050000 s"),
        ([frame(60), frame(77), frame(90)], (60, 90), "the frame at 0.077 s cannot be fully decoded"),
        ([frame(20), frame(40, 32)], (20, 40), "changes its size from 64x48 to 32x48 at 0.040 s"),
    ):
        with pytest.raises(FormatError, match=said):
            wanted(frames, *times)
