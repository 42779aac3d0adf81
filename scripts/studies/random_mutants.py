"""Faults drawn at random from the package's source, and the share that the tests catch.

    python -m scripts.studies.random_mutants map FILE
    python -m scripts.studies.random_mutants draw --map FILE [--count 300] [--seed S] [--room ROOM] [--list]
                                     [--workers 2] [--json FILE]

``map`` runs the tests once under coverage and writes which tests run which lines, and how long each takes. ``draw``
draws faults at random, at least 12 in each room and of each kind alike: a sign, a factor in place of a divisor, a
transpose, the order of two operands or arguments, a power, minimum for maximum, a bound of whole numbers that is one
off, a dropped term, a unit, a condition turned round, a check that is left out. Each is made in a copy of the package.
Tests that run its line are run until one fails: the quickest, and those that run little beside its module. A fault
counts as caught where a test fails that passes without it. Printed: each fault, and the share caught by room.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
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
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "colmap_inertial"
#: Tests of one fault that run its line: the quickest for so long (s), and as long those that run little but its module.
MOST_S = 15.0
#: A fault that makes its tests run for longer than this is caught, too (s).
LONGEST_S = 900
LEAST_IN_A_ROOM = 12

_SWAPPED = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
_SYMBOL = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.MatMult: "@", ast.Pow: "**"}
_ONE_OFF = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
_TURNED = {ast.Lt: ">", ast.LtE: ">", ast.Gt: "<", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "=="}
_PAIRS = "min max, minimum maximum, nanmin nanmax, argmin argmax, any all, floor ceil, sin cos"
_PARTNER = {a: b for pair in _PAIRS.split(", ") for a, b in (pair.split(), reversed(pair.split()))}
#: Functions of which the order of arguments means nothing.
_SYMMETRIC = {
    "min",
    "max",
    "minimum",
    "maximum",
    "hypot",
    "allclose",
    "array_equal",
    "logical_and",
    "logical_or",
    "samefile",
}
_WHOLE = {"size", "shape", "ndim", "width", "height", "count"}
#: Names of quantities: a unit, or what has none and is real.
_UNIT = re.compile(r"_(s|px|m|rad|deg|hz|s2|pct|percent|share|gib|mb|db|factor|ratio|weight)$")
_DROPPED = {"sqrt", "abs", "deg2rad", "rad2deg", "radians", "degrees", "square", "log", "log1p", "expm1", "exp"}


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One change of the source: what stands at ``start`` to ``end`` (characters) of ``file`` becomes ``new``."""

    file: str
    line: int
    kind: str
    start: int
    end: int
    old: str
    new: str

    @property
    def room(self) -> str:
        """The room of the package."""
        return self.file.split("/")[0]

    def applied(self, text: str) -> str:
        """The module's text with the fault."""
        return text[: self.start] + self.new + text[self.end :]


class Source:
    """A module's text and the places of its nodes."""

    def __init__(self, text: str) -> None:
        self.text = text
        lines = text.splitlines(keepends=True)
        self._begin = [0]
        for line in lines:
            self._begin.append(self._begin[-1] + len(line))
        self._lines = lines

    def span(self, node: ast.AST) -> tuple[int, int]:
        """First character of a node and the one behind it."""
        return self._at(node.lineno, node.col_offset), self._at(node.end_lineno, node.end_col_offset)

    def _at(self, line: int, column: int) -> int:
        # columns count bytes
        return self._begin[line - 1] + len(self._lines[line - 1].encode()[:column].decode())

    def of(self, node: ast.AST) -> str:
        """The text of a node."""
        start, end = self.span(node)
        return self.text[start:end]


def changes(node: ast.AST, source: Source) -> Iterator[tuple[str, ast.AST, str]]:
    """What may be put in place of a node: the kind of fault, the node that is replaced, and the new text."""
    of = source.of
    if isinstance(node, ast.BinOp):
        left, right, kind = of(node.left), of(node.right), type(node.op)
        text = isinstance(node.left, ast.JoinedStr) or isinstance(getattr(node.left, "value", 0), str)
        if kind in _SWAPPED and not text:
            yield "sign" if kind in (ast.Add, ast.Sub) else "factor", node, f"({left}) {_SWAPPED[kind]} ({right})"
        if kind in (ast.Add, ast.Sub, ast.Mult) and not text:
            yield "dropped term", node, f"({left})"
        if kind in (ast.Sub, ast.Div, ast.MatMult):
            yield "operand order", node, f"({right}) {_SYMBOL[kind]} ({left})"
        if kind is ast.Pow:
            yield "power", node, f"({left})"
    elif isinstance(node, ast.AugAssign) and type(node.op) in _SWAPPED:
        yield "sign", node, f"{of(node.target)} {_SWAPPED[type(node.op)]}= {of(node.value)}"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not, ast.Invert)):
        yield "sign" if isinstance(node.op, ast.USub) else "condition", node, f"({of(node.operand)})"
    elif isinstance(node, ast.Attribute) and node.attr in ("T", "mT"):
        yield "transpose", node, of(node.value)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right, kind = of(node.left), of(node.comparators[0]), type(node.ops[0])
        if kind in _ONE_OFF and _is_whole(node):
            yield "bound", node, f"{left} {_ONE_OFF[kind]} {right}"
        if kind in _TURNED:
            yield "condition", node, f"{left} {_TURNED[kind]} {right}"
    elif isinstance(node, ast.BoolOp):
        word = " or " if isinstance(node.op, ast.And) else " and "
        yield "condition", node, word.join(f"({of(value)})" for value in node.values)
    elif isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        function = of(node.func)
        if name in _PARTNER:
            yield "partner", node.func, function[: -len(name)] + _PARTNER[name]
        if name in _DROPPED and len(node.args) == 1 and not node.keywords:
            yield "unit", node, f"({of(node.args[0])})"
        if (
            name not in _SYMMETRIC
            and len(node.args) >= 2
            and not any(isinstance(a, (ast.Starred, ast.Constant)) for a in node.args[:2])
        ):
            rest = [of(a) for a in node.args[2:]] + [of(k) for k in node.keywords]
            yield "argument order", node, f"{function}({', '.join([of(node.args[1]), of(node.args[0]), *rest])})"
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool):
        text = of(node)
        if isinstance(node.value, int) and abs(node.value) < 100:
            yield "one off", node, f"({text} + 1)"
        elif isinstance(node.value, float) and node.value:
            yield "unit", node, f"({text} * 10)"
    elif isinstance(node, ast.Raise) and node.exc is not None:
        yield "check", node, "pass"


def _is_whole(node: ast.Compare) -> bool:
    """Whether a comparison looks like one of whole numbers: between reals, ``<`` for ``<=`` changes nothing."""
    parts = [part for side in (node.left, *node.comparators) for part in _terms(side)]
    whole = any(
        (isinstance(part, ast.Constant) and type(part.value) is int)
        or (isinstance(part, ast.Call) and getattr(part.func, "id", "") == "len")
        or (isinstance(part, ast.Attribute) and part.attr in _WHOLE)
        or (isinstance(part, ast.Subscript) and getattr(part.value, "attr", "") == "shape")
        for part in parts
    )
    real = any(
        (isinstance(part, ast.Constant) and isinstance(part.value, float))
        or _UNIT.search(getattr(part, "attr", getattr(part, "id", ""))) is not None
        for part in parts
    )
    return whole and not real


def _terms(side: ast.expr) -> list[ast.expr]:
    """What is added, subtracted or multiplied on one side of a comparison; neither arguments nor indices."""
    if isinstance(side, ast.BinOp):
        return [*_terms(side.left), *_terms(side.right)]
    return [side]


def _skipped(tree: ast.AST) -> set[ast.AST]:
    """Nodes that are no computation: docstrings, annotations, texts, defaults of types."""
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = []
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
            parts = [node.returns, *(a.annotation for a in every if a is not None), *node.decorator_list]
        elif isinstance(node, ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.JoinedStr) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)):
            parts = [node]
        elif isinstance(node, ast.Raise):  # the words of an error
            parts = [node.exc, node.cause]
        elif isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id[:1].isupper():
            parts = [node]  # a type
        for part in parts:
            if part is not None:
                skipped.update(ast.walk(part))
    return skipped


def faults_of(path: Path) -> list[Fault]:
    """Every fault that can be drawn from one module."""
    source = Source(path.read_text(encoding="utf-8"))
    tree = ast.parse(source.text)
    skipped = _skipped(tree)
    file = str(path.relative_to(ROOT / PACKAGE))
    found = []
    for node in ast.walk(tree):
        for kind, place, new in changes(node, source) if node not in skipped else ():
            start, end = source.span(place)
            old = source.text[start:end]
            found.append(Fault(file=file, line=place.lineno, kind=kind, start=start, end=end, old=old, new=new))
    return found


def _is_python(fault: Fault) -> bool:
    try:
        ast.parse(fault.applied((ROOT / PACKAGE / fault.file).read_text(encoding="utf-8")))
    except SyntaxError:
        return False
    return True


def drawn(count: int, seed: int, room: str | None) -> list[Fault]:
    """Faults drawn at random: by room as many as its share of all places, of each kind alike, then a place."""
    chance = random.Random(seed)
    by_room: dict[str, dict[str, list[Fault]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted((ROOT / PACKAGE).rglob("*/*.py")):
        for fault in faults_of(path):
            by_room[fault.room][fault.kind].append(fault)
    sizes = {name: sum(map(len, kinds.values())) for name, kinds in by_room.items()}
    picked: list[Fault] = []
    for name in sorted(by_room) if room is None else [room]:
        wanted = max(LEAST_IN_A_ROOM, round(count * sizes[name] / sum(sizes.values())))
        taken: dict[tuple[str, int, int], Fault] = {}
        for _ in range(100 * wanted):
            fault = chance.choice(by_room[name][chance.choice(sorted(by_room[name]))])
            if len(taken) < wanted and (fault.file, fault.start, fault.end) not in taken and _is_python(fault):
                taken[fault.file, fault.start, fault.end] = fault
        picked += taken.values()
    return picked


def write_map(file: Path) -> None:
    """Run all tests under coverage, and write for each line which tests run it, and how long each test takes."""
    import coverage

    with tempfile.TemporaryDirectory() as folder:
        data, times = Path(folder) / "coverage", Path(folder) / "times.xml"
        config = Path(folder) / "coveragerc"
        config.write_text(f"[run]\ndata_file = {data}\nbranch = false\nsource = {ROOT / PACKAGE}\n")
        words = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "--numprocesses",
            "auto",
            "--dist",
            "loadfile",
            f"--junitxml={times}",
        ]
        words += [f"--cov={PACKAGE}", "--cov-context=test", "--cov-report=", f"--cov-config={config}"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        subprocess.run(words, cwd=ROOT, env=environment, check=False)
        found = coverage.CoverageData(basename=str(data))
        found.read()
        lines: dict[str, dict[str, list[str]]] = {}
        for path in found.measured_files():
            contexts = found.contexts_by_lineno(path)
            named = {str(line): sorted({c.rpartition("|")[0] for c in some if c}) for line, some in contexts.items()}
            lines[str(Path(path).relative_to(ROOT / PACKAGE))] = {line: some for line, some in named.items() if some}
        seconds: dict[str, float] = {}
        for case in re.finditer(r'<testcase classname="([^"]*)" name="([^"]*)" time="([^"]*)"', times.read_text()):
            name = f"{case[1].replace('.', '/')}.py::{case[2].partition('[')[0]}"
            seconds[name] = seconds.get(name, 0.0) + float(case[3])
    file.write_text(json.dumps({"lines": lines, "seconds": seconds}))


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
            "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        code = f"import {PACKAGE}; print({PACKAGE}.__file__)"
        found = self._run([sys.executable, "-c", code]).stdout.strip()
        if not Path(found).is_relative_to(folder):
            raise SystemExit(f"tests would use {found} instead of the copy")

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
            return "caught", f"tests run for more than {LONGEST_S} s"
        failed = re.search(r"^(?:FAILED|ERROR) \S*?(tests/.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
        if failed is not None:
            sound = "::" not in failed[1] or self._passes(failed[1])
            return ("caught", failed[1]) if sound else ("broken", f"{failed[1]} fails without the fault")
        if done.returncode < 0:
            return "caught", f"tests end by signal {-done.returncode}"
        if "ImportError while loading conftest" in done.stderr and self._passes(tests[0]):
            return "caught", "the package cannot be imported"
        printed = (done.stdout + done.stderr).strip().splitlines()
        return ("survived", "") if done.returncode == 0 else ("broken", printed[-1] if printed else "pytest failed")

    @functools.cache  # noqa: B019 (a trial lives as long as the script)
    def _passes(self, test: str) -> bool:
        """Whether a test passes in the installed package, without any fault."""
        return self._pytest([test], where=ROOT, environment={**os.environ}).returncode == 0

    def _pytest(
        self, tests: Sequence[str], where: Path | None = None, environment: dict[str, str] | None = None
    ) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", f"--rootdir={ROOT}"]
        words += ["-o", "pythonpath="]  # the checkout itself would come before the copy
        return self._run([*words, *(str(ROOT / test) for test in tests)], where, environment, timeout=LONGEST_S)

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


class Tests:
    """Which tests run a line: the quickest, and those that run little beside its module."""

    def __init__(self, file: Path) -> None:
        known = json.loads(file.read_text())
        self._lines, self._seconds = known["lines"], known["seconds"]
        #: Lines of a module that a test runs, and of all modules.
        self._run: Counter[tuple[str, str]] = Counter()
        self._run_by: Counter[str] = Counter()
        for module, numbers in self._lines.items():
            for contexts in numbers.values():
                for name in {_function(context) for context in contexts}:
                    self._run[name, module] += 1
                    self._run_by[name] += 1

    def of(self, fault: Fault) -> list[str]:
        """Tests that run the line, the quickest first."""
        lines = self._lines.get(fault.file, {})
        # what runs when the module is imported, such as a default, is of every test that runs anything of the module
        contexts = lines.get(str(fault.line)) or sorted(set().union(*lines.values()))
        by_time = sorted({_function(context) for context in contexts}, key=self._time)
        by_share = sorted(by_time, key=lambda name: -self._run[name, fault.file] / self._run_by[name])
        chosen = {by_time[0]} if by_time else set()
        for names in (by_time, by_share):
            left_s = MOST_S
            for name in names:
                if self._time(name) < left_s:
                    left_s -= self._time(name)
                    chosen.add(name)
        return [name for name in by_time if name in chosen]

    def _time(self, name: str) -> float:
        return self._seconds.get(name, 10.0)


def _function(context: str) -> str:
    """The function of a test, without its parameters."""
    return re.sub(r"\[.*", "", context, flags=re.DOTALL)


def _tried(trial: Trial, fault: Fault, tests: Tests) -> dict[str, object]:
    text = (ROOT / PACKAGE / fault.file).read_text(encoding="utf-8")
    begun = time.perf_counter()
    chosen = tests.of(fault)
    state, by = "survived", "no test runs this line"
    if chosen:
        with trial.module(fault.file, fault.applied(text)):
            state, by = trial.tested(chosen)
    return {**asdict(fault), "room": fault.room, "state": state, "by": by, "seconds": time.perf_counter() - begun}


def run(faults: Sequence[Fault], tests: Tests, workers: int) -> list[dict[str, object]]:
    """Make each fault in a copy of the package, ``workers`` at once, and print what became of it."""
    with tempfile.TemporaryDirectory() as folder:
        of_thread = threading.local()
        number = iter(range(workers))

        def prepare() -> None:
            place = Path(folder).resolve() / str(next(number))
            place.mkdir()
            of_thread.trial = Trial(place)

        def try_one(fault: Fault) -> dict[str, object]:
            row = _tried(of_thread.trial, fault, tests)
            words = f"{row['state']:8} {row['seconds']:5.0f} s  {fault.file}:{fault.line} {fault.kind}"
            print(f"{words}: {' '.join(fault.old.split())[:80]} -> {' '.join(fault.new.split())[:80]}", flush=True)
            return row

        with concurrent.futures.ThreadPoolExecutor(workers, initializer=prepare) as pool:
            return list(pool.map(try_one, faults))


def summary(rows: Sequence[dict[str, object]]) -> str:
    """The share caught by room."""
    lines = []
    for room in [*sorted({str(row["room"]) for row in rows}), "all"]:
        some = [row for row in rows if room in ("all", row["room"])]
        caught = sum(row["state"] == "caught" for row in some)
        lines.append(f"{room:15} {caught:4d} of {len(some):4d} caught, {100 * caught / len(some):5.1f} %")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    parts.add_parser("map").add_argument("file", type=Path)
    draw = parts.add_parser("draw")
    draw.add_argument("--map", type=Path, required=True)
    draw.add_argument("--count", type=int, default=300)
    draw.add_argument("--seed", type=int, default=0)
    draw.add_argument("--room")
    draw.add_argument("--list", action="store_true", help="show them and run nothing")
    draw.add_argument("--workers", type=int, default=2)
    draw.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.part == "map":
        write_map(given.file)
        return
    faults = drawn(given.count, given.seed, given.room)
    if given.list:
        print("\n".join(f"{f.file}:{f.line} {f.kind}: {f.old!r} -> {f.new!r}" for f in faults))
        return
    rows = run(faults, Tests(given.map), given.workers)
    print(f"\nseed {given.seed}\n{summary(rows)}")
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
