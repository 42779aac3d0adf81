"""Films the inside of a textured box as a motion of the simulator has it: quick enough for a video in a test."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraModel
from colmap_inertial.tools.simulate import MotionOptions
from colmap_inertial.tools.simulate.recipe import SceneRecipe
from colmap_inertial.tools.simulate.render import ShutterCamera
from colmap_inertial.tools.simulate.scene import Scene, make_scene

WIDTH, HEIGHT, FOCAL = 240, 180, 190.0
#: The box; motions of the simulator stay well inside.
LOW_M, HIGH_M = np.array([-3.0, -3.0, -1.2]), np.array([3.0, 3.0, 2.2])
#: Instants per exposure that are averaged.
_SAMPLES = 6


@dataclass(frozen=True, eq=False)
class BoxVideo:
    """A capture folder with ``clip.mp4``, and the truth."""

    folder: Path
    scene: Scene
    t_s: np.ndarray
    exposure_s: float

    def smear_px(self, index: int) -> float:
        """How far the picture moves while a frame is exposed, by the true poses: mean over the picture."""
        before, after = (_pose(self.scene, self.t_s[index] + s) for s in (0.0, self.exposure_s))
        return float(np.mean(_moved_px(before, after)))

    def parallax(self, first: int, second: int) -> float:
        """How far the picture moves from one frame to another but for the rotation, in shares of its width."""
        before, after = (_pose(self.scene, self.t_s[i] + 0.5 * self.exposure_s) for i in (first, second))
        all_of_it = _moved_px(before, after, keep_rotation=False)
        return float(np.nanmedian(all_of_it)) / WIDTH


def _moved_px(before, after, *, keep_rotation: bool = True) -> np.ndarray:
    """How far a grid of points moves between two poses; without the rotation: against points infinitely far away."""
    x, y = (np.arange(8) + 0.5) * WIDTH / 8, (np.arange(6) + 0.5) * HEIGHT / 6
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.column_stack([(pixels - (WIDTH / 2, HEIGHT / 2)) / FOCAL, np.ones(len(pixels))])
    (rotation, centre), (rotation_after, centre_after) = before, after
    looking = rays @ rotation.T
    seen = (centre + _hit(centre, looking)[0][:, None] * looking - centre_after) @ rotation_after
    if keep_rotation:
        reference = pixels
    else:
        turned = looking @ rotation_after
        reference = FOCAL * turned[:, :2] / turned[:, 2:] + (WIDTH / 2, HEIGHT / 2)
    moved = FOCAL * seen[:, :2] / seen[:, 2:] + (WIDTH / 2, HEIGHT / 2) - reference
    return np.linalg.norm(moved, axis=1)


def _pose(scene: Scene, t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(3, 3) world_from_cam and the centre."""
    at = np.array([t_s])
    return matrix_from_quat(scene.motion.world_from_cam_xyzw(at))[0], scene.motion.cam_in_world_m(at)[0]


def _hit(centre: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along each ray the box's wall is, and which wall (axis, doubled, plus one for the upper)."""
    with np.errstate(divide="ignore"):
        ways = np.where(rays > 0, (HIGH_M - centre) / rays, (LOW_M - centre) / rays)
    axis = np.argmin(ways, axis=-1)
    far = np.take_along_axis(ways, axis[..., None], axis=-1)[..., 0]
    up = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0
    return far, 2 * axis + up


def _atlas(seed: int) -> np.ndarray:
    """Six textures of 512 pixels, one above the other: noise of several sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((6 * 512, 512), np.float32)
    for size in (16, 48, 128, 256):
        total += cv2.resize(rng.normal(size=(6 * size, size)).astype(np.float32), (512, 6 * 512)) / len("four")
    return np.clip(128 + 90 * total, 0, 255).astype(np.float32)


def _picture(atlas: np.ndarray, rotation: np.ndarray, centre: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(H, W) what is seen along (3, H * W) rays; an axis after the other and in single precision, which is quicker."""
    looking = rotation.astype(np.float32) @ rays
    low, high = ((wall - centre).astype(np.float32) for wall in (LOW_M, HIGH_M))
    with np.errstate(divide="ignore"):
        ways = [np.maximum(high[k] / ray, low[k] / ray) for k, ray in enumerate(looking)]
    far = np.minimum(np.minimum(ways[0], ways[1]), ways[2])
    x, y, z = ((far * ray - low[k]) / (high[k] - low[k]) for k, ray in enumerate(looking))
    at_x, at_z = ways[0] == far, ways[2] == far
    u, v = np.where(at_x, y, x), np.where(at_z, y, z)
    up = looking > 0
    wall = np.where(at_x, up[0], np.where(at_z, 4 + up[2], 2 + up[1])).astype(np.float32)
    map_x = (u * 510).reshape(HEIGHT, WIDTH)
    map_y = (wall * 512 + np.clip(v, 0, 1) * 510).reshape(HEIGHT, WIDTH)
    return cv2.remap(atlas, map_x, map_y, cv2.INTER_LINEAR)


def _write_clip(path: Path, scene: Scene, exposure_s: float, cam_from_reference: np.ndarray) -> None:
    """Film what a camera sees that is fixed to the one whose poses the motion has."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)])
    rays = rays.reshape(3, -1).astype(np.float32)
    atlas, frame_rate_hz = _atlas(scene.recipe.seed), scene.recipe.frame_rate_hz
    reference_from_cam = np.linalg.inv(cam_from_reference)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(frame_rate_hz).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "16", "threads": "1"}
        stream.codec_context.time_base = stream.time_base = Fraction(1, 90000)
        for t_s in scene.trigger_s:
            total = np.zeros((HEIGHT, WIDTH), np.float32)
            for k in range(_SAMPLES):
                rotation, centre = _pose(scene, t_s + exposure_s * (k + 0.5) / _SAMPLES)
                place = centre + rotation @ reference_from_cam[:3, 3]
                total += _picture(atlas, rotation @ reference_from_cam[:3, :3], place, rays)
            grey = np.rint(total / _SAMPLES).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, axis=2), format="rgb24")
            frame.pts, frame.time_base = round(t_s * 90000), Fraction(1, 90000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def film_beside(video: BoxVideo, name: str, cam_from_reference: np.ndarray) -> None:
    """Write ``clip_NAME.mp4`` of a second camera that is fixed to the first; (4, 4) in metres."""
    _write_clip(video.folder / f"clip_{name}.mp4", video.scene, video.exposure_s, cam_from_reference)


def film(
    folder: Path,
    motion: MotionOptions,
    *,
    exposure_s: float = 0.016,
    exposure_known: bool = True,
    frame_rate_hz: float = 30.0,
    seed: int = 1,
) -> BoxVideo:
    """Write a capture: ``clip.mp4``, IMU, ``capture.toml``. The clocks are minutes apart; the camera is declared."""
    model = CameraModel(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=(FOCAL, WIDTH / 2, HEIGHT / 2))
    camera = ShutterCamera(model=model, exposure_s=exposure_s)
    scene = make_scene(SceneRecipe(motion=motion, frame_rate_hz=frame_rate_hz, camera=camera, format="h264", seed=seed))
    folder.mkdir(parents=True)
    _write_clip(folder / "clip.mp4", scene, exposure_s, np.eye(4))
    imu = scene.imu.recording
    for name, times, values in (("gyro", imu.gyro_t_s, imu.gyro_rad_s), ("accel", imu.accel_t_s, imu.accel_m_s2)):
        rows = [f"{t:.7f},{a:.6f},{b:.6f},{c:.6f}" for t, (a, b, c) in zip(times, values, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["t,x,y,z", *rows]) + "\n")
    tables = "".join(
        f'[imu.{name}]\nfile = "{name}.csv"\ntime = "t"\ntime_unit = "s"\ncolumns = ["x", "y", "z"]\nunit = "{unit}"\n'
        for name, unit in (("gyro", "rad/s"), ("accel", "m/s2"))
    )
    timing = "[timing]\nreadout_s = 0\n" + (f"exposure_s = {exposure_s}\n" if exposure_known else "")
    (folder / "capture.toml").write_text(
        f'[video]\nfile = "clip.mp4"\n{timing}[camera]\nmodel = "SIMPLE_PINHOLE"\nwidth = {WIDTH}\nheight = {HEIGHT}\n'
        f'params = {list(model.params)}\npixel_origin = "corner"\n{tables}'
    )
    return BoxVideo(folder=folder, scene=scene, t_s=np.asarray(scene.trigger_s), exposure_s=exposure_s)
