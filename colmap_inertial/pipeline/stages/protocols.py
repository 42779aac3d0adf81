"""What a stage of each kind takes and gives: the three hooks of a reconstruction.

Our own stages come in by the same doors. What a stage did travels with the data (``treatments``), and results are made
from that alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from types import EllipsisType
from typing import Protocol, TypeVar, runtime_checkable

from colmap_inertial.core.types import Frame, Gap, Keypoints
from colmap_inertial.model import Model

Stage = TypeVar("Stage")


class FrameStage(Protocol):
    """Between decoding and feature extraction: changes pixels or the camera, or drops frames; keeps names."""

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Take frames in order of time and yield them in the same order; see ``Frame.dropped``."""
        ...


class KeypointStage(Protocol):
    """Between extraction and matching: changes keypoint coordinates, never their number or order."""

    def __call__(self, keypoints: Keypoints, /) -> Keypoints:
        """Return the keypoints of one image that COLMAP shall use."""
        ...


class ModelStage(Protocol):
    """Between mapping and the final write: takes a model and returns the one to go on with."""

    def __call__(self, model: Model, /) -> Model:
        """Return the model, or another one made from it."""
        ...


@runtime_checkable
class JoiningStage(Protocol):
    """A model stage that takes all models of a run at once."""

    def join_models(self, models: Sequence[Model], /) -> tuple[tuple[Model, ...], tuple[Gap, ...]]:
        """Return the models to go on with, and what lies between those that came, the largest first."""
        ...


def with_defaults(stages: Sequence[Stage | EllipsisType], defaults: Iterable[Stage]) -> list[Stage]:
    """A list of stages with the defaults where ``...`` stands.

    Raises
    ------
    ValueError
        Where ``...`` stands twice.
    """
    if sum(stage is ... for stage in stages) > 1:
        raise ValueError("the default stages (...) can stand in a list of stages once")
    found: list[Stage] = []
    for stage in stages:
        if isinstance(stage, EllipsisType):
            found += defaults
        else:
            found.append(stage)
    return found
