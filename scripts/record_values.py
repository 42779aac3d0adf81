"""Write what the package's functions return in tests, for the tests to compare with (``tests/returned_values.py``).

    python scripts/record_values.py renew [FILE ...]
    python scripts/record_values.py run FOLDER [--elsewhere] [PYTEST'S WORDS ...]
    python scripts/record_values.py choose --map MAP FOLDER FOLDER ...

``renew`` is for a change that was meant to change values: the files of tests that values are kept of, or those given,
are run twice, and what functions return now is written. Look at what the tests said before. The other two are for
values of new tests. ``run`` runs tests and writes all that functions return in each into a new folder; ``--elsewhere``
has numpy, OpenBLAS and OpenCV calculate as an old processor would, in another time zone, with nothing of ``.venv`` on
the PATH. ``choose`` takes what several runs agree in and keeps some of it: for each line that a quick test runs
(``random_mutants.py map``), what its function returns in such a test, or in two; of a function that runs in no quick
test, in a slower one.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from returned_values import KEPT, PACKAGE, read_kept, same, versions  # noqa: E402

#: Another machine: kernels of a processor without AVX, other surroundings.
ELSEWHERE = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX2,FP16,FMA3",
    "OPENCV_IPP": "disabled",
    "PATH": os.defpath,
    "TZ": "Asia/Tokyo",
}
#: Tests of each line that values are kept of, how long such a test may take unless the function runs in no other, and
#: how long the second (s): to note what functions return makes a test a fifth slower.
TESTS_OF_A_LINE, LONGEST_S, QUICK_S = 2, 0.8, 0.5

#: Modules and tests whose functions wait for other processes: how often they return varies. Functions of the time that
#: has gone by, and of where files lie.
VARYING = (
    *("pipeline/run/chunks", "pipeline/run/workers", "tools/batch/", "tools/view/server"),
    *("cli/screen:Stage.seconds", "cli/screen:clock", "pipeline/run/runner:hash_values", "checks/report/page:_packed"),
)
VARYING_TESTS = tuple(f"tests/test_{name}.py::" for name in ("batch", "heal", "installed_colmap", "parts", "view"))

#: So many places of a result are kept.
PLACES = 10

#: By test: seconds, and by function and place what it returned.
Seen = dict[str, tuple[float, dict[str, dict[str, Any]]]]


def run(folder: Path, words: Sequence[str], *, elsewhere: bool = False) -> int:
    """Run tests and write what functions return in each; returns pytest's exit code."""
    if folder.exists() and any(folder.iterdir()):
        raise SystemExit(f"{folder} is not empty")
    command = [sys.executable, "-m", "pytest", "-q", "--numprocesses", "auto", "--dist", "loadfile", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment |= ELSEWHERE if elsewhere else {}
    return subprocess.run([*command, f"--write-returned={folder}"], cwd=ROOT, env=environment, check=False).returncode


def read(folder: Path) -> Seen:
    """What a run wrote."""
    every = (json.loads(file.read_text()) for file in sorted(folder.glob("*.json")))
    return {seen["test"]: (seen["seconds"], seen["returned"]) for seen in every}


def agreed(runs: Sequence[Seen]) -> Seen:
    """What is the same in all runs that a test was in: a hundredfold closer than tests ask."""
    first, *others = runs
    out: Seen = {}
    for test, (seconds, functions) in first.items():
        rest = [other[test][1] for other in others if test in other]
        kept = {
            name: {
                place: summary
                for place, summary in places.items()
                if all(same(other.get(name, {}).get(place), summary, share=1e-5) for other in rest)
            }
            for name, places in functions.items()
        }
        if rest:
            out[test] = seconds, {name: _shallowest(places) for name, places in kept.items() if places}
    return out


def _shallowest(places: dict[str, Any]) -> dict[str, Any]:
    """The first places of a result that hold something; what lies deep in it was returned by another function."""
    order = sorted(
        (place for place in places if ".versions." not in place),
        key=lambda place: (places[place][-1] == "NoneType", place.count(".")),
    )
    return {place: places[place] for place in order[:PLACES]}


def functions_of(module: str) -> Iterator[tuple[str, range]]:
    """Names of a module's functions, as they are noted in tests, and the lines of their bodies."""

    def inside(node: ast.AST, prefix: str) -> Iterator[tuple[str, range]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield prefix + child.name, range(child.body[0].lineno, child.end_lineno + 1)
                yield from inside(child, f"{prefix}{child.name}.<locals>.")
            elif isinstance(child, ast.ClassDef):
                yield from inside(child, f"{prefix}{child.name}.")
            else:
                yield from inside(child, prefix)

    yield from inside(ast.parse((PACKAGE / module).read_text(encoding="utf-8")), f"{module.removesuffix('.py')}:")


def choose(seen: Seen, lines: dict[str, dict[str, list[str]]]) -> dict[str, dict[str, Any]]:
    """By test and function what is kept."""
    seen = {test: some for test, some in seen.items() if not test.startswith(VARYING_TESTS)}
    chosen: dict[str, set[str]] = defaultdict(set)
    for module, contexts in sorted(item for item in lines.items() if item[0].endswith(".py")):
        for function, body in functions_of(module):
            if function.startswith(VARYING):
                continue
            able = {test for test, (_, functions) in seen.items() if function in functions}
            able = {test for test in able if seen[test][0] <= LONGEST_S} or able
            # what is chosen for another line or function already comes first
            costs = {test: (test not in chosen, seen[test][0], test) for test in able}
            tests: set[str] = set()
            for line in body:
                of_line = able & set(contexts.get(str(line), ()))
                ranked = sorted((test not in tests, *costs[test]) for test in of_line)
                tests |= {rank[-1] for i, rank in enumerate(ranked[:TESTS_OF_A_LINE]) if i == 0 or rank[2] < QUICK_S}
            for test in tests:
                chosen[test].add(function)
    return {test: {name: seen[test][1][name] for name in functions} for test, functions in chosen.items()}


def write(kept: dict[str, dict[str, Any]]) -> None:
    """Write what tests compare with, a line a function."""
    tests = []
    for test in sorted(kept):
        rows = (f"{json.dumps(name)}:{_compact(kept[test][name])}" for name in sorted(kept[test]))
        tests.append(f"{json.dumps(test)}:{{\n" + ",\n".join(rows) + "}")
    text = f'{{"versions":{_compact(versions())},\n"tests":{{' + ",\n".join(tests) + "}}\n"
    KEPT.write_text(text, encoding="utf-8")


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


def renewed(before: dict[str, dict[str, Any]], runs: Sequence[Seen]) -> dict[str, dict[str, Any]]:
    """What is kept of the same tests and functions after other runs; of a test that was skipped, what it was."""
    seen = agreed(runs)
    kept = {}
    for test, functions in before.items():
        kept[test] = functions
        if test in seen:
            returned = {name: seen[test][1][name] for name in functions if name in seen[test][1]}
            # a place that was left out before may vary; where none of them is left, the function has others now
            kept[test] = {
                name: {place: places[place] for place in places if place in functions[name]} or places
                for name, places in returned.items()
            }
    return {test: functions for test, functions in kept.items() if functions and exists(test)}


def exists(test: str) -> bool:
    """Whether there is such a test function."""
    file, name = test.partition("[")[0].split("::")
    return (ROOT / file).is_file() and f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")


def renew(only: Sequence[str]) -> None:
    """Write anew what is kept of tests, or of those in some files."""
    before = read_kept()
    files = sorted({test.partition("::")[0] for test in before if exists(test)})
    if only:
        files = [file for file in files if file in only]
    if only and json.loads(KEPT.read_text())["versions"] != versions():
        raise SystemExit("libraries have other versions than the kept values: renew all of these, or install those")
    if unknown := sorted(set(only) - set(files)):
        raise SystemExit(f"values are kept of no test in {', '.join(unknown)} (give paths such as tests/test_scale.py)")
    with tempfile.TemporaryDirectory() as folder:
        usual, other = Path(folder) / "usual", Path(folder) / "other"
        # another distribution over processes, too: what a test's helper keeps for the next ones shows
        if run(usual, files) or run(other, [*files, "--dist", "load"], elsewhere=True):
            raise SystemExit("tests fail: nothing was written")
        kept = renewed(before, [read(usual), read(other)])
    write(kept)
    for test in before:
        for name in sorted(before[test].keys() - kept.get(test, {}).keys()):
            print(f"no longer kept: {name} in {test}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    renewing = parts.add_parser("renew")
    renewing.add_argument("files", nargs="*", help="of tests (default: all that values are kept of)")
    running = parts.add_parser("run")
    running.add_argument("folder", type=Path)
    running.add_argument("--elsewhere", action="store_true")
    choosing = parts.add_parser("choose")
    choosing.add_argument("--map", type=Path, required=True)
    choosing.add_argument("folders", type=Path, nargs="+")
    given, rest = parser.parse_known_args()
    if rest and given.part != "run":
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if given.part == "renew":
        renew(given.files)
    elif given.part == "run":
        sys.exit(run(given.folder.resolve(), rest, elsewhere=given.elsewhere))
    else:
        lines = json.loads(given.map.read_text())["lines"]
        write(choose(agreed([read(folder) for folder in given.folders]), lines))


if __name__ == "__main__":
    main()
