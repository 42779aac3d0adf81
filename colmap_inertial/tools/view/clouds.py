"""Points and meshes as arrays, thinned: from COLMAP's models and from the PLY files of its dense reconstructions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import reader
from colmap_inertial.io.ply import Element, read_ply_header
from colmap_inertial.report.series import stride_indices

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class CloudLimits:
    """Limits of the points that are shown, and of the scene's extent."""

    fewest_views: int = 3
    """Points seen by fewer images are left out where enough others remain."""
    worst_px: float = 2.0
    """So are points with a larger reprojection error."""
    enough_share: float = 0.3
    """Of the points: enough others."""
    reach_of_points_pct: float = 65
    """The scene reaches as far as this share of its points."""
    reach_of_cameras_pct: float = 95
    """And of its cameras."""
    grey: int = 150
    """Of points without a colour."""


LIMITS = CloudLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Cloud:
    """Some of a model's points.

    Attributes
    ----------
    xyz
        (N, 3) float32, in the units of the model.
    rgb
        (N, 3) colours.
    total
        Number of points that the model or file has.
    dense
        Whether they come from depth maps.
    """

    xyz: Float32Array
    rgb: UInt8Array
    total: int
    dense: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """A mesh: vertices (V, 3), faces (F, 3), colours (V, 3) where it has them."""

    vertices: Float32Array
    faces: NDArray[np.uint32]
    rgb: UInt8Array | None


def sparse_cloud(reconstruction: pycolmap.Reconstruction, most: int) -> Cloud:
    """At most ``most`` points of a model, the same each time: those that at least three images see well."""
    ids = np.array(sorted(reconstruction.point3D_ids()), dtype=np.uint64)
    points = reconstruction.points3D
    # a first choice bounds the work for models of millions of points
    chosen = [points[i] for i in ids[stride_indices(len(ids), 2 * most)].tolist()]
    largest = float(np.finfo(np.float32).max)  # what the graphics card's numbers can hold
    chosen = [p for p in chosen if np.abs(p.xyz).max() < largest]
    good = [p for p in chosen if p.track.length() >= LIMITS.fewest_views and not p.error > LIMITS.worst_px]
    if len(good) >= LIMITS.enough_share * len(chosen):
        chosen = good
    chosen = [chosen[i] for i in stride_indices(len(chosen), most).tolist()]
    rgb = np.array([p.color for p in chosen], dtype=np.uint8).reshape(-1, 3)
    if not rgb.any():  # a model without colours
        rgb = np.full_like(rgb, LIMITS.grey)
    xyz = np.array([p.xyz for p in chosen], dtype=np.float32).reshape(-1, 3)
    return Cloud(xyz=xyz, rgb=rgb, total=len(ids), dense=False)


@reader("points")
def dense_cloud(path: Path, most: int, origin: Array | None = None) -> Cloud:
    """At most ``most`` points of a PLY file, evenly chosen; only these are read, and shown where they are finite.

    Coordinates count from (3,) ``origin``.

    Raises
    ------
    FormatError
        For what is no binary PLY file with points.
    """
    table, _ = _vertices(path)
    some = np.asarray(table[stride_indices(len(table), most)])
    xyz = _positions(some, origin)
    finite = np.isfinite(xyz).all(axis=1)
    some, xyz = some[finite], xyz[finite]
    rgb = _colours(some)
    rgb = np.full((len(some), 3), LIMITS.grey, np.uint8) if rgb is None else rgb
    return Cloud(xyz=xyz, rgb=rgb, total=len(table), dense=True)


@reader("a mesh")
def read_mesh(path: Path, most_faces: int, origin: Array | None = None) -> Mesh | None:
    """A PLY file of triangles; ``None`` where it has more than ``most_faces``, or none. Without what is not finite.

    Coordinates count from (3,) ``origin``.

    Raises
    ------
    FormatError
        For what is no binary PLY mesh of triangles.
    """
    table, rest = _vertices(path)
    if rest is None:
        raise FormatError(path, Fact("mesh-without-faces"))
    element, offset, order = rest
    if not 0 < element.rows <= most_faces:
        return None
    lists = [p for p in element.properties if p.count is not None]
    if len(lists) != 1:
        raise FormatError(path, Fact("faces-with-more"))
    fields: list[Any] = []
    for p in element.properties:
        if p.count is None:
            fields.append((p.name, order + p.kind))
        else:
            fields += [("count", order + p.count), ("index", order + p.kind, (3,))]
    dtype = np.dtype(fields)
    if path.stat().st_size < offset + element.rows * dtype.itemsize:
        raise FormatError(path, Fact("mesh-truncated"))
    faces = np.memmap(path, dtype, "r", offset, (element.rows,))
    if not (faces["count"] == 3).all() or faces["index"].max() >= len(table):
        raise FormatError(path, Fact("faces-not-triangles"))
    vertices, index, rgb = _positions(table, origin), faces["index"].astype(np.uint32), _colours(table)
    finite = np.asarray(np.isfinite(vertices).all(axis=1))
    if not finite.all():
        renumbered = (np.cumsum(finite) - 1).astype(np.uint32)
        index = renumbered[index[np.all(finite[index], axis=1)]]
        vertices, rgb = vertices[finite], None if rgb is None else rgb[finite]
    return Mesh(vertices=vertices, faces=index, rgb=rgb) if len(index) else None


def _vertices(path: Path) -> tuple[Any, tuple[Element, int, str] | None]:
    """The table of vertices, mapped from the file; and the faces' element, where in the file it begins, byte order."""
    try:
        with open(path, "rb") as file:
            header = read_ply_header(path, file)
            offset = file.tell()
    except OSError as error:
        raise FormatError(path, Fact("file-not-readable", detail=str(error.strerror or error))) from None
    order, elements = header.order, header.elements
    if order is None or not elements or elements[0].name != "vertex" or elements[0].has_list:
        raise FormatError(path, Fact("ply-not-shown"))
    first = elements[0]
    dtype = first.dtype(order)
    if not {"x", "y", "z"} <= set(dtype.names or ()) or first.rows == 0:
        raise FormatError(path, Fact("holds-no-points"))
    end = offset + first.rows * dtype.itemsize
    if path.stat().st_size < end:
        raise FormatError(path, Fact("truncated"))
    table = np.memmap(path, dtype, "r", offset, (first.rows,))
    faces = elements[1] if len(elements) > 1 and elements[1].name == "face" else None
    return table, None if faces is None else (faces, end, order)


def _positions(table: Any, origin: Array | None) -> Float32Array:
    xyz = np.stack([table[name] for name in "xyz"], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is not finite, and left out
        return (xyz if origin is None else xyz.astype(np.float64) - origin).astype(np.float32)


def _colours(table: Any) -> UInt8Array | None:
    names = ("red", "green", "blue")
    if not set(names) <= set(table.dtype.names):
        return None
    return np.stack([table[name] for name in names], axis=1).astype(np.uint8)


def centre_and_reach(xyz: Array, cameras: Array) -> tuple[Array, float]:
    """The middle of what was filmed, and how far around it most points and nearly all cameras are.

    Far points, which a model of an open place always has, count for little.
    """
    every = np.concatenate([xyz, cameras])
    middle = np.median(xyz if len(xyz) else cameras, axis=0)
    points = np.percentile(np.linalg.norm(xyz - middle, axis=1), LIMITS.reach_of_points_pct) if len(xyz) else 0.0
    poses = np.percentile(np.linalg.norm(cameras - middle, axis=1), LIMITS.reach_of_cameras_pct)
    reach = max(float(points), float(poses), 1e-6 * float(np.abs(every).max()), 1e-9)
    return middle, reach
