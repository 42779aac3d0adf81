#!/usr/bin/env python3
"""Scale errors on recordings of other sensors: real IMUs, motion capture with errors such as a reconstruction has.

    python scripts/study_scale_real.py FOLDER [--most 8] [--calibrated] [--json FILE]

FOLDER holds TUM-VI rooms and EuRoC flights (``real_imu.py``). Whole recordings and windows of 20, 10, 5 and 3 s, with
errors of 0, .5, 2 and 5 mm that are alike over .1, .35 or 1 s, an arbitrary scale, axes and clock. The estimator is
told nothing of it. Each row: how many, signed mean, mean and rms of the error in %, how many 95 % intervals hold the
truth (of those that were given), how many are trusted and of these right, rms of error over standard deviation, median
half-width, refusals. Errors of 0 mm are the recordings' own. With ``--calibrated`` the handheld ones alone, each with
the accelerometer calibrated by the motion capture of the others (``capture_gains.py``).
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from bench_report import write_report
from capture_gains import calibration_by
from real_imu import HANDHELD, RECORDINGS, Window, recorded, windows

from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import ImuCalibration
from colmap_inertial.inertial.scale import estimate_scale

LENGTHS_S = (np.inf, 20.0, 10.0, 5.0, 3.0)
NOISES_M = (0.0, 0.0005, 0.002, 0.005)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was made of a window; error and sigma of the logarithm of the scale, None where it was refused."""

    window: Window
    verdict: str
    error: float | None
    sigma: float | None
    reasons: tuple[str, ...]


def calibrations(folder: Path) -> dict[str, ImuCalibration]:
    """Of each handheld recording, by the others."""
    names = [name for name, (rig, _) in RECORDINGS.items() if rig is HANDHELD]
    return {name: calibration_by(folder, tuple(other for other in names if other != name)) for name in names}


@one_blas_thread()
def run(task: tuple[Path, Window, ImuCalibration | None]) -> Outcome:
    """Estimate the scale of a window and compare."""
    folder, window, calibration = task
    trajectory, imu, truth = recorded(folder, window)
    if calibration is not None:
        imu = calibration.corrected(imu)
    estimate = estimate_scale(trajectory, imu)
    given = estimate.metres_per_unit
    return Outcome(
        window=window,
        verdict=estimate.verdict,
        error=None if given is None else float(np.log(given / truth)),
        sigma=estimate.sigma_log,
        reasons=estimate.reasons,
    )


def summary(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Figures of outcomes; errors in %."""
    given = [o for o in outcomes if o.error is not None and o.sigma is not None]
    error = 100 * np.array([o.error for o in given], dtype=float)
    sigma = 100 * np.array([o.sigma for o in given], dtype=float)
    inside = np.abs(error) <= Z95 * sigma
    trusted = np.array([o.verdict == "trusted" for o in given], dtype=bool)

    def mean(values: np.ndarray) -> float:
        return float(np.mean(values)) if len(values) else float("nan")

    return {
        "windows": len(outcomes),
        "signed": mean(error),
        "mean": mean(np.abs(error)),
        "rms": mean(error**2) ** 0.5,
        "inside": 100 * mean(inside),
        "trusted": int(trusted.sum()),
        "right": 100 * mean(inside[trusted]),
        "z_rms": mean((error / sigma) ** 2) ** 0.5 if len(given) else float("nan"),
        "half_width": Z95 * float(np.median(sigma)) if len(given) else float("nan"),
        "refused": len(outcomes) - len(given),
    }


def tables(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Figures by length and error, and of all that have errors."""
    out = {}
    for length_s in dict.fromkeys(o.window.length_s for o in outcomes):
        for noise_m in dict.fromkeys(o.window.noise_m for o in outcomes):
            of = [o for o in outcomes if (o.window.length_s, o.window.noise_m) == (length_s, noise_m)]
            name = "whole" if np.isinf(length_s) else f"{length_s:g} s"
            out[f"{name}, {1000 * noise_m:g} mm"] = summary(of)
    for recording in dict.fromkeys(o.window.recording for o in outcomes):
        out[f"{recording}, all"] = summary([o for o in outcomes if o.window.recording == recording])
    out["all with errors"] = summary([o for o in outcomes if o.window.noise_m > 0])
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lengths", nargs="+", type=float, default=LENGTHS_S, help="of windows, s; inf for whole")
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES_M, help="errors of the centres, m")
    parser.add_argument("--most", type=int, default=8, help="windows of a length in each recording")
    parser.add_argument("--seed", type=int, default=0, help="number of the first window")
    parser.add_argument("--calibrated", action="store_true", help="handheld ones, calibrated by each other's")
    parser.add_argument("--json", type=Path, help="write every outcome")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    found = windows(args.folder, tuple(args.lengths), tuple(args.noises), most=args.most, first=args.seed)
    known = calibrations(args.folder) if args.calibrated else {}
    tasks = [(args.folder, w, known.get(w.recording)) for w in found if not args.calibrated or w.recording in known]
    with multiprocessing.Pool(args.processes) as pool:
        outcomes = pool.map(run, tasks, chunksize=1)
    print(
        f"{'':<18}{'n':>4}{'signed':>8}{'mean':>7}{'rms':>7}{'inside':>8}{'trusted':>9}{'right':>7}{'z rms':>7}", end=""
    )
    print(f"{'+-%':>6}{'refused':>9}")
    for name, s in tables(outcomes).items():
        print(
            f"{name:<18}{s['windows']:4d}{s['signed']:8.2f}{s['mean']:7.2f}{s['rms']:7.2f}{s['inside']:8.0f}"
            f"{s['trusted']:9d}{s['right']:7.0f}{s['z_rms']:7.2f}{s['half_width']:6.1f}{s['refused']:9d}"
        )
    if args.json:
        write_report(args.json, {"outcomes": [asdict(outcome) for outcome in outcomes]})


if __name__ == "__main__":
    main()
