"""Blurred frames with exact truth, for the imaging benchmark: a wall at infinity before a handheld camera.

A camera that only turns sees a wall at infinity: what one of its pixels sees at one instant is given by the orientation
at that instant, whatever the depth. So blur and rolling shutter are not approximated: a frame is the mean of many
sharp ones, each line of each of them at the orientation of its own instant, in linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import blur_field, predict_blur_px
from colmap_inertial.imaging.rolling_shutter import spread_nodes
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import colmap_camera
from colmap_inertial.tools.simulate.textures import MATERIALS

DURATION_S = 60.0
#: Of the camera, and of a phone's gyroscope (white, each sample).
EXPOSURE_S, READOUT_S = 0.02, 0.02
GYRO_HZ, GYRO_NOISE_RAD_S = 400.0, 0.002
#: The hand holds much stiller while filming than while walking about; both frames of a pair see much the same.
VIGOUR, NEAREST_DEG, FARTHEST_DEG = 0.8, 1.5, 9.0
NOISE = 0.01
CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))
#: Spacing of the nodes at which the exact mapping is worked out; between them it is bilinear, to 0.005 px.
NODE_PX = 16


def lens(width: int, height: int) -> CameraModel:
    """A phone's main camera: 65 degrees wide, slight distortion."""
    f = 0.78 * width
    return CameraModel(
        model="OPENCV",
        width=width,
        height=height,
        params=(f, f, width / 2 + 3, height / 2 - 2, 0.06, -0.09, 3e-4, -2e-4),
    )


@dataclass(frozen=True, kw_only=True)
class GyroErrors:
    """What a gyroscope, or what is known of it, gets wrong.

    Attributes
    ----------
    late_s
        Its clock.
    extent
        Factor on the blur it predicts.
    angle_rad
        By which the blur it predicts is turned.
    noise_rad_s
        White, of each sample.
    flipped
        Its first axis.
    """

    late_s: float = 0.0
    extent: float = 1.0
    angle_rad: float = 0.0
    noise_rad_s: float = GYRO_NOISE_RAD_S
    flipped: bool = False


NAMED_ERRORS = {
    "": GyroErrors(),
    "noise": GyroErrors(noise_rad_s=0.2),
    "flipped axis": GyroErrors(flipped=True),
    "20 % long": GyroErrors(extent=1.2),
    "20 % short": GyroErrors(extent=0.8),
    "10 ms late": GyroErrors(late_s=0.01),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """Two frames of one recording that see much the same part of a wall."""

    wall: Float32Array
    wall_from_world: Array
    model: CameraModel
    motion: Motion
    shutters: tuple[FrameShutter, FrameShutter]
    seed: int

    def turn(self, t_s: Array) -> Array:
        """(N, 3, 3) wall_from_cam at (N,) times."""
        return np.asarray(self.wall_from_world @ matrix_from_quat(self.motion.world_from_cam_xyzw(t_s)))

    def frame(self, index: int, *, noise: float = NOISE, exposure_s: float | None = None) -> UInt8Array:
        """A frame as filmed; with ``exposure_s``, around the same instants of mid-exposure."""
        shutter = self.shutters[index] if exposure_s is None else _shortened(self.shutters[index], exposure_s)
        light = self.light(shutter)
        light += noise * np.random.default_rng([self.seed, index]).standard_normal(light.shape, dtype=np.float32)
        return np.asarray(np.rint(255 * srgb_from_linear(light)), dtype=np.uint8)

    def light(self, shutter: FrameShutter) -> Float32Array:
        """What a frame of this shutter gathers, without noise and clipping; the wall's own light where it is still."""
        length = float(np.percentile(blur_field(self.gyro(), colmap_camera(self.model), shutter).extent_px(), 99))
        samples = 1 if shutter.exposure_s == 0 else max(32, int(np.ceil(2 * length)))
        return _render(self, shutter, samples)

    def sharp(self, index: int) -> UInt8Array:
        """The frame without blur or noise."""
        return self.frame(index, noise=0.0, exposure_s=0.0)

    def gyro(self, error: str | GyroErrors = "") -> GyroCamera:
        """The camera as its gyroscope knows it, or would with an error."""
        errors = NAMED_ERRORS[error] if isinstance(error, str) else error
        t = np.arange(-1.0, DURATION_S + 1, 1 / GYRO_HZ)
        rate = self.motion.rate_in_cam_rad_s(t)
        rate = rate + errors.noise_rad_s * np.random.default_rng(self.seed).standard_normal(rate.shape)
        if errors.flipped:
            rate = rate * [-1, 1, 1]
        path = GyroPath(t, rate @ matrix_from_quat(CAM_FROM_IMU), np.zeros(3))
        return GyroCamera(path=path, cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=errors.late_s)

    def blur(self, index: int, error: str | GyroErrors = "") -> BlurField:
        """The blur that the gyroscope predicts."""
        errors = NAMED_ERRORS[error] if isinstance(error, str) else error
        field = blur_field(self.gyro(errors), colmap_camera(self.model), self.shutters[index])
        return erred(field, errors)

    def directions(self, index: int, points_px: Array) -> Array:
        """(N, 3) where points of a frame lie on the wall: true, each by the orientation of its own line."""
        rays = np.asarray(colmap_camera(self.model).cam_from_img(np.asarray(points_px, dtype=np.float64)))[:, :2]
        rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        return np.einsum("nij,nj->ni", self.turn(self.shutters[index].middle_s(points_px)), rays)

    def transferred(self, points_px: Array, *, source: int = 0) -> Array:
        """(N, 2) where points of a frame truly are in the other frame; NaN where out of its sight."""
        target = 1 - source
        shutter, camera = self.shutters[target], colmap_camera(self.model)
        wall = self.directions(source, points_px)
        found = np.tile([0.5 * self.model.width, 0.5 * self.model.height], (len(wall), 1))
        for _ in range(6):
            turn = self.turn(shutter.middle_s(np.clip(found, 0, max(self.model.width, self.model.height))))
            seen = np.asarray(camera.img_from_cam(np.einsum("nji,nj->ni", turn, wall)))
            found = np.where(np.isfinite(seen), seen, found)
        inside = (found > 0).all(axis=1) & (found < [self.model.width, self.model.height]).all(axis=1)
        found[~inside] = np.nan
        return found


def erred(field: BlurField, errors: GyroErrors) -> BlurField:
    """A blur field with what is wrong about extents and directions."""
    cos, sin = np.cos(errors.angle_rad), np.sin(errors.angle_rad)
    turned = field.vector_px @ np.array([[cos, sin], [-sin, cos]], dtype=np.float32)
    return replace(field, vector_px=turned * np.float32(errors.extent))


def _shortened(shutter: FrameShutter, exposure_s: float) -> FrameShutter:
    assert shutter.exposure_s is not None
    return replace(shutter, exposure_s=exposure_s, t_s=shutter.t_s + 0.5 * (shutter.exposure_s - exposure_s))


def _render(pair: Pair, shutter: FrameShutter, samples: int) -> Float32Array:
    """(H, W) or (H, W, 3) light of a frame."""
    model, wall = pair.model, pair.wall
    rows, columns = BlurField.nodes(model.width, model.height, NODE_PX)
    x, y = NODE_PX * np.arange(float(columns)) + 0.5, NODE_PX * np.arange(float(rows)) + 0.5
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    rays = np.asarray(colmap_camera(model).cam_from_img(nodes.reshape(-1, 2)))[:, :2].reshape(nodes.shape)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    middle_s = shutter.middle_s(nodes[:, 0])
    exposure_s = shutter.exposure_s or 0.0
    scale = model.params[0]
    total = np.zeros((model.height, model.width, *wall.shape[2:]), dtype=np.float32)
    for k in range(samples):
        turn = pair.turn(middle_s + exposure_s * ((k + 0.5) / samples - 0.5))
        seen = np.einsum("yij,yxj->yxi", turn, rays)
        u = seen[..., 0] / seen[..., 2] * scale + (wall.shape[1] - 1) / 2
        v = seen[..., 1] / seen[..., 2] * scale + (wall.shape[0] - 1) / 2
        maps = [spread_nodes(a, model.width, model.height, NODE_PX) for a in (u, v)]
        total += cv2.remap(wall, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return total / np.float32(samples)


def make_pairs(
    walls: Sequence[Float32Array],
    blur_px: float,
    *,
    size: tuple[int, int] | None,
    seed: int,
    rate_rad_s: float | None = None,
    exposure_s: float = EXPOSURE_S,
) -> list[Pair]:
    """A pair of frames before each wall, both with about ``blur_px`` of blur (90th percentile).

    Motion is as measured of people who carry a camera (``simulate.motion``), exposure and readout are 20 ms; instants
    are chosen at which the blur is within a tenth of what is wanted.

    Parameters
    ----------
    size
        Width and height; ``None`` is each wall's own size.
    rate_rad_s
        Where given, instants are chosen by this speed of turning instead.
    exposure_s
        Of both frames.
    """
    pairs = []
    for i, wall in enumerate(walls):
        width, height = size or (wall.shape[1], wall.shape[0])
        model = lens(width, height)
        for attempt in range(20):
            rng = np.random.default_rng([seed, i, attempt, int(10 * blur_px)])
            options = MotionOptions(kind="pure_rotation", duration_s=DURATION_S, vigour=VIGOUR)
            motion = make_motion(options, rng)
            found = _instants(motion, model, blur_px, rate_rad_s, exposure_s, rng)
            if found is not None:
                break
        else:
            raise ValueError(f"no two frames with {blur_px} px of blur in {20 * DURATION_S:.0f} s of motion")
        shutters = tuple(
            FrameShutter(width=width, height=height, t_s=t, exposure_s=exposure_s, readout_s=READOUT_S) for t in found
        )
        middle = matrix_from_quat(motion.world_from_cam_xyzw(np.array([s.reference_s() for s in shutters])))
        forward = middle[:, :, 2].sum(axis=0)
        forward /= np.linalg.norm(forward)
        right = np.cross(middle[0][:, 1], forward)
        right /= np.linalg.norm(right)
        wall_from_world = np.stack([right, np.cross(forward, right), forward])
        pairs.append(
            Pair(
                wall=wall,
                wall_from_world=wall_from_world,
                model=model,
                motion=motion,
                shutters=(shutters[0], shutters[1]),
                seed=seed + i,
            )
        )
    return pairs


def _instants(
    motion: Motion,
    model: CameraModel,
    blur_px: float,
    rate_rad_s: float | None,
    exposure_s: float,
    rng: np.random.Generator,
) -> tuple[float, float] | None:
    """Starts of exposure of two frames that suit, or ``None``."""
    t = np.arange(0.5, DURATION_S - 0.5, 1 / 60)
    middle = t + 0.5 * (exposure_s + READOUT_S)
    if rate_rad_s is not None:
        of = np.linalg.norm(motion.rate_in_cam_rad_s(middle), axis=1) / rate_rad_s
    else:
        grid = np.arange(0.0, DURATION_S, 1 / 200)
        path = GyroPath(grid, motion.rate_in_cam_rad_s(grid), np.zeros(3))
        gyro = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0, 0, 0, 1.0]), offset_s=0.0)
        timing = FrameTiming(
            names=tuple(str(i) for i in range(len(t))),
            t_s=t,
            epoch_ns=0,
            exposure_s=np.full(len(t), exposure_s),
            readout_s=READOUT_S,
        )
        of = predict_blur_px(gyro, colmap_camera(model), timing, width=model.width, height=model.height).px / blur_px
    good = np.flatnonzero(np.abs(of - 1) < 0.1)
    looking = matrix_from_quat(motion.world_from_cam_xyzw(middle[good]))
    cosine = 0.5 * (np.einsum("aij,bij->ab", looking, looking) - 1)
    apart_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    apart_s = np.abs(t[good][:, None] - t[good])
    suits = np.argwhere(np.triu((apart_deg > NEAREST_DEG) & (apart_deg < FARTHEST_DEG) & (apart_s > 0.1)))
    if not len(suits):
        return None
    a, b = suits[rng.integers(len(suits))]
    return float(t[good[a]]), float(t[good[b]])


def drawn_walls(count: int, seed: int) -> list[Float32Array]:
    """Walls of the simulator's materials, six patches each."""
    walls = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        patches = [MATERIALS[rng.integers(len(MATERIALS))](rng, 750, 800)[..., 1] for _ in range(6)]
        walls.append(0.95 * np.vstack([np.hstack(patches[:3]), np.hstack(patches[3:])]).astype(np.float32))
    return walls


def photographs(folder: Path) -> list[Path]:
    """The pictures of a folder, in order of their names."""
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    if len(found) < 15:
        raise SystemExit(f"{folder} holds {len(found)} pictures, 15 are wanted")
    return found


def photographed_walls(paths: Sequence[Path], count: int, seed: int, *, colour: bool = False) -> list[Float32Array]:
    """Walls hung with photographs at their own size, 15 each, none twice while there are enough."""
    side = 500
    order = np.random.default_rng(seed).permutation(len(paths))
    walls = []
    for i in range(count):
        chosen = [paths[order[(15 * i + k) % len(paths)]] for k in range(15)]
        patches = [_light(path, (side, side), colour) for path in chosen]
        walls.append(np.vstack([np.hstack(patches[5 * r : 5 * r + 5]) for r in range(3)]))
    return walls


def native_walls(paths: Sequence[Path], count: int, seed: int, *, colour: bool = False) -> list[Float32Array]:
    """Whole photographs, the larger ones first."""
    sizes = {path: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).size for path in paths}
    large = sorted(paths, key=lambda path: (-sizes[path], path.name))[: 3 * count]
    chosen = np.random.default_rng(seed).permutation(len(large))[:count]
    return [_light(large[k], None, colour) for k in chosen]


def _light(path: Path, size: tuple[int, int] | None, colour: bool) -> Float32Array:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB if colour else cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise SystemExit(f"cannot read {path}")
    if size is not None:
        if picture.shape[0] < size[1] or picture.shape[1] < size[0]:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        top, left = (picture.shape[0] - size[1]) // 2, (picture.shape[1] - size[0]) // 2
        picture = picture[top : top + size[1], left : left + size[0]]
    return linear_from_srgb(picture / 255).astype(np.float32)
