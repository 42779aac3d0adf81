"""Each deciding constant at half and at double its value: which figures of a benchmark change.

    python -m scripts.studies.sweep_constants {scale,blur} [--shared ../shared/data] [--workers N] [--only TEXT] [--json
    FILE]

Constants are the numbers at module level, and those in frozen values there or in the defaults of their classes. Each is
changed in a process of its own, in which the benchmark then runs:

``scale``
    Scale, width of its interval, verdict and findings of ``inertial_scale`` recordings, as they are and with twelve
    faults: constants of ``core``, ``motion.align``, ``inertial.core``, ``inertial.scale`` and ``checks.diagnose``.
``blur``
    What becomes of each frame of the scene ``blurred``, and its pixels: constants of ``imaging``, ``motion``,
    ``pipeline.stages`` and ``reconstruction.preparation``.

Printed: how many figures change at half and at double, and the largest change relative to a figure. A constant that
changes none at either decides nothing that the benchmark sees.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib
import inspect
import json
import multiprocessing
import os
import pkgutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import colmap_inertial
from colmap_inertial.core.errors import InertialError

ROOT = Path(__file__).resolve().parents[2]
Figures = dict[str, float | str]


@dataclass(frozen=True)
class Constant:
    """A number of the package: of a module, or of a frozen value or class in it (``holder``)."""

    module: str
    holder: str
    name: str
    value: float

    def __str__(self) -> str:
        return f"{self.module}: {'.'.join(filter(None, (self.holder, self.name)))}"

    def set(self, value: float) -> None:
        """Change it in this process, wherever it was imported."""
        home = importlib.import_module(self.module)
        if not self.holder:
            for module in _modules():
                if vars(module).get(self.name) is getattr(home, self.name) and module is not home:
                    setattr(module, self.name, value)
            setattr(home, self.name, value)
        elif isinstance(held := getattr(home, self.holder), type):
            defaults = held.__init__.__kwdefaults__
            defaults[self.name] = value
            setattr(held, self.name, value)
        else:
            object.__setattr__(held, self.name, value)


def _modules() -> list[Any]:
    names = [m.name for m in pkgutil.walk_packages(colmap_inertial.__path__, "colmap_inertial.")]
    skipped = ("__main__", "_kernels", "tools.batch.process")
    return [importlib.import_module(name) for name in names if not any(part in name for part in skipped)]


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value not in (0, -1)


def constants(rooms: tuple[str, ...]) -> Iterator[Constant]:
    """The constants of these rooms."""
    for module in _modules():
        inside = module.__name__.removeprefix("colmap_inertial.")
        if not any(f"{inside}.".startswith(f"{room}.") for room in rooms):
            continue
        source = inspect.getsource(module)
        for name, value in vars(module).items():
            if _is_number(value) and f"\n{name}" in source:
                yield Constant(module.__name__, "", name, value)
            elif dataclasses.is_dataclass(value) and getattr(value, "__module__", "") == module.__name__:
                if isinstance(value, type):
                    if any(type(other) is value for other in vars(module).values()):
                        continue  # its instance is listed
                    for field, default in (value.__init__.__kwdefaults__ or {}).items():
                        if _is_number(default):
                            yield Constant(module.__name__, name, field, default)
                else:
                    for field in dataclasses.fields(value):
                        if _is_number(getattr(value, field.name)):
                            yield Constant(module.__name__, name, field.name, getattr(value, field.name))


def _faults(imu: Any, other: Any, rng: np.random.Generator) -> dict[str, Any]:
    """One recording with twelve faults."""
    turn = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
    rate = 1.01
    return {
        "gyro mirrored": replace(imu, gyro_rad_s=imu.gyro_rad_s * [1, -1, 1]),
        "gyro swapped": replace(imu, gyro_rad_s=imu.gyro_rad_s @ turn),
        "gyro in degrees": replace(imu, gyro_rad_s=np.degrees(imu.gyro_rad_s)),
        "accelerometer mirrored": replace(imu, accel_m_s2=imu.accel_m_s2 * [1, 1, -1]),
        "accelerometer in g": replace(imu, accel_m_s2=imu.accel_m_s2 / 9.81),
        "accelerometer 5 % high": replace(imu, accel_m_s2=imu.accel_m_s2 * 1.05),
        "accelerometer cut off": replace(imu, accel_m_s2=np.clip(imu.accel_m_s2, -9.9, 9.9)),
        "clock 1 % fast": replace(imu, gyro_t_s=imu.gyro_t_s * rate, accel_t_s=imu.accel_t_s * rate),
        "accelerometer .2 s late": replace(imu, accel_t_s=imu.accel_t_s + 0.2),
        "noise": replace(imu, accel_m_s2=imu.accel_m_s2 + rng.normal(0, 1.0, imu.accel_m_s2.shape)),
        "every fourth sample": replace(imu, accel_t_s=imu.accel_t_s[::4], accel_m_s2=imu.accel_m_s2[::4]),
        "another recording": other,
    }


def run_scale(shared: Path) -> Figures:
    """Scales and findings of recordings, as they are and with faults."""
    from colmap_inertial.diagnose import Recorded, diagnose
    from colmap_inertial.inertial.scale import estimate_scale
    from colmap_inertial.io.trajectories import read_inertial_scale

    figures: Figures = {}
    recordings = {path.name: read_inertial_scale(path) for path in sorted((shared / "inertial_scale").glob("D*"))}
    for number, (name, (trajectory, imu)) in enumerate(recordings.items()):
        trajectory = trajectory.select(trajectory.t_s < trajectory.t_s[0] + (10.0 if number else 20.0))
        other = recordings[list(recordings)[number - 1]][1]
        faults = _faults(imu, other, np.random.default_rng(number)) if number == 0 else {}
        for fault, changed in {"": imu, **faults}.items():
            label = f"{name} {fault}".strip()
            found = diagnose(Recorded(imu=changed, trajectory=trajectory)).findings
            figures[f"{label}: findings"] = " ".join(sorted(finding.code for finding in found))
            try:
                estimate = estimate_scale(trajectory, changed)
            except InertialError as error:
                figures[f"{label}: verdict"] = type(error).__name__
                continue
            figures[f"{label}: verdict"] = estimate.verdict
            if estimate.metres_per_unit is not None and estimate.ci95 is not None:
                figures[f"{label}: scale"] = estimate.metres_per_unit
                figures[f"{label}: width"] = estimate.ci95[1] - estimate.ci95[0]
    return figures


def run_blur(shared: Path) -> Figures:
    """What becomes of each frame of a blurred capture."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as folder:
        result = colmap_inertial.deblur_capture(ROOT / "example_scenes" / "blurred", Path(folder) / "out")
        for frame in result.frames:
            figures[f"{frame.name}: action"] = frame.action
        for path in sorted(Path(folder).rglob("*.[jp][pn]g")):
            figures[f"{path.name}: pixels"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return figures


BENCHMARKS = {
    "scale": (run_scale, ("core", "motion.align", "inertial.core", "inertial.scale", "diagnose")),
    "blur": (run_blur, ("imaging", "motion", "run.stages", "run.preparation")),
}


@dataclass(frozen=True)
class Task:
    """One constant at one value; ``None`` changes nothing."""

    benchmark: str
    shared: Path
    constant: Constant | None = None
    factor: float = 1.0

    def run(self) -> Figures:
        """The figures, or the error that the change ends in."""
        constant = self.constant
        try:
            if constant is not None:
                value = constant.value * self.factor
                constant.set(max(1, round(value)) if isinstance(constant.value, int) else value)
            return BENCHMARKS[self.benchmark][0](self.shared)
        except Exception as error:  # a constant that breaks what it belongs to is one that matters
            return {"error": f"{type(error).__name__}: {error}"}


def compare_figures(before: Figures, after: Figures) -> tuple[int, float]:
    """How many figures differ, and the largest relative difference of numbers."""
    differing = [name for name in {*before, *after} if before.get(name) != after.get(name)]
    pairs = [(before[name], after[name]) for name in differing if name in before and name in after]
    numbers = [abs(b / a - 1) for a, b in pairs if isinstance(a, float) and isinstance(b, float) and a]
    return len(differing), max(numbers, default=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmark", choices=sorted(BENCHMARKS))
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--only", default="", help="constants whose place contains this text")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    shared = given.shared.resolve()
    chosen = [c for c in constants(BENCHMARKS[given.benchmark][1]) if given.only in str(c)]
    tasks = [Task(given.benchmark, shared, c, factor) for c in chosen for factor in (0.5, 2.0)]
    rows = []
    with multiprocessing.get_context("fork").Pool(given.workers, maxtasksperchild=1) as pool:
        base = pool.apply(Task(given.benchmark, shared).run)
        print(f"{len(base)} figures, {len(chosen)} constants; changed at half, at double (largest relative change)")
        results = pool.imap(Task.run, tasks)
        for constant in chosen:
            (n, half), (m, double) = (compare_figures(base, next(results)) for _ in range(2))
            print(f"{n:4d} {half:8.1e}  {m:4d} {double:8.1e}  {constant} = {constant.value:g}", flush=True)
            rows.append({"constant": str(constant), "value": constant.value, "half": [n, half], "double": [m, double]})
    idle = [row["constant"] for row in rows if not row["half"][0] and not row["double"][0]]
    print(f"\n{len(idle)} of {len(rows)} change no figure:", *idle, sep="\n  ")
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
