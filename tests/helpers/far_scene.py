"""A flat texture infinitely far away, filmed by a camera that only turns: exact blur and rolling shutter, quickly."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import colmap_camera
from colmap_inertial.tools.simulate.textures import poster

CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))


def srgb(linear):
    light = np.clip(linear, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@lru_cache(maxsize=4)
def rays_of(model):
    """(H, W, 2) the middles of a camera's pixels, and (H, W, 3) their rays, z = 1. Nobody may change them."""
    x, y = np.meshgrid(np.arange(model.width) + 0.5, np.arange(model.height) + 0.5)
    pixels = np.stack([x, y], axis=-1)
    rays = np.asarray(colmap_camera(model).cam_from_img(pixels.reshape(-1, 2)))[:, :2].reshape(pixels.shape)
    return pixels, np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)


@dataclass(frozen=True, eq=False)
class FarScene:
    """A wall at infinity, ``half`` as the tangent of the angle to its edges, filmed by a turning camera."""

    texture: np.ndarray
    motion: Motion
    half: float = 1.6

    @classmethod
    def make(cls, seed=3, *, vigour=0.7, duration_s=6.0, size=2400, texture=None):
        rng = np.random.default_rng(seed)
        options = MotionOptions(kind="pure_rotation", duration_s=duration_s, vigour=vigour, heading_deg=90.0)
        motion = make_motion(options, rng)
        return cls(texture=poster(rng, size, size) if texture is None else texture, motion=motion)

    def wall_from_cam(self, t_s):
        looking = matrix_from_quat(self.motion.world_from_cam_xyzw(np.array([3.0])))[0]
        return looking.T @ matrix_from_quat(self.motion.world_from_cam_xyzw(t_s))

    def gyro(self, *, rate_hz=400.0, end_s=6.0, noise_rad_s=0.0, late_s=0.0, seed=0):
        """The camera as its gyroscope knows it; ``late_s`` is an error of the clock offset."""
        t = np.arange(0.0, end_s, 1 / rate_hz)
        rate = self.motion.rate_in_cam_rad_s(t)
        rate = rate + noise_rad_s * np.random.default_rng(seed).standard_normal(rate.shape)
        rate = rate @ matrix_from_quat(CAM_FROM_IMU)
        path = GyroPath(t + 11.0, rate, np.zeros(3))
        return GyroCamera(path=path, cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=-11.0 + late_s)

    def linear(self, model, shutter: FrameShutter, samples=1):
        """(H, W, 3) light: the mean of ``samples`` sharp pictures within the exposure of each line."""
        pixels, rays = rays_of(model)
        by_column = shutter.readout_direction in ("right", "left")
        line_s = shutter.middle_s(pixels[0] if by_column else pixels[:, 0])
        total = np.zeros((model.height, model.width, 3), np.float32)
        scale = self.texture.shape[0] / (2 * self.half)
        for k in range(samples):
            turn = self.wall_from_cam(line_s + shutter.exposure_s * ((k + 0.5) / samples - 0.5))
            back = np.swapaxes(turn, 1, 2)
            seen = np.swapaxes(np.swapaxes(rays, 0, 1) @ back, 0, 1) if by_column else rays @ back
            u, v = (((seen[..., i] / seen[..., 2] + self.half) * scale - 0.5).astype(np.float32) for i in (0, 1))
            total += cv2.remap(self.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return total / samples

    def picture(self, model, shutter: FrameShutter, samples=1, *, noise=0.0, seed=0):
        """(H, W, 3) 8 bit sRGB with noise in linear light."""
        light = self.linear(model, shutter, samples)
        light = light + noise * np.random.default_rng(seed).standard_normal(light.shape)
        return np.round(255 * srgb(light)).astype(np.uint8)
