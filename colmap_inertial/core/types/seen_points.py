"""Points of a model as one image shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, check_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenPoints:
    """Points of a model at their keypoints in one image.

    Attributes
    ----------
    name
        Of the image.
    t_s
        When it was exposed, or its place in the order of images where nobody knows.
    width, height
        Of the image, pixels.
    xy_px
        (K, 2) keypoints; the top-left pixel's centre is (0.5, 0.5).
    depth
        (K,) along the optical axis, in units of the model.
    sigma_log
        (K,) standard deviation of its logarithm, by the angles under which images see the point.
    """

    name: str
    t_s: float
    width: int
    height: int
    xy_px: Array
    depth: Array
    sigma_log: Array

    def __post_init__(self) -> None:
        check_fields(self, xy_px=("K", 2), depth=("K",), sigma_log=("K",))
        if len(self.depth) and not (np.min(self.depth) > 0 and np.min(self.sigma_log) > 0):
            raise ValueError("points lie before the camera, and none is known exactly")
