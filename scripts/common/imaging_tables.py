"""The imaging benchmark's report as tables, each figure beside what is wanted of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

#: Least ratio of correct matches, by blur.
MATCHES_WANTED = {"6": 1.4, "10": 1.9, "20": 3.3, "30": 6.0}
#: Least share of a sharp frame's matches that is kept, and of blurred frames that are treated.
KEPT_WANTED, TREATED_WANTED = 0.98, 0.9


def print_report(report: dict[str, Any], console: Console) -> None:
    """Print every section."""
    print_about(report["about"], console)
    for kind, by_blur in report.get("quality", {}).items():
        _quality(kind, by_blur, console)
    for kind, by_blur in report.get("treated", {}).items():
        _treated(kind, by_blur, console)
    sections = {
        "other_ways_20_px": _other_ways,
        "cost": _cost,
        "false_blur_10_px": _false_blur,
        "rolling_shutter": _shutter,
        "colmap": reconstructions,
    }
    for name, section in sections.items():
        if name in report:
            section(report[name], console)


def print_about(about: dict[str, Any], console: Console) -> None:
    """Print the machine, versions and options of a run on one line."""
    flat = {
        k: v for key, value in about.items() for k, v in (value if isinstance(value, dict) else {key: value}).items()
    }
    console.print(", ".join(f"{key} {value}" for key, value in flat.items()), style="dim", highlight=False)


def verdict(value: float, wanted: float, *, least: bool = True) -> str:
    """What is wanted, and whether it is met."""
    good = value >= wanted if least else value <= wanted
    return f"[{'green' if good else 'red'}]{'>=' if least else '<='} {wanted:g}[/]"


def table_of(title: str, *columns: str) -> Table:
    """A table whose first column is text."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    return table


def _quality(kind: str, by_blur: dict[str, Any], console: Console) -> None:
    table = table_of(
        f"Quality, {kind}: nothing -> gated default",
        *("blur px", "median", "deblurred", "correct matches", "ratio", "wanted"),
        *("least, median, most", "repeatability", "localisation px", "PSNR dB", "SSIM"),
    )
    for blur, row in by_blur.items():
        a, b = row["nothing"], row["gated"]
        table.add_row(
            blur,
            f"{row['median_blur_px']:.1f}",
            f"{row['deblurred_frames']}/{2 * row['pairs']}",
            f"{a['correct']:.0f} -> {b['correct']:.0f}",
            f"{row['ratio']:.2f}",
            verdict(row["ratio"], MATCHES_WANTED[blur]) if blur in MATCHES_WANTED else "",
            ", ".join(f"{r:.2f}" for r in np.percentile(row["ratio_of_each_scene"], [0, 50, 100])),
            f"{a['repeatability']:.3f} -> {b['repeatability']:.3f}",
            f"{a['localisation_px']:.3f} -> {b['localisation_px']:.3f}",
            f"{a['psnr_db']:.2f} -> {b['psnr_db']:.2f}",
            f"{a['ssim']:.3f} -> {b['ssim']:.3f}",
        )
    console.print(table)


def _other_ways(ways: dict[str, Any], console: Console) -> None:
    table = table_of("At 20 px", "way", "correct matches", "repeatability", "localisation px", "PSNR dB", "SSIM")
    for name, row in ways.items():
        measures = [
            f"{row[key]:.{digits}f}" if key in row else "-"
            for key, digits in (("repeatability", 3), ("localisation_px", 3), ("psnr_db", 2), ("ssim", 3))
        ]
        table.add_row(name, f"{row['correct']:.0f}", *measures)
    console.print(table)


def _cost(cost: dict[str, Any], console: Console) -> None:
    table = table_of(
        f"Processor time, grey 1080p, {cost['blur_px']} px (median {cost['median_blur_px']}), 8 bit to 8 bit",
        *("way", "ms", "times ours", "wanted"),
    )
    wanted = {"spatial_wiener_2d": 10.0, "richardson_lucy_one_psf": 50.0, "richardson_lucy_blocks": 50.0}
    for name, ms in cost["ms_cpu"].items():
        times = cost["times_faster"].get(name)
        text = "" if times is None else f"{times:.1f}"
        table.add_row(name, f"{ms:.1f}", text, verdict(times, wanted[name]) if name in wanted else "")
    console.print(table)
    share = cost["share_of_colmap_sift"]
    console.print(f"share of COLMAP's SIFT: {100 * share:.2f} % {verdict(100 * share, 1.0, least=False)}")


def _treated(kind: str, by_blur: dict[str, Any], console: Console) -> None:
    table = table_of(
        f"Blurred frames that are treated, {kind}",
        *(
            "blur px",
            "treated",
            "wanted",
            "gyroscope trusted",
            "sigmas",
            "extents times",
            "why the others are left alone",
        ),
    )
    for blur, row in by_blur.items():
        table.add_row(
            blur,
            f"{row['treated']}/{row['frames']}",
            verdict(row["treated"] / row["frames"], TREATED_WANTED),
            str(row["trusted"]),
            f"{row['support']:.1f}",
            f"{row['extent_factor']:.2f}",
            "; ".join(row["left_alone"]),
        )
    console.print(table)


def _false_blur(errors: dict[str, Any], console: Console) -> None:
    table = table_of(
        "False blur, 10 px: correct matches against doing nothing",
        *("error", "filter", "kept", "wanted", "frames deblurred", "gyroscope trusted", "sigmas", "extents times"),
    )
    for error, by_filter in errors.items():
        for name, row in by_filter.items():
            table.add_row(
                error,
                name,
                f"{row['kept']:.3f}",
                verdict(row["kept"], KEPT_WANTED),
                f"{row['deblurred_frames']}/{row['frames']}",
                str(row["trusted"]),
                f"{row['support']:.1f}",
                f"{row['extent_factor']:.2f}",
            )
    console.print(table)


def _shutter(row: dict[str, Any], console: Console) -> None:
    table = table_of(
        f"Rolling shutter, two views, readout {1e3 * row['readout_s']:.0f} ms, {row['rate_rad_s']:g} rad/s",
        *("keypoints", "rotation deg", "90th", "direction deg", "inliers"),
    )
    for name in ("as filmed", "rectified"):
        one = row[name]
        table.add_row(
            name,
            f"{one['rotation_deg']:.3f}",
            f"{one['rotation_deg_90th']:.3f}",
            f"{one['direction_deg']:.2f}",
            f"{one['inliers']:.3f}",
        )
    best = row["rectified"]
    table.add_row("wanted", verdict(best["rotation_deg"], 0.2, least=False), "", "", verdict(best["inliers"], 0.98))
    console.print(table)


def reconstructions(scenes: dict[str, Any], console: Console) -> None:
    """Print what COLMAP made of scenes, by treatment."""
    for name, row in scenes.items():
        table = table_of(
            f"COLMAP, {name}: {row['images']} images, {row['blur_px']:.0f} px, readout {1e3 * row['readout_s']:.0f} ms",
            *("treatment", "registered", "points", "camera error %", "rotation deg"),
        )
        for way, one in row["ways"].items():
            table.add_row(
                way,
                f"{one['registered']}/{row['images']}",
                f"{one['points']}",
                f"{one['centre_error_pct']:.3f}",
                f"{one['rotation_deg']:.3f}",
            )
        console.print(table)
        for label, value, wanted, least in row["wanted"]:
            console.print(f"{label}: {value:.3g} {verdict(value, wanted, least=least)}")
