"""The restoration benchmark's report as tables, each figure beside what is wanted of it."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from scripts.common.imaging_tables import print_about, reconstructions, table_of, verdict
from scripts.common.restoration_exposures import BASELINES

#: Of DeepGyro over the Wiener filter, both gated; of LSD2 over the best of the other ways.
PSNR_WANTED_DB, MATCHES_WANTED = 2.0, 1.2
KEPT_WANTED = 0.99
SECONDS_WANTED = 1.5


def print_report(report: dict[str, Any], console: Console) -> None:
    """Print every section."""
    print_about(report["about"], console)
    for kind, by_blur in report.get("deepgyro", {}).items():
        for blur, row in by_blur.items():
            _deepgyro(kind, blur, row, console)
    if "false_blur" in report:
        _false_blur(report["false_blur"], console)
    if "colmap" in report:
        reconstructions(report["colmap"], console)
    for noise, row in report.get("lsd2", {}).items():
        _lsd2(noise, row, console)
    if "cost" in report:
        _cost(report["cost"], console)


def _deepgyro(kind: str, blur: str, found: dict[str, Any], console: Console) -> None:
    for errors in ("no error", "usual errors"):
        rows = found[errors]["rows"]
        table = table_of(
            f"DeepGyro, {kind}, {blur} px, gyroscope with {errors}: {found['pairs']} pairs",
            *("way", "PSNR dB", "SSIM", "correct matches", "of nothing", "of Wiener", "precision", "repeatability"),
            *("localisation px",),
        )
        for name, row in rows.items():
            wiener = rows.get(name.replace("DeepGyro", "Wiener"), {}) if "DeepGyro" in name else {}
            table.add_row(
                name,
                f"{row['psnr_db']:.2f}",
                f"{row['ssim']:.3f}",
                f"{row['correct']:.0f}",
                f"{row['correct'] / max(rows['nothing']['correct'], 1):.2f}",
                f"{row['correct'] / max(wiener['correct'], 1):.2f}" if wiener else "",
                f"{row['correct'] / max(row['found'], 1):.3f}",
                f"{row['repeatability']:.3f}",
                f"{row['localisation_px']:.3f}",
            )
        console.print(table)
        _gain("gated", rows, console)
        _gain("ungated", rows, console)
        counts = ", ".join(f"{name} {count}" for name, count in found[errors]["deblurred_frames"].items())
        console.print(
            f"deblurred by the gate, of {2 * found['pairs']} frames: {counts}; {found[errors]['verdict']}", style="dim"
        )


def _gain(which: str, rows: dict[str, Any], console: Console) -> None:
    ours, theirs = rows[f"DeepGyro {which}"], rows[f"Wiener {which}"]
    db, ratio = ours["psnr_db"] - theirs["psnr_db"], ours["correct"] / max(theirs["correct"], 1)
    console.print(
        f"DeepGyro against Wiener, {which}: {db:+.2f} dB {verdict(db, PSNR_WANTED_DB)}, "
        f"{ratio:.2f} times the matches {verdict(ratio, MATCHES_WANTED)}"
    )


def _false_blur(by_blur: dict[str, Any], console: Console) -> None:
    table = table_of(
        "Sharp frames with false blur: correct matches as a share of those before", "way", *(f"{b} px" for b in by_blur)
    )
    for name in next(iter(by_blur.values()))["rows"]:
        shares = [found["rows"][name]["kept"] for found in by_blur.values()]
        table.add_row(name, *(f"{share:.3f} {verdict(share, KEPT_WANTED)}" for share in shares))
    console.print(table)


def _lsd2(noise: str, found: dict[str, Any], console: Console) -> None:
    rows = found["rows"]
    table = table_of(
        f"Short and long, noise {noise} at half of full scale: {found['scenes']} pairs, {found['aligned_by_gyro']} "
        f"aligned by the gyroscope; non-local means at {found['nlm_strength']:g}",
        *("way", "PSNR dB", "SSIM", "correct matches with a clean view", "precision"),
    )
    for name, row in rows.items():
        # exposure fusion has a brightness of its own: it cannot be compared with the truth
        likeness = ("-", "-") if name.startswith("Mertens") else (f"{row['psnr_db']:.2f}", f"{row['ssim']:.3f}")
        table.add_row(name, *likeness, f"{row['correct']}", f"{row['correct'] / max(row['found'], 1):.3f}")
    console.print(table)
    ours = rows["LSD2"]
    db = ours["psnr_db"] - max(rows[name]["psnr_db"] for name in BASELINES)
    ratio = ours["correct"] / max(1, *(rows[name]["correct"] for name in BASELINES))
    console.print(
        f"LSD2 against the best of the ways above it: {db:+.2f} dB {verdict(db, PSNR_WANTED_DB)}, "
        f"{ratio:.2f} times the matches {verdict(ratio, 1.0)}"
    )


def _cost(cost: dict[str, Any], console: Console) -> None:
    width, height = cost["size"]
    table = table_of(
        f"Cost of {width} x {height} in colour, {cost['threads']} threads (SIFT: one), {cost['blur_px']} px of blur; "
        f"load average {cost['load_average']} before",
        *("what", "wall s", "processor s", "DeepGyro takes times"),
    )
    times = cost["times"]
    for name, row in times.items():
        ratio = times["DeepGyro"]["wall_s"] / row["wall_s"]
        table.add_row(name, f"{row['wall_s']:.3f}", f"{row['cpu_s']:.3f}", f"{ratio:.2f}")
    console.print(table)
    wall = times["DeepGyro"]["wall_s"]
    console.print(f"DeepGyro: {wall:.2f} s {verdict(wall, SECONDS_WANTED, least=False)}")
    if cost["mib"]:
        before, peak = cost["mib"]["before"], cost["mib"]["peak"]
        console.print(f"memory: {peak:.0f} MiB at most, {peak - before:.0f} more than with the network just loaded")
