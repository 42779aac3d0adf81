"""Images that are registered anew by the points of the others."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.model.deregistration import deregister_images, forget_unregistered
from colmap_inertial.model.submodels.matches import Submodel, localise, matches_between

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


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

    rest = deregister_images(model, names, keep_frames=True)
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
    return forget_unregistered(rest), tuple(again)
