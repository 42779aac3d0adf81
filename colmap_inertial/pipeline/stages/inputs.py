"""What the default stages of a run are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.pipeline.run.context import Recording
from colmap_inertial.pipeline.stages.fusers import Fuser
from colmap_inertial.pipeline.stages.imaging_plan import ImagingPlan
from colmap_inertial.pipeline.stages.protocols import KeypointStage


@dataclass(frozen=True, eq=False, kw_only=True)
class StageInputs:
    """What the default stages of a run are made of.

    Attributes
    ----------
    recording
        Capture, IMU, times of the frames, and what is known of the calibration beforehand.
    options
        Of the run.
    plan
        What was decided of frames and keypoints.
    fuser
        What makes one frame of a pair of exposures; ``None`` where none are fused.
    maps
        Feed COLMAP: leave out frames that are too blurred, and show it deblurred ones smoothed.
    apertures
        Folder for disparities and depths of a multi-aperture camera.
    keypoint_stages
        For model stages: what keypoints went through.
    database
        For model stages: COLMAP's, of the models.
    """

    recording: Recording
    options: ReconstructOptions = field(default_factory=ReconstructOptions)
    plan: ImagingPlan = field(default_factory=ImagingPlan)
    fuser: Fuser | None = None
    maps: bool = True
    apertures: Path | None = None
    keypoint_stages: Sequence[KeypointStage] = ()
    database: Path | None = None
