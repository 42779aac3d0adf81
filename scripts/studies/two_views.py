"""Rotations of close frames of a real video against its gyroscope: COLMAP's own, refined ones, averages; alignment.

    python -m scripts.studies.two_views FOLDER [--data ../shared/data/euroc_mh01] [--frames N] [--features N]

COLMAP finds and matches features of the first frames of EuRoC MH_01 (20 Hz), 1, 2 and 4 apart, in FOLDER; those there
stay. The truth is the gyroscope's rotation, less its mean while the camera stands still at the end, with the
published rotation between camera and IMU; it is off by about .01 degrees from frame to frame.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import yaml

from colmap_inertial.colmap.views.gyro_orientations import estimate_gyro_orientations
from colmap_inertial.colmap.views.two_views import compare, open_features, read_ray_pairs, read_rotations_rad
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, so3_exp, so3_log
from colmap_inertial.core.types import FrameTiming, ImuRecording
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.recording import Recording

STEPS = (1, 2, 4)
#: The camera stands still then, seconds after the first frame.
STILL_S = (20.0, 27.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Video:
    """Frames, IMU and published calibration of MH_01; times in seconds after the first frame."""

    images: Path
    names: tuple[str, ...]
    t_s: Array
    imu_t_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    cam_from_imu: Array
    camera: str

    @classmethod
    def of(cls, data: Path, frames: int) -> Video:
        folder = data / "mav0" / "cam0"
        names = tuple(sorted(path.name for path in (folder / "data").iterdir()))[:frames]
        t_ns = np.array([int(Path(name).stem) for name in names])
        rows = np.genfromtxt(data / "mav0" / "imu0" / "data.csv", delimiter=",", skip_header=1)
        sensor = yaml.safe_load((folder / "sensor.yaml").read_text())
        imu_from_cam = np.array(sensor["T_BS"]["data"]).reshape(4, 4)[:3, :3]
        return cls(
            images=folder / "data",
            names=names,
            t_s=1e-9 * (t_ns - t_ns[0]),
            imu_t_s=1e-9 * (rows[:, 0] - t_ns[0]),
            gyro_rad_s=rows[:, 1:4],
            accel_m_s2=rows[:, 4:7],
            cam_from_imu=imu_from_cam.T,
            camera=",".join(map(str, [*sensor["intrinsics"], *sensor["distortion_coefficients"]])),
        )

    def world_from_cam(self) -> Array:
        """(N, 3, 3) orientations of the frames by the gyroscope."""
        from scipy.spatial.transform import Rotation, Slerp

        still = (self.imu_t_s > STILL_S[0]) & (self.imu_t_s < STILL_S[1])
        rate = self.gyro_rad_s - self.gyro_rad_s[still].mean(axis=0)
        turns = so3_exp(0.5 * (rate[:-1] + rate[1:]) * np.diff(self.imu_t_s)[:, None])
        orientation = [np.eye(3)]
        for turn in turns:
            orientation.append(orientation[-1] @ turn)
        of_frames = Slerp(self.imu_t_s, Rotation.from_matrix(orientation))(self.t_s).as_matrix()
        return np.asarray(of_frames @ self.cam_from_imu.T)


def match(database: Path, video: Video, pairs: list[tuple[str, str]], features: int) -> None:
    """Features and verified matches of pairs, by COLMAP."""
    reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=video.camera)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=2, use_gpu=False)
    extraction.sift.max_num_features = features
    pycolmap.extract_features(
        database,
        video.images,
        image_names=list(video.names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    listed = database.with_suffix(".txt")
    listed.write_text("\n".join(" ".join(pair) for pair in pairs))
    pycolmap.match_image_pairs(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=2, use_gpu=False),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(listed)),
    )


def solve_by_colmap(database: Path, pairs: list[tuple[str, str]]) -> Array:
    """(M, 3, 3) ``first_from_second`` as COLMAP takes it from its matrices; NaN where it finds none."""
    rotations = np.full((len(pairs), 3, 3), np.nan)
    with open_features(database) as features:
        for k, pair in enumerate(pairs):
            views = features.geometry(*pair)
            first, second = ((features.camera(name), features.xy_px(name)) for name in pair)
            if pycolmap.estimate_two_view_geometry_pose(*first, *second, views) and views.cam2_from_cam1 is not None:
                rotations[k] = matrix_from_quat(np.array(views.cam2_from_cam1.rotation.quat)).T
    return rotations


def say(name: str, found: Array, true: Array) -> None:
    off = np.degrees(np.linalg.norm(so3_log(np.swapaxes(true, 1, 2) @ found), axis=1))
    off = off[np.isfinite(off)]
    print(f"| {name} | {len(off)} | {np.median(off):.3f} | {np.percentile(off, 90):.3f} | {np.mean(off > 1):.1%} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[3] / "shared" / "data" / "euroc_mh01")
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--features", type=int, default=1500)
    args = parser.parse_args()
    if not args.data.is_dir():
        print(f"skipped: {args.data} is not there")
        return
    video = Video.of(args.data, args.frames)
    places = [(i, i + step) for i in range(len(video.names)) for step in STEPS if i + step < len(video.names)]
    pairs = [(video.names[i], video.names[j]) for i, j in places]
    args.folder.mkdir(parents=True, exist_ok=True)
    database = args.folder / "database.db"
    if not database.exists():
        match(database, video, pairs, args.features)
    orientation = video.world_from_cam()
    first, second = np.array(places).T
    true = np.swapaxes(orientation[first], 1, 2) @ orientation[second]
    refined = compare(database, pairs).first_from_second
    turn_rad = read_rotations_rad(database, video.names, places)
    print("| rotations | of | median, degrees | 90 % | beyond 1 degree |\n|---|---|---|---|---|")
    for step in STEPS:
        of = second - first == step
        say(f"{step} apart, COLMAP's", solve_by_colmap(database, [pairs[k] for k in np.flatnonzero(of)]), true[of])
        say(f"{step} apart, refined", refined[of], true[of])
    say("consecutive, averaged", so3_exp(turn_rad), np.swapaxes(orientation[:-1], 1, 2) @ orientation[1:])
    timing = FrameTiming(names=video.names, t_s=video.t_s)
    imu = ImuRecording(
        gyro_t_s=video.imu_t_s, gyro_rad_s=video.gyro_rad_s, accel_t_s=video.imu_t_s, accel_m_s2=video.accel_m_s2
    )
    prior = calibration_prior(Declared())
    recording = Recording.of(load_capture(args.data), imu, timing, prior, max_offset_s=1.0)
    rays = read_ray_pairs(database, video.names, places)
    found = estimate_gyro_orientations(recording, turn_rad, rays, None).calibration
    off = so3_log(video.cam_from_imu.T @ matrix_from_quat(found.cam_from_imu_xyzw))
    print(
        f"gyroscope: {1e3 * found.gyro_time_offset_s:.1f} +- {1e3 * found.clock_sigma_s:.1f} ms late (one sigma), axes "
        f"{np.degrees(np.linalg.norm(off)):.2f} degrees off the published ones, by "
        f"{np.degrees(np.sqrt(3) * found.rotation_sigma_rad):.2f} (one sigma)"
    )


if __name__ == "__main__":
    main()
