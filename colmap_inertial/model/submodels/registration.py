"""Images that leave a model, and images that are registered anew by the points of the others."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.model.submodels.matches import Submodel, localise, matches_between

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


def deregister_images(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    """A copy of a model without the frames of some images; points that fewer than two others see go with them."""
    return _registered_only(_deregistered(model, names))


def _deregistered(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    import pycolmap

    rest = pycolmap.Reconstruction(model)
    images = map(rest.image, rest.reg_image_ids())
    for frame in sorted({image.frame_id for image in images if image.name in names}):
        rest.deregister_frame(frame)
    return rest


def _registered_only(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """As COLMAP reads what it wrote: without frames that are not registered, which its bundle adjustment refuses."""
    import pycolmap

    if model.num_reg_frames() == model.num_frames():
        return model
    with tempfile.TemporaryDirectory() as folder:
        model.write_binary(folder)
        read = pycolmap.Reconstruction()
        read.read_binary(folder)
    return read


def register_again(
    model: pycolmap.Reconstruction, names: Collection[str], database: Path
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """Register images anew, by their matches with the points of all others.

    Parameters
    ----------
    model
        It stays as it is. One camera to a frame.
    names
        Images that are in the wrong place.
    database
        COLMAP's, with their matches.

    Returns
    -------
    pycolmap.Reconstruction, tuple of str
        A copy without these images, but for those that enough matches place (named); as COLMAP places images.

    Raises
    ------
    FormatError
        Where the database is none, or damaged.
    """
    import pycolmap

    rest = _deregistered(model, names)
    there, own = Submodel(rest), Submodel(model, names)
    again = []
    for name, _, cam_from_world, agree in localise(there, own, matches_between(database, [there, own]).get((0, 1), [])):
        image_id = own.images[name].image_id
        image = rest.image(image_id)
        frame = rest.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, cam_from_world)
        rest.register_frame(frame.frame_id)
        # a point is seen once in an image, and a keypoint sees one point
        agree = agree[np.unique(agree[:, 1], return_index=True)[1]]
        agree = agree[np.unique(agree[:, 0], return_index=True)[1]]
        for keypoint, point in agree.tolist():
            rest.add_observation(point, pycolmap.TrackElement(image_id, keypoint))
        again.append(name)
        log.info("%s was registered again by %d points", name, len(agree))
    return _registered_only(rest), tuple(again)
