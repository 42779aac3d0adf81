"""Pairs of a short and a long exposure whose gain, geometry and blur are known: a coloured wall at infinity.

A camera that only turns sees a wall at infinity by its orientation alone: each line of a frame is the mean of what it
sees at the true orientations of its own exposure, in linear light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.rolling_shutter import spread_nodes
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion

CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))
SHORT_S, LONG_S, READOUT_S, DELAY_S = 0.004, 0.06, 0.02, 0.045
#: Light of the long exposure over that of the short one, and what colours differ by beside it.
GAIN, COLOURS = 12.0, (1.08, 1.0, 0.94)
STEP_PX = 16


@dataclass(frozen=True, eq=False)
class PairScene:
    """One pair; light is that of the long exposure."""

    wall: np.ndarray
    wall_from_world: np.ndarray
    camera: CameraModel
    motion: Motion
    short: FrameShutter
    long: FrameShutter
    seed: int

    def turn(self, t_s):
        """(..., 3, 3) wall_from_cam."""
        t_s = np.asarray(t_s, dtype=float)
        world_from_cam = matrix_from_quat(self.motion.world_from_cam_xyzw(t_s.ravel())).reshape(*t_s.shape, 3, 3)
        return self.wall_from_world @ world_from_cam

    def gyro(self, *, offset_s=0.0):
        """The camera by its gyroscope, with a phone's noise."""
        t = np.arange(-1.0, self.motion_s + 1, 1 / 400)
        rate = self.motion.rate_in_cam_rad_s(t) @ matrix_from_quat(CAM_FROM_IMU)
        rate = rate + 0.002 * np.random.default_rng(self.seed).standard_normal(rate.shape)
        path = GyroPath(t, rate, np.zeros(3))
        return GyroCamera(path=path, cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=offset_s)

    motion_s = 20.0

    def rendered(self, shutter, samples):
        """(H, W, 3) light of a frame."""
        width, height = self.camera.width, self.camera.height
        rays, nodes = self._rays(width, height)
        scale = self.camera.params[0]
        total = np.zeros((height, width, 3), dtype=np.float32)
        middle_s = shutter.middle_s(nodes)
        for k in range(samples):
            turn = self.turn(middle_s + (shutter.exposure_s or 0.0) * ((k + 0.5) / samples - 0.5))
            seen = np.einsum("yxij,yxj->yxi", turn, rays)
            u = seen[..., 0] / seen[..., 2] * scale + (self.wall.shape[1] - 1) / 2
            v = seen[..., 1] / seen[..., 2] * scale + (self.wall.shape[0] - 1) / 2
            maps = [spread_nodes(a, width, height, STEP_PX) for a in (u, v)]
            total += cv2.remap(self.wall, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return total / np.float32(samples)

    def _rays(self, width, height):
        columns, rows = -(-(width - 1) // STEP_PX) + 1, -(-(height - 1) // STEP_PX) + 1
        nodes = STEP_PX * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) + 0.5
        xy = np.asarray(colmap_camera(self.camera).cam_from_img(nodes.reshape(-1, 2)))[:, :2].reshape(nodes.shape)
        return np.concatenate([xy, np.ones((*nodes.shape[:2], 1))], axis=-1), nodes

    def sharp(self):
        """What a perfect fusion gives: the short exposure's geometry, the long one's light."""
        return codes(self.rendered(self.short, 4))

    def short_codes(self, *, noise=0.002, read=0.0008, dtype=np.uint8):
        """The short exposure as stored: dark and noisy."""
        light = self.rendered(self.short, 8) / (GAIN * np.array(COLOURS, dtype=np.float32))
        rng = np.random.default_rng([self.seed, 1])
        sigma = np.sqrt(noise**2 * light * 12 + read**2)
        return codes(light + sigma * rng.standard_normal(light.shape), dtype)

    def long_codes(self, dtype=np.uint8):
        """The long exposure as stored: blurred, hardly any noise; bright things clip."""
        light = self.rendered(self.long, 48)
        rng = np.random.default_rng([self.seed, 2])
        return codes(light + 0.001 * rng.standard_normal(light.shape), dtype)

    def true_shift(self, points_px):
        """(N, 2) from points of the short exposure (COLMAP's px) to the long one, by the middles of their lines."""
        return self._seen(self.long, self._directions(self.short, points_px), points_px) - points_px

    def true_blur(self, points_px):
        """(N, 2) the chord in the short exposure of what those pixels of the long one see that belong to its points."""
        pixels = points_px + self.true_shift(points_px)
        ends = []
        for sign in (-0.5, 0.5):
            wall = self._directions(self.long, pixels, sign * self.long.exposure_s)
            ends.append(self._seen(self.short, wall, points_px))
        return ends[1] - ends[0]

    def _directions(self, shutter, points_px, later_s=0.0):
        """(N, 3) where pixels see the wall."""
        xy = np.asarray(colmap_camera(self.camera).cam_from_img(points_px))[:, :2]
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        return np.einsum("nij,nj->ni", self.turn(shutter.middle_s(points_px) + later_s), rays)

    def _seen(self, shutter, wall, start_px):
        """(N, 2) the pixels of a frame at whose own mid-exposure a part of the wall is there."""
        found = np.array(start_px, dtype=float)
        for _ in range(20):
            turn = self.turn(shutter.middle_s(found))
            found = np.asarray(colmap_camera(self.camera).img_from_cam(np.einsum("nji,nj->ni", turn, wall)))
        return found


def codes(light, dtype=np.uint8):
    top = np.iinfo(dtype).max
    return np.asarray(np.rint(top * srgb_from_linear(np.asarray(light, dtype=np.float64))), dtype=dtype)


def coloured_wall(height, width, seed, *, lamps=6):
    """Linear light with detail of all sizes, and a few lamps that clip."""
    rng = np.random.default_rng(seed)
    layers = []
    for _ in range(3):
        layer = sum(
            s**0.9 * cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), s)
            for s in (1.2, 3, 8, 20, 50)
        )
        layers.append(layer / layer.std())
    shared = layers[0]
    wall = np.stack([0.8 * shared + 0.4 * layer for layer in layers], axis=-1)
    # boxes with sharp edges
    for _ in range(120):
        x, y = rng.integers(0, width), rng.integers(0, height)
        w, h = rng.integers(8, 90, 2)
        wall[y : y + h, x : x + w] += rng.normal(0, 0.8, 3)
    wall = 0.22 * np.exp(0.55 * wall)
    for _ in range(lamps):
        x, y = rng.integers(40, width - 40), rng.integers(40, height - 40)
        cv2.circle(wall, (int(x), int(y)), 7, (9.0, 8.0, 7.0), -1)
    return wall.astype(np.float32)


def make_scene(seed, *, size=(480, 320), vigour=1.0, lamps=6) -> PairScene:
    """A pair at a moment of a handheld recording at which the long exposure is blurred."""
    width, height = size
    f = 0.78 * width
    camera = CameraModel(
        model="OPENCV",
        width=width,
        height=height,
        params=(f, f, width / 2 + 3, height / 2 - 2, 0.06, -0.09, 3e-4, -2e-4),
    )
    rng = np.random.default_rng([seed, 77])
    motion = make_motion(MotionOptions(kind="pure_rotation", duration_s=PairScene.motion_s, vigour=vigour), rng)
    t = np.arange(1.0, PairScene.motion_s - 1, 0.05)
    speed = np.linalg.norm(motion.rate_in_cam_rad_s(t + DELAY_S + LONG_S / 2), axis=1)
    start = float(t[np.argmin(np.abs(speed * LONG_S * f - 14))])
    short = FrameShutter(width=width, height=height, t_s=start, exposure_s=SHORT_S, readout_s=READOUT_S)
    long = replace(short, t_s=start + DELAY_S, exposure_s=LONG_S)
    middle = matrix_from_quat(motion.world_from_cam_xyzw(np.array([short.reference_s()])))[0]
    return PairScene(
        wall=coloured_wall(3 * height, 3 * width, seed, lamps=lamps),
        wall_from_world=middle.T,
        camera=camera,
        motion=motion,
        short=short,
        long=long,
        seed=seed,
    )


def later(scene, by_s) -> PairScene:
    """Another pair of the same recording, before the same wall, which stands where the camera then looks."""
    short, long = (replace(shutter, t_s=shutter.t_s + by_s) for shutter in (scene.short, scene.long))
    middle = matrix_from_quat(scene.motion.world_from_cam_xyzw(np.array([short.reference_s()])))[0]
    return replace(scene, wall_from_world=middle.T, short=short, long=long, seed=scene.seed + round(1000 * by_s))


TOML = """\
[images]
folder = "short"
times = "frames.csv"

[exposures]
folder = "long"
times = "long.csv"
short_iso = 1600
long_iso = {long_iso}

[timing]
readout_s = 0.02
shared_clock = true

[imu]
path = "imu.csv"

[calibration]
cam_from_imu_xyzw = {rotation}
rotation_sigma_rad = 0.002
gyro_time_offset_s = 0.0
accel_time_offset_s = 0.0
time_offset_sigma_s = 0.001

[camera]
model = "OPENCV"
width = {width}
height = {height}
params = {params}
pixel_origin = "corner"
"""


def write_pair_capture(folder, seed=3, *, pairs=3, size=(240, 160), suffix=".png") -> list[PairScene]:
    """A capture of pairs with its gyroscope and accelerometer, all declared."""
    first = make_scene(seed, size=size)
    scenes = [first] + [later(first, 0.3 * (i + 1)) for i in range(pairs - 1)]
    (folder / "short").mkdir(parents=True)
    (folder / "long").mkdir()
    tables = {"frames": ["name,t_s,exposure_s"], "long": ["name,t_s,exposure_s"]}
    for i, scene in enumerate(scenes):
        name = f"{i:03d}"
        cv2.imwrite(str(folder / "short" / f"{name}.png"), scene.short_codes()[..., ::-1])
        cv2.imwrite(str(folder / "long" / f"{name}{suffix}"), scene.long_codes()[..., ::-1])
        tables["frames"].append(f"{name}.png,{scene.short.t_s:.6f},{SHORT_S}")
        tables["long"].append(f"{name}{suffix},{scene.long.t_s:.6f},{LONG_S}")
    for kind, rows in tables.items():
        (folder / f"{kind}.csv").write_text("\n".join(rows) + "\n")
    t = np.arange(0.0, PairScene.motion_s, 1 / 400)
    imu_from_cam = matrix_from_quat(CAM_FROM_IMU).T
    gyro = first.motion.rate_in_cam_rad_s(t) @ imu_from_cam.T
    world_from_cam = matrix_from_quat(first.motion.world_from_cam_xyzw(t))
    accel = np.einsum("ij,nkj,k->ni", imu_from_cam, np.swapaxes(world_from_cam, 1, 2), [0, 0, 9.81])
    lines = ["t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"]
    lines += [",".join(f"{v:.7f}" for v in (s, *g, *a)) for s, g, a in zip(t, gyro, accel, strict=True)]
    (folder / "imu.csv").write_text("\n".join(lines) + "\n")
    text = TOML.format(
        long_iso=1600 * GAIN * SHORT_S / LONG_S,
        rotation=[float(v) for v in CAM_FROM_IMU],
        width=size[0],
        height=size[1],
        params=[float(v) for v in first.camera.params],
    )
    (folder / "capture.toml").write_text(text)
    return scenes


def psnr_db(a, b) -> float:
    """Of two pictures in codes of 8 bit."""
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))
