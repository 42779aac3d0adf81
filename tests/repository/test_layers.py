"""The architecture: a package imports only earlier ones, and starting up is cheap."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import colmap_inertial

PACKAGE = Path(__file__).parents[2] / "colmap_inertial"


def module_name(path: Path) -> str:
    """Full name of the module in a file."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


#: Each module's syntax tree by its full name, and the packages among them.
TREES = {module_name(path): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
PACKAGES = {module_name(path) for path in PACKAGE.rglob("__init__.py")}


def imports() -> list[tuple[str, str, str]]:
    """Importing module, place and full name of all imports, those inside functions too."""
    found = []
    for module, tree in TREES.items():
        for node in ast.walk(tree):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [(module, f"{module}:{node.lineno}", name) for name in names]
    return found


IMPORTS = imports()

#: Each room imports only itself and rooms of earlier rows.
ROWS = [
    ("messages",),
    ("core", "_kernels"),
    ("io", "imaging"),
    ("model", "motion"),
    ("inertial",),
    ("evidence",),
    ("diagnose", "report"),
    ("validate", "hooks"),
    ("colmap",),
    ("run",),
    ("tools",),
    ("cli",),
]
#: Inside a room, the same. All packages have a place here; modules that have none stand before those that have.
ROWS_INSIDE = {
    "core": [("types",), ("camera_clock",), ("gyro",)],
    "imaging": [("semi_global",), ("plane_sweep", "multi_aperture", "exposure_pairs", "restoration")],
    "model": [("submodels",)],
    "motion": [("flow",), ("two_view_rotation", "shutter", "lateral_flow", "sign"), ("align", "smooth")],
    "inertial": [("core",), ("scale",), ("static_calibration", "georeference"), ("refine", "join")],
    "colmap": [("views",), ("loops",), ("features",), ("matching",), ("mapping",), ("dense",)],
    "run": [("steps",), ("stages",), ("preparation",), ("commands",)],
    "tools": [("simulate", "batch", "view"), ("export",)],
}
ROW = {room: row for row, rooms in enumerate(ROWS) for room in rooms}
ROW_INSIDE = {
    f"{room}.{name}": row for room, rows in ROWS_INSIDE.items() for row, names in enumerate(rows) for name in names
}

#: The only importers of pycolmap.
COLMAP = ("model", "inertial.refine", "diagnose", "validate", "report", "hooks", "colmap", "run", "tools", "cli")
#: What computes touches no file.
COMPUTES = ("core", "_kernels", "imaging", "motion", "inertial", "evidence")
TOUCHES_FILES = ("core.errors", "core.options", "core.progress", "core.threads", "core.types.imu")


def inside(module: str, places: tuple[str, ...]) -> bool:
    """Whether a module lies in one of these rooms, packages or modules."""
    return any(f"{module}.".startswith(f"colmap_inertial.{place}.") for place in places)


def room_of(name: str) -> str:
    """Top-level package of a module, or of what is imported; empty where it is none of ours."""
    package, room, *_ = f"{name}.".split(".")
    return room if package == PACKAGE.name else ""


def test_a_room_imports_only_rooms_above_it():
    rooms = {path.name.split(".")[0] for path in PACKAGE.iterdir() if path.suffix in (".py", ".pyi") or path.is_dir()}
    assert sorted(name for name in rooms if not name.startswith("__")) == sorted(ROW)
    upward = []
    for module, place, name in IMPORTS:
        room, other = room_of(module), room_of(name)
        if room in ROW and other in ROW and room != other and ROW[other] >= ROW[room]:
            upward.append(f"{place} imports {name}")
    assert upward == []


def test_inside_a_room_packages_import_only_those_above_them():
    assert {name.partition(".")[2] for name in PACKAGES if name.count(".") == 2} <= set(ROW_INSIDE)
    assert {f"colmap_inertial.{name}" for name in ROW_INSIDE} <= set(TREES)
    upward = []
    for module, place, name in IMPORTS:
        own, other = (".".join(full.split(".")[1:3]) for full in (module, name))
        same_room = room_of(module) == room_of(name) and own != other
        if same_room and other in ROW_INSIDE and ROW_INSIDE[other] >= ROW_INSIDE.get(own, -1):
            upward.append(f"{place} imports {name}")
    assert upward == []


def test_no_modules_import_each_other_in_a_circle():
    graph: dict[str, set[str]] = {module: set() for module in TREES}
    for module, _, name in IMPORTS:
        imported = name if name in TREES else name.rpartition(".")[0]
        if imported in graph and imported != module:
            graph[module].add(imported)
    graphlib.TopologicalSorter(graph).prepare()  # a CycleError names the modules


def test_private_names_and_modules_stay_in_their_package():
    outside = []
    for module, place, name in IMPORTS:
        parts = name.split(".")
        private = [k for k, part in enumerate(parts) if re.match("_(?!_)", part) and part != "_kernels"]
        if not private or room_of(name) in ("", "_kernels"):
            continue
        owner = ".".join(parts[: private[0]])
        if owner not in PACKAGES:
            owner = owner.rpartition(".")[0]
        if not f"{module}.".startswith(f"{owner}."):
            outside.append(f"{place} imports {name}")
    assert outside == []


def test_imports_are_absolute():
    relative = [
        f"{module}:{node.lineno}"
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert relative == []


def test_only_model_and_below_touch_colmap_and_estimators_touch_no_file():
    broken = []
    for module, place, name in IMPORTS:
        library = name.split(".")[0]
        computes = inside(module, COMPUTES) and not inside(module, TOUCHES_FILES)
        if library == "pycolmap" and not inside(module, COLMAP):
            broken.append(f"{place} imports {name}")
        if library in ("pathlib", "os", "io", "shutil", "tempfile") and computes:
            broken.append(f"{place} imports {name}")
    assert broken == []


def output_of(code: str) -> str:
    """What a bare Python process prints for ``code``."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_importing_the_command_line_loads_nothing_heavy():
    heavy = "('numpy', 'pycolmap', 'cv2', 'open3d', 'filterpy', 'scipy', 'av', 'yaml', 'rich.progress')"
    code = f"import sys, colmap_inertial.cli; print([m for m in {heavy} if m in sys.modules])"
    assert output_of(code) == "[]"


def test_importing_the_command_line_loads_only_what_describes_the_commands():
    rooms = "{m.split('.')[1] for m in sys.modules if m.startswith('colmap_inertial.')}"
    code = f"import sys, colmap_inertial.cli; print(sorted({rooms}))"
    assert output_of(code) == "['cli', 'core', 'messages']"


def test_importing_every_module_works_on_its_own():
    names = [name for name in TREES if not name.endswith("__main__")]
    code = f"import importlib\nfor name in {names!r}: importlib.import_module(name)"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_python_s_zlib_survives_pycolmap():
    # A bare process: pytest itself imports zlib early and would hide the crash.
    code = (
        "import colmap_inertial, pycolmap, zlib, numpy, io\n"
        "data = bytes(range(256)) * 4000\n"
        "assert zlib.decompress(zlib.compress(data)) == data\n"
        "numpy.savez_compressed(io.BytesIO(), a=numpy.arange(1000))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_leads_somewhere():
    for name in colmap_inertial.__all__:
        assert getattr(colmap_inertial, name).__name__ == name
    with pytest.raises(AttributeError, match="nothing"):
        colmap_inertial.nothing  # noqa: B018
    code = "import sys, colmap_inertial; print([m for m in sys.modules if m.startswith('colmap_inertial.')])"
    assert output_of(code) == "[]"


def test_documented_modules_that_moved_are_still_found():
    code = (
        "from colmap_inertial.restoration import deepgyro; from colmap_inertial.imaging import restoration\n"
        "import colmap_inertial.exposure_pairs; print(deepgyro is restoration.deepgyro)"
    )
    assert output_of(code) == "True"
