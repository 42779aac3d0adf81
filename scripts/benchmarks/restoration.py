"""The networks DeepGyro and LSD2 against other methods.

    python -m scripts.benchmarks.restoration --photos FOLDER [--scenes N] [--only SECTION ...] [--weights FILE ...]
        [--sheet FILE.png] [--json FILE]

Scenes, camera, measures and counting are those of ``scripts/benchmarks/imaging.py``, but in colour: walls at infinity
before a handheld camera that turns, blur and rolling shutter exact, hung with photographs of FOLDER. Of these only such
serve as the networks were never trained on (``restoration/photographs.py`` knows by their names); there may be fewer
than 15 for each wall, and then they hang in several. Motion is the simulator's, by seeds of its own. PSNR and SSIM are
of the three channels, against the frame without blur and noise; features are those of the grey picture.

Gyroscopes come without any error, and with the usual ones, drawn for each pair of frames: clock 3 ms, extent of the
blur 10 %, its direction 3 degrees (standard deviations), and 1 mrad/s of white noise on each sample at 400 Hz.

``deepgyro``: the frames as they are; the Wiener filter and DeepGyro behind the package's gate as ``--deblur`` has them,
all frames of one blur judged as one recording (each pair has errors of its own, so the gate can mend the extents of
single pairs no more than their mean); and both without the gate. Walls in 1080p and whole photographs. The yardstick
is the thesis's U-Net, picture and blur alone, trained on the same samples (``--unet``).

``false_blur``: sharp frames with the blur field of blurred ones, as a wrong exposure time would give: the share of
correct matches that is kept. Behind the gate twice: where other frames of the recording confirm the gyroscope, and
where all of them are sharp.

``colmap``: a whole reconstruction of the scene with 10 px of blur of ``scripts/benchmarks/imaging.py``, by each way.

``lsd2``: pairs of a short exposure (1/8 to 1/16 of the time, noisy) and a long one (10 to 25 px of blur), clipped
lamps, colours that differ by 4 %, 8 bits, brought together by the package with a gyroscope that has the usual errors
(``restoration_exposures.py``). The Wiener filter gets the true blur, non-local means the strength that is best by the
truth. Matches are those with a frame from elsewhere without noise and blur. (Mertens' exposure fusion makes pictures of
another brightness: matches alone can be compared.)

``cost``: 1920 x 1080 in colour, 2 threads. ``--sheet``: crops of rendered scenes side by side, to look at.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from rich.console import Console

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import deblur
from colmap_inertial.imaging.restoration import Network, deepgyro, load_network
from scripts.benchmarks.imaging import BLURS_PX, SIZE, about
from scripts.common import imaging_colmap, imaging_metrics as metrics, restoration_cost, restoration_exposures
from scripts.common.imaging_scenes import make_pairs, native_walls, photographed_walls
from scripts.common.restoration_deblur import Ways, false_blur, quality
from scripts.common.restoration_sheet import SCENES, write_sheet
from scripts.common.restoration_tables import print_report
from scripts.common.restoration_weights import checksums, use_weights
from scripts.restoration.photographs import photographs

FALSE_BLURS_PX = (10.0, 20.0)
#: Frames so large where all has to go fast.
QUICK_SIZE = (640, 480)
SECTIONS = ("deepgyro", "false_blur", "colmap", "lsd2", "cost")
console = Console(stderr=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True, help="the folder of sharp photographs of the training")
    parser.add_argument("--scenes", type=int, default=4, help="how many, of each kind")
    parser.add_argument("--compared", type=int, default=2, help="scenes for false blur")
    parser.add_argument("--pairs", type=int, default=9, help="of short and long exposures, for each noise")
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2, help="for one picture")
    parser.add_argument(
        "--first-octave",
        type=int,
        choices=(-1, 0),
        default=-1,
        help="of SIFT, where matches count; 0 takes a quarter of the time of COLMAP's -1",
    )
    parser.add_argument(
        "--weights", type=Path, nargs="+", default=[], help="deepgyro.onnx, lsd2.onnx to use before the package's"
    )
    parser.add_argument(
        "--unet", type=Path, help="also the U-Net of the thesis, as train_restoration.py thesis_unet wrote it (ONNX)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="two scenes of 640 x 480, 10 and 20 px, a short reconstruction"
    )
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="these sections alone")
    parser.add_argument("--sheet", type=Path, help="write a contact sheet there (PNG)")
    parser.add_argument("--json", type=Path, help="also write all figures there")
    args = parser.parse_args()
    if min(args.scenes, args.compared, args.pairs) < 1:
        parser.error("--scenes, --compared, --pairs: at least 1")
    cv2.setNumThreads(1)
    metrics.set_first_octave(args.first_octave)
    with tempfile.TemporaryDirectory() as folder:
        if args.weights:
            use_weights(args.weights, Path(folder))
        try:
            run(args)
        except InertialError as error:
            raise SystemExit(f"restoration: {error}") from None


def run(args: argparse.Namespace) -> None:
    """Measure, print, write."""
    start = time.process_time()
    held_out = photographs(args.photos, held_out=True)
    scenes, compared, pairs = (2, 1, 2) if args.quick else (args.scenes, min(args.compared, args.scenes), args.pairs)
    size = QUICK_SIZE if args.quick else SIZE
    walls = photographed_walls(held_out, max(scenes, pairs), args.seed, colour=True)
    networks = checksums()

    def ways() -> Ways:
        network = load_network("deepgyro", threads=args.threads)
        found: dict[str, Any] = {"Wiener": _filtered, "DeepGyro": partial(_restored, network=network)}
        if args.unet:
            unet = Network.of(args.unet.read_bytes(), "deepgyro", source=str(args.unet), threads=args.threads)
            found["thesis's U-Net"] = partial(_restored, network=unet)
        return found

    def deepgyro_quality() -> dict[str, Any]:
        kinds = {"photographs": (walls[:scenes], size)}
        if not args.quick:
            kinds["whole photographs"] = (native_walls(held_out, scenes, args.seed, colour=True), None)
        return {
            kind: {
                f"{blur:g}": quality(
                    make_pairs(some, blur, size=px, seed=args.seed),
                    ways(),
                    label=f"{kind}, {blur:g} px",
                    console=console,
                )
                for blur in ((10.0, 20.0) if args.quick else BLURS_PX)
            }
            for kind, (some, px) in kinds.items()
        }

    def false() -> dict[str, Any]:
        return {
            f"{blur:g}": false_blur(
                make_pairs(walls[:compared], blur, size=size, seed=args.seed),
                ways(),
                label=f"{blur:g} px",
                console=console,
            )
            for blur in FALSE_BLURS_PX
        }

    sections: dict[str, Callable[[], Any]] = {
        "deepgyro": deepgyro_quality,
        "false_blur": false,
        "colmap": lambda: reconstructions(quick=args.quick),
        "lsd2": lambda: restoration_exposures.measure(
            walls[:pairs],
            load_network("lsd2", threads=args.threads),
            noises=restoration_exposures.NOISES[1:2] if args.quick else restoration_exposures.NOISES,
            size=QUICK_SIZE if args.quick else restoration_exposures.SIZE,
            seed=args.seed,
            console=console,
        ),
        "cost": lambda: restoration_cost.measure(
            make_pairs(walls[:1], 20.0, size=SIZE, seed=args.seed)[0], args.weights, 1 if args.quick else 5
        ),
    }
    report: dict[str, Any] = {"about": about(args) | {"held_out": len(held_out), "networks": networks}}
    for name in args.only or SECTIONS:
        if name == "lsd2" and "lsd2" not in networks:
            console.print("lsd2: no such network, left out")
            continue
        report[name] = sections[name]()
        report["about"]["cpu_s"] = round(time.process_time() - start)
        if args.json:
            args.json.write_text(json.dumps(report, indent=2) + "\n")
    if args.sheet:
        lsd2 = load_network("lsd2", threads=args.threads) if "lsd2" in networks else None
        deblur = ways()["DeepGyro"] if "deepgyro" in networks else None
        shown = photographed_walls(held_out, SCENES, args.seed, colour=True)
        write_sheet(args.sheet, shown, deblur, lsd2, size=restoration_exposures.SIZE, seed=args.seed)
    # tables are wide; a file has no width of its own
    print_report(report, Console() if sys.stdout.isatty() else Console(width=140))


def _filtered(image: UInt8Array, blur: BlurField) -> UInt8Array:
    return deblur(image, blur)


def _restored(image: UInt8Array, blur: BlurField, *, network: Network) -> UInt8Array:
    return deepgyro.deblur(image, BlurPath.straight(blur), network=network)


def reconstructions(*, quick: bool) -> dict[str, Any]:
    """The lively desk, without deblurring and by both ways."""
    ways = {
        "rectified": ReconstructOptions(deblur="off"),
        "Wiener": ReconstructOptions(deblur="wiener"),
        "DeepGyro": ReconstructOptions(deblur="deepgyro"),
    }
    with console.status("COLMAP"):
        found = imaging_colmap.reconstructed(imaging_colmap.lively_desk(quick=quick), 10.0, ways)
    ours, theirs = found["ways"]["DeepGyro"], found["ways"]["Wiener"]
    found["wanted"] = [
        ("images, DeepGyro / Wiener", ours["registered"] / max(theirs["registered"], 1), 1.0, True),
        ("points, DeepGyro / Wiener", ours["points"] / max(theirs["points"], 1), 1.0, True),
        ("camera error, DeepGyro / Wiener", ours["centre_error_pct"] / theirs["centre_error_pct"], 1.0, False),
    ]
    return {"10 px": found}


if __name__ == "__main__":
    main()
