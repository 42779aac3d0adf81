"""What the tight refinement does to real recordings.

    python scripts/study_refine_real.py --euroc DATASET FOLDER
    python scripts/study_refine_real.py --recordings FOLDER [--noise-px 10]

``--euroc``: the 100 keyframes of V1_01_easy (DATASET has ``keyframes/``, ``mav0/`` and ``gt/``), matched and mapped by
``reconstruct`` with and without ``--refine inertial``, in FOLDER. Both metric models against motion capture, as
``check_euroc.py`` compares them: the camera centres' error and that of the scale, and what the refinement said.

``--recordings`` (a folder of InertialScale, as ``bench_scale.py`` takes it) has poses and no images: made points are
seen from every eighth pose with ``--noise-px``, as a camera in these places would see them, which holds each pose to a
milliradian and some millimetres, as surely as such poses are known, and the model goes through scale and refinement as
any other. The error of the scale before and after, what the refinement itself would make of it (the stage keeps the
scale's), and how far the refined centres lie from the poses after one similarity.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from bench_scale import recordings_in
from bench_whole import euroc_capture
from check_euroc import check, similarity

from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.files import read_json
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.model import Model
from colmap_inertial.pipeline.stages.metric import MetricStage
from colmap_inertial.pipeline.stages.refine import RefineStage

#: Of the made pictures: one pose of so many, points of each, how many frames on either side see one, and how far (m).
EVERY, POINTS, BESIDE, DEPTH_M = 8, 60, 5, (2.0, 7.0)


def euroc(dataset: Path, folder: Path) -> None:
    """V1_01 mapped by this code, with and without the refinement."""
    capture, _ = euroc_capture(dataset, folder)
    out, found = folder / "out", {}
    # the second run goes on from what the first one mapped
    for refine in ("off", "inertial"):
        command = [sys.executable, "-m", "colmap_inertial", "reconstruct", capture, out, "--deterministic"]
        subprocess.run([*map(str, command), "--refine", refine], check=True, stdout=subprocess.DEVNULL)
        found[refine] = one = check(out / "sparse" / "0", dataset)
        told: list[dict[str, Any]] = read_json(out / "result.json")["models"][0]["treatments"]
        said = "; ".join(each["reason"] for each in told if each["stage"] == "refine")
        print(
            f"--refine {refine}: {one['registered_images']} images, centres {1e3 * one['centre_rms_m']:.2f} mm off, "
            f"scale {one['scale_error_pct']:+.3f} %. {said}",
            flush=True,
        )
    off, on = found["off"], found["inertial"]
    farther = abs(on["scale_error_pct"]) - abs(off["scale_error_pct"])
    ratio = on["centre_rms_m"] / off["centre_rms_m"]
    print(f"centres' error {ratio:.3f} of that without, scale {farther:+.3f} % farther from the truth")


def seen_from(path: CameraTrajectory, metres: float, noise_px: float, seed: int) -> pycolmap.Reconstruction:
    """A model of poses and of made points around them."""
    rng, count = np.random.default_rng(seed), len(path.names)
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1280, height=960, params=[1000.0, 1000.0, 640.0, 480.0]
    )
    rotation, centre = matrix_from_quat(path.cam_from_world_xyzw), path.cam_in_world
    keypoints: list[list[np.ndarray]] = [[] for _ in range(count)]
    points, tracks = [], []
    for i in np.repeat(np.arange(count), POINTS).tolist():
        ray = np.append((rng.uniform([5, 5], [1275, 955]) - [640, 480]) / 1000, 1.0)
        point = centre[i] + rotation[i].T @ ray * rng.uniform(*DEPTH_M) / metres
        track = pycolmap.Track()
        for j in range(max(0, i - BESIDE), min(count, i + BESIDE + 1)):
            in_cam = rotation[j] @ (point - centre[j])
            xy = camera.img_from_cam(in_cam) if in_cam[2] > 0.1 / metres else None
            if xy is not None and (xy > 0).all() and (xy < [1280, 960]).all():
                track.add_element(j + 1, len(keypoints[j]))
                keypoints[j].append(xy + noise_px * rng.standard_normal(2))
        points.append(point)
        tracks.append(track)
    built = pycolmap.Reconstruction()
    built.add_camera_with_trivial_rig(camera)
    for j, name in enumerate(path.names):
        image = pycolmap.Image(name=name, keypoints=np.array(keypoints[j]), camera_id=1, image_id=j + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation[j]), -rotation[j] @ centre[j])
        built.add_image_with_trivial_frame(image, pose)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 2:
            built.add_point3D(point, track)
    return built


def recording(folder: Path, noise_px: float) -> None:
    """One recording of poses, before and after."""
    path, imu = read_inertial_scale(folder)
    path = path.select(np.arange(len(path.names)) % EVERY == 0)
    metres = float((folder / "groundtruth.txt").read_text())
    timing = FrameTiming(names=path.names, t_s=path.t_s, readout_s=0.0, epoch_ns=path.epoch_ns)
    prior = calibration_prior()
    model = Model(reconstruction=seen_from(path, metres, noise_px, 0), colmap_index=0, timing=timing)
    model = MetricStage(imu=imu, calibration=prior)(model)
    if model.similarity is None:
        print(f"{folder.name}: its scale is refused", flush=True)
        return
    refined = RefineStage(imu=imu, calibration=prior, refine_intrinsics=False)(model)
    said = refined.treatments[-1]
    errors, centres = [], []
    for one in (model, refined):
        images = sorted((one.reconstruction.image(i) for i in one.reconstruction.reg_image_ids()), key=_number)
        centres.append(np.array([image.projection_center() for image in images]))
        errors.append(100 * (1 / similarity(centres[-1], metres * path.cam_in_world)[0] - 1))
    scale, rotation, shift = similarity(centres[1], centres[0])
    moved = np.linalg.norm(scale * centres[1] @ rotation.T + shift - centres[0], axis=1)
    by_itself = f"{100 / said.values['size_before'] - 100:+.2f} %" if "size_before" in said.values else "-"
    print(
        f"{folder.name}: {len(path.names)} poses, scale off by {errors[0]:+.2f} -> {errors[1]:+.2f} %, by itself "
        f"{by_itself} of that; moved by {1e3 * float(np.sqrt(np.mean(moved**2))):.1f} mm; {said.reason}",
        flush=True,
    )


def _number(image: pycolmap.Image) -> int:
    return int(image.name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--euroc", type=Path, nargs=2, metavar=("DATASET", "FOLDER"))
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--noise-px", type=float, default=10.0)
    asked = parser.parse_args()
    if asked.euroc:
        euroc(*asked.euroc)
    if asked.recordings:
        for folder in recordings_in(asked.recordings):
            recording(folder, asked.noise_px)


if __name__ == "__main__":
    main()
