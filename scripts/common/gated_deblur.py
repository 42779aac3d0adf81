"""One picture through the safety gate, as ``DeblurStage`` does it with a recording: for benchmarks and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import UInt8Array, UInt16Array
from colmap_inertial.imaging import path_filters
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import GateOptions, RecordingVerdict, judge_frame, keep_sharp

Code = TypeVar("Code", np.uint8, np.uint16)


@dataclass(frozen=True, eq=False, kw_only=True)
class GatedFrame:
    """A frame that went through the gate.

    Attributes
    ----------
    image
        Deblurred, or the very array that came in.
    deblurred
        Whether any pixel was changed on purpose.
    kept_share
        Share of the image that keeps its pixels because it was sharp already.
    extent_factor
        What the predicted extents were multiplied by, to agree with the images.
    reason
        In words.
    """

    image: UInt8Array | UInt16Array
    deblurred: bool
    kept_share: float
    extent_factor: float
    reason: str


def deblur_gated(
    image: NDArray[Code],
    blur: BlurField,
    *,
    recording: RecordingVerdict | None = None,
    deblur: Callable[[NDArray[Code], BlurField], NDArray[Code]] | None = None,
    options: GateOptions | None = None,
) -> GatedFrame:
    """Deblur a frame where the image confirms it, and only there.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), sRGB.
    blur
        Predicted by the gyroscope.
    recording
        What its frames say together (:func:`judge_recording`). Without it, only frames that show the blur clearly by
        themselves are deblurred.
    deblur
        ``path_filters.deblur`` by default.
    options
        Thresholds.
    """
    options = options or GateOptions()
    factor, reason = judge_frame(image, blur, recording, options)
    if factor is None:
        return GatedFrame(image=image, deblurred=False, kept_share=1.0, extent_factor=1.0, reason=reason)
    if factor != 1.0:
        blur = blur.times(factor)
    restored = (deblur or path_filters.deblur)(image, blur)
    out, kept = keep_sharp(image, restored, blur)
    return GatedFrame(image=out, deblurred=True, kept_share=kept, extent_factor=factor, reason=reason)
