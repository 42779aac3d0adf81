"""A metric model of EuRoC V1_01_easy against motion capture: scale error, up axis, camera centres.

    python -m scripts.studies.check_euroc OUT/sparse/0 DATASET

DATASET is the folder with ``gt/`` and ``mav0/``. The scale error is the metric model's length over the true
length, minus one, from a similarity between camera centres (Umeyama 1991). The true up is the accelerometer averaged in
the motion-capture frame over the whole flight, less the flight's mean acceleration: that frame's z is tilted against
gravity by a quarter of a degree.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import yaml

from colmap_inertial.core.geometry import quat_rotate, slerp
from colmap_inertial.io.imu import read_imu
from colmap_inertial.model import TRANSFORM_FILE, read_model


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and translation that take ``source`` to ``target``, (N, 3) each, by least squares."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float(np.trace(np.diag(d) @ sign) / np.sum(a**2))
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def check(model: Path, dataset: Path) -> dict[str, float]:
    """The figures that :mod:`this script <check_euroc>` prints."""
    reconstruction = read_model(model)
    images = sorted((reconstruction.image(i) for i in reconstruction.reg_image_ids()), key=lambda image: image.name)
    images = [image for image in images if not image.name.startswith("cam1/")]  # the right camera of a rig
    centres = np.array([image.projection_center() for image in images])
    stamps_ns = np.array([int(Path(image.name).stem.split("_")[0]) for image in images])

    truth = np.loadtxt(dataset / "gt" / "V1_01_easy.csv", delimiter=",", skiprows=1)
    truth_ns = np.loadtxt(dataset / "gt" / "V1_01_easy.csv", delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
    epoch_ns = truth_ns[0]
    t_s = (truth_ns - epoch_ns) * 1e-9
    world_from_imu = truth[:, [5, 6, 7, 4]]
    sheet = (dataset / "mav0" / "cam0" / "sensor.yaml").read_text().replace("%YAML:1.0", "")
    cam_in_imu = np.array(yaml.safe_load(sheet)["T_BS"]["data"]).reshape(4, 4)[:3, 3]
    query_s = (stamps_ns - epoch_ns) * 1e-9
    imu_in_world = np.stack([np.interp(query_s, t_s, truth[:, 1 + k]) for k in range(3)], axis=1)
    true_centres = imu_in_world + quat_rotate(slerp(t_s, world_from_imu, query_s), cam_in_imu)

    scale, rotation, translation = similarity(centres, true_centres)
    residual_m = np.linalg.norm(scale * centres @ rotation.T + translation - true_centres, axis=1)

    imu = read_imu(dataset / "mav0" / "imu0")
    accel_s = imu.accel_t_s + (imu.epoch_ns - int(epoch_ns)) * 1e-9
    inside = (accel_s > t_s[0]) & (accel_s < t_s[-1])
    force = quat_rotate(slerp(t_s, world_from_imu, accel_s[inside]), imu.accel_m_s2[inside] - truth[:, 14:17].mean(0))
    up = force.mean(0) - (truth[-1, 8:11] - truth[0, 8:11]) / (t_s[-1] - t_s[0])
    model_up = rotation @ np.array([0, 0, 1.0])
    angle = np.degrees(np.arccos(np.clip(model_up @ up / np.linalg.norm(up), -1, 1)))
    figures = {
        "registered_images": len(images),
        "scale_error_pct": 100 * (1 / scale - 1),
        "up_error_deg": float(angle),
        "centre_rms_m": float(np.sqrt(np.mean(residual_m**2))),
    }
    transform = json.loads((model / TRANSFORM_FILE).read_text())
    sigma = np.sqrt(transform["cov"][0][0])
    figures["stated_half_width_pct"] = 196 * sigma
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("dataset", type=Path)
    for name, value in check(**vars(parser.parse_args())).items():
        print(f"{name:<22} {value:.4g}")
