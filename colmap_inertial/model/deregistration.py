"""Images that leave a model."""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap


def deregister_images(
    reconstruction: pycolmap.Reconstruction, names: Collection[str], *, keep_frames: bool = False
) -> pycolmap.Reconstruction:
    """A copy of a model without the frames of some images; points that fewer than two others see go with them.

    ``keep_frames``: the frames stay in it without a pose, to be registered again; bundle adjustment refuses such.
    """
    import pycolmap

    rest = pycolmap.Reconstruction(reconstruction)
    images = map(rest.image, rest.reg_image_ids())
    for frame in sorted({image.frame_id for image in images if image.name in names}):
        rest.deregister_frame(frame)
    return rest if keep_frames else forget_unregistered(rest)


def forget_unregistered(reconstruction: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A model as COLMAP reads what it wrote: without frames that are not registered."""
    import pycolmap

    if reconstruction.num_reg_frames() == reconstruction.num_frames():
        return reconstruction
    with tempfile.TemporaryDirectory(prefix="colmap-inertial-") as folder:
        reconstruction.write_binary(folder)
        read = pycolmap.Reconstruction()
        read.read_binary(folder)
    return read
