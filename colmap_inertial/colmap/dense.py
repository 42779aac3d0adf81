"""From a metric model to depth maps, a fused point cloud and a mesh in metres, by COLMAP."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.io.images import read_image
from colmap_inertial.io.names import path_in
from colmap_inertial.io.ply import read_ply_header
from colmap_inertial.model import TRANSFORM_FILE, read_model
from colmap_inertial.model.artefacts import check_map
from colmap_inertial.options import DenseOptions
from colmap_inertial.run.runner import fingerprint, remove
from colmap_inertial.run.session import Session

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Octree depths of Poisson meshing: COLMAP's own is the largest.
_LEAST_DEPTH, _MOST_DEPTH = 6, 13
#: COLMAP cuts away what is sampled three levels (8 times) more coarsely than the finest; so do we.
_TRIM_LEVELS = 3
_STEPS = 4
#: Ends with the process that started it.
_PATCH_MATCH = """
import ctypes, signal, sys, zlib
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
import pycolmap
options = pycolmap.PatchMatchOptions()
options.max_image_size = int(sys.argv[2])
pycolmap.patch_match_stereo(sys.argv[1], options=options)
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class DenseResult:
    """What became of the dense reconstruction of one model.

    Attributes
    ----------
    folder
        COLMAP's dense workspace.
    images, depth_maps
        How many undistorted images there are, and how many of them have a depth map.
    fused, points
        The point cloud (PLY); ``None`` while depth maps are missing.
    mesh, faces
        Its surface (PLY); ``None`` where none was asked for, or there are no points.
    waiting
        What the user has to do for it to go on; empty where it is finished.
    """

    folder: Path
    images: int
    depth_maps: int
    fused: Path | None = None
    points: int = 0
    mesh: Path | None = None
    faces: int = 0
    waiting: str = ""

    def as_json(self, root: Path) -> dict[str, object]:
        """In JSON types; paths count from ``root``."""
        return {
            "folder": str(self.folder.relative_to(root)),
            "images": self.images,
            "depth_maps": self.depth_maps,
            "fused": self.fused and str(self.fused.relative_to(root)),
            "points": self.points,
            "mesh": self.mesh and str(self.mesh.relative_to(root)),
            "faces": self.faces,
            "waiting": self.waiting or None,
        }


def run_dense(session: Session, indices: Sequence[int], images: Path, options: DenseOptions) -> dict[int, DenseResult]:
    """Undistort, patch-match, fuse and mesh the metric models; lengths are metres because the models' are.

    Without CUDA there is no patch-match: depth maps that lie in the workspace already are used, otherwise the result
    waits for them.

    Parameters
    ----------
    session
        Of the run.
    indices
        Numbers of the models in ``sparse_metric/``.
    images
        The images that agree with the models: the rectified ones where the rolling shutter was undone.
    options
        See :class:`DenseOptions`.

    Raises
    ------
    FormatError
        For an image or depth map that is missing or damaged.
    OutputExistsError
        Where depth maps lie in the workspace that were made from another model.
    """
    steps, progress = len(indices) * _STEPS, session.progress
    # all of them first: depth maps that come later then change nothing that others depend on
    names = {}
    for index in indices:
        names[index] = _undistort(session, index, images, options)
        progress("dense", len(names), steps)
    found: dict[int, DenseResult] = {}
    for index in indices:
        done = len(indices) + (_STEPS - 1) * len(found)

        def step(n: int, done: int = done) -> None:
            progress("dense", done + n, steps)

        found[index] = _densify(session, index, names[index], options, step)
        step(_STEPS - 1)
    return found


def _densify(
    session: Session, index: int, names: Sequence[str], options: DenseOptions, progress: Callable[[int], object]
) -> DenseResult:
    """Everything after undistortion."""
    import pycolmap

    runner, num_threads = session.runner, session.context.num_threads
    folder = session.workspace.dense_metric / str(index)
    before = [f"dense_{index}_undistorted"]

    if pycolmap.has_cuda:
        runner.run(f"dense_{index}_depth", {}, [], lambda _: patch_match(folder, options.max_image_size), after=before)
    kind, mapped = _depth_maps(folder, names)
    progress(1)
    result = DenseResult(folder=folder, images=len(names), depth_maps=len(mapped))
    if not mapped:
        waiting = (
            f"{folder} waits for depth maps: COLMAP makes them on a CUDA GPU only, and this pycolmap is built without "
            "CUDA. Replace it (pip uninstall pycolmap; pip install pycolmap-cuda12), or run 'colmap patch_match_stereo "
            f"--workspace_path {folder}' elsewhere and copy its stereo folder back; then give the same command again"
        )
        if pycolmap.has_cuda:
            waiting = f"{folder} has no depth maps: COLMAP found no images that see enough of the same"
        log.warning("%s", waiting)
        return replace(result, waiting=waiting)
    if len(mapped) < len(names):
        log.warning("model %d: no depth map of %s", index, ", ".join(sorted(set(names) - set(mapped))))
    fused, mesh = folder / "fused.ply", folder / "meshed-poisson.ply"

    def fuse(partial: Sequence[Path]) -> None:
        fusion = pycolmap.StereoFusionOptions()
        fusion.num_threads = num_threads
        pycolmap.stereo_fusion(str(partial[0]), str(folder), input_type=kind, options=fusion, output_type="PLY")
        visible = partial[0].with_name(partial[0].name + ".vis")
        if not visible.is_file():
            raise OutputError(f"{fused}: COLMAP did not write the fused points; is the disk full?")
        os.replace(visible, partial[1])

    maps = [fingerprint(folder / "stereo" / f"{what}_maps") for what in ("depth", "normal")]
    runner.run(f"dense_{index}_fused", {"maps": maps}, [fused, folder / "fused.ply.vis"], fuse, after=before)
    progress(2)
    result = replace(result, fused=fused, points=_count(fused, "vertex"))
    if options.mesh == "none" or not result.points:
        remove(mesh)
        return result
    poisson = pycolmap.PoissonMeshingOptions()
    poisson.num_threads = num_threads
    poisson.depth, poisson.trim = _octree(fused, read_model(folder / "sparse"))

    def surface(partial: Sequence[Path]) -> None:
        pycolmap.poisson_meshing(str(fused), str(partial[0]), poisson)
        if not partial[0].is_file():
            raise OutputError(f"{mesh}: COLMAP wrote no mesh; is the disk full?")

    depends = {"depth": poisson.depth, "trim": poisson.trim}
    runner.run(f"dense_{index}_mesh", depends, [mesh], surface, after=[f"dense_{index}_fused"])
    return replace(result, mesh=mesh, faces=_count(mesh, "face"))


def _undistort(session: Session, index: int, images: Path, options: DenseOptions) -> tuple[str, ...]:
    """Write the dense workspace without depth maps; returns the names of its images."""
    import pycolmap

    runner, workspace = session.runner, session.workspace
    model, folder = workspace.sparse_metric / str(index), workspace.dense_metric / str(index)
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction = read_model(model)
    names = tuple(sorted(reconstruction.image(i).name for i in reconstruction.reg_image_ids()))
    _check_images(images, model, reconstruction)
    # depth maps may have taken hours: they are never removed, and never used with another model
    identity = {"model": _digest(model), "max_image_size": options.max_image_size}
    record = folder / "made_from.json"
    has_maps = any(file.is_file() for file in (folder / "stereo").glob("*_maps/**/*"))
    if has_maps and not (record.is_file() and read_json(record) == identity):
        raise OutputExistsError(
            f"{folder / 'stereo'} holds depth maps of another model or other options; rename or remove {folder}"
        )

    def work(partial: Sequence[Path]) -> None:
        scratch = workspace.stamps / "dense"
        remove(scratch)
        scratch.mkdir(parents=True)
        undistortion = pycolmap.UndistortCameraOptions()
        undistortion.max_image_size = options.max_image_size or -1
        pycolmap.undistort_images(str(scratch), str(model), str(images), undistort_options=undistortion)
        lost = [name for name in names if not (scratch / "images" / name).is_file()]
        if lost:
            raise OutputError(f"{folder}: COLMAP could not undistort {len(lost)} of {len(names)} images ({lost[0]})")
        shutil.copyfile(model / TRANSFORM_FILE, scratch / "sparse" / TRANSFORM_FILE)
        for source, target in zip((scratch / "images", scratch / "sparse"), partial, strict=True):
            os.replace(source, target)
        for path in scratch.iterdir():
            if not has_maps or path.name != "stereo":
                remove(folder / path.name)
                os.replace(path, folder / path.name)
        write_json(record, identity)
        remove(scratch)

    depends = {**identity, "images": [fingerprint(path_in(images, name, model)) for name in names]}
    runner.run(f"dense_{index}_undistorted", depends, [folder / "images", folder / "sparse"], work, after=["metric"])
    return names


def _digest(model: Path) -> str:
    """Of a model's poses and cameras."""
    digest = hashlib.sha256()
    for path in sorted(model.iterdir()):
        if path.stem in ("cameras", "images", "rigs", "frames"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _check_images(images: Path, model: Path, reconstruction: pycolmap.Reconstruction) -> None:
    """COLMAP ends the process where an image is missing or has another size than its camera."""
    checked = set()
    for i in reconstruction.reg_image_ids():
        image = reconstruction.image(i)
        path = path_in(images, image.name, model)
        if not path.is_file():
            raise FormatError(path, "no such picture, but the model has it; give the folder of its images")
        if image.camera_id not in checked:
            checked.add(image.camera_id)
            height, width = read_image(path).shape[:2]
            camera = reconstruction.camera(image.camera_id)
            if (width, height) != (camera.width, camera.height):
                raise FormatError(
                    path, f"is {width}x{height}, but its camera in the model is {camera.width}x{camera.height}"
                )


def _map_file(folder: Path, what: str, name: str, kind: str) -> Path:
    return path_in(folder / "stereo" / f"{what}_maps", f"{name}.{kind}.bin")


def patch_match(folder: Path, max_image_size: int | None) -> None:
    """COLMAP's patch-match on a dense workspace, in a process of its own: where CUDA fails it ends the process.

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
    command = [sys.executable, "-c", _PATCH_MATCH, str(folder), str(max_image_size or -1)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InertialError(
            f"{folder}: COLMAP's patch-match ended with code {done.returncode}: {said}. Started again, it continues "
            "with the next depth map"
        )


def _depth_maps(folder: Path, names: Sequence[str]) -> tuple[str, list[str]]:
    """The kind of depth map that is there, and the images that have one and its normals, all of them checked.

    Raises
    ------
    FormatError
        For a map that is damaged: COLMAP would end the process over it.
    """
    for kind in ("geometric", "photometric"):
        mapped = [n for n in names if all(_map_file(folder, w, n, kind).is_file() for w in ("depth", "normal"))]
        if mapped:
            for name in mapped:
                sizes = []
                for what, channels in (("depth", 1), ("normal", 3)):
                    path = _map_file(folder, what, name, kind)
                    sizes.append((path.stat().st_size - check_map(path, channels)) // channels)
                if sizes[0] != sizes[1]:
                    raise FormatError(_map_file(folder, "normal", name, kind), "is not as large as its depth map")
            return kind, mapped
    return "geometric", []


def _octree(fused: Path, model: pycolmap.Reconstruction) -> tuple[int, float]:
    """Depth of the octree, so that its cells are as large as pixels on the surface, and where to trim it."""
    with open(fused, "rb") as file:
        header = read_ply_header(fused, file)
        start = file.tell()
    vertices = next(element for element in header.elements if element.name == "vertex")
    rows = np.memmap(fused, vertices.dtype("<"), "r", start, vertices.rows)
    extent_m = max(float(rows[axis].max()) - float(rows[axis].min()) for axis in "xyz")
    cells_m = []
    for i in model.reg_image_ids():
        image = model.image(i)
        pose, focal_px = image.cam_from_world(), model.camera(image.camera_id).mean_focal_length()
        points = [model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        if points:
            cam = np.array(points) @ pose.rotation.matrix().T + pose.translation
            cells_m.append(float(np.median(cam[:, 2])) / focal_px)
    if not cells_m or extent_m <= 0:
        return _MOST_DEPTH, float(_MOST_DEPTH - _TRIM_LEVELS)
    depth = math.ceil(math.log2(1.1 * extent_m / float(np.median(cells_m))))
    depth = min(max(depth, _LEAST_DEPTH), _MOST_DEPTH)
    return depth, float(depth - _TRIM_LEVELS)


def _count(path: Path, element: str) -> int:
    with open(path, "rb") as file:
        return sum(e.rows for e in read_ply_header(path, file).elements if e.name == element)
