"""The filters along paths by instruction set, beside what Fourier transforms of SciPy and OpenCV alone take.

    python -m scripts.benchmarks.transforms [--repeat N]

A grey 1080p picture, one thread, processor time, the least of several in turn: both filters with each instruction set
that the processor has; and for each tile of the same tiling one real transform and its inverse by ``scipy.fft``
(pocketfft) and by ``cv2.dft``, without anything that a filter does in between. Ratios are to `wiener` with the best.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
import scipy.fft
from rich.console import Console

from colmap_inertial._kernels import _path
from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.imaging._tiles import TiledPaths, Tiling
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import FILTER_MODEL, Noise, filter_along
from scripts.common.imaging_tables import table_of

SIZE, BLURS_PX = (1920, 1080), (10.0, 20.0, 60.0)
NOISE = (Noise(1e-5, 0.0),)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    repeat = parser.parse_args().repeat
    cv2.setNumThreads(1)
    light = np.random.default_rng(0).random((*SIZE[::-1], 1), dtype=np.float32)
    for blur_px in BLURS_PX:
        path = BlurPath.straight(BlurField.uniform(*SIZE, (0.9 * blur_px, 0.43 * blur_px)))
        tiling = Tiling.covering(*SIZE, path.extent_px())
        ms = least_ms(ways(light, path, tiling), repeat)
        best = ms[f"wiener, {_path.instruction_sets()[-1]}"]
        count = tiling.count[0] * tiling.count[1]
        table = table_of(f"{blur_px:g} px, {count} tiles of {tiling.side} px", "way", "ms", "times wiener")
        for name, value in ms.items():
            table.add_row(name, f"{value:.1f}", f"{value / best:.2f}")
        Console().print(table)


def ways(light: Float32Array, path: BlurPath, tiling: Tiling) -> dict[str, Callable[[], object]]:
    """What is timed, by name."""
    paths = TiledPaths(tiling.paths(path), tiling.spreads(path))
    tiles = [light[: tiling.side, : tiling.side, 0].copy() for _ in range(tiling.count[0] * tiling.count[1])]
    inverse = cv2.DFT_INVERSE | cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE
    out: dict[str, Callable[[], object]] = {
        "transforms alone, SciPy": lambda: [scipy.fft.irfft2(scipy.fft.rfft2(tile)) for tile in tiles],
        "transforms alone, OpenCV": lambda: [cv2.dft(cv2.dft(tile), flags=inverse) for tile in tiles],
    }
    for name in _path.instruction_sets():
        for method, splitting in (("wiener", ()), ("path", FILTER_MODEL.splitting)):
            out[f"{method}, {name}"] = lambda name=name, splitting=splitting: filter_along(
                light, tiling, paths, NOISE, splitting, threads=1, instruction_set=name
            )
    return out


def least_ms(ways: dict[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Least processor time of each; all take turns."""
    least = dict.fromkeys(ways, np.inf)
    for _ in range(repeat):
        for name, run in ways.items():
            begin = time.thread_time()
            run()
            least[name] = min(least[name], 1e3 * (time.thread_time() - begin))
    return least


if __name__ == "__main__":
    main()
