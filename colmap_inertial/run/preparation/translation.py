"""Blur by translation: whether pixels move from frame to frame, and how the camera moves past what each frame shows.

Positions of a model alone do not give the velocity of a hand between frames; smoothed with the accelerometer, they do,
also for frames that the model lacks. Depths are those of the points that the nearest frames of the model have seen.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraModel, CameraTrajectory, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.parallax import Parallax, parallax_from_points
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import colmap_camera, trajectory_from_model
from colmap_inertial.motion.lateral_flow import follow_pairs
from colmap_inertial.run.preparation.frame_reading import FOLLOWED, GreyFrames
from colmap_inertial.run.preparation.sampling import names_at
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.metric import calibration_of_rectified, smooth_path

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TranslationLimits:
    """Limits for blur by the camera's translation."""

    #: Pairs that are followed in each segment of a recording.
    pairs: int = 12
    #: So many of them show enough blur where the camera translates.
    blurred_pairs: int = 2
    #: Frames further apart do not tell how quickly the camera moved at either.
    apart_s: float = 0.5
    #: Nobody slides past things more quickly, depths per second: a metre a second, half a metre away.
    depths_per_s: float = 2.0
    #: A frame shows what the nearest frames of a model show, where they are near enough.
    neighbours: int = 3
    farthest_s: float = 2.0
    #: Velocities are used where their standard deviation is below this share of them, or of what is slow anyway.
    velocity_share: float = 0.3
    slow_m_s: float = 0.1
    #: A model of fewer images says nothing.
    model_images: int = 8


_LIMITS = TranslationLimits()


def most_by_sliding_px(timing: FrameTiming, camera: CameraModel) -> float:
    """Blur by sliding that the longest exposure lets expect at the most, px."""
    longest_s = 0.0 if timing.exposure_s is None else float(timing.exposure_s.max())
    return _LIMITS.depths_per_s * longest_s * colmap_camera(camera).mean_focal_length()


def translating_segments(
    recording: Recording,
    frames: GreyFrames,
    camera: CameraModel,
    parts: Sequence[Sequence[str]],
    limit_px: float,
    progress: Progress,
    motion: GyroCamera | None = None,
) -> list[bool]:
    """Parts of a recording in which translation blurs frames by more than a limit, from motion between frames.

    Parameters
    ----------
    recording
        With the frames to use.
    frames
        All images: pixels are followed to the next frame of the video, where frames were chosen from one.
    camera
        Intrinsics; a guess serves without a gyroscope.
    parts
        Names of frames, in order of time.
    limit_px
        Blur that counts, px of the image as it is.
    progress
        Called with ``"motion"``.
    motion
        Takes the camera's turning out; without it, all that moves counts.
    """
    timing, every = recording.timing, frames.timing
    if timing.exposure_s is None or most_by_sliding_px(timing, camera) < limit_px:
        return [False] * len(parts)
    exposure_s = dict(zip(timing.names, timing.exposure_s.tolist(), strict=True))
    place = {name: i for i, name in enumerate(every.names)}
    focal_px = colmap_camera(camera).mean_focal_length()
    chosen: list[list[str]] = []
    for names in parts:
        near = [
            name
            for name in names
            if place[name] + 1 < len(every.t_s)
            and every.t_s[place[name] + 1] - every.t_s[place[name]] <= _LIMITS.apart_s
            and _LIMITS.depths_per_s * exposure_s[name] * focal_px >= limit_px
        ]
        some = np.unique(np.linspace(0, len(near) - 1, min(len(near), _LIMITS.pairs)).astype(np.intp))
        chosen.append([near[i] for i in some])
    firsts = {name for names in chosen for name in names}
    if not firsts:
        return [False] * len(parts)
    indices = sorted({place[name] + k for name in firsts for k in (0, 1)})
    seen = report_each(frames.look(FOLLOWED, names_at(every, indices)), len(indices), "motion", progress)
    projector = colmap_camera(camera)
    with one_blas_thread():
        blur_px = {
            pair.name: exposure_s[pair.name] * pair.speed_px_s(projector, motion)
            for pair in follow_pairs(seen, every, firsts)
        }
    return [sum(blur_px.get(name, 0.0) >= limit_px for name in names) >= _LIMITS.blurred_pairs for names in chosen]


def find_parallaxes(models: Sequence[pycolmap.Reconstruction], view: GyroView) -> dict[str, Parallax]:
    """The parallax of frames, by name; those without are of frames that no model tells about.

    Parameters
    ----------
    models
        Of frames of the recording, of rectified keypoints where there is a readout. Of several that tell about a frame,
        the one counts that has it, or has one nearest to it.
    view
        Gyroscope, camera and times.
    """
    out: dict[str, tuple[float, Parallax]] = {}
    for model in models:
        if model.num_reg_images() >= _LIMITS.model_images:
            for name, away_s, parallax in _measure_parallax(model, view):
                if name not in out or away_s < out[name][0]:
                    out[name] = away_s, parallax
    return {name: parallax for name, (_, parallax) in out.items()}


def _measure_parallax(model: pycolmap.Reconstruction, view: GyroView) -> Iterator[tuple[str, float, Parallax]]:
    """Names of frames, how far in time they are from the model's nearest one, and their parallax."""
    calibration = calibration_of_rectified(view.calibration) if view.timing.readout_s else view.calibration
    trajectory, _ = trajectory_from_model(model, view.timing)
    imu = view.timed().imu
    estimate = estimate_scale(trajectory, imu, calibration=calibration, options=ScaleOptions())
    if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
        log.info("no blur by translation: %s", "; ".join(sentences(estimate.reasons)))
        return
    if estimate.rotations is not None:
        trajectory = trajectory.select(estimate.rotations.kept)
    metric = dataclasses.replace(
        trajectory, cam_in_world=trajectory.cam_in_world * estimate.metres_per_unit, length_unit="m", pose_cov=None
    )
    every_s = view.timing.pose_t_s()
    around = np.flatnonzero(
        (every_s >= trajectory.t_s[0] - _LIMITS.farthest_s) & (every_s <= trajectory.t_s[-1] + _LIMITS.farthest_s)
    )
    try:
        path = smooth_path(metric, imu, estimate, estimate.gravity_in_world_m_s2, also_at_s=every_s[around])
    except NotObservableError as error:
        log.info("no blur by translation: %s", error)
        return
    seen = _points_seen(model, trajectory, estimate.metres_per_unit)
    camera, width, height = colmap_camera(view.camera), view.camera.width, view.camera.height
    rotation = matrix_from_quat(path.cam_from_world_xyzw)
    sigma = np.sqrt(np.trace(path.cov[:, 3:6, 3:6], axis1=1, axis2=2))
    speed = np.linalg.norm(path.velocity_in_world, axis=1)
    known = sigma < _LIMITS.velocity_share * np.maximum(speed, _LIMITS.slow_m_s)
    for k in around:
        t_s = float(every_s[k])
        i = min(int(np.searchsorted(path.t_s, t_s - 1e-6)), len(path.t_s) - 1)
        away_s = np.abs(trajectory.t_s - t_s)
        near = np.argsort(away_s)[: _LIMITS.neighbours]
        if abs(path.t_s[i] - t_s) > 1e-5 or not known[i] or away_s[near[0]] > _LIMITS.farthest_s:
            continue
        points = np.unique(np.concatenate([seen[n] for n in near]), axis=0)
        in_cam = (points - path.cam_in_world[i]) @ rotation[i].T
        velocity = rotation[i] @ path.velocity_in_world[i]
        parallax = parallax_from_points(in_cam, velocity, camera, width=width, height=height)
        if parallax is not None:
            yield view.timing.names[k], float(away_s[near[0]]), parallax


def _points_seen(model: pycolmap.Reconstruction, trajectory: CameraTrajectory, factor: float) -> list[Array]:
    """Points (N, 3) that the image of each pose sees."""
    points = {key: factor * point.xyz for key, point in model.points3D.items()}
    out = []
    for name in trajectory.names:
        image = model.find_image_with_name(name)
        out.append(np.array([points[p.point3D_id] for p in image.points2D if p.has_point3D()]).reshape(-1, 3))
    return out
