"""``transforms.json``: cameras as NeRF trainers read them, in OpenGL axes (x right, y up, z back)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, so3_exp
from colmap_inertial.core.types import CameraModel

#: From COLMAP's camera axes to OpenGL's, and back.
OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class NormalisationLimits:
    """The box that trainers' scenes are brought into."""

    #: Side of the box around 0.5 that the scene is scaled to for instant-ngp, a power of two.
    box: int = 4
    #: It holds the cameras and this share of the points, with so much room around.
    points_share: float = 0.98
    room: float = 1.05


_LIMITS = NormalisationLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """One image of the export.

    Attributes
    ----------
    name
        Of its file in ``images/``.
    camera
        ``PINHOLE``, the principal point in the middle.
    cam_from_world_xyzw
        (4,) rotation.
    cam_in_world
        (3,) centre.
    """

    name: str
    camera: CameraModel
    cam_from_world_xyzw: Array
    cam_in_world: Array

    def matrix(self) -> Array:
        """(4, 4) world from camera, OpenGL camera axes."""
        matrix = np.eye(4)
        matrix[:3, :3] = matrix_from_quat(quat_conjugate(self.cam_from_world_xyzw)) @ OPENGL_FROM_CAM
        matrix[:3, 3] = self.cam_in_world
        return matrix


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposure:
    """Motion of a camera during the exposure of an image of the export.

    Attributes
    ----------
    velocity_in_cam_m_s, angular_velocity_in_cam_rad_s
        (3,) at the middle of the exposure, COLMAP's camera axes (x right, y down, z forward).
    exposure_s
        0 where the blur was undone.
    readout_s
        From the first row of the exported image to one past its last; 0 where the rolling shutter was undone.
    late_s
        By how much the exported image's middle row is later than the instant of the pose.
    """

    velocity_in_cam_m_s: Array
    angular_velocity_in_cam_rad_s: Array
    exposure_s: float
    readout_s: float
    late_s: float = 0.0

    @property
    def span_s(self) -> float:
        """Time from the begin of the first row's exposure to the end of the last one's."""
        return self.exposure_s + self.readout_s


def transforms(views: Sequence[View], xyz: Array, up_in_world: Array) -> dict[str, Any]:
    """The content of ``transforms.json``, but for exposures.

    Parameters
    ----------
    views
        In the order of their names.
    xyz
        (N, 3) sparse points; in ``sparse_pc.ply``.
    up_in_world
        (3,) unit vector.
    """
    shared = len({_key(view.camera) for view in views}) == 1
    box = _box(np.array([view.cam_in_world for view in views]), xyz)
    return {
        # what pinhole cameras are without distortion; one trainer refuses the other name
        "camera_model": "OPENCV",
        **(_intrinsics(views[0].camera) if shared else {}),
        "ply_file_path": "sparse_pc.ply",
        # the world is the model's: nothing was turned
        "applied_transform": np.eye(4)[:3].tolist(),
        "orientation_override": "none",
        "auto_scale_poses_override": False,
        **box,
        "up": up_in_world.tolist(),
        "frames": [
            {
                "file_path": f"images/{view.name}",
                **({} if shared else _intrinsics(view.camera)),
                "transform_matrix": view.matrix().tolist(),
            }
            for view in views
        ],
    }


def add_velocities(content: Mapping[str, Any], exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """The same for the deblurring fork of splatfacto: velocities in OpenGL camera axes, exposure and readout.

    It takes a pose for that of the image's middle row, so that each is brought to it.

    Frames without velocities are left out: it wants them of all or of none.
    """
    frames = []
    for frame in content["frames"]:
        moved = exposures.get(frame["file_path"].removeprefix("images/"))
        if moved is not None:
            frames.append(
                {
                    **frame,
                    "transform_matrix": _at(np.array(frame["transform_matrix"]), moved, moved.late_s).tolist(),
                    "camera_linear_velocity": (OPENGL_FROM_CAM @ moved.velocity_in_cam_m_s).tolist(),
                    "camera_angular_velocity": (OPENGL_FROM_CAM @ moved.angular_velocity_in_cam_rad_s).tolist(),
                }
            )
    times = [exposures[frame["file_path"].removeprefix("images/")] for frame in frames]
    return {
        **content,
        "exposure_time": float(np.median([time.exposure_s for time in times])),
        "rolling_shutter_time": float(np.median([time.readout_s for time in times])),
        "frames": frames,
    }


def add_row_poses(content: Mapping[str, Any], exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """The same for instant-ngp: a pose for the first row's begin and the last one's end, and what lies between them.

    A ray of row ``v`` (0 to 1) at the share ``b`` (0 to 1) of its exposure has the pose at ``A + B u + C v + D b``
    between the two, with ``rolling_shutter`` = [A, B, C, D].
    """
    frames = []
    for frame in content["frames"]:
        moved = exposures.get(frame["file_path"].removeprefix("images/"))
        if moved is None or moved.span_s == 0:
            frames.append(frame)
            continue
        matrix, span_s = np.array(frame["transform_matrix"]), moved.span_s
        begin_s = moved.late_s - 0.5 * span_s
        frames.append(
            {
                **frame,
                "transform_matrix_start": _at(matrix, moved, begin_s).tolist(),
                "transform_matrix_end": _at(matrix, moved, begin_s + span_s).tolist(),
                "rolling_shutter": [0.0, 0.0, moved.readout_s / span_s, moved.exposure_s / span_s],
            }
        )
    return {**content, "frames": frames}


def view_matrices(views: Sequence[View], exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """Poses at the begin and end of each image's readout, as gsplat's ``rasterization`` takes them.

    ``viewmats`` and ``viewmats_rs``: (4, 4) camera from world, x right, y down, z forward, of the first row and of one
    past the last. Of an image without a readout, or a velocity, both are the pose.
    """
    frames = []
    for view in views:
        moved = exposures.get(view.name)
        half_s = 0.0 if moved is None else 0.5 * moved.readout_s
        late_s = 0.0 if moved is None else moved.late_s
        both = []
        for shift_s in (late_s - half_s, late_s + half_s):
            pose = view.matrix() if moved is None else _at(view.matrix(), moved, shift_s)
            pose[:3, :3] = pose[:3, :3] @ OPENGL_FROM_CAM
            both.append(np.linalg.inv(pose).tolist())
        fx, fy, cx, cy = view.camera.params
        frames.append(
            {
                "file_path": f"images/{view.name}",
                "width": view.camera.width,
                "height": view.camera.height,
                "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "readout_s": 2 * half_s,
                "viewmats": both[0],
                "viewmats_rs": both[1],
            }
        )
    return {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM", "frames": frames}


def _at(matrix: Array, moved: Exposure, late_s: float) -> Array:
    """(4, 4) the pose so much later, to first order."""
    turned = np.array(matrix)
    turn = so3_exp(OPENGL_FROM_CAM @ moved.angular_velocity_in_cam_rad_s * late_s)
    turned[:3, 3] += matrix[:3, :3] @ (OPENGL_FROM_CAM @ moved.velocity_in_cam_m_s) * late_s
    turned[:3, :3] = matrix[:3, :3] @ turn
    return turned


def _key(camera: CameraModel) -> tuple[object, ...]:
    return camera.width, camera.height, camera.params


def _intrinsics(camera: CameraModel) -> dict[str, float]:
    fx, fy, cx, cy = camera.params
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "camera_angle_x": float(2 * np.arctan(0.5 * camera.width / fx)),
        "camera_angle_y": float(2 * np.arctan(0.5 * camera.height / fy)),
    }


def _box(cam_in_world: Array, xyz: Array) -> dict[str, object]:
    """instant-ngp's ``scale``, ``offset`` and ``aabb_scale``: ``p' = scale p + offset`` fills the box around 0.5."""
    low, high = cam_in_world.min(axis=0), cam_in_world.max(axis=0)
    if len(xyz):
        outside = 50 * (1 - _LIMITS.points_share) / 3  # each side of each axis leaves out its part
        low = np.minimum(low, np.percentile(xyz, outside, axis=0))
        high = np.maximum(high, np.percentile(xyz, 100 - outside, axis=0))
    middle, reach = 0.5 * (low + high), _LIMITS.room * float((high - low).max())
    scale = _LIMITS.box / reach if reach > 0 else 1.0
    return {"scale": scale, "offset": (0.5 - scale * middle).tolist(), "aabb_scale": _LIMITS.box}
