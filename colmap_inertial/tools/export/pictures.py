"""The pictures of an export: resampled, 8 bit, three channels."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import AnyArray, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.threads import frames_at_once, in_order
from colmap_inertial.io.images import read_image
from colmap_inertial.pipeline.run.progress import Progress
from colmap_inertial.pipeline.stages.frame_folder import encode_image
from colmap_inertial.tools.export.undistort import Undistortion


@dataclass(frozen=True, eq=False, kw_only=True)
class Job:
    """One picture to write.

    Attributes
    ----------
    target
        The new file.
    source
        The file that it is made from, or where its pixels come from, for messages.
    undistortion
        What its camera becomes.
    pixels
        (H, W) or (H, W, 3) where they are decoded already; ``None`` reads the file.
    """

    target: Path
    source: Path
    undistortion: Undistortion
    pixels: AnyArray | None = None

    def write(self) -> None:
        """Write it."""
        image: AnyArray = read_image(self.source) if self.pixels is None else self.pixels
        camera = self.undistortion.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise FormatError(
                self.source,
                f"has {image.shape[1]} x {image.shape[0]} pixels, its camera {camera.width} x {camera.height}: no "
                "picture of the model",
            )
        if self.pixels is None and self.undistortion.is_same() and _is_plain(self.source, self.target, image):
            shutil.copyfile(self.source, self.target)
        else:
            encode_image(self.target, self.undistortion.resampled(three_channels(image)))


def write_pictures(jobs: Iterable[Job], count: int, progress: Progress) -> None:
    """Write pictures as pinhole cameras would have taken them; a few at a time.

    Parameters
    ----------
    jobs, count
        The pictures, and how many there are.
    progress
        Called with ``"export"``.

    Raises
    ------
    FormatError
        For a picture that cannot be read, or whose size is not the camera's.
    """
    progress("export", 0, count)
    for done, _ in enumerate(in_order(Job.write, jobs, workers=frames_at_once()), start=1):
        progress("export", done, count)


def three_channels(image: AnyArray) -> UInt8Array:
    """(H, W, 3) the picture in 8 bit and three channels: trainers read nothing else."""
    shown = np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)
    return np.repeat(shown[:, :, None], 3, axis=2) if shown.ndim == 2 else shown


def _is_plain(source: Path, target: Path, image: AnyArray) -> bool:
    """Whether a file is what trainers read, as it is; an orientation in its metadata some of them would heed."""
    suffix = {".jpeg": ".jpg"}.get(source.suffix.lower(), source.suffix.lower())
    plain = image.ndim == 3 and image.dtype == np.uint8 and suffix == target.suffix
    if not plain:
        return False
    with open(source, "rb") as file:
        head = file.read(1 << 16)
    return b"Exif" not in head and b"eXIf" not in head  # in JPEG, in PNG
