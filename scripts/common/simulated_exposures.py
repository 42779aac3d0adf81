"""Pairs of a short, dark, noisy and a long, blurred exposure with known truth, of all sorts that hands make.

Good pairs show one scene; they differ in texture, in how much clips, in how far the camera turned between the two, in
exposure times and noise, and in parallax. Wrong pairs are a short exposure of one scene and a long one of another. All
is drawn from a seed; the truth is the short exposure without noise, as bright as the long one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging.exposure_pairs import PairGyro
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear
from colmap_inertial.model import colmap_camera
from scripts.common.turning_world import Moment, Turning, TurningCamera

TEXTURES = ("photographs", "one photograph", "low texture", "repeated", "clipping", "speckled", "dark")
#: Of the picture's width: how far the camera turned between the exposures, from and to.
NEAR, FAR = (0.0, 0.06), (0.1, 0.25)
READOUT_S = 0.02
#: Of a gyroscope, each sample, and of its clock.
_GYRO_NOISE_RAD_S, _LATE_S = 0.002, 0.003


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """One pair, and what is true of it.

    Attributes
    ----------
    kind
        In words.
    short, long
        (H, W, 3) codes.
    truth
        (H, W, 3) codes of the short one without noise at the long one's brightness.
    gyro
        Of about every second pair.
    gain
        The light of the long one over that of the short one.
    good
        Whether both show one scene.
    shift_px
        (H / 16, W / 16, 2) true shift from the short to the long one, at every sixteenth pixel.
    """

    kind: str
    short: UInt8Array
    long: UInt8Array
    truth: UInt8Array
    gyro: PairGyro | None
    gain: float
    good: bool
    shift_px: Array


def codes(light: Float32Array) -> UInt8Array:
    """8 bit sRGB of linear light."""
    return np.asarray(np.rint(255 * srgb_from_linear(np.clip(light, 0, 1))), dtype=np.uint8)


def pairs(
    turnings: Sequence[Turning], photos: Sequence[Path], count: int, seed: int, *, width: int = 640, good: bool = True
) -> list[Callable[[], Pair]]:
    """Makers of so many pairs, each sort in turn.

    Parameters
    ----------
    turnings
        How the camera turns.
    photos
        What the scenes are made of; without any, they are drawn.
    """
    return [_maker(turnings, photos, i, seed, width, good) for i in range(count)]


def _maker(
    turnings: Sequence[Turning], photos: Sequence[Path], i: int, seed: int, width: int, good: bool
) -> Callable[[], Pair]:
    return lambda: _pair(turnings, photos, i, seed, width, good)


def _pair(turnings: Sequence[Turning], photos: Sequence[Path], i: int, seed: int, width: int, good: bool) -> Pair:
    rng = np.random.default_rng([seed, i, int(good)])
    texture = TEXTURES[i % len(TEXTURES)]
    far = (i // len(TEXTURES)) % 2 == 1
    told = (i // (2 * len(TEXTURES))) % 2 == 0
    height = 3 * width // 4
    wall = _wall(texture, photos, rng, (3 * width, 3 * height))
    turning = turnings[i % len(turnings)]
    focal = 0.8 * width
    gain = float(np.exp(rng.uniform(np.log(4), np.log(30))))
    long_s = float(np.exp(rng.uniform(np.log(0.03), np.log(0.1))))
    short, long = _moments(turning, rng, focal, width, gain, long_s, FAR if far else NEAR)
    camera = TurningCamera(wall=wall, wall_from_world=np.eye(3), turning=turning, size=(width, height), focal_px=focal)
    camera = replace(camera, wall_from_world=camera.facing(short, long))
    noise = float(np.exp(rng.uniform(np.log(0.02), np.log(0.12))))
    brief = camera.frame(short, 8)
    if not good:
        wall = _wall(TEXTURES[rng.integers(len(TEXTURES))], photos, rng, (3 * width, 3 * height))
        camera = replace(camera, wall=wall)
    late = camera.frame(long, 64, moved=_parallax(rng, width) if good else None)
    tint = (1 + 0.04 * rng.standard_normal(3)).astype(np.float32)
    kind = f"{texture}, {'far' if far else 'near'}{'' if told else ', no gyroscope'}"
    return Pair(
        kind=kind,
        short=_filmed(tint * brief, 1 / gain, noise, gain, rng),
        long=_filmed(late, 1.0, noise, gain, rng),
        truth=codes(brief),
        gyro=_gyro(turning, short, long, camera, rng) if told else None,
        gain=gain,
        good=good,
        shift_px=_shift(camera, short, long),
    )


def _filmed(light: Float32Array, gathered: float, noise: float, gain: float, rng: np.random.Generator) -> UInt8Array:
    """Of one sensor: at half of full scale of the brightened short exposure, the noise is ``noise``."""
    variance = 0.5 * noise**2 * (1 / gain**2 + np.clip(gathered * light, 0, 1) / (0.5 * gain))
    grain = np.sqrt(variance) * rng.standard_normal(light.shape, dtype=np.float32)
    return codes(gathered * light + grain.astype(np.float32))


def _moments(
    turning: Turning,
    rng: np.random.Generator,
    focal: float,
    width: int,
    gain: float,
    long_s: float,
    wanted: tuple[float, float],
) -> tuple[Moment, Moment]:
    """A short and a long exposure between which the camera turns as far as wanted, and the long one is blurred."""
    for _ in range(4000):
        t_s = float(rng.uniform(turning.t_s[0] + 1, turning.t_s[-1] - 1))
        delay_s = float(rng.uniform(0.005, 0.3 if wanted is FAR else 0.05))
        short = Moment(t_s=t_s, exposure_s=long_s / gain, readout_s=READOUT_S)
        long = Moment(t_s=t_s + long_s / gain + delay_s, exposure_s=long_s, readout_s=READOUT_S)
        ends = np.array([short.t_s, long.t_s, long.t_s + long_s]) + 0.5 * READOUT_S
        looking = turning.world_from_cam(np.append(ends, long.t_s + 0.5 * (long_s + READOUT_S)))

        def apart_px(a: int, b: int, looking: Array = looking) -> float:
            forward = looking[a].T @ looking[b][:, 2]
            return float(focal * np.hypot(*forward[:2]) / max(forward[2], 0.1))

        if wanted[0] <= apart_px(0, 3) / width <= wanted[1] and 3 < apart_px(1, 2) < 0.05 * width:
            return short, long
    raise ValueError("no such motion in this recording")


def _parallax(rng: np.random.Generator, width: int) -> Callable[[Array, Array], tuple[Array, Array]]:
    """The wall's parts at depths of their own, of up to half a percent of the width: a smooth change and an edge."""
    angle, phase = rng.uniform(0, 2 * np.pi, 2)
    much = rng.uniform(0, 0.005) * width
    length = rng.uniform(0.5, 1.5) * width
    cos, sin = np.cos(angle), np.sin(angle)

    def moved(u: Array, v: Array) -> tuple[Array, Array]:
        depth = 0.5 * np.sin(2 * np.pi * (cos * u + sin * v) / length + phase)
        return u + much * cos * depth, v + much * sin * depth

    return moved


def _gyro(turning: Turning, short: Moment, long: Moment, camera: TurningCamera, rng: np.random.Generator) -> PairGyro:
    width, height = camera.size
    model = CameraModel(
        model="PINHOLE", width=width, height=height, params=(camera.focal_px, camera.focal_px, width / 2, height / 2)
    )
    near = (turning.t_s > short.t_s - 1) & (turning.t_s < long.t_s + 1)
    rate = turning.rate_rad_s[near]
    rate = rate + _GYRO_NOISE_RAD_S * rng.standard_normal(rate.shape)
    path = GyroPath(turning.t_s[near], rate, np.zeros(3))
    late_s = float(_LATE_S * rng.standard_normal())
    shutters = [
        FrameShutter(width=width, height=height, t_s=m.t_s, exposure_s=m.exposure_s, readout_s=m.readout_s)
        for m in (short, long)
    ]
    motion = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0, 0, 0, 1.0]), offset_s=late_s)
    return PairGyro(motion=motion, camera=colmap_camera(model), short=shutters[0], long=shutters[1])


def _shift(camera: TurningCamera, short: Moment, long: Moment) -> Array:
    width, height = camera.size
    nodes = np.stack(np.meshgrid(np.arange(0.0, width, 16), np.arange(0.0, height, 16)), axis=-1)
    found = camera.transferred(nodes.reshape(-1, 2), short, long)
    return (found - nodes.reshape(-1, 2)).reshape(nodes.shape)


# --- scenes -----------------------------------------------------------------------------------------------------------


def _wall(texture: str, photos: Sequence[Path], rng: np.random.Generator, size: tuple[int, int]) -> Float32Array:
    """(H, W, 3) linear light."""
    width, height = size
    side = max(size) // 4
    if texture == "one photograph":
        wall = _piece(photos, rng, (width, height))
    elif texture == "repeated":
        period = int(rng.integers(48, 120))
        tile = _piece(photos, rng, (period, period))
        wall = np.tile(tile, (-(-height // period), -(-width // period), 1))[:height, :width].copy()
        # no wall is the same everywhere
        wall *= 1 + 0.25 * _smooth(rng, size, 0.1 * width)[..., None]
        wall += 0.03 * np.maximum(_smooth(rng, size, 4.0), 0)[..., None]
    else:
        patches = [_piece(photos, rng, (side, side)) for _ in range(12)]
        wall = np.vstack([np.hstack(patches[4 * r : 4 * r + 4]) for r in range(3)])[:height, :width]
    if texture == "low texture":
        # a wall, a ceiling: little contrast, and that coarse
        coarse = cv2.GaussianBlur(wall, (0, 0), 3.0)
        wall = coarse.mean() + rng.uniform(0.08, 0.2) * (coarse - coarse.mean())
    wall = wall * (rng.uniform(0.25, 0.45) / wall.mean())
    if texture == "clipping":
        wall = wall * rng.uniform(2.0, 4.0)
    if texture == "dark":
        wall = wall * rng.uniform(0.1, 0.25)
    if texture in ("speckled", "dark"):
        # glints and lamps: small, bright, and everywhere
        for _ in range(int(rng.integers(300, 1500)) if texture == "speckled" else 40):
            x, y, r = rng.integers(width), rng.integers(height), int(rng.integers(1, 4))
            cv2.circle(wall, (int(x), int(y)), r, (8.0, 7.0, 6.0), -1)
    return np.ascontiguousarray(np.maximum(wall, 0), dtype=np.float32)


def _smooth(rng: np.random.Generator, size: tuple[int, int], sigma: float) -> Float32Array:
    """Noise of unit deviation, smooth at so many pixels."""
    step = max(1, int(sigma / 3))
    small = rng.standard_normal((size[1] // step + 2, size[0] // step + 2)).astype(np.float32)
    small = cv2.GaussianBlur(small, (0, 0), sigma / step)
    out = cv2.resize(small / small.std(), size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(out, dtype=np.float32)


def _piece(photos: Sequence[Path], rng: np.random.Generator, size: tuple[int, int]) -> Float32Array:
    width, height = size
    if not photos:
        layers = [sum(s**0.9 * _smooth(rng, size, s) for s in (1.2, 3.0, 8.0, 20.0)) for _ in range(3)]
        light = np.stack([0.8 * layers[0] + 0.4 * layer for layer in layers], axis=-1)
        for _ in range(12):
            x, y, w, h = rng.integers(0, width), rng.integers(0, height), *rng.integers(8, max(9, width // 3), 2)
            light[y : y + h, x : x + w] += rng.normal(0, 0.8 * light.std(), 3)
        return np.asarray(0.25 * np.exp(0.55 * light / light.std()), dtype=np.float32)
    picture = cv2.imread(str(photos[rng.integers(len(photos))]), cv2.IMREAD_COLOR_RGB)
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows, min(1.0, rng.uniform(0.6, 1.2)))
    taken = (min(columns, int(width / scale)), min(rows, int(height / scale)))
    left, top = rng.integers(columns - taken[0] + 1), rng.integers(rows - taken[1] + 1)
    part = picture[top : top + taken[1], left : left + taken[0]]
    part = cv2.resize(part, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    return linear_from_srgb(part / 255).astype(np.float32)
