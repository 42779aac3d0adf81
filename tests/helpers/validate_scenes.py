"""Sharp images of flat targets, rendered exactly: every pixel is the mean over rays through it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.validate import Target

Texture = Callable[[np.ndarray], np.ndarray]

DARK, LIGHT, GROUND = 0.06, 0.9, 0.45


@dataclass(frozen=True)
class Pose:
    """cam_from_world: rotation (3, 3) and translation (3,), metres."""

    rotation: np.ndarray
    translation: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        return -self.rotation.T @ self.translation


def look_at(centre, target=(0.0, 0.0, 0.0), roll_rad=0.0) -> Pose:
    """A camera that looks at a point of the target's plane; the target's side that its z axis leaves is in view."""
    forward = np.asarray(target, float) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
    return Pose(rotation, -rotation @ np.asarray(centre, float))


def orbit(
    rng, count, *, distance_m=(0.5, 0.8), spread=0.6, target=(0.0, 0.0, 0.0), roll_rad=3.1, front=-1
) -> list[Pose]:
    """Cameras around the z axis of a target that look near its middle. ``front`` is the side of z they stand on."""
    poses = []
    for _ in range(count):
        direction = np.array([*rng.uniform(-spread, spread, 2), front])
        centre = np.asarray(target) + rng.uniform(*distance_m) * direction / np.linalg.norm(direction)
        aim = np.asarray(target) + np.append(rng.uniform(-0.02, 0.02, 2), 0)
        poses.append(look_at(centre, aim, rng.uniform(-roll_rad, roll_rad)))
    return poses


def default_camera(width=640, height=480) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 600.0, width, height)
    camera.params = [600.0, 602.0, width / 2 + 2, height / 2 - 2, -0.1, 0.02, 0.001, -0.0005]
    return camera


def _within(xy: np.ndarray, low, high) -> np.ndarray:
    """Which points (n, 2) lie in a rectangle."""
    (x, y), (x0, y0), (x1, y1) = xy.T, np.broadcast_to(low, 2), np.broadcast_to(high, 2)
    return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def checkerboard(target: Target, *, centre=(0.0, 0.0)) -> Texture:
    """Grey values of a checkerboard with a white rim, as a function of the plane's coordinates (n, 2)."""
    first = target.corners_m[0, :2] + centre

    def grey(xy: np.ndarray) -> np.ndarray:
        u = (xy - first) / target.length_m
        size = np.array([target.columns, target.rows])
        on_board = _within(u, -1, size)
        on_paper = _within(u, -2, size + 1)
        dark = np.floor(u).astype(int).sum(axis=1) % 2 == 0
        return np.where(on_board, np.where(dark, DARK, LIGHT), np.where(on_paper, LIGHT, np.nan))

    return grey


def cells(bits: np.ndarray, side_m: float, lower_left=(0.0, 0.0), *, rim: float = 1.0) -> Texture:
    """Square picture of black and white cells; row 0 at small y. Around it ``rim`` cells of white."""

    def grey(xy: np.ndarray) -> np.ndarray:
        n = len(bits)
        u = (xy - lower_left) / side_m * n
        inside = _within(u, 0, n)
        paper = _within(u, -rim, n + rim)
        index = np.clip(np.floor(u).astype(int), 0, n - 1)
        return np.where(inside, np.where(bits[index[:, 1], index[:, 0]], LIGHT, DARK), np.where(paper, LIGHT, np.nan))

    return grey


def charuco(target: Target) -> Texture:
    """A ChArUco board as OpenCV prints it, with a white rim."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{target.dictionary}"))
    size = (target.columns, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.length_m, target.marker_m, markers)
    scale = 80
    bits = board.generateImage((size[0] * scale, size[1] * scale), marginSize=0, borderBits=1) > 127
    extent = np.array(size) * target.length_m

    def grey(xy: np.ndarray) -> np.ndarray:
        u = xy + extent / 2
        inside = _within(u, 0, extent)
        paper = _within(u, -target.length_m, extent + target.length_m)
        index = np.clip((u / target.length_m * scale).astype(int), 0, np.array(size) * scale - 1)
        return np.where(inside, np.where(bits[index[:, 1], index[:, 0]], LIGHT, DARK), np.where(paper, LIGHT, np.nan))

    return grey


def aprilgrid(target: Target, *, centre=(0.0, 0.0)) -> Texture:
    """An AprilGrid as Kalibr prints it (y up): black squares between the corners of the tags, white around."""
    tag, gap = target.length_m, target.gap * target.length_m
    lower_left = target.corners_m[0, :2] + centre
    extent = np.array([target.columns, target.rows]) * (tag + gap) - gap
    bits = np.stack(
        [
            np.flipud(np.rot90(marker_bits("DICT_APRILTAG_36h11", i, border=2), 2))
            for i in range(target.columns * target.rows)
        ]
    )
    side = bits.shape[1]

    def grey(xy: np.ndarray) -> np.ndarray:
        u = xy - lower_left
        place = np.floor(u / (tag + gap)).astype(int)
        within = u - place * (tag + gap)
        column, row = np.clip(place, 0, [target.columns - 1, target.rows - 1]).T
        on_tag = _within(place, 0, [target.columns, target.rows]) & (within < tag).all(axis=1)
        x, y = np.clip((within / tag * side).astype(int), 0, side - 1).T
        on_board = _within(u, -gap, extent + gap)
        paper = _within(u, -2 * gap, extent + 2 * gap)
        between = ((u + gap) % (tag + gap) < gap).all(axis=1)
        around = np.where(on_board & between, DARK, np.where(paper, LIGHT, np.nan))
        return np.where(on_tag, np.where(bits[row * target.columns + column, y, x], LIGHT, DARK), around)

    return grey


def marker_bits(dictionary: str, number: int, border: int = 1) -> np.ndarray:
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return markers.generateImageMarker(number, markers.markerSize + 2 * border, borderBits=border) > 127


def over(*textures: Texture) -> Texture:
    """The first texture that has something to show at a place."""

    def grey(xy: np.ndarray) -> np.ndarray:
        out = np.full(len(xy), np.nan)
        for texture in textures:
            hole = np.isnan(out)
            out[hole] = texture(xy[hole])
        return out

    return grey


def ground(xy: np.ndarray) -> np.ndarray:
    """A smooth uneven floor."""
    return GROUND + 0.1 * np.sin(9 * xy[:, 0]) * np.sin(7 * xy[:, 1])


@lru_cache(maxsize=2)
def _rays(params: str, model: str, width: int, height: int, samples: int) -> np.ndarray:
    """(H, W, samples^2, 3) directions with z = 1 through the parts of every pixel."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, width, height)
    camera.set_params_from_string(params)
    part = np.stack(np.meshgrid(*2 * [(np.arange(samples) + 0.5) / samples]), axis=-1).reshape(-1, 2)
    px = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)[:, :, None, :] + part
    plane = camera.cam_from_img(px.reshape(-1, 2)).reshape(px.shape)
    return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)


def render(camera, pose: Pose, texture: Texture, rng, *, samples=3, blur_px=0.6, noise=1.0, gamma=1.0) -> np.ndarray:
    """(H, W) uint8 image of the plane z = 0: exact on the texture, one ray a pixel on the ground around it."""
    assert samples % 2 == 1
    rays = _rays(camera.params_to_string(), camera.model_name, camera.width, camera.height, samples)

    def grey(ray: np.ndarray, what: Texture) -> np.ndarray:
        direction = ray.reshape(-1, 3) @ pose.rotation
        distance = -pose.centre[2] / direction[:, 2]
        out = what(pose.centre[:2] + distance[:, None] * direction[:, :2])
        return np.where(distance > 0, out, GROUND).reshape(ray.shape[:-1])

    image = grey(rays[:, :, samples**2 // 2], over(texture, ground))
    on_texture = ~np.isnan(grey(rays[:, :, samples**2 // 2], texture))
    fine = cv2.dilate(on_texture.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    image[fine] = grey(rays[fine], over(texture, ground)).mean(axis=-1)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px) ** (1 / gamma) * 255
    return np.clip(np.round(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)


def reconstruction(camera, poses: list[Pose], *, units_per_m=1.0) -> pycolmap.Reconstruction:
    """A model without points; images are 000.png, 001.png ... in a turned and moved world."""
    world = cv2.Rodrigues(np.array([0.3, -1.1, 0.7]))[0]
    out = pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(camera)
    for i, pose in enumerate(poses):
        rotation = pose.rotation @ world.T
        centre = units_per_m * (world @ pose.centre + [5.0, -3.0, 2.0])
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(quat_from_matrix(rotation)), -rotation @ centre)
        image = pycolmap.Image(name=f"{i:03}.png", camera_id=1, image_id=i + 1)
        out.add_image_with_trivial_frame(image, moved)
    return out


def write_images(folder: Path, camera, poses: list[Pose], texture: Texture, rng, **how) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(poses):
        assert cv2.imwrite(str(folder / f"{i:03}.png"), render(camera, pose, texture, rng, **how))
    return folder
