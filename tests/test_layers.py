"""The architecture: data moves downhill, its numbers do not grow, and starting up is cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import colmap_inertial

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from measure_structure import Checkout, measure, room_of  # noqa: E402

CHECKOUT = Checkout(ROOT)

#: Each room imports only itself and rooms of earlier rows.
ROWS = [
    ("core", "_kernels"),
    ("io", "imaging"),
    ("model", "motion"),
    ("inertial",),
    ("checks",),
    ("pipeline",),
    ("colmap",),
    ("reconstruction",),
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
    "checks": [("diagnose", "validate", "report")],
    "pipeline": [("run",), ("stages",)],
    "reconstruction": [("preparation",), ("drivers",)],
    "tools": [("simulate", "batch", "view"), ("export",)],
}
ROW = {room: row for row, rooms in enumerate(ROWS) for room in rooms}
ROW_INSIDE = {
    f"{room}.{name}": row for room, rows in ROWS_INSIDE.items() for row, names in enumerate(rows) for name in names
}

#: The only importers of pycolmap.
COLMAP = ("model", "inertial.refine", "checks", "pipeline", "colmap", "reconstruction", "tools", "cli")
#: What computes touches no file.
COMPUTES = ("core", "_kernels", "imaging", "motion", "inertial")
TOUCHES_FILES = ("core.errors", "core.options", "core.threads")

#: ``scripts/measure_structure.py --list NAME`` prints what a number counts.
LIMITS = {
    "names": 13,
    "rows": 10,
    "circles": 0,
    "chain": 20,  # goal: 20
    "private_rooms": 0,
    "private_packages": 0,
    "code": 49086,  # goal: 38000
    "long": 0,
    "complex": 0,
    "wide": 4,  # public signatures; goal: 2
    "numbers": 347,
    "offset": 8,
    "phrases": 0,
}


def inside(module: str, places: tuple[str, ...]) -> bool:
    """Whether a module lies in one of these rooms, packages or modules."""
    return any(f"{module}.".startswith(f"colmap_inertial.{place}.") for place in places)


def test_a_room_imports_only_rooms_above_it():
    assert sorted(CHECKOUT.rooms) == sorted(ROW)
    upward = []
    for module, place, name in CHECKOUT.imports:
        room, other = room_of(module), room_of(name)
        if room in ROW and other in ROW and room != other and ROW[other] >= ROW[room]:
            upward.append(f"{place} imports {name}")
    assert upward == []


def test_inside_a_room_packages_import_only_those_above_them():
    packages = {".".join(path.split("/")[1:3]) for path in CHECKOUT.texts if path.count("/") > 2}
    assert packages <= set(ROW_INSIDE)
    assert {f"colmap_inertial.{name}" for name in ROW_INSIDE} <= set(CHECKOUT.modules)
    upward = []
    for module, place, name in CHECKOUT.imports:
        own, other = (".".join(full.split(".")[1:3]) for full in (module, name))
        same_room = room_of(module) == room_of(name) and own != other
        if same_room and other in ROW_INSIDE and ROW_INSIDE[other] >= ROW_INSIDE.get(own, -1):
            upward.append(f"{place} imports {name}")
    assert upward == []


def test_imports_are_absolute():
    relative = [
        f"{path}:{node.lineno}" for path, node in CHECKOUT.nodes if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert relative == []


def test_only_model_and_below_touch_colmap_and_estimators_touch_no_file():
    broken = []
    for module, place, name in CHECKOUT.imports:
        library = name.split(".")[0]
        computes = inside(module, COMPUTES) and not inside(module, TOUCHES_FILES)
        if library == "pycolmap" and not inside(module, COLMAP):
            broken.append(f"{place} imports {name}")
        if library in ("pathlib", "os", "io", "shutil", "tempfile") and computes:
            broken.append(f"{place} imports {name}")
    assert broken == []


def test_no_module_is_too_long_to_read():
    assert [path for path, text in CHECKOUT.texts.items() if len(text.splitlines()) > 500] == []


def test_the_numbers_of_the_structure_do_not_grow():
    measured = {name: measure(CHECKOUT, name) for name in LIMITS}
    assert {name: number for name, number in measured.items() if number > LIMITS[name]} == {}


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
    assert output_of(code) == "['cli', 'core']"


def test_importing_every_module_works_on_its_own():
    names = [name for name in CHECKOUT.modules if not name.endswith("__main__")]
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
