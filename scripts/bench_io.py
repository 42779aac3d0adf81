"""How fast inertial recordings are read: 10 minutes of 200 Hz, as GoPro telemetry and as other files.

    python scripts/bench_io.py

Prints, for each format, the best of three readings in seconds, and its ratio to reading the same recording from a CSV
file. Files are written to a temporary folder; the disk's cache is warm.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import imu_files

from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.imu import read_imu

MINUTES, RATE_HZ = 10.0, 200.0


def made_up() -> ImuRecording:
    """Smooth motion with noise; both sensors at the same stamps, so that every format can hold it."""
    rng = np.random.default_rng(1)
    t_s = np.arange(int(MINUTES * 60 * RATE_HZ)) / RATE_HZ
    gyro = 0.4 * np.sin(t_s[:, None] * [1.7, 2.3, 1.1]) + rng.normal(0, 0.01, (len(t_s), 3))
    accel = np.array([0.3, 0.5, 9.7]) + rng.normal(0, 0.3, (len(t_s), 3))
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel)


def write_csv(path: Path, imu: ImuRecording) -> Path:
    rows = [
        f"{round(t * 1e9)}," + ",".join(f"{v:.6f}" for v in (*g, *a))
        for t, g, a in zip(imu.gyro_t_s, imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    ]
    path.write_text("\n".join(["t_ns,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2", *rows]) + "\n")
    return path


def best_of_three(read: Callable[[], object]) -> float:
    taken = []
    for _ in range(3):
        begin = time.perf_counter()
        read()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def main() -> None:
    imu = made_up()
    frame_ns = (np.arange(int(MINUTES * 60 * 30)) * 1e9 / 30).astype(np.int64)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def own(part: str) -> Path:
            (folder / part).mkdir()
            return folder / part

        paths = {
            "csv": write_csv(folder / "imu.csv", imu),
            "gopro (GPMF)": imu_files.write_gopro(folder / "a.mp4", imu),
            "camm": imu_files.write_camm(folder / "b.mp4", imu, frames=len(frame_ns)),
            "gcsv": imu_files.write_gcsv(folder / "a.gcsv", imu),
            "opencamera": imu_files.write_opencamera(own("opencamera"), imu, frame_ns),
            "mars": imu_files.write_mars(own("mars"), imu, frame_ns),
            "stray-scanner": imu_files.write_stray_scanner(own("stray"), imu, frame_ns),
            "sensor-logger (zip)": imu_files.write_sensor_logger(own("logger"), imu),
            "video-imu-capture": imu_files.write_video_imu_capture(own("vic"), imu, frame_ns),
            "ros 1 bag": imu_files.write_rosbag(folder / "a.bag", imu),
        }
        print(f"{MINUTES:g} minutes of {RATE_HZ:g} Hz gyroscope and accelerometer, {len(imu.gyro_t_s)} samples each")
        print(f"{'format':<22}{'seconds':>9}{'of the CSV':>12}")
        reference = best_of_three(lambda: read_imu(paths["csv"]))
        for label, path in paths.items():
            taken = reference if label == "csv" else best_of_three(lambda path=path: read_imu(path))
            print(f"{label:<22}{taken:9.3f}{taken / reference:12.2f}")


if __name__ == "__main__":
    main()
