"""The values that move through the package: frozen, checked when built, numpy only.

Conventions. Times are seconds on the clock that the name says, counted from the value's ``epoch_ns`` (so that
nanosecond stamps of the size 1e18 keep their precision). Transforms are ``target_from_source``, quaternions xyzw.
IMU frame: whatever the reader delivers, right-handed, the same for gyroscope and accelerometer. Accelerations are
specific force: at rest the accelerometer reads +9.8 m/s2 away from the ground.
"""

from __future__ import annotations

from colmap_inertial.core.types.consensus import RotationConsensus, Seam, WrongCamera
from colmap_inertial.core.types.estimated import (
    DOWN_IN_WORLD,
    AcceptedScale,
    CameraMotion,
    Gap,
    JoinedPart,
    ScaleDrift,
    ScaleEstimate,
    Similarity,
    SmoothedTrajectory,
    SolvedMotion,
)
from colmap_inertial.core.types.evidence import Verdict
from colmap_inertial.core.types.imu import (
    CAL,
    CALIBRATION_PARAMETERS,
    IMU_CAL,
    IMU_CALIBRATION_PARAMETERS,
    JOINT_GYRO_WALK_RAD_S_RTS,
    TYPICAL_NOISE,
    CameraImuCalibration,
    ImuCalibration,
    ImuNoise,
    ImuRecording,
    ImuSource,
)
from colmap_inertial.core.types.recorded import (
    Action,
    Aperture,
    ApertureRig,
    CameraModel,
    CameraTrajectory,
    Frame,
    FrameLog,
    FrameTiming,
    HeightDatum,
    Keypoints,
    LengthUnit,
    PositionFixes,
    Projector,
    ReadoutDirection,
    SpectralRole,
    Treatment,
)

__all__ = [
    "Action",
    "CAL",
    "CALIBRATION_PARAMETERS",
    "DOWN_IN_WORLD",
    "IMU_CAL",
    "IMU_CALIBRATION_PARAMETERS",
    "JOINT_GYRO_WALK_RAD_S_RTS",
    "TYPICAL_NOISE",
    "AcceptedScale",
    "Aperture",
    "ApertureRig",
    "CameraImuCalibration",
    "CameraModel",
    "CameraMotion",
    "CameraTrajectory",
    "Frame",
    "FrameLog",
    "FrameTiming",
    "Gap",
    "HeightDatum",
    "ImuCalibration",
    "ImuNoise",
    "ImuRecording",
    "ImuSource",
    "JoinedPart",
    "Keypoints",
    "LengthUnit",
    "PositionFixes",
    "Projector",
    "ReadoutDirection",
    "RotationConsensus",
    "ScaleDrift",
    "ScaleEstimate",
    "Seam",
    "Similarity",
    "SmoothedTrajectory",
    "SolvedMotion",
    "SpectralRole",
    "Treatment",
    "Verdict",
    "WrongCamera",
]
