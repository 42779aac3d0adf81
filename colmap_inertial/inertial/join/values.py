"""What is joined: fitted submodels, and the IMU between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial.scale.posterior import FittedPath


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedSubmodel:
    """A submodel that its own scale estimate made metric.

    Attributes
    ----------
    number
        COLMAP's.
    trajectory
        Its poses, in metres.
    path
        The same fitted to the IMU once more: what is known of its motion.
    cameras
        Names for its cameras, by which those of two submodels are told apart; empty where they are not known.
    """

    number: int
    trajectory: CameraTrajectory
    path: FittedPath
    cameras: frozenset[str] = frozenset()

    @property
    def world_from_cam(self) -> Array:
        """(F, 3, 3) of its images."""
        return matrix_from_quat(self.trajectory.cam_from_world_xyzw).transpose(0, 2, 1)


@dataclass(frozen=True, kw_only=True)
class ImuLink:
    """What the IMU felt between a node of one submodel and the next node of another one.

    Attributes
    ----------
    first, second
        Places of the submodels, the earlier one first.
    from_node, to_node
        Nodes of their paths.
    """

    first: int
    second: int
    from_node: int
    to_node: int

    @property
    def ends(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Submodel and node of both ends."""
        return (self.first, self.from_node), (self.second, self.to_node)

    def seconds(self, submodels: Sequence[FittedSubmodel]) -> float:
        """How long it lasts."""
        begin_s, end_s = (float(submodels[k].path.nodes_s[node]) for k, node in self.ends)
        return end_s - begin_s
