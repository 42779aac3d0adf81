"""What an export is made of, in the form that its pictures and cameras have in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.model.nerf import NO_SCALE, NO_UP
from colmap_inertial.tools.export.names import flat_names
from colmap_inertial.tools.export.pinhole_model import needed_cameras
from colmap_inertial.tools.export.points import sparse_points
from colmap_inertial.tools.export.source import ExportSource, Picture
from colmap_inertial.tools.export.transforms import View
from colmap_inertial.tools.export.undistort import Undistortion

#: What says up where gravity is unknown: z, as trainers' viewers have it.
_Z_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportContent:
    """What an export is made of.

    Attributes
    ----------
    source
        The model that is exported.
    names
        The new name of each image.
    cameras
        What becomes of each camera, by its number.
    views
        The images, in the order of their new names.
    xyz, rgb
        (N, 3) points and colours.
    on_map
        Where on Earth the model stands, where that was asked for.
    pictures
        By image name, the file that is exported; empty where none are.
    notes
        What the user should know; writers add to it.
    """

    source: ExportSource
    names: Mapping[str, str]
    cameras: Mapping[int, Undistortion]
    views: list[View]
    xyz: Array
    rgb: UInt8Array
    on_map: Georeference | None = None
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    notes: list[str]

    @classmethod
    def of(cls, source: ExportSource, on_map: Georeference | None, *, square: bool) -> ExportContent:
        """All but the pictures; cameras with ``square`` pixels where that is needed."""
        model, where = source.model, source.found.folder
        names = flat_names(model.image(i).name for i in model.reg_image_ids())
        cameras = {i: Undistortion.of(model.camera(i), where, square=square) for i in needed_cameras(model)}
        views = [
            View(
                name=names[image.name],
                camera=cameras[image.camera_id].pinhole,
                cam_from_world_xyzw=np.array(image.cam_from_world().rotation.quat),
                cam_in_world=np.array(image.projection_center()),
            )
            for image in map(model.image, model.reg_image_ids())
        ]
        xyz, rgb = sparse_points(model)
        return cls(
            source=source,
            names=names,
            cameras=cameras,
            views=sorted(views, key=lambda view: view.name),
            xyz=xyz,
            rgb=rgb,
            on_map=on_map,
            notes=_notes_on_model(source),
        )

    @property
    def is_metric(self) -> bool:
        """Whether the model is in metres."""
        return self.source.found.scale.unit == "m"

    @property
    def up_in_world(self) -> Array:
        """(3,) unit vector; z where gravity is unknown."""
        return _Z_UP if self.source.up_in_world is None else self.source.up_in_world


def _notes_on_model(source: ExportSource) -> list[str]:
    """What the user should know of the model."""
    notes = []
    if source.found.scale.unit != "m":
        notes.append(NO_SCALE)
    if source.up_in_world is None:
        notes.append(NO_UP)
    elif float(source.up_in_world @ _Z_UP) < 0.9:
        notes.append("up is not z in this model (up_in_world says what it is), while most trainers' viewers take z")
    return notes
