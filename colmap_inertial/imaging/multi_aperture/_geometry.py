"""All apertures seen from one orientation, where a candidate disparity is a shift of whole views.

The reference and its partner are rectified: both are rotated until the line between them lies in the image plane. The
other views are brought to the same orientation and focal length, so that the trifocal tensor of reference, partner
and view, which takes a point and its disparity to its place in the view, becomes a shift (and for an aperture that
stands before or behind the others a small change of size).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, Int32Array
from colmap_inertial.core.geometry import (
    colmap_px_from_opencv,
    matrix_from_quat,
    opencv_px_from_colmap,
    quat_rotate,
    rotation_between,
)
from colmap_inertial.core.types import ApertureRig, CameraModel, Projector
from colmap_inertial.imaging.rolling_shutter import rays

#: The canvas is at most this much larger than the reference's image: strong fisheyes lose their rim.
_LARGEST = 1.4
#: Maps that move pixels by less leave them alone.
_STILL_PX = 1 / 64


def trifocal_tensor(second: Array, third: Array) -> Array:
    """(3, 3, 3) trifocal tensor ``T[i, j, k]`` of cameras ``[I | 0]``, ``second`` and ``third``, (3, 4) each.

    ``T_i = a_i b_4^T - a_4 b_i^T`` of their columns (Hartley, Zisserman, Multiple View Geometry, 2nd ed., eq. 15.1).
    """
    return np.asarray(
        np.einsum("ji,k->ijk", second[:, :3], third[:, 3]) - np.einsum("j,ki->ijk", second[:, 3], third[:, :3])
    )


def transfer(tensor: Array, points: Array, lines: Array) -> Array:
    """(..., 3) points in the third view of (..., 3) points in the first that lie on (..., 3) lines in the second.

    ``x''^k = x^i l'_j T_i^jk`` (Hartley, Zisserman, section 15.3).
    """
    return np.asarray(np.einsum("...i,...j,ijk->...k", points, lines, tensor))


@dataclass(frozen=True, eq=False, kw_only=True)
class Rectified:
    """The canvas on which views are matched, and how their images map to it. Pixel centres are whole numbers.

    Attributes
    ----------
    width, height, focal_px, centre_px
        Of the canvas: a pinhole camera.
    rect_from_reference
        (3, 3) its orientation against the reference's.
    baselines
        (N - 1, 3) from the reference to the other apertures, in the canvas' frame and the rig's unit.
    direction
        (2,) unit vector from the partner's image of a near thing to the reference's.
    image_from_canvas
        For each aperture (height, width, 2) pixels of its image; ``None`` where the canvas is its image.
    canvas_from_reference
        (H, W, 2) the other way for the reference.
    depth_factor
        (H, W) depth along the reference's optical axis over that along the canvas', where they differ.
    covered
        For each aperture the first and last column and row of the canvas that its image reaches.
    """

    width: int
    height: int
    focal_px: float
    centre_px: Array
    rect_from_reference: Array
    baselines: Array
    direction: Array
    image_from_canvas: tuple[Float32Array | None, ...]
    canvas_from_reference: Float32Array | None
    depth_factor: Float32Array | None
    covered: tuple[tuple[int, int, int, int], ...]

    @property
    def baseline(self) -> float:
        """Between the reference and its partner, in the rig's unit."""
        return float(np.linalg.norm(self.baselines[0]))

    def disparity(self, depth: float) -> float:
        """Disparity at this depth along the canvas' optical axis, in the rig's unit."""
        return self.focal_px * self.baseline / depth

    @property
    def ratios(self) -> Array:
        """(N - 1, 3) for each pixel of disparity a view's shift along x and y in pixels, and its shrinking.

        A pixel at ``x`` from the middle of the canvas, with disparity d, lies at ``(x - d r_xy) / (1 - d r_z)``.
        """
        return np.asarray(self.baselines / self.baseline / np.array([1.0, 1.0, self.focal_px]))

    def shrunk(self, by: int) -> Rectified:
        """The canvas for images that are so many times smaller, without maps."""
        return replace(
            self,
            width=self.width // by,
            height=self.height // by,
            focal_px=self.focal_px / by,
            centre_px=(self.centre_px - (by - 1) / 2) / by,
            image_from_canvas=(),
            canvas_from_reference=None,
            covered=tuple(
                _shrink_range(a, b, by, self.width // by) + _shrink_range(c, d, by, self.height // by)
                for a, b, c, d in self.covered
            ),
        )

    def transfers(self, disparities_px: Array) -> tuple[Array, Array]:
        """Transforms of the canvas into the other views for each candidate: (N - 1, D) sizes and (N - 1, D, 2) offsets.

        A pixel (x, y) lies at ``size (x, y) + offset``: the trifocal tensor takes the pixel, and the line in the
        partner across the direction of disparities, to the view.
        """
        k = np.array(
            [[self.focal_px, 0, self.centre_px[0]], [0, self.focal_px, self.centre_px[1]], [0, 0, 1.0]], dtype=float
        )

        def camera(baseline: Array) -> Array:
            # of points whose coordinates are the reference's pixels, times depth
            return np.column_stack([np.eye(3), -k @ baseline])

        partner = camera(self.baselines[0])
        e = self.direction
        corners = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
        at = corners[:, None, :2] - np.asarray(disparities_px)[:, None] * e
        lines = np.concatenate([np.broadcast_to(e, at.shape), -(at @ e)[..., None]], axis=-1)
        placed = []
        for baseline in self.baselines:
            points = transfer(trifocal_tensor(partner, camera(baseline)), corners[:, None], lines)
            placed.append(points[..., :2] / points[..., 2:])
        moved = np.stack(placed)  # (N - 1, corner, D, 2)
        return moved[:, 1, :, 0] - moved[:, 0, :, 0], moved[:, 0]

    def sample_positions(self, disparities_px: Array) -> tuple[Int32Array, Int32Array]:
        """(N - 1, D, W) columns and (N - 1, D, H) rows in sixteenths of a pixel; negative where a view ends."""
        sizes, offsets = self.transfers(disparities_px)
        out = []
        for axis, length in ((0, self.width), (1, self.height)):
            at = sizes[..., None] * np.arange(length) + offsets[..., axis, None]
            first, last = (np.array([c[2 * axis + i] for c in self.covered[1:]])[:, None, None] for i in (0, 1))
            out.append(np.where((at < first) | (at > last), -1, np.floor(16 * at + 0.5)).astype(np.int32))
        return out[0], out[1]


def rectify(rig: ApertureRig, projectors: Sequence[Projector]) -> Rectified:
    """The canvas of a rig.

    The reference is rotated as little as possible: until the line to its partner lies in the image plane. It need not
    run along rows, as paths and views are taken in any direction.

    Parameters
    ----------
    projectors
        Of the apertures' cameras, in their order.
    """
    apertures = rig.apertures
    rotations = [matrix_from_quat(aperture.cam_from_rig_xyzw) for aperture in apertures]
    reference = apertures[0]
    to_others = np.stack(
        [quat_rotate(reference.cam_from_rig_xyzw, a.cam_in_rig - reference.cam_in_rig) for a in apertures]
    )
    flat = to_others[1] * np.array([1.0, 1.0, 0.0])
    if np.linalg.norm(flat) < 0.2 * np.linalg.norm(to_others[1]):
        raise ValueError(
            f"{rig.names[1]} stands before or behind {rig.names[0]}, not beside it: disparities would be nothing"
        )
    rect_from_ref = matrix_from_quat(rotation_between(to_others[1], flat))
    rect_from_rig = rect_from_ref @ rotations[0]
    baselines = to_others[1:] @ rect_from_ref.T

    camera = reference.camera
    focal = _measure_focal_px(projectors[0], camera.width, camera.height)
    width, height, centre = _find_canvas_extent(camera, projectors[0], rect_from_ref, focal)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    directions = np.concatenate([(pixels - centre) / focal, np.ones((height, width, 1))], axis=-1)
    maps: list[Float32Array | None] = []
    covered = []
    for aperture, projector, rotation in zip(apertures, projectors, rotations, strict=True):
        at = _project_directions(projector, directions.reshape(-1, 3) @ (rotation @ rect_from_rig.T).T).reshape(
            pixels.shape
        )
        w, h = aperture.camera.width, aperture.camera.height
        inside = (at >= -0.5 - 1e-6).all(axis=-1) & (at[..., 0] <= w - 0.5 + 1e-6) & (at[..., 1] <= h - 0.5 + 1e-6)
        columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
        if not len(columns):
            raise ValueError(f"{aperture.name} looks elsewhere than {rig.names[0]}: their pictures share nothing")
        covered.append((int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1])))
        still = (w, h) == (width, height) and bool(np.nanmax(np.abs(at - pixels)) < _STILL_PX)
        maps.append(None if still else np.where(np.isfinite(at), at, -1e4).astype(np.float32))
    back = factor = None
    if maps[0] is not None:
        back, factor = _map_reference(camera, projectors[0], rect_from_ref, focal, centre)
    return Rectified(
        width=width,
        height=height,
        focal_px=focal,
        centre_px=centre,
        rect_from_reference=rect_from_ref,
        baselines=baselines,
        direction=baselines[0, :2] / np.linalg.norm(baselines[0, :2]),
        image_from_canvas=tuple(maps),
        canvas_from_reference=back,
        depth_factor=factor,
        covered=tuple(covered),
    )


def _find_canvas_extent(
    camera: CameraModel, projector: Projector, rect_from_ref: Array, focal_px: float
) -> tuple[int, int, Array]:
    """Width, height and principal point of the canvas: its pixels are the reference's where nothing is distorted or
    rotated."""
    border = _cast_rays(projector, _border_pixels(camera.width, camera.height)) @ rect_from_ref.T
    sides = np.array([camera.width, camera.height])
    seen = np.where(border[:, 2:] > 0.05, border[:, :2] / np.maximum(border[:, 2:], 0.05), np.nan) * focal_px
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    middle = focal_px * (_cast_rays(projector, opencv_px_from_colmap(sides / 2.0)[None]) @ rect_from_ref.T)[0, :2]
    low, high = np.maximum(low, middle - _LARGEST / 2 * sides), np.minimum(high, middle + _LARGEST / 2 * sides)
    axis = opencv_px_from_colmap(np.asarray(projector.img_from_cam(np.array([[0.0, 0.0, 1.0]])))[0])
    start = np.floor(low + axis + 1e-3)
    width, height = np.ceil(high + axis - start + 1 - 1e-3).astype(int).tolist()
    return width, height, axis - start


def _project_directions(projector: Projector, in_cam: Array) -> Array:
    """(N, 2) pixels, centres whole numbers, of (N, 3) directions; nan of those behind the camera."""
    return opencv_px_from_colmap(np.where(in_cam[:, 2:] > 0, np.asarray(projector.img_from_cam(in_cam)), np.nan))


def _map_reference(
    camera: CameraModel, projector: Projector, rect_from_ref: Array, focal_px: float, centre: Array
) -> tuple[Float32Array, Float32Array]:
    """Positions of the reference's pixels on the canvas, and their depth there as a factor of that on the canvas."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)), axis=-1)
    seen = _cast_rays(projector, pixels.reshape(-1, 2)) @ rect_from_ref.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(seen[:, 2:] > 0.05, seen[:, 2:], np.nan)
        at = focal_px * seen[:, :2] / ahead + centre
    factor = (1 / ahead).reshape(camera.height, camera.width).astype(np.float32)
    return np.nan_to_num(at, nan=-1e4).reshape(pixels.shape).astype(np.float32), factor


def _shrink_range(first: int, last: int, by: int, size: int) -> tuple[int, int]:
    """The pixels, ``by`` times larger, that lie whole within a range; at least one."""
    start = min(-(-first // by), size - 1)
    return start, max(start, min((last + 1) // by, size) - 1)


def _cast_rays(projector: Projector, xy_px: Array) -> Array:
    """(N, 3) directions of pixels whose centres are whole numbers."""
    return rays(projector, colmap_px_from_opencv(xy_px))


def _border_pixels(width: int, height: int) -> Array:
    """(N, 2) centres of the pixels all around."""
    x, y = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33)
    sides = [(x, 0 * x), (x, 0 * x + height - 1), (0 * y, y), (0 * y + width - 1, y)]
    return np.concatenate([np.column_stack(side) for side in sides])


def _measure_focal_px(projector: Projector, width: int, height: int) -> float:
    """Pixels a radian, at the middle of the image."""
    middle = np.array([[width / 2, height / 2]])
    rays = [np.asarray(projector.cam_from_img(middle + step))[0, :2] for step in ((0, 0), (1, 0), (0, 1))]
    area = np.linalg.det(np.stack([rays[1] - rays[0], rays[2] - rays[0]]))
    return float(1 / np.sqrt(abs(area)))
