"""Scale errors on InertialScale recordings by method and window, beside published ones.

    python -m scripts.benchmarks.scale FOLDER [--figure FILE.png] [--json FILE] [--sensitivity]

FOLDER holds recordings (``poses.txt``, ``gyroscope.txt``, ``accelerometer.txt``) with ``groundtruth.txt``: metres per
model unit. Windows: the first so many seconds of a recording; the first so many metres of the camera's path, its length
taken with the true scale from positions averaged over 0.2 s; and the first minute cut into equal parts. Each starts
from nothing but its own frames and the IMU recording: the alignment is estimated anew.

Methods: ``joint`` and ``spectral`` of the package, ``linear`` of ``linear_scale.py`` (a baseline without an interval),
and for comparison the ``published`` figures of Mustaniemi et al. (IROS 2017): their own code on their 15 recordings,
of which FOLDER may hold some only.

Printed per method and window: the errors in % of the recordings, mean, median and largest absolute error of those that
were not refused, how many 95 % intervals hold the truth (a refusal counts as a miss), their median half-width, the
refusals, and the median processor time of alignment and estimate together, on one thread. Last, what ``joint`` states
where the true sizes of the other recordings of the same window are known, as those of targets.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.inertial.core.target_comparison import TargetComparison, calibrate_by_targets
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.motion.align import align_camera_imu
from scripts.common.bench_report import describe_run, write_report
from scripts.common.linear_scale import estimate_linear

METHODS = ("joint", "spectral", "linear")
SECONDS = (60.0, 30.0, 20.0, 10.0, 5.0)
METRES = (1.0, 2.0, 4.0, 8.0)
PARTS = (2, 3, 6, 12)
PARTED_S = 60.0
#: Mean, median and largest absolute error in % over all 15 recordings, and errors of some at 60 s.
PUBLISHED = {
    "first 60 s": (1.23, 0.85, 3.52),
    "first 30 s": (1.95, 2.00, 4.39),
    "first 20 s": (2.54, 2.14, 7.34),
    "first 10 s": (1.84, 2.03, 4.75),
    "first 5 s": (5.48, 3.19, 20.1),
    "first 2 m": (4.61, 2.30, 17.3),
}
PUBLISHED_60_S = {
    **{"D1": -1.99, "D3": 0.71, "D5": 0.63, "D7": 0.63},
    **{"D9": -3.52, "D11": -0.85, "D13": -3.10, "D15": 0.73},
}


@dataclass(frozen=True, kw_only=True)
class Window:
    """Frames ``begin_s <= t <= end_s`` of a recording; ``group`` names windows of the same kind and length."""

    folder: Path
    group: str
    begin_s: float
    end_s: float

    @property
    def recording(self) -> str:
        return self.folder.name

    def read(self) -> tuple[CameraTrajectory, ImuRecording, float]:
        """Its frames, the whole IMU recording, the true metres per unit."""
        trajectory, imu, truth = read(self.folder)
        return trajectory.select((trajectory.t_s >= self.begin_s) & (trajectory.t_s <= self.end_s)), imu, truth


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a method made of a window; errors and half-width in %, None where refused or not given."""

    recording: str
    group: str
    begin_s: float
    duration_s: float
    method: str
    error: float | None
    half_width: float | None
    inside: bool
    verdict: str
    cpu_s: float
    accel_sigma_log: float | None = None
    sigma_log: float | None = None

    def compared(self) -> TargetComparison:
        """The estimate beside its true size."""
        assert self.error is not None and self.accel_sigma_log is not None and self.sigma_log is not None
        return TargetComparison(
            error_log=math.log1p(0.01 * self.error),
            accel_sigma_log=self.accel_sigma_log,
            sigma_log=math.sqrt(self.sigma_log**2 - self.accel_sigma_log**2),
            target=self.recording,
            target_sigma_log=0.0,
        )


@functools.lru_cache
def read(folder: Path) -> tuple[CameraTrajectory, ImuRecording, float]:
    """A recording and its true metres per unit."""
    return *read_inertial_scale(folder), float((folder / "groundtruth.txt").read_text())


def recordings_in(folder: Path) -> list[Path]:
    """Recordings with a ground truth, in natural order."""
    found = [path.parent for path in folder.glob("*/groundtruth.txt")]
    if not found:
        raise SystemExit(f"{folder}: no recording with a groundtruth.txt")
    return sorted(found, key=lambda path: (len(path.name), path.name))


def path_length_m(trajectory: CameraTrajectory, metres_per_unit: float) -> tuple[Array, Array]:
    """Times and lengths of the path up to then; of positions averaged over 0.2 s, as noise would lengthen it."""
    cell = ((trajectory.t_s - trajectory.t_s[0]) / 0.2).astype(int)
    cell = np.unique(cell, return_inverse=True)[1]
    columns = np.column_stack([trajectory.t_s, trajectory.cam_in_world * metres_per_unit])
    means = np.stack([np.bincount(cell, column) / np.bincount(cell) for column in columns.T], axis=1)
    steps = np.linalg.norm(np.diff(means[:, 1:], axis=0), axis=1)
    return means[:, 0], np.concatenate([[0.0], np.cumsum(steps)])


def first_windows(folder: Path, seconds: Sequence[float], metres: Sequence[float]) -> list[Window]:
    """From a recording's begin; a path that is shorter than asked for gives no window."""
    trajectory, _, truth = read(folder)
    begin_s = float(trajectory.t_s[0])
    out = [Window(folder=folder, group=f"first {s:g} s", begin_s=begin_s, end_s=begin_s + s) for s in seconds]
    t_s, length_m = path_length_m(trajectory, truth)
    for wanted in metres:
        if length_m[-1] >= wanted:
            end_s = float(np.interp(wanted, length_m, t_s))
            out.append(Window(folder=folder, group=f"first {wanted:g} m", begin_s=begin_s, end_s=end_s))
    return out


def part_windows(folder: Path, parts: Sequence[int]) -> list[Window]:
    """The first minute cut into equal parts."""
    trajectory, _, _ = read(folder)
    begin_s = float(trajectory.t_s[0])
    out = []
    for count in parts:
        edges = np.linspace(begin_s, min(float(trajectory.t_s[-1]), begin_s + PARTED_S), count + 1)
        for first, last in itertools.pairwise(edges):
            group = f"{count} parts of {PARTED_S / count:g} s"
            out.append(Window(folder=folder, group=group, begin_s=float(first), end_s=float(last)))
    return out


def run(task: tuple[Window, str]) -> Outcome:
    """One method on one window."""
    window, method = task
    trajectory, imu, truth = window.read()
    start = time.process_time()
    scale: float | None = None
    interval, verdict = None, "-"
    sigma_log: float | None = None
    accel: float | None = None
    if method == "linear":
        try:
            scale = estimate_linear(trajectory, imu, align_camera_imu(trajectory, imu)).metres_per_unit
        except NotObservableError:
            verdict = "refused"
    else:
        estimate = estimate_scale(trajectory, imu, options=ScaleOptions(method=method))
        scale, interval, verdict = estimate.metres_per_unit, estimate.ci95, estimate.verdict
        sigma_log, accel = estimate.sigma_log, (estimate.parts or {}).get("accel_gain")
    cpu_s = time.process_time() - start
    low, high = interval or (np.nan, np.nan)
    return Outcome(
        recording=window.recording,
        group=window.group,
        begin_s=window.begin_s - float(read(window.folder)[0].t_s[0]),
        duration_s=window.end_s - window.begin_s,
        method=method,
        error=None if scale is None else 100 * (scale / truth - 1),
        half_width=None if scale is None or interval is None else 50 * (high - low) / scale,
        inside=bool(low <= truth <= high),
        verdict=verdict,
        cpu_s=cpu_s,
        accel_sigma_log=accel,
        sigma_log=sigma_log,
    )


def each(function: Callable[[Any], Any], tasks: Sequence[Any], processes: int, title: str) -> list[Any]:
    """Map, with a progress bar on a terminal; results in the order of the tasks."""
    show = {"description": title, "total": len(tasks), "transient": True, "console": Console(stderr=True)}
    if processes == 1:
        return list(track(map(function, tasks), **show))
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        return list(track(pool.imap(function, tasks), **show))


def summary(outcomes: Sequence[Outcome]) -> dict[str, float | int]:
    """Figures of one method's outcomes; NaN where there are none."""
    errors = np.abs([o.error for o in outcomes if o.error is not None])
    widths = [o.half_width for o in outcomes if o.half_width is not None]
    return {
        "windows": len(outcomes),
        "mean": float(errors.mean()) if len(errors) else np.nan,
        "median": float(np.median(errors)) if len(errors) else np.nan,
        "max": float(errors.max()) if len(errors) else np.nan,
        "inside": sum(o.inside for o in outcomes),
        "half_width": float(np.median(widths)) if widths else np.nan,
        "refused": sum(o.error is None for o in outcomes),
        "cpu_s": float(np.median([o.cpu_s for o in outcomes])),
    }


def grouped(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], list[Outcome]]:
    """By group and method, in the order of appearance."""
    out: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        out.setdefault((outcome.group, outcome.method), []).append(outcome)
    return out


def _cell(value: float | None, width: int, digits: int = 2) -> str:
    return ("refused" if value is None else "-" if np.isnan(value) else f"{value:.{digits}f}").rjust(width)


def _figures(label: str, rows: Sequence[Outcome], middle: str) -> str:
    s = summary(rows)
    errors = "".join(_cell(s[name], 8) for name in ("mean", "median", "max"))
    interval = f"{s['inside']}/{s['windows']}" if s["half_width"] == s["half_width"] else "-"
    return f"{label}{middle}{errors}{interval:>9}{_cell(s['half_width'], 7, 1)}{s['refused']:>9}{_cell(s['cpu_s'], 7)}"


_HEADINGS = f"{'mean':>8}{'median':>8}{'max':>8}{'inside':>9}{'+-%':>7}{'refused':>9}{'cpu s':>7}"


def print_first(outcomes: Sequence[Outcome], names: Sequence[str]) -> None:
    """The table with a column for each recording."""
    print(f"{'window':<12}{'method':<11}" + "".join(f"{name:>8}" for name in names) + _HEADINGS)
    by_group = grouped(outcomes)
    for group in dict.fromkeys(group for group, _ in by_group):
        published = PUBLISHED.get(group)
        if published:
            blank = " " * 8 * len(names)
            print(f"{group:<12}{'published':<11}{blank}" + "".join(_cell(value, 8) for value in published))
        here = [PUBLISHED_60_S[name] for name in names if name in PUBLISHED_60_S]
        if group == "first 60 s" and here:
            row = "".join(_cell(PUBLISHED_60_S.get(name, np.nan), 8) for name in names)
            figures = (np.mean(np.abs(here)), np.median(np.abs(here)), np.max(np.abs(here)))
            print(f"{group:<12}{' of these':<11}{row}" + "".join(_cell(float(value), 8) for value in figures))
        for (of, method), rows in by_group.items():
            if of == group:
                errors = {row.recording: row.error for row in rows}
                cells = "".join(_cell(errors.get(name, np.nan), 8) for name in names)
                print(_figures(f"{group:<12}{method:<11}", rows, cells))


def print_parts(outcomes: Sequence[Outcome]) -> None:
    """The table of equal parts, by length and pooled."""
    print(f"{'windows':<20}{'method':<11}" + _HEADINGS)
    for (group, method), rows in grouped(outcomes).items():
        print(_figures(f"{group:<20}{method:<11}", rows, ""))
    for method in dict.fromkeys(o.method for o in outcomes):
        rows = [o for o in outcomes if o.method == method]
        share = 100 * sum(o.inside for o in rows) / len(rows)
        note = "" if method == "linear" else f"  inside {share:.1f} %"
        print(_figures(f"{'pooled':<20}{method:<11}", rows, "") + note)


def print_compared(outcomes: Sequence[Outcome]) -> None:
    """Intervals of each recording where the sizes of the others are known."""
    print(f"{'compared':<12}{'recordings':>11}{'factor':>8}{'inside':>9}{'+-%':>7}")
    for (group, method), rows in grouped(outcomes).items():
        usable = [row for row in rows if method == "joint" and row.error is not None]
        factors, widths, inside = [], [], 0
        for row in usable if len(usable) > 1 else ():
            factor = calibrate_by_targets(
                [other.compared() for other in usable if other is not row], gravity_m_s2=9.81
            ).accel_factor
            mine = row.compared()
            half_width = Z95 * math.hypot(mine.sigma_log, (factor or 1.0) * mine.accel_sigma_log)
            factors.append(factor)
            widths.append(100 * math.sinh(half_width))
            inside += abs(mine.error_log) <= half_width
        if factors:
            figures = f"{np.median(factors):8.2f}{f'{inside}/{len(factors)}':>9}{np.median(widths):7.1f}"
            print(f"{group:<12}{len(factors):>11}{figures}")


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Mean absolute error against the length of the window, first so many seconds, and the joint half-width."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    colours = {"joint": "#0b6e4f", "spectral": "#d17a00", "linear": "#8a8a8a", "published": "#b3123c"}
    rows = [o for o in outcomes if o.group.startswith("first") and o.group.endswith(" s")]
    figure, axes = plt.subplots(figsize=(7.2, 5.0), layout="constrained")

    def line(method: str, points: dict[float, float], style: str, label: str) -> None:
        lengths = sorted(points)
        axes.plot(lengths, [points[s] for s in lengths], style, color=colours[method], label=label)

    def by_length(method: str, figure_of: str) -> dict[float, float]:
        groups = [(group, found) for (group, of), found in grouped(rows).items() if of == method]
        return {float(group.split()[1]): float(summary(found)[figure_of]) for group, found in groups}

    line("published", {float(g.split()[1]): v[0] for g, v in PUBLISHED.items() if g.endswith(" s")}, "s-", "published")
    for method in (m for m in reversed(METHODS) if any(o.method == m for o in rows)):
        line(method, by_length(method, "mean"), "o-", method)
    joint = [o for o in rows if o.method == "joint" and o.error is not None]
    if joint:
        line("joint", by_length("joint", "half_width"), "--", "joint, median half-width of the 95 % interval")
        lengths = [float(o.group.split()[1]) for o in joint]
        axes.plot(lengths, [abs(o.error or 0) for o in joint], ".", color=colours["joint"], alpha=0.35, ms=5)
    ticks = sorted({float(o.group.split()[1]) for o in rows})
    axes.set(xscale="log", yscale="log", xlabel="first seconds of the recording", ylabel="absolute scale error, %")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.set_ylim(bottom=0.1)
    axes.grid(True, which="major", alpha=0.3)
    names = len({o.recording for o in rows})
    axes.set_title(f"Mean over {names} recordings (published: 15); dots: single recordings, joint", fontsize=10)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--seconds", nargs="*", type=float, default=SECONDS, help="windows from the begin, s")
    parser.add_argument("--metres", nargs="*", type=float, default=METRES, help="windows from the begin, m of path")
    parser.add_argument("--parts", nargs="*", type=int, default=PARTS, help="equal parts of the first minute")
    parser.add_argument("--figure", type=Path, help="draw error against window length")
    parser.add_argument("--json", type=Path, help="write every outcome, machine, versions and commit")
    parser.add_argument("--sensitivity", action="store_true", help="instead: the joint method's constants, each varied")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args(arguments)

    folders = recordings_in(args.folder)
    result = describe_run()
    if args.sensitivity:
        from scripts.common.scale_sensitivity import study

        result["sensitivity"] = study(folders, args.processes)
    else:
        first = [window for folder in folders for window in first_windows(folder, args.seconds, args.metres)]
        parts = [window for folder in folders for window in part_windows(folder, args.parts)]
        order = [f"first {s:g} s" for s in args.seconds] + [f"first {m:g} m" for m in args.metres]
        first.sort(key=lambda window: order.index(window.group))
        parts.sort(key=lambda window: int(window.group.split()[0]))
        tasks = [(window, method) for window in (*first, *parts) for method in args.methods]
        outcomes: list[Outcome] = each(run, tasks, args.processes, "estimating")
        of_first, of_parts = outcomes[: len(first) * len(args.methods)], outcomes[len(first) * len(args.methods) :]
        if of_first:
            print_first(of_first, [folder.name for folder in folders])
            print()
            print_compared(of_first)
        if of_parts:
            print()
            print_parts(of_parts)
        if args.figure:
            draw(of_first, args.figure)
        result["outcomes"] = [asdict(outcome) for outcome in outcomes]
    write_report(args.json, result)


if __name__ == "__main__":
    main()
