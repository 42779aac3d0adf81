"""A posed pinhole camera, and where points and planes lie in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array

#: Rows of an image that are worked on at once: what is made of them stays in the cache, and little memory is held.
ROWS_AT_ONCE = 64


@dataclass(frozen=True, eq=False, kw_only=True)
class Pinhole:
    """A pinhole camera with its pose.

    Attributes
    ----------
    width, height
        Of its image.
    focal_px, centre_px
        (2,) along x and y; pixel centres are whole numbers, as in OpenCV.
    cam_from_world
        (3, 3) rotation.
    cam_in_world
        (3,) centre of projection, in the model's unit.
    """

    width: int
    height: int
    focal_px: Array
    centre_px: Array
    cam_from_world: Array
    cam_in_world: Array

    @property
    def matrix(self) -> Array:
        """(3, 3) pixels from the camera's frame."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def seen_from(self, other: Pinhole) -> tuple[Array, Array]:
        """Positions of the points of another camera's depth map in this one.

        Returns
        -------
        (3, 3) A and (3,) b: pixel (x, y) of depth z of the other one lies at ``A (x, y, 1) z + b``, which is
        ``(u w, v w, w)`` for pixel (u, v) of depth w in this one.
        """
        turn = self.cam_from_world @ other.cam_from_world.T
        shift = self.cam_from_world @ (other.cam_in_world - self.cam_in_world)
        return self.matrix @ turn @ np.linalg.inv(other.matrix), self.matrix @ shift
