"""Frames of a camera that turns as a recorded gyroscope did, for ``scripts/benchmarks/path.py``."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.core.geometry import quat_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, Projector
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera, MotionErrors
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.model import colmap_camera
from scripts.common.imaging_metrics import CORRECT_PX, Features, match
from scripts.common.imaging_scenes import photographed_walls
from scripts.common.turning_world import Moment, Turning, TurningCamera
from scripts.restoration.photographs import photographs

#: What the package knows of a frame's motion: gyroscope, camera, shutter.
Known = tuple[GyroCamera, Projector, FrameShutter]

HELD_OUT = "room5"
FOCAL = 1000 / 1280
READOUT_S, INTERVAL_S = 0.02, 0.2
NOISE, JPEG = 0.01, 90
#: Instants of an exposure, and of longer blur, one each so many px.
SAMPLES, SAMPLE_PX = 112, 0.3
EXTENT, LATE_S, ANGLE_RAD = 0.1, 3e-3, np.radians(3.0)
#: What a calibration says of itself: a usual one, and one as bad as these errors.
GOOD = MotionErrors(rotation_cov_rad2=np.radians(0.3) ** 2 * np.eye(3), offset_sigma_s=5e-4)
BAD = MotionErrors(rotation_cov_rad2=ANGLE_RAD**2 * np.eye(3), offset_sigma_s=LATE_S, extent_sigma=EXTENT)
#: The gyroscope, whether it is wrong, and what the package is told of it: right; or exposure, clock and direction wrong
#: at once, and known to be; and each with what is told of the other.
GYROS = {
    "exact": (False, GOOD),
    "errors": (True, BAD),
    "exact but doubted": (False, BAD),
    "errors unsaid": (True, GOOD),
}
#: Of a frame that is sharp.
SHARP_S = 2e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """Two frames, one after the other."""

    camera: TurningCamera
    moments: tuple[Moment, Moment]
    blur_px: float
    seed: int
    cache: Path | None

    def frame(self, index: int) -> UInt8Array:
        """As filmed."""
        return self._kept(f"frame{index}", lambda: _filmed(self._light(self.moments[index]), self.seed + index))

    def sharp(self, index: int) -> UInt8Array:
        """Without blur, noise and JPEG."""
        return self._kept(f"sharp{index}", lambda: _codes(self.camera.frame(self.moments[index], 1)))

    def short(self, index: int) -> UInt8Array:
        """As filmed with so short an exposure, around the same instant, that nothing blurs."""
        brief = shortened(self.moments[index])
        return self._kept(f"short{index}", lambda: _filmed(self.camera.frame(brief, 3), self.seed + 7 + index))

    def known(self, index: int, gyro: str, moment: Moment | None = None) -> Known:
        """What the package is told of a frame."""
        rng = np.random.default_rng([self.seed, 99])
        is_wrong, errors = GYROS[gyro]
        return _known(self.camera, moment or self.moments[index], rng.choice([-1.0, 1.0], 3) * is_wrong, errors)

    def correct_matches(self, a: Features, b: Features) -> tuple[int, int]:
        """How many matches are correct, and how many there are."""
        found = match(a, b)
        if not len(found):
            return 0, 0
        # COLMAP's pixels begin at the corner
        there = self.camera.transferred(a.points_px[found[:, 0]] - 0.5, *self.moments) + 0.5
        with np.errstate(invalid="ignore"):
            right = np.linalg.norm(there - b.points_px[found[:, 1]], axis=1) < CORRECT_PX
        return int(right.sum()), len(found)

    def _light(self, moment: Moment) -> Float32Array:
        return self.camera.frame(moment, max(SAMPLES, int(np.ceil(self.blur_px / SAMPLE_PX))))

    def _kept(self, name: str, make: Any) -> UInt8Array:
        if self.cache is None:
            return np.asarray(make())
        width, height = self.camera.size
        text = f"{self.moments} {self.seed} {width} {height} {self.camera.focal_px} {float(self.camera.wall.sum())}"
        path = self.cache / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}_{name}.png"
        if not path.exists():
            self.cache.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), make())
        return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


@dataclass(frozen=True, eq=False, kw_only=True)
class Take:
    """Pairs of one exposure time, and how many had too much or too little blur."""

    exposure_s: float
    pairs: list[Pair]
    beyond: dict[str, int]


def takes(
    photos: Path,
    motion: Path | None,
    exposures_s: list[float],
    *,
    size: tuple[int, int],
    every_s: float,
    most: int,
    most_px: float,
    least_px: float,
    seed: int,
    cache: Path | None = None,
) -> list[Take]:
    """Pairs of neighbours through the whole recording, for each exposure time."""
    turning = Turning.simulated(seed) if motion is None else Turning.recorded(motion, HELD_OUT)
    # as large as turns within a pair need
    walls = photographed_walls(photographs(photos, held_out=True), 4, seed)
    begin, end = turning.t_s[0] + 0.5, turning.t_s[-1] - 1.0
    out = []
    for exposure_s in exposures_s:
        found: list[Pair] = []
        beyond = {"more": 0, "less": 0}
        for i, t_s in enumerate(np.arange(begin, end, every_s)):
            if len(found) == most:
                break
            moments = tuple(
                Moment(t_s=float(t_s + k * INTERVAL_S), exposure_s=exposure_s, readout_s=READOUT_S) for k in (0, 1)
            )
            camera = TurningCamera(
                wall=walls[i % len(walls)],
                wall_from_world=np.eye(3),
                turning=turning,
                size=size,
                focal_px=FOCAL * size[0],
            )
            camera = replace(camera, wall_from_world=camera.facing(*moments))
            blurs = [blur_px(camera, moment) for moment in moments]
            if max(blurs) > most_px or np.mean(blurs) < least_px:
                beyond["more" if max(blurs) > most_px else "less"] += 1
                continue
            found.append(
                Pair(
                    camera=camera,
                    moments=(moments[0], moments[1]),
                    blur_px=float(np.mean(blurs)),
                    seed=1000 * seed + i,
                    cache=cache,
                )
            )
        out.append(Take(exposure_s=exposure_s, pairs=found, beyond=beyond))
    return out


def blur_px(camera: TurningCamera, moment: Moment) -> float:
    """90th percentile over the frame of how far the picture moves during the exposure, end to end."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 6))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    at = moment.middle_s(points[:, 1], height)
    rays = np.concatenate(
        [(points - 0.5 * np.array(camera.size) + 0.5) / camera.focal_px, np.ones((len(points), 1))], axis=1
    )
    ends = []
    for sign in (-0.5, 0.5):
        turn = np.swapaxes(camera.turning.world_from_cam(at), -1, -2)
        turn = turn @ camera.turning.world_from_cam(at + sign * moment.exposure_s)
        seen = np.einsum("nij,nj->ni", turn, rays)
        ends.append(camera.focal_px * seen[:, :2] / seen[:, 2:])
    return float(np.percentile(np.linalg.norm(ends[1] - ends[0], axis=1), 90))


def shortened(moment: Moment) -> Moment:
    """So short that nothing blurs, around the same instant."""
    return replace(moment, exposure_s=SHARP_S, t_s=moment.t_s + 0.5 * (moment.exposure_s - SHARP_S))


def _known(camera: TurningCamera, moment: Moment, wrong: Array, errors: MotionErrors) -> Known:
    width, height = camera.size
    f = camera.focal_px
    model = CameraModel(model="PINHOLE", width=width, height=height, params=(f, f, width / 2, height / 2))
    near = (camera.turning.t_s > moment.t_s - 1.5) & (camera.turning.t_s < moment.t_s + 1.5)
    path = GyroPath(camera.turning.t_s[near], camera.turning.rate_rad_s[near], np.zeros(3))
    motion = GyroCamera(
        path=path,
        cam_from_imu_xyzw=quat_exp(np.array([0.0, 0.0, ANGLE_RAD * wrong[0]])),
        offset_s=LATE_S * float(wrong[1]),
        errors=errors,
    )
    exposure_s = moment.exposure_s * (1 + EXTENT * float(wrong[2]))
    # the middle of a row's exposure stays; OpenCV's row 0 is COLMAP's 0.5
    shutter = FrameShutter(
        width=width,
        height=height,
        t_s=moment.t_s + 0.5 * (moment.exposure_s - exposure_s),
        exposure_s=exposure_s,
        readout_s=moment.readout_s,
    )
    return motion, colmap_camera(model), shutter


def _filmed(light: Float32Array, seed: int) -> UInt8Array:
    """With noise of photons and of reading, alike at half of full scale, and JPEG."""
    rng = np.random.default_rng([seed, 3])
    sigma = NOISE * np.sqrt(0.5 + np.clip(light, 0, 1))
    noisy = _codes(light + sigma * rng.standard_normal(light.shape, dtype=np.float32))
    data = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, JPEG])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))


def _codes(light: Float32Array) -> UInt8Array:
    return np.asarray(np.rint(255 * srgb_from_linear(np.clip(light, 0, 1))), dtype=np.uint8)
