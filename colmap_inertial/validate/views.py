"""Posed images of a COLMAP model, and corners turned into rays with the model's own cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.images import require_modest
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.model import model_format, read_model
from colmap_inertial.validate.detect import DETECTION, Detection

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """One posed image.

    Attributes
    ----------
    name
        The image's name in the model.
    path
        Its file.
    camera
        The ``pycolmap.Camera`` that took it.
    cam_from_world
        (3, 3) rotation.
    cam_from_world_t
        (3,) translation, model units; the world's origin is the middle of the cameras, not the model's own.
    origin_in_model
        (3,) that origin in the model's own world.
    """

    name: str
    path: Path
    camera: Any
    cam_from_world: Array
    cam_from_world_t: Array
    origin_in_model: Array = field(default_factory=lambda: np.zeros(3))

    def read(self, *, flip: int | None = None) -> UInt8Array | Fact:
        """The image (H, W) in grey as COLMAP sees it (orientation tags ignored), or why it cannot be used.

        Parameters
        ----------
        flip
            OpenCV's flip code, to look at the image in a mirror.
        """
        import cv2

        try:
            data = read_bytes(self.path, what="picture")
            require_modest(self.path, data)
        except FormatError as error:
            return error.fact
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
        if image is None:
            return Fact("view-unreadable")
        height, width = image.shape
        if (width, height) != (self.camera.width, self.camera.height):
            return Fact(
                "view-of-other-size",
                width=width,
                height=height,
                camera_width=self.camera.width,
                camera_height=self.camera.height,
            )
        return np.asarray(image if flip is None else cv2.flip(image, flip), dtype=np.uint8)


@dataclass(frozen=True, eq=False, kw_only=True)
class Sighting:
    """A detection with the rays to its corners.

    Attributes
    ----------
    view
        Index of the view.
    part
        The target's rigid part.
    corner
        (n,) numbers of the corners as the detector numbered them.
    xy_px
        (n, 2) COLMAP's pixel coordinates.
    ray
        (n, 3) unit directions in the camera frame.
    px_from_tangent
        (n, 2, 3) derivative of the pixel with respect to the direction; zero along the ray.
    """

    view: int
    part: int
    corner: IndexArray
    xy_px: Array
    ray: Array
    px_from_tangent: Array


def load_views(model: Path | pycolmap.Reconstruction, images: Path) -> tuple[list[View], dict[str, Fact]]:
    """The posed images of a model whose files are there.

    Parameters
    ----------
    model
        Folder of a COLMAP model, or one in memory.
    images
        Folder that the images' names are relative to.

    Returns
    -------
    views
        In the order of their names.
    missing
        Names of posed images without a file, with the reason.

    Raises
    ------
    FormatError
        When the folder holds no model, the model no posed image, or the image folder none of its images.
    """
    if isinstance(model, Path):
        others = [] if model_format(model) else sorted(p.name for p in model.glob("*") if model_format(p))
        if others:
            raise FormatError(model, Fact("models-in-folders", folders=others))
        reconstruction = read_model(model)
    else:
        reconstruction = model
    if not images.is_dir():
        raise FormatError(images, Fact("not-a-folder-of-images"))
    posed = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda image: image.name)
    if not posed:
        raise FormatError(model if isinstance(model, Path) else "model", Fact("no-image-with-pose"))
    middle = np.median([image.projection_center() for image in posed], axis=0)
    views, missing = [], dict[str, Fact]()
    for image in posed:
        path = picture_in(images, image.name, model if isinstance(model, Path) else None)
        if not path.is_file():
            missing[image.name] = Fact("view-without-file")
            continue
        pose = image.cam_from_world()
        rotation = np.asarray(pose.rotation.matrix(), dtype=np.float64)
        views.append(
            View(
                name=image.name,
                path=path,
                camera=reconstruction.cameras[image.camera_id],
                cam_from_world=rotation,
                cam_from_world_t=np.asarray(pose.translation) + rotation @ middle,
                origin_in_model=middle,
            )
        )
    if not views:
        raise FormatError(
            images,
            Fact("images-of-model-missing", count=len(posed), first=posed[0].name),
        )
    return views, missing


def sight(view: int, camera: Any, detection: Detection) -> Sighting:
    """Rays to the corners of a detection; corners that the camera model cannot turn into rays are left out.

    Parameters
    ----------
    view
        Index to note.
    camera
        The ``pycolmap.Camera``.
    detection
        What was found in the image.
    """
    xy = np.ascontiguousarray(detection.xy_px, dtype=np.float64)
    if hasattr(camera, "cam_ray_from_img"):  # reaches behind the camera, where newer models can see
        ray = np.asarray(camera.cam_ray_from_img(xy), dtype=np.float64)
    else:
        plane = np.asarray(camera.cam_from_img(xy), dtype=np.float64)
        ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    side = np.cross(ray, np.eye(3)[np.argmin(np.abs(ray), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    tangent = np.stack([side, np.cross(ray, side)], axis=1)

    def project(direction: Array) -> Array:
        return np.asarray(camera.img_from_cam(np.ascontiguousarray(direction)), dtype=np.float64)

    step = DETECTION.derivative_step_rad
    ends = [[project(ray + sign * step * tangent[:, k]) for sign in (1, -1)] for k in (0, 1)]
    derivative = np.stack([(ahead - behind) / (2 * step) for ahead, behind in ends], axis=2)
    px_from_tangent = derivative @ tangent
    good = np.isfinite(px_from_tangent).all(axis=(1, 2)) & (
        np.abs(project(ray) - xy).max(axis=1) < DETECTION.round_trip_px
    )
    return Sighting(
        view=view,
        part=detection.part,
        corner=detection.corner[good],
        xy_px=xy[good],
        ray=ray[good],
        px_from_tangent=px_from_tangent[good],
    )
