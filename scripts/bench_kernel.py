"""Speed and quality of the deblurring filter on one core, against the usual ways, in one run.

Prints JSON: the time of a grey 1920x1080 frame, 8 bit to 8 bit; the share of the processor's peak that the filter
reaches, the peak measured in the same run; PSNR and time of a Wiener filter with 2-D kernels in blocks and of ten
Richardson-Lucy iterations on the same frame.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from colmap_inertial._kernels import _wiener
from colmap_inertial.imaging import wiener
from colmap_inertial.imaging._transfer import decode_table, linear_from_srgb, srgb_from_linear
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.wiener import DeblurOptions, deblur
from colmap_inertial.simulate.textures import poster

HEIGHT, WIDTH = 1080, 1920
BLOCK_PX = 64

Image = NDArray[np.uint8]
Light = NDArray[np.float32]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", type=Path, help="a sharp picture, scaled to cover the frame (default: a drawn one)")
    parser.add_argument("--length", type=float, default=20.0, help="blur, px")
    parser.add_argument("--angle", type=float, default=20.0, help="of the blur to the rows, degrees")
    parser.add_argument("--noise", type=float, default=0.01, help="standard deviation of the codes, full scale = 1")
    parser.add_argument("--repeat", type=int, default=15, help="the best of so many runs counts")
    args = parser.parse_args()
    cv2.setNumThreads(1)

    angle = np.deg2rad(args.angle)
    vector_px = (args.length * float(np.cos(angle)), args.length * float(np.sin(angle)))
    sharp = sharp_frame(args.image)
    blurred = blur(sharp, vector_px, args.noise)
    field = BlurField.uniform(WIDTH, HEIGHT, vector_px)
    noise = wiener.estimate_noise(blurred, "x" if abs(vector_px[0]) >= abs(vector_px[1]) else "y")
    point_spread = line(vector_px)
    kernel = wiener_kernel(point_spread)

    one = DeblurOptions(threads=1)
    methods: dict[str, tuple[Callable[[], Image], int]] = {
        "blurred": (lambda: blurred, 1),
        "directional": (lambda: deblur(blurred, field, one), args.repeat),
        "blockwise_2d": (lambda: blockwise(blurred, kernel), 3),
        "richardson_lucy_10": (lambda: richardson_lucy(blurred, point_spread, 10), 1),
    }
    results = {}
    for name, (run, repeat) in methods.items():
        seconds, result = best_of(run, repeat)
        results[name] = {"ms": round(1e3 * seconds, 2), "psnr_db": round(psnr(result, sharp), 2)}
    ours = results["directional"]["ms"]
    report = {
        "machine": platform.processor() or platform.machine(),
        "frame": [WIDTH, HEIGHT],
        "blur_px": vector_px,
        "noise_estimated": noise,
        "methods": results,
        "times_faster_than_blockwise_2d": round(results["blockwise_2d"]["ms"] / ours, 1),
        "times_faster_than_richardson_lucy_10": round(results["richardson_lucy_10"]["ms"] / ours, 1),
        "instruction_sets": {name: roofline(blurred, field, name, args.repeat) for name in _wiener.instruction_sets()},
    }
    print(json.dumps(report, indent=2))


def roofline(image: Image, field: BlurField, name: str, repeat: int) -> dict[str, float]:
    """Times of the stages, ms, and the multiply-adds a second as a share of the processor's peak.

    The filter is timed on light that needs no decoding, less the time of the same pass with a single tap: what is left
    is the filter and not the copying in and out.
    """
    planes, cells, prior = wiener._prepare(image, field, DeblurOptions())
    table = wiener._table(cells, prior)
    single = wiener.TapTable(first=table.first, weights=table.weights, reach=np.zeros_like(table.reach))
    light = decode_table(image.dtype)[planes]
    row, _ = table.at(cells.extent_px)
    taps = 2 * table.reach[row + 1] + 1
    # Two multiply-adds a tap and pixel (two rows, or columns, are interpolated), one in the middle.
    count = float(np.mean(2 * taps - 1)) * cells.extent_px.size * 256

    def seconds(what: NDArray, taps: wiener.TapTable) -> tuple[float, float]:
        runs = [wiener._compiled(what, cells, taps, threads=1, instruction_set=name)[1] for _ in range(repeat)]
        decode_s, filter_s = np.min(runs, axis=0)
        return decode_s, filter_s

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


def sharp_frame(path: Path | None) -> Image:
    """A grey frame."""
    if path is None:
        light = poster(np.random.default_rng(1), HEIGHT, WIDTH)[..., 1]
        return np.round(255 * srgb_from_linear(0.9 * light)).astype(np.uint8)
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise SystemExit(f"bench_kernel: cannot read {path}")
    scale = max(HEIGHT / picture.shape[0], WIDTH / picture.shape[1])
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=method)[:HEIGHT, :WIDTH]


def blur(sharp: Image, vector_px: tuple[float, float], noise: float) -> Image:
    """What the moving camera records: light averaged along the line, encoded, with noise."""
    light = linear_from_srgb(sharp / 255).astype(np.float32)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    steps = int(3 * np.hypot(*vector_px)) + 3
    total = np.zeros_like(light)
    for s in ((np.arange(steps) + 0.5) / steps - 0.5).tolist():
        shifted = x + np.float32(s * vector_px[0]), y + np.float32(s * vector_px[1])
        total += cv2.remap(light, *shifted, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    codes = srgb_from_linear(total / steps) + noise * np.random.default_rng(0).standard_normal(light.shape)
    return np.round(255 * np.clip(codes, 0, 1)).astype(np.uint8)


def line(vector_px: tuple[float, float]) -> Light:
    """The point spread function on whole pixels."""
    radius = int(np.ceil(np.hypot(*vector_px) / 2)) + 1
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    spread = np.zeros(y.shape)
    for s in np.linspace(-0.5, 0.5, 400):
        spread += np.clip(1 - np.abs(x - s * vector_px[0]), 0, 1) * np.clip(1 - np.abs(y - s * vector_px[1]), 0, 1)
    return np.asarray(spread / spread.sum(), dtype=np.float32)


def wiener_kernel(spread: Light, noise_to_signal: float = 0.01) -> Light:
    """The 2-D Wiener filter of the published schemes, cut to twice the size of the point spread function."""
    n = 256
    spectrum = np.fft.fft2(np.fft.ifftshift(np.pad(spread, [((n - s) // 2 + 1, (n - s) // 2) for s in spread.shape])))
    inverse = np.fft.fftshift(np.fft.ifft2(np.conj(spectrum) / (np.abs(spectrum) ** 2 + noise_to_signal)).real)
    reach = spread.shape[0]
    kernel = inverse[n // 2 - reach : n // 2 + reach + 1, n // 2 - reach : n // 2 + reach + 1]
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def blockwise(image: Image, kernel: Light) -> Image:
    """Filter blocks of 64 px, each with a kernel (here the same one: making kernels is not counted)."""
    reach = kernel.shape[0] // 2
    light = cv2.LUT(image, decode_table(np.dtype(np.uint8)))
    padded = cv2.copyMakeBorder(light, reach, reach, reach, reach, cv2.BORDER_REFLECT_101)
    result = np.empty_like(light)
    for top in range(0, HEIGHT, BLOCK_PX):
        for left in range(0, WIDTH, BLOCK_PX):
            part = padded[top : top + BLOCK_PX + 2 * reach, left : left + BLOCK_PX + 2 * reach]
            filtered = cv2.filter2D(part, -1, kernel, borderType=cv2.BORDER_ISOLATED)
            result[top : top + BLOCK_PX, left : left + BLOCK_PX] = filtered[reach:-reach, reach:-reach]
    return encoded(result)


def richardson_lucy(image: Image, spread: Light, iterations: int) -> Image:
    """As scikit-image has it: FFT convolutions, from a flat start."""
    light = cv2.LUT(image, decode_table(np.dtype(np.uint8)))
    estimate = np.full_like(light, 0.5)
    mirrored = spread[::-1, ::-1]
    for _ in range(iterations):
        ratio = light / (fftconvolve(estimate, spread, mode="same") + 1e-12)
        estimate *= fftconvolve(ratio, mirrored, mode="same")
    return encoded(estimate)


def encoded(light: Light) -> Image:
    """8-bit codes, through a table of 16 bits."""
    index = cv2.multiply(np.clip(light, 0, 1), 16384.0).astype(np.uint16)
    return TO_CODE[index]


TO_CODE = np.round(255 * srgb_from_linear(np.arange(16385) / 16384)).astype(np.uint8)


def best_of(run: Callable[[], Image], repeat: int) -> tuple[float, Image]:
    """Least processor time of several runs, seconds, and the result; one more run before, which fills the caches."""
    result = run()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times), result


def psnr(image: Image, truth: Image, margin: int = 30) -> float:
    inside = (slice(margin, -margin),) * 2
    return float(10 * np.log10(255**2 / np.mean((image[inside].astype(np.float64) - truth[inside]) ** 2)))


if __name__ == "__main__":
    main()
