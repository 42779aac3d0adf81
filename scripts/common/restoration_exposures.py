"""LSD2 against what else can be made of a short, noisy and a long, blurred exposure.

Both are simulated as a camera takes them, one right after the other, in 8 bits, and brought together by the package
(brightness, geometry, blur) with a gyroscope that has the usual errors. So what is left of misalignment, of colour and
of wrong gain is what the package leaves. Every row of the table starts from that pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import AnyArray, Float32Array, UInt8Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.exposure_pairs import (
    ExposurePair,
    PairGyro,
    blur_seen_from_short,
    brightened,
    bring_together,
    fuse_mertens,
    gyro_shift,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.imaging.path_filters import deblur
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.imaging.restoration import Network
from colmap_inertial.imaging.restoration.lsd2 import fuse
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.tools.simulate.render import colmap_camera
from scripts.common.imaging_metrics import correct_matches, extract, psnr_db, ssim
from scripts.common.imaging_scenes import GyroErrors, Pair, erred, make_pairs
from scripts.common.restoration_deblur import PERFECT, usual_errors

SIZE = (960, 720)
LONG_S = 0.06
#: From the end of the short exposure to the beginning of the long one.
BETWEEN_S = 0.005
#: Blur of the long exposure, px, and its time as a multiple of the short one's, scene after scene.
BLURS_PX, RATIOS = (10.0, 17.5, 25.0), (8.0, 11.0, 16.0)
#: Of the short exposure once it is as bright as the long one: at half of full scale, of full scale, in linear light.
NOISES = (0.03, 0.06, 0.12)
#: Half of the noise's variance there is read noise, the rest is that of photons.
READ_SHARE = 0.5
COLOUR_DIFFERENCE = 0.04
#: Scenes are so much brighter than the photographs, and lamps in them (what is nearly white) by so much more.
BRIGHTER, LAMPS = 1.15, 4.0
NLM_STRENGTHS = (3.0, 6.0, 10.0, 15.0, 20.0, 27.0, 35.0)
#: Strengths are compared on the middle of every scene.
_NLM_CROP = (360, 480)
BASELINES = ("short", "long", "non-local means on short", "Wiener on long")


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposures:
    """A short and a long exposure as filmed, and what is true.

    Attributes
    ----------
    pair
        The short exposure as its first frame, a view from elsewhere as the second one.
    short, long
        (H, W, 3)
    truth
        The short one without noise and blur, as bright as the long one.
    view
        The second frame, likewise.
    errors
        Of the gyroscope.
    ratio
        Of the exposure times.
    """

    pair: Pair
    long_shutter: FrameShutter
    short: UInt8Array
    long: UInt8Array
    truth: UInt8Array
    view: UInt8Array
    errors: GyroErrors
    ratio: float

    def gyro(self, errors: GyroErrors) -> PairGyro:
        """The gyroscope's part in bringing the two together."""
        camera = colmap_camera(self.pair.model)
        return PairGyro(
            motion=self.pair.gyro(errors), camera=camera, short=self.pair.shutters[0], long=self.long_shutter
        )

    def together(self, *, gyro: bool = True) -> ExposurePair:
        """As the package brings them together."""
        joined = bring_together(
            self.short, self.long, gyro=self.gyro(self.errors) if gyro else None, stated_gain=self.ratio
        )
        return joined if joined.blur is None else replace(joined, blur=erred(joined.blur, self.errors))

    def true_blur(self) -> BlurField:
        """Of the long exposure in the short one's geometry."""
        exact = self.gyro(PERFECT)
        shift = gyro_shift(exact.motion, exact.camera, exact.short, exact.long)
        return blur_seen_from_short(blur_field(exact.motion, exact.camera, exact.long), shift)


def expose(
    wall: Float32Array,
    blur_px: float,
    ratio: float,
    noise: float,
    errors: GyroErrors,
    *,
    size: tuple[int, int],
    seed: int,
) -> Exposures:
    """Two exposures of a wall, and a view from elsewhere.

    Both exposures come from the same sensor: what is noise of photons and of reading in the short one is so in the long
    one, too, only that it has ``ratio`` times the light.
    """
    lit = BRIGHTER * (wall + LAMPS * np.clip((wall - 0.85) / 0.15, 0, 1))
    found = make_pairs([np.asarray(lit, dtype=np.float32)], blur_px, size=size, seed=seed, exposure_s=LONG_S)[0]
    long_shutter, view_shutter = found.shutters
    brief_s = LONG_S / ratio
    short_shutter = replace(long_shutter, exposure_s=brief_s, t_s=long_shutter.t_s - BETWEEN_S - brief_s)
    pair = replace(found, shutters=(short_shutter, view_shutter))
    rng = np.random.default_rng([seed, round(1e4 * noise)])
    read = noise * np.sqrt(READ_SHARE)
    by_light = noise**2 * (1 - READ_SHARE) / 0.5

    def filmed(light: Float32Array, gathered: float) -> UInt8Array:
        """Codes of light of which the sensor gathered a share, as bright as that leaves it."""
        variance = read**2 / ratio**2 + by_light / ratio * np.clip(gathered * light, 0, None)
        grain = np.sqrt(variance) * rng.standard_normal(light.shape, dtype=np.float32)
        return codes(srgb_from_linear(gathered * light + grain))

    tint = (1 + COLOUR_DIFFERENCE * rng.standard_normal(3)).astype(np.float32)
    return Exposures(
        pair=pair,
        long_shutter=long_shutter,
        short=filmed(tint * pair.light(short_shutter), 1 / ratio),
        long=filmed(pair.light(long_shutter), 1.0),
        truth=pair.sharp(0),
        view=pair.sharp(1),
        errors=errors,
        ratio=ratio,
    )


def codes(srgb: AnyArray) -> UInt8Array:
    """8 bits of 0 to 1."""
    return np.asarray(np.rint(255 * np.clip(srgb, 0, 1)), dtype=np.uint8)


def denoised(image: UInt8Array, strength: float) -> UInt8Array:
    """Non-local means as OpenCV has it, of brightness and colours alike."""
    return np.asarray(cv2.fastNlMeansDenoisingColored(image, None, strength, strength, 7, 21))


def best_strength(pictures: Sequence[UInt8Array], truth: Sequence[UInt8Array]) -> float:
    """Of non-local means, by the PSNR of the middle of all pictures: the truth chooses, in their favour."""

    def middle(image: UInt8Array) -> UInt8Array:
        top, left = ((n - m) // 2 if n > m else 0 for n, m in zip(image.shape, _NLM_CROP, strict=False))
        return np.ascontiguousarray(image[top : top + _NLM_CROP[0], left : left + _NLM_CROP[1]])

    def quality(strength: float) -> float:
        return float(
            np.mean([psnr_db(denoised(middle(a), strength), middle(b)) for a, b in zip(pictures, truth, strict=True)])
        )

    return max(NLM_STRENGTHS, key=quality)


def measure(
    walls: Sequence[Float32Array],
    network: Network,
    *,
    noises: Sequence[float],
    size: tuple[int, int],
    seed: int,
    console: Console,
) -> dict[str, Any]:
    """Every figure of every way, by the short exposure's noise."""
    return {f"{noise:g}": _of_noise(walls, network, noise, size, seed, console) for noise in noises}


def _of_noise(
    walls: Sequence[Float32Array], network: Network, noise: float, size: tuple[int, int], seed: int, console: Console
) -> dict[str, Any]:
    scenes = [
        expose(wall, BLURS_PX[i % 3], RATIOS[i // 3 % 3], noise, errors, size=size, seed=seed + i)
        for i, (wall, errors) in enumerate(zip(walls, usual_errors(len(walls), seed), strict=True))
    ]
    joined = [scene.together() for scene in scenes]
    strength = best_strength([codes(pair.short) for pair in joined], [scene.truth for scene in scenes])
    rows: dict[str, list[dict[str, float]]] = {}
    work = list(zip(scenes, joined, strict=True))
    for scene, pair in track(work, f"short and long, noise {noise:g}", console=console):
        view = extract(scene.view)
        for name, make in ways(scene, pair, network, strength).items():
            picture = make()
            correct, found = correct_matches(scene.pair, extract(picture), view)
            rows.setdefault(name, []).append(
                {
                    "correct": correct,
                    "found": found,
                    "psnr_db": psnr_db(picture, scene.truth),
                    "ssim": ssim(picture, scene.truth),
                }
            )
    out = {
        name: {
            "correct": sum(int(row["correct"]) for row in found),
            "found": sum(int(row["found"]) for row in found),
            "psnr_db": float(np.mean([row["psnr_db"] for row in found])),
            "ssim": float(np.mean([row["ssim"] for row in found])),
        }
        for name, found in rows.items()
    }
    return {
        "scenes": len(scenes),
        "nlm_strength": strength,
        "aligned_by_gyro": sum(pair.registered.by_gyro for pair in joined),
        "rows": out,
    }


def ways(
    scene: Exposures, pair: ExposurePair, network: Network, strength: float
) -> dict[str, Callable[[], UInt8Array]]:
    """What can be made of a pair; the last one has a brightness of its own."""
    short, long = codes(pair.short), codes(pair.long)
    fused = fuse(pair.short, pair.long, blur=pair.blur, network=network)

    def without_gyro() -> UInt8Array:
        other = scene.together(gyro=False)
        return codes(fuse(other.short, other.long, network=network))

    def mertens() -> UInt8Array:
        dark = brightened(scene.short, replace(pair.brightness, gain=1.0))
        return codes(fuse_mertens([dark, fused]))

    return {
        "short": lambda: short,
        "long": lambda: long,
        "non-local means on short": lambda: denoised(short, strength),
        "Wiener on long": lambda: deblur(long, scene.true_blur()),
        "LSD2": lambda: codes(fused),
        "LSD2, no gyroscope": without_gyro,
        "Mertens of short and LSD2": mertens,
    }
