"""In which world each file of a workspace is: the model's own, or that of a ``transforms.json`` beside it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.ply import sample_vertices
from colmap_inertial.model.camera_files import CAMERAS_OF, are_cameras_of
from colmap_inertial.model.database import PlacedModel
from colmap_inertial.model.nerf import (
    cameras_are_those_of,
    depth_pictures,
    is_transforms,
    read_applied_transform,
    unmoved_fields,
)
from colmap_inertial.model.other_files import (
    find_parsed_world,
    is_dataparser,
    is_rig_of,
    read_training_world,
    rig_ratio,
)
from colmap_inertial.model.places import express_in_world, find_world, is_elsewhere

#: What the user is told of a file whose cameras are those of no model here, by its kind.
_TOLD = {
    **dict.fromkeys(("transforms", "splat cameras", "poses and bounds"), "cameras-elsewhere-in-file"),
    "dataparser": "training-of-another-model",
}


class Worlds:
    """Worlds of a project's files.

    Parameters
    ----------
    project
        The project.
    placed
        Its models.
    files
        Its files that are not kept as they are, relative to it.
    note
        Is told what the user should know.
    """

    def __init__(
        self, project: Path, placed: Sequence[PlacedModel], files: Sequence[Path], note: Callable[[Fact], object]
    ) -> None:
        self._project, self._placed, self._note = project, placed, note
        self._own: dict[Path, Array] = {}
        self._trainings: dict[Path, Array] = {}
        self._of_models: dict[Path, list[int]] = {}
        depths, counted = set[Path](), set[Path]()
        for path in files:
            if not is_transforms(path):
                continue
            applied = read_applied_transform(project / path)
            if applied is None:
                continue
            owners = [model.index for model in placed if cameras_are_those_of(project / path, [model])]
            names, has_unit = depth_pictures(project / path)
            pictures = {Path(os.path.normpath(path.parent / name)) for name in names}
            depths |= pictures
            if has_unit and owners:
                counted |= pictures
            self._of_models[path] = owners
            if owners and (fields := unmoved_fields(project / path)):
                self._note(Fact("fields-unmoved", path=str(path), fields=fields))
            if owners and not np.allclose(applied, np.eye(4)):
                self._own[path] = applied
        for path in files:
            if is_dataparser(project / path):
                self._find_training(path)
        #: Images of depths that are named as such, and those whose unit is in the file that names them.
        self.depths, self.counted = frozenset(depths), frozenset(counted)

    def _find_training(self, path: Path) -> None:
        """The world that a training was made from, and its own."""
        worlds = [np.eye(4), *self._own.values()]
        training = read_training_world(self._project / path)
        found = {
            m.index: w for m in self._placed if (w := find_parsed_world(self._project / path, m, worlds)) is not None
        }
        self._of_models[path] = list(found)
        if found and training is not None:
            world = next(iter(found.values()))
            self._own[path], self._trainings[path] = world, training @ world

    def owners_of(self, path: Path, kind: str) -> list[int]:
        """Models whose cameras a file has; the user is told where it has those of none here."""
        if kind in ("transforms", "dataparser"):
            if path not in self._of_models:  # no file of cameras, whatever its name
                return []
            owners = self._of_models[path]
        elif kind == "rig configuration":
            owners = [model.index for model in self._placed if is_rig_of(self._project / path, model)]
        else:
            written = CAMERAS_OF[kind](self._project / path)
            owners = [model.index for model in self._placed if are_cameras_of(model, written)]
        if not owners and kind == "rig configuration":
            ratios = [rig_ratio(self._project / path, model) for model in self._placed]
            self._note(Fact("rig-elsewhere", path=str(path), ratio=next((r for r in ratios if r is not None), None)))
        if not owners and kind in _TOLD:
            self._note(Fact(_TOLD[kind], path=str(path)))
        return owners

    def similarity_of(self, path: Path, kind: str, model: int | None, similarity: Similarity) -> Similarity | None:
        """The similarity of a file, in the world that its points are in; ``None`` where that stays, as a training's."""
        if kind == "dataparser":
            return express_in_world(similarity, self._own[path])
        if kind != "ply":
            return similarity
        own_worlds = {name: world for name, world in self._own.items() if name not in self._trainings}
        near = {name: world for name, world in own_worlds.items() if path.is_relative_to(name.parent)}
        near |= own_worlds | self._trainings
        placed = [m for m in self._placed if model is None or m.index == model]
        own = np.concatenate([m.points for m in placed]) if placed else np.empty((0, 3))
        try:
            points = sample_vertices(self._project / path)
        except FormatError:
            return similarity  # the writer says why
        best, distance = find_world(points, own, [np.eye(4), *near.values()])
        if is_elsewhere(distance):
            self._note(Fact("other-frame", path=str(path), share_pct=100 * distance))
        if best == 0:
            return similarity
        by, world = list(near.items())[best - 1]
        if by in self._trainings:
            self._note(Fact("frame-of-training", path=str(path), by=str(by)))
            return None
        moved = express_in_world(similarity, world)
        if moved is None:
            return similarity
        self._note(Fact("frame-of-transforms", path=str(path), by=str(by)))
        return moved
