"""Pinhole cameras with the principal point in the middle, and images as they would have taken them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.rolling_shutter import grid_nodes, sampling_maps
from colmap_inertial.model import colmap_camera
from colmap_inertial.model.lenses import Fold, find_fold, is_beyond_fold, sees_all_around

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class UndistortionLimits:
    """Limits of the search for the undistorted image."""

    #: A side of the new image is at most this many times the old one's: beyond it a wide lens shows hardly any
    #: detail.
    largest: float = 1.6
    #: Points of the border that tell how far an image reaches; how well distorting must undo undistorting there, px.
    border: int = 200
    undone_px: float = 0.05
    #: Where the new image shows what the old one does not have, it shrinks by this share, so often.
    shrink: float = 0.01
    rounds: int = 90
    #: Distance of the nodes between which the resampling is interpolated, px.
    step_px: int = 8


_LIMITS = UndistortionLimits()


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A camera, and the pinhole camera that takes its place.

    Attributes
    ----------
    camera
        COLMAP's, with any lens.
    pinhole
        ``PINHOLE`` of fx, fy, and cx, cy in the middle.
    fold
        Where the lens folds: nothing is known of what lies beyond.
    """

    camera: pycolmap.Camera
    pinhole: CameraModel
    fold: Fold | None = None

    @classmethod
    def of(cls, camera: pycolmap.Camera, where: Path, *, square: bool = False) -> Undistortion:
        """The largest pinhole camera of the same focal lengths that sees nothing the camera does not see.

        The image of a camera whose principal point is off the middle loses a strip on the far side; the optical axis,
        poses and points stay what they are.

        Parameters
        ----------
        camera
            Of the model.
        where
            The model's folder, for messages.
        square
            Make pixels square, of the focal length in between.

        Raises
        ------
        FormatError
            For a camera that sees all around.
        """
        if sees_all_around(camera):
            raise FormatError(where, Fact("sees-all-around", camera=camera.camera_id, model=camera.model_name))
        fx, fy = float(camera.focal_length_x), float(camera.focal_length_y)
        if square:
            fx = fy = 0.5 * (fx + fy)
        fold = find_fold(camera)
        half = _half_extent(camera, fold)
        for _ in range(_LIMITS.rounds):
            # what is left of a whole pixel by rounding counts as one
            width, height = (
                int(min(2 * extent * focal + 1e-6, _LIMITS.largest * side))
                for extent, focal, side in zip(half, (fx, fy), (camera.width, camera.height), strict=True)
            )
            if width < 1 or height < 1:
                break
            pinhole = CameraModel(
                model="PINHOLE", width=width, height=height, params=(fx, fy, 0.5 * width, 0.5 * height)
            )
            undistortion = cls(camera, pinhole, fold)
            if undistortion.is_inside():
                return undistortion
            half = half * (1 - _LIMITS.shrink)
        raise FormatError(where, Fact("not-undistorted", camera=camera.camera_id, model=camera.model_name))

    def is_inside(self) -> bool:
        """Whether all of the new image comes from the old one."""
        width, height = self.pinhole.width, self.pinhole.height
        x, y = np.linspace(0, width, _LIMITS.border // 4), np.linspace(0, height, _LIMITS.border // 4)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        source = self.source_px(grid)
        size = np.array([self.camera.width, self.camera.height])
        return bool(np.isfinite(source).all() and (source >= -0.01).all() and (source <= size + 0.01).all())

    def source_px(self, xy_px: Array) -> Array:
        """(N, 2) where (N, 2) points of the new image are in the old one; nan where nowhere."""
        fx, fy, cx, cy = self.pinhole.params
        rays = np.stack([(xy_px[:, 0] - cx) / fx, (xy_px[:, 1] - cy) / fy, np.ones(len(xy_px))], axis=1)
        source = np.array(self.camera.img_from_cam(rays), dtype=np.float64)
        source[is_beyond_fold(rays[:, :2], self.fold)] = np.nan
        return source

    def moved_px(self, xy_px: Array) -> Array:
        """(N, 2) where (N, 2) points of the old image are in the new one; nan where they have no ray."""
        fx, fy, cx, cy = self.pinhole.params
        return np.asarray(_unproject(self.camera, xy_px, self.fold) * [fx, fy] + [cx, cy])

    def is_same(self) -> bool:
        """Whether the camera is that pinhole already."""
        size = (self.camera.width, self.camera.height) == (self.pinhole.width, self.pinhole.height)
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * [self.pinhole.width, self.pinhole.height]
        return size and bool(np.abs(self.source_px(corners) - corners).max() < 1e-6)

    def resampled(self, image: UInt8Array) -> UInt8Array:
        """(h, w, C) or (h, w) the image (H, W, C) or (H, W) as the pinhole camera would have taken it.

        By bicubic interpolation.
        """
        import cv2

        if self.is_same():
            return image
        width, height = self.pinhole.width, self.pinhole.height
        nodes = _LIMITS.step_px * grid_nodes(*BlurField.nodes(width, height, _LIMITS.step_px))
        target = colmap_px_from_opencv(nodes.reshape(-1, 2))
        # a shift between pixels is the same whichever corner they are counted from
        shift = (self.source_px(target) - target).reshape(nodes.shape)
        maps = sampling_maps(_extrapolate_shifts(shift), width, height, _LIMITS.step_px)
        out = cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(out, dtype=np.uint8)


def _extrapolate_shifts(shift: Array) -> Array:
    """Shifts at nodes beyond the image's edge, which a lens may not reach, as those within go on."""
    for axis in (0, 1):
        along = np.moveaxis(shift, axis, 0)
        for i in range(2, len(along)):
            lost = ~np.isfinite(along[i])
            along[i][lost] = (2 * along[i - 1] - along[i - 2])[lost]
    return shift


def _unproject(camera: pycolmap.Camera, xy_px: Array, fold: Fold | None) -> Array:
    """(N, 2) rays at z = 1 of (N, 2) pixels; nan where the lens model does not lead there and back, or has folded."""
    if len(xy_px) == 0:
        return np.zeros((0, 2))
    rays = np.asarray(camera.cam_from_img(xy_px), dtype=np.float64)[:, :2].copy()
    ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    ahead[~np.isfinite(rays).all(axis=1)] = [0.0, 0.0, 1.0]
    back = np.asarray(camera.img_from_cam(ahead), dtype=np.float64)
    lost = ~(np.abs(back - xy_px).max(axis=1) < _LIMITS.undone_px)
    rays[lost | is_beyond_fold(rays, fold)] = np.nan
    return rays


def _half_extent(camera: pycolmap.Camera, fold: Fold | None = None) -> Array:
    """(2,) how far the image reaches at z = 1, to the nearer side of each two."""
    width, height = camera.width, camera.height
    x, y = np.linspace(0, width, _LIMITS.border), np.linspace(0, height, _LIMITS.border)
    sides = {
        (0, -1.0): np.stack([np.zeros_like(y), y], axis=1),
        (0, 1.0): np.stack([np.full_like(y, width), y], axis=1),
        (1, -1.0): np.stack([x, np.zeros_like(x)], axis=1),
        (1, 1.0): np.stack([x, np.full_like(x, height)], axis=1),
    }
    # where no ray leads to the border, the lens sees further than a pinhole may
    size = np.array([width, height])
    reach = 0.5 * _LIMITS.largest * size / [camera.focal_length_x, camera.focal_length_y]
    if fold is not None:
        reach = np.minimum(reach, fold.tangent)
    for (axis, sign), border in sides.items():
        rays = sign * _unproject(camera, border, fold)[:, axis]
        rays = rays[np.isfinite(rays) & (rays > 0)]
        if len(rays):
            reach[axis] = min(reach[axis], float(rays.min()))
    return reach


def pinhole_model(
    model: pycolmap.Reconstruction, cameras: Mapping[int, Undistortion], names: Mapping[str, str]
) -> pycolmap.Reconstruction:
    """The model with its images undistorted.

    Observations move along with the images; those beyond an edge of the new image, and keypoints that see no point,
    are left out. All points stay, also those that lose observations.

    Parameters
    ----------
    model
        As COLMAP made it; not changed.
    cameras
        What takes the place of each camera, by its number.
    names
        The new name of each registered image.
    """
    import pycolmap

    made = pycolmap.Reconstruction()
    for camera_id, undistortion in cameras.items():
        made.add_camera(colmap_camera(undistortion.pinhole, camera_id))
    for rig_id in _rigs(model):
        made.add_rig(model.rig(rig_id))
    registered = set(model.reg_image_ids())
    frames = {model.image(i).frame_id for i in registered}
    for frame_id in sorted(frames):
        frame = model.frame(frame_id)
        copy = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id, rig_from_world=frame.rig_from_world)
        for data_id in frame.data_ids:
            copy.add_data_id(data_id)
        made.add_frame(copy)
    tracks: dict[int, pycolmap.Track] = {point_id: pycolmap.Track() for point_id in model.points3D}
    for image_id in sorted(registered):
        image = model.image(image_id)
        kept = _observations(image, cameras[image.camera_id])
        made.add_image(
            pycolmap.Image(
                name=names[image.name],
                points2D=[pycolmap.Point2D(xy) for xy, _ in kept],
                camera_id=image.camera_id,
                image_id=image_id,
                frame_id=image.frame_id,
            )
        )
        for index, (_, point_id) in enumerate(kept):
            tracks[point_id].add_element(image_id, index)
    for point_id, track in tracks.items():
        point = model.points3D[point_id]
        made.add_point3D_with_id(
            point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
        )
    for frame_id in sorted(frames):
        made.register_frame(frame_id)
    return made


def list_needed_cameras(model: pycolmap.Reconstruction) -> list[int]:
    """Numbers of the cameras that registered images have, and of those on the same rigs."""
    import pycolmap

    sensors = [model.camera(model.image(i).camera_id).sensor_id for i in model.reg_image_ids()]
    for rig_id in _rigs(model):
        rig = model.rig(rig_id)
        sensors += [rig.ref_sensor_id, *rig.non_ref_sensors]
    return sorted({int(sensor.id) for sensor in sensors if sensor.type == pycolmap.SensorType.CAMERA})


def _rigs(model: pycolmap.Reconstruction) -> list[int]:
    return sorted({int(model.frame(model.image(i).frame_id).rig_id) for i in model.reg_image_ids()})


def _observations(image: pycolmap.Image, undistortion: Undistortion) -> list[tuple[np.ndarray, int]]:
    """Positions of an image's points after undistortion, and their numbers."""
    seen = [point for point in image.points2D if point.has_point3D()]
    if not seen:
        return []
    moved = undistortion.moved_px(np.array([point.xy for point in seen]))
    size = [undistortion.pinhole.width, undistortion.pinhole.height]
    inside = np.flatnonzero(((moved >= 0) & (moved <= size)).all(axis=1))  # not where one of them is nan
    return [(moved[i], seen[i].point3D_id) for i in inside]
