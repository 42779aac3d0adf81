"""The default stages: one table for each kind. A stage says by itself whether it applies to a run (``for_run``)."""

from __future__ import annotations

from collections.abc import Callable

from colmap_inertial.hooks import FrameStage, KeypointStage, ModelStage, Stage
from colmap_inertial.run.stages.apertures import ApertureStage
from colmap_inertial.run.stages.deblur import DeblurStage
from colmap_inertial.run.stages.exposures import ExposureStage
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.refine import RefineStage
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.run.stages.sensors import SensorStage

_FRAME: tuple[Callable[[StageInputs], FrameStage | None], ...] = (
    ApertureStage.for_run,
    ExposureStage.for_run,
    DeblurStage.for_run,
)
_KEYPOINT: tuple[Callable[[StageInputs], KeypointStage | None], ...] = (RollingShutterStage.for_run,)
_MODEL: tuple[Callable[[StageInputs], ModelStage | None], ...] = (
    ReadoutStage.for_run,
    MetricStage.for_run,
    JoinStage.for_run,
    RefineStage.for_run,
    SensorStage.for_run,
)


def default_frame_stages(inputs: StageInputs) -> list[FrameStage]:
    """Frame stages that replace ``...`` in ``frame_stages``."""
    return _applying(_FRAME, inputs)


def default_keypoint_stages(inputs: StageInputs) -> list[KeypointStage]:
    """Keypoint stages that replace ``...`` in ``keypoint_stages``."""
    return _applying(_KEYPOINT, inputs)


def default_model_stages(inputs: StageInputs) -> list[ModelStage]:
    """Model stages that replace ``...`` in ``model_stages``."""
    return _applying(_MODEL, inputs)


def _applying(makers: tuple[Callable[[StageInputs], Stage | None], ...], inputs: StageInputs) -> list[Stage]:
    return [stage for make in makers if (stage := make(inputs)) is not None]
