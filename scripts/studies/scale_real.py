#!/usr/bin/env python3
"""Scale errors, coverage and verdicts on real IMUs with motion capture.

    python -m scripts.studies.scale_real FOLDER [--most 8] [--calibrated] [--remembered] [--reconstructed FOLDER]

FOLDER holds TUM-VI rooms and EuRoC flights (``real_imu.py``). Whole recordings and windows of 20, 10, 5 and 3 s, with
errors of 0, .5, 2 and 5 mm that are alike over .1, .35 or 1 s, an arbitrary scale, axes and clock. The estimator is
told nothing of it. Each row: how many, signed mean, mean and rms of the error in %, how many 95 % intervals hold the
truth (of those that were given), how many are trusted and of these right, rms of error over standard deviation, median
half-width, refusals. Errors of 0 mm are the recordings' own. With ``--calibrated`` the handheld ones alone, each with
the accelerometer calibrated by the motion capture of the others (``capture_gains.py``).
With ``--remembered`` each has the lever arm that ``align`` finds in another recording of the rig.

Then, of 2 mm: errors of whole recordings, each by itself, and rms errors by recording with all, half and none of the
shift for noise in the path, the best of these by the other recordings, and what it makes of the one left out.
``--reconstructed`` adds InertialScale recordings (60 s, and parts of 20 and 10 s) to these. At last coverage of given
and of trusted intervals, by hand and flown (``interval_coverage.py``).
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.facts import sentences
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuCalibration, ImuRecording
from colmap_inertial.inertial.scale import estimate_scale, interval, learn_lever_arm
from colmap_inertial.inertial.scale._fit import Fit
from colmap_inertial.io.calibration import calibration_prior
from scripts.benchmarks.scale import read as read_reconstructed, recordings_in
from scripts.common.bench_report import write_report
from scripts.common.capture_gains import calibration_by
from scripts.common.interval_coverage import measure_coverage
from scripts.common.real_imu import HANDHELD, RECORDINGS, Window, recorded, windows

LENGTHS_S = (np.inf, 20.0, 10.0, 5.0, 3.0)
NOISES_M = (0.0, 0.0005, 0.002, 0.005)
#: Of poses that a reconstruction made: they have errors of their own.
TRACKED = float("nan")
#: What is taken of a reconstructed recording.
MINUTE_S = 60.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was made of a window; error and sigma of the logarithm of the scale, None where it was refused."""

    window: Window
    verdict: str
    error: float | None
    sigma: float | None
    reasons: tuple[str, ...]
    shift: float | None

    @property
    def holds(self) -> bool:
        """Whether the 95 % interval holds the truth; of one that was given."""
        assert self.error is not None and self.sigma is not None
        return abs(self.error) <= Z95 * self.sigma


@contextlib.contextmanager
def listening() -> Iterator[list[float]]:
    """Shifts of the scale that the joint fit makes, as they come."""
    shifts: list[float] = []
    scale_shift = interval.scale_shift

    def record_shift(fit: Fit) -> float:
        shifts.append(scale_shift(fit))
        return shifts[-1]

    interval.scale_shift = record_shift
    try:
        yield shifts
    finally:
        interval.scale_shift = scale_shift


def calibrations(folder: Path) -> dict[str, ImuCalibration]:
    """Of each handheld recording, by the others."""
    names = [name for name, (rig, _) in RECORDINGS.items() if rig is HANDHELD]
    return {name: calibration_by(folder, tuple(other for other in names if other != name)) for name in names}


def remembered(folder: Path) -> dict[str, CameraImuCalibration]:
    """Of each recording, what is known once the next one of its rig was aligned, with errors of 2 mm."""
    whole = {w.recording: w for w in windows(folder, (np.inf,), (0.002,))}
    out = {}
    for name, (rig, _) in RECORDINGS.items():
        of_rig = [other for other, (its, _) in RECORDINGS.items() if its is rig]
        other = of_rig[(of_rig.index(name) + 1) % len(of_rig)]
        trajectory, imu, _ = recorded(folder, whole[other])
        out[name] = learn_lever_arm(calibration_prior(), estimate_scale(trajectory, imu))
    return out


@one_blas_thread()
def run(task: tuple[Path, Window, ImuCalibration | None, CameraImuCalibration | None]) -> Outcome:
    """Estimate the scale of a window and compare."""
    folder, window, calibration, known = task
    trajectory, imu, truth = read_window(folder, window)
    if calibration is not None:
        imu = calibration.corrected(imu)
    with listening() as shifts:
        estimate = estimate_scale(trajectory, imu, calibration=known)
    given = estimate.metres_per_unit
    return Outcome(
        window=window,
        verdict=estimate.verdict,
        error=None if given is None else float(np.log(given / truth)),
        sigma=estimate.sigma_log,
        reasons=sentences(estimate.reasons),
        shift=None if given is None or not shifts else shifts[-1],
    )


def read_window(folder: Path, window: Window) -> tuple[CameraTrajectory, ImuRecording, float]:
    """A window of either kind of recording, with its IMU and the true metres per unit."""
    if window.recording in RECORDINGS:
        return recorded(folder, window)
    trajectory, imu, truth = read_reconstructed(folder / window.recording)
    t_s = trajectory.t_s
    return trajectory.select((t_s >= window.begin_s) & (t_s < window.end_s)), imu, truth


def windows_of_reconstructed(folder: Path, lengths_s: tuple[float, ...]) -> list[Window]:
    """The first minute of each InertialScale recording, and parts of it."""
    out = []
    for one in recordings_in(folder):
        start_s = float(read_reconstructed(one)[0].t_s[0])
        for length_s in lengths_s:
            part_s = min(length_s, MINUTE_S)
            for begin_s in start_s + part_s * np.arange(int(MINUTE_S // part_s)):
                out.append(
                    Window(
                        recording=one.name,
                        length_s=length_s,
                        begin_s=float(begin_s),
                        end_s=float(begin_s + part_s),
                        noise_m=TRACKED,
                        correlation_s=0.0,
                        seed=len(out),
                    )
                )
    return out


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


def print_shifts(outcomes: Sequence[Outcome]) -> None:
    """Errors by recording, with all, half and none of the shift, and by the best of these on the other recordings."""
    given = [
        o
        for o in outcomes
        if o.error is not None and o.shift is not None and (o.window.noise_m == 0.002 or np.isnan(o.window.noise_m))
    ]
    shares = np.array([1.0, 0.5, 0.0])
    for length_s in dict.fromkeys(o.window.length_s for o in given):
        of = [o for o in given if o.window.length_s == length_s]
        left = {
            name: np.array([o.error - (1 - shares) * o.shift for o in of if o.window.recording == name])  # type: ignore[operator]
            for name in dict.fromkeys(o.window.recording for o in of)
        }
        print(
            f"\n{'whole' if np.isinf(length_s) else f'{length_s:g} s'}: mean error with all of the shift; rms errors, %"
        )
        print(f"{'':<10}{'n':>4}{'mean':>8}{'all':>7}{'half':>7}{'none':>7}{'left out':>10}")
        best = {}
        for name, errors in left.items():
            others = np.concatenate([e for other, e in left.items() if other != name] or [errors])
            best[name] = int(np.argmin(np.mean(others**2, axis=0)))
            rms = 100 * np.mean(errors**2, axis=0) ** 0.5
            print(
                f"{name:<10}{len(errors):4d}{100 * errors[:, 0].mean():8.2f}{rms[0]:7.2f}{rms[1]:7.2f}{rms[2]:7.2f}"
                f"{rms[best[name]]:7.2f} {('all', 'half', 'none')[best[name]]}"
            )
        every = np.concatenate(list(left.values()))
        chosen = np.concatenate([errors[:, best[name]] for name, errors in left.items()])
        rms = 100 * np.mean(every**2, axis=0) ** 0.5
        print(
            f"{'together':<10}{len(every):4d}{100 * every[:, 0].mean():8.2f}{rms[0]:7.2f}{rms[1]:7.2f}{rms[2]:7.2f}"
            f"{100 * np.mean(chosen**2) ** 0.5:7.2f}"
        )


def print_coverage(outcomes: Sequence[Outcome]) -> None:
    """How often intervals hold the truth, of windows with errors."""
    given = [o for o in outcomes if o.error is not None and o.window.noise_m > 0]
    hands = {name for name, (rig, _) in RECORDINGS.items() if rig is HANDHELD}
    print()
    for verdicts in (("trusted", "weak"), ("trusted",)):
        for where, by_hand in (("all", (True, False)), ("by hand", (True,)), ("flown", (False,))):
            held: dict[str, list[bool]] = {}
            for o in given:
                if (
                    o.verdict in verdicts
                    and (o.window.recording in hands) in by_hand
                    and o.window.recording in RECORDINGS
                ):
                    held.setdefault(o.window.recording, []).append(o.holds)
            print(f"{'given' if len(verdicts) > 1 else 'trusted':<8}{where:<8} {measure_coverage(held)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lengths", nargs="+", type=float, default=LENGTHS_S, help="of windows, s; inf for whole")
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES_M, help="errors of the centres, m")
    parser.add_argument("--most", type=int, default=8, help="windows of a length in each recording")
    parser.add_argument("--seed", type=int, default=0, help="number of the first window")
    parser.add_argument("--calibrated", action="store_true", help="handheld ones, calibrated by each other's")
    parser.add_argument("--remembered", action="store_true", help="with the lever arm by another recording of the rig")
    parser.add_argument("--reconstructed", type=Path, help="InertialScale recordings, for the table of shifts")
    parser.add_argument("--json", type=Path, help="write every outcome")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    found = windows(args.folder, tuple(args.lengths), tuple(args.noises), most=args.most, first=args.seed)
    known = calibrations(args.folder) if args.calibrated else {}
    arms = remembered(args.folder) if args.remembered else {}
    used = [w for w in found if not args.calibrated or w.recording in known]
    tasks = [(args.folder, w, known.get(w.recording), arms.get(w.recording)) for w in used]
    others = windows_of_reconstructed(args.reconstructed, tuple(args.lengths)) if args.reconstructed else []
    with multiprocessing.Pool(args.processes) as pool:
        outcomes = pool.map(run, tasks, chunksize=1)
        more = pool.map(run, [(args.reconstructed, window, None, None) for window in others], chunksize=1)
    print(
        f"{'':<18}{'n':>4}{'signed':>8}{'mean':>7}{'rms':>7}{'inside':>8}{'trusted':>9}{'right':>7}{'z rms':>7}", end=""
    )
    print(f"{'+-%':>6}{'refused':>9}")
    for name, s in tables(outcomes).items():
        print(
            f"{name:<18}{s['windows']:4d}{s['signed']:8.2f}{s['mean']:7.2f}{s['rms']:7.2f}{s['inside']:8.0f}"
            f"{s['trusted']:9d}{s['right']:7.0f}{s['z_rms']:7.2f}{s['half_width']:6.1f}{s['refused']:9d}"
        )
    print_shifts([*outcomes, *more])
    print_coverage(outcomes)
    if args.json:
        write_report(args.json, {"outcomes": [asdict(outcome) for outcome in (*outcomes, *more)]})


if __name__ == "__main__":
    main()
