"""Undo the rolling shutter: what a camera would see all at once at the frame's reference instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera

Pixel = TypeVar("Pixel", np.uint8, np.uint16)


@dataclass(frozen=True, kw_only=True)
class RectificationLimits:
    """Convergence of the row of a rectified point."""

    #: Each round of the fixed-point iteration gains one to three digits: by how much less the image moves within a
    #: readout than the shutter does.
    most_rounds: int = 12
    settled_px: float = 1e-3


_LIMITS = RectificationLimits()


def rectify_keypoints(
    keypoints_px: NDArray[np.floating], motion: GyroCamera, camera: Projector, shutter: FrameShutter
) -> NDArray[np.floating]:
    """Move keypoints to where they would be, had the whole image been taken at ``shutter.reference_s()``.

    The camera's rotation between the keypoint's line and that instant is undone; what translation does within the
    readout stays.

    Parameters
    ----------
    keypoints_px
        (N, 2 or more) COLMAP's pixel coordinates first. Of four columns, the others are scale and orientation (rad);
        of six, the affine shape a11, a12, a21, a22, as in COLMAP's database: they follow the derivative of the
        mapping. Any other columns stay as they are.
    motion, camera, shutter
        As for ``psf.blur_field``; the exposure may be unknown.

    Returns
    -------
    A new array of the same shape and type. A keypoint that leaves what the camera model can project stays in place.

    Raises
    ------
    NotObservableError
        Where the gyroscope did not record the whole readout.
    """
    keypoints = np.array(keypoints_px)
    if keypoints.ndim != 2 or keypoints.shape[1] < 2:
        raise ValueError(f"keypoints_px: shape {keypoints.shape}, expected (N, 2 or more)")
    _check_covered(motion, shutter)
    if len(keypoints) == 0 or shutter.readout_s == 0:
        return keypoints
    points = keypoints[:, :2].astype(np.float64)
    moved = _move_to_reference(points, motion, camera, shutter)
    ok = np.isfinite(moved).all(axis=1)
    if keypoints.shape[1] in (4, 6):
        beside = [_move_to_reference(points + step, motion, camera, shutter) for step in ([1.0, 0.0], [0.0, 1.0])]
        derivative = np.stack([b - moved for b in beside], axis=-1)
        ok &= np.isfinite(derivative).all(axis=(1, 2))
        keypoints[ok, 2:] = _transform_shapes(keypoints[ok, 2:].astype(np.float64), derivative[ok])
    keypoints[ok, :2] = moved[ok]
    return keypoints


def rectify_image(
    image: NDArray[Pixel], motion: GyroCamera, camera: Projector, shutter: FrameShutter, *, step_px: int = 16
) -> tuple[NDArray[Pixel], BoolArray]:
    """The image as a global shutter would have taken it at ``shutter.reference_s()``.

    Where a pixel came from is found by fixed-point iteration on a grid, and interpolated between its nodes; colours by
    OpenCV's bicubic interpolation.

    Parameters
    ----------
    image
        (H, W) or (H, W, C), uint8 or uint16.
    motion, camera, shutter
        As for ``psf.blur_field``; the exposure may be unknown.
    step_px
        Distance of the nodes.

    Returns
    -------
    The rectified image, and (H, W) which of its pixels the frame covers; the others are black.

    Raises
    ------
    NotObservableError
        Where the gyroscope did not record the whole readout.
    """
    import cv2

    height, width = image.shape[:2]
    if (width, height) != (shutter.width, shutter.height):
        raise ValueError(f"the image is {width}x{height}, its shutter {shutter.width}x{shutter.height}")
    _check_covered(motion, shutter)
    if shutter.readout_s == 0:
        return image.copy(), np.ones((height, width), dtype=np.bool_)
    shift = _shift_from_reference(motion, camera, shutter, step_px)
    map_x, map_y = sampling_maps(shift, width, height, step_px)
    covered = (map_x >= -0.5) & (map_x <= width - 0.5) & (map_y >= -0.5) & (map_y <= height - 0.5)
    out = cv2.remap(image, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    out[~covered] = 0
    return out, covered


def _check_covered(motion: GyroCamera, shutter: FrameShutter) -> None:
    if not shutter.covered_by(motion, reference=True):
        raise NotObservableError("rolling shutter", Fact("frame-readout-not-covered"))


def rays(camera: Projector, points: Array) -> Array:
    """(N, 3) directions of (N, 2) pixels in the camera frame, z = 1."""
    return append_unit_depth(np.asarray(camera.cam_from_img(points))[:, :2])


def append_unit_depth(xy: Array) -> Array:
    """(N, 3) rays at z = 1 of (N, 2)."""
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


def _move_to_reference(points: Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter) -> Array:
    """(N, 2) where (N, 2) points of the frame are at the reference instant."""
    reference = motion.start_from_cam(np.array(shutter.reference_s()))
    seen = motion.start_from_cam(shutter.middle_s(points))
    rotated = np.einsum("ji,njk,nk->ni", reference, seen, rays(camera, points))
    return np.asarray(camera.img_from_cam(rotated))


def _shift_from_reference(motion: GyroCamera, camera: Projector, shutter: FrameShutter, step_px: int) -> Array:
    """(Gy, Gx, 2) what to add to a pixel at the reference instant to get to the frame's, at the nodes of a grid."""
    nodes = step_px * grid_nodes(*BlurField.nodes(shutter.width, shutter.height, step_px))
    target = colmap_px_from_opencv(nodes.reshape(-1, 2))
    directions = rays(camera, target) @ motion.start_from_cam(np.array(shutter.reference_s())).T
    source = project_by_lines(directions, target, motion, camera, shutter)
    return np.asarray(source - target).reshape(nodes.shape)


def project_by_lines(
    directions: Array, start: Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter
) -> Array:
    """(N, 2) where a frame has (N, 3) directions that do not move, each when its own line exposes.

    By fixed-point iteration from (N, 2) pixels near them; directions are in the frame of ``GyroCamera.start_from_cam``.
    """
    xy_px_now = start
    for _ in range(_LIMITS.most_rounds):
        then = motion.start_from_cam(shutter.middle_s(np.where(np.isfinite(xy_px_now), xy_px_now, start)))
        before, xy_px_now = xy_px_now, np.asarray(camera.img_from_cam(np.einsum("nji,nj->ni", then, directions)))
        if not (np.abs(xy_px_now - before) > _LIMITS.settled_px).any():
            break
    return xy_px_now


def grid_nodes(rows: int, columns: int) -> Array:
    """(rows, columns, 2) column and row of each node."""
    return np.stack(np.meshgrid(np.arange(float(columns)), np.arange(float(rows))), axis=-1)


def sampling_maps(shift_px: Array, width: int, height: int, step_px: float) -> tuple[Float32Array, Float32Array]:
    """(H, W) columns and rows for ``cv2.remap``: each pixel's own and the shift there, given at (Gy, Gx, 2) nodes."""
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    spread_x, spread_y = (spread_nodes(shift_px[..., i], width, height, step_px) for i in (0, 1))
    return spread_x + x, spread_y + y


def spread_nodes(nodes: Array, width: int, height: int, step_px: float) -> Float32Array:
    """(H, W) bilinear values between (Gy, Gx) nodes, as two products with weights."""

    def weights(size: int, count: int) -> Float32Array:
        distance = np.abs(np.arange(size)[:, None] / step_px - np.arange(count))
        return np.maximum(1 - distance, 0).astype(np.float32)

    # what the camera model cannot project comes from nowhere
    values = np.where(np.isfinite(nodes), nodes, 1e6).astype(np.float32)
    rows, columns = nodes.shape
    return np.asarray(weights(height, rows) @ values @ weights(width, columns).T)


def _transform_shapes(columns: Array, derivative: Array) -> Array:
    """(N, 2) scale and orientation or (N, 4) affine shape after a mapping with (N, 2, 2) derivatives."""
    if columns.shape[1] == 4:
        return np.asarray((derivative @ columns.reshape(-1, 2, 2)).reshape(-1, 4))
    scale, angle = columns.T
    along = np.einsum("nij,nj->ni", derivative, np.stack([np.cos(angle), np.sin(angle)], axis=1))
    size = np.sqrt(np.abs(np.linalg.det(derivative)))
    return np.stack([scale * size, np.arctan2(along[:, 1], along[:, 0])], axis=1)
