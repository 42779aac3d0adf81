"""Real stereo pairs of an AprilGrid, mapped and scaled by its tags: the baseline in metres.

    python -m scripts.studies.validate_aprilgrid DATA [--pairs N]

DATA is a folder with ``euroc_calib_aprilgrid`` (``<n>_0.jpg`` and ``<n>_1.jpg``: 6x6 tags of 0.088 m, gap ratio 0.3)
and ``euroc_v101`` (``mav0/cam*/sensor.yaml``: intrinsics and the rig's true baseline). Nothing tells COLMAP that the
images are pairs, so the distance between the two cameras is an independent check of the scale. The pairs see the
target from near and far; their baselines are averaged as vectors, each weighted by what its corners tell about it.
"""

from __future__ import annotations

import argparse
import tempfile
import zlib  # noqa: F401  must come before pycolmap
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import yaml
from rich.console import Console

from colmap_inertial.core.geometry import skew
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.validate import Validation, parse_target, validate_model, validation_table
from colmap_inertial.validate.detect import Detection, detect

SPEC = "aprilgrid:6x6:0.088:0.3"
LEAST_COMMON = 16


@dataclass(frozen=True)
class Result:
    """Baseline of the rig from all pairs with its standard error, that of each pair (P,), and the calibrated one."""

    baseline_m: float
    sigma_m: float
    baselines_m: np.ndarray
    true_m: float
    images: int
    registered: int
    validation: Validation

    @property
    def error_pct(self) -> float:
        return 100 * (self.baseline_m / self.true_m - 1)


def read_rig(folder: Path) -> tuple[list[pycolmap.Camera], float]:
    """The two cameras with COLMAP's pixel origin, and the distance between them in metres."""
    cameras, centres = [], []
    for i in range(2):
        text = (folder / f"cam{i}" / "sensor.yaml").read_text().removeprefix("%YAML:1.0\n")
        sensor = yaml.safe_load(text)
        width, height = sensor["resolution"]
        fx, fy, cx, cy = sensor["intrinsics"]
        camera = pycolmap.Camera.create_from_model_name(i + 1, "OPENCV", fx, width, height)
        camera.params = [fx, fy, cx + 0.5, cy + 0.5, *sensor["distortion_coefficients"]]
        camera.has_prior_focal_length = True
        cameras.append(camera)
        centres.append(np.array(sensor["T_BS"]["data"]).reshape(4, 4)[:3, 3])
    return cameras, float(np.linalg.norm(centres[1] - centres[0]))


def write_database(path: Path, cameras: list[pycolmap.Camera], seen: dict[str, Detection]) -> None:
    """A database as COLMAP would make it, with tag corners for keypoints and their numbers for matches."""
    with pycolmap.Database.open(path) as database:
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        ids = {}
        for number, (name, detection) in enumerate(seen.items(), start=1):
            camera = cameras[int(Path(name).stem[-1])]
            image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=number)
            ids[name] = database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=camera.camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(ids[name], detection.xy_px.astype(np.float32))
        for a, b in combinations(seen, 2):
            _, ia, ib = np.intersect1d(seen[a].corner, seen[b].corner, return_indices=True)
            if len(ia) < LEAST_COMMON:
                continue
            matches = np.stack([ia, ib], axis=1).astype(np.uint32)
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[int(Path(a).stem[-1])], seen[a].xy_px, cameras[int(Path(b).stem[-1])], seen[b].xy_px, matches
            )
            database.write_matches(ids[a], ids[b], matches)
            database.write_two_view_geometry(ids[a], ids[b], geometry)


def pose_covariance(model: pycolmap.Reconstruction, image: pycolmap.Image) -> np.ndarray:
    """(6, 6) of the camera's turn (rad) and shift (model units), camera frame, for corner noise of one pixel."""
    camera, pose = model.cameras[image.camera_id], image.cam_from_world()
    points = np.array([model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()])
    in_cam = points @ pose.rotation.matrix().T + pose.translation
    columns = []
    for step in 1e-5 * np.eye(6):
        move = np.cross(step[:3], in_cam) - step[3:]
        columns.append((camera.img_from_cam(in_cam + move) - camera.img_from_cam(in_cam - move)).ravel() / 2e-5)
    jacobian = np.array(columns).T
    return np.linalg.inv(jacobian.T @ jacobian)


def mean_baseline(model: pycolmap.Reconstruction, pairs: list[tuple[pycolmap.Image, pycolmap.Image]]) -> np.ndarray:
    """Length of the mean baseline and its standard error, model units; pairs far off the others are left out."""
    vectors, weights = [], []
    for left, right in pairs:
        a, b = left.cam_from_world().rotation.matrix(), right.cam_from_world().rotation.matrix()
        vector = a @ (right.projection_center() - left.projection_center())
        by_left = np.hstack([-skew(vector), -np.eye(3)])
        cov = by_left @ pose_covariance(model, left) @ by_left.T
        weights.append(np.linalg.inv(cov + a @ b.T @ pose_covariance(model, right)[3:, 3:] @ b @ a.T))
        vectors.append(vector)
    vector, weight, keep = np.array(vectors), np.array(weights), np.ones(len(pairs), dtype=bool)
    for _ in range(3):
        total = weight[keep].sum(axis=0)
        mean = np.linalg.solve(total, np.einsum("nij,nj->i", weight[keep], vector[keep]))
        square = np.einsum("ni,nij,nj->n", vector - mean, weight, vector - mean) / 3
        keep = square < 16 * np.median(square)
    along = mean / np.linalg.norm(mean)
    return np.array([np.linalg.norm(mean), np.sqrt(square[keep].mean() * along @ np.linalg.solve(total, along))])


def measure(data: Path, *, pairs: int | None = None) -> Result:
    """Map the first ``pairs`` stereo pairs (all by default) and measure their baselines."""
    images = data / "euroc_calib_aprilgrid"
    cameras, true_m = read_rig(data / "euroc_v101" / "mav0")
    target = parse_target(SPEC)
    numbers = sorted(int(path.stem[:-2]) for path in images.glob("*_0.jpg"))[:pairs]
    seen = {}
    for name in (f"{n}_{side}.jpg" for n in numbers for side in (0, 1)):
        found = detect(cv2.imread(str(images / name), cv2.IMREAD_GRAYSCALE), target)
        if found and len(found[0].corner) >= LEAST_COMMON:
            seen[name] = found[0]
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        write_database(database, cameras, seen)
        options = pycolmap.IncrementalPipelineOptions()
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_principal_point = False
        options.multiple_models = options.extract_colors = False
        options.random_seed, options.num_threads = 0, 1
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.mapper.init_min_num_inliers = 60
        options.mapper.abs_pose_min_num_inliers = LEAST_COMMON
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
        models = pycolmap.incremental_mapping(database, images, Path(folder), options=options)
    if not models:
        raise SystemExit("COLMAP could not map the images")
    model = max(models.values(), key=lambda m: m.num_reg_images())
    validation = validate_model(model, images, target, ValidateOptions(unscaled=True, max_views=2 * len(numbers)))
    scale = validation.metres_per_unit if validation.control is None else validation.control.metres_per_unit
    image = {image.name: image for image in model.images.values() if image.has_pose}
    both = [(f"{n}_0.jpg", f"{n}_1.jpg") for n in numbers if f"{n}_0.jpg" in image and f"{n}_1.jpg" in image]
    each_m = [scale * np.linalg.norm(image[a].projection_center() - image[b].projection_center()) for a, b in both]
    baseline_m, sigma_m = scale * mean_baseline(model, [(image[a], image[b]) for a, b in both])
    return Result(baseline_m, sigma_m, np.array(each_m), true_m, 2 * len(numbers), model.num_reg_images(), validation)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with euroc_calib_aprilgrid and euroc_v101")
    parser.add_argument("--pairs", type=int, help="use only the first pairs")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    result = measure(arguments.data, pairs=arguments.pairs)
    Console().print(validation_table(result.validation))
    each = result.baselines_m
    print(f"{result.registered} of {result.images} images mapped, {len(each)} complete pairs")
    print(f"baselines of single pairs: median {np.median(each):.5f} m, from {each.min():.5f} to {each.max():.5f}")
    print(
        f"stereo baseline: {result.baseline_m:.5f} +- {result.sigma_m:.5f} m, calibrated {result.true_m:.5f} m: "
        f"error {result.error_pct:+.2f} %"
    )


if __name__ == "__main__":
    main()
