"""Colour frames deblurred as luma and half chroma, against each channel by itself: cost and PSNR, side by side.

For ``scripts.benchmarks.path --only colour``. The other way is what the package did before: all three channels at full
size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.imaging._cells import Cells
from colmap_inertial.imaging._tiles import TiledPaths, Tiling
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import (
    FILTER_MODEL,
    DeblurOptions,
    blend_where_blurred,
    filter_along,
    half_quadratic,
    noise_along,
    path_wiener,
)
from colmap_inertial.imaging.psf import blur_path
from colmap_inertial.imaging.transfer import linearise, srgb_from_linear
from scripts.common import imaging_metrics as metrics
from scripts.common.imaging_scenes import photographed_walls
from scripts.common.path_methods import COST_SIZE, with_blur
from scripts.common.path_scenes import FOCAL, HELD_OUT, JPEG, NOISE, READOUT_S, Pair
from scripts.common.turning_world import Moment, Turning, TurningCamera
from scripts.restoration.photographs import photographs

#: Blurs, px, and walls, of which each is seen at one instant.
BLURS_PX, WALLS = (10.0, 20.0, 30.0), 3
_COST_PX, _REPEAT = 20.0, 7


def _each_channel(image: UInt8Array, path: BlurPath, splitting: tuple[float, ...], threads: int) -> UInt8Array:
    tiling = Tiling.covering(path.width, path.height, path.extent_px())
    paths, light = tiling.paths(path), linearise(image)
    noise = noise_along(light, tiling, paths, threads)
    sharp = filter_along(light, tiling, TiledPaths(paths, tiling.spreads(path)), noise, splitting, threads=threads)
    return blend_where_blurred(image, sharp, Cells.of(path.field()), threads)


WAYS: Mapping[str, tuple[Callable[..., UInt8Array], tuple[float, ...]]] = {
    "wiener": (path_wiener, ()),
    "path": (half_quadratic, FILTER_MODEL.splitting),
}


def colour(photos: Path, motion: Path | None, size: tuple[int, int], seed: int, *, console: Console) -> dict[str, Any]:
    """By method: PSNR gained at each blur, and milliseconds of processor and of the clock for a 1080p frame."""
    frames = [
        _frame(photos, motion, size, seed, wall, blur)
        for blur in track(BLURS_PX, "colour", console=console)
        for wall in range(WALLS)
    ]
    large, _, path = _frame(photos, motion, COST_SIZE, seed, 0, _COST_PX)
    out: dict[str, Any] = {}
    for name, (now, splitting) in WAYS.items():
        ways: dict[str, Callable[[UInt8Array, BlurPath, int], UInt8Array]] = {
            "each channel": lambda image, path, threads, s=splitting: _each_channel(image, path, s, threads),
            "luma and chroma": lambda image, path, threads, f=now: f(image, path, DeblurOptions(threads=threads)),
        }
        for way, work in ways.items():
            gained = [
                metrics.psnr_db(work(image, path, 1), sharp) - metrics.psnr_db(image, sharp)
                for image, sharp, path in frames
            ]
            row: dict[str, Any] = {
                f"{blur:g} px": float(np.mean(gained[WALLS * i : WALLS * (i + 1)])) for i, blur in enumerate(BLURS_PX)
            }
            out[f"{name}, {way}"] = row
        # in turn, so that whatever else the machine does strikes both alike
        for threads in (1, 2):
            took = {way: (np.inf, np.inf) for way in ways}
            for _ in range(_REPEAT):
                for way, work in ways.items():
                    begin = time.process_time(), time.perf_counter()
                    work(large, path, threads)
                    spent = time.process_time() - begin[0], time.perf_counter() - begin[1]
                    took[way] = min(took[way][0], spent[0]), min(took[way][1], spent[1])
            for way, (cpu_s, wall_s) in took.items():
                out[f"{name}, {way}"] |= {f"cpu_ms_{threads}": 1e3 * cpu_s, f"wall_ms_{threads}": 1e3 * wall_s}
    return out


def _frame(
    photos: Path, motion: Path | None, size: tuple[int, int], seed: int, wall: int, blur_px: float
) -> tuple[UInt8Array, UInt8Array, BlurPath]:
    """As filmed, without blur, and the path."""
    turning = Turning.simulated(seed) if motion is None else Turning.recorded(motion, HELD_OUT)
    walls = photographed_walls(photographs(photos, held_out=True), WALLS, seed, colour=True)
    t_s = turning.t_s[0] + (0.2 + 0.3 * wall) * (turning.t_s[-1] - turning.t_s[0])
    camera = TurningCamera(
        wall=walls[wall], wall_from_world=np.eye(3), turning=turning, size=size, focal_px=FOCAL * size[0]
    )
    moment = with_blur(camera, Moment(t_s=float(t_s), exposure_s=0.016, readout_s=READOUT_S), blur_px)
    camera = replace(camera, wall_from_world=camera.facing(moment))
    pair = Pair(camera=camera, moments=(moment, moment), blur_px=blur_px, seed=seed, cache=None)
    light = camera.frame(moment, max(60, int(2 * blur_px)))
    noise = np.random.default_rng([seed, wall]).standard_normal(light.shape, dtype=np.float32)
    noisy = _codes(light + NOISE * np.sqrt(0.5 + np.clip(light, 0, 1)) * noise)
    data = cv2.imencode(".jpg", np.ascontiguousarray(noisy[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG])[1]
    image = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return image, _codes(camera.frame(moment, 1)), blur_path(*pair.known(0, "exact"))


def _codes(light: np.ndarray[Any, np.dtype[np.float32]]) -> UInt8Array:
    return np.asarray(np.rint(255 * srgb_from_linear(np.clip(light, 0, 1))), dtype=np.uint8)
