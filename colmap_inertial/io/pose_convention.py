"""Conventions of poses in tables: direction of quaternions, place of w, and meaning of the position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.geometry import quat_conjugate, quat_rotate
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.messages.findings import describe_convention


@dataclass(frozen=True, kw_only=True)
class PoseConvention:
    """Convention of a table of poses.

    Attributes
    ----------
    rotation
        What the quaternions turn into what.
    order
        Of their four numbers.
    position
        The camera's centre in the world, or the translation t of camera_from_world: x_cam = R x_world + t.
    """

    rotation: Literal["camera_from_world", "world_from_camera"] = "camera_from_world"
    order: Literal["xyzw", "wxyz"] = "xyzw"
    position: Literal["centre", "translation"] = "centre"

    def __str__(self) -> str:
        return describe_convention(self.rotation, self.order, self.position)

    def others(self) -> tuple[PoseConvention, ...]:
        """The other seven."""
        every = (
            PoseConvention(rotation=rotation, order=order, position=position)
            for rotation in ROTATIONS
            for order in ORDERS
            for position in POSITIONS
        )
        return tuple(convention for convention in every if convention != self)


ROTATIONS: tuple[Literal["camera_from_world", "world_from_camera"], ...] = ("camera_from_world", "world_from_camera")
ORDERS: tuple[Literal["xyzw", "wxyz"], ...] = ("xyzw", "wxyz")
POSITIONS: tuple[Literal["centre", "translation"], ...] = ("centre", "translation")

#: ``CameraTrajectory`` and what is read.
ARRAYS = PoseConvention()
TUM = PoseConvention(rotation="world_from_camera")
INERTIAL_SCALE = PoseConvention(order="wxyz")
COLMAP = PoseConvention(order="wxyz", position="translation")


def reread(trajectory: CameraTrajectory, read_as: PoseConvention, written_as: PoseConvention) -> CameraTrajectory:
    """The trajectory of a table that was read by one convention and written by another; without covariance."""
    xyzw = trajectory.cam_from_world_xyzw
    columns = trajectory.cam_in_world
    if read_as.position == "translation":
        columns = -quat_rotate(xyzw, columns)
    if read_as.rotation == "world_from_camera":
        xyzw = quat_conjugate(xyzw)
    if read_as.order != written_as.order:
        xyzw = np.roll(xyzw, -1 if written_as.order == "wxyz" else 1, axis=1)
    if written_as.rotation == "world_from_camera":
        xyzw = quat_conjugate(xyzw)
    if written_as.position == "translation":
        columns = -quat_rotate(quat_conjugate(xyzw), columns)
    return replace(trajectory, cam_from_world_xyzw=xyzw, cam_in_world=columns, pose_cov=None)
