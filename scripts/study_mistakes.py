"""Make mistakes that people make, and look at what is said, when, and whether following the advice gives a run.

    python scripts/study_mistakes.py [--seed 0] [--kinds units axes ...] [--reconstruct] [--json mistakes.json]

Each mistake changes a copy of ``example_scenes/desk`` by a seeded draw and starts the command that a person would. It
counts as caught where the command ends with an error before features are extracted, and its message has the words that
lead to the remedy. Then the remedy is applied, and the check beforehand must find nothing; with ``--reconstruct`` the
whole reconstruction must succeed. Exit code 1 where more than two mistakes are not caught.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_report import write_report

from colmap_inertial.cli import main as run_command
from colmap_inertial.core.arrays import Array

HERE = Path(__file__).resolve().parents[1]
DESK = HERE / "example_scenes" / "desk"
Change = Callable[[Path, np.random.Generator], None]


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """A mistake in a copy of the scene, or in the arguments.

    Attributes
    ----------
    kind, name
        What it is about, and what was done.
    make
        Changes the copy.
    says
        Pattern of what the message must hold.
    mend
        Changes the copy as the message advises; the original's file where the advice is to give another.
    arguments
        Of the command; ``{scene}`` and ``{out}`` stand for the folders.
    """

    kind: str
    name: str
    says: str
    make: Change = lambda scene, rng: None
    mend: Change | None = None
    arguments: tuple[str, ...] = ("reconstruct", "{scene}", "{out}")


def text(file: str, old: str, new: str) -> Change:
    """Replace words of a file."""

    def change(scene: Path, rng: np.random.Generator) -> None:
        path = scene / file
        before = path.read_text()
        assert old in before, (file, old)
        path.write_text(before.replace(old, new))

    return change


def toml(old: str, new: str) -> Change:
    """Replace words of capture.toml."""
    return text("capture.toml", old, new)


def rows(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the numbers of tables, with one draw for all of them."""

    def apply(scene: Path, rng: np.random.Generator) -> None:
        state = rng.bit_generator.state
        for file in files:
            rng.bit_generator.state = state
            path = scene / file
            header = path.read_text().splitlines()[0]
            table = change(np.loadtxt(path, delimiter=",", skiprows=1), rng)
            np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.12g")

    return apply


def values(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the readings, not the stamps."""
    return rows(*files, change=lambda table, rng: np.column_stack([table[:, 0], change(table[:, 1:], rng)]))


def stamps(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the stamps, not the readings."""
    return rows(*files, change=lambda table, rng: np.column_stack([change(table[:, 0], rng), table[:, 1:]]))


def frame_times(change: Callable[[float], float], header: str = "name,t_s") -> Change:
    """Change the times of the frames."""

    def apply(scene: Path, rng: np.random.Generator) -> None:
        path = scene / "frames.csv"
        with path.open() as file:
            table = list(csv.reader(file))[1:]
        lines = [header, *(f"{name},{change(float(t_s)):.9f}" for name, t_s in table)]
        path.write_text("\n".join(lines) + "\n")

    return apply


def original(*files: str) -> Change:
    """Give the file as it was recorded."""

    def apply(scene: Path, rng: np.random.Generator) -> None:
        for file in files:
            shutil.copy(DESK / file, scene / file)

    return apply


def both(*changes: Change) -> Change:
    """One change after the other."""

    def apply(scene: Path, rng: np.random.Generator) -> None:
        for change in changes:
            change(scene, rng)

    return apply


GYRO_UNIT = 'columns = ["x", "y", "z"]\nunit = "rad/s"'
G = 9.80665

MISTAKES: tuple[Mistake, ...] = (
    Mistake(
        kind="units",
        name="gyroscope in deg/s, called rad/s",
        make=values("gyro.csv", change=lambda w, _: np.degrees(w)),
        says=r'unit = "deg/s"',
        mend=toml('unit = "rad/s"', 'unit = "deg/s"'),
    ),
    Mistake(
        kind="units",
        name="gyroscope in rad/s, called deg/s",
        make=toml('unit = "rad/s"', 'unit = "deg/s"'),
        says=r'unit = "rad/s"',
        mend=toml('unit = "deg/s"', 'unit = "rad/s"'),
    ),
    Mistake(
        kind="units",
        name="accelerometer in g, called m/s2",
        make=values("accel.csv", change=lambda a, _: a / G),
        says=r'unit = "g"',
        mend=toml('unit = "m/s2"', 'unit = "g"'),
    ),
    Mistake(
        kind="units",
        name="accelerometer in m/s2, called g",
        make=toml('unit = "m/s2"', 'unit = "g"'),
        says=r'unit = "m/s2"',
        mend=toml('unit = "g"', 'unit = "m/s2"'),
    ),
    Mistake(
        kind="units",
        name="raw counts of the gyroscope",
        make=values("gyro.csv", change=lambda w, _: np.round(w * 939.65) + 12),
        says="counts_per_unit",
        mend=toml(GYRO_UNIT, f"{GYRO_UNIT}\nzero = 12\ncounts_per_unit = 939.65"),
    ),
    Mistake(
        kind="units",
        name="gyroscope with a wrong factor",
        make=values("gyro.csv", change=lambda w, rng: w * rng.uniform(1.28, 1.4)),
        says="the gyroscope measures .* times the rotation",
        mend=original("gyro.csv"),
    ),
    Mistake(
        kind="units",
        name="frame times in ms, called s",
        make=frame_times(lambda t_s: 1e3 * t_s),
        says="frames span .* in milliseconds where seconds were read",
        mend=frame_times(lambda t_ms: t_ms, "name,t_ms"),
    ),
    Mistake(
        kind="units",
        name="stamps of the IMU in ms, called s",
        make=stamps("gyro.csv", "accel.csv", change=lambda t_s, _: 1e3 * t_s),
        says="set time_unit",
        mend=toml('time_unit = "s"', 'time_unit = "ms"'),
    ),
    Mistake(
        kind="axes",
        name="gyroscope's x and y exchanged",
        make=values("gyro.csv", change=lambda w, _: w[:, [1, 0, 2]]),
        says="mirrored",
        mend=toml('columns = ["x", "y", "z"]\nunit = "rad/s"', 'columns = ["y", "x", "z"]\nunit = "rad/s"'),
    ),
    Mistake(
        kind="axes",
        name="an axis of the gyroscope flipped",
        make=values("gyro.csv", change=lambda w, rng: w * np.roll([-1, 1, 1], rng.integers(3))),
        says="mirrored",
        mend=original("gyro.csv"),
    ),
    Mistake(
        kind="axes",
        name="both sensors left-handed",
        make=values("gyro.csv", "accel.csv", change=lambda w, _: w * [-1, 1, 1]),
        says="mirrored = true",
        mend=toml('unit = "rad/s"', 'unit = "rad/s"\naxes = "-x,y,z"\nmirrored = true'),
    ),
    Mistake(
        kind="axes",
        name="gyroscope turned against the accelerometer",
        make=values("gyro.csv", change=lambda w, _: w[:, [1, 2, 0]]),
        says="axes",
        mend=toml('columns = ["x", "y", "z"]\nunit = "rad/s"', 'columns = ["z", "x", "y"]\nunit = "rad/s"'),
    ),
    Mistake(
        kind="axes",
        name="gyroscope measures the opposite",
        make=values("gyro.csv", change=lambda w, _: -w),
        says="mirrored",
        mend=original("gyro.csv"),
    ),
    Mistake(
        kind="clocks",
        name="clocks 565 s apart, called shared",
        make=toml("[timing]", "[timing]\nshared_clock = true"),
        says=r"565\.\d+ s apart.*shared_clock",
        mend=toml("shared_clock = true\n", ""),
    ),
    Mistake(
        kind="clocks",
        name="times by another frame rate",
        make=frame_times(lambda t_s: 1.25 * t_s),
        says="timed by another frame rate",
        mend=original("frames.csv"),
    ),
    Mistake(
        kind="clocks",
        name="the clock of the IMU 3 % fast",
        make=stamps("gyro.csv", "accel.csv", change=lambda t_s, _: 1.03 * t_s),
        says="clock runs",
        mend=original("gyro.csv", "accel.csv"),
    ),
    Mistake(
        kind="clocks",
        name="IMU of another recording",
        make=values("gyro.csv", "accel.csv", change=lambda w, _: w[::-1]),
        says="check that this IMU recording belongs to these images",
        mend=original("gyro.csv", "accel.csv"),
    ),
    Mistake(
        kind="clocks",
        name="IMU stopped after a fifth",
        make=rows("gyro.csv", "accel.csv", change=lambda table, _: table[: len(table) // 5]),
        says="IMU",
        mend=original("gyro.csv", "accel.csv"),
    ),
    Mistake(
        kind="clocks",
        name="a time offset that is wrong",
        make=toml("[target]", "[calibration]\ngyro_time_offset_s = 100.0\naccel_time_offset_s = 100.0\n\n[target]"),
        says="time offset that was given",
        mend=toml("gyro_time_offset_s = 100.0\naccel_time_offset_s = 100.0\n", ""),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a mistake: the message, when it came, whether it was caught, and whether its advice helped."""

    message: str
    seconds: float
    caught: bool
    mended: bool


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit code and everything that a command says."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            run_command(arguments)
        except SystemExit as stopped:
            return int(stopped.code or 0), " ".join(said.getvalue().split())
    return 0, " ".join(said.getvalue().split())


def try_mistake(mistake: Mistake, folder: Path, seed: int, *, reconstruct: bool = False) -> Outcome:
    """Make a mistake, read what is said, and do what it advises."""
    scene, out = folder / "scene", folder / "out"
    shutil.copytree(DESK, scene)
    rng = np.random.default_rng(seed)
    mistake.make(scene, rng)
    begin_s = time.monotonic()
    code, message = run([word.format(scene=scene, out=out) for word in mistake.arguments])
    seconds = time.monotonic() - begin_s
    begun = (out / "colmap" / "database.db").exists()
    caught = code != 0 and not begun and re.search(mistake.says, message) is not None
    mended = True
    if mistake.mend is not None:
        mistake.mend(scene, rng)
        words = ["reconstruct", str(scene), str(folder / "mended")] if reconstruct else ["diagnose", str(scene)]
        mended = run(words)[0] == 0
    return Outcome(message=message[-400:], seconds=seconds, caught=caught, mended=mended)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=[])
    parser.add_argument("--reconstruct", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    report = []
    for i, mistake in enumerate(MISTAKES):
        if options.kinds and mistake.kind not in options.kinds:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found = try_mistake(mistake, Path(folder), options.seed + i, reconstruct=options.reconstruct)
        report.append({"kind": mistake.kind, "name": mistake.name, **vars(found)})
        word = "ok    " if found.caught and found.mended else "MISSED" if not found.caught else "UNMENDED"
        print(f"{word} {mistake.kind:8} {mistake.name:46} {found.seconds:5.1f} s  {found.message[-150:]}", flush=True)
    bad = [row["name"] for row in report if not (row["caught"] and row["mended"])]
    print(f"{len(report) - len(bad)} of {len(report)} mistakes were caught, and their advice helped")
    if options.json is not None:
        write_report(options.json, {"mistakes": report})
    return int(len(bad) > 2)


if __name__ == "__main__":
    sys.exit(main())
