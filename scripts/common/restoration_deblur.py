"""DeepGyro against the Wiener filter, with a gyroscope that is right and with one that is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import RecordingVerdict
from scripts.benchmarks.imaging import features_of, flat, measured, summed, verdict_on, with_short_exposure
from scripts.common.gated_deblur import GatedFrame, deblur_gated
from scripts.common.imaging_metrics import correct_matches
from scripts.common.imaging_scenes import GyroErrors, Pair

#: By name; each undoes the blur of a frame.
Ways = Mapping[str, Callable[[UInt8Array, BlurField], UInt8Array]]

#: A gyroscope without any error, and standard deviations of those of a usual one.
PERFECT = GyroErrors(noise_rad_s=0.0)
LATE_S, EXTENT, ANGLE_RAD, GYRO_NOISE_RAD_S = 3e-3, 0.1, np.radians(3.0), 1e-3
#: Where draws of errors begin, apart from those of scenes.
_DRAWN = 977


def usual_errors(count: int, seed: int) -> list[GyroErrors]:
    """Errors of clock, extent, direction and noise, drawn for some recordings.

    Of several, each is 0 in the mean and has the standard deviation that it is said to have: a few draws may not.
    """
    draws = np.random.default_rng([_DRAWN, seed]).standard_normal((count, 3))
    if count > 1:
        draws -= draws.mean(axis=0)
        draws /= np.sqrt((draws**2).mean(axis=0))
    return [
        GyroErrors(
            late_s=LATE_S * late,
            extent=float(np.exp(EXTENT * extent)),
            angle_rad=ANGLE_RAD * angle,
            noise_rad_s=GYRO_NOISE_RAD_S,
        )
        for late, extent, angle in draws
    ]


def quality(pairs: Sequence[Pair], ways: Ways, *, label: str, console: Console) -> dict[str, Any]:
    """All figures of doing nothing and of every way, gated and not, by the errors of the gyroscope."""
    frames = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
    truth = [[pair.sharp(i) for i in (0, 1)] for pair in pairs]
    nothing = [measured(*one) for one in zip(pairs, frames, truth, strict=True)]
    out: dict[str, Any] = {"pairs": len(pairs)}
    for kind, errors in {
        "no error": [PERFECT] * len(pairs),
        "usual errors": usual_errors(len(pairs), pairs[0].seed),
    }.items():
        fields = [[pair.blur(i, error) for i in (0, 1)] for pair, error in zip(pairs, errors, strict=True)]
        verdict = verdict_on(flat(frames), flat(fields))
        rows: dict[str, list[dict[str, float]]] = {"nothing": nothing}
        deblurred = dict.fromkeys(ways, 0)
        work = list(zip(pairs, frames, fields, truth, nothing, strict=True))
        for pair, two, blurs, sharp, before in track(work, f"{label}, {kind}", console=console):
            for name, deblur in ways.items():
                plain = [deblur(a, b) for a, b in zip(two, blurs, strict=True)]
                gated = gated_again(two, blurs, plain, deblur, verdict)
                figures = measured(pair, plain, sharp)
                rows.setdefault(f"{name} ungated", []).append(figures)
                same = _all_same([g.image for g in gated], plain)
                untouched = not any(g.deblurred for g in gated)
                if not same:
                    figures = before if untouched else measured(pair, [g.image for g in gated], sharp)
                rows.setdefault(f"{name} gated", []).append(figures)
                deblurred[name] += sum(g.deblurred for g in gated)
        out[kind] = {
            "verdict": str(verdict.reason),
            "deblurred_frames": deblurred,
            "rows": {name: summed(found) for name, found in rows.items()},
            "correct_of_each_scene": {name: [int(row["correct"]) for row in found] for name, found in rows.items()},
        }
    return out


def gated_again(
    images: Sequence[UInt8Array],
    fields: Sequence[BlurField],
    plain: Sequence[UInt8Array],
    deblur: Callable[[UInt8Array, BlurField], UInt8Array],
    verdict: RecordingVerdict,
) -> list[GatedFrame]:
    """Frames through the gate, of which it is known what ``deblur`` makes of them by the fields as they are."""

    def known(image: UInt8Array, blur: BlurField, *, of: BlurField, result: UInt8Array) -> UInt8Array:
        return result if blur is of else deblur(image, blur)

    return [
        deblur_gated(image, field, recording=verdict, deblur=partial(known, of=field, result=result))
        for image, field, result in zip(images, fields, plain, strict=True)
    ]


def false_blur(pairs: Sequence[Pair], ways: Ways, *, label: str, console: Console) -> dict[str, Any]:
    """Correct matches between sharp frames of which the gyroscope says that they are blurred.

    As a share of those before: without the gate; among frames that are as blurred as the gyroscope says, by which it is
    trusted; and where all frames are sharp.
    """
    blurred = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
    fields = [[pair.blur(i) for i in (0, 1)] for pair in pairs]
    short = [with_short_exposure(pair) for pair in pairs]
    sharp = [[pair.frame(i) for i in (0, 1)] for pair in short]
    trusted, alone = (verdict_on(flat(frames), flat(fields)) for frames in (blurred, sharp))
    before = [correct_matches(pair, *features_of(two))[0] for pair, two in zip(short, sharp, strict=True)]
    kept: dict[str, int] = {}
    for pair, two, blurs, untouched in track(
        list(zip(short, sharp, fields, before, strict=True)), f"false blur, {label}", console=console
    ):
        for name, deblur in ways.items():
            plain = [deblur(a, b) for a, b in zip(two, blurs, strict=True)]
            images = {f"{name} ungated": plain}
            for where, verdict in (("sharp among blurred", trusted), ("all sharp", alone)):
                gated = gated_again(two, blurs, plain, deblur, verdict)
                images[f"{name} gated, {where}"] = [g.image for g in gated]
            for row, pictures in images.items():
                same = _all_same(pictures, two)
                count = untouched if same else correct_matches(pair, *features_of(pictures))[0]
                kept[row] = kept.get(row, 0) + count
    return {
        "pairs": len(pairs),
        "nothing": sum(before),
        "rows": {row: {"correct": count, "kept": count / max(sum(before), 1)} for row, count in kept.items()},
    }


def _all_same(a: Sequence[UInt8Array], b: Sequence[UInt8Array]) -> bool:
    """Whether these are the very same arrays."""
    return all(x is y for x, y in zip(a, b, strict=True))
