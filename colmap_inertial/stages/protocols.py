"""What a stage of each kind takes and gives: the three hooks of a reconstruction."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from colmap_inertial.model import Model
from colmap_inertial.types import Array, Frame


class FrameStage(Protocol):
    """Between decoding and feature extraction: changes pixels or the camera, or drops frames; keeps names."""

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Take frames in order of time and yield those that COLMAP shall see, in the same order."""
        ...


class KeypointStage(Protocol):
    """Between extraction and matching: changes keypoint coordinates, never their number or order."""

    def __call__(self, name: str, keypoints_px: Array, /) -> Array:
        """Return the (N, 2) coordinates that COLMAP shall use, COLMAP's pixel origin."""
        ...


class ModelStage(Protocol):
    """Between mapping and the final write: takes a model of ours and returns the one to go on with."""

    def __call__(self, model: Model, /) -> Model:
        """Return a model whose ``folder`` is the given one, rewritten, or a new one beside it."""
        ...
