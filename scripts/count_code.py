"""Code lines, functions with many parameters and type tests of stages, of this checkout and an earlier commit.

    python scripts/count_code.py [--against COMMIT] [--parameters 8]

Counts lines of the package that hold code: no docstrings, comments or blank lines. With ``--against``, modules that
COMMIT has, too, under the same or another name as git follows it, are compared, and what is new is listed apart.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "colmap_inertial"
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def git(*words: str) -> str:
    """What git prints."""
    return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True).stdout


def code_lines(text: str) -> int:
    """Lines that hold code."""
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            held.update(range(token.start[0], token.end[0] + 1))
    return len(held - _docstring_lines(text))


def _docstring_lines(text: str) -> set[int]:
    lines: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        for child in ast.iter_child_nodes(node):
            if (
                isinstance(child, ast.Expr)
                and isinstance(child.value, ast.Constant)
                and isinstance(child.value.value, str)
            ):
                lines.update(range(child.lineno, (child.end_lineno or child.lineno) + 1))
    return lines


def parameter_count(function: Function) -> int:
    """Parameters of a function or method; ``self`` and ``cls`` do not count."""
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return len([parameter for parameter in every if parameter.arg not in ("self", "cls")])


def lines_without_docstring(function: Function) -> int:
    """Lines from ``def`` to the end."""
    first = function.body[0]
    docstring = 0 if ast.get_docstring(function) is None else (first.end_lineno or 0) - first.lineno + 1
    return (function.end_lineno or 0) - function.lineno + 1 - docstring


def complexity(function: Function) -> int:
    """Cyclomatic complexity as radon 6 counts it: functions inside of this one are counted by themselves."""
    return 1 + sum(map(_decisions, function.body))


def _decisions(node: ast.AST) -> int:
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return 0
        case ast.Assert():
            return 1
        case ast.If() | ast.IfExp():
            own = 1
        case ast.For() | ast.AsyncFor() | ast.While():
            own = 1 + bool(node.orelse)
        case ast.Try():
            own = len(node.handlers) + bool(node.orelse)
        case ast.BoolOp():
            own = len(node.values) - 1
        case ast.comprehension():
            own = 1 + len(node.ifs)
        case ast.Match():
            own = len(node.cases) - any(getattr(case.pattern, "pattern", node) is None for case in node.cases)
        case _:
            own = 0
    return own + sum(map(_decisions, ast.iter_child_nodes(node)))


def with_many_parameters(text: str, least: int) -> Iterator[tuple[str, int]]:
    """Functions and methods with so many parameters or more."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, Function) and parameter_count(node) >= least:
            yield node.name, parameter_count(node)


def modules(commit: str | None) -> dict[str, str]:
    """The package's Python files by path, with their text."""
    if commit is None:
        return {str(p.relative_to(ROOT)): p.read_text() for p in sorted((ROOT / PACKAGE).rglob("*.py"))}
    names = [n for n in git("ls-tree", "-r", "--name-only", commit, PACKAGE).splitlines() if n.endswith(".py")]
    return {name: git("show", f"{commit}:{name}") for name in names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="COMMIT")
    parser.add_argument("--parameters", type=int, default=8)
    given = parser.parse_args()
    now = modules(None)
    lines = {name: code_lines(text) for name, text in now.items()}
    print(f"code lines: {sum(lines.values())} in {len(now)} modules")
    many = [(name, *found) for name, text in now.items() for found in with_many_parameters(text, given.parameters)]
    print(f"functions with {given.parameters} or more parameters: {len(many)}")
    for name, function, count in many:
        print(f"  {count:3d} {function}  ({name})")
    tests = [name for name, text in now.items() if re.search(r"isinstance\([^()]*Stage\b", text)]
    print(f"modules that test the type of a stage: {len(tests)} {' '.join(tests)}")
    if given.against is None:
        return
    before = modules(given.against)
    old = {name: code_lines(text) for name, text in before.items()}
    listed = git("diff", "--name-status", "-M40%", given.against, "--", PACKAGE).splitlines()
    added = {row.split("\t")[1] for row in listed if row.startswith("A")}
    removed = {row.split("\t")[1] for row in listed if row.startswith("D")}
    kept = sum(count for name, count in lines.items() if name not in added)
    print(f"\n{given.against}: {sum(old.values())} code lines in {len(old)} modules")
    print(f"modules that existed: {sum(old.values())} -> {kept} ({100 * (kept / sum(old.values()) - 1):+.1f} %)")
    print("new modules: " + (", ".join(f"{n} {lines[n]}" for n in sorted(added) if n in lines) or "none"))
    print("modules that went: " + (", ".join(f"{n} {old[n]}" for n in sorted(removed) if n in old) or "none"))


if __name__ == "__main__":
    main()
