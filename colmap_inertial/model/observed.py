"""What an image of a model sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Int64Array

if TYPE_CHECKING:
    import pycolmap


def points_of_features(image: pycolmap.Image) -> Int64Array:
    """Of an image's features, the numbers of their points; -1 without one."""
    points = np.full(image.num_points2D(), -1, dtype=np.int64)
    seen = np.array(image.get_observation_point2D_idxs(), dtype=np.intp)
    points[seen] = [point.point3D_id for point in image.get_observation_points2D()]
    return points
