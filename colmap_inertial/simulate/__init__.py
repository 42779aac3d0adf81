"""A world in which the truth is known: handheld motion, an IMU, and the reconstruction that would come of it.

:func:`simulate_recording` makes poses and IMU samples without rendering, for Monte-Carlo studies.
"""

from colmap_inertial.simulate.imu import IMU_PRESETS, ImuErrors, ImuOptions, draw_imu_errors, sample_imu
from colmap_inertial.simulate.motion import Kinematics, Motion, MotionOptions, make_motion
from colmap_inertial.simulate.recording import (
    RecordingOptions,
    RecordingTruth,
    SfmOptions,
    SimulatedRecording,
    simulate_recording,
)

__all__ = [
    "IMU_PRESETS",
    "ImuErrors",
    "ImuOptions",
    "Kinematics",
    "Motion",
    "MotionOptions",
    "RecordingOptions",
    "RecordingTruth",
    "SfmOptions",
    "SimulatedRecording",
    "draw_imu_errors",
    "make_motion",
    "sample_imu",
    "simulate_recording",
]
