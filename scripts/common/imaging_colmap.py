"""Whole reconstructions of simulated scenes, with and without the treatment of frames and keypoints."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.console import Console

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.model import colmap_camera, read_model
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.stages import deblur
from colmap_inertial.run.stages.deblur import SMOOTHING
from colmap_inertial.tools.simulate import MotionOptions, SceneRecipe, make_scene, read_truth, write_capture

#: Share of the blur at which any blur is smoothed alike.
_OF_ANY_BLUR = 1e9
WAYS = {
    "as filmed": ReconstructOptions(deblur="off", rolling_shutter="off"),
    "rectified": ReconstructOptions(deblur="off", rolling_shutter="rectify"),
    "deblurred and rectified": ReconstructOptions(),
}


def measure(*, quick: bool, console: Console) -> dict[str, Any]:
    """A lively desk with 10 px of blur and 20 ms readout, and one with so much blur that frames are lost."""
    base = lively_desk(quick=quick)
    scenes = {"10 px": (base, 10.0), "heavy blur": (replace(base, seed=5), 19.0)}
    out = {}
    for name, (recipe, blur_px) in scenes.items():
        with console.status(f"COLMAP, {name}"):
            out[name] = reconstructed(recipe, blur_px, WAYS)
    mild, heavy = out["10 px"]["ways"], out["heavy blur"]["ways"]
    before, after = mild["as filmed"], mild["deblurred and rectified"]
    out["10 px"]["wanted"] = [
        ("camera error, treated / as filmed", after["centre_error_pct"] / before["centre_error_pct"], 0.2, False),
        ("points, treated / as filmed", after["points"] / before["points"], 1.4, True),
    ]
    count = out["heavy blur"]["images"]
    out["heavy blur"]["wanted"] = [
        ("share of images lost as filmed", 1 - heavy["as filmed"]["registered"] / count, 0.1, True),
        ("share registered, treated", heavy["deblurred and rectified"]["registered"] / count, 1.0, True),
    ]
    return out


def lively_desk(*, quick: bool) -> SceneRecipe:
    """A desk around which a handheld camera with 20 ms readout goes; exposure times are for `with_blur` to find."""
    duration_s = 6.0 if quick else 12.0
    motion = MotionOptions(kind="orbit", duration_s=duration_s, vigour=0.8, sweep_s=16.0, arc_deg=130.0)
    base = SceneRecipe(seed=4, frame_rate_hz=2.5, quality=95, motion=motion)
    return replace(base, camera=replace(base.camera, readout_s=0.02, white_electrons=10000.0))


def with_blur(recipe: SceneRecipe, blur_px: float) -> SceneRecipe:
    """The recipe with an exposure at which the median frame has this blur (90th percentile over the frame)."""
    scene = make_scene(recipe)
    t = np.arange(-1.0, recipe.motion.duration_s + 1.0, 1 / 400)
    path = GyroPath(t, scene.motion.rate_in_cam_rad_s(t), np.zeros(3))
    gyro = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0, 0, 0, 1.0]), offset_s=0.0)
    model = recipe.camera.model
    exposure_s = 0.01
    for _ in range(3):
        timing = FrameTiming(
            names=scene.names,
            t_s=scene.trigger_s,
            epoch_ns=0,
            exposure_s=np.full(len(scene.names), exposure_s),
            readout_s=recipe.camera.readout_s,
        )
        predicted = predict_blur_px(gyro, colmap_camera(model), timing, width=model.width, height=model.height)
        exposure_s *= blur_px / float(np.median(predicted.px))
    return replace(recipe, camera=replace(recipe.camera, exposure_s=round(exposure_s, 5)))


def reconstructed(
    recipe: SceneRecipe,
    blur_px: float,
    ways: Mapping[str, ReconstructOptions],
    widths_px: Mapping[str, float] | None = None,
    said: Callable[[str, dict[str, Any]], None] = lambda way, figures: None,
) -> dict[str, Any]:
    """A scene with this blur, reconstructed in several ways, some with another smoothing of what features see.

    ``said`` hears of each way as it ends.
    """
    widths_px = widths_px or {}
    recipe = with_blur(recipe, blur_px)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # in this process: the recipe's motion may be another than the package's (`recorded_orbits`)
        capture = write_capture(recipe, folder / "capture")
        truth = read_truth(folder / "capture" / "truth.json").trajectory
        # the same options with another smoothing go on from the same plan
        out = {way: folder / str([*ways.values()].index(options)) for way, options in ways.items()}
        found = {}
        for way, options in ways.items():
            found[way] = _run(capture, out[way], options, truth, widths_px.get(way))
            said(way, found[way])
        return {
            "images": len(truth.names),
            "blur_px": blur_px,
            "exposure_s": recipe.camera.exposure_s,
            "readout_s": recipe.camera.readout_s,
            "ways": found,
        }


def _run(
    capture: Path, out: Path, options: ReconstructOptions, truth: CameraTrajectory, width_px: float | None
) -> dict[str, Any]:
    """Of the largest model, as it is handed on; ``width_px``: smoothing of any blur, in place of the package's."""
    smoothing = SMOOTHING if width_px is None else replace(SMOOTHING, share=_OF_ANY_BLUR, most_px=width_px)
    begin_s = time.process_time()
    try:
        with patch.object(deblur, "SMOOTHING", smoothing):
            result = reconstruct(capture, out, options)
    except MappingError:
        return {"registered": 0, "points": 0, "centre_error_pct": float("nan"), "rotation_deg": float("nan")}
    largest = max(result.models, key=lambda model: model.summary["registered_images"])
    best = read_model(largest.sparse_metric or largest.sparse)
    images = [best.image(i) for i in best.reg_image_ids()]
    index = {name: i for i, name in enumerate(truth.names)}
    at = [index[image.name] for image in images]
    true = truth.cam_in_world[at]
    scale, turn, shift = similarity(np.array([image.projection_center() for image in images]), true)
    centres = scale * np.array([image.projection_center() for image in images]) @ turn.T + shift
    rotations = np.array([image.cam_from_world().rotation.matrix() for image in images]) @ turn.T
    relative = np.einsum("nij,nkj->nik", rotations, matrix_from_quat(truth.cam_from_world_xyzw[at]))
    angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(relative, axis1=1, axis2=2) - 1), -1, 1)))
    extent = np.linalg.norm(truth.cam_in_world[:, None] - truth.cam_in_world, axis=2).max()
    estimate = largest.scale
    # what is read is in metres by the estimate, where there is one: then the similarity has its error
    ends = None if estimate.ci95 is None else np.array(estimate.ci95) / (scale * (estimate.metres_per_unit or np.nan))
    return {
        "registered": len(images),
        "points": best.num_points3D(),
        "observations": best.compute_num_observations(),
        # of the largest distance between two cameras
        "centre_error_pct": float(100 * np.sqrt(np.mean(np.sum((centres - true) ** 2, axis=1))) / extent),
        "rotation_deg": float(np.median(angle)),
        "deblurring": str(result.imaging.deblur_note or ""),
        "deblurred": sum(frame.sharpened for frame in result.frames),
        "scale_verdict": estimate.verdict,
        "scale_error_pct": None if ends is None else 100 * (1 / scale - 1),
        "scale_ci95_pct": None if ends is None else [float(round(100 * (end - 1), 2)) for end in ends],
        "cpu_s": round(time.process_time() - begin_s),
    }


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation and shift that take (N, 3) points to others best (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u * sign @ vt
    scale = float((singular * sign).sum() / np.sum(a**2))
    return scale, turn, target.mean(axis=0) - scale * turn @ source.mean(axis=0)
