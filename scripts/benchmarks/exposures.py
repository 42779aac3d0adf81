"""Exposure pairs of all kinds: how many are refused, blended wrongly, or worse than an input.

    python -m scripts.benchmarks.exposures [--photos FOLDER] [--motion FOLDER] [--pairs N] [--wrong N] [--width PX]
        [--triplets FOLDER] [--json FILE]

Pairs are simulated (``simulated_exposures.py``): scenes of photographs that no network was trained on, or drawn ones;
the camera turns as recorded (gyroscopes of TUM-VI rooms in ``--motion``), or as the package's simulator has it; much or
little texture, repeated texture, clipping, glints, darkness; a quarter of the picture's width between the exposures in
every second group; every second two groups without a gyroscope; every third pair without stated exposures. Good pairs
must be aligned and blended, and the result be no worse (PSNR against the short exposure without noise) than the better
one of the short exposure, brightened, and the long one; beside it, than the long one aligned. Wrong pairs, of two
scenes, must not be blended. ``--triplets`` takes pictures in the layout of the LSD2 paper's data (``short``, ``long``
and ``sharp``).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from colmap_inertial.core.arrays import AnyArray, UInt8Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.imaging.exposure_pairs import better_alone, bring_together, replace_departures
from colmap_inertial.imaging.restoration import Network, load_network, lsd2
from scripts.common.bench_report import write_report
from scripts.common.simulated_exposures import Pair, pairs
from scripts.common.turning_world import Turning
from scripts.restoration.photographs import photographs

ROOMS = ("room1", "room3", "room5")
console = Console(stderr=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, help="a folder of sharp photographs; those held out are used")
    parser.add_argument("--motion", type=Path, help="a folder of recordings: room1_imu.csv.xz and so on")
    parser.add_argument("--pairs", type=int, default=42, help="good ones")
    parser.add_argument("--wrong", type=int, default=21, help="of two scenes")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--triplets", type=Path, help="also short, long and sharp pictures in folders of these names")
    parser.add_argument("--json", type=Path, help="also write all figures there")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    photos = [] if args.photos is None else photographs(args.photos, held_out=True)
    turnings = (
        [Turning.simulated(k) for k in range(3)]
        if args.motion is None
        else [Turning.recorded(args.motion, name) for name in ROOMS]
    )
    network = load_network("lsd2", device="cpu", threads=1)
    report: dict[str, Any] = {}
    for good, count in ((True, args.pairs), (False, args.wrong)):
        makers = pairs(turnings, photos, count, args.seed, width=args.width, good=good)
        rows = [_row(make(), i, network) for i, make in enumerate(track(makers, "pairs", console=console))]
        report["good" if good else "wrong"] = {"summary": _summary(rows), "pairs": rows}
    if args.triplets is not None:
        rows = [_row(pair, i, network) for i, pair in enumerate(_triplets(args.triplets))]
        report["triplets"] = {"summary": _summary(rows), "pairs": rows}
    for name, found in report.items():
        _print(name, found)
    write_report(args.json, report)


def _row(pair: Pair, i: int, network: Network) -> dict[str, Any]:
    """Every figure of one pair."""
    row: dict[str, Any] = {"kind": pair.kind, "gain": pair.gain}
    try:
        found = bring_together(pair.short, pair.long, gyro=pair.gyro, stated_gain=pair.gain if i % 3 else None)
    except NotObservableError as error:
        return row | {"blended": False, "why": error.hint, "used": better_alone(pair.short, pair.long, None).used}
    blended = found.registered.alike
    row |= {
        "blended": blended,
        "agreement": found.registered.agreement,
        "by_gyro": found.registered.by_gyro,
        "gain_error_pct": 100 * (found.brightness.gain / pair.gain - 1),
        "clipped": float(found.clipped.mean()),
        "used": "both" if blended else better_alone(pair.short, pair.long, found.brightness).used,
    }
    if np.isfinite(pair.shift_px).any():
        rows, columns = pair.shift_px.shape[:2]
        off = np.linalg.norm(found.registered.shift_px[:rows, :columns] - pair.shift_px, axis=2)
        row["shift_px"] = float(np.nanmedian(np.linalg.norm(pair.shift_px, axis=2)))
        row["shift_error_px"] = float(np.nanmedian(off))
    if pair.good:
        by_network = lsd2.fuse(found.short, found.long, blur=found.blur, network=network)
        fused = replace_departures(by_network, found.short)
        row["psnr_db"] = {
            "short": psnr_db(found.short, pair.truth),
            "long": psnr_db(pair.long / 255, pair.truth),
            "long, aligned": psnr_db(found.long, pair.truth),
            "by network": psnr_db(by_network, pair.truth),
            "fused": psnr_db(fused, pair.truth),
        }
        of = row["psnr_db"]
        row["gained_db"] = of["fused"] - max(of["short"], of["long"])
        row["over_aligned_db"] = of["fused"] - max(of["short"], of["long, aligned"])
    return row


def psnr_db(image: AnyArray, truth: UInt8Array) -> float:
    """Of 0 to 1 against codes."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1) - truth / 255) ** 2)))


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    gained = [row["gained_db"] for row in rows if "gained_db" in row]
    out: dict[str, Any] = {"pairs": len(rows), "blended": sum(row["blended"] for row in rows)}
    if gained:
        out |= {
            "worse": sum(bool(g < 0) for g in gained),
            "least_gained_db": min(gained),
            "median_gained_db": float(np.median(gained)),
            "least_over_aligned_db": min(row["over_aligned_db"] for row in rows if "gained_db" in row),
        }
    return out


def _triplets(folder: Path) -> list[Pair]:
    found = []
    for path in sorted((folder / "sharp").rglob("*.png")):
        short, long, sharp = (
            np.asarray(cv2.imread(str(next((folder / kind).rglob(path.name))), cv2.IMREAD_COLOR_RGB))
            for kind in ("short", "long", "sharp")
        )
        unknown = np.full((1, 1, 2), np.nan)
        found.append(
            Pair(kind=path.name, short=short, long=long, truth=sharp, gyro=None, gain=1.0, good=True, shift_px=unknown)
        )
    return found


def _print(name: str, found: dict[str, Any]) -> None:
    table = Table(title=name, title_justify="left")
    for column in (
        "kind",
        "blended",
        "used",
        "agreement",
        "shift px",
        "error px",
        "gain error %",
        "short",
        "long",
        "by network",
        "fused",
        "gained dB",
    ):
        table.add_column(column, justify="left" if column == "kind" else "right")

    def shown(value: float | None, digits: int = 2) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    for row in found["pairs"]:
        psnr = row.get("psnr_db", {})
        table.add_row(
            row["kind"],
            "yes" if row["blended"] else "no",
            row["used"],
            shown(row.get("agreement")),
            shown(row.get("shift_px"), 1),
            shown(row.get("shift_error_px"), 1),
            shown(row.get("gain_error_pct"), 1),
            *(shown(psnr.get(key)) for key in ("short", "long", "by network", "fused")),
            shown(row.get("gained_db")),
        )
    Console(width=140).print(table)
    print(name, ", ".join(f"{key} {value}" for key, value in found["summary"].items()))


if __name__ == "__main__":
    main()
