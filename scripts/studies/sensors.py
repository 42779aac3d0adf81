#!/usr/bin/env python3
"""Sensors together, with errors drawn for each: do intervals hold, and what becomes of a sensor that is wrong?

    python -m scripts.studies.sensors [--captures 100] [--paths 30] [--gains 10] [--jobs 2] [--seed 0]
                                      [--json study.json]
    python -m scripts.studies.sensors --again study.json

captures    A phone filmed a desk or a room for 20 to 30 s. Of a model of it with the errors of structure from motion,
            the IMU is estimated from its samples, depth from maps of 256 x 192, the device's path from poses that
            drift. Positions, a target and a known distance are drawn from the errors that they state. Gains, lens,
            depth scale, what path and depth share: from the priors. Then each sensor is wrong by 2, 5, 10 % in turn.
paths       Recordings of such a phone, of which the scale of its own path is asked for, which wanders: by all, and
            by depth and path where there is no IMU. Right is how much longer the true path is.

gains       Recordings whose accelerometer reads 2, 5, 10 % too long: what the IMU alone makes of it.

A capture's seed alone reproduces it. ``--again`` judges the captures of an earlier report.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
from rich.console import Console
from rich.table import Table

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraModel, CameraTrajectory
from colmap_inertial.core.types.depth import DepthMap, DepthMaps, PinholeGrid
from colmap_inertial.core.types.evidence import CombinedScale, ScaleEvidence, Sensor
from colmap_inertial.evidence.combine import combine, covariance_of, weigh
from colmap_inertial.evidence.depth import DepthLimits, scale_by_depth
from colmap_inertial.evidence.inertial import evidence_of_device, evidence_of_imu, length_of
from colmap_inertial.evidence.priors import DECLARED, FAULT_SIGMA, FAULTS, GROSS_SHARE, GROSS_SIGMA, PRIORS
from colmap_inertial.inertial.core.priors import PRIORS as INERTIAL_PRIORS
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.inertial.scale.verdict import verdict_of, without_width
from colmap_inertial.io.calibration import SIGMAS
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    DeviceOptions,
    MotionOptions,
    RecordingOptions,
    Renderer,
    ShutterCamera,
    SimulatedRecording,
    make_world,
    simulate_recording,
    true_metres_per_unit,
)
from colmap_inertial.tools.simulate.device import HIGH, DeviceErrors, compute_path, draw_device_errors, measure_depth
from colmap_inertial.tools.simulate.motion import MotionKind
from scripts.common.bench_report import describe_run, write_report

T = TypeVar("T")
VIEW = PinholeGrid(width=256, height=192, focal_px=(180.0, 180.0), centre_px=(128.2, 96.3))
CAMERA = ShutterCamera(model=CameraModel(model="PINHOLE", width=256, height=192, params=(180.0, 180.0, 128.2, 96.3)))
KINDS: tuple[MotionKind, ...] = ("orbit", "roam")
#: Views of a recording that are compared: a third of what is usual, to save time.
VIEWS = DepthLimits(views=35)
DEVICE = replace(DeviceOptions(), depth_scale_sd=PRIORS.depth_scale, fusion_sd=PRIORS.device_fusion)
#: Those that are only drawn: range of the random standard deviation, and what is their own.
STATED: dict[Sensor, tuple[tuple[float, float], dict[str, float]]] = {
    "positions": ((0.01, 0.04), {"receiver": 0.004}),
    "target": ((0.003, 0.01), {DECLARED: 0.003}),
    "distance": ((0.005, 0.02), {DECLARED: 0.003}),
}
SETS: dict[str, tuple[Sensor, ...]] = {
    "IMU, depth, device": ("imu", "depth", "device"),
    "IMU, depth, device, positions": ("imu", "depth", "device", "positions"),
    "IMU, device": ("imu", "device"),
    "depth, device": ("depth", "device"),
    "all six": ("imu", "depth", "device", "positions", "target", "distance"),
}
SENSORS: tuple[Sensor, ...] = get_args(Sensor)
WRONG = (0.02, 0.05, 0.10)


@dataclass(frozen=True, kw_only=True)
class Capture:
    """What sensors said of a capture; ``log_scale`` is true, ``evidence`` keywords of :class:`ScaleEvidence`."""

    seed: int
    kind: str
    log_scale: float
    evidence: tuple[dict[str, Any], ...]
    seconds: float

    def of(self, sensors: Iterable[Sensor]) -> list[ScaleEvidence]:
        """What some of the sensors said, where they said something."""
        return [ScaleEvidence(**one) for one in self.evidence if one["sensor"] in sensors]


# --- drawing ----------------------------------------------------------------------------------------------------------


@cache
def _renderer(kind: str) -> Renderer:
    return Renderer(make_world("desk" if kind == "orbit" else "room", 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Drawn:
    """A recording and its errors: of the accelerometer beside its matrix, of the lens, of the device."""

    kind: MotionKind
    recording: SimulatedRecording
    accel_log: float
    lens_log: float
    device: DeviceErrors
    rng: np.random.Generator

    def depth_maps(self, trajectory: CameraTrajectory) -> DepthMaps:
        """Maps at the poses of a trajectory."""
        renderer = _renderer(self.kind)
        at_s = dict(zip(trajectory.names, trajectory.t_s.tolist(), strict=True))

        def read(name: str) -> DepthMap:
            true_m = renderer.depth_m(CAMERA, self.recording.truth.motion, at_s[name])
            depth_m, confidence = measure_depth(true_m, DEVICE, self.device, self.rng)
            return DepthMap(depth_m=np.where(confidence == HIGH, depth_m, np.nan), view=VIEW)

        return DepthMaps(names=trajectory.names, read=read, source="simulated", is_fused=True)

    def device_path(self) -> CameraTrajectory:
        """What the device computed, in its own metres."""
        model = self.recording.trajectory
        xyzw, centres = compute_path(self.recording.truth.motion, model.t_s, DEVICE, self.device, self.rng)
        return replace(model, cam_from_world_xyzw=quat_conjugate(xyzw), cam_in_world=centres, length_unit="m")

    def true_path(self) -> CameraTrajectory:
        """Where the camera was, in metres."""
        model, motion = self.recording.trajectory, self.recording.truth.motion
        return replace(
            model,
            cam_from_world_xyzw=quat_conjugate(motion.world_from_cam_xyzw(model.t_s)),
            cam_in_world=motion.cam_in_world_m(model.t_s),
        )

    def by_imu(self, trajectory: CameraTrajectory) -> list[ScaleEvidence]:
        """What the IMU says of a path; nothing where it is refused."""
        estimate = estimate_scale(trajectory, self.recording.imu)
        if estimate.metres_per_unit is None:
            return []
        said = evidence_of_imu(estimate)
        return [replace(said, log_scale=said.log_scale + self.accel_log + self.lens_log)]

    def by_depth(self, trajectory: CameraTrajectory, log_scale: float | None) -> list[ScaleEvidence]:
        """What depth says of a path; nothing where too little is seen."""
        try:
            maps = self.depth_maps(trajectory)
            return [scale_by_depth(maps, trajectory, log_scale=log_scale, limits=VIEWS).evidence()]
        except NotObservableError:
            return []


def _draw(seed: int) -> _Drawn:
    rng = np.random.default_rng([seed, 1])
    kind = KINDS[seed % 2]
    imu = replace(
        IMU_PRESETS["phone"],
        gyro_scale_sd=INERTIAL_PRIORS.gyro_gain,
        gyro_misalignment_sd=INERTIAL_PRIORS.gyro_gain,
        accel_scale_sd=INERTIAL_PRIORS.accel_gain,
        accel_misalignment_sd=INERTIAL_PRIORS.accel_gain,
        accel_bias_m_s2_sd=INERTIAL_PRIORS.accel_bias_m_s2,
        clock_rate_sd=INERTIAL_PRIORS.clock_rate,
        accel_delay_s=(0.0, SIGMAS.accel_minus_gyro_offset_s),
    )
    motion = MotionOptions(
        kind=kind, duration_s=float(rng.uniform(20, 30)), vigour=float(np.exp(rng.uniform(np.log(0.5), 0)))
    )
    gravity_m_s2 = float(rng.normal(9.80665, INERTIAL_PRIORS.gravity_m_s2))
    recording = simulate_recording(RecordingOptions(motion=motion, imu=imu, gravity_m_s2=gravity_m_s2), seed=seed)
    accel_log, lens_log = rng.standard_normal(2) * (INERTIAL_PRIORS.accel_model, INERTIAL_PRIORS.lens)
    gain = float(np.mean(np.diagonal(recording.truth.imu.errors.accel_matrix)))
    device = draw_device_errors(DEVICE, float(accel_log) + gain, rng)
    return _Drawn(
        kind=kind, recording=recording, accel_log=float(accel_log), lens_log=float(lens_log), device=device, rng=rng
    )


def _stated(log_scale: float, rng: np.random.Generator) -> list[ScaleEvidence]:
    """Sensors whose errors are as they state, drawn; a cause that two have is drawn once."""
    causes = {cause: rng.standard_normal() for _, own in STATED.values() for cause in own}
    out = []
    for sensor, (limits, own) in STATED.items():
        random_sigma = float(np.exp(rng.uniform(*np.log(limits))))
        error = random_sigma * rng.standard_normal() + sum(sigma * causes[cause] for cause, sigma in own.items())
        out.append(ScaleEvidence(sensor=sensor, log_scale=log_scale + error, random_sigma=random_sigma, systematic=own))
    return out


def _keywords(evidence: Iterable[ScaleEvidence]) -> tuple[dict[str, Any], ...]:
    return tuple(
        {
            "sensor": one.sensor,
            "log_scale": one.log_scale,
            "random_sigma": one.random_sigma,
            "systematic": dict(one.systematic),
        }
        for one in evidence
    )


@one_blas_thread()
def draw_capture(seed: int) -> Capture:
    """A model, and what all sensors say of it."""
    begin_s = time.perf_counter()
    drawn = _draw(seed)
    model = drawn.recording.trajectory
    log_scale = float(np.log(drawn.recording.truth.metres_per_unit))
    evidence = drawn.by_imu(model)
    evidence += drawn.by_depth(model, evidence[0].log_scale if evidence else None)
    of_device = true_metres_per_unit(model.names, model.cam_in_world, drawn.device_path())
    evidence += [evidence_of_device(float(np.log(of_device))), *_stated(log_scale, drawn.rng)]
    seconds = time.perf_counter() - begin_s
    return Capture(seed=seed, kind=drawn.kind, log_scale=log_scale, evidence=_keywords(evidence), seconds=seconds)


@one_blas_thread()
def draw_path(seed: int) -> Capture:
    """A device's own path, and what its sensors say of it."""
    begin_s = time.perf_counter()
    drawn = _draw(seed)
    path = drawn.device_path()
    log_scale = float(np.log(length_of(drawn.true_path()) / length_of(path)))
    evidence = [*drawn.by_imu(path), *drawn.by_depth(path, 0.0), evidence_of_device()]
    seconds = time.perf_counter() - begin_s
    return Capture(seed=seed, kind=drawn.kind, log_scale=log_scale, evidence=_keywords(evidence), seconds=seconds)


@dataclass(frozen=True, kw_only=True)
class Gain:
    """What the IMU alone makes of an accelerometer that reads too long, by ``by``."""

    seed: int
    by: float
    log_error: float | None
    sigma: float | None
    verdict: str
    codes: tuple[str, ...]


@one_blas_thread()
def draw_gain(seed: int) -> list[Gain]:
    """A recording whose accelerometer reads too long, by each of the amounts."""
    drawn = _draw(seed)
    imu, out = drawn.recording.imu, []
    for by in WRONG:
        estimate = estimate_scale(drawn.recording.trajectory, replace(imu, accel_m_s2=(1 + by) * imu.accel_m_s2))
        known = estimate.metres_per_unit
        out.append(
            Gain(
                seed=seed,
                by=by,
                log_error=None if known is None else float(np.log(known / drawn.recording.truth.metres_per_unit)),
                sigma=estimate.sigma_log,
                verdict=estimate.verdict,
                codes=tuple(reason.code for reason in estimate.reasons),
            )
        )
    return out


# --- judging ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Row:
    """What was made of captures; shares are of those that gave a scale.

    ``outside`` are trusted ones whose interval does not hold the truth, ``named`` those whose likeliest culprit is the
    sensor that is wrong, ``ratio`` is the median half-width over that of the best sensor alone.
    """

    count: int
    held: float
    ratio: float
    half_width: float
    trusted: float
    outside: float
    named: float


def judge(
    captures: Sequence[Capture],
    sensors: Iterable[Sensor],
    rule: Callable[[list[ScaleEvidence]], CombinedScale] = combine,
    wrong: Sensor | None = None,
    by: float = 0.0,
) -> Row:
    """Combine what some sensors said of captures, one of them wrong by some amount to either side.

    Parameters
    ----------
    rule
        How they are combined.
    wrong, by
        Which one, and by how much the logarithm of its scale.
    """
    rows = []
    for capture in captures:
        sound = capture.of(sensors)
        for sign in (1,) if wrong is None else (1, -1):
            evidence = [replace(one, log_scale=one.log_scale + sign * by * (one.sensor == wrong)) for one in sound]
            if not evidence or (wrong is not None and wrong not in {one.sensor for one in evidence}):
                continue
            found = rule(evidence)
            held = abs(found.log_scale - capture.log_scale) <= Z95 * found.sigma
            trusted = found.verdict == "trusted"
            culprits = {r.values["culprit"] for r in found.reasons if r.code == "sensors-contradict"}
            best = min(one.sigma for one in evidence)
            rows.append((held, found.sigma / best, Z95 * found.sigma, trusted, trusted and not held, wrong in culprits))
    if not rows:
        raise ValueError("no capture has evidence of these sensors")
    table = np.array(rows, dtype=float)
    means, medians = table.mean(axis=0), np.median(table, axis=0)
    return Row(
        count=len(table),
        held=float(means[0]),
        ratio=float(medians[1]),
        half_width=float(medians[2]),
        trusted=float(means[3]),
        outside=float(means[4]),
        named=float(means[5]),
    )


def with_faults(captures: Sequence[Capture], times: int = 5) -> list[Capture]:
    """Captures some times over, whose sensors are wrong as often and by as much as is assumed beforehand."""

    def spoil(one: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        is_wrong, is_gross = rng.uniform(size=2) < (FAULTS[one["sensor"]], GROSS_SHARE)
        by = (GROSS_SIGMA if is_gross else FAULT_SIGMA) * rng.standard_normal()
        return {**one, "log_scale": one["log_scale"] + by * is_wrong}

    out = []
    for capture in captures:
        rng = np.random.default_rng([capture.seed, 2])
        out += [replace(capture, evidence=tuple(spoil(one, rng) for one in capture.evidence)) for _ in range(times)]
    return out


def alone(evidence: list[ScaleEvidence]) -> CombinedScale:
    """The sensor that is surest by itself."""
    return combine([min(evidence, key=lambda one: one.sigma)])


def as_if_sound(evidence: list[ScaleEvidence]) -> CombinedScale:
    """By the covariance alone: nobody is ever wrong by more than stated."""
    cov = covariance_of(evidence)
    weights = weigh(cov)
    mean = float(weights @ [one.log_scale for one in evidence])
    return _with_interval(evidence, mean, float(np.sqrt(weights @ cov @ weights)))


def without_each(evidence: list[ScaleEvidence]) -> CombinedScale:
    """From the lowest to the highest end of the intervals without each in turn: it holds whoever is wrong."""
    sets = [evidence, *([one for one in evidence if one is not left_out] for left_out in evidence)]
    found = [as_if_sound(some) for some in sets if some]
    low = min(one.log_scale - Z95 * one.sigma for one in found)
    high = max(one.log_scale + Z95 * one.sigma for one in found)
    return _with_interval(evidence, 0.5 * (low + high), 0.5 * (high - low) / Z95)


def _with_interval(evidence: list[ScaleEvidence], log_scale: float, sigma: float) -> CombinedScale:
    """What is combined, with another interval and the verdict that goes with it."""
    found = combine(evidence)
    verdict, _, reasons = verdict_of(float(np.exp(log_scale)), sigma, without_width(found.reasons))
    return replace(found, log_scale=log_scale, sigma=sigma, verdict=verdict, reasons=reasons)


def weak_sooner(evidence: list[ScaleEvidence]) -> CombinedScale:
    """As combined, but weak where chance sets one recording's sensors in ten as far apart."""
    found = combine(evidence)
    return replace(found, verdict="weak") if found.verdict == "trusted" and found.p_value < 0.1 else found


RULES: dict[str, Callable[[list[ScaleEvidence]], CombinedScale]] = {
    "the surest one alone": alone,
    "nobody is ever wrong": as_if_sound,
    "combined": combine,
    "combined, weak sooner": weak_sooner,
    "without each in turn": without_each,
}


# --- tables -----------------------------------------------------------------------------------------------------------


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _sound(title: str, captures: Sequence[Capture], sets: Mapping[str, tuple[Sensor, ...]]) -> Table:
    rows = []
    for name, sensors in sets.items():
        row = judge(captures, sensors)
        shares = (_percent(row.held, 1), _percent(row.half_width, 2), f"{row.ratio:.2f}")
        rows.append([name, str(row.count), *shares, _percent(row.trusted), _percent(row.outside, 1)])
    columns = ("", "count", "95 % holds", "half-width", "over the best alone", "trusted", "trusted, outside")
    return _table(title, columns, rows)


def _one_wrong(name: str, captures: Sequence[Capture]) -> Table:
    rows = []
    for sensor in SETS[name]:
        cells = []
        for by in WRONG:
            row, single = (judge(captures, some, wrong=sensor, by=by) for some in (SETS[name], (sensor,)))
            cells.append(f"{_percent(row.named)}, {_percent(row.outside)} ({_percent(single.outside)})")
        rows.append([sensor, *cells])
    title = f"{name}; one of them wrong: named, trusted and outside (the same of that one alone)"
    return _table(title, ("wrong", *(f"by {_percent(by)}" for by in WRONG)), rows)


def _rules(captures: Sequence[Capture]) -> Table:
    rows = []
    for name, rule in RULES.items():
        row = judge(captures, SETS["IMU, depth, device"], rule)
        spoilt = [judge(captures, SETS["IMU, depth, device"], rule, wrong="imu", by=by) for by in WRONG]
        cells = (_percent(row.held, 1), f"{row.ratio:.2f}", _percent(row.trusted))
        rows.append([name, *cells, *(_percent(one.outside) for one in spoilt)])
    title = "IMU, depth, device by other rules; trusted and outside where the IMU is wrong"
    columns = ("", "95 % holds", "over the best alone", "trusted", *(f"by {_percent(by)}" for by in WRONG))
    return _table(title, columns, rows)


def _gains(gains: Sequence[Gain]) -> Table:
    rows = []
    for by in WRONG:
        some = [gain for gain in gains if gain.by == by]
        known = [(gain.verdict, gain.log_error, gain.sigma) for gain in some if gain.log_error is not None]
        outside = [verdict for verdict, error, sigma in known if sigma is not None and abs(error) > Z95 * sigma]
        median = _percent(float(np.median([error for _, error, _ in known])), 2) if known else ""
        counts = (str(sum(gain.verdict == verdict for gain in some)) for verdict in ("trusted", "weak", "refused"))
        rows.append([_percent(by), str(len(some)), median, *counts, str(outside.count("trusted"))])
    columns = ("accelerometer too long by", "count", "median error", "trusted", "weak", "refused", "trusted, outside")
    return _table("The IMU alone, whose accelerometer reads too long", columns, rows)


def show(captures: Sequence[Capture], paths: Sequence[Capture], gains: Sequence[Gain]) -> None:
    """All tables on the terminal."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    alone_sets: dict[str, tuple[Sensor, ...]] = {f"{sensor} alone": (sensor,) for sensor in SENSORS}
    of_paths = ("IMU, depth, device", "IMU, device", "depth, device", "imu alone", "depth alone", "device alone")
    sets = {**SETS, **alone_sets}
    console.print(_sound("Captures, errors as drawn", captures, sets))
    console.print(_sound("Captures, each sensor wrong as often as is assumed", with_faults(captures), SETS))
    console.print(_sound("The device's own path, which wanders", paths, {name: sets[name] for name in of_paths}))
    for name in ("IMU, depth, device", "IMU, depth, device, positions", "all six"):
        console.print(_one_wrong(name, captures))
    console.print(_rules(captures))
    console.print(_gains(gains))


def draw(what: Callable[[int], T], seeds: Sequence[int], jobs: int) -> list[T]:
    """What is drawn from some seeds, in several processes, with a progress bar on the error stream."""
    from rich.progress import track

    for kind in KINDS:
        _renderer(kind)  # built once, for all processes
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        return list(track(pool.imap(what, seeds), "", len(seeds), console=Console(stderr=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=100)
    parser.add_argument("--paths", type=int, default=30)
    parser.add_argument("--gains", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the first capture")
    parser.add_argument("--json", type=Path, help="where to write what was drawn")
    parser.add_argument("--again", type=Path, help="a report whose captures are judged again")
    arguments = parser.parse_args()
    begun_in = describe_run()
    if arguments.again is not None:
        report = json.loads(arguments.again.read_text())
        captures, paths = ([Capture(**one) for one in report[name]] for name in ("captures", "paths"))
        gains = [Gain(**one) for one in report["gains"]]
    else:
        seeds = range(arguments.seed, arguments.seed + max(arguments.captures, arguments.paths, arguments.gains))
        captures = draw(draw_capture, seeds[: arguments.captures], arguments.jobs)
        paths = draw(draw_path, seeds[: arguments.paths], arguments.jobs)
        gains = [gain for some in draw(draw_gain, seeds[: arguments.gains], arguments.jobs) for gain in some]
    show(captures, paths, gains)
    if arguments.json:
        drawn = {"captures": captures, "paths": paths, "gains": gains}
        write_report(
            arguments.json, {**begun_in, **{name: [asdict(one) for one in some] for name, some in drawn.items()}}
        )


if __name__ == "__main__":
    main()
