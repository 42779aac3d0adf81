"""Models that lie far from the origin, on their way through the model stages: about a point in their middle.

What the stages find of a model at UTM coordinates is then what they find of the same one at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import CameraTrajectory, Similarity, SmoothedTrajectory
from colmap_inertial.model import transform_model
from colmap_inertial.model.places import between, find_pivot, translation

if TYPE_CHECKING:
    import pycolmap

PathT = TypeVar("PathT", CameraTrajectory, SmoothedTrajectory)


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnPlace:
    """The point that a model's coordinates count from in the stages: (3,) ``pivot``, ``None`` for the origin."""

    pivot: Array | None = None

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> OwnPlace:
        """Of a model: the origin, unless it lies far from it."""
        centres = [model.image(number).projection_center() for number in model.reg_image_ids()]
        points = [point.xyz for point in model.points3D.values()]
        return cls(pivot=find_pivot(np.array([*centres, *points]).reshape(-1, 3)))

    def enter(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """A model about its pivot."""
        return model if self.pivot is None else transform_model(model, translation(-self.pivot))

    def leave(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """The model where it was."""
        return model if self.pivot is None else transform_model(model, translation(self.pivot))

    def leave_path(self, trajectory: PathT) -> PathT:
        """A path where the model was."""
        if self.pivot is None:
            return trajectory
        return replace(trajectory, cam_in_world=trajectory.cam_in_world + self.pivot)

    def similarity(self, found: Similarity, source: OwnPlace | None = None) -> Similarity:
        """What was found about pivots, of coordinates from the origin; ``source``: of the model before, if another."""
        before = (source or self).pivot
        if before is None and self.pivot is None:
            return found
        origin = np.zeros(3)
        return between(found, origin if before is None else before, origin if self.pivot is None else self.pivot)
