#!/usr/bin/env python3
"""Coverage of the joint scale's intervals on simulated recordings, against the Cramer-Rao bound.

    python -m scripts.studies.scale [--runs 1000] [--stressed 300] [--unobservable 200] [--faulty 300]
                                  [--json study.json]
    python -m scripts.studies.scale --only 1000017

Recordings are drawn from what the estimator takes for granted (``scale/priors.py``), over phone, tablet and action
camera, and over motions round a subject, on foot and about a room, vigour 0.3 to 1 (log-uniform):

handheld       60 s. Gains, axis errors, biases, delays, lever arm, clock rate and gravity from the priors; the drift of
               the reconstruction is a random walk of |N(0, 1)| mm/sqrt(s) on each axis; the truth is
               exp(N(0, 0.5 %)) off for what the lens does to a model.
short          the same, 10 to 30 s: a fifth as many.
stressed       60 s, twice the accelerometer noise that the estimator assumes (the larger of data sheet and typical
               sensor, the sheet as without stress), and a drift of 1 cm/sqrt(s).
unobservable   constant velocity, pure rotation, tripod, too short for its motion, stabilised video, and the IMU of
               another recording of the same kind.
faulty         60 s of a sensor of its own (a third to thrice the preset's noise, of which no data sheet tells), with
               one of the faults of ``scale_faults.py``. Most of them the bound knows nothing of.

Each run has a seed that alone reproduces it: its millions tell the part, in the order above. Error and bound are those
of the logarithm of the scale and contain the model's scale; ``scale_bound.py`` computes the bound from the truth.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from colmap_inertial.core.facts import Fact, sentences
from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_multiply, quat_normalize
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial.core.priors import PRIORS, model_scale_sigma
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.inertial.scale._noise import TYPICAL
from colmap_inertial.inertial.scale.verdict import WEAK_HALF_WIDTH, half_width
from colmap_inertial.io.calibration import SIGMAS
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    SimulatedRecording,
    simulate_recording,
)
from scripts.common.bench_report import describe_run, write_report
from scripts.common.scale_bound import BoundPriors, bound_of
from scripts.common.scale_faults import FAULTS

PARTS = ("handheld", "short", "stressed", "unobservable", "faulty")
#: Those whose scale could be known.
OBSERVABLE = tuple(part for part in PARTS if part != "unobservable")
PART_SIZE = 1_000_000
DEVICES = ("phone", "tablet", "action_camera")
KINDS = ("orbit", "roam", "walk")
FUTILE = ("constant_velocity", "pure_rotation", "static", "too_short", "stabilised", "another_imu")
#: Too short: the bound is this far above the width at which a scale is refused.
FUTILE_MARGIN = 2.0
OBSERVABLE_HALF_WIDTH = 0.02


@dataclass(frozen=True, kw_only=True)
class Run:
    """One recording and what the estimator said; error, sigma and bound are of the logarithm of the scale."""

    seed: int
    part: str
    device: str
    kind: str
    duration_s: float
    vigour: float
    drift_m_rts: float
    verdict: str
    reasons: tuple[Fact, ...]
    error: float | None
    sigma: float | None
    bound: float
    seconds: float

    @property
    def inside(self) -> bool:
        """Whether the 95 % interval holds the truth."""
        return self.error is not None and self.sigma is not None and abs(self.error) <= 1.959963984540054 * self.sigma


def drawn(seed: int) -> tuple[RecordingOptions, str, str]:
    """Options of a seed's recording, what kind it is, and the device."""
    part, number = PARTS[seed // PART_SIZE], seed % PART_SIZE
    rng = np.random.default_rng([seed, 1])
    futile = FUTILE[number % len(FUTILE)] if part == "unobservable" else ""
    number = number // len(FUTILE) if futile else number
    device, kind = DEVICES[number % 3], KINDS[number // 3 % 3]
    imu = replace(
        IMU_PRESETS[device],
        gyro_scale_sd=PRIORS.gyro_gain,
        gyro_misalignment_sd=PRIORS.gyro_gain,
        accel_scale_sd=PRIORS.accel_gain,
        accel_misalignment_sd=PRIORS.accel_gain,
        accel_bias_m_s2_sd=PRIORS.accel_bias_m_s2,
        clock_rate_sd=PRIORS.clock_rate,
        lever_arm_m_sd=BoundPriors().imu_in_cam_m,
        accel_delay_s=(0.0, SIGMAS.accel_minus_gyro_offset_s),
    )
    vigour = float(np.exp(rng.uniform(np.log(0.3), 0.0)))
    duration_s = float(rng.uniform(10.0, 30.0)) if part == "short" else 60.0
    drift_m_rts = float(abs(rng.normal(0.0, 1e-3)))
    gravity_m_s2 = float(rng.normal(9.80665, PRIORS.gravity_m_s2))
    speed_m_s = 0.8
    if part == "stressed":
        assumed = max(imu.accel_density_m_s2_rthz, TYPICAL.accel_density_m_s2_rthz)
        imu, drift_m_rts = replace(imu, accel_density_m_s2_rthz=2 * assumed), 0.01
    if part == "faulty":
        louder = float(np.exp(rng.uniform(-np.log(3), np.log(3))))
        imu = replace(
            imu,
            accel_density_m_s2_rthz=louder * imu.accel_density_m_s2_rthz,
            gyro_density_rad_s_rthz=louder * imu.gyro_density_rad_s_rthz,
        )
    if futile:
        duration_s, speed_m_s = float(rng.uniform(10.0, 60.0)), float(rng.uniform(0.3, 1.5))
    if futile in ("constant_velocity", "pure_rotation", "static"):
        kind = futile
    if futile == "too_short":
        duration_s, vigour = float(rng.uniform(1.5, 4.0)), float(np.exp(rng.uniform(np.log(0.05), np.log(0.3))))
    options = RecordingOptions(
        motion=MotionOptions(kind=kind, duration_s=duration_s, vigour=vigour, speed_m_s=speed_m_s),
        imu=imu,
        sfm=SfmOptions(position_drift_m_rts=drift_m_rts),
        gravity_m_s2=gravity_m_s2,
    )
    return options, futile or kind, device


def recorded(seed: int) -> tuple[SimulatedRecording, RecordingOptions, str, str]:
    """A seed's recording as the estimator gets it, its options, kind and device."""
    options, kind, device = drawn(seed)
    recording = simulate_recording(options, seed=seed)
    sheet = IMU_PRESETS[device].noise()
    recording = replace(recording, imu=replace(recording.imu, noise=sheet))
    if kind == "too_short":
        while half_width(bound_of(recording, options)) < FUTILE_MARGIN * WEAK_HALF_WIDTH:
            shorter = replace(options.motion, duration_s=0.8 * options.motion.duration_s)
            options = replace(options, motion=shorter)
            recording = simulate_recording(options, seed=seed)
            recording = replace(recording, imu=replace(recording.imu, noise=sheet))
    elif kind == "stabilised":
        recording = replace(recording, trajectory=stabilised(recording.trajectory, options, seed))
    elif kind == "another_imu":
        other = simulate_recording(options, seed=seed + PART_SIZE // 2)
        recording = replace(recording, imu=replace(other.imu, noise=sheet))
    elif PARTS[seed // PART_SIZE] == "faulty":
        kind = list(FAULTS)[seed % len(FAULTS)]
        recording = replace(recording, imu=replace(recording.imu, noise=None))
        recording = FAULTS[kind](recording, np.random.default_rng([seed, 4]))
    return recording, options, kind, device


def stabilised(trajectory: CameraTrajectory, options: RecordingOptions, seed: int) -> CameraTrajectory:
    """Poses of a video whose rotations were smoothed over 0.3 to 1 s; the centres are the camera's."""
    from scipy.ndimage import gaussian_filter1d

    rng = np.random.default_rng([seed, 3])
    q = np.array(trajectory.cam_from_world_xyzw)
    q[1:] *= np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))[:, None]
    width = rng.uniform(0.3, 1.0) * options.sfm.frame_rate_hz
    smooth = quat_normalize(gaussian_filter1d(q, width, axis=0, mode="nearest"))
    seen = quat_exp(options.sfm.rotation_white_rad * rng.standard_normal((len(q), 3)))
    return replace(trajectory, cam_from_world_xyzw=quat_conjugate(quat_multiply(quat_conjugate(smooth), seen)))


@one_blas_thread()
def run(seed: int) -> Run:
    """Simulate, estimate, compare."""
    recording, options, kind, device = recorded(seed)
    lens = model_scale_sigma() * float(np.random.default_rng([seed, 2]).standard_normal())
    begin_s = time.perf_counter()
    estimate = estimate_scale(recording.trajectory, recording.imu)
    seconds = time.perf_counter() - begin_s
    error = None
    if estimate.metres_per_unit is not None:
        error = float(np.log(estimate.metres_per_unit / recording.truth.metres_per_unit) - lens)
    return Run(
        seed=seed,
        part=PARTS[seed // PART_SIZE],
        device=device,
        kind=kind,
        duration_s=options.motion.duration_s,
        vigour=options.motion.vigour,
        drift_m_rts=options.sfm.position_drift_m_rts,
        verdict=estimate.verdict,
        reasons=estimate.reasons,
        error=error,
        sigma=estimate.sigma_log,
        bound=bound_of(recording, options),
        seconds=seconds,
    )


def seeds(first: int, counts: Sequence[int]) -> list[int]:
    """Seeds of so many runs of each part."""
    return [part * PART_SIZE + first + i for part, count in enumerate(counts) for i in range(count)]


def summary(runs: Sequence[Run]) -> dict[str, float]:
    """Figures of runs whose scale could be known; the nan of no runs where there are none."""
    given = [r for r in runs if r.error is not None and r.sigma is not None]
    error, sigma = (np.array([getattr(r, name) for r in given], dtype=float) for name in ("error", "sigma"))
    bound = np.array([r.bound for r in given])
    n = max(len(given), 1)
    covered = sum(r.inside for r in given) / n
    observable = [r for r in runs if half_width(r.bound) <= OBSERVABLE_HALF_WIDTH]
    trusted = [r for r in runs if r.verdict == "trusted"]

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")

    return {
        "runs": len(runs),
        "coverage": covered,
        "coverage_error": float(np.sqrt(covered * (1 - covered) / n)),
        "bias_sigmas": float(np.mean(error / sigma)) if len(error) else float("nan"),
        "bias_sigmas_error": n**-0.5,
        "rms_error": rms(error),
        "rms_sigma": rms(sigma),
        "rms_bound": rms(bound),
        "rms_over_bound": rms(error) / rms(bound) if len(error) else float("nan"),
        "rms_of_error_over_bound": rms(error / bound),
        "trusted": len(trusted),
        "weak": sum(r.verdict == "weak" for r in runs),
        "refused": sum(r.verdict == "refused" for r in runs),
        "observable": len(observable),
        "trusted_of_observable": sum(r.verdict == "trusted" for r in observable) / max(len(observable), 1),
        "trusted_outside": sum(not r.inside for r in trusted),
        "inside_or_not_trusted": sum(r.inside or r.verdict != "trusted" for r in runs) / max(len(runs), 1),
        "seconds": float(np.median([r.seconds for r in runs])) if runs else float("nan"),
    }


def groups(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs of each part but the unobservable ones, and those of its devices and motions."""
    out = {}
    for part in OBSERVABLE:
        of_part = [r for r in runs if r.part == part]
        if of_part:
            out[part] = of_part
            kinds = tuple(FAULTS) if part == "faulty" else KINDS
            for name, values in (("device", DEVICES), ("kind", kinds)):
                out |= {f"{part} {v}": [r for r in of_part if getattr(r, name) == v] for v in values}
    return {name: members for name, members in out.items() if members}


def show(runs: Sequence[Run]) -> None:
    """Tables and findings on the terminal."""
    # Not cut where the output goes to a file
    console = Console(width=None if sys.stdout.isatty() else 170)
    columns: dict[str, Callable[[dict[str, float]], str]] = {
        "runs": lambda s: f"{s['runs']}",
        "95 % holds": lambda s: f"{100 * s['coverage']:.1f}+-{100 * s['coverage_error']:.1f} %",
        "bias/sigma": lambda s: f"{s['bias_sigmas']:+.2f}+-{s['bias_sigmas_error']:.2f}",
        "rms error": lambda s: f"{100 * s['rms_error']:.2f} %",
        "sigma": lambda s: f"{100 * s['rms_sigma']:.2f} %",
        "bound": lambda s: f"{100 * s['rms_bound']:.2f} %",
        "rms/bound": lambda s: f"{s['rms_over_bound']:.2f}",
        "trusted/weak/refused": lambda s: f"{s['trusted']}/{s['weak']}/{s['refused']}",
        "observable trusted": lambda s: f"{100 * s['trusted_of_observable']:.0f} % of {s['observable']}",
        "trusted & outside": lambda s: f"{s['trusted_outside']}",
        "s": lambda s: f"{s['seconds']:.1f}",
    }
    table = Table(title="Scale: targets are 93-97 %, bias below 0.1, rms/bound up to 1.3, trusted at least 90 %")
    table.add_column("", no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for name, members in groups(runs).items():
        figures = summary(members)
        label = "  " + name.split(" ")[1] if " " in name else name
        table.add_row(label, *(text(figures) for text in columns.values()), style="bold" if label == name else None)
    console.print(table)
    _print_observable(runs, console)
    _print_unobservable([r for r in runs if r.part == "unobservable"], console)


def _print_observable(runs: Sequence[Run], console: Console) -> None:
    """Why runs were not trusted, and which intervals miss the truth."""
    for part in OBSERVABLE:
        odd = [r for r in runs if r.part == part and (r.verdict != "trusted" or not r.inside)]
        counts = Counter(reason.code for r in odd for reason in r.reasons)
        for code, count in counts.most_common(8):
            console.print(f"{part}: {count} x {code}", markup=False)
        for r in sorted((r for r in odd if r.error is not None and not r.inside), key=lambda r: r.seed):
            z = abs(r.error or 0) / (r.sigma or 1)
            console.print(f"{part}: seed {r.seed} is {z:.1f} sigma off, {r.verdict}", markup=False)
    stressed = [r for r in runs if r.part == "stressed"]
    if stressed:
        share = 100 * summary(stressed)["inside_or_not_trusted"]
        console.print(f"stressed: {share:.1f} % inside the interval or not trusted (target: at least 90 %)")


def _print_unobservable(futile: Sequence[Run], console: Console) -> None:
    """How many were refused, and what was said of the others."""
    for kind in FUTILE:
        of_kind = [r for r in futile if r.kind == kind]
        if of_kind:
            refused = sum(r.verdict == "refused" for r in of_kind)
            console.print(f"unobservable: {kind}: {refused} of {len(of_kind)} refused", markup=False)
        for r in of_kind:
            if r.verdict != "refused":
                off = f"{100 * (r.error or 0):+.1f} % off, sigma {100 * (r.sigma or 0):.1f} %"
                console.print(f"  seed {r.seed}: {r.verdict}, {off}; {' | '.join(sentences(r.reasons))}", markup=False)


def study(todo: Sequence[int], processes: int) -> list[Run]:
    """Run all seeds, with a progress bar on the error stream."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    done = []
    bar = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*bar, console=Console(stderr=True)) as progress, multiprocessing.Pool(processes) as pool:
        task = progress.add_task("", total=len(todo))
        for result in pool.imap_unordered(run, todo):
            done.append(result)
            progress.advance(task)
    return sorted(done, key=lambda r: r.seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000, help="of 60 s; a fifth as many short ones are added")
    parser.add_argument("--stressed", type=int, default=300)
    parser.add_argument("--unobservable", type=int, default=200)
    parser.add_argument("--faulty", type=int, default=300)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--seed", type=int, default=0, help="number of the first run of each part")
    parser.add_argument("--json", type=Path, help="where to write figures and all runs")
    parser.add_argument("--only", type=int, metavar="SEED", help="details of a single run")
    arguments = parser.parse_args()
    if arguments.only is not None:
        print(json.dumps(asdict(run(arguments.only)), indent=2))
        return
    counts = (arguments.runs, arguments.runs // 5, arguments.stressed, arguments.unobservable, arguments.faulty)
    begun_in = describe_run()
    runs = study(seeds(arguments.seed, counts), arguments.processes)
    show(runs)
    if arguments.json:
        figures = {name: summary(members) for name, members in groups(runs).items()}
        content = {**begun_in, "summary": figures, "runs": [asdict(r) for r in runs]}
        write_report(arguments.json, content)


if __name__ == "__main__":
    main()
