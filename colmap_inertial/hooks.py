"""Arguments and results of each kind of stage: the three hooks of a reconstruction.

Our own stages come in by the same doors. What a stage did travels with the data (``treatments``), and results are made
from that alone.

A stage may have further attributes, by which it says what else it does. A plain function has none of them.

========================================== ============================================================================
``replaces``                               types of default stages that do not run beside it
``move_image(name, image)``                keypoint stage: moves the pixels of an image as it moves its keypoints
``covers(name)``                           keypoint stage: whether it moves anything in an image
``as_exposed(name, xy_px)``                keypoint stage: its inverse, where the shutter had keypoints
``refined(calibration, readout_s, camera)`` keypoint stage: the same with what a refinement made of these
``join_models(models)``                    model stage: takes all models at once (:class:`JoiningStage`)
``changes_images``                         model stage: whether images are made after it, by ``refined`` keypoint stages
========================================== ============================================================================
"""

from __future__ import annotations

import importlib
import operator
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import Any, Protocol, TypeGuard, TypeVar

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import DEFAULT_STAGES, StageNames
from colmap_inertial.core.types import CameraImuCalibration, CameraModel, Frame, Gap, Keypoints
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


class InvertibleStage(KeypointStage, Protocol):
    """A keypoint stage that knows where the shutter had the keypoints that it moved."""

    def as_exposed(self, name: str, xy_px: Array) -> Array:
        """Return (N, 2) pixels of an image as it was exposed, of keypoints as the stage left them."""
        ...


class ModelStage(Protocol):
    """Between mapping and the final write: takes a model and returns the one to continue with."""

    def __call__(self, model: Model, /) -> Model:
        """Return the model, or another one made from it."""
        ...


class JoiningStage(ModelStage, Protocol):
    """A model stage that takes all models of a run at once."""

    def join_models(self, models: Sequence[Model], /) -> tuple[tuple[Model, ...], tuple[Gap, ...]]:
        """Return the models to continue with, and what lies between those that came, the largest first."""
        ...


def insert_defaults(stages: Sequence[Stage | EllipsisType], defaults: Iterable[Stage]) -> list[Stage]:
    """A list of stages with the defaults where ``...`` stands, but those that another stage ``replaces``.

    Raises
    ------
    ValueError
        Where ``...`` stands twice.
    InertialError
        Where two stages join models: the second one would get models that are joined already.
    """
    if sum(stage is ... for stage in stages) > 1:
        raise ValueError("the default stages (...) can stand in a list of stages once")
    replaced = tuple(kind for stage in stages for kind in getattr(stage, "replaces", ()))
    every: list[Stage] = []
    for stage in stages:
        if isinstance(stage, EllipsisType):
            every += [default for default in defaults if type(default) not in replaced]
        else:
            every.append(stage)
    joining = [type(stage).__name__ for stage in every if joins_models(stage)]
    if len(joining) > 1:
        raise InertialError(Fact("two-stages-join", stages=joining[:2]))
    return every


def joins_models(stage: object) -> TypeGuard[JoiningStage]:
    """Whether a stage takes all models at once."""
    return hasattr(stage, "join_models")


def changes_images(stages: Iterable[ModelStage]) -> bool:
    """Whether images can be made only after these stages, because one of them changes the matching images."""
    return any(getattr(stage, "changes_images", False) for stage in stages)


def find_inverse(stages: Sequence[KeypointStage]) -> InvertibleStage | None:
    """The stage that knows where the shutter had all keypoints: the only one, where it can tell."""
    return next((stage for stage in stages if len(stages) == 1 and _is_invertible(stage)), None)


def _is_invertible(stage: object) -> TypeGuard[InvertibleStage]:
    return hasattr(stage, "as_exposed")


def apply_refined_calibration(
    stages: Iterable[KeypointStage], calibration: CameraImuCalibration, readout_s: float, camera: CameraModel
) -> list[KeypointStage]:
    """The keypoint stages with what a refinement found, as far as they take it."""
    return [
        stage if (refined := getattr(stage, "refined", None)) is None else refined(calibration, readout_s, camera)
        for stage in stages
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Stages:
    """The hooks of a reconstruction; ``...`` stands for the default stages.

    Attributes
    ----------
    frame, keypoint, model
        What ``reconstruct`` takes.
    """

    frame: tuple[FrameStage | EllipsisType, ...] = (...,)
    keypoint: tuple[KeypointStage | EllipsisType, ...] = (...,)
    model: tuple[ModelStage | EllipsisType, ...] = (...,)


def load_stages(names: StageNames) -> Stages:
    """Import the stages that are named; this runs the code of their modules.

    Raises
    ------
    InertialError
        Where a module cannot be imported, has no such name, or what it names is no stage.
    """
    return Stages(
        frame=tuple(_load(name) for name in names.frame),
        keypoint=tuple(_load(name) for name in names.keypoint),
        model=tuple(_load(name) for name in names.model),
    )


def _load(name: str) -> Any:
    if name == DEFAULT_STAGES:
        return ...
    module_name, _, path = name.partition(":")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever the code of a stranger's module does
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            why = Fact("module-of-stage-missing", module=missing)
        else:
            text = str(error).partition("\n")[0]
            why = Fact("module-of-stage-failed", module=module_name, detail=f"{type(error).__name__}: {text}")
        raise InertialError(Fact("stage-not-imported", stage=name, why=why)) from error
    try:
        stage = operator.attrgetter(path)(module)
    except AttributeError:
        raise InertialError(Fact("stage-not-in-module", stage=name, module=module_name, name=path)) from None
    if isinstance(stage, type):
        raise InertialError(Fact("stage-is-a-class", stage=name))
    if not callable(stage):
        raise InertialError(Fact("stage-not-callable", stage=name, type=type(stage).__name__))
    return stage
