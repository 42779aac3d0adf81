"""Images that agree with rectified keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from colmap_inertial.imaging.rolling_shutter import rectify_image
from colmap_inertial.io.images import read_image
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.progress import Progress
from colmap_inertial.stages.frame_folder import FrameRecord, encode_image
from colmap_inertial.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.threads import in_order


def write_rectified(
    stage: RollingShutterStage, records: Sequence[FrameRecord], images: Path, target: Path, progress: Progress
) -> None:
    """Write the images that COLMAP saw as a global shutter would have taken them; what cannot be rectified is copied.

    Parameters
    ----------
    stage
        That rectified the keypoints.
    records
        Of all frames; those that were dropped have no image.
    images, target
        Folders of the images and of the rectified ones.
    progress
        Called with ``"rectified"``.
    """
    view = stage.view
    motion, camera, index = view.motion(), colmap_camera(view.camera), view.index()

    def work(name: str) -> None:
        source, out = images / name, target / name
        out.parent.mkdir(parents=True, exist_ok=True)
        if stage.covers(name):
            original: Any = read_image(source)
            image, _ = rectify_image(original, motion, camera, view.shutter(index[name]))
            encode_image(out, image, source)
        else:
            out.write_bytes(source.read_bytes())

    names = [record.name for record in records if record.action != "dropped"]
    target.mkdir(parents=True)
    progress("rectified", 0, len(names))
    for done, _ in enumerate(in_order(work, names, workers=2), start=1):
        progress("rectified", done, len(names))
