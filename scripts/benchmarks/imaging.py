"""Quality and cost of deblurring and of rolling-shutter correction, against other methods.

    python -m scripts.benchmarks.imaging [--photos FOLDER] [--scenes N] [--colmap] [--only SECTION ...] [--json FILE]

Scenes are walls at infinity before a handheld camera that turns (``imaging_scenes.py``: blur and rolling shutter exact,
motion as measured of people, 20 ms exposure, 20 ms readout, a phone's gyroscope at 400 Hz, 1 % noise in linear light,
8 bit), drawn or hung with the photographs of FOLDER; with FOLDER also whole photographs at their own size. Of each,
two frames with a blur of 6, 10, 20, 30 px (90th percentile over the frame). All frames with the same blur count as one
recording: it is judged first, then each frame goes through the gate, all at the package's defaults.

Features are COLMAP's own SIFT, at its defaults but for ``--first-octave``, matches as COLMAP finds them. A match is
correct within 3 px of the true transfer; matches are summed over the scenes. PSNR and SSIM are against the frame
without blur and noise.

Sections: quality by blur; which share of the truly blurred frames is treated; other ways at 20 px (with ``dropped``:
leaving such frames out leaves nothing to match); processor time of a grey 1080p frame; false blur (share of the matches
of doing nothing that the gate keeps, with each of the package's filters); the rolling shutter in two views; with
``--colmap``, whole reconstructions with and without the treatment.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import Float32Array, UInt8Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.evidence import blur_evidence
from colmap_inertial.imaging.gate import GateOptions, RecordingVerdict, judge_frame, judge_recording
from colmap_inertial.imaging.path_filters import deblur, half_quadratic
from scripts.common import (
    imaging_baselines as baselines,
    imaging_colmap,
    imaging_cost,
    imaging_metrics as metrics,
    imaging_shutter,
)
from scripts.common.bench_report import describe_run
from scripts.common.gated_deblur import deblur_gated
from scripts.common.imaging_metrics import Features, correct_matches, extract, psnr_db, repeatability, ssim
from scripts.common.imaging_scenes import Pair, drawn_walls, make_pairs, native_walls, photographed_walls, photographs
from scripts.common.imaging_tables import print_report

SIZE = (1920, 1080)
BLURS_PX = (6.0, 10.0, 20.0, 30.0)
ERRORS = ("noise", "flipped axis", "20 % long", "20 % short", "10 ms late")
#: Of a sharp frame: as filmed in bright light.
SHARP_S = 0.0002
#: As many frames judge a recording, the most blurred ones.
JUDGED = 14
SECTIONS = ("quality", "treated", "other_ways_20_px", "cost", "false_blur_10_px", "rolling_shutter", "colmap")
console = Console(stderr=True)
T = TypeVar("T")
#: The package's filters, by the names that ``--deblur`` gives them.
FILTERS: dict[str, Callable[[UInt8Array, BlurField], UInt8Array]] = {
    "wiener": deblur,
    "path": lambda image, blur: half_quadratic(image, BlurPath.straight(blur)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, help="a folder of sharp photographs")
    parser.add_argument("--scenes", type=int, default=10, help="how many, of each kind")
    parser.add_argument("--compared", type=int, default=5, help="scenes for the other ways and for false blur")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--first-octave",
        type=int,
        choices=(-1, 0),
        default=-1,
        help="of SIFT, where matches count; 0 takes a quarter of the time of COLMAP's -1",
    )
    parser.add_argument("--colmap", action="store_true", help="also whole reconstructions (minutes)")
    parser.add_argument(
        "--quick", action="store_true", help="two scenes, 10 and 20 px, one for the other ways, short reconstructions"
    )
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="these sections alone")
    parser.add_argument("--json", type=Path, help="also write all figures there")
    args = parser.parse_args()
    if args.scenes < 1:
        parser.error("--scenes: at least 1")
    cv2.setNumThreads(1)
    metrics.set_first_octave(args.first_octave)
    start = time.process_time()
    scenes, compared = (2, 1) if args.quick else (args.scenes, min(args.compared, args.scenes))
    blurs = (10.0, 20.0) if args.quick else BLURS_PX
    walls = drawn_walls(scenes, args.seed)
    kinds: dict[str, tuple[list[Float32Array], tuple[int, int] | None]] = {"drawn": (walls, SIZE)}
    if args.photos is not None:
        pictures = photographs(args.photos)
        walls = photographed_walls(pictures, scenes, args.seed)
        native = native_walls(pictures, scenes, args.seed)
        kinds = {"photographs": (walls, SIZE), "whole photographs": (native, None)}
    sections: dict[str, Callable[[], Any]] = {
        "quality": lambda: {
            kind: {f"{blur:g}": quality(wall, size, blur, args.seed, kind) for blur in blurs}
            for kind, (wall, size) in kinds.items()
        },
        "treated": lambda: {
            kind: {f"{blur:g}": treated(make_pairs(wall, blur, size=size, seed=args.seed)) for blur in blurs}
            for kind, (wall, size) in kinds.items()
        },
        "other_ways_20_px": lambda: other_ways(make_pairs(walls[:compared], 20.0, size=SIZE, seed=args.seed)),
        "cost": lambda: imaging_cost.measure(make_pairs(walls, 20.0, size=SIZE, seed=args.seed)),
        "false_blur_10_px": lambda: false_blur(make_pairs(walls[:compared], 10.0, size=SIZE, seed=args.seed)),
        "rolling_shutter": lambda: imaging_shutter.two_views(20, args.seed),
    }
    sections["colmap"] = lambda: imaging_colmap.measure(quick=args.quick, console=console)
    report: dict[str, Any] = {"about": about(args)}
    for name in args.only or [name for name in SECTIONS if name != "colmap" or args.colmap]:
        report[name] = sections[name]()
        report["about"]["cpu_s"] = round(time.process_time() - start)
        if args.json:
            args.json.write_text(json.dumps(report, indent=2) + "\n")
    print_report(report, Console())


def about(args: argparse.Namespace) -> dict[str, Any]:
    """Machine, versions, commit, and what was asked for."""
    return {
        **describe_run(),
        "scenes": args.scenes,
        "seed": args.seed,
        "first_octave": args.first_octave,
        "photos": args.photos is not None,
        "quick": args.quick,
    }


def flat(pairs: Sequence[Sequence[T]]) -> list[T]:
    """Both of each pair in one list."""
    return [one for pair in pairs for one in pair]


def features_of(images: Sequence[UInt8Array]) -> list[Features]:
    """Of a few images, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(extract, images))


def verdict_on(frames: Sequence[UInt8Array], blurs: Sequence[BlurField]) -> RecordingVerdict:
    """What the most blurred frames of a recording say of its gyroscope."""
    order = sorted(range(len(frames)), key=lambda i: -float(np.percentile(blurs[i].extent_px(), 90)))[:JUDGED]
    return judge_recording(blur_evidence(frames[i], blurs[i]) for i in order)


def measured(pair: Pair, images: Sequence[UInt8Array], sharp: Sequence[UInt8Array]) -> dict[str, float]:
    """Every figure of one pair of frames."""
    features = features_of(images)
    correct, found = correct_matches(pair, *features)
    repeated, error_px = repeatability(pair, *features)
    return {
        "correct": correct,
        "found": found,
        "repeatability": repeated,
        "localisation_px": error_px,
        "psnr_db": float(np.mean([psnr_db(a, b) for a, b in zip(images, sharp, strict=True)])),
        "ssim": float(np.mean([ssim(a, b) for a, b in zip(images, sharp, strict=True)])),
    }


def summed(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Matches summed, the rest averaged over scenes."""
    out = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
    return out | {key: sum(int(row[key]) for row in rows) for key in ("correct", "found")}


def quality(
    walls: Sequence[Float32Array], size: tuple[int, int] | None, blur_px: float, seed: int, kind: str
) -> dict[str, Any]:
    """Nothing against the gated default, at one blur."""
    pairs = make_pairs(walls, blur_px, size=size, seed=seed)
    frames = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
    blurs = [[pair.blur(i) for i in (0, 1)] for pair in pairs]
    verdict = verdict_on(flat(frames), flat(blurs))
    rows: dict[str, list[dict[str, float]]] = {"nothing": [], "gated": []}
    kept, deblurred = [], 0
    for pair, images, fields in track(
        list(zip(pairs, frames, blurs, strict=True)), f"{kind}, {blur_px:g} px", console=console
    ):
        sharp = [pair.sharp(i) for i in (0, 1)]
        gated = [deblur_gated(a, b, recording=verdict) for a, b in zip(images, fields, strict=True)]
        deblurred += sum(g.deblurred for g in gated)
        kept += [g.kept_share for g in gated if g.deblurred]
        rows["nothing"].append(measured(pair, images, sharp))
        rows["gated"].append(measured(pair, [g.image for g in gated], sharp))
    each = [b["correct"] / max(a["correct"], 1) for a, b in zip(*rows.values(), strict=True)]
    out = {name: summed(found) for name, found in rows.items()}
    ratio = out["gated"]["correct"] / max(out["nothing"]["correct"], 1)
    console.print(f"{kind}, {blur_px:g} px: {ratio:.2f} times the correct matches of doing nothing")
    return {
        "pairs": len(pairs),
        "median_blur_px": float(np.median([np.median(b.extent_px()) for two in blurs for b in two])),
        "deblurred_frames": deblurred,
        "verdict": str(verdict.reason),
        "kept_share": float(np.mean(kept)) if kept else 1.0,
        **out,
        "ratio": ratio,
        "ratio_of_each_scene": [round(r, 3) for r in each],
    }


def treated(pairs: Sequence[Pair]) -> dict[str, Any]:
    """How many frames go through the gate with a right gyroscope: all are blurred."""
    frames = [pair.frame(i) for pair in pairs for i in (0, 1)]
    blurs = [pair.blur(i) for pair in pairs for i in (0, 1)]
    verdict = verdict_on(frames, blurs)
    judged = [judge_frame(image, blur, verdict, GateOptions()) for image, blur in zip(frames, blurs, strict=True)]
    return {
        "frames": len(frames),
        "treated": sum(factor is not None for factor, _ in judged),
        "trusted": verdict.trusted,
        "support": round(verdict.support, 1),
        "extent_factor": round(verdict.extent_factor, 3),
        "left_alone": sorted({reason for factor, reason in judged if factor is None}),
    }


def other_ways(pairs: Sequence[Pair]) -> dict[str, Any]:
    """The gated default, the filter without the gate, and what others do, on the same frames."""
    frames = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
    blurs = [[pair.blur(i) for i in (0, 1)] for pair in pairs]
    verdict = verdict_on(flat(frames), flat(blurs))
    ways: dict[str, Callable[[UInt8Array, BlurField], UInt8Array]] = {
        "nothing": lambda image, _: image,
        "gated": lambda image, blur: deblur_gated(image, blur, recording=verdict).image,
        "ungated": deblur,
        "spatial_wiener_2d": baselines.spatial_wiener,
        "fourier_wiener": baselines.fourier_wiener,
        "richardson_lucy_blocks": baselines.richardson_lucy_blocks,
    }
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for pair, images, fields in track(list(zip(pairs, frames, blurs, strict=True)), "other ways", console=console):
        sharp = [pair.sharp(i) for i in (0, 1)]
        for name, way in ways.items():
            rows[name].append(measured(pair, [way(a, b) for a, b in zip(images, fields, strict=True)], sharp))
    out: dict[str, Any] = {name: summed(found) for name, found in rows.items()}
    # a frame that is left out matches nothing
    return out | {"dropped": {"correct": 0, "found": 0}}


def false_blur(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Correct matches of the gated filters with a wrong gyroscope, as a share of those of doing nothing."""
    frames = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
    before = [correct_matches(pair, *features_of(two))[0] for pair, two in zip(pairs, frames, strict=True)]
    trusted = verdict_on(flat(frames), [pair.blur(i) for pair in pairs for i in (0, 1)])
    out: dict[str, Any] = {}
    for error in track(("", *ERRORS), "false blur", console=console):
        fields = [[pair.blur(i, error) for i in (0, 1)] for pair in pairs]
        verdict = verdict_on(flat(frames), flat(fields))
        out[error or "none"] = by_filter(pairs, frames, fields, verdict, before)
    short = [with_short_exposure(pair) for pair in pairs]
    frames = [[pair.frame(i) for i in (0, 1)] for pair in short]
    before = [correct_matches(pair, *features_of(two))[0] for pair, two in zip(short, frames, strict=True)]
    fields = [[pair.blur(i) for i in (0, 1)] for pair in pairs]
    alone = verdict_on(flat(frames), flat(fields))
    out["sharp recording"] = by_filter(short, frames, fields, alone, before)
    out["sharp frames among blurred ones"] = by_filter(short, frames, fields, trusted, before)
    return out


def by_filter(
    pairs: Sequence[Pair],
    frames: Sequence[Sequence[UInt8Array]],
    fields: Sequence[Sequence[BlurField]],
    verdict: RecordingVerdict,
    before: Sequence[int],
) -> dict[str, Any]:
    """What the gate leaves of the matches, with each of the filters."""
    return {name: kept_share(pairs, frames, fields, verdict, before, way) for name, way in FILTERS.items()}


def with_short_exposure(pair: Pair) -> Pair:
    """The same frames with a short exposure; mid-exposures stay."""
    shutters = tuple(
        replace(s, exposure_s=SHARP_S, t_s=s.t_s + 0.5 * ((s.exposure_s or 0.0) - SHARP_S)) for s in pair.shutters
    )
    return replace(pair, shutters=(shutters[0], shutters[1]))


def kept_share(
    pairs: Sequence[Pair],
    frames: Sequence[Sequence[UInt8Array]],
    fields: Sequence[Sequence[BlurField]],
    verdict: RecordingVerdict,
    before: Sequence[int],
    way: Callable[[UInt8Array, BlurField], UInt8Array] | None = None,
) -> dict[str, Any]:
    """Correct matches through the gate against those of doing nothing."""
    after, deblurred = 0, 0
    for pair, images, blurs, untouched in zip(pairs, frames, fields, before, strict=True):
        gated = [deblur_gated(a, b, recording=verdict, deblur=way) for a, b in zip(images, blurs, strict=True)]
        deblurred += sum(g.deblurred for g in gated)
        changed = any(g.deblurred for g in gated)
        after += correct_matches(pair, *features_of([g.image for g in gated]))[0] if changed else untouched
    return {
        "correct": after,
        "nothing": sum(before),
        "kept": after / max(sum(before), 1),
        "deblurred_frames": deblurred,
        "frames": 2 * len(pairs),
        "extent_factor": round(verdict.extent_factor, 3),
        "trusted": verdict.trusted,
        "support": round(verdict.support, 1),
    }


if __name__ == "__main__":
    main()
