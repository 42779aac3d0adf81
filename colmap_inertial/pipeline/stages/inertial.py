"""What the model stages that use the IMU have in common."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from colmap_inertial.core.options import ScaleOptions, WorldAxes
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording, ScaleEstimate
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.model import Model, trajectory_from_model
from colmap_inertial.pipeline.stages.inputs import StageInputs
from colmap_inertial.pipeline.stages.rolling_shutter import for_rectified


@dataclass(frozen=True, eq=False, kw_only=True)
class InertialStage:
    """A model stage that uses the IMU.

    Attributes
    ----------
    imu
        The recording that ran along.
    calibration
        What is known of the camera and the IMU beforehand.
    options
        Of the scale estimate.
    world
        Where gravity points in the metric model.
    """

    imu: ImuRecording
    calibration: CameraImuCalibration | None
    options: ScaleOptions = field(default_factory=ScaleOptions)
    world: WorldAxes = "z-up"

    @staticmethod
    def fields_for(inputs: StageInputs) -> dict[str, Any]:
        """The fields that all of these stages have, for a run."""
        recording, options = inputs.recording, inputs.options
        return {
            "imu": recording.imu,
            "calibration": recording.prior,
            "options": replace(options.scale, max_offset_s=recording.max_offset_s),
            "world": options.world,
        }

    @staticmethod
    def refines_intrinsics(inputs: StageInputs) -> bool:
        """Whether the cameras may change: as asked for, else where the capture declares none."""
        asked = inputs.options.mapping.refine_intrinsics
        return inputs.recording.capture.camera is None if asked is None else asked

    def calibration_of(self, model: Model) -> CameraImuCalibration | None:
        """What is known of the camera that a model was mapped for; rectified keypoints leave it hardly any readout."""
        if model.rectified and self.calibration is not None:
            return for_rectified(self.calibration)
        return self.calibration

    def estimate_scale(self, model: Model) -> tuple[ScaleEstimate, CameraTrajectory, tuple[str, ...]]:
        """The scale of a model, with its poses, and notes on images that have no time."""
        trajectory, notes = trajectory_from_model(model.reconstruction, model.timing)
        calibration = self.calibration_of(model)
        return (
            estimate_scale(trajectory, self.imu, calibration=calibration, options=self.options),
            trajectory,
            tuple(notes),
        )
