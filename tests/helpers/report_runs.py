"""Output folders as runs leave them, for the tests of the report: simulated motion, everything else small and known."""

import dataclasses
import json
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.core.types import Similarity
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.files import write_json
from colmap_inertial.report.folders import CROPS_FOLDER, DATA_FOLDER
from colmap_inertial.report.photogrammetry import photogrammetry_record, scene_record
from colmap_inertial.report.signals import signal_record
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording

#: What a user may call things, and what a page must not run.
HOSTILE = '<script>alert("x")</script><img src=x onerror=alert(1)> "quotes" & \'more\' 蜂🐝'


def cloud(num_points: int = 300) -> pycolmap.Reconstruction:
    """A model of a few cameras and so many points."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=num_points
    )
    pycolmap.set_random_seed(1)
    return pycolmap.synthesize_dataset(options)


@lru_cache(maxsize=4)
def recorded(*, kind: str = "orbit", duration_s: float = 20.0, seed: int = 3):
    """Trajectory in metres where there is a scale, IMU, estimate, gravity in the trajectory's world, truth."""
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(kind=kind, duration_s=duration_s)), seed=seed)
    trajectory, imu = recording.trajectory, recording.imu
    estimate = estimate_scale(trajectory, imu)
    gravity = estimate.gravity_in_world_m_s2
    if estimate.metres_per_unit is not None:
        similarity = Similarity.from_scale(estimate)
        gravity = quat_rotate(similarity.rotation_xyzw, gravity)
        trajectory = dataclasses.replace(
            trajectory,
            cam_in_world=similarity.scale * quat_rotate(similarity.rotation_xyzw, trajectory.cam_in_world),
            cam_from_world_xyzw=_turned(trajectory, similarity),
            length_unit="m",
            pose_cov=None,
        )
    return trajectory, imu, estimate, gravity, recording.truth


def _turned(trajectory, similarity):
    from colmap_inertial.core.geometry import quat_conjugate, quat_multiply

    return quat_multiply(trajectory.cam_from_world_xyzw, quat_conjugate(similarity.rotation_xyzw))


def write_run(
    out: Path, *, name: str = "frame", kind: str = "orbit", duration_s: float = 20.0, points: int = 300, models: int = 1
) -> dict:
    """Write a finished run with data for every section, as far as it has a scale; returns ``result.json``'s content.

    ``name`` stands in everything that a user names.
    """
    trajectory, imu, estimate, gravity, _ = recorded(kind=kind, duration_s=duration_s)
    out.mkdir()
    data = out / DATA_FOLDER
    (data / CROPS_FOLDER).mkdir(parents=True)
    count = len(trajectory)
    names = [f"{name}/{i:05}.jpg" for i in range(count)]
    blur_px = 6 + 5 * np.sin(np.arange(count) / 7)
    actions = ["dropped" if i % 50 == 49 else "deblurred" if blur_px[i] > 8 else "passed" for i in range(count)]
    metric = estimate.metres_per_unit is not None
    model = {
        "registered_images": count,
        "points": points,
        "observations": 4 * points,
        "mean_reprojection_error_px": 0.4,
        "sparse": "colmap/sparse/0",
        "sparse_metric": "sparse/0" if metric else None,
        "trajectory": "trajectory.tum" if metric else None,
        **dataclasses.replace(estimate, reasons=(*estimate.reasons, Fact.stated(f"something about {name}"))).as_json(),
        "calibration_change": None,
        "readout_translation": {"shift_px": 1.2, "before_px": 0.5, "after_px": 0.4, "accepted": True},
        "validation": _validation(name) if metric else None,
        "dense": None,
    }
    result = {
        "versions": {"colmap_inertial": "0.1.0", "pycolmap": "4.2.1"},
        "capture": f"/home/user/{name}/capture.toml",
        "models": [{"index": i, **model} for i in range(models)],
        "project_metric": None,
        "waiting": False,
        "imaging": {"deblur": f"{name}: some frames are blurred", "rolling_shutter": "keypoints are rectified"},
        "frames": [
            {
                "name": names[i],
                "action": actions[i],
                "sharpened": actions[i] == "deblurred",
                "reason": f"because of {name}",
                "blur_px": float(blur_px[i]),
                "kept_share": 0.5,
                "extent_factor": 1.0,
                "rectified": True,
            }
            for i in range(count)
        ],
        "seconds": {"frames": 3.0, "mapping": 20.0, "metric": 1.5},
    }
    write_json(out / "result.json", result)
    seen = cloud(points)
    scene = scene_record(seen, trajectory, gravity)
    record = {
        "scene": scene,
        "photogrammetry": photogrammetry_record(seen, np.array(scene["display_from_model_xyzw"]), unit=scene["unit"]),
        "signals": signal_record(trajectory, imu, estimate, gravity),
    }
    for i in range(models):
        write_json(data / f"model_{i}.json", record)
    finding = {"code": "saturated", "severity": "error", "evidence": f"{name} hits the end", "advice": f"mind {name}"}
    write_json(
        out / "diagnosis.json", {"version": 1, "worst": "error", "checked": ["gyroscope"], "findings": [finding]}
    )
    (out / "config.toml").write_text(f"seed = 0\nnote = {json.dumps(name, ensure_ascii=False)}\n", encoding="utf-8")
    shift = np.linspace(-3, 3, 9)[:, None, None] * np.ones((9, 9, 2))
    write_json(
        data / "recording.json",
        {
            "imu": {"device": name, "gyro_hz": 200.0, "accel_hz": 100.0, "duration_s": duration_s},
            "frames": {
                "count": count,
                "duration_s": duration_s,
                "interval_s": duration_s / count,
                "names": names,
                "t_s": (trajectory.t_s - trajectory.t_s[0]).tolist(),
                "exposure_s": [0.01] * count,
                "readout_s": 0.02,
            },
            "rolling_shutter": {
                "t_s": [0.0, 1.0, 2.0],
                "median_px": [1.0, 2.0, 1.5],
                "largest_px": [2.0, 4.0, 3.0],
                "worst": {
                    "name": names[1],
                    "width": 640,
                    "height": 480,
                    "at_px": np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), -1).reshape(-1, 2) * [70, 52],
                    "shift_px": shift.reshape(-1, 2),
                },
            },
        },
    )
    rng = np.random.default_rng(0)
    pairs = []
    for i in range(3):
        for side in ("before", "after"):
            picture = cv2.GaussianBlur(rng.integers(0, 255, (280, 420, 3), dtype=np.uint8), (0, 0), 3)
            cv2.imwrite(str(data / CROPS_FOLDER / f"{i}_{side}.jpg"), picture)
        pairs.append({"name": names[i], "blur_px": 12.5 - i, "before": f"{i}_before.jpg", "after": f"{i}_after.jpg"})
    write_json(data / CROPS_FOLDER / "crops.json", {"crops": pairs})
    pictures = out / "validation" / "0"
    pictures.mkdir(parents=True)
    for i in range(6):
        picture = rng.integers(0, 255, (90, 120, 3), dtype=np.uint8)
        cv2.imwrite(str(pictures / f"{i}.jpg"), cv2.resize(picture, (1920, 1440), interpolation=cv2.INTER_CUBIC))
    return result


def _validation(name: str) -> dict:
    return {
        "target": f"checkerboard:8x6:0.04 {name}",
        "unscaled": False,
        "tolerance_pct": 2.0,
        "within_tolerance": True,
        "scale_error_pct": -0.31,
        "ci95_pct": [-0.5, -0.12],
        "metres_per_unit": 1.0031,
        "metres_per_unit_ci95": [1.001, 1.005],
        "views_used": 2,
        "views_searched": 3,
        "corners_used": 96,
        "corners_rejected": 1,
        "rms_px": 0.12,
        "corner_noise_px": 0.1,
        "pose_noise_px": 0.05,
        "control": None,
        "check": None,
        "check_error_pct": None,
        "check_ci95_pct": None,
        "distances": [
            {"pair": [f"a{name}", f"b{i}"], "known_m": 0.04 * i, "measured": 0.04 * i, "residual_m": 1e-4, "set": kind}
            for i, kind in ((1, "control"), (2, "check"), (3, "mixed"))
        ],
        "views": [{"name": f"{name}{i}.jpg", "corners": 48, "rms_px": 0.1 + i} for i in range(2)],
        "views_rejected": [{"name": "x.jpg", "reason": "target not found", "residual_px": None}],
        "reasons": [f"the print of {name} was not measured"],
    }
