"""Deblurring along the gyroscope's path, by method: matches, PSNR, gate, cost and reconstructions.

    python -m scripts.benchmarks.path --photos FOLDER --motion FOLDER [--every S] [--most N] [--exposures S ...]
        [--methods NAME ...] [--octaves 0 -1] [--only SECTION ...] [--cache FOLDER] [--json FILE]
    python -m scripts.benchmarks.path --colmap [--methods NAME ...] [--scenes N] [--widths PX ...]

Held-out photographs (``restoration/photographs.py``) hang on a wall at infinity before a camera of 1280 x 720 px with
1000 px of focal length that turns as the gyroscope of TUM-VI's room 5 did, by a reckoning of its own
(``turning_world.py``): exposures of 16, 33 and 66 ms, 20 ms readout, shot and read noise of 1 %, JPEG 90, grey. Frames
follow one another every 0.2 s; all pairs of neighbours count, in order through the recording, and fall into bins by the
mean of their blurs (90th percentile over the frame): 3-8, 8-15, 15-25 px and above. Only pairs of which a frame has
more than ``--most-px`` are left out and counted, as the package leaves such frames out, too; below 3 px, too.

``quality``: both frames of each pair treated alike. Correct matches of COLMAP's SIFT are those within 3 px of the true
transfer, on the output for features; ratios to untreated frames are of the sums, their median over pairs, and their
mean. PSNR is of the output for people, against the frame without blur, noise and JPEG. The gyroscope is exact, or wrong
in three ways at once (signs drawn for each pair): exposure 10 % too long or short, clock 3 ms, direction 3 degrees. The
filters are told what a usual calibration says of itself (0.5 ms, 0.3 degrees), or for ``errors`` these errors;
``--gyros`` has the other way round, too.

``gate``: the package's gate over each exposure's frames as one recording: which share of the blurred ones it treats, by
bin, and which share of their matches remains of frames that are sharp while the gyroscope says that they are blurred
(``false``), and of sharp video.

``sky``: whether recordings at 6 and 10 px of which 70 and 90 % is sky are trusted, and how many of their frames are
treated, with a right gyroscope and with wrong ones.

``false``: wrong gyroscopes at 10 and 20 px, those played backwards and with the wrong sign among them: which share of
the correct matches the gate leaves, with each of the package's methods.

``short``: what 1 to 3 px of blur in pictures of 640 px gain or lose by being treated.

``cost``: processor time of a grey 1080p frame at 10, 20 and 40 px, as a ratio to `wiener`'s in the same run.

``colour``: colour frames as luma in full and chroma at half the size, against each channel by itself: PSNR gained, and
processor time and time of a 1080p frame with one and two threads.

``--colmap``: whole reconstructions of simulated scenes at 10 and 20 px by ``--deblur`` methods, each with the default
smoothing of what features see, and with the ``--widths``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.options import BlurRemover
from scripts.benchmarks.imaging import about
from scripts.common import imaging_metrics as metrics, path_reconstructions, path_scenes
from scripts.common.path_colour import colour
from scripts.common.path_false import false_gyroscopes, mostly_sky, recording, short_blur
from scripts.common.path_methods import METHODS, cost, gate
from scripts.common.path_tables import print_report

SECTIONS = ("quality", "gate", "sky", "false", "short", "cost", "colour")
#: Lower ends of the bins of blur, px.
BINS_PX = (3.0, 8.0, 15.0, 25.0)
console = Console(stderr=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, help="the folder of sharp photographs of the training")
    parser.add_argument("--motion", type=Path, help="a folder with room5_imu.csv.xz; the simulator's hand without")
    parser.add_argument("--exposures", type=float, nargs="+", default=(0.016, 0.033, 0.066), help="s")
    parser.add_argument("--every", type=float, default=1.2, help="s between the beginnings of two pairs; 0.2 takes all")
    parser.add_argument("--most", type=int, default=10**6, help="pairs of each exposure at most")
    parser.add_argument(
        "--recorded", type=int, default=7, help="pairs of each recording for ``sky``, ``false`` and ``short``"
    )
    parser.add_argument("--most-px", type=float, default=50.0, help="frames with more blur are left out")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=tuple(METHODS))
    parser.add_argument("--octaves", type=int, nargs="+", choices=(0, -1), default=(0, -1), help="first ones of SIFT")
    parser.add_argument("--gyros", nargs="+", choices=tuple(path_scenes.GYROS), default=("exact", "errors"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--cache", type=Path, help="keep rendered frames there")
    parser.add_argument("--colmap", action="store_true", help="reconstructions, and nothing else")
    parser.add_argument("--scenes", type=int, default=8, help="of them")
    parser.add_argument(
        "--widths", type=float, nargs="*", default=(), help="of smoothing, px: reconstructions with each"
    )
    parser.add_argument("--json", type=Path, help="also write all figures there")
    args = parser.parse_args()
    if not args.colmap and args.photos is None:
        parser.error("--photos: give the folder of photographs")
    cv2.setNumThreads(1)
    args.scenes, args.first_octave, args.quick = args.scenes, args.octaves[0], False
    report: dict[str, Any] = {"about": about(args)}

    def keep() -> None:
        if args.json:
            args.json.write_text(json.dumps(report, indent=2) + "\n")

    if args.colmap:
        path_reconstructions.measure(
            report, args.methods, args.scenes, args.widths, motion=args.motion, console=console, keep=keep
        )
    else:
        removers = [name for name in args.methods if name in get_args(BlurRemover)]
        make = partial(
            recording,
            args.photos,
            args.motion,
            count=args.recorded,
            size=tuple(args.size),
            seed=args.seed,
            cache=args.cache,
        )
        takes = path_scenes.takes(
            args.photos,
            args.motion,
            args.exposures,
            size=tuple(args.size),
            every_s=args.every,
            most=args.most,
            most_px=args.most_px,
            least_px=BINS_PX[0],
            seed=args.seed,
            cache=args.cache,
        )
        sections: dict[str, Callable[[], Any]] = {
            "quality": lambda: quality(takes, args, report, keep),
            "gate": lambda: gate(takes, binned, console=console),
            "sky": lambda: mostly_sky(make, console=console),
            "false": lambda: false_gyroscopes(make, removers, console=console),
            "short": lambda: short_blur(make, removers, console=console),
            "cost": lambda: cost(takes[0], args.methods),
            "colour": lambda: colour(args.photos, args.motion, tuple(args.size), args.seed, console=console),
        }
        report["pairs_beyond"] = {f"{1e3 * t.exposure_s:g} ms": t.beyond for t in takes}
        for name in args.only:
            report[name] = sections[name]()
            keep()
    print_report(report, Console(width=160))


def binned(blur_px: float) -> str:
    """The bin's name."""
    k = int(np.searchsorted(BINS_PX, blur_px, side="right")) - 1
    return f">{BINS_PX[-1]:g}" if k == len(BINS_PX) - 1 else f"{BINS_PX[k]:g}-{BINS_PX[k + 1]:g}"


def quality(
    takes: list[path_scenes.Take], args: argparse.Namespace, report: dict[str, Any], keep: Callable[[], None]
) -> dict[str, Any]:
    """Figures by gyroscope, method and bin; rows of the single pairs beside them, written as they come."""
    rows: list[dict[str, Any]] = report.setdefault("rows", [])
    work = [(take, pair) for take in takes for pair in take.pairs]
    # in an order that fills all bins soon: what is there when one stops is not of one exposure alone
    order = np.random.default_rng(args.seed).permutation(len(work))
    for k in track(order, "pairs", console=console):
        take, pair = work[k]
        rows.append(_row(take, pair, args))
        if len(rows) % 5 == 0:
            keep()
    return summary(rows)


def _row(take: path_scenes.Take, pair: path_scenes.Pair, args: argparse.Namespace) -> dict[str, Any]:
    frames, sharp = ([shot(i) for i in (0, 1)] for shot in (pair.frame, pair.sharp))
    row: dict[str, Any] = {
        "exposure_s": take.exposure_s,
        "t_s": pair.moments[0].t_s,
        "blur_px": pair.blur_px,
        "bin": binned(pair.blur_px),
    }

    def matches(images: list[np.ndarray[Any, np.dtype[np.uint8]]]) -> dict[str, list[int]]:
        return {
            str(octave): list(pair.correct_matches(*(metrics.extract(image, octave) for image in images)))
            for octave in args.octaves
        }

    def psnr(images: list[np.ndarray[Any, np.dtype[np.uint8]]]) -> float:
        return float(np.mean([metrics.psnr_db(a, b) for a, b in zip(images, sharp, strict=True)]))

    row["untreated"] = {"matches": matches(frames), "psnr_db": psnr(frames)}
    for gyro in args.gyros:
        known = [pair.known(i, gyro) for i in (0, 1)]
        for name in args.methods:
            if name.startswith("untreated") and gyro != args.gyros[0]:
                continue
            made = [METHODS[name](image, *one) for image, one in zip(frames, known, strict=True)]
            row[f"{name}, {gyro}"] = {
                "matches": matches([m.for_features for m in made]),
                "psnr_db": psnr([m.for_people for m in made]),
            }
    return row


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """By way, bin and octave."""
    out: dict[str, Any] = {}
    names = [key for key in rows[0] if isinstance(rows[0][key], dict)] if rows else []
    bins = [*sorted({row["bin"] for row in rows}, key=lambda b: float(b.strip(">").split("-")[0])), "all"]
    for name in names:
        for place in bins:
            some = [row for row in rows if place in (row["bin"], "all")]
            gained = [row[name]["psnr_db"] - row["untreated"]["psnr_db"] for row in some]
            one: dict[str, Any] = {
                "pairs": len(some),
                "psnr_db": float(np.mean([row[name]["psnr_db"] for row in some])),
                "gained_db": float(np.mean(gained)),
                "worse_share": float(np.mean([g < 0 for g in gained])),
            }
            for octave in some[0]["untreated"]["matches"]:
                a, b = (
                    np.array([row[way]["matches"][octave] for row in some], dtype=float) for way in ("untreated", name)
                )
                # a pair with hardly any match has no ratio
                each = (b[:, 0] + 1) / (a[:, 0] + 1)
                one[f"octave {octave}"] = {
                    "untreated": int(a[:, 0].sum()),
                    "correct": int(b[:, 0].sum()),
                    "ratio_of_sums": float(b[:, 0].sum() / max(a[:, 0].sum(), 1)),
                    "median_ratio": float(np.median(each)),
                    "mean_ratio": float(np.mean(each)),
                    "precision": float(b[:, 0].sum() / max(b[:, 1].sum(), 1)),
                }
            out.setdefault(name, {})[place] = one
    return out


if __name__ == "__main__":
    main()
