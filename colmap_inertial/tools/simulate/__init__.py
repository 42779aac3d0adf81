"""A world in which the truth is known.

:func:`simulate_recording` makes poses and IMU samples without rendering, thousands of seconds in a second, for
Monte-Carlo studies; :func:`simulate_rests` lays a device still in many attitudes. :func:`write_capture` films a
textured world as a :class:`SceneRecipe` says and writes what a user would have recorded, with the truth beside it.
"""

from colmap_inertial.tools.simulate.capture import write_capture
from colmap_inertial.tools.simulate.device import DeviceOptions
from colmap_inertial.tools.simulate.motion import Kinematics, Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.recipe import SceneRecipe, load_recipe, recipe_text
from colmap_inertial.tools.simulate.recording import (
    RecordingOptions,
    RecordingTruth,
    SfmOptions,
    SimulatedRecording,
    simulate_recording,
)
from colmap_inertial.tools.simulate.render import Renderer, ShutterCamera, develop
from colmap_inertial.tools.simulate.rests import RestOptions, SimulatedRests, simulate_rests
from colmap_inertial.tools.simulate.scene import Scene, make_scene
from colmap_inertial.tools.simulate.sensors import IMU_PRESETS, ImuErrors, ImuOptions, draw_imu_errors, sample_imu
from colmap_inertial.tools.simulate.truth import SceneTruth, read_truth, true_metres_per_unit
from colmap_inertial.tools.simulate.world import Board, Quad, World, make_world

__all__ = [
    "IMU_PRESETS",
    "Board",
    "DeviceOptions",
    "ImuErrors",
    "ImuOptions",
    "Kinematics",
    "Motion",
    "MotionOptions",
    "Quad",
    "RecordingOptions",
    "RecordingTruth",
    "Renderer",
    "RestOptions",
    "Scene",
    "SceneRecipe",
    "SceneTruth",
    "SfmOptions",
    "ShutterCamera",
    "SimulatedRecording",
    "SimulatedRests",
    "World",
    "develop",
    "draw_imu_errors",
    "load_recipe",
    "make_motion",
    "make_scene",
    "make_world",
    "read_truth",
    "recipe_text",
    "sample_imu",
    "simulate_recording",
    "simulate_rests",
    "true_metres_per_unit",
    "write_capture",
]
