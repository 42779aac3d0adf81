"""Constant parts of the viewer, drawn once; and the shapes that come and go."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, UInt8Array
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.tools.view import panel
from colmap_inertial.tools.view.clouds import Mesh
from colmap_inertial.tools.view.measure import length_text
from colmap_inertial.tools.view.scene import Ground, Scene
from colmap_inertial.tools.view.sources import TargetFacts

if TYPE_CHECKING:
    import viser

BLUE, RED, AMBER, GREEN = (70, 130, 230), (230, 40, 30), (240, 170, 30), (30, 190, 90)


class Drawing:
    """A scene as viser draws it.

    Attributes
    ----------
    parts
        Handles by the name of the switch that shows and hides them.
    cloud
        The points' handle.
    camera_size
        Length of a drawn camera, in units of the scene.
    """

    def __init__(self, scene: Scene, api: viser.SceneApi) -> None:
        self.scene, self._api = scene, api
        self.camera_size = 0.05 * scene.reach
        self.parts: dict[str, list[Any]] = {}
        self._draw()

    def _draw(self) -> None:
        """Everything that does not change; what belongs to one switch of the panel goes by one name."""
        scene = self.scene
        self.cloud = self.points("/points", scene.cloud.xyz, scene.cloud.rgb, self.point_size(), point_shading="flat")
        self.parts["Points"] = [self.cloud]
        if scene.mesh is not None:
            self.parts["Mesh"] = [self._add_mesh(scene.mesh)]
        self.parts["Cameras"] = self._add_cameras()
        if len(scene.path):
            line = self.lines("/path", scene.path, path_colours(scene.path_percent), 2.0)
            self.parts["Path"] = [line]
        if scene.ground is not None:
            self.parts["Ground"] = self._add_ground(scene.ground)
        else:
            self.label("/no_scale", "units of the model, no scale", scene.centre - scene.reach * scene.up_in_world)
        if scene.gravity_known:
            self.parts["Gravity"] = self._add_gravity()
        if scene.target is not None and scene.target.corners:
            self.parts["Target"] = self._add_target(scene.target)

    def point_size(self) -> float:
        """So that points cover a part of the area they lie in."""
        return self.scene.reach * min(0.75 / max(len(self.scene.cloud.xyz), 1) ** 0.5, 1 / 150)

    def _add_mesh(self, mesh: Mesh) -> Any:
        if mesh.rgb is None:
            grey, add = (170, 170, 170), self._api.add_mesh_simple
            return add("/mesh", mesh.vertices, mesh.faces, color=grey, side="double", visible=False)
        import trimesh

        coloured = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.rgb, process=False)
        return self._api.add_mesh_trimesh("/mesh", coloured, visible=False)

    def _add_cameras(self) -> list[Any]:
        """All cameras as instances of one pyramid, in one piece for the graphics card however many there are."""
        cameras = self.scene.cameras
        tip_and_base = np.array([[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=np.float32)
        faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], dtype=np.uint32)
        half_height = np.tan(0.5 * cameras.vertical_fov_rad)
        scales = self.camera_size * np.stack([half_height * cameras.aspect, half_height, np.ones(len(cameras))], axis=1)
        bodies = self._api.add_batched_meshes_simple(
            "/cameras/bodies",
            tip_and_base,
            faces,
            batched_wxyzs=_wxyz(cameras.world_from_cam_xyzw),
            batched_positions=cameras.cam_in_world,
            batched_scales=scales,
            batched_colors=BLUE,
            opacity=0.25,
            side="double",
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        corners = scales[:, None, :] * tip_and_base
        world = cameras.cam_in_world[:, None, :] + quat_rotate(cameras.world_from_cam_xyzw[:, None, :], corners)
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
        lines = self.lines("/cameras/edges", world[:, edges].reshape(-1, 2, 3), BLUE, 1.2)
        return [bodies, lines]

    def _add_ground(self, ground: Ground) -> list[Any]:
        up = self.scene.up_in_world
        places = np.linspace(-0.5, 0.5, ground.cells + 1) * ground.side_m
        half = 0.5 * ground.side_m
        lines = [
            [ground.origin + place * v - half * w, ground.origin + place * v + half * w]
            for v, w in ((ground.along, ground.across), (ground.across, ground.along))
            for place in places
        ]
        grid = self.lines("/ground/grid", np.array(lines), (85, 90, 100), 1.0)
        a, b = ground.bar
        beside = np.cross(up, b - a) / ground.bar_m * 0.03 * self.scene.reach
        strokes = np.array([[a, b], [a - beside, a + beside], [b - beside, b + beside]])
        bar = self.lines("/ground/bar", strokes, (255, 255, 255), 4.0)
        text, middle = length_text(ground.bar_m), 0.5 * (a + b)
        return [grid, bar, self.label("/ground/bar_length", text, middle, anchor="top-center", size=1.3)]

    def _add_gravity(self) -> list[Any]:
        scene, add = self.scene, self._api
        up, length = scene.up_in_world, 0.35 * scene.reach
        if scene.ground is not None:
            ground = scene.ground
            half_m = 0.5 * ground.side_m
            sides = ((s, t) for s in (-1, 1) for t in (-1, 1))
            corners = [ground.origin + half_m * (s * ground.along + t * ground.across) for s, t in sides]
            # the corner farthest from the scale bar, where it hides nothing
            foot = max(corners, key=lambda corner: float(np.linalg.norm(corner - ground.bar.mean(axis=0))))
        else:
            foot = scene.centre - scene.reach * up
        middle = foot + length * up
        shapes = {"shaft_radius": 0.02 * length, "head_radius": 0.08 * length, "head_length": 0.28 * length}
        down_arrow = add.add_arrows("/gravity/down", np.array([[middle, foot]]), RED, **shapes)
        up_arrow = add.add_arrows("/gravity/up", np.array([[middle, middle + length * up]]), GREEN, **shapes)
        labels = [
            self.label("/gravity/name", "gravity", foot, anchor="top-center"),
            self.label("/gravity/up_name", "up", middle + length * up, anchor="bottom-center"),
        ]
        return [down_arrow, up_arrow, *labels]

    def _add_target(self, target: TargetFacts) -> list[Any]:
        scene = self.scene
        corners = np.array(list(target.corners.values()))
        spacing = max((float(np.linalg.norm(b - a)) for a, b in scene.target_lines[:1]), default=0.0)
        size = 0.2 * spacing or 0.01 * scene.reach
        drawn: list[Any] = [self.points("/target/corners", corners, GREEN, size, point_shading="flat")]
        if len(scene.target_lines):
            drawn.append(self.lines("/target/lines", scene.target_lines, GREEN, 1.0))
        for i, distance in enumerate(scene.labelled):
            ends = np.array([target.corners[name] for name in distance.pair])
            drawn.append(self.lines(f"/target/known/{i}", ends[None], (255, 255, 255), 2.0))
            # as large as the target, not as the screen: from afar they would hide it
            label = self._api.add_label(
                f"/target/known/{i}/label",
                panel.distance_label(distance),
                position=ends.mean(axis=0),
                anchor="center-center",
                font_size_mode="scene",
                font_scene_height=0.25 * spacing,
            )
            drawn.append(label)
        return drawn

    def points(self, name: str, xyz: AnyArray, colours: Any, size: float, **more: Any) -> Any:
        """Add points (N, 3) of one or (N, 3) colours, so large in the scene's units."""
        return self._api.add_point_cloud(
            name, xyz, colours, point_size=size, point_shape="circle", precision="float32", **more
        )

    def lines(self, name: str, pieces: Array, colour: tuple[int, int, int] | UInt8Array, width_px: float) -> Any:
        """Add straight lines (N, 2, 3), as wide on the screen from everywhere; of one colour, or of their ends'."""
        return self._api.add_line_segments(name, pieces, colour, thickness=width_px, thickness_units="screen")

    def label(self, name: str, text: str, position: Array, *, anchor: Any = "center-center", size: float = 1.0) -> Any:
        """Add a text, as large on the screen from everywhere."""
        return self._api.add_label(name, text, position=position, anchor=anchor, font_screen_scale=size)

    def frustum(self, name: str, camera: int, image: UInt8Array | None, *, through: bool = False) -> Any:
        """Add a camera with its image; larger than the others, so that it is seen; one looks ``through`` its image."""
        cameras = self.scene.cameras
        half_height, aspect = np.tan(0.5 * cameras.vertical_fov_rad[camera]), float(cameras.aspect[camera])
        if image is not None and through:
            # half transparent: points show whether they are where the image has them
            alpha = np.full((*image.shape[:2], 1), round(255 * 0.55), np.uint8)
            image = np.concatenate([image, alpha], axis=2)
        return self._api.add_camera_frustum(
            name,
            fov=float(cameras.vertical_fov_rad[camera]),
            aspect=aspect,
            # viser draws every frustum with the volume scale^3; we want the depth of the others
            scale=self.camera_size * (1.5 if through else 2.2) * float(np.cbrt(half_height**2 * aspect / 3)),
            thickness=2.0,
            thickness_units="screen",
            color=AMBER if through else BLUE,
            image=image,
            wxyz=_wxyz(cameras.world_from_cam_xyzw[camera]),
            position=cameras.cam_in_world[camera],
            cast_shadow=False,
            receive_shadow=False,
        )


def path_colours(percent: Array | None) -> tuple[int, int, int] | UInt8Array:
    """Colours of a path: amber; red where it was stretched and blue where it was shortened, (S, 2, 3)."""
    if percent is None:
        return AMBER
    share = percent / max(float(np.abs(percent).max(initial=0.0)), 1e-9)
    towards = np.where(share[..., None] > 0, RED, BLUE)
    colours: UInt8Array = np.rint(AMBER + np.abs(share[..., None]) * (towards - AMBER)).astype(np.uint8)
    return colours


def _wxyz(xyzw: Array) -> Array:
    return np.roll(xyzw, 1, axis=-1)
