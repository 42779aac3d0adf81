"""Some frames of a capture, before any is treated: chosen by their times, and followed by their pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import FlowOptions, GreyFrame, VisualRotation, measure_rotation
from colmap_inertial.run.preparation.frame_reading import FOLLOWED, GreyFrames


@dataclass(frozen=True, kw_only=True)
class SampleLimits:
    """Limits for sampling frames of a recording before the reconstruction."""

    #: Where a quick look at a video begins at the latest: all before it is decoded, too.
    begin_s: float = 5.0


_LIMITS = SampleLimits()


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


def names_at(timing: FrameTiming, indices: Iterable[int]) -> list[str]:
    """Names of some frames."""
    return [timing.names[i] for i in indices]


def show_frames(frames: Iterable[GreyFrame], look: Callable[[GreyFrame], None]) -> Iterator[GreyFrame]:
    """The same frames, each shown to ``look`` first."""
    for frame in frames:
        look(frame)
        yield frame


def measure_sampled_rotation(
    frames: GreyFrames,
    camera: CameraModel,
    indices: Sequence[int],
    progress: Progress,
    *,
    stage: str = "motion",
    look: Callable[[GreyFrame], None] | None = None,
) -> VisualRotation:
    """The rotation between some frames, by their pixels; progress under the name of ``stage``.

    Each frame is shown to ``look``.
    """
    timing = frames.timing
    seen = report_each(frames.look(FOLLOWED, names_at(timing, indices)), len(indices), stage, progress)
    if look is not None:
        seen = show_frames(seen, look)
    with one_blas_thread():
        return measure_rotation(seen, colmap_camera(camera), timing, FlowOptions())
