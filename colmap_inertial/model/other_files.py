"""Files of stereo programs, rigs and trainers under a similarity.

Cameras of MVSNet (``cams/*_cam.txt``), COLMAP's rig configuration (``rig_config.json``), and nerfstudio's
``dataparser_transforms.json``, which leads from the model's world to that of a training.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import read_bytes, read_json_value
from colmap_inertial.model.database import PlacedModel

#: A rig's cameras are as far apart as the model's within this share.
_SAME_BASELINE = 0.1
#: Cameras of a training fill a cube of side 2, or lie around its middle, within this share: single precision does.
_SAME_BOX = 1e-3
#: nerfstudio's points of a model that says of no transform: its axes are exchanged so.
_EXCHANGED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
_LARGEST = 1 << 16
_TRANSLATIONS = ("cam_from_rig_translation", "rel_tvec")


# MVSNet: "extrinsic" and 4 x 4 camera_from_world, "intrinsic" and 3 x 3, then the smallest depth and the step, and
# perhaps the number of depths and the largest.


@dataclass(frozen=True, eq=False)
class _MvsnetCamera:
    """A camera file: its lines, which of them hold the pose and the depths, and (4, 4) camera_from_world."""

    lines: list[str]
    pose: list[int]
    depths: int | None
    cam_from_world: Array


def mvsnet_cameras(path: Path) -> list[tuple[str, Array]]:
    """The centre of the one camera of an MVSNet file, without a name; empty for any other file."""
    camera = _read_mvsnet_camera(path)
    if camera is None:
        return []
    rotation, translation = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    return [("", -rotation.T @ translation)]


def _read_mvsnet_camera(path: Path) -> _MvsnetCamera | None:
    data = read_bytes(path, _LARGEST)
    if not re.match(rb"\s*extrinsic\b", data) or len(data) >= _LARGEST:
        return None
    lines = data.decode("utf-8", "surrogateescape").splitlines(keepends=True)
    filled = [i for i, line in enumerate(lines) if line.strip()]
    rows = [_numbers(lines[i]) for i in filled]
    if len(rows) not in (9, 10) or lines[filled[5]].strip() != "intrinsic":
        return None
    if any(len(row) != 4 for row in rows[1:5]) or any(len(row) != 3 for row in rows[6:9]):
        return None
    pose = np.array(rows[1:5])
    if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3) or pose[3].tolist() != [0, 0, 0, 1]:
        return None
    if len(rows) == 10 and len(rows[9]) not in (2, 4):
        return None
    return _MvsnetCamera(lines, filled[1:4], filled[9] if len(rows) == 10 else None, pose)


def _numbers(line: str) -> list[float]:
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        return []


def transform_mvsnet_camera(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of an MVSNet camera with its pose moved, and its depths times the scale."""
    camera = _read_mvsnet_camera(source)
    assert camera is not None
    lines, pose = camera.lines, camera.cam_from_world
    rotation = pose[:3, :3] @ matrix_from_quat(similarity.rotation_xyzw).T
    translation = similarity.scale * pose[:3, 3] - rotation @ similarity.translation_m
    for i, row in zip(camera.pose, np.column_stack([rotation, translation]).tolist(), strict=True):
        lines[i] = _with_words(lines[i], [repr(value) for value in row])
    changed = ["camera"]
    if camera.depths is not None:
        words = lines[camera.depths].split()
        # the third counts depths
        words = [word if k == 2 else repr(similarity.scale * float(word)) for k, word in enumerate(words)]
        lines[camera.depths] = _with_words(lines[camera.depths], words)
        changed.append("depth ranges")
    target.write_bytes("".join(lines).encode("utf-8", "surrogateescape"))
    return tuple(changed)


def _with_words(line: str, words: Sequence[str]) -> str:
    """A line with other words, its white space kept."""
    new = iter(words)
    return re.sub(r"\S+", lambda _: next(new), line)


# COLMAP's rig configuration: a list of rigs, whose cameras have a prefix of image names and cam_from_rig


def is_rig_configuration(path: Path) -> bool:
    """Whether a file describes rigs whose cameras stand apart."""
    return any(np.any(place) for place in _rig_places(path))


def is_rig_in_one_place(path: Path) -> bool:
    """Whether a file describes rigs whose cameras all stand in one place, as those of a panorama."""
    places = _rig_places(path)
    return bool(places) and not any(np.any(place) for place in places)


def _rig_places(path: Path) -> list[Array]:
    """``cam_from_rig`` of all cameras of a rig configuration; empty for any other file."""
    if path.suffix != ".json":
        return []
    head = read_bytes(path, _LARGEST)
    if b'"cameras"' not in head or not any(name.encode() in head for name in _TRANSLATIONS):
        return []
    return [place for _, places in _rigs(path) for place in places.values()]


def _rigs(path: Path) -> Iterator[tuple[str, dict[str, Array]]]:
    """Of each rig, the prefix of its reference's images, and by that of each other camera, (3,) ``cam_from_rig``."""
    try:
        rigs = read_json_value(path)
    except FormatError:
        return
    for rig in rigs if isinstance(rigs, list) else []:
        cameras = rig.get("cameras") if isinstance(rig, dict) else None
        if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
            continue
        number = rig.get("ref_camera_id")
        first = next((c for c in cameras if c.get("ref_sensor") is True), None)
        first = first or next((c for c in cameras if number is not None and c.get("camera_id") == number), None)
        places = {str(c.get("image_prefix", "")): p for c in cameras if (p := _place(c)) is not None and c is not first}
        yield str((first or {}).get("image_prefix", "")), places


def _place(camera: Mapping[str, Any]) -> Array | None:
    for name in _TRANSLATIONS:
        try:
            place = np.array(camera.get(name), dtype=np.float64)
        except (TypeError, ValueError):
            continue
        if place.shape == (3,) and np.isfinite(place).all():
            return place
    return None


def rig_ratio(path: Path, model: PlacedModel) -> float | None:
    """How many times as far apart as a model's the cameras of a rig configuration are; ``None`` without such images."""
    ratios = []
    for reference, places in _rigs(path):
        for prefix, place in places.items():
            apart = [
                float(np.linalg.norm(centre - model.centres[other]))
                for name, centre in model.centres.items()
                if name.startswith(prefix) and (other := reference + name[len(prefix) :]) in model.centres
            ]
            if apart and np.any(place) and np.median(apart) > 0:
                ratios.append(float(np.linalg.norm(place)) / float(np.median(apart)))
    return float(np.median(ratios)) if ratios else None


def is_rig_of(path: Path, model: PlacedModel) -> bool:
    """Whether the cameras of a rig configuration are as far apart as a model has them."""
    ratio = rig_ratio(path, model)
    return ratio is not None and abs(np.log(ratio)) < _SAME_BASELINE


def transform_rig_configuration(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of a rig configuration with its translations times the scale."""
    rigs = read_json_value(source)
    for rig in rigs:
        for camera in rig["cameras"]:
            for name in _TRANSLATIONS:
                if name in camera and (place := _place({name: camera[name]})) is not None:
                    camera[name] = (similarity.scale * place).tolist()
    target.write_text(json.dumps(rigs, indent=2) + "\n", encoding="utf-8")
    return ("rigs",)


# nerfstudio: x_training = scale * (transform @ x), of the world before applied_transform


def is_dataparser(path: Path) -> bool:
    """Whether a file leads from a model's world to that of a training."""
    return path.name == "dataparser_transforms.json" and read_training_world(path) is not None


def read_training_world(path: Path) -> Array | None:
    """(4, 4) training_from_world; ``None`` where the file holds none."""
    try:
        values = read_json_value(path)
        matrix, scale = np.array(values["transform"], dtype=np.float64), float(values["scale"])
    except (FormatError, TypeError, ValueError, KeyError):
        return None
    if matrix.shape not in ((3, 4), (4, 4)) or not scale > 0 or not np.isfinite(matrix).all():
        return None
    if not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-3):
        return None
    world = np.eye(4)
    world[:3] = scale * matrix[:3]
    return world


def find_parsed_world(path: Path, model: PlacedModel, worlds: Sequence[Array]) -> Array | None:
    """Which of some worlds, (4, 4) from the model's each, a training was made from; ``None`` where none fits.

    nerfstudio has the cameras fill a cube of side 2, or lie around its middle, or both.
    """
    training = read_training_world(path)
    if training is None or len(model.centres) < 2:
        return None
    centres = np.array(list(model.centres.values()))
    for world in [*worlds, _EXCHANGED]:
        by = training @ world
        seen = centres @ by[:3, :3].T + by[:3, 3]
        size = float(np.abs(seen - seen.mean(axis=0)).max())
        fills = abs(float(np.abs(seen).max()) - 1) < _SAME_BOX
        if size > 0 and (fills or float(np.abs(seen.mean(axis=0)).max()) < _SAME_BOX * size):
            return world
    return None


def transform_dataparser(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy that leads from the moved world to the same training."""
    values = read_json_value(source)
    rows = np.array(values["transform"], dtype=np.float64)
    turn = rows[:3, :3] @ matrix_from_quat(similarity.rotation_xyzw).T
    rows[:3, 3] = similarity.scale * rows[:3, 3] - turn @ similarity.translation_m
    rows[:3, :3] = turn
    values |= {"transform": rows.tolist(), "scale": float(values["scale"]) / similarity.scale}
    target.write_text(json.dumps(values, indent=4) + "\n", encoding="utf-8")
    return ("training's world",)
