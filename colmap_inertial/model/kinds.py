"""What kind of file carries length, and who writes it under a similarity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from colmap_inertial.core.types import Similarity
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.model.artefacts import check_map, transform_depth_map, transform_obj, transform_options
from colmap_inertial.model.database import is_database
from colmap_inertial.model.nerf import is_export, is_transforms, transform_export, transform_transforms

#: Formats that carry length and are left as they are; the user is told.
_SUFFIXES = (
    *(".stl", ".off", ".glb", ".gltf", ".fbx", ".dae", ".las", ".laz", ".pcd", ".xyz", ".pts", ".e57", ".splat"),
    *(".mvs", ".nvm", ".out", ".ksplat", ".spz", ".sog", ".tum"),
)
_NAMES = ("georeference.json", "cameras.csv")


def foreign_kind(path: Path) -> str | None:
    """Ending or name of a file that carries length and is left as it is, of which the user is told."""
    if path.name in _NAMES:
        return path.name
    return suffix if (suffix := path.suffix.lower()) in _SUFFIXES else None


def kind_of(file: Path, path: Path) -> str | None:
    """What a file is, where it carries length; damaged maps are refused here even where they would not change."""
    suffix = path.suffix.lower()
    stereo = path.parts[:-1]
    if suffix == ".bin" and "depth_maps" in stereo:
        return "depth map"
    if suffix == ".bin" and "normal_maps" in stereo:
        check_map(file, 3)
        return None
    if suffix == ".obj":
        with open(file, "rb") as head:
            return None if b"\0" in head.read(1024) else "obj"  # a compiler's object file has the same ending
    if is_transforms(path):
        return "transforms"
    if is_export(file):
        return "export"
    return {".ply": "ply", ".ini": "options"}.get(suffix) or ("database" if is_database(file) else None)


def _depth_map(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    transform_depth_map(source, target, similarity)
    return ("depths",)


WRITERS: dict[str, Callable[[Path, Path, Similarity], tuple[str, ...]]] = {
    "depth map": _depth_map,
    "ply": transform_ply,
    "obj": transform_obj,
    "options": transform_options,
    "transforms": transform_transforms,
    "export": transform_export,
}
