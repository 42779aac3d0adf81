"""Cameras and depths as trainers of splats and radiance fields keep them, under a similarity.

``cameras.json`` of 3D Gaussian Splatting, its ``depth_params.json``, ``poses_bounds.npy`` of LLFF.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import read_json_value
from colmap_inertial.model.database import PlacedModel
from colmap_inertial.model.other_files import mvsnet_cameras

#: Cameras of a file that are not named as the model's are the same within this share of the cameras' extent.
_SAME_PLACE = 1e-3


def pair_centres(model: PlacedModel, written: Sequence[tuple[str, Array]]) -> list[tuple[Array, Array]]:
    """Centres of a model's cameras, each with where a file has the camera of that name.

    Of names that differ in folders or endings alone, those go together that share most of their last folders; of
    several such, the nearest.
    """
    images: dict[str, list[str]] = {}
    for name in model.centres:
        images.setdefault(PurePosixPath(name).stem, []).append(name)
    pairs = []
    for path, centre in written:
        parts = PurePosixPath(path.replace("\\", "/")).parts
        last = parts[-1] if parts else ""
        stems = {last, last.rpartition(".")[0] or last}
        candidates = [name for stem in stems for name in images.get(stem, [])]
        if not candidates:
            continue
        shared = {name: _count_shared_folders(PurePosixPath(name).parts[:-1], parts[:-1]) for name in candidates}
        best = [name for name, count in shared.items() if count == max(shared.values())]
        nearest = min(best, key=lambda name: float(np.linalg.norm(model.centres[name] - centre)))
        pairs.append((model.centres[nearest], centre))
    return pairs


def _count_shared_folders(a: tuple[str, ...], b: tuple[str, ...]) -> int:
    """Number of last folders that two paths share."""
    count = 0
    for x, y in zip(reversed(a), reversed(b), strict=False):
        if x != y:
            break
        count += 1
    return count


def are_cameras_of(model: PlacedModel, written: Sequence[tuple[str, Array]]) -> bool:
    """Whether a file's cameras, by names and centres, are where those of a model are."""
    if not written or not model.centres:
        return False
    pairs = pair_centres(model, written)
    if 2 * len(pairs) >= min(len(model.centres), len(written)):
        return model.has_cameras_at(pairs)
    return _all_stand_there(model, np.array([centre for _, centre in written]))


def _all_stand_there(model: PlacedModel, centres: Array) -> bool:
    """Whether nearly all of a file's cameras, whatever their names, stand where one of the model does."""
    own = np.array(list(model.centres.values()))
    if not np.isfinite(centres).all() or model.extent() == 0:
        return False
    nearest = np.array([np.linalg.norm(own - centre, axis=1).min() for centre in centres])
    return bool(np.mean(nearest <= _SAME_PLACE * model.extent()) >= 0.9)


def splat_cameras(path: Path) -> list[tuple[str, Array]]:
    """Names and centres of a ``cameras.json`` of 3D Gaussian Splatting; empty for any other file."""
    try:
        values = read_json_value(path)
    except FormatError:
        return []
    if not isinstance(values, list) or not values:
        return []
    found = []
    for camera in values:
        if not isinstance(camera, dict) or not {"img_name", "position", "rotation"} <= camera.keys():
            return []
        centre, rotation = _array(camera["position"]), _array(camera["rotation"])
        if centre.shape != (3,) or rotation.shape != (3, 3):
            return []
        found.append((str(camera["img_name"]), centre))
    return found


def transform_splat_cameras(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of ``cameras.json`` with its cameras moved: positions, and rotations world_from_camera."""
    turn = matrix_from_quat(similarity.rotation_xyzw)
    cameras = read_json_value(source)
    for camera in cameras:
        place = similarity.scale * turn @ _array(camera["position"]) + similarity.translation_m
        camera["position"] = place.tolist()
        camera["rotation"] = (turn @ _array(camera["rotation"])).tolist()
    target.write_text(json.dumps(cameras) + "\n", encoding="utf-8")
    return ("cameras",)


def is_depth_params(path: Path) -> bool:
    """Whether a file has scale and offset of each image's inverse depth."""
    return path.name == "depth_params.json" and bool(_depth_params(path))


def _depth_params(path: Path) -> dict[str, dict[str, Any]]:
    try:
        values = read_json_value(path)
    except FormatError:
        return {}
    if not isinstance(values, dict):
        return {}
    for fields in values.values():
        numbers = isinstance(fields, dict) and [fields.get("scale"), fields.get("offset")]
        if not numbers or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
            return {}
    return values


def transform_depth_params(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy whose inverse depths, ``scale * image + offset``, are those of the moved model."""
    values = _depth_params(source)
    for fields in values.values():
        fields["scale"] /= similarity.scale
        fields["offset"] /= similarity.scale
        if isinstance(fields.get("med_scale"), int | float):
            fields["med_scale"] /= similarity.scale
    target.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    return ("inverse depths",)


def bounds_cameras(path: Path) -> list[tuple[str, Array]]:
    """Centres of the cameras of LLFF's ``poses_bounds.npy``, without names; empty for any other file."""
    rows = _bounds(path)
    return [] if rows is None else [("", row[[3, 8, 13]]) for row in rows]


def _bounds(path: Path) -> Array | None:
    """(N, 17) a pose of 3 x 5, near and far; ``None`` where the file holds anything else."""
    try:
        rows = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError):
        return None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        return None
    return np.asarray(rows, dtype=np.float64)


def transform_bounds(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of ``poses_bounds.npy`` with its cameras moved, and near and far times the scale."""
    kind = np.load(source, allow_pickle=False).dtype
    rows = _bounds(source)
    assert rows is not None
    turn = matrix_from_quat(similarity.rotation_xyzw)
    poses = rows[:, :15].reshape(-1, 3, 5).copy()
    poses[:, :, :3] = turn @ poses[:, :, :3]
    poses[:, :, 3] = similarity.scale * poses[:, :, 3] @ turn.T + similarity.translation_m
    moved = np.concatenate([poses.reshape(-1, 15), similarity.scale * rows[:, 15:]], axis=1)
    with open(target, "wb") as file:
        np.save(file, moved.astype(kind))
    return ("cameras", "depth ranges")


def _array(value: object) -> Array:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


#: By kind, what reads a file's cameras.
CAMERAS_OF: Mapping[str, Any] = {
    "splat cameras": splat_cameras,
    "poses and bounds": bounds_cameras,
    "MVSNet camera": mvsnet_cameras,
}
