"""Some frames of a capture, before any is treated: chosen by their times, decoded, and followed by their pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    CameraModel,
    Frame,
    FrameTiming,
)
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.images import read_image
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import FlowOptions, VisualRotation, measure_rotation


@dataclass(frozen=True, kw_only=True)
class SampleLimits:
    """Limits for sampling frames of a recording before the reconstruction."""

    #: Where a quick look at a video begins at the latest: all before it is decoded, too.
    begin_s: float = 5.0
    #: COLMAP's guess of a focal length, in longer sides of the image.
    focal_per_side: float = 1.2


_LIMITS = SampleLimits()


def some_frames(capture: Capture, timing: FrameTiming, indices: Sequence[int]) -> Iterator[Frame]:
    """Some frames of a capture, in order of time; of a folder, no other is opened."""
    if not isinstance(capture.frames, ImageFolder):
        yield from read_frames(capture, only=[timing.names[i] for i in indices])[1]
        return
    for i in sorted(indices):
        image = read_image(path_in(capture.frames.folder, timing.names[i]))
        yield Frame(name=timing.names[i], image=image, t_s=float(timing.t_s[i]), camera=capture.camera)


def guess_camera(capture: Capture, timing: FrameTiming) -> CameraModel:
    """The declared intrinsics, or what COLMAP starts from without any."""
    if capture.camera is not None:
        return capture.camera
    height, width = next(some_frames(capture, timing, [0])).image.shape[:2]
    params = (_LIMITS.focal_per_side * max(width, height), width / 2, height / 2)
    return CameraModel(model="SIMPLE_PINHOLE", width=width, height=height, params=params)


def sample_spaced(timing: FrameTiming, spacing_s: float) -> list[int]:
    """Indices of frames from the first one on, not closer together than asked for."""
    kept = [0]
    for i, t_s in enumerate(timing.t_s.tolist()):
        if t_s - timing.t_s[kept[-1]] >= spacing_s:
            kept.append(i)
    return kept


def sample_middle(timing: FrameTiming, spacing_s: float, most: int) -> list[int]:
    """Indices of frames from the middle of a recording, not closer together than asked for."""
    kept = sample_spaced(timing, spacing_s)
    first = max(0, (len(kept) - most) // 2)
    return kept[first : first + most]


def sample_beginning(timing: FrameTiming, spacing_s: float, most: int) -> list[int]:
    """Indices of frames of a video about so far apart, which begin a few seconds in at the latest."""
    usual_s = float(np.median(np.diff(timing.t_s))) if len(timing.t_s) > 1 else 0.0
    kept = sample_spaced(timing, spacing_s - 0.25 * usual_s)
    early = int(np.searchsorted(timing.t_s[kept], timing.t_s[0] + _LIMITS.begin_s))
    first = min(max(0, (len(kept) - most) // 2), early)
    return kept[first : first + most]


def show_frames(frames: Iterable[Frame], look: Callable[[Frame], None]) -> Iterator[Frame]:
    """The same frames, each shown to ``look`` first."""
    for frame in frames:
        look(frame)
        yield frame


def measure_sampled_rotation(
    capture: Capture,
    timing: FrameTiming,
    camera: CameraModel,
    indices: Sequence[int],
    progress: Progress,
    *,
    stage: str = "motion",
    look: Callable[[Frame], None] | None = None,
) -> VisualRotation:
    """The rotation between some frames, by their pixels; progress under the name of ``stage``.

    Each frame is shown to ``look``.
    """
    frames = report_each(some_frames(capture, timing, indices), len(indices), stage, progress)
    if look is not None:
        frames = show_frames(frames, look)
    with one_blas_thread():
        return measure_rotation(frames, colmap_camera(camera), timing, FlowOptions())
