"""A recipe carried out, but for the images: motion, device, instants of the frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_normalize
from colmap_inertial.io.video import frame_name
from colmap_inertial.tools.simulate.motion import Motion
from colmap_inertial.tools.simulate.recipe import VIDEO_FORMATS, SceneRecipe
from colmap_inertial.tools.simulate.render import Renderer, ShutterCamera
from colmap_inertial.tools.simulate.sensors import SampledImu, simulate_imu
from colmap_inertial.tools.simulate.world import WALLS_M, Board, World, WorldKind, make_world

#: Ticks of a video's clock in a second: 30, 25, 24 frames per second are whole numbers of them.
TICKS_HZ = 90000


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A recipe carried out, but for the images.

    Attributes
    ----------
    motion
        The body's path: poses at any time.
    imu
        The device and its samples.
    trigger_s
        (F,) when the main camera starts exposing each frame's first line, camera clock.
    names
        (F,) file names of the frames.
    """

    recipe: SceneRecipe
    motion: Motion
    imu: SampledImu
    trigger_s: Array
    names: tuple[str, ...]

    def world(self) -> World:
        """The world that is filmed."""
        return self.renderer().world

    def renderer(self) -> Renderer:
        """Renders that world; takes seconds to build, and is kept until one of another world is asked for."""
        return _renderer(self.recipe.world, self.recipe.seed, self.recipe.board)

    def camera_pose(self, camera: ShutterCamera, t_s: Array) -> tuple[Array, Array]:
        """(N, 4) cam_from_world_xyzw and (N, 3) camera centres in metres of a camera of the rig at (N,) times."""
        world_from_body = self.motion.world_from_cam_xyzw(t_s)
        centre = self.motion.cam_in_world_m(t_s) + matrix_from_quat(world_from_body) @ np.array(camera.cam_in_body_m)
        world_from_cam = quat_multiply(world_from_body, np.array(camera.body_from_cam_xyzw))
        return quat_normalize(quat_conjugate(world_from_cam)), centre


def make_scene(recipe: SceneRecipe) -> Scene:
    """Draw the motion, the device and its samples; the camera's clock starts at 0 with the first frame.

    Stray Scanner stamps frames and IMU by one clock.
    """
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(recipe.seed).spawn(2)]
    options = recipe.imu
    if recipe.format == "stray-scanner":
        options = replace(options, clock_offset_s=(0.0, 0.0), clock_rate_sd=0.0)
    motion, imu = simulate_imu(recipe.motion, options, streams, walls_m=WALLS_M[recipe.world])
    count = int(recipe.motion.duration_s * recipe.frame_rate_hz)
    ticks = np.rint(np.arange(count) * (TICKS_HZ / recipe.frame_rate_hz)).astype(np.int64)
    if recipe.format in VIDEO_FORMATS:
        names = tuple(frame_name(int(t), 0) for t in np.rint(ticks * (1e9 / TICKS_HZ)))
    else:
        names = tuple(f"{i:06d}.{'jpg' if recipe.format == 'jpeg' else 'png'}" for i in range(count))
    return Scene(recipe=recipe, motion=motion, imu=imu, trigger_s=ticks / TICKS_HZ, names=names)


@lru_cache(maxsize=1)
def _renderer(world: WorldKind, seed: int, board: Board) -> Renderer:
    return Renderer(make_world(world, seed, board))
