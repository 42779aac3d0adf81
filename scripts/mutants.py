"""Listed faults put into the package one at a time, and the tests that catch them.

    python scripts/mutants.py [--only ROOM] [--sample N [--seed S]] [--list] [--json FILE]

The faults (``mutant_set.py``) are small and realistic: signs, swapped arguments, missing factors, wrong frames, dropped
keys of a resume hash, checks that are left out. Each is made in a copy of the package with its compiled kernels, in a
temporary folder, and the tests that are named for it are run against that copy until one fails. A fault counts as
caught where a test fails that passes without it. Printed: what became of each, counts by room, the share caught. Exit
code 1 below 95 %.

All of them take half an hour or more on one processor; a room or a sample takes minutes.
``random_mutants.py`` draws faults at random instead.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import random
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mutant_set import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "colmap_inertial"
#: Share of the faults that tests must notice.
LEAST_SHARE = 0.95
#: A fault that makes a test run for longer than this is caught, too (s).
_LONGEST_S = 900
_PASSED, _FAILED = 0, 1


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one mutant: ``caught`` (by which test), ``survived``, ``stale``, or ``broken`` (tests cannot run).

    ``seconds`` is how long its tests ran.
    """

    mutant: Mutant
    state: str
    by: str = ""
    seconds: float = 0.0


def mutated(text: str, mutant: Mutant) -> str | None:
    """A module's text with the fault; ``None`` where the place is not there exactly once."""
    return text.replace(mutant.old, mutant.new) if text.count(mutant.old) == 1 else None


class Trial:
    """A copy of the package in which one fault at a time is made."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        shutil.copytree(ROOT / PACKAGE, folder / PACKAGE)
        # An editable install keeps the compiled kernels with the installed packages, and is found before any folder.
        for kernel in Path(sysconfig.get_path("platlib"), PACKAGE).rglob("*.so"):
            shutil.copy2(kernel, folder / PACKAGE / kernel.relative_to(Path(sysconfig.get_path("platlib"), PACKAGE)))
        (folder / "sitecustomize.py").write_text(
            'import sys\nsys.meta_path[:] = [f for f in sys.meta_path if "ScikitBuild" not in type(f).__name__]\n'
        )
        self._environment = {
            **os.environ,
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        code = f"import {PACKAGE}; print({PACKAGE}.__file__)"
        found = self._run([sys.executable, "-c", code]).stdout.strip()
        if not Path(found).is_relative_to(folder):
            raise SystemExit(f"tests would use {found} instead of the copy")

    def outcome(self, mutant: Mutant) -> Outcome:
        """Make the fault, run its tests, and take it back."""
        text = mutated((ROOT / PACKAGE / mutant.file).read_text(encoding="utf-8"), mutant)
        if text is None:
            return Outcome(mutant=mutant, state="stale")
        begun = time.perf_counter()
        with self.module(mutant.file, text):
            state, by = self.tested(mutant.test_files())
        return Outcome(mutant=mutant, state=state, by=by, seconds=time.perf_counter() - begun)

    @contextmanager
    def module(self, file: str, text: str) -> Iterator[None]:
        """While the context lasts, a module of the copy has this text."""
        target = self._folder / PACKAGE / file
        target.write_text(text, encoding="utf-8")
        try:
            yield
        finally:
            shutil.copy2(ROOT / PACKAGE / file, target)

    def tested(self, tests: Sequence[str]) -> tuple[str, str]:
        """``caught`` and the test that failed first, ``survived``, or ``broken`` and what pytest said.

        A test that fails without the fault as well counts for nothing (``broken``).
        """
        try:
            done = self._pytest(tests)
        except subprocess.TimeoutExpired:
            return "caught", f"tests run for more than {_LONGEST_S} s"
        failed = re.search(r"^(?:FAILED|ERROR) \S*?(tests/test_.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
        if failed is not None:
            sound = "::" not in failed[1] or self._passes(failed[1])
            return ("caught", failed[1]) if sound else ("broken", f"{failed[1]} fails without the fault")
        if done.returncode < 0:
            return "caught", f"tests end by signal {-done.returncode}"
        if "ImportError while loading conftest" in done.stderr and self._passes(tests[0]):
            return "caught", "the package cannot be imported"
        printed = (done.stdout + done.stderr).strip().splitlines()
        return (
            ("survived", "") if done.returncode == _PASSED else ("broken", printed[-1] if printed else "pytest failed")
        )

    @functools.cache  # noqa: B019 (a trial lives as long as the script)
    def _passes(self, test: str) -> bool:
        """Whether a test passes in the installed package, without any fault."""
        return self._pytest([test], where=ROOT, environment={**os.environ}).returncode == _PASSED

    def _pytest(
        self, tests: Sequence[str], where: Path | None = None, environment: dict[str, str] | None = None
    ) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", f"--rootdir={ROOT}"]
        return self._run([*words, *(str(ROOT / test) for test in tests)], where, environment, timeout=_LONGEST_S)

    def _run(
        self,
        words: Sequence[str],
        where: Path | None = None,
        environment: dict[str, str] | None = None,
        timeout: float | None = None,
    ) -> subprocess.CompletedProcess[str]:
        # in the copy's folder: Python finds modules where it is started before it looks elsewhere
        return subprocess.run(
            words,
            cwd=where or self._folder,
            env=environment or self._environment,
            capture_output=True,
            text=True,
            timeout=timeout,
        )


def share_caught(outcomes: Sequence[Outcome]) -> float:
    """Share of the mutants that a test noticed; those that change nothing (``why``) and survive do not count."""
    counted = [one for one in outcomes if one.state == "caught" or not one.mutant.why]
    return sum(one.state == "caught" for one in counted) / max(len(counted), 1)


def line_of(one: Outcome) -> str:
    """One row of the table."""
    state = f"SURVIVED{': ' + one.mutant.why if one.mutant.why else ''}" if one.state == "survived" else one.state
    said = f"{state} {one.by}".strip()
    return f"{one.mutant.room:13} {one.seconds:5.0f} s  {one.mutant.breaks}\n{'':22} {one.mutant.file}: {said}"


def summary(outcomes: Sequence[Outcome]) -> str:
    """Counts by room and the share."""
    states = ("caught", "survived", "stale", "broken")
    lines = [f"{'room':13} " + " ".join(f"{state:>8}" for state in states)]
    for room in dict.fromkeys(one.mutant.room for one in outcomes):
        counts = Counter(one.state for one in outcomes if one.mutant.room == room)
        lines.append(f"{room:13} " + " ".join(f"{counts[state]:8d}" for state in states))
    minutes = sum(one.seconds for one in outcomes) / 60
    caught = sum(one.state == "caught" for one in outcomes)
    lines.append(f"{caught} of {len(outcomes)} caught, {100 * share_caught(outcomes):.1f} %, in {minutes:.0f} minutes")
    return "\n".join(lines)


def chosen(only: str | None, sample: int | None, seed: int) -> list[Mutant]:
    """The mutants of a room, or of all, or some of them."""
    some = [mutant for mutant in MUTANTS if only in (None, mutant.room)]
    return some if sample is None else random.Random(seed).sample(some, min(sample, len(some)))


def main() -> int:
    """Run the mutants; the exit code."""
    rooms = list(dict.fromkeys(mutant.room for mutant in MUTANTS))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=rooms, metavar="ROOM", help=f"one of {', '.join(rooms)}")
    parser.add_argument("--sample", type=int, metavar="N", help="so many of them, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="show them and run nothing")
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args()
    some = chosen(given.only, given.sample, given.seed)
    if given.list:
        print("\n".join(f"{one.room:13} {one.file}: {one.breaks}" for one in some))
        return 0
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder).resolve())
        for mutant in some:
            outcomes.append(trial.outcome(mutant))
            print(line_of(outcomes[-1]), flush=True)
    print(f"\n{summary(outcomes)}")
    if given.json is not None:
        rows = [{**dataclasses.asdict(one), "room": one.mutant.room} for one in outcomes]
        given.json.write_text(json.dumps({"share": share_caught(outcomes), "mutants": rows}, indent=2) + "\n")
    return 0 if share_caught(outcomes) >= LEAST_SHARE else 1


if __name__ == "__main__":
    sys.exit(main())
