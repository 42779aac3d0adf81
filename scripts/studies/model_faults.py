#!/usr/bin/env python3
"""Wrong models, clocks and sensors, made from real recordings: what is named, and what is trusted.

    python -m scripts.studies.model_faults FOLDER [--faults clock gain bias wxyz torn ...] [--power] [--json FILE]

FOLDER holds TUM-VI rooms and EuRoC flights (``real_imu.py``). Clips of 20, 40 and 60 s with errors of 2 mm are altered:
``clock`` camera stamps 1 % slow or fast; ``gain`` an accelerometer that reads 1 to 5 % too much or too little;
``bias`` one that is off by .45 m/s2 along an axis, which is no gain; ``wxyz`` quaternions in the other order; ``torn``
one end of the path 2, 3 or 5 % larger; ``drift`` a scale that grows by 3 or 5 % from end to end; ``stretch`` one
direction 3 or 5 % longer, volume kept; ``moved`` centres of three cameras alone wrong by .1 m. Each row: how many,
given, intervals that hold the truth, trusted, of these wrong and wrong by more than 1.5 times the interval, and how
often the fault was named. True metres are those of a torn path's larger part. At last, what must be
named: how often it is, and how often it must.

``--power``: of the torn and drifting ones that must be named, how often the clean fit's own information lets them be
found: by our test, and by one that knows the place and kind and accuses 2 % of sound models.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.inertial.scale import _shape as shape, estimate_scale
from scripts.common.bench_report import write_report
from scripts.common.real_imu import HANDHELD, RECORDINGS, Window, recorded, windows

LENGTHS_S = (20.0, 40.0, 60.0)
NOISE_M = 0.002
#: By fault: sizes, and parts of the codes of reasons and notes that name it.
FAULTS: dict[str, tuple[tuple[float, ...], tuple[str, ...]]] = {
    "clean": ((0.0,), ("scale-grows", "scale-breaks", "scale-varies", "model-stretched")),
    "clock": ((0.01, -0.01), ("clocks-run-apart", "imu-clock-stretched")),
    "gain": ((0.01, -0.01, 0.02, -0.02, 0.03, -0.03, 0.05, -0.05), ("gain",)),
    "bias": ((0.45,), ("gain",)),
    "wxyz": ((1.0,), ("convention",)),
    "torn": ((0.02, 0.03, 0.05), ("scale-grows", "scale-breaks", "scale-varies")),
    "drift": ((0.03, 0.05), ("scale-grows", "scale-breaks", "scale-varies")),
    "stretch": ((0.03, 0.05), ("model-stretched", "scale-grows", "scale-breaks", "scale-varies")),
    "moved": ((0.1,), ("poses-jump",)),
}
#: Fault, size, length of clips, recordings, and the least share that must be named.
REQUIRED = (
    ("torn", 0.03, 40.0, "all", 0.75),
    ("torn", 0.03, 40.0, "by hand", 0.9),
    ("torn", 0.05, 20.0, "all", 0.8),
    ("drift", 0.05, 20.0, "all", 0.6),
    ("stretch", 0.05, 60.0, "all", 0.9),
)
#: Of clean clips, the largest share that may be named.
FALSE_ALARMS = 0.02


def list_codes(facts: Iterable[Any]) -> Iterator[str]:
    """Codes of facts, and of the facts within them."""
    for fact in facts:
        if isinstance(fact, Fact):
            yield fact.code
            for value in fact.values.values():
                yield from list_codes(value if isinstance(value, tuple) else (value,))


@dataclass(frozen=True, kw_only=True)
class Altered:
    """A window with a fault of some size."""

    window: Window
    fault: str
    size: float


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was made of it; error and sigma of the logarithm of the scale, None where it was refused."""

    altered: Altered
    verdict: str
    error: float | None
    sigma: float | None
    said: tuple[str, ...]

    @property
    def named(self) -> bool:
        """Whether the fault was named."""
        return any(part in code for part in FAULTS[self.altered.fault][1] for code in self.said)


def alter(
    altered: Altered, trajectory: CameraTrajectory, imu: ImuRecording, metres_per_unit: float
) -> tuple[CameraTrajectory, ImuRecording]:
    """Put the fault in."""
    size, t_s, path = altered.size, trajectory.t_s, trajectory.cam_in_world
    rng = np.random.default_rng([9, altered.window.seed])
    since = (t_s - t_s[0]) / (t_s[-1] - t_s[0])
    if altered.fault == "clock":
        return replace(trajectory, t_s=t_s[0] + (t_s - t_s[0]) * (1 - size)), imu
    if altered.fault == "gain":
        return trajectory, replace(imu, accel_m_s2=imu.accel_m_s2 * (1 + size))
    if altered.fault == "bias":
        axis = rng.standard_normal(3)
        return trajectory, replace(imu, accel_m_s2=imu.accel_m_s2 + size * axis / np.linalg.norm(axis))
    if altered.fault == "wxyz":
        return replace(trajectory, cam_from_world_xyzw=np.roll(trajectory.cam_from_world_xyzw, 1, axis=1)), imu
    if altered.fault == "torn":
        begin = rng.uniform(0.25, 0.42)
        end = since < begin if rng.random() < 0.5 else since > 1 - begin
        path = _grown(path, np.log1p(size) * end)
    elif altered.fault == "drift":
        path = _grown(path, size * (since - 0.5))
    elif altered.fault == "stretch":
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        path = path * (1 + size) ** (-1 / 3)
        path = path + size * np.outer(path @ axis, axis)
    elif altered.fault == "moved":
        path = path.copy()
        path[rng.choice(len(path), 3, replace=False)] += size / metres_per_unit * rng.standard_normal((3, 3)) / 3**0.5
    return replace(trajectory, cam_in_world=path), imu


def _grown(path: Array, log_scale: Array) -> Array:
    """The path with steps of another size, none of them a jump."""
    factor = np.exp(0.5 * (log_scale[1:] + log_scale[:-1]))[:, None]
    return np.concatenate([path[:1], path[0] + np.cumsum(np.diff(path, axis=0) * factor, axis=0)])


@one_blas_thread()
def run(task: tuple[Path, Altered]) -> Outcome:
    """Estimate the scale of an altered window and compare."""
    folder, altered = task
    trajectory, imu, truth = recorded(folder, altered.window)
    estimate = estimate_scale(*alter(altered, trajectory, imu, truth))
    given = estimate.metres_per_unit
    return Outcome(
        altered=altered,
        verdict=estimate.verdict,
        error=None if given is None else float(np.log(given / truth)),
        sigma=estimate.sigma_log,
        said=tuple(list_codes((*estimate.reasons, *estimate.notes))),
    )


def summary(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Figures of outcomes."""
    given = [o for o in outcomes if o.error is not None and o.sigma is not None]
    ratio = np.array([abs(o.error) / (Z95 * o.sigma) for o in given], dtype=float)
    trusted = np.array([o.verdict == "trusted" for o in given], dtype=bool)
    return {
        "n": len(outcomes),
        "given": len(given),
        "inside": int(np.sum(ratio <= 1)),
        "trusted": int(trusted.sum()),
        "wrong": int(np.sum(ratio[trusted] > 1)),
        "far": int(np.sum(ratio[trusted] > 1.5)),
        "named": sum(o.named for o in outcomes),
    }


def by_place(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """All outcomes, those by hand, and those of flights."""
    hands = {name for name, (rig, _) in RECORDINGS.items() if rig is HANDHELD}
    by_hand = [o for o in outcomes if o.altered.window.recording in hands]
    return {"all": list(outcomes), "by hand": by_hand, "flown": [o for o in outcomes if o not in by_hand]}


def print_required(outcomes: Sequence[Outcome]) -> None:
    """What must be named against what is, where it was tried."""
    print(f"\n{'required':<32}{'named':>7}{'n':>5}{'share':>8}{'asked':>8}")

    def row(name: str, of: Sequence[Outcome], asked: str) -> None:
        named = sum(o.named for o in of)
        if of:
            print(f"{name:<32}{named:7d}{len(of):5d}{named / len(of):8.2f}{asked:>8}")

    for fault, size, length_s, where, least in REQUIRED:
        key = fault, size, length_s
        of = [o for o in outcomes if (o.altered.fault, o.altered.size, o.altered.window.length_s) == key]
        row(f"{fault} {size:g}, {length_s:g} s, {where}", by_place(of)[where], f">= {least:g}")
    row("false alarms", [o for o in outcomes if o.altered.fault == "clean"], f"<= {FALSE_ALARMS:g}")


def power(folder: Path, fault: str, size: float, window: Window) -> tuple[float, float]:
    """How often a torn end or a drift of this size is found in a window: by our test, by one that knows the place."""
    found: list[tuple[list[shape.ShapeFault], bool]] = []
    original = shape.find_faults

    def kept(
        kinds: Sequence[tuple[shape.Kind, float]], scores: shape.Scores, *, shaken: bool
    ) -> list[shape.ShapeFault]:
        found.append((original(kinds, scores, shaken=shaken), shaken))
        return found[-1][0]

    shape.find_faults = kept
    try:
        trajectory, imu, _ = recorded(folder, window)
        estimate_scale(trajectory, imu)
    finally:
        shape.find_faults = original
    if not found:
        return 0.0, 0.0
    faults, shaken = found[0]
    limits, kind = shape.LIMITS, "break" if fault == "torn" else "drift"
    of_kind = [one for one in faults if one.kind == kind]
    if kind == "break" and of_kind:  # where `alter` tears
        places = np.array([one.at_s for one in of_kind])
        since = (places - places.min() + limits.margin_s) / (np.ptp(places) + 2 * limits.margin_s)
        of_kind = [one for one, at in zip(of_kind, since, strict=True) if 0.25 <= min(at, 1 - at) <= 0.42]
    if not of_kind:
        return 0.0, 0.0
    least = np.sqrt(limits.break_chi2 if kind == "break" else limits.drift_chi2)
    variances = np.array([one.cov[0, 0] for one in of_kind])
    sigma = np.sqrt((limits.shaken if shaken else 1.0) * variances + limits.tolerated_log**2)
    ours, known = norm.cdf(np.log1p(size) / sigma - least), norm.cdf(np.log1p(size) / sigma - norm.ppf(0.99))
    return float(ours.mean()), float(known.mean())


def print_power(folder: Path, most: int, first: int) -> None:
    """The share that can be found of what must be named."""
    for fault, size, length_s, where, least in REQUIRED:
        if where == "all" and fault in ("torn", "drift"):
            clips = windows(folder, (length_s,), (NOISE_M,), most=most, first=first)
            shares = np.array([power(folder, fault, size, one) for one in clips])
            hands = np.array([RECORDINGS[one.recording][0] is HANDHELD for one in clips])
            for name, some in (("all", np.ones_like(hands)), ("by hand", hands), ("flown", ~hands)):
                ours, known = shares[some].mean(axis=0)
                print(
                    f"{fault} {size:g}, {length_s:g} s, {name:<9} {ours:5.2f} {known:5.2f} asked {least:g}", flush=True
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--lengths", nargs="+", type=float, default=LENGTHS_S, help="of clips, s")
    parser.add_argument("--most", type=int, default=3, help="clips of a length in each recording")
    parser.add_argument("--seed", type=int, default=0, help="number of the first clip")
    parser.add_argument("--json", type=Path, help="write every outcome")
    parser.add_argument("--power", action="store_true", help="what the information of the fits lets be found")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    if args.power:
        print_power(args.folder, args.most, args.seed)
        return
    clips = windows(args.folder, tuple(args.lengths), (NOISE_M,), most=args.most, first=args.seed)
    every = [Altered(window=w, fault=f, size=s) for f in args.faults for s in FAULTS[f][0] for w in clips]
    with multiprocessing.Pool(args.processes) as pool:
        outcomes = pool.map(run, [(args.folder, one) for one in every], chunksize=1)
    print(f"{'':<24}" + "".join(f"{name:>9}" for name in summary([])))
    for key in dict.fromkeys((o.altered.fault, o.altered.size, o.altered.window.length_s) for o in outcomes):
        of = [o for o in outcomes if (o.altered.fault, o.altered.size, o.altered.window.length_s) == key]
        for where, some in by_place(of).items():
            name = f"{key[0]} {key[1]:g}, {key[2]:g} s" if where == "all" else f"  {where}"
            print(f"{name:<24}" + "".join(f"{value:9d}" for value in summary(some).values()))
    print_required(outcomes)
    if args.json:
        write_report(args.json, {"outcomes": [asdict(outcome) | {"named": outcome.named} for outcome in outcomes]})


if __name__ == "__main__":
    main()
