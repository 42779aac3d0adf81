"""The viewer: a scene in the browser, by viser (https://viser.studio, Apache-2.0)."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError, MissingExtraError, OutputError
from colmap_inertial.geometry import quat_rotate
from colmap_inertial.types import Array
from colmap_inertial.view import panel
from colmap_inertial.view.measure import ball_at_ray, length_text, measured, nearest_to_ray
from colmap_inertial.view.scene import START_FOV_RAD, Scene

if TYPE_CHECKING:
    import viser

#: Cameras that carry their image at the same time, and widths of images in the panel and on cameras.
_THUMBNAILS, _PANEL_PX, _THUMBNAIL_PX = 24, 640, 160
#: Opacity of the image that one looks through, so that points show whether they are where the image has them.
_THROUGH = 0.55
#: Ports that are tried from the first one on.
_PORTS = 50
_BLUE, _RED, _AMBER, _GREEN = (70, 130, 230), (230, 40, 30), (240, 170, 30), (30, 190, 90)


class Viewer:
    """A scene on a server of its own; :meth:`close` ends it.

    Parameters
    ----------
    scene
        What to show.
    host, port
        Where to listen; a port that is taken makes way for the next free one, and 0 takes any.

    Raises
    ------
    MissingExtraError
        Without viser.
    OutputError
        Where the host's address cannot be listened at.
    """

    def __init__(self, scene: Scene, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.scene = scene
        self._server = _start_server(host, port, f"colmap-inertial: {scene.out.absolute().name}")
        self._lock = threading.RLock()
        self._picked: list[Array] = []
        self._drawn: dict[str, list[Any]] = {}
        #: What comes and goes: the chosen camera, thumbnails, the measured line.
        self._passing: dict[str, list[Any]] = {"chosen": [], "thumbnails": [], "measure": []}
        self._image_of = functools.lru_cache(maxsize=64)(self._read_image)
        #: Size of a drawn camera, in units of the scene.
        self._size = 0.05 * scene.reach
        self._candidates = scene.pickable()
        self._set_stage()
        self._draw()
        self._build_panel()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        host = self._server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '::') else host}:{self._server.get_port()}"

    def close(self) -> None:
        """Stop listening."""
        with contextlib.redirect_stdout(io.StringIO()):  # it says so itself
            self._server.stop()

    def _set_stage(self) -> None:
        scene, server = self.scene, self._server
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(scene.up_in_world)
        camera = server.initial_camera
        camera.fov, camera.near, camera.far = START_FOV_RAD, 2e-3 * scene.reach, 300 * scene.reach
        camera.up, camera.look_at, camera.position = scene.up_in_world, scene.centre, scene.start

    def _draw(self) -> None:
        """Everything that does not change; what belongs to one switch of the panel goes by one name."""
        scene, add = self.scene, self._server.scene
        self._cloud = add.add_point_cloud(
            "/points",
            scene.cloud.xyz,
            scene.cloud.rgb,
            point_size=self._point_size(),
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        self._drawn["Points"] = [self._cloud]
        if scene.mesh is not None:
            self._drawn["Mesh"] = [self._add_mesh()]
        self._drawn["Cameras"] = self._add_cameras()
        if len(scene.path):
            line = add.add_line_segments("/path", scene.path, _AMBER, thickness=2.0, thickness_units="screen")
            self._drawn["Path"] = [line]
        if scene.ground is not None:
            self._drawn["Ground"] = self._add_ground()
        if scene.gravity_known:
            self._drawn["Gravity"] = self._add_gravity()
        if scene.target is not None and scene.target.corners:
            self._drawn["Target"] = self._add_target()

    def _point_size(self) -> float:
        """So that points cover a part of the area they lie in."""
        return float(
            np.clip(0.6 * self.scene.reach / np.sqrt(max(len(self.scene.cloud.xyz), 1)), 0, self.scene.reach / 150)
        )

    def _add_mesh(self) -> Any:
        mesh = self.scene.mesh
        assert mesh is not None
        add = self._server.scene
        if mesh.rgb is None:
            return add.add_mesh_simple(
                "/mesh", mesh.vertices, mesh.faces, color=(170, 170, 170), side="double", visible=False
            )
        import trimesh

        coloured = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.rgb, process=False)
        return add.add_mesh_trimesh("/mesh", coloured, visible=False)

    def _add_cameras(self) -> list[Any]:
        """All cameras as instances of one pyramid, in one piece for the graphics card however many there are."""
        cameras, add = self.scene.cameras, self._server.scene
        tip_and_base = np.array([[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=np.float32)
        faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], dtype=np.uint32)
        half_height = np.tan(0.5 * cameras.vertical_fov_rad)
        scales = self._size * np.stack([half_height * cameras.aspect, half_height, np.ones(len(cameras))], axis=1)
        bodies = add.add_batched_meshes_simple(
            "/cameras/bodies",
            tip_and_base,
            faces,
            batched_wxyzs=_wxyz(cameras.world_from_cam_xyzw),
            batched_positions=cameras.cam_in_world,
            batched_scales=scales,
            batched_colors=_BLUE,
            opacity=0.25,
            side="double",
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        corners = scales[:, None, :] * tip_and_base
        world = cameras.cam_in_world[:, None, :] + quat_rotate(cameras.world_from_cam_xyzw[:, None, :], corners)
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
        lines = add.add_line_segments(
            "/cameras/edges", world[:, edges].reshape(-1, 2, 3), _BLUE, thickness=1.2, thickness_units="screen"
        )
        return [bodies, lines]

    def _add_ground(self) -> list[Any]:
        ground = self.scene.ground
        assert ground is not None
        add, up = self._server.scene, self.scene.up_in_world
        places = np.linspace(-0.5, 0.5, ground.cells + 1) * ground.side_m
        half = 0.5 * ground.side_m
        lines = [
            [ground.origin + place * v - half * w, ground.origin + place * v + half * w]
            for v, w in ((ground.along, ground.across), (ground.across, ground.along))
            for place in places
        ]
        grid = add.add_line_segments(
            "/ground/grid", np.array(lines), (85, 90, 100), thickness=1.0, thickness_units="screen"
        )
        a, b = ground.bar
        beside = np.cross(up, b - a) / ground.bar_m * 0.03 * self.scene.reach
        strokes = np.array([[a, b], [a - beside, a + beside], [b - beside, b + beside]])
        bar = add.add_line_segments("/ground/bar", strokes, (255, 255, 255), thickness=4.0, thickness_units="screen")
        label = self._label(
            "/ground/bar_length", length_text(ground.bar_m), 0.5 * (a + b), anchor="top-center", size=1.3
        )
        return [grid, bar, label]

    def _add_gravity(self) -> list[Any]:
        scene, add = self.scene, self._server.scene
        up, length = scene.up_in_world, 0.35 * scene.reach
        if scene.ground is not None:
            ground = scene.ground
            corners = [
                ground.origin + 0.5 * ground.side_m * (s * ground.along + t * ground.across)
                for s in (-1, 1)
                for t in (-1, 1)
            ]
            # the corner farthest from the scale bar, where it hides nothing
            foot = max(corners, key=lambda corner: float(np.linalg.norm(corner - ground.bar.mean(axis=0))))
        else:
            foot = scene.centre - scene.reach * up
        middle = foot + length * up
        shapes = {"shaft_radius": 0.012 * length, "head_radius": 0.05 * length, "head_length": 0.18 * length}
        shapes = {name: 1.6 * size for name, size in shapes.items()}
        down_arrow = add.add_arrows("/gravity/down", np.array([[middle, foot]]), _RED, **shapes)
        up_arrow = add.add_arrows("/gravity/up", np.array([[middle, middle + length * up]]), _GREEN, **shapes)
        labels = [
            self._label("/gravity/name", "gravity", foot, anchor="top-center"),
            self._label("/gravity/up_name", "up", middle + length * up, anchor="bottom-center"),
        ]
        return [down_arrow, up_arrow, *labels]

    def _add_target(self) -> list[Any]:
        scene, add = self.scene, self._server.scene
        assert scene.target is not None
        corners = np.array(list(scene.target.corners.values()))
        spacing = (
            float(np.linalg.norm(scene.target_lines[0, 1] - scene.target_lines[0, 0])) if len(scene.target_lines) else 0
        )
        size = 0.2 * spacing or 0.01 * scene.reach
        drawn: list[Any] = [
            add.add_point_cloud(
                "/target/corners",
                corners,
                _GREEN,
                point_size=size,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )
        ]
        if len(scene.target_lines):
            drawn.append(
                add.add_line_segments(
                    "/target/lines", scene.target_lines, _GREEN, thickness=1.0, thickness_units="screen"
                )
            )
        for i, distance in enumerate(scene.labelled):
            ends = np.array([scene.target.corners[name] for name in distance.pair])
            drawn.append(
                add.add_line_segments(
                    f"/target/known/{i}", ends[None], (255, 255, 255), thickness=2.0, thickness_units="screen"
                )
            )
            # as large as the target, not as the screen: from afar they would hide it
            label = self._server.scene.add_label(
                f"/target/known/{i}/label",
                panel.distance_label(distance),
                position=ends.mean(axis=0),
                anchor="center-center",
                font_size_mode="scene",
                font_scene_height=0.25 * spacing,
            )
            drawn.append(label)
        return drawn

    def _add_lines(self, name: str, pieces: Array, colour: tuple[int, int, int], width_px: float) -> Any:
        return self._server.scene.add_line_segments(name, pieces, colour, thickness=width_px, thickness_units="screen")

    def _label(self, name: str, text: str, position: Array, *, anchor: Any = "center-center", size: float = 1.0) -> Any:
        return self._server.scene.add_label(name, text, position=position, anchor=anchor, font_screen_scale=size)

    def _build_panel(self) -> None:
        scene, gui = self.scene, self._server.gui
        gui.add_html(panel.verdict_html(scene))
        gui.add_markdown(panel.scale_text(scene))
        gui.add_markdown(panel.contents_text(scene))
        overview = gui.add_button("Overview", icon="home")
        overview.on_click(lambda event: self._look_at_everything(event.client))
        self._server.scene.on_click()(self._click)
        with gui.add_folder("Distance"):
            self._measuring = gui.add_checkbox("Measure", False, hint="Click two points in the scene.")
            self._measured = gui.add_markdown("")
            clear = gui.add_button("Clear")
        self._measuring.on_update(lambda _: self._switch_measuring())
        clear.on_click(lambda _: self._clear())
        with gui.add_folder("Show"):
            for name, drawn in self._drawn.items():
                self._add_switch(name, drawn)
            thumbnails = gui.add_checkbox("Images", False, hint=f"On {_THUMBNAILS} cameras.")
            thumbnails.on_update(lambda event: self._show_thumbnails(bool(event.target.value)))
            size = gui.add_slider("Point size", 0.2, 5.0, 0.1, 1.0)
            if scene.ground is not None:
                gui.add_markdown(panel.ground_text(scene))
        size.on_update(lambda _: setattr(self._cloud, "point_size", self._point_size() * size.value))
        with gui.add_folder("Camera"):
            self._slider = gui.add_slider("Number", 0, max(len(scene.cameras) - 1, 1), 1, 0)
            self._about = gui.add_markdown("Click a camera, or move the slider.")
            self._picture = gui.add_image(np.zeros((3, 4, 3), np.uint8), visible=False, format="jpeg")
        self._slider.on_update(self._slide)
        if scene.target is not None:
            with gui.add_folder("Target"):
                gui.add_html(panel.tolerance_html(scene.target))
                gui.add_markdown(panel.target_text(scene.target))
                if scene.target.corners:
                    closer = gui.add_button("Look at the target")
                    closer.on_click(lambda event: self._look_at_target(event.client))

    def _add_switch(self, name: str, drawn: list[Any]) -> None:
        switch = self._server.gui.add_checkbox(name, bool(drawn[0].visible))

        def show(_: Any) -> None:
            for handle in drawn:
                handle.visible = switch.value

        switch.on_update(show)

    def _slide(self, event: Any) -> None:
        if event.client is not None:  # moved by a user, not by _choose
            self._choose(min(int(self._slider.value), len(self.scene.cameras) - 1), event.client)

    def _look_at_everything(self, client: viser.ClientHandle | None) -> None:
        scene = self.scene
        if client is None:
            return
        with client.atomic():
            client.camera.fov = START_FOV_RAD
            client.camera.up_direction = scene.up_in_world
            client.camera.position = scene.start
            client.camera.look_at = scene.centre
        with self._lock:
            self._remove("chosen")

    def _look_at_target(self, client: viser.ClientHandle | None) -> None:
        target, up = self.scene.target, self.scene.up_in_world
        if client is None or target is None:
            return
        corners = np.array(list(target.corners.values()))
        middle = corners.mean(axis=0)
        size = float(np.linalg.norm(corners - middle, axis=1).max())
        # from the side from which the cameras saw it
        towards = self.scene.cameras.cam_in_world.mean(axis=0) - middle
        with client.atomic():
            client.camera.fov = START_FOV_RAD
            client.camera.up_direction = up
            client.camera.position = middle + 3.5 * size * towards / np.linalg.norm(towards)
            client.camera.look_at = middle

    def _choose(self, camera: int, client: viser.ClientHandle) -> None:
        """Show a camera's image, and look through it."""
        cameras = self.scene.cameras
        with self._lock:
            self._remove("chosen")
            image, problem = self._image_of(camera, _PANEL_PX)
            text = panel.camera_text(self.scene, camera)
            self._about.content = text if image is not None else f"{text}\n\n{problem}"
            self._picture.visible = image is not None
            if image is not None:
                self._picture.image = image
            if int(self._slider.value) != camera:
                self._slider.value = camera
            self._passing["chosen"].append(self._frustum("/chosen", camera, image, through=True))
        rotation = cameras.world_from_cam_xyzw[camera]
        fov, aspect = float(cameras.vertical_fov_rad[camera]), float(cameras.aspect[camera])
        # the whole image fits, with a margin
        height = np.tan(0.5 * fov) * max(1.0, aspect / client.camera.aspect)
        ahead = quat_rotate(rotation, np.array([0.0, 0.0, 1.0]))
        centre = cameras.cam_in_world[camera]
        with client.atomic():
            client.camera.fov = float(2 * np.arctan(1.15 * height))
            client.camera.up_direction = quat_rotate(rotation, np.array([0.0, -1.0, 0.0]))
            client.camera.position = centre
            client.camera.look_at = centre + 0.5 * self.scene.reach * ahead

    def _remove(self, group: str) -> None:
        for handle in self._passing[group]:
            handle.remove()
        self._passing[group].clear()

    def _frustum(self, name: str, camera: int, image: NDArray[np.uint8] | None, *, through: bool = False) -> Any:
        cameras = self.scene.cameras
        half_height, aspect = np.tan(0.5 * cameras.vertical_fov_rad[camera]), float(cameras.aspect[camera])
        if image is not None and through:
            alpha = np.full((*image.shape[:2], 1), round(255 * _THROUGH), np.uint8)
            image = np.concatenate([image, alpha], axis=2)
        return self._server.scene.add_camera_frustum(
            name,
            fov=float(cameras.vertical_fov_rad[camera]),
            aspect=aspect,
            # viser draws every frustum with the volume scale^3; we want the depth of the others
            scale=self._size * (1.5 if through else 1.0) * float(np.cbrt(half_height**2 * aspect / 3)),
            thickness=2.0,
            thickness_units="screen",
            color=_AMBER if through else _BLUE,
            image=image,
            wxyz=_wxyz(cameras.world_from_cam_xyzw[camera]),
            position=cameras.cam_in_world[camera],
            cast_shadow=False,
            receive_shadow=False,
        )

    def _show_thumbnails(self, shown: bool) -> None:
        with self._lock:
            self._remove("thumbnails")
            if not shown:
                return
            count = len(self.scene.cameras)
            for camera in np.unique(np.linspace(0, count - 1, min(count, _THUMBNAILS)).round().astype(int)).tolist():
                image, _ = self._image_of(camera, _THUMBNAIL_PX)
                if image is not None:
                    self._passing["thumbnails"].append(self._frustum(f"/thumbnails/{camera}", camera, image))

    def _read_image(self, camera: int, width_px: int) -> tuple[NDArray[np.uint8] | None, str]:
        """A camera's image, made smaller, or why there is none."""
        import cv2

        from colmap_inertial.io.images import read_image

        path = self.scene.image_of(camera)
        if path is None:
            return None, "Its image is not beside the model."
        try:
            image = read_image(path)
        except FormatError as error:
            return None, f"Its image: {error.reason}"
        shown = np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)
        if shown.ndim == 2:
            shown = np.repeat(shown[:, :, None], 3, axis=2)
        height, width = shown.shape[:2]
        if width > width_px:
            size = (width_px, max(1, round(height * width_px / width)))
            shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return shown, ""

    def _switch_measuring(self) -> None:
        with self._lock:
            if self._measuring.value:
                self._measured.content = "Click the first point."
            elif len(self._picked) < 2:
                self._clear()

    def _click(self, event: viser.SceneClickEvent) -> None:
        """Measures, or chooses the camera that was clicked."""
        ray = np.array(event.ray_origin), np.array(event.ray_direction)
        if self._measuring.value:
            self._pick(nearest_to_ray(self._candidates, *ray))
            return
        if not self._drawn["Cameras"][0].visible:
            return
        ahead = quat_rotate(self.scene.cameras.world_from_cam_xyzw, np.array([0.0, 0.0, 1.0]))
        middles = self.scene.cameras.cam_in_world + 0.6 * self._size * ahead
        camera = ball_at_ray(middles, 0.6 * self._size, *ray)
        if camera is not None:
            self._choose(camera, event.client)

    def _pick(self, found: int | None) -> None:
        with self._lock:
            if len(self._picked) == 2:
                self._clear()
            if found is None:
                self._measured.content = "No point there; click closer to one."
                return
            self._picked.append(self._candidates[found])
            points = np.array(self._picked)
            ends = self._server.scene.add_point_cloud(
                "/measure/ends",
                points,
                _RED,
                point_size=0.012 * self.scene.reach,
                point_shape="circle",
                precision="float32",
            )
            if len(points) == 1:
                self._passing["measure"].append(ends)
                self._measured.content = "Click the second point."
                return
            result = measured(points[0], points[1], self.scene.scale.unit, self.scene.scale.relative_ci95)
            line = self._add_lines("/measure/line", points[None], _RED, 3.0)
            label = self._label("/measure/label", result.text, points.mean(axis=0), size=1.2)
            self._passing["measure"] = [ends, line, label]
            self._measured.content = panel.measured_text(result)

    def _clear(self) -> None:
        with self._lock:
            self._picked.clear()
            self._remove("measure")
            self._measured.content = "Click the first point." if self._measuring.value else ""


def serve(scene: Scene, *, host: str, port: int, ready: Callable[[str], object]) -> None:
    """Show a scene until Ctrl-C.

    Parameters
    ----------
    scene, host, port
        As of :class:`Viewer`.
    ready
        Called with the address to open, once the viewer answers there.
    """
    viewer = Viewer(scene, host=host, port=port)
    try:
        ready(viewer.url)
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()


def require_viser() -> None:
    """Say so early where viser is missing.

    Raises
    ------
    MissingExtraError
    """
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise MissingExtraError("view", "the viewer runs in a browser with viser")


def _start_server(host: str, port: int, label: str) -> viser.ViserServer:
    require_viser()
    import viser

    port = _free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of its own
        return viser.ViserServer(host=host, port=port, label=label, verbose=False)


def _free_port(host: str, port: int) -> int:
    """The first port from ``port`` on that is free; viser would look for one without end, or wait for it forever."""
    try:
        address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        for candidate in range(port, min(port + _PORTS, 65536)):
            with socket.socket(address[0], socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((address[4][0], candidate))
                except OSError as error:
                    if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                        raise
                    continue
                return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise OutputError(f"cannot listen at {host}, port {port}: {error}") from error
    raise OutputError(f"no port from {port} on is free at {host}; choose another with --port")


def _wxyz(xyzw: Array) -> Array:
    return np.roll(xyzw, 1, axis=-1)


__all__ = ["Viewer", "require_viser", "serve"]
