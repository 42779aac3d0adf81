"""The depth maps of a dense workspace: their maker, which are there, COLMAP's patch-match, and fusion by COLMAP."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.settings import NO_SETTINGS, ColmapSettings
from colmap_inertial.core.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import opencv_px_from_colmap
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import path_in, read_json, write_json
from colmap_inertial.model import read_model
from colmap_inertial.model.artefacts import check_map, read_map
from colmap_inertial.model.copying import copy_file

if TYPE_CHECKING:
    import pycolmap

Maker = Literal["patch-match", "plane sweep"]

#: Longer side of images that the sweep works on where the user names none: its work grows with its cube.
_SWEPT_SIZE = 1200
_RECORD = "made_from.json"
#: Keys of the record that decide patch-match's maps, and what counts where an earlier version did not say.
_MADE_FROM = (("model", None), ("max_image_size", None), ("settings", ""))
#: A process that ends with the one that started it.
_BEGIN = """
import ctypes, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
import pycolmap
from colmap_inertial.colmap.settings import ColmapSettings
"""
_PATCH_MATCH = """
options = pycolmap.PatchMatchOptions()
options.max_image_size = int(sys.argv[2])
pycolmap.patch_match_stereo(sys.argv[1], options=ColmapSettings(tuple(sys.argv[3:])).apply(options))
"""
_POISSON = """
options = pycolmap.PoissonMeshingOptions()
options.depth, options.trim, options.num_threads = int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5])
pycolmap.poisson_meshing(sys.argv[1], sys.argv[2], ColmapSettings(tuple(sys.argv[6:])).apply(options))
"""


@dataclass(frozen=True, kw_only=True)
class MadeFrom:
    """Inputs of a workspace's depth maps, stored in it as ``made_from.json``.

    Attributes
    ----------
    model
        Digest of the model's poses and cameras.
    max_image_size
        Longer side of the undistorted images; ``None`` is as they are.
    maps
        Who makes the maps.
    settings
        What the user set of patch-match.
    """

    model: str
    max_image_size: int | None
    maps: Maker
    settings: str = ""

    def write(self, folder: Path) -> None:
        """Write it into a workspace that does not say it already."""
        path, values = folder / _RECORD, asdict(self)
        if not (path.is_file() and read_json(path) == values):
            write_json(path, values)


@dataclass(frozen=True, eq=False, kw_only=True)
class DenseResult:
    """The dense reconstruction of one model.

    Attributes
    ----------
    folder
        COLMAP's dense workspace.
    images, depth_maps
        How many undistorted images there are, and how many of them have a depth map.
    maps
        The method that made the depth maps: patch-match or plane sweep.
    coverage
        Share of the maps' pixels that have a depth.
    fused, points
        The point cloud (PLY); ``None`` while depth maps are missing.
    mesh, faces
        Its surface (PLY); ``None`` where none was asked for, or there are no points.
    waiting
        Why it is incomplete; ``None`` where it is finished.
    """

    folder: Path
    images: int
    depth_maps: int
    maps: Maker
    coverage: float = 0.0
    fused: Path | None = None
    points: int = 0
    mesh: Path | None = None
    faces: int = 0
    waiting: Fact | None = None

    def as_json(self, root: Path) -> dict[str, object]:
        """As JSON types; paths are relative to ``root``."""
        paths = {name: str(value.relative_to(root)) for name, value in vars(self).items() if isinstance(value, Path)}
        return vars(self) | paths | {"waiting": None if self.waiting is None else str(self.waiting)}


def digest_of_model(model: Path) -> str:
    """Digest of a model's poses and cameras."""
    digest = hashlib.sha256()
    for path in sorted(model.iterdir()):
        if path.stem in ("cameras", "images", "rigs", "frames"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def model_of(folder: Path) -> str | None:
    """The digest of the model that a dense workspace of ours was made from; ``None`` for any other folder."""
    record = folder / _RECORD
    return str(read_json(record).get("model")) if record.is_file() else None


def choose_maker(
    folder: Path, model: str, max_image_size: int | None, settings: ColmapSettings = NO_SETTINGS
) -> tuple[MadeFrom, bool]:
    """Decide who makes a workspace's depth maps, and tell whether some are there.

    Whoever began goes on: maps of two makers are never mixed. Maps of patch-match may have taken hours, or came from
    elsewhere; they are never used with another model, nor replaced. Those of the sweep that do not fit do not count.

    Parameters
    ----------
    folder
        The workspace, whether it is there or not.
    model
        Digest of the model.
    max_image_size, settings
        What the user asks for.

    Raises
    ------
    OutputExistsError
        Where maps of patch-match lie there that were made from something else, or beside those of the sweep.
    """
    import pycolmap

    maps = [file for file in (folder / "stereo").glob("*_maps/**/*.bin") if file.is_file()]
    here: Maker = "patch-match" if pycolmap.has_cuda else "plane sweep"
    if not maps:
        return _plan_maps(model, max_image_size, here, settings), False
    record = folder / _RECORD
    stated = read_json(record) if record.is_file() else {}
    # an earlier version's record does not say: only patch-match made maps then
    maker: Maker = "plane sweep" if stated.get("maps") == "plane sweep" else "patch-match"
    if maker == "plane sweep" and any(file.name.endswith(".photometric.bin") for file in maps):
        raise OutputExistsError(Fact("maps-of-two-makers", stereo=str(folder / "stereo"), record=str(record)))
    wanted = _plan_maps(model, max_image_size, maker, settings)
    if all(stated.get(key, default) == getattr(wanted, key) for key, default in _MADE_FROM):
        return wanted, True
    if maker == "patch-match":
        raise OutputExistsError(Fact("maps-of-another-model", stereo=str(folder / "stereo"), folder=str(folder)))
    return _plan_maps(model, max_image_size, here, settings), False


def _plan_maps(model: str, max_image_size: int | None, maker: Maker, settings: ColmapSettings) -> MadeFrom:
    if maker == "plane sweep":
        return MadeFrom(model=model, max_image_size=max_image_size or _SWEPT_SIZE, maps=maker)
    chosen = " ".join(settings.of("stereo"))
    return MadeFrom(model=model, max_image_size=max_image_size, maps=maker, settings=chosen)


def map_file(folder: Path, what: str, name: str, kind: str = "geometric") -> Path:
    """Path of an image's map in a workspace; ``what`` is depth or normal."""
    return path_in(folder / "stereo" / f"{what}_maps", f"{name}.{kind}.bin")


def patch_match(
    folder: Path, max_image_size: int | None, settings: ColmapSettings, count: Callable[[int], None]
) -> None:
    """COLMAP's patch-match on a dense workspace, in a process of its own: where CUDA fails it ends the process.

    ``count`` is called each second with the number of depth maps there are, photometric and geometric ones.

    Raises
    ------
    InertialError
        When it fails; the depth maps that are done stay.
    """
    # COLMAP keeps the maps that are there, so that half-written ones must go first
    for path in (folder / "stereo").glob("*_maps/**/*.bin"):
        try:
            check_map(path, 1 if "depth_maps" in path.parts else 3)
        except FormatError:
            remove(path)

    def watch() -> None:
        count(sum(1 for _ in (folder / "stereo" / "depth_maps").glob("**/*.bin")))

    done = _run_apart(_PATCH_MATCH, folder, max_image_size or -1, *settings.of("stereo"), watch=watch)
    if done.returncode:
        message = _last_line(done)
        raise InertialError(Fact("patch-match-failed", folder=str(folder), exit_code=done.returncode, detail=message))


def mesh_points(fused: Path, target: Path, *, depth: int, trim: float, context: RunContext) -> None:
    """Write COLMAP's Poisson surface of a point cloud.

    In a process of its own, whose threads sleep where they wait for each other: its many short loops otherwise take
    most of their time waiting for threads that other programs keep off the processor. With two threads on two busy
    cores and 104,000 points, 45 s and 11 s of processor time instead of 170 s and 81 s.

    Parameters
    ----------
    fused
        The points with normals (PLY).
    target
        Of the mesh (PLY).
    depth, trim
        Of the octree, and up to which level of density the surface is kept.
    context
        How the work is done.

    Raises
    ------
    OutputError
        Where nothing was written.
    """
    settings = context.colmap.of("fusion")
    done = _run_apart(_POISSON, fused, target, depth, trim, context.num_threads, *settings)
    if done.returncode or not target.is_file():
        raise OutputError(Fact("no-mesh-written", folder=str(fused.parent), detail=_last_line(done)))


def _run_apart(
    code: str, *arguments: object, watch: Callable[[], None] = lambda: None
) -> subprocess.CompletedProcess[str]:
    """Run COLMAP in a process of its own, which ends with this one; calls ``watch`` each second."""
    command = [sys.executable, "-c", _BEGIN + code, *map(str, arguments)]
    waiting, pipe = os.environ | {"OMP_WAIT_POLICY": "passive"}, subprocess.PIPE
    with subprocess.Popen(command, env=waiting, stdout=pipe, stderr=pipe, text=True, errors="replace") as process:
        try:
            while True:
                try:
                    out, said = process.communicate(timeout=1)
                    return subprocess.CompletedProcess(command, process.returncode, out, said)
                except subprocess.TimeoutExpired:
                    watch()
        finally:
            process.kill()


def _last_line(done: subprocess.CompletedProcess[str]) -> str:
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


def find_maps(folder: Path, names: Sequence[str]) -> tuple[str, list[str]]:
    """The kind of depth map that is there, and the images that have one and its normals, all of them checked.

    Raises
    ------
    FormatError
        For a map that is damaged: COLMAP would end the process over it.
    """
    for kind in ("geometric", "photometric"):
        mapped = [n for n in names if all(map_file(folder, w, n, kind).is_file() for w in ("depth", "normal"))]
        if mapped:
            for name in mapped:
                sizes = []
                for what, channels in (("depth", 1), ("normal", 3)):
                    path = map_file(folder, what, name, kind)
                    sizes.append((path.stat().st_size - check_map(path, channels)) // channels)
                if sizes[0] != sizes[1]:
                    raise FormatError(map_file(folder, "normal", name, kind), Fact("normals-of-other-size"))
            return kind, mapped
    return "geometric", []


def coverage(folder: Path, names: Sequence[str], kind: str) -> float:
    """Share of the pixels of these pictures' depth maps that have a depth."""
    with_depth = pixels = 0
    for name in names:
        depth = read_map(map_file(folder, "depth", name, kind))
        with_depth, pixels = with_depth + int(np.count_nonzero(depth > 0)), pixels + depth.size
    return with_depth / pixels if pixels else 0.0


def fusion_options(maker: Maker, context: RunContext) -> pycolmap.StereoFusionOptions:
    """Options of COLMAP's fusion of depth maps."""
    import pycolmap

    options = pycolmap.StereoFusionOptions()
    options.num_threads = context.num_threads
    if maker == "plane sweep":
        # uncertain depths are dropped already; 5, COLMAP's own, loses more points than it mends (benchmarks/dense.py: F
        # at 5 mm 0.861 instead of 0.846 on photographs, 0.900 instead of 0.894 on the example scene), and within 2 px
        # too much becomes one point that is not (0.80 instead of 0.83 on photographs; within 1 px meshing takes longer,
        # for the same)
        options.min_num_pixels, options.max_reproj_error = 3, 1.4
    return context.colmap.apply(options)


def fuse_maps(
    folder: Path,
    names: Sequence[str],
    targets: tuple[Path, Path],
    *,
    maker: Maker,
    kind: str,
    scratch: Path,
    context: RunContext,
) -> None:
    """Fuse a workspace's depth maps.

    COLMAP's fusion takes a pixel's ray at its corner, as its patch-match does. Maps of the sweep hold the depth of
    pixels' centres, so that fusion is shown cameras whose principal point is half a pixel aside. It holds all images
    and maps at once, about 20 bytes a pixel; its cache was far slower.

    Parameters
    ----------
    folder
        The workspace.
    names
        Of the images that have maps.
    targets
        Of the points (PLY) and of who sees them (COLMAP's ``.vis``).
    maker, kind
        Whose maps, and which of them.
    scratch
        A folder that may be made and removed.
    context
        How the work is done.

    Raises
    ------
    OutputError
        Where nothing was written.
    """
    import pycolmap

    options = fusion_options(maker, context)
    seen = folder
    if maker == "plane sweep":
        seen = scratch
        _write_corner_workspace(folder, names, scratch)
    pycolmap.stereo_fusion(str(targets[0]), str(seen), input_type=kind, options=options, output_type="PLY")
    remove(scratch)
    visible = targets[0].with_name(targets[0].name + ".vis")
    if not visible.is_file():
        raise OutputError(Fact("points-not-written", folder=str(targets[0].parent)))
    os.replace(visible, targets[1])


def _write_corner_workspace(folder: Path, names: Sequence[str], scratch: Path) -> None:
    """A workspace of links to the images and maps, with cameras that see pixels' corners where centres are."""
    remove(scratch)
    (scratch / "sparse").mkdir(parents=True)
    (scratch / "stereo").mkdir()
    model = read_model(folder / "sparse")
    for camera in model.cameras.values():
        fx, fy, cx, cy = camera.params
        camera.params = [fx, fy, *opencv_px_from_colmap(np.array([cx, cy]))]
    model.write_binary(str(scratch / "sparse"))
    copy_file(folder / "stereo" / "fusion.cfg", scratch / "stereo" / "fusion.cfg")
    for name in names:
        pairs = [(path_in(folder / "images", name), path_in(scratch / "images", name))]
        pairs += [(map_file(folder, what, name), map_file(scratch, what, name)) for what in ("depth", "normal")]
        for source, target in pairs:
            target.parent.mkdir(parents=True, exist_ok=True)
            copy_file(source, target, link=True)
