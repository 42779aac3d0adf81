"""Whether a camera that hardly turns blurs frames by sliding past near things: looked at before small models are made.

Points are followed over a few pairs of neighbouring frames. How far they move, but for the turn that the gyroscope
felt, tells how far the same motion smears them while a frame is exposed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.lateral_flow import follow_pairs
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.pipeline.run.progress import Progress, counted
from colmap_inertial.reconstruction.preparation.calibrate import some_frames

#: Pairs that are followed in each part of a recording; in a part that slides, so many of them show enough blur.
_PAIRS, _ENOUGH = 12, 2
#: Frames further apart do not tell how quickly the camera moved at either.
_APART_S = 0.5
#: Nobody slides past things more quickly, depths per second: a metre a second, half a metre away.
_MOST_PER_S = 2.0


def most_by_sliding_px(timing: FrameTiming, camera: CameraModel) -> float:
    """Blur by sliding that the longest exposure lets expect at the most, px."""
    longest_s = 0.0 if timing.exposure_s is None else float(timing.exposure_s.max())
    return _MOST_PER_S * longest_s * colmap_camera(camera).mean_focal_length()


def translating_segments(
    recording: Recording,
    camera: CameraModel,
    parts: Sequence[Sequence[str]],
    limit_px: float,
    progress: Progress,
    motion: GyroCamera | None = None,
) -> list[bool]:
    """In which parts of a recording frames are blurred by more than a limit, by what moves from frame to frame.

    Parameters
    ----------
    recording
        Pixels are followed to the next frame of the video, where frames were chosen from one.
    camera
        Intrinsics; a guess serves without a gyroscope.
    parts
        Names of frames, in order of time.
    limit_px
        Blur that counts, px of the picture as it is.
    progress
        Called with ``"motion"``.
    motion
        Takes the camera's turning out; without it, all that moves counts.
    """
    timing, every = recording.timing, recording.every
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
            and every.t_s[place[name] + 1] - every.t_s[place[name]] <= _APART_S
            and _MOST_PER_S * exposure_s[name] * focal_px >= limit_px
        ]
        some = np.unique(np.linspace(0, len(near) - 1, min(len(near), _PAIRS)).astype(np.intp))
        chosen.append([near[i] for i in some])
    firsts = {name for names in chosen for name in names}
    if not firsts:
        return [False] * len(parts)
    indices = sorted({place[name] + k for name in firsts for k in (0, 1)})
    frames = counted(some_frames(recording.capture, every, indices), len(indices), "motion", progress)
    projector = colmap_camera(camera)
    with one_blas_thread():
        blur_px = {
            pair.name: exposure_s[pair.name] * pair.speed_px_s(projector, motion)
            for pair in follow_pairs(frames, every, firsts)
        }
    return [sum(blur_px.get(name, 0.0) >= limit_px for name in names) >= _ENOUGH for names in chosen]
