"""Images that agree with the model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from colmap_inertial.core.threads import in_order
from colmap_inertial.io.files import path_in
from colmap_inertial.io.images import read_image
from colmap_inertial.model.copying import copy_file
from colmap_inertial.pipeline.run.progress import Progress
from colmap_inertial.pipeline.stages.frame_folder import encode_image
from colmap_inertial.pipeline.stages.protocols import KeypointStage

#: Moves the pixels of a named image as a keypoint stage moves its keypoints.
ImageMover = Callable[[str, Any], Any]


def image_movers(stages: Sequence[KeypointStage]) -> list[ImageMover]:
    """Those of the keypoint stages that can move pixels, too: by a method ``move_image(name, image)``."""
    return [stage.move_image for stage in stages if hasattr(stage, "move_image")]


def rectifiable(stages: Sequence[KeypointStage], names: Iterable[str]) -> frozenset[str]:
    """Names of the images that one of the stages can move: where it has a method ``covers(name)``, what that says."""
    movers = [stage for stage in stages if hasattr(stage, "move_image")]
    return frozenset(name for name in names if any(_covers(stage, name) for stage in movers))


def _covers(stage: object, name: str) -> bool:
    covers = getattr(stage, "covers", None)
    return covers is None or bool(covers(name))


def write_images(
    movers: Sequence[ImageMover],
    names: Sequence[str],
    rectified: Collection[str],
    images: Path,
    target: Path,
    progress: Progress,
    unsmoothed: Path | None = None,
) -> None:
    """Write the images that COLMAP saw as they are without smoothing, and as a global shutter would have taken them.

    What was not rectified is the same file under a second name (a hard link), or a copy where the file system has none.

    Parameters
    ----------
    movers
        Applied one after the other.
    names
        Of all images.
    rectified
        Names of those whose keypoints were rectified.
    images, target
        Folders of the images that COLMAP saw, and of those that are written.
    progress
        Called with ``"images"``.
    unsmoothed
        Folder of those images as they are that COLMAP saw smoothed.
    """

    def work(name: str) -> None:
        source, out = path_in(images, name), path_in(target, name)
        if unsmoothed is not None and path_in(unsmoothed, name).is_file():
            source = path_in(unsmoothed, name)
        out.parent.mkdir(parents=True, exist_ok=True)
        if name in rectified:
            image: Any = read_image(source)
            for move in movers:
                image = move(name, image)
            encode_image(out, image, source)
        else:
            copy_file(source, out, link=True)

    target.mkdir(parents=True)
    progress("images", 0, len(names))
    for done, _ in enumerate(in_order(work, names, workers=2), start=1):
        progress("images", done, len(names))
