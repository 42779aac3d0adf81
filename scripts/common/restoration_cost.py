"""What DeepGyro costs on a 1080p frame in colour: time and memory, against the Wiener filter and COLMAP's SIFT."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import DeblurOptions, path_wiener
from colmap_inertial.imaging.restoration import deepgyro, load_network
from scripts.common.imaging_metrics import extract
from scripts.common.imaging_scenes import Pair
from scripts.common.restoration_weights import use_weights

THREADS = 2


def measure(pair: Pair, weights: Sequence[Path], repeat: int) -> dict[str, Any]:
    """Least wall time of several runs, processor time of that run, and memory."""
    image, blur = pair.frame(0), pair.blur(0)
    path = BlurPath.straight(blur)
    network = load_network("deepgyro", device="cpu", threads=THREADS)
    options = DeblurOptions(threads=THREADS)
    filtered = path_wiener(image, path, options)
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "network": (lambda: network.restore(image, filtered, path), repeat),
        "DeepGyro": (lambda: deepgyro.deblur(image, path, network=network), repeat),
        "Wiener": (lambda: path_wiener(image, path, options), 3 * repeat),
        "COLMAP's SIFT": (lambda: extract(image, -1), 1),
    }
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        mib = pool.submit(_memory_mib, image, path, list(weights)).result()
    return {
        "size": list(image.shape[1::-1]),
        "threads": THREADS,
        "load_average": round(os.getloadavg()[0], 1),
        "blur_px": round(float(np.percentile(blur.extent_px(), 90)), 1),
        "times": {name: dict(zip(("wall_s", "cpu_s"), least_s(*run), strict=True)) for name, run in runs.items()},
        "mib": mib,
    }


def least_s(run: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Wall and processor time of the fastest of several runs, after one that fills caches."""
    run()
    times = []
    for _ in range(repeat):
        wall, processor = time.perf_counter(), time.process_time()
        run()
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    return min(times)


def _memory_mib(image: UInt8Array, path: BlurPath, weights: list[Path]) -> dict[str, float] | None:
    """In a process of its own: what is in use before a frame is deblurred, and at most while it is."""
    if not Path("/proc/self/status").exists():
        return None
    with TemporaryDirectory() as folder:
        if weights:
            use_weights(weights, Path(folder))
        network = load_network("deepgyro", device="cpu", threads=THREADS)
        before = _resident_mib("VmRSS")
        deepgyro.deblur(image, path, network=network)
    return {"before": before, "peak": _resident_mib("VmHWM")}


def _resident_mib(which: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(round(int(line.split()[1]) / 1024) for line in lines if line.startswith(which + ":"))
