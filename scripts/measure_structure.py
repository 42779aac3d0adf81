"""Structure of the package in numbers: imports, sizes of functions, constants, names, words, tests.

    python scripts/measure_structure.py [--root DIR] [--before DIR] [--cases] [--list NUMBER]

Prints what is asked of each number, and what it is in the checkout that this script lies in (or ``--root``) and in
that of ``--before``. ``--list`` prints what a number counts, with file and line. ``--cases`` has pytest count the test
cases, which takes longer. ``tests/test_layers.py`` keeps the numbers from growing.

A room is a name at the top level of the package. Imports inside functions and under ``TYPE_CHECKING`` count, too;
``from a import b`` imports the module ``a.b`` where there is one, and ``a`` otherwise.
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path

from count_code import PACKAGE, ROOT, Function, code_lines, complexity, lines_without_docstring, parameter_count

#: Names of several words that begin with a participle or a preposition.
PHRASE = re.compile(
    "_*(?!(?:embed|feed|need|speed)_)([a-z]+ed|begun|built|chosen|done|drawn|felt|found|given|held|kept|known|left|lost|made|met|said"
    "|seen|shown|shrunk|taken|told|torn|written|about|above|across|after|against|along|among|around|as|at|before|behind"
    "|below|beside|between|beyond|by|down|during|for|from|in|inside|into|like|near|of|off|on|onto|out|outside|over|past"
    "|per|since|than|through|throughout|to|towards|under|until|up|upon|with|within|without)_"
)

Graph = Mapping[str, set[str]]
#: What a number counts, one line each; or what each file adds to it.
Counted = list[str] | dict[str, int]


class Checkout:
    """The files of one checkout, read once."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.texts = self.read(PACKAGE, "*.py")
        self.trees = {path: ast.parse(text) for path, text in self.texts.items()}
        self.nodes = [(path, node) for path, tree in self.trees.items() for node in ast.walk(tree)]
        self.modules = {module_name(path): path for path in self.texts}

    def read(self, folder: str, pattern: str) -> dict[str, str]:
        """Texts of a folder's files, at any depth, by path relative to the root."""
        return {str(p.relative_to(self.root)): p.read_text() for p in sorted((self.root / folder).rglob(pattern))}

    @cached_property
    def rooms(self) -> list[str]:
        """Names at the top level, without ``__init__`` and ``__main__``."""
        paths = [*self.texts, *self.read(PACKAGE, "*.pyi")]
        names = {path.split("/")[1].split(".")[0] for path in paths}
        return sorted(names - {"__init__", "__main__"})

    @cached_property
    def imports(self) -> list[tuple[str, str, str]]:
        """Importing module, place and full name of all imports."""
        found = []
        for path, node in self.nodes:
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            found += [(module_name(path), f"{path}:{node.lineno}", name) for name in names]
        return found

    def graph(self, nodes: Iterable[str], node_of: Callable[[str], str]) -> Graph:
        """What each room or module imports."""
        graph: dict[str, set[str]] = {node: set() for node in nodes}
        for module, _, name in self.imports:
            importing, imported = node_of(module), node_of(name)
            if importing in graph and imported in graph and importing != imported:
                graph[importing].add(imported)
        return graph

    @cached_property
    def room_graph(self) -> Graph:
        return self.graph(self.rooms, room_of)

    @cached_property
    def module_graph(self) -> Graph:
        return self.graph(self.modules, lambda name: name if name in self.modules else name.rpartition(".")[0])

    @cached_property
    def functions(self) -> list[tuple[str, Function]]:
        """Functions and methods, those inside of others too, with their places."""
        return [(f"{path}:{node.lineno} {node.name}", node) for path, node in self.nodes if isinstance(node, Function)]


def module_name(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def room_of(name: str) -> str:
    """Room of a module, or of what is imported; empty where it is none of ours."""
    package, room, *_ = f"{name}.".split(".")
    return room if package == PACKAGE else ""


def circles(graph: Graph) -> list[list[str]]:
    """Strongly connected components of two nodes or more."""
    reached: dict[str, set[str]] = {}
    for start in graph:
        reached[start], ahead = set(), [start]
        while ahead:
            steps = graph[ahead.pop()] - reached[start]
            reached[start] |= steps
            ahead += steps
    components = {frozenset(other for other in reached[node] if node in reached[other]) for node in graph}
    return sorted(sorted(component) for component in components if component)


def longest_chain(graph: Graph) -> list[str]:
    """Nodes of the longest path, what is imported by all others first; a circle counts as one node."""
    circle_of = {node: circle for circle in circles(graph) for node in circle}
    chains: dict[str, list[str]] = {}

    def chain(node: str) -> list[str]:
        members = circle_of.get(node, [node])
        if members[0] not in chains:
            ahead = sorted({step for member in members for step in graph[member]} - set(members))
            chains[members[0]] = [*max(map(chain, ahead), key=len, default=[]), " = ".join(members)]
        return chains[members[0]]

    return max(map(chain, sorted(graph)), key=len, default=[])


def private_imports(checkout: Checkout, across: str) -> list[str]:
    """Private names and modules imported from another room, or from outside of the ``"package"`` that they lie in."""
    found = []
    for module, place, name in checkout.imports:
        parts = name.split(".")
        private = [k for k, part in enumerate(parts) if re.match("_(?!_)", part) and part != "_kernels"]
        if not private or room_of(name) in ("", "_kernels"):
            continue
        owner = parts[: private[0]]
        if not checkout.modules.get(".".join(owner), "__init__.py").endswith("__init__.py"):
            owner.pop()
        inside = module.split(".")[: len(owner)] == owner if across == "package" else room_of(module) == parts[1]
        if not inside:
            found.append(f"{place} {name}")
    return found


def has_number(node: ast.AST) -> bool:
    return any(isinstance(n, ast.Constant) and type(n.value) in (int, float, complex) for n in ast.walk(node))


def phrase_names(checkout: Checkout) -> list[str]:
    """Functions outside of classes and other functions whose names begin with a preposition or a participle."""
    nodes = [(path, node) for path, tree in checkout.trees.items() for node in tree.body if isinstance(node, Function)]
    return [f"{path}:{node.lineno} {node.name}" for path, node in nodes if PHRASE.match(node.name)]


def large(checkout: Checkout, size: Callable[[Function], int], least: int) -> list[str]:
    """Functions of this size or more, the largest first."""
    sizes = [(size(function), place) for place, function in checkout.functions]
    return [f"{place} {value}" for value, place in sorted(sizes, reverse=True) if value >= least]


def assignments(checkout: Checkout, holds: Callable[[ast.AST], bool]) -> list[str]:
    """Assignments at the top level of modules whose values hold something."""
    nodes = [(path, node) for path, tree in checkout.trees.items() for node in tree.body]
    return [
        f"{path}:{node.lineno} {ast.unparse(node)[:100]}"
        for path, node in nodes
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and holds(node.value)
    ]


def lines_with(texts: Mapping[str, str], pattern: str) -> list[str]:
    """Lines in which a pattern occurs."""
    rows = [(f"{path}:{k}", row) for path, text in texts.items() for k, row in enumerate(text.splitlines(), 1)]
    return [f"{place} {row.strip()}" for place, row in rows if re.search(pattern, row)]


def sizes(texts: Mapping[str, str], split: Callable[[str], list[str]]) -> dict[str, int]:
    """Words or lines of each file."""
    return {path: len(split(text)) for path, text in texts.items()}


def test_cases(checkout: Checkout) -> list[str]:
    """Names of the cases that pytest collects, by the checkout's own Python where it has one."""
    own = checkout.root / ".venv/bin/python"
    command = [str(own) if own.exists() else sys.executable, "-m", "pytest", "--collect-only", "-q", "tests"]
    done = subprocess.run(command, cwd=checkout.root, check=True, capture_output=True, text=True)
    return [row for row in done.stdout.splitlines() if "::" in row]


def written_pages(checkout: Checkout) -> dict[str, str]:
    """Pages of the documentation but those that a script makes."""
    texts = checkout.read("docs", "*.md")
    return {path: text for path, text in texts.items() if "Generated by scripts/" not in text[:200]}


#: Name for ``--list``: what is asked, what the number is, and how it is counted.
NUMBERS: dict[str, tuple[int | None, str, Callable[[Checkout], Counted]]] = {
    "names": (13, "names at the top level", lambda c: c.rooms),
    "rows": (10, "rooms on the longest chain of imports", lambda c: longest_chain(c.room_graph)),
    "arrows": (None, "imports of rooms by rooms", lambda c: [f"{a} {b}" for a in c.rooms for b in c.room_graph[a]]),
    "circles": (0, "circles of modules", lambda c: [" = ".join(circle) for circle in circles(c.module_graph)]),
    "chain": (20, "modules on the longest chain of imports", lambda c: longest_chain(c.module_graph)),
    "private_rooms": (0, "private names imported across rooms", lambda c: private_imports(c, "room")),
    "private_packages": (0, "private names imported across packages", lambda c: private_imports(c, "package")),
    "code": (38000, "code lines", lambda c: {path: code_lines(text) for path, text in c.texts.items()}),
    "long": (0, "functions above 60 lines without docstring", lambda c: large(c, lines_without_docstring, 61)),
    "complex": (5, "functions of a complexity above 20", lambda c: large(c, complexity, 21)),
    "wide": (2, "functions with 8 or more parameters", lambda c: large(c, parameter_count, 8)),
    "numbers": (450, "module-level assignments with a number", lambda c: assignments(c, has_number)),
    "assigned": (None, "module-level assignments", lambda c: assignments(c, lambda _: True)),
    "offset": (8, "files that name the clock offset", lambda c: [p for p, t in c.texts.items() if "time_offset" in t]),
    "on_camera_rate": (1, "calls of on_camera_rate", lambda c: lines_with(c.texts, r"(?<!def )\bon_camera_rate\(")),
    "phrases": (0, "functions named by a preposition or participle", phrase_names),
    "docs": (30000, "words of docs that are not generated", lambda c: sizes(written_pages(c), str.split)),
    "readme": (1100, "words of the README", lambda c: {"README.md": len((c.root / "README.md").read_text().split())}),
    "scripts": (None, "scripts", lambda c: list(c.read("scripts", "*.py"))),
    "script_lines": (None, "lines of scripts", lambda c: sizes(c.read("scripts", "*.py"), str.splitlines)),
    "test_files": (None, "test files", lambda c: list(c.read("tests", "*.py"))),
    "test_lines": (None, "lines of tests", lambda c: sizes(c.read("tests", "*.py"), str.splitlines)),
    "tests": (None, "test functions", lambda c: lines_with(c.read("tests", "*.py"), r"^ *def test_")),
    "cases": (2800, "test cases", test_cases),
}


def measure(checkout: Checkout, name: str) -> int:
    counted = NUMBERS[name][2](checkout)
    return sum(counted.values()) if isinstance(counted, dict) else len(counted)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=ROOT)
    parser.add_argument("--before", type=Path)
    parser.add_argument("--cases", action="store_true")
    parser.add_argument("--list", choices=NUMBERS)
    given = parser.parse_args()
    if given.list:
        counted = NUMBERS[given.list][2](Checkout(given.root))
        rows = [f"{n:6d} {path}" for path, n in counted.items()] if isinstance(counted, dict) else counted
        print("\n".join(rows))
        return
    roots = {"before": given.before, "now": given.root}
    checkouts = {title: Checkout(root) for title, root in roots.items() if root}
    print(f"{'name':16} {'number':48} {'asked':>7}" + "".join(f" {title:>7}" for title in checkouts))
    for name, (asked, text, _) in NUMBERS.items():
        if name != "cases" or given.cases:
            measured = "".join(f" {measure(checkout, name):7d}" for checkout in checkouts.values())
            print(f"{name:16} {text:48} {'' if asked is None else asked:>7}{measured}")


if __name__ == "__main__":
    main()
