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
from colmap_inertial.model.nerf import cameras_are_those_of, depth_pictures, is_transforms, read_applied_transform
from colmap_inertial.model.places import express_in_world, find_world, is_elsewhere


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
        self._of_models: dict[Path, bool] = {}
        depths: set[Path] = set()
        for path in files:
            if not is_transforms(path):
                continue
            applied = read_applied_transform(project / path)
            if applied is None:
                continue
            for name in depth_pictures(project / path):
                depths.add(Path(os.path.normpath(path.parent / name)))
            self._of_models[path] = cameras_are_those_of(project / path, placed)
            if self._of_models[path] and not np.allclose(applied, np.eye(4)):
                self._own[path] = applied
        #: Pictures of depths that are named as such.
        self.depths = frozenset(depths)

    def is_of_a_model(self, path: Path, kind: str) -> bool:
        """Whether a file of cameras has those of a model here; the user is told where it has not."""
        if kind == "transforms":
            if path not in self._of_models:  # no file of cameras, whatever its name
                return False
            same = self._of_models[path]
        else:
            written = CAMERAS_OF[kind](self._project / path)
            same = any(are_cameras_of(model, written) for model in self._placed)
        if not same:
            self._note(Fact("cameras-elsewhere-in-file", path=str(path)))
        return same

    def similarity_of(self, path: Path, kind: str, model: int | None, similarity: Similarity) -> Similarity:
        """The similarity of a file: in the world that its points are in."""
        if kind != "ply":
            return similarity
        near = {name: world for name, world in self._own.items() if path.is_relative_to(name.parent)}
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
        moved = express_in_world(similarity, list(near.values())[best - 1])
        if moved is None:
            return similarity
        self._note(Fact("frame-of-transforms", path=str(path), by=str(list(near)[best - 1])))
        return moved
