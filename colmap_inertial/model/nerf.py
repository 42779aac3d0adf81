"""``transforms.json`` of NeRF trainers, and the ``export.json`` beside it, under a similarity."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import DETAILS, Fact, read_facts, with_sentences
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import DOWN_IN_WORLD, Similarity
from colmap_inertial.io.files import read_json
from colmap_inertial.model.camera_files import are_cameras_of
from colmap_inertial.model.database import PlacedModel

_MATRICES = ("transform_matrix", "transform_matrix_start", "transform_matrix_end")
#: Depths between which a camera sees, as some programs have them.
_RANGES = {"near", "far", "z_near", "z_far", "znear", "zfar", "near_plane", "far_plane"}
#: Fields without lengths: lenses, sizes of images, times, numbers of images, and what is done to the world.
_FREE_FIELD = re.compile(
    r"(?i)fl_?[xy]|f[xy]|c[xy]|[wh]|width|height|k\d*|p[12]|k[1-6]|camera_angle_[xy]|[xy]?_?fov(_?[xy])?|aabb_scale|"
    r"applied_(transform|scale)|.*(exposure|time|stamp|iso|sharpness|angular_velocity|readout|shutter|index|_id).*|id|"
    r"n_frames|distortion.*|is_fisheye|rolling_.*|colmap_im_id|camera_id|white_.*|colou?r.*|orientation_override|"
    r"integer_.*levels|fps|frame_rate|rotation|bit_depth|version|.*class.*"
)
#: What a step in images of depths means, and where frames name these: of instant-ngp and nerfstudio.
_DEPTH_UNITS = ("integer_depth_scale", "depth_unit_scale_factor")
_DEPTHS = ("depth_file_path", "depth_path")
#: What ``export.json`` says of itself, and of its unit: metres, or so many of them.
EXPORT_FORMAT = "colmap-inertial export"
_METRES = re.compile(r"(?:(\d\S*) )?m")
#: What it says where there is no scale, and no gravity, until a similarity brings them.
NOT_METRES = "unknown: not metres"
NO_SCALE, NEVER_SCALED, NO_UP = Fact("units-not-metres"), Fact("units-never-scaled"), Fact("up-unknown")
#: What it said before a similarity made it metres, and in that the provenance of this one.
_BEFORE, _BY = "before_apply", "provenance"
_NOTES_DETAILS = f"notes{DETAILS}"
_UNTIL_METRIC = ("unit", "up_in_world", "scale", "notes", _NOTES_DETAILS)
_DIRECTIONS = ("up_in_world", "gravity_in_world_m_s2")


def is_transforms(path: Path) -> bool:
    """Whether a file is named like NeRF trainers' cameras."""
    return path.suffix == ".json" and path.name.startswith("transforms")


def cameras_are_those_of(path: Path, placed: Sequence[PlacedModel]) -> bool:
    """Whether the file's cameras have the positions of those of one of the models, once ``applied_transform`` is
    undone.

    Some programs write cameras that they have turned, moved and scaled without saying how: a similarity of the model is
    none of theirs.
    """
    values = _frames(path)
    if values is None:
        return False
    back = np.linalg.inv(_read_applied_transform(path, values))
    written = [
        (str(frame.get("file_path", "")), (back @ _matrix(path, frame["transform_matrix"]))[:3, 3])
        for frame in values["frames"]
    ]
    return any(are_cameras_of(model, written) for model in placed)


def read_applied_transform(path: Path) -> Array | None:
    """(4, 4) what was done to the model's world in a ``transforms.json``; ``None`` for any other file."""
    values = _frames(path)
    return None if values is None else _read_applied_transform(path, values)


def depth_pictures(path: Path) -> tuple[set[str], bool]:
    """Pictures of depths that a ``transforms.json`` names, as paths relative to it, and whether it has their unit."""
    values = _frames(path)
    if values is None:
        return set(), False
    named = {str(frame[key]) for frame in values["frames"] for key in _DEPTHS if frame.get(key)}
    return named, any(_is_number(values.get(name)) for name in _DEPTH_UNITS)


def unmoved_fields(path: Path) -> tuple[str, ...]:
    """Fields of a ``transforms.json`` with numbers that are neither moved nor known to be free of lengths."""
    values = _frames(path)
    if values is None:
        return ()
    moved = {*_MATRICES, *_RANGES, *_DEPTH_UNITS, "frames", "camera_linear_velocity", "up"}
    moved |= {"scale", "offset"} if {"scale", "offset"} <= values.keys() else set()
    found = {name for fields in (values, *values["frames"]) for name, value in fields.items() if _has_numbers(value)}
    return tuple(sorted(name for name in found - moved if not _FREE_FIELD.fullmatch(name)))


def _has_numbers(value: object) -> bool:
    if isinstance(value, Mapping):
        return any(map(_has_numbers, value.values()))
    return any(map(_has_numbers, value)) if isinstance(value, list) else _is_number(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def transform_transforms(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy with its cameras moved, and what goes along: velocities, up, instant-ngp's box.

    ``applied_transform`` stays: the similarity acts on the world before it.

    Raises
    ------
    FormatError
        For matrices that are none.
    """
    values = _frames(source)
    if values is None:
        return ()
    applied, moving = _read_applied_transform(source, values), np.eye(4)
    moving[:3, :3] = similarity.scale * matrix_from_quat(similarity.rotation_xyzw)
    moving[:3, 3] = similarity.translation_m
    moving = applied @ moving @ np.linalg.inv(applied)
    rotation = moving[:3, :3] / similarity.scale
    changed = ["cameras"]
    for fields in (values, *values["frames"]):
        for name in _RANGES & fields.keys():
            if _is_number(fields[name]):
                fields[name] *= similarity.scale
                changed.append("depth ranges")
    for name in _DEPTH_UNITS:
        if _is_number(values.get(name)):
            values[name] *= similarity.scale
            changed.append("unit of depths")
    for frame in values["frames"]:
        for name in _MATRICES:
            if name in frame:
                pose = _matrix(source, frame[name])
                pose[:3, 3] = moving[:3, :3] @ pose[:3, 3] + moving[:3, 3]
                pose[:3, :3] = rotation @ pose[:3, :3]
                frame[name] = pose.tolist()
        if "camera_linear_velocity" in frame:
            velocity = similarity.scale * _vector(source, frame["camera_linear_velocity"])
            frame["camera_linear_velocity"] = velocity.tolist()
            changed.append("velocities")
    if "up" in values:
        values["up"] = (rotation @ _vector(source, values["up"])).tolist()
        changed.append("up")
    if "scale" in values and "offset" in values:
        scale = values["scale"]
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < np.inf:
            raise FormatError(source, Fact("scale-not-above-zero"))
        offset = _vector(source, values["offset"])
        middle = moving[:3, :3] @ ((0.5 - offset) / scale) + moving[:3, 3]
        values["scale"] = scale / similarity.scale
        values["offset"] = (0.5 - values["scale"] * middle).tolist()
        changed.append("box")
    target.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    return tuple(dict.fromkeys(changed))


def is_export(file: Path) -> bool:
    """Whether a file is what an export of ours says of itself."""
    if file.name != "export.json":
        return False
    try:
        return bool(read_json(file).get("format") == EXPORT_FORMAT)
    except FormatError:
        return False


def transform_export(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy whose unit and directions are those of the moved model.

    Where the unit was unknown, the similarity is what makes it metres: the copy says so, and keeps what it said before
    for when that very one is undone. Undoing another one makes nothing metres.

    Raises
    ------
    FormatError
        For a unit or directions that are none.
    """
    values = read_json(source)
    changed = []
    for name in _DIRECTIONS:
        if values.get(name) is not None:
            before = _vector(source, values[name])
            after = matrix_from_quat(similarity.rotation_xyzw) @ before
            if not np.allclose(after, before, rtol=0, atol=1e-12):
                values[name] = after.tolist()
                changed.append("directions")
    metres = _METRES.fullmatch(str(values.get("unit")))
    before_apply = values.get(_BEFORE)
    if isinstance(before_apply, dict) and similarity.undoes == before_apply.get(_BY, ""):
        for name in (_BEFORE, _NOTES_DETAILS):
            values.pop(name, None)
        values |= {name: value for name, value in before_apply.items() if name != _BY}
        changed.append("unit")
    elif values.get("unit") == NOT_METRES and similarity.undoes is None:
        in_metres = _describe_metres(values, similarity)
        values.pop(_NOTES_DETAILS, None)
        values |= in_metres
        changed.append("unit")
    elif metres is not None and similarity.scale != 1:
        try:
            length = float(metres[1] or 1) / similarity.scale
        except ValueError:
            raise FormatError(source, Fact("unit-no-length", unit=values["unit"])) from None
        values["unit"] = "m" if abs(length - 1) < 1e-9 else f"{length:.12g} m"
        changed.append("unit")
    target.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    return tuple(dict.fromkeys(changed))


def _describe_metres(values: Mapping[str, Any], similarity: Similarity) -> dict[str, Any]:
    """Unit of an export that a similarity made metric, in words."""
    up = values.get("up_in_world")
    up = _up(similarity) if up is None else up
    sigma = math.sqrt(similarity.cov[0, 0])
    factor = math.exp(Z95 * sigma)
    outdated = {NO_SCALE.code, NEVER_SCALED.code, *(() if up is None else (NO_UP.code,))}
    notes = [note for note in read_facts(values, "notes") if note.code not in outdated]
    return {
        "unit": "m",
        "up_in_world": up,
        "scale": {
            "verdict": None,
            "reasons": [similarity.provenance],
            "metres_per_unit": similarity.scale,
            "relative_ci95": [1 / factor, factor] if sigma > 0 else None,
        },
        **with_sentences({"notes": notes}),
        _BEFORE: {
            _BY: similarity.provenance,
            **{name: values[name] for name in _UNTIL_METRIC if name in values},
        },
    }


def _up(similarity: Similarity) -> list[float] | None:
    """Up after a similarity that turned gravity onto an axis: the one about which its turn is certain."""
    variance = np.diag(similarity.cov)[1:4]
    for down in DOWN_IN_WORLD.values():
        certain = np.abs(down) > 0
        if variance[certain].max() <= 1e-9 * variance.max() and variance[~certain].min() > 0:
            return [float(x) for x in -down]
    return None


def _frames(path: Path) -> dict[str, Any] | None:
    """The content, where it is one of cameras."""
    try:
        values = read_json(path)
    except FormatError:  # whatever else has this name
        return None
    frames = values.get("frames")
    cameras = isinstance(frames, list) and frames and all(isinstance(f, dict) and _MATRICES[0] in f for f in frames)
    return values if cameras else None


def _read_applied_transform(path: Path, values: Mapping[str, Any]) -> Array:
    """(4, 4) what was done to the model's world before the cameras were written: nerfstudio scales last."""
    given = values.get("applied_transform")
    scale: Any = values.get("applied_scale")
    applied = np.eye(4) if given is None else _matrix(path, given)
    if _is_number(scale) and 0 < scale < math.inf:
        applied[:3] *= scale
    return applied


def _matrix(path: Path, value: object) -> Array:
    """(4, 4) of 3 or 4 rows."""
    matrix = _array(value)
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
    if matrix.shape != (4, 4) or not abs(np.linalg.det(matrix)) > 0:  # not where one of them is nan
        raise FormatError(path, Fact("not-a-transform"))
    return matrix


def _vector(path: Path, value: object) -> Array:
    vector = _array(value)
    if vector.shape != (3,):
        raise FormatError(path, Fact("not-a-vector"))
    return vector


def _array(value: object) -> Array:
    """The numbers of a value; none where it is no array of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
