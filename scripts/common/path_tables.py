"""The report of ``scripts/benchmarks/path.py`` as tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich.console import Console

from scripts.common.imaging_tables import print_about, table_of

#: Least ratio of summed matches at first octave 0 by bin, and least PSNR gained, dB: gyroscope exact; with errors.
WANTED: dict[str, dict[str, dict[str, float]]] = {
    "wiener": {
        "exact": {"3-8": 1.15, "8-15": 1.7, "15-25": 2.1, ">25": 2.4, "dB": 0.8},
        "errors": {"3-8": 1.1, "8-15": 1.5, "15-25": 1.5, ">25": 1.3, "dB": 0.0},
    },
    "path": {
        "exact": {"8-15": 2.0, "15-25": 2.6, ">25": 3.2, "dB": 2.3},
        "errors": {"dB": 0.0},
    },
}
TREATED, KEPT = 0.9, 0.98
#: Least change of the PSNR of a treated frame, dB.
LEAST_DB = -0.1
#: Of the time of `wiener`.
TIMES = {"path": {"10": 2.4, "20": 2.4, "40": 4.0}}


def print_report(report: dict[str, Any], console: Console) -> None:
    """Print every section."""
    print_about(report["about"], console)
    for name, beyond in report.get("pairs_beyond", {}).items():
        console.print(f"{name}: left out {beyond['more']} pairs with more blur, {beyond['less']} with less")
    sections = {
        "quality": _quality,
        "gate": _gate,
        "sky": _sky,
        "false": _false,
        "short": _short,
        "cost": _cost,
        "colour": _colour,
        "colmap": _colmap,
    }
    for name, section in sections.items():
        if report.get(name):
            section(report[name], console)


def _verdict(value: float, wanted: float | None, text: str, *, least: bool = True) -> str:
    if wanted is None:
        return text
    good = value >= wanted if least else value <= wanted
    return f"[{'green' if good else 'red'}]{text} ({'>=' if least else '<='} {wanted:g})[/]"


def _quality(found: dict[str, Any], console: Console) -> None:
    octaves = [key for key in next(iter(found["untreated"].values())) if key.startswith("octave")]
    for place in found["untreated"]:
        base = found["untreated"][place]
        table = table_of(
            f"{place} px: {base['pairs']} pairs, untreated {base['psnr_db']:.2f} dB",
            *("way", "PSNR gained dB", "pairs with less"),
            *(f"{what} ({octave})" for octave in octaves for what in ("sums", "median", "mean")),
        )
        for way, by_bin in found.items():
            if way == "untreated":
                continue
            method, _, gyro = way.rpartition(", ")
            wanted = WANTED.get(method, {}).get(gyro, {})
            row = by_bin[place]
            cells = [
                way,
                _verdict(row["gained_db"], None if place == "all" else wanted.get("dB"), f"{row['gained_db']:+.2f}"),
                f"{row['worse_share']:.0%}",
            ]
            for octave in octaves:
                one = row[octave]
                aim = wanted.get(place) if octave == "octave 0" else None
                cells += [
                    _verdict(one["ratio_of_sums"], aim, f"{one['ratio_of_sums']:.2f}"),
                    f"{one['median_ratio']:.2f}",
                    f"{one['mean_ratio']:.2f}",
                ]
            table.add_row(*cells)
        untreated = ", ".join(f"{octave}: {base[octave]['untreated']} correct matches" for octave in octaves)
        console.print(table)
        console.print(f"untreated, {untreated}", style="dim")


def _gate(found: dict[str, Any], console: Console) -> None:
    bins = sorted(
        {b for row in found.values() for b in row["treated"]}, key=lambda b: float(b.strip(">").split("-")[0])
    )
    table = table_of(
        "The gate: frames treated that are blurred, and matches kept of those that are not",
        *("exposure", *(f"{b} px" for b in bins), "sharp recording", "sharp among blurred", "sharp video", "trusted"),
    )
    for name, row in found.items():
        cells = []
        for b in bins:
            one = row["treated"].get(b)
            share = None if one is None else one["treated"] / one["frames"]
            cells.append("" if share is None else _verdict(share, TREATED, f"{one['treated']}/{one['frames']}"))
        for key in ("sharp recording", "sharp among blurred", "sharp video"):
            one = row[key]
            cells.append(_verdict(one["kept"], KEPT, f"{one['kept']:.3f} ({one['treated']} treated)"))
        table.add_row(name, *cells, str(row["trusted"]))
    console.print(table)


def _print_rows(
    title: str, rows: list[dict[str, Any]], columns: dict[str, Callable[[dict[str, Any]], str]], console: Console
) -> None:
    """A table of rows, beginning with the gyroscope and the blur."""
    table = table_of(title, "gyroscope", "blur px", *columns)
    for row in rows:
        table.add_row(row["gyroscope"], f"{row['blur_px']:g}", *(cell(row) for cell in columns.values()))
    console.print(table)


def _treated_share(row: dict[str, Any]) -> str:
    return f"{row['treated']}/{row['frames']}"


def _sky(rows: list[dict[str, Any]], console: Console) -> None:
    def treated(row: dict[str, Any]) -> str:
        wanted = TREATED if row["gyroscope"] == "right" else None
        return _verdict(row["treated"] / row["frames"], wanted, _treated_share(row))

    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "sky": lambda row: f"{row['sky']:.0%}",
        "trusted": lambda row: str(row["trusted"]),
        "sigmas": lambda row: f"{row['support']:.1f}",
        "treated": treated,
    }
    _print_rows("Mostly sky", rows, columns, console)


def _false(rows: list[dict[str, Any]], console: Console) -> None:
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "method": lambda row: row["method"],
        "trusted": lambda row: str(row["trusted"]),
        "kept": lambda row: _verdict(row["kept"], KEPT, f"{row['kept']:.3f}"),
        "treated": _treated_share,
        "PSNR gained dB": lambda row: f"{row['gained_db']:+.2f}",
        "worst": lambda row: _verdict(row["worst_db"], LEAST_DB, f"{row['worst_db']:+.2f}"),
    }
    _print_rows("Wrong gyroscopes: correct matches against doing nothing", rows, columns, console)


def _short(rows: list[dict[str, Any]], console: Console) -> None:
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "method": lambda row: row["method"],
        "untreated matches": lambda row: str(row["untreated"]),
        "times": lambda row: f"{row['ratio']:.3f}",
        "PSNR gained dB": lambda row: f"{row['gained_db']:+.2f}",
    }
    _print_rows("Little blur in pictures of 640 px, treated against untreated", rows, columns, console)


def _cost(found: dict[str, Any], console: Console) -> None:
    names = list(next(iter(found.values()))["ms"])
    table = table_of("Processor time, one core, grey 1080p, ms (times wiener)", "blur px", *names)
    for blur, row in found.items():
        cells = []
        for name in names:
            times = row["times_wiener"][name]
            text = f"{row['ms'][name]:.1f} (x{times:.1f})"
            cells.append(_verdict(times, TIMES.get(name, {}).get(blur), text, least=False))
        table.add_row(f"{blur} (departs by {row['departure_px']:.1f})", *cells)
    console.print(table)


def _colour(found: dict[str, Any], console: Console) -> None:
    columns = list(next(iter(found.values())))
    table = table_of("Colour: PSNR gained, dB; ms of a 1080p frame by threads, least of several", "way", *columns)
    for way, row in found.items():
        table.add_row(way, *(f"{row[c]:+.2f}" if c.endswith("px") else f"{row[c]:.1f}" for c in columns))
    console.print(table)
    for name in dict.fromkeys(way.split(",")[0] for way in found):
        old, new = (found[f"{name}, {way}"] for way in ("each channel", "luma and chroma"))
        share, faster = new["cpu_ms_1"] / old["cpu_ms_1"], new["wall_ms_1"] / new["wall_ms_2"]
        console.print(f"{name}: {share:.2f} of the processor time; two threads are {faster:.2f} times as fast")


def _colmap(found: dict[str, Any], console: Console) -> None:
    ways = list(next(iter(found["scenes"].values()))["ways"])
    table = table_of("COLMAP: registered, points, camera error % of the baseline", "scene", "images", *ways)
    for name, row in found["scenes"].items():
        cells = [f"{one['registered']}, {one['points']}, {one['centre_error_pct']:.3f}" for one in row["ways"].values()]
        table.add_row(name, str(row["images"]), *cells)
    console.print(table)
    for label, value, wanted, least in found["wanted"]:
        console.print(_verdict(value, wanted, f"{label}: {value:.3g}", least=least))
