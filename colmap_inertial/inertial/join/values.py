"""What is joined: parts, what ties them together, and where they come to lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial.scale.posterior import FittedPath


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

    def among(self, place_of: Mapping[int, int]) -> Self:
        """The same between parts that have other places."""
        return replace(self, first=place_of[self.first], second=place_of[self.second])


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
    in_first: Int64Array
    in_second: Int64Array
    weight: float

    def among(self, place_of: Mapping[int, int]) -> Self:
        """The same between parts that have other places."""
        return replace(self, first=place_of[self.first], second=place_of[self.second])

    def poses(self, parts: Sequence[Part], k: int) -> tuple[Array, Array]:
        """(n, 3, 3) world_from_cam and (n, 3) centres of the images in one of the two parts, in its own world."""
        part, places = parts[k], self.in_first if k == self.first else self.in_second
        return part.world_from_cam[places], part.trajectory.cam_in_world[places]


@dataclass(frozen=True, eq=False, kw_only=True)
class MatchedImages(SharedImages):
    """Images of one part that matches place in the other one.

    Of the other part, ``in_first`` or ``in_second`` are its images that each of them matches best.

    Attributes
    ----------
    other
        Place of the part in which they were found.
    world_from_cam, cam_in_world
        (n, 3, 3), (n, 3) their poses there.
    """

    other: int
    world_from_cam: Array
    cam_in_world: Array

    def among(self, place_of: Mapping[int, int]) -> Self:
        """As :meth:`SharedImages.among`."""
        return replace(super().among(place_of), other=place_of[self.other])

    def poses(self, parts: Sequence[Part], k: int) -> tuple[Array, Array]:
        """As :meth:`SharedImages.poses`."""
        return (self.world_from_cam, self.cam_in_world) if k == self.other else super().poses(parts, k)


@dataclass(frozen=True, eq=False, kw_only=True)
class Found:
    """Images of one model that matches place in another one, as that one lies.

    Attributes
    ----------
    first, second
        COLMAP's number of the model in which they were found, and of their own.
    names
        Of the images.
    beside
        The other model's images that each of them matches best.
    world_from_cam, cam_in_world
        (n, 3, 3), (n, 3) poses in the other model.
    matches
        (m, 2) pairs of points that these matches say are one, by their numbers in the two models.
    """

    first: int
    second: int
    names: tuple[str, ...]
    beside: tuple[str, ...]
    world_from_cam: Array
    cam_in_world: Array
    matches: Int64Array


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
