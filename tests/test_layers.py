"""The architecture: data moves downhill, and starting up is cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import colmap_inertial

PACKAGE = Path(__file__).parents[1] / "colmap_inertial"

#: Each room may import itself and the rooms before it.
ORDER = [
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
RANK = {room: rank for rank, rooms in enumerate(ORDER) for room in rooms}
PIXELS = ("semi_global", "imaging", "multi_aperture", "restoration", "exposure_pairs", "sweep")
ESTIMATORS = (
    "geometry",
    "sampling",
    "types",
    "gravity",
    "gyro",
    "semi_global",
    "sweep",
    *PIXELS,
    "flow",
    "turns",
    "shutter",
    "slide",
    "align",
    "smooth",
    "scale",
    "georeference",
    "refine",
    "join",
)


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    """Full names of everything a module imports, at module level or inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE or not path.name.startswith("__"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_room_imports_only_rooms_above_it(path):
    room = room_of(path)
    assert room in RANK, f"{room} has no place in the order"
    for name in imports(path):
        parts = name.split(".")
        if parts[0] == "colmap_inertial" and len(parts) > 1 and parts[1] in RANK and parts[1] != room:
            assert RANK[parts[1]] < RANK[room], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_model_and_below_touch_colmap_and_estimators_touch_no_file(path):
    names = {name.split(".")[0] for name in imports(path)}
    if RANK[room_of(path)] < RANK["model"]:
        assert "pycolmap" not in names
    if room_of(path) in ESTIMATORS:
        assert not {"pathlib", "os", "io", "shutil", "tempfile"} & names


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_module_is_too_long_to_read(path):
    assert len(path.read_text().splitlines()) <= 500


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
    names = [".".join(("colmap_inertial", *p.relative_to(PACKAGE).with_suffix("").parts)) for p in MODULES]
    names = [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]
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
