"""A surface by a truncated signed distance function (Curless and Levoy, SIGGRAPH 1996), in Open3D.

Depth maps are brought in one by one, so that memory grows with the surface and not with the images.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.colmap.dense.depth_maps import Maker, map_file
from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.core.errors import InertialError, MissingExtraError, OutputError, advise_library
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.io.files import path_in
from colmap_inertial.io.images import read_image
from colmap_inertial.model import read_model
from colmap_inertial.model.artefacts import read_map

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class SurfaceLimits:
    """The voxels of a surface."""

    #: Which of the depths counts as near: what was filmed for its own sake, not what stands behind.
    near_quantile: float = 0.25
    #: Side of a voxel in pixels where it is near; on the example scene 2 to 3 px are alike.
    voxel_px: float = 2.5
    #: How far from the surface distances are kept; twice of it blunts the example scene.
    truncation_voxels: float = 4.0
    #: What is so many times farther than what is near is coarser than the voxels: it would take most of the memory.
    farthest: float = 3.0
    #: Surfaces that fewer images saw are left out.
    least_seen: float = 3.0
    #: Voxels on a side of the blocks that memory comes in,
    block_voxels: int = 8
    #: blocks in the beginning,
    first_blocks: int = 10_000
    #: and the most of them: about 3 GB.
    most_blocks: int = 400_000


SURFACE = SurfaceLimits()


def require_mesh_maker(options: ReconstructOptions) -> None:
    """Check that Open3D can be loaded where it is to make the mesh, before the work begins.

    In a process of its own: it takes 200 MB, which COLMAP may need until the mesh is made.

    Raises
    ------
    MissingExtraError
        Where it is not installed.
    InertialError
        Where it is, but a library of the system is missing.
    """
    if options.dense and options.dense_options.mesh == "tsdf":
        if find_spec("open3d") is None:
            raise _missing_error()
        tried = subprocess.run(
            [sys.executable, "-c", "import open3d"], capture_output=True, text=True, errors="replace"
        )
        if tried.returncode:
            raise _unloadable_error((tried.stderr.strip().splitlines() or [f"exit code {tried.returncode}"])[-1])


def _missing_error() -> MissingExtraError:
    return MissingExtraError("mesh", Fact("needs-open3d"))


def _unloadable_error(why: str) -> InertialError:
    return InertialError(Fact("open3d-not-loaded", detail=why, mend=advise_library(why, "open3d")))


def _import_open3d() -> ModuleType:
    try:
        import open3d
    except ModuleNotFoundError:
        raise _missing_error() from None
    except (ImportError, OSError) as error:
        raise _unloadable_error(str(error)) from error
    return open3d


def tsdf_mesh(folder: Path, names: Sequence[str], target: Path, *, maker: Maker, kind: str) -> None:
    """Write the surface of a workspace's depth maps as a coloured mesh (PLY).

    Parameters
    ----------
    folder
        The workspace, with ``images/``, ``sparse/`` and maps.
    names
        Of the images that have maps.
    target
        File to write.
    maker, kind
        Whose maps, and which of them: patch-match takes a pixel's ray at its corner, the sweep at its centre.

    Raises
    ------
    MissingExtraError, InertialError
        See :func:`require_mesh_maker`; where the surface is too large for its voxels.
    OutputError
        Where nothing was written.
    """
    o3d = _import_open3d()
    core = o3d.core
    model = read_model(folder / "sparse")
    images = {image.name: image for image in (model.image(i) for i in model.reg_image_ids())}
    files = {name: map_file(folder, "depth", name, kind) for name in names}
    typical = [_measure_typical(read_map(files[name]), model.camera(images[name].camera_id)) for name in names]
    near_m, pixel_m = np.median(typical, axis=0)
    voxel_m, far_m = SURFACE.voxel_px * float(pixel_m), SURFACE.farthest * float(near_m)
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.uint16, core.uint16),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel_m,
        block_resolution=SURFACE.block_voxels,
        block_count=SURFACE.first_blocks,
        device=core.Device("CPU:0"),
    )
    for name in sorted(names):
        depth, image = read_map(files[name]), images[name]
        depth = np.where(depth <= far_m, depth, np.float32(0))
        if not depth.any():
            continue
        camera, cam_from_world = model.camera(image.camera_id), np.eye(4)
        cam_from_world[:3] = image.cam_from_world().matrix()
        seen = o3d.t.geometry.Image(np.ascontiguousarray(depth))
        shown = o3d.t.geometry.Image(_read_colours(path_in(folder / "images", name)))
        matrix, pose = core.Tensor(_open3d_matrix(camera.params, maker)), core.Tensor(cam_from_world)
        limits = (1.0, far_m, SURFACE.truncation_voxels)
        blocks = grid.compute_unique_block_coordinates(seen, matrix, pose, *limits)
        grid.integrate(blocks, seen, shown, matrix, pose, *limits)
        if grid.hashmap().size() > SURFACE.most_blocks:
            raise InertialError(Fact("surface-too-large", path=str(target), voxel_m=voxel_m))
    mesh = _sort_mesh(o3d, grid.extract_triangle_mesh(weight_threshold=SURFACE.least_seen))
    if not o3d.t.io.write_triangle_mesh(str(target), mesh) or not target.is_file():
        raise OutputError(Fact("mesh-not-written", path=str(target)))


def _sort_mesh(o3d: ModuleType, mesh: Any) -> Any:
    """The mesh in single precision, its vertices and faces sorted: Open3D's threads leave them in any order."""
    positions = mesh.vertex.positions.numpy().astype(np.float32)
    order = np.lexsort(positions.T[::-1])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    faces = place[mesh.triangle.indices.numpy()]
    # the same vertex first, the same way round
    first = np.argmin(faces, axis=1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    tensor = o3d.core.Tensor
    out = o3d.t.geometry.TriangleMesh(tensor(positions[order]), tensor(faces.astype(np.int32)))
    out.vertex.normals = tensor(mesh.vertex.normals.numpy()[order].astype(np.float32))
    out.vertex.colors = tensor(mesh.vertex.colors.numpy()[order])
    return out


def _measure_typical(depth: Float32Array, camera: pycolmap.Camera) -> tuple[float, float]:
    """Typical near depth of a map, and the size of a pixel there."""
    known = depth[depth > 0]
    near = float(np.quantile(known, SURFACE.near_quantile)) if len(known) else 0.0
    return near, near / float(camera.mean_focal_length())


def _open3d_matrix(params: Array, maker: Maker) -> Array:
    """(3, 3) intrinsics. Open3D rounds down: the depth of a pixel holds for all of it, counted from its corner."""
    fx, fy, cx, cy = params
    aside = 0.0 if maker == "plane sweep" else 0.5
    return np.array([[fx, 0, cx + aside], [0, fy, cy + aside], [0, 0, 1]])


def _read_colours(path: Path) -> Float32Array:
    picture = read_image(path)
    shares = picture.astype(np.float32) / np.float32(np.iinfo(picture.dtype).max)
    return shares if shares.ndim == 3 else np.stack([shares] * 3, axis=2)
