"""What deblurring a grey 1080p frame costs: processor time on one core, against other ways."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from colmap_inertial.imaging.evidence import blur_evidence
from colmap_inertial.imaging.gate import judge_recording
from colmap_inertial.imaging.path_filters import DeblurOptions, deblur
from scripts.common import imaging_baselines as baselines
from scripts.common.gated_deblur import deblur_gated
from scripts.common.imaging_metrics import extract
from scripts.common.imaging_scenes import Pair


def measure(pairs: Sequence[Pair], repeat: int = 15) -> dict[str, Any]:
    """Times in ms of one frame, 8 bit to 8 bit; what COLMAP takes.

    Of the first frames, that counts whose blur is longest in the median: where the camera rolls, the middle is sharp.
    """
    pair = max(pairs, key=lambda one: float(np.median(one.blur(0).extent_px())))
    image, blur = pair.frame(0), pair.blur(0)
    middle = blur.vector_px[blur.vector_px.shape[0] // 2, blur.vector_px.shape[1] // 2]
    spread = baselines.line((float(middle[0]), float(middle[1])))
    one = DeblurOptions(threads=1)
    verdict = judge_recording([blur_evidence(image, blur)] * 3)
    ways: dict[str, tuple[Callable[[], object], int]] = {
        "wiener": (lambda: deblur(image, blur, one), repeat),
        "wiener_gated": (
            lambda: deblur_gated(image, blur, recording=verdict, deblur=lambda i, b: deblur(i, b, one)),
            repeat,
        ),
        "spatial_wiener_2d": (lambda: baselines.spatial_wiener(image, blur), 3),
        "fourier_wiener": (lambda: baselines.fourier_wiener(image, blur), 3),
        "richardson_lucy_one_psf": (lambda: baselines.richardson_lucy(image, spread), 1),
        "richardson_lucy_blocks": (lambda: baselines.richardson_lucy_blocks(image, blur), 1),
        "colmap_sift": (lambda: extract(image, -1), 2),
    }
    ms = {name: round(1e3 * least_cpu_s(run, count), 2) for name, (run, count) in ways.items()}
    ours = ms["wiener"]
    return {
        "blur_px": round(float(np.percentile(blur.extent_px(), 90)), 1),
        "median_blur_px": round(float(np.median(blur.extent_px())), 1),
        "ms_cpu": ms,
        "times_faster": {
            name: round(value / ours, 1) for name, value in ms.items() if name not in ("wiener", "wiener_gated")
        },
        "share_of_colmap_sift": round(ours / ms["colmap_sift"], 5),
        "share_of_colmap_sift_gated": round(ms["wiener_gated"] / ms["colmap_sift"], 5),
    }


def least_cpu_s(run: Callable[[], object], repeat: int) -> float:
    """Least processor time of several runs, after one that fills the caches."""
    run()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)
