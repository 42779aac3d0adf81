#!/usr/bin/env python3
"""Models with wrong cameras: how many scales are given, right and trusted, and which cameras are lost.

    python -m scripts.studies.consensus [--tracked FOLDER] [--reconstructed FOLDER] [--cases one three] [--json FILE]

``--tracked`` holds TUM-VI rooms and EuRoC flights (``real_imu.py``), whose poses get errors of 2 mm and .07 degrees;
``--reconstructed`` holds InertialScale recordings (``poses.txt``, ``groundtruth.txt``). Windows: 30 keyframes at 2, 3
and 4 a second, and video of 20, 40 and 60 s. In each, cameras are made wrong as a reconstruction makes them wrong: one
or three of 30 turned by 10 to 90 degrees and moved, or a block of 10 to 40 % turned by 10 to 60 degrees as a whole.
``moved`` are three in another place, turned rightly; ``foreign`` takes another recording's IMU. Each row: windows, how
many scales are given, 95 % intervals that hold the truth (of all windows), trusted ones, how many of these are right,
windows in which exactly the wrong cameras are named (or the seams, to within two cameras), sound cameras lost (%), rms
error (%), median half-width (%), and median time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import quat_exp, quat_multiply, quat_rotate
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial.scale import estimate_scale
from scripts.benchmarks.scale import read as read_reconstructed, recordings_in
from scripts.common.bench_report import write_report
from scripts.common.real_imu import Window, windows
from scripts.studies.scale_real import read_window

CASES = ("clean", "one", "three", "block", "foreign", "moved")
#: Frames a second and length; keyframes are 30.
KINDS = {"K2": (2.0, 15.0), "K3": (3.0, 10.0), "K4": (4.0, 7.5)} | {f"V{s}": (20.0, float(s)) for s in (20, 40, 60)}
NOISE_M = 0.002


@dataclass(frozen=True, kw_only=True)
class Task:
    """A window, and what is done to it."""

    folder: Path
    kind: str
    case: str
    window: Window
    other: Window | None
    seed: int


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was made of a window; error and sigma of the logarithm of the scale, None where it was refused."""

    recording: str
    kind: str
    case: str
    cameras: int
    left_out: int
    verdict: str
    error: float | None
    sigma: float | None
    wrong: tuple[int, ...]
    named: tuple[int, ...]
    seams: tuple[int, ...]
    seconds: float
    reasons: tuple[str, ...]


def spread_windows(folder: Path, length_s: float, most: int) -> list[Window]:
    """Windows of a length over each recording of a folder."""
    if not (folder / "room1_imu.csv.xz").exists():
        out = []
        for one in recordings_in(folder):
            t_s = read_reconstructed(one)[0].t_s
            for begin_s in np.linspace(t_s[0], max(t_s[-1] - length_s, t_s[0]), min(most, int(60 // length_s))):
                out.append(
                    Window(
                        recording=one.name,
                        length_s=length_s,
                        begin_s=float(begin_s),
                        end_s=float(begin_s + length_s),
                        noise_m=0.0,
                        correlation_s=0.0,
                        seed=len(out),
                    )
                )
        return out
    return windows(folder, (length_s,), (NOISE_M,), most=most)


def thinned(trajectory: CameraTrajectory, rate_hz: float) -> CameraTrajectory:
    """The frames nearest to a rate."""
    t_s = trajectory.t_s
    wanted = np.arange(t_s[0], t_s[-1], 1 / rate_hz)
    return trajectory.select(np.unique(np.argmin(np.abs(t_s[:, None] - wanted), axis=0)))


def damage(
    trajectory: CameraTrajectory, case: str, rng: np.random.Generator
) -> tuple[CameraTrajectory, tuple[int, ...], tuple[int, ...]]:
    """A trajectory with wrong cameras, their indices, and the first cameras after each seam."""
    n = len(trajectory)
    pose, centre = trajectory.cam_from_world_xyzw.copy(), trajectory.cam_in_world.copy()
    size = float(np.linalg.norm(np.ptp(centre, axis=0)))

    def turn(low_deg: float, high_deg: float) -> Array:
        axis = rng.standard_normal(3)
        return quat_exp(np.radians(rng.uniform(low_deg, high_deg)) * axis / np.linalg.norm(axis))

    wrong: tuple[int, ...] = ()
    seams: tuple[int, ...] = ()
    if case in ("one", "three", "moved"):
        wrong = tuple(sorted(rng.choice(n, 1 if case == "one" else 3, replace=False).tolist()))
        for i in wrong:
            if case != "moved":
                pose[i] = quat_multiply(turn(10, 90), pose[i])
            away = rng.standard_normal(3)
            centre[i] += size * rng.uniform(0.1, 2) * away / np.linalg.norm(away)
    elif case == "block":
        length = round(n * rng.uniform(0.1, 0.4))
        first = int(rng.integers(0, n - length + 1))
        block, by = slice(first, first + length), turn(10, 60)
        pose[block] = quat_multiply(pose[block], by * [-1, -1, -1, 1])
        middle = centre[block].mean(axis=0)
        shift = rng.standard_normal(3)
        shift *= size * rng.uniform(0, 0.5) / np.linalg.norm(shift)
        centre[block] = quat_rotate(by, centre[block] - middle) + middle + shift
        seams = tuple(i for i in (first, first + length) if 0 < i < n)
    return replace(trajectory, cam_from_world_xyzw=pose, cam_in_world=centre), wrong, seams


@one_blas_thread()
def run(task: Task) -> Outcome:
    """Damage a window, estimate its scale and compare."""
    rng = np.random.default_rng([11, task.seed])
    trajectory, imu, truth = read_window(task.folder, task.window)
    trajectory = thinned(trajectory, KINDS[task.kind][0])
    if task.other is not None:
        imu = read_window(task.folder, task.other)[1]
    damaged, wrong, seams = damage(trajectory, task.case, rng)
    begin_s = time.perf_counter()
    estimate = estimate_scale(damaged, imu)
    seconds = time.perf_counter() - begin_s
    check = getattr(estimate, "rotations", None)
    given = estimate.metres_per_unit
    place = {name: i for i, name in enumerate(damaged.names)}
    return Outcome(
        recording=task.window.recording,
        kind=task.kind,
        case=task.case,
        cameras=len(trajectory),
        left_out=0 if check is None else int((~check.kept).sum()),
        verdict=estimate.verdict,
        error=None if given is None else float(np.log(given / truth)),
        sigma=estimate.sigma_log,
        wrong=wrong,
        named=()
        if check is None
        else tuple(place[name] for name in (*(one.name for one in check.wrong), *check.moved)),
        seams=(*seams, -1, *(() if check is None else (place[one.name] for one in check.seams))),
        seconds=seconds,
        reasons=sentences(estimate.reasons),
    )


def found(outcome: Outcome) -> bool:
    """Whether what is wrong was named and nothing else was: wrong cameras exactly, seams to within two cameras."""
    middle = outcome.seams.index(-1)
    true, said = outcome.seams[:middle], outcome.seams[middle + 1 :]
    if outcome.case == "block":
        # a short block is a few wrong cameras
        edges = {*said, *outcome.named, *(i + 1 for i in outcome.named)}
        return all(any(abs(i - j) <= 2 for j in edges) for i in true)
    return set(outcome.named) == set(outcome.wrong) and not said


def row(outcomes: Sequence[Outcome]) -> str:
    """The figures of a case."""
    given = [o for o in outcomes if o.error is not None and o.sigma is not None]
    inside = [abs(o.error) <= Z95 * o.sigma for o in given]  # type: ignore[operator, arg-type]
    trusted = [ok for o, ok in zip(given, inside, strict=True) if o.verdict == "trusted"]
    sound = sum(o.cameras - len(o.wrong) for o in outcomes if o.case != "block")
    lost = sum(o.left_out - len(set(o.named) & set(o.wrong)) for o in outcomes if o.case != "block")
    rms = 100 * float(np.sqrt(np.mean([o.error**2 for o in given if o.error is not None]))) if given else float("nan")
    width = 100 * Z95 * float(np.median([o.sigma for o in given if o.sigma is not None])) if given else float("nan")
    return (
        f"{len(outcomes):5d}{len(given):7d}{sum(inside):8d}{len(trusted):9d}{sum(trusted):7d}"
        f"{sum(map(found, outcomes)):7d}{100 * lost / max(sound, 1):7.2f}{rms:8.2f}{width:8.2f}"
        f"{np.median([o.seconds for o in outcomes]):8.2f}"
    )


def tasks_of(folder: Path, kinds: Sequence[str], cases: Sequence[str], most: int) -> list[Task]:
    """Every case in every window of a folder; the IMU of ``foreign`` is that of the next recording."""
    out = []
    for kind in kinds:
        spread = spread_windows(folder, KINDS[kind][1], most)
        names = list(dict.fromkeys(w.recording for w in spread))
        for i, window in enumerate(spread):
            for case in cases:
                others = [w for w in spread if w.recording == names[(names.index(window.recording) + 1) % len(names)]]
                other = others[i % len(others)] if case == "foreign" else None
                seed = 1000 * list(KINDS).index(kind) + 10 * i + CASES.index(case)
                out.append(Task(folder=folder, kind=kind, case=case, window=window, other=other, seed=seed))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracked", type=Path)
    parser.add_argument("--reconstructed", type=Path)
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--most", type=int, default=4, help="windows of a length in each recording")
    parser.add_argument("--json", type=Path, help="write every outcome")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    folders = [folder for folder in (args.tracked, args.reconstructed) if folder is not None]
    tasks = [task for folder in folders for task in tasks_of(folder, args.kinds, args.cases, args.most)]
    with multiprocessing.Pool(args.processes) as pool:
        outcomes = list(pool.imap(run, tasks))
    print(
        f"{'':<16}{'n':>5}{'given':>7}{'inside':>8}{'trusted':>9}{'right':>7}{'found':>7}{'lost%':>7}{'rms%':>8}"
        f"{'+-%':>8}{'s':>8}"
    )
    for case in args.cases:
        for group in ("K", "V"):
            of = [o for o in outcomes if o.case == case and o.kind.startswith(group)]
            if of:
                print(f"{case + ', ' + ('keyframes' if group == 'K' else 'video'):<18}"[:16] + row(of))
    if args.json:
        write_report(args.json, {"outcomes": [asdict(outcome) for outcome in outcomes]})


if __name__ == "__main__":
    main()
