"""Damaged files: whatever happens to the bytes, a reader answers with a value or with an error of its own, and soon."""

import re
from collections.abc import Callable
from pathlib import Path

from colmap_inertial.io.calibration import Declared, calibration_prior, read_calibration, write_calibration
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_times, read_frames
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.trajectories import read_tum
from tests.helpers.asl_imu import HEADER, handheld, rows
from tests.helpers.cases import loop_over
from tests.helpers.damage import refusals
from tests.io.test_capture import EVERYTHING
from tests.io.test_frames import picture
from tests.io.test_video_frames import write_video

MUTATIONS = 200


def imu_csv(folder: Path) -> Path:
    (folder / "imu.csv").write_text("\n".join([HEADER, *rows(*handheld(60))]) + "\n")
    return folder / "imu.csv"


def inertial_scale(folder: Path) -> Path:
    t_ns, gyro, accel = handheld(60)
    for name, values in (("gyroscope.txt", gyro), ("accelerometer.txt", accel)):
        text = "\n".join(f"{t} {x:.5f} {y:.5f} {z:.5f}" for t, (x, y, z) in zip(t_ns, values, strict=True))
        (folder / name).write_text(text + "\n")
    return folder / "accelerometer.txt"


def tum(folder: Path) -> Path:
    (folder / "a.tum").write_text("".join(f"{i * 0.1:.3f} {i} 0 0.5 0 0 0.6 0.8\n" for i in range(30)))
    return folder / "a.tum"


def frame_times(folder: Path) -> Path:
    (folder / "t.csv").write_text("name,t_s,exposure_s\n" + "".join(f"a{i}.png,{i * 0.1:.3f},0.01\n" for i in range(9)))
    return folder / "t.csv"


def calibration(folder: Path) -> Path:
    write_calibration(folder / "c.json", calibration_prior(Declared(gyro_time_offset_s=1.0)))
    return folder / "c.json"


def capture(folder: Path) -> Path:
    text = re.sub(r"\[video\].*?(?=\[timing\])", "", EVERYTHING, flags=re.S)
    text = re.sub(r'path = "mav0/imu0".*?\n|format = "auto"\n|file = "phone_calibration.json".*?\n', "", text)
    (folder / "capture.toml").write_text(text)
    return folder / "capture.toml"


def sensor_yaml(folder: Path) -> Path:
    (folder / "capture.toml").write_text('[imu]\npath = "a"\n[camera]\nsensor_yaml = "sensor.yaml"\n')
    (folder / "sensor.yaml").write_text(
        "%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0.1,\n 0, 1, 0, 0,\n 0, 0, 1, 0,\n 0, 0, 0, 1]\n"
        "resolution: [752, 480]\ncamera_model: pinhole\nintrinsics: [458.6, 457.2, 367.2, 248.3]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0, 0.0]\n"
    )
    return folder / "sensor.yaml"


def image(suffix: str) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        import cv2

        cv2.imwrite(str(folder / f"a{suffix}"), picture(1))
        return folder / f"a{suffix}"

    return build


def video(folder: Path) -> Path:
    (folder / "capture.toml").write_text('[video]\nfile = "a.mp4"\n')
    return write_video(folder / "a.mp4")


def parent(read: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: read(path.parent)


READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "imu csv": (imu_csv, read_imu),
    "inertial-scale": (inertial_scale, parent(read_imu)),
    "tum": (tum, read_tum),
    "frame times": (frame_times, read_frame_times),
    "calibration": (calibration, read_calibration),
    "capture": (capture, load_capture),
    "sensor.yaml": (sensor_yaml, parent(load_capture)),
    "png": (image(".png"), read_image),
    "jpg": (image(".jpg"), read_image),
    "tif": (image(".tif"), read_image),
    "bmp": (image(".bmp"), read_image),
    "ppm": (image(".ppm"), read_image),
    "video": (video, lambda path: list(read_frames(path.parent)[1])),
}


@loop_over("reader", READERS)
def test_only_errors_of_our_own_escape(tmp_path: Path, reader: str) -> None:
    build, read = READERS[reader]
    path = build(tmp_path)
    for error in refusals(path, lambda: read(path), key=reader, count=MUTATIONS):
        assert str(tmp_path) in str(error) and "\n\n" not in str(error)
