"""What is joined: parts, what ties them together, and where they come to lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.geometry import matrix_from_quat
from colmap_inertial.scale.posterior import FittedPath
from colmap_inertial.types import Array, CameraTrajectory

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """A sub-model that its own scale estimate made metric.

    Attributes
    ----------
    number
        COLMAP's.
    trajectory
        Its poses, in metres.
    path
        The same fitted to the IMU once more: what is known of its motion.
    cameras
        Names for its cameras, by which those of two parts are told apart; empty where they are not known.
    """

    number: int
    trajectory: CameraTrajectory
    path: FittedPath
    cameras: frozenset[str] = frozenset()

    @property
    def world_from_cam(self) -> Array:
        """(F, 3, 3) of its images."""
        return matrix_from_quat(self.trajectory.cam_from_world_xyzw).transpose(0, 2, 1)

    def nearest(self, t_s: float) -> int:
        """The image that was taken nearest to an instant."""
        return int(np.argmin(np.abs(self.trajectory.t_s - t_s)))


@dataclass(frozen=True, kw_only=True)
class Link:
    """What the IMU felt between a node of one part and the next node of another one.

    Attributes
    ----------
    first, second
        Places of the parts, the earlier one first.
    from_node, to_node
        Nodes of their paths.
    """

    first: int
    second: int
    from_node: int
    to_node: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedImages:
    """Images that two parts have both.

    Attributes
    ----------
    first, second
        Places of the parts.
    in_first, in_second
        (n,) which of their poses.
    weight
        How much one of them counts: errors of pictures a few hundredths of a second apart are alike.
    """

    first: int
    second: int
    in_first: Index
    in_second: Index
    weight: float


def pair_of(tie: Link | SharedImages) -> tuple[int, int]:
    """The places of the two parts, the larger part first."""
    return min(tie.first, tie.second), max(tie.first, tie.second)


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Where a part lies in the world of another: ``x = scale * rotation (x_part - origin) + translation_m``.

    Attributes
    ----------
    scale
        On the part's own metres.
    rotation
        (3, 3).
    translation_m, origin
        (3,) each.
    """

    scale: float
    rotation: Array
    translation_m: Array
    origin: Array

    def points(self, points: Array) -> Array:
        """(N, 3) points of the part, in the world."""
        return np.asarray(self.scale * (points - self.origin) @ self.rotation.T + self.translation_m)
