"""A simulated recording in the files of a user who has a COLMAP model."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.tools.simulate import SimulatedRecording


@dataclass(frozen=True)
class Project:
    """A user's files: a COLMAP model, frame times, an IMU folder; and the truth behind them."""

    model: Path
    frame_times: Path
    imu: Path
    recording: SimulatedRecording


def write_project(folder: Path, recording: SimulatedRecording) -> Project:
    """Write a simulated recording as a user would have it: a COLMAP model without points, a CSV, sensor text files."""
    import pycolmap

    trajectory, imu = recording.trajectory, recording.imu
    names = [f"{i:05}.jpg" for i in range(len(trajectory))]
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480)
    reconstruction.add_camera_with_trivial_rig(camera)
    for i, (name, q, centre) in enumerate(
        zip(names, trajectory.cam_from_world_xyzw, trajectory.cam_in_world, strict=True)
    ):
        rotation = pycolmap.Rotation3d(q)
        pose = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ centre))
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pose)
    reconstruction.write_binary(str(model))

    frame_times = folder / "frames.csv"
    stamps_ns = trajectory.epoch_ns + np.rint(trajectory.t_s * 1e9).astype(np.int64)
    rows = [f"{name},{stamp}" for name, stamp in zip(names, stamps_ns.tolist(), strict=True)]
    frame_times.write_text("name,t_ns\n" + "\n".join(rows) + "\n")

    imu_folder = folder / "imu"
    imu_folder.mkdir()
    for name, t_s, values in (
        ("gyroscope.txt", imu.gyro_t_s, imu.gyro_rad_s),
        ("accelerometer.txt", imu.accel_t_s, imu.accel_m_s2),
    ):
        t_ns = imu.epoch_ns + np.rint(t_s * 1e9).astype(np.int64)
        lines = [f"{t} {x:.8f} {y:.8f} {z:.8f}" for t, (x, y, z) in zip(t_ns.tolist(), values, strict=True)]
        (imu_folder / name).write_text("\n".join(lines) + "\n")
    return Project(model=model, frame_times=frame_times, imu=imu_folder, recording=recording)
