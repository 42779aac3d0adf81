"""The viewer: a scene in the browser, by viser (https://viser.studio, Apache-2.0)."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import MissingExtraError, OutputError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.report.series import stride_indices
from colmap_inertial.tools.view import panel
from colmap_inertial.tools.view.drawing import RED, Drawing
from colmap_inertial.tools.view.guard import Guard, guarding
from colmap_inertial.tools.view.images import read_preview
from colmap_inertial.tools.view.measure import ball_at_ray, measure_distance, nearest_to_ray
from colmap_inertial.tools.view.scene import LIMITS as SCENE_LIMITS, Scene

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True, kw_only=True)
class ViewerLimits:
    """Sizes and numbers of what the viewer sends."""

    thumbnails: int = 24
    """Cameras that carry their image at the same time."""
    thumbnail_px: int = 160
    """Width of these images."""
    panel_px: int = 640
    """Width of the image in the panel."""
    ports: int = 50
    """That are tried from the first one on."""


LIMITS = ViewerLimits()


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
        self._guard = Guard(host=host)
        self._server = _start_server(self._guard, port, f"colmap-inertial: {scene.out.absolute().name}")
        self._lock = threading.RLock()
        self._picked: list[Array] = []
        #: Handles that are removed again: the chosen camera, thumbnails, the measured line.
        self._temporary: dict[str, list[Any]] = {"chosen": [], "thumbnails": [], "measure": []}
        self._image_of = functools.lru_cache(maxsize=64)(self._read_image)
        self._candidates = scene.pickable()
        self._set_stage()
        self._drawing = Drawing(scene, self._server.scene)
        self._build_panel()

    @property
    def url(self) -> str:
        """Address for a browser; whoever knows it sees the scene."""
        host = self._server.get_host()
        host = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        return f"http://{host}:{self._server.get_port()}/{self._guard.token}"

    def close(self) -> None:
        """Stop listening."""
        with contextlib.redirect_stdout(io.StringIO()):  # it says so itself
            self._server.stop()

    def _set_stage(self) -> None:
        scene, server = self.scene, self._server
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(scene.up_in_world)
        server.scene.configure_default_lights(cast_shadow=False)
        if scene.mesh is None:  # what lights meshes evenly takes weak graphics cards many seconds to prepare
            server.scene.configure_environment_map(None)
            server.scene.add_light_ambient("/light", intensity=1.5)
        camera = server.initial_camera
        camera.fov, camera.near, camera.far = SCENE_LIMITS.start_fov_rad, 2e-3 * scene.reach, 300 * scene.reach
        camera.up, camera.look_at, camera.position = scene.up_in_world, scene.centre, scene.start

    def _build_panel(self) -> None:
        scene, gui = self.scene, self._server.gui
        gui.add_html(panel.verdict_html(scene))
        gui.add_markdown(panel.scale_text(scene))
        gui.add_markdown(panel.contents_text(scene))
        overview = gui.add_button("Overview", icon="home")
        overview.on_click(lambda event: self._look_at_everything(event.client))
        with gui.add_folder("Distance"):
            self._measuring = gui.add_checkbox("Measure", False, hint="Click two points in the scene.")
            self._measured = gui.add_markdown("")
            clear = gui.add_button("Clear")
        self._measuring.on_update(lambda _: self._switch_measuring())
        clear.on_click(lambda _: self._clear())
        with gui.add_folder("Show"):
            for name, drawn in self._drawing.parts.items():
                self._add_switch(name, drawn)
            thumbnails = gui.add_checkbox("Images", False, hint=f"On {LIMITS.thumbnails} cameras.")
            thumbnails.on_update(lambda event: self._show_thumbnails(bool(event.target.value)))
            size = gui.add_slider("Point size", 0.2, 5.0, 0.1, 1.0)
            if scene.ground is not None:
                gui.add_markdown(panel.ground_text(scene))
        size.on_update(lambda _: setattr(self._drawing.cloud, "point_size", self._drawing.point_size() * size.value))
        with gui.add_folder("Camera"):
            self._slider = gui.add_slider("Number", 0, max(len(scene.cameras) - 1, 1), 1, 0)
            self._about = gui.add_markdown("Click a camera, or move the slider.")
            self._image = gui.add_image(np.zeros((3, 4, 3), np.uint8), visible=False, format="jpeg")
        self._slider.on_update(self._slide)
        self._server.scene.on_click()(self._click)
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
            self._choose(min(max(int(self._slider.value), 0), len(self.scene.cameras) - 1), event.client)

    def _look_at_everything(self, client: viser.ClientHandle | None) -> None:
        scene = self.scene
        if client is None:
            return
        _aim(client, scene.start, scene.centre, scene.up_in_world)
        with self._lock:
            self._remove("chosen")

    def _look_at_target(self, client: viser.ClientHandle | None) -> None:
        target = self.scene.target
        if client is None or target is None:
            return
        corners = np.array(list(target.corners.values()))
        middle = corners.mean(axis=0)
        size = float(np.linalg.norm(corners - middle, axis=1).max())
        # from the side from which the cameras saw it
        towards = self.scene.cameras.cam_in_world.mean(axis=0) - middle
        _aim(client, middle + 3.5 * size * towards / np.linalg.norm(towards), middle, self.scene.up_in_world)

    def _choose(self, camera: int, client: viser.ClientHandle) -> None:
        """Show a camera's image, and look through it."""
        cameras = self.scene.cameras
        with self._lock:
            self._remove("chosen")
            image, problem = self._image_of(camera, LIMITS.panel_px)
            self._about.content = panel.camera_text(self.scene, camera, problem)
            self._image.visible = image is not None
            if image is not None:
                self._image.image = image
            if int(self._slider.value) != camera:
                self._slider.value = camera
            self._temporary["chosen"].append(self._drawing.frustum("/chosen", camera, image, through=True))
        rotation = cameras.world_from_cam_xyzw[camera]
        fov, aspect = float(cameras.vertical_fov_rad[camera]), float(cameras.aspect[camera])
        # the whole image fits, with a margin
        height = np.tan(0.5 * fov) * max(1.0, aspect / client.camera.aspect)
        ahead = quat_rotate(rotation, np.array([0.0, 0.0, 1.0]))
        centre = cameras.cam_in_world[camera]
        up = quat_rotate(rotation, np.array([0.0, -1.0, 0.0]))
        _aim(client, centre, centre + 0.5 * self.scene.reach * ahead, up, fov_rad=float(2 * np.arctan(1.15 * height)))

    def _remove(self, group: str) -> None:
        for handle in self._temporary[group]:
            handle.remove()
        self._temporary[group].clear()

    def _show_thumbnails(self, shown: bool) -> None:
        with self._lock:
            self._remove("thumbnails")
            if not shown:
                return
            for camera in stride_indices(len(self.scene.cameras), LIMITS.thumbnails).tolist():
                image, _ = self._image_of(camera, LIMITS.thumbnail_px)
                if image is not None:
                    self._temporary["thumbnails"].append(self._drawing.frustum(f"/thumbnails/{camera}", camera, image))

    def _read_image(self, camera: int, width_px: int) -> tuple[UInt8Array | None, str]:
        return read_preview(self.scene.image_of(camera), width_px)

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
        if not self._drawing.parts["Cameras"][0].visible:
            return
        ahead = quat_rotate(self.scene.cameras.world_from_cam_xyzw, np.array([0.0, 0.0, 1.0]))
        middles = self.scene.cameras.cam_in_world + 0.6 * self._drawing.camera_size * ahead
        camera = ball_at_ray(middles, 0.6 * self._drawing.camera_size, *ray)
        if camera is not None:
            self._choose(camera, event.client)

    def _pick(self, index: int | None) -> None:
        with self._lock:
            if len(self._picked) == 2:
                self._clear()
            if index is None:
                self._measured.content = "No point there; click closer to one."
                return
            self._picked.append(self._candidates[index])
            points = np.array(self._picked)
            ends = self._drawing.points("/measure/ends", points, RED, 0.012 * self.scene.reach)
            if len(points) == 1:
                self._temporary["measure"].append(ends)
                self._measured.content = "Click the second point."
                return
            result = measure_distance(points[0], points[1], self.scene.scale.unit, self.scene.scale.relative_ci95)
            line = self._drawing.lines("/measure/line", points[None], RED, 3.0)
            label = self._drawing.label("/measure/label", result.text, points.mean(axis=0), size=1.2)
            self._temporary["measure"] = [ends, line, label]
            self._measured.content = panel.describe_distance(result)

    def _clear(self) -> None:
        with self._lock:
            self._picked.clear()
            self._remove("measure")
            self._measured.content = "Click the first point." if self._measuring.value else ""


def _aim(
    client: viser.ClientHandle, position: Array, at: Array, up: Array, *, fov_rad: float = SCENE_LIMITS.start_fov_rad
) -> None:
    """Let somebody look from a position at a point."""
    with client.atomic():
        client.camera.fov = fov_rad
        client.camera.up_direction = up
        client.camera.position = position
        client.camera.look_at = at


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
        raise MissingExtraError("view", Fact("needs-viser"))


def _start_server(guard: Guard, port: int, label: str) -> viser.ViserServer:
    require_viser()
    import viser

    port = _free_port(guard.host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of its own
        server = None
        try:
            with guarding(guard):
                server = viser.ViserServer(host=guard.host, port=port, label=label, verbose=False)
        except OutputError:
            if server is not None:
                server.stop()
            raise
    # viser lets any page that is connected ask for a tunnel to the internet
    server.request_share_url = lambda verbose=True: None
    return server


def _free_port(host: str, port: int) -> int:
    """The first port from ``port`` on that is free; viser would look for one without end, or wait for it forever."""
    try:
        address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        for candidate in range(port, min(port + LIMITS.ports, 65536)):
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
        raise OutputError(Fact("port-unusable", host=host, port=port, detail=str(error))) from error
    raise OutputError(Fact("no-port-free", port=port, host=host))
