"""What deblurring a grey 1080p frame costs: processor time on one core, against other ways and the core's own peak."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from colmap_inertial._kernels import _wiener
from colmap_inertial.core.arrays import AnyArray, UInt8Array
from colmap_inertial.imaging import wiener
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.evidence import blur_evidence
from colmap_inertial.imaging.gate import judge_recording
from colmap_inertial.imaging.transfer import decode_table
from colmap_inertial.imaging.wiener import DeblurOptions, deblur
from scripts.common import imaging_baselines as baselines
from scripts.common.gated_deblur import deblur_gated
from scripts.common.imaging_metrics import extract
from scripts.common.imaging_scenes import Pair


def measure(pairs: Sequence[Pair], repeat: int = 15) -> dict[str, Any]:
    """Times in ms of one frame, 8 bit to 8 bit; the shares of the peak; what COLMAP takes.

    Of the first frames, that counts whose blur is longest in the median: where the camera rolls, the middle is sharp.
    """
    pair = max(pairs, key=lambda one: float(np.median(one.blur(0).extent_px())))
    image, blur = pair.frame(0), pair.blur(0)
    middle = blur.vector_px[blur.vector_px.shape[0] // 2, blur.vector_px.shape[1] // 2]
    spread = baselines.line((float(middle[0]), float(middle[1])))
    one = DeblurOptions(threads=1)
    verdict = judge_recording([blur_evidence(image, blur)] * 3)
    ways: dict[str, tuple[Callable[[], object], int]] = {
        "directional": (lambda: deblur(image, blur, one), repeat),
        "directional_gated": (
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
    ours = ms["directional"]
    return {
        "blur_px": round(float(np.percentile(blur.extent_px(), 90)), 1),
        "median_blur_px": round(float(np.median(blur.extent_px())), 1),
        "ms_cpu": ms,
        "times_faster": {
            name: round(value / ours, 1) for name, value in ms.items() if not name.startswith("directional")
        },
        "share_of_colmap_sift": round(ours / ms["colmap_sift"], 5),
        "share_of_colmap_sift_gated": round(ms["directional_gated"] / ms["colmap_sift"], 5),
        "instruction_sets": {name: roofline(image, blur, name, repeat) for name in _wiener.instruction_sets()},
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


def roofline(image: UInt8Array, blur: BlurField, name: str, repeat: int) -> dict[str, float]:
    """Times of the stages, ms, and the multiply-adds a second as a share of the processor's peak.

    The filter is timed on light that needs no decoding, less the time of the same pass with a single tap: what is left
    is the filter and not the copying in and out. The peak is that of a loop of independent multiply-adds, just before.
    """
    planes, cells, noise = wiener._prepare(image, blur, DeblurOptions())
    table = wiener._table(cells, noise)
    single = wiener.TapTable(
        first=table.first, weights=table.weights, reach=np.zeros_like(table.reach), smoothing=table.smoothing
    )
    light = decode_table(image.dtype)[planes]
    row, _ = table.at(cells.extent_px)
    taps = 2 * table.reach[row + 1] + 1
    # Two multiply-adds a tap and pixel (two rows, or columns, are interpolated), one in the middle.
    count = float(np.mean(2 * taps - 1)) * cells.extent_px.size * 256

    def seconds(what: AnyArray, with_taps: wiener.TapTable) -> Any:
        runs = [wiener._compiled(what, cells, with_taps, threads=1, instruction_set=name)[1] for _ in range(repeat)]
        return np.min(runs, axis=0)

    peak = _wiener.peak_multiply_adds(name)
    decode_s, encode_s = seconds(planes, table)
    filter_s = seconds(light, table)[1] - seconds(light, single)[1]
    return {
        "decode_ms": round(1e3 * decode_s, 2),
        "filter_and_encode_ms": round(1e3 * encode_s, 2),
        "filter_ms": round(1e3 * filter_s, 2),
        "peak_gflops": round(2e-9 * peak, 1),
        "share_of_peak": round(count / filter_s / peak, 3),
        "share_of_peak_with_encoding": round(count / encode_s / peak, 3),
    }
