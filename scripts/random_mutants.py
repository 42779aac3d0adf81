"""Faults drawn at random from the package's source, and the share that the tests catch.

    python scripts/random_mutants.py map FILE
    python scripts/random_mutants.py draw --map FILE [--count 300] [--seed S] [--room ROOM] [--list]
                                     [--workers 2] [--json FILE]

``map`` runs the tests once under coverage and writes which tests run which lines, and how long each takes. ``draw``
draws faults at random, at least 12 in each room and of each kind alike: a sign, a factor in place of a divisor, a
transpose, the order of two operands or arguments, a power, minimum for maximum, a bound of whole numbers that is one
off, a dropped term, a unit, a condition turned round, a check that is left out. Each is made in a copy of the package.
Tests that run its line are run until one fails: the quickest, those that run little beside its module, and those that
compare what its functions return. Printed: each fault, and the share caught by room.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mutants import PACKAGE, ROOT, Trial
from record_values import functions_of, read_kept

#: Tests of one fault that run its line: the quickest for so long (s), as long those of little but its module, and as
#: long those that compare what its functions return.
MOST_S = 15.0
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


class Tests:
    """Which tests run a line: the quickest, those that run little beside its module, those that keep its values."""

    def __init__(self, file: Path) -> None:
        known = json.loads(file.read_text())
        self._lines, self._seconds = known["lines"], known["seconds"]
        #: Functions of which a test compares what they return with what they returned before.
        self._kept: dict[str, set[str]] = defaultdict(set)
        for test, functions in read_kept().items():
            self._kept[_function(test)].update(functions)
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
        functions = {name for name, body in functions_of(fault.file) if fault.line in body}
        by_kept = [name for name in by_time if functions & self._kept[name]]
        chosen = {by_time[0]} if by_time else set()
        for names in (by_time, by_share, by_kept):
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
