"""Stages by name, where the process that needs them is not the one that chose them."""

from __future__ import annotations

import importlib
import operator
from dataclasses import dataclass
from types import EllipsisType
from typing import Any

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import DEFAULT_STAGES, StageNames
from colmap_inertial.pipeline.stages.protocols import FrameStage, KeypointStage, ModelStage


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
            reason = f"there is no module {missing}; install it where the capture is worked on, or set PYTHONPATH"
        else:
            text = str(error).partition("\n")[0]
            reason = f"{module_name} cannot be imported: {type(error).__name__}: {text}"
        raise InertialError(f"stage {name}: {reason}") from error
    try:
        stage = operator.attrgetter(path)(module)
    except AttributeError:
        raise InertialError(f"stage {name}: {module_name} has no {path}") from None
    if isinstance(stage, type):
        raise InertialError(f"stage {name}: is a class; name an instance of it, or a function")
    if not callable(stage):
        raise InertialError(
            f"stage {name}: is of type {type(stage).__name__}; name a function, or what can be called as one"
        )
    return stage
