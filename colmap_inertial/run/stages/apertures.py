"""Frames of a multi-aperture camera: each exposure's sub-images become the one image that COLMAP sees."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import AnyArray
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ApertureOptions
from colmap_inertial.core.types import Frame, Treatment
from colmap_inertial.imaging.multi_aperture import (
    Fused,
    Rectified,
    fuse_apertures,
    plane_of,
    rectify,
    require_colours,
)
from colmap_inertial.io.capture_images import ApertureImages
from colmap_inertial.io.files import path_in
from colmap_inertial.io.images import read_image
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.stages.inputs import StageInputs


@dataclass(frozen=True, eq=False, kw_only=True)
class ApertureStage:
    """The frame stage that fuses sub-images.

    Takes the reference's images, reads the others' beside them, and yields RGB with the reference's camera.

    Attributes
    ----------
    pictures
        The rig, and where its sub-images are.
    options
        How they are fused.
    keep
        Folder for ``disparity/NAME.npy`` (px) and ``depth/NAME.npy`` (m), (H, W) float32; nothing is kept where absent.
    """

    pictures: ApertureImages
    options: ApertureOptions = field(default_factory=ApertureOptions)
    keep: Path | None = field(default=None, compare=False)
    _canvas: list[Rectified] = field(default_factory=list, init=False, compare=False, repr=False)

    @classmethod
    def for_run(cls, inputs: StageInputs) -> ApertureStage | None:
        """The stage of a run, for a multi-aperture camera."""
        options, pictures = inputs.options.apertures, inputs.recording.capture.apertures
        if pictures is None:
            return None
        return cls(pictures=pictures, options=options, keep=inputs.apertures if options.depth else None)

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Fuse the exposures, in order."""
        require_colours(self.pictures.rig)
        for frame in frames:
            if frame.dropped:
                yield frame
                continue
            fused = self.fused(frame.name, frame.image)
            if self.keep is not None:
                write_maps(self.keep / "disparity", self.keep / "depth", frame.name, fused)
            count = len(self.pictures.rig.apertures)
            done = Treatment(stage="apertures", reason=Fact("apertures-fused", count=count))
            yield replace(
                frame,
                image=fused.image,
                camera=self.pictures.rig.reference.camera,
                treatments=(*frame.treatments, done),
            )

    def canvas(self) -> Rectified:
        """The rig's, worked out once."""
        if not self._canvas:
            rig = self.pictures.rig
            try:
                self._canvas.append(rectify(rig, [colmap_camera(aperture.camera) for aperture in rig.apertures]))
            except ValueError as error:
                raise InertialError(Fact("apertures-apart", detail=str(error))) from None
        return self._canvas[0]

    def fused(self, name: str, reference: AnyArray) -> Fused:
        """One exposure, by the name and the pixels of the reference's image."""
        rig = self.pictures.rig
        paths = [source.path(name) for source in self.pictures.sources]
        images = [reference, *(read_image(path) for path in paths[1:])]
        for aperture, path, image in zip(rig.apertures, paths, images, strict=True):
            camera, (height, width) = aperture.camera, image.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise FormatError(
                    path,
                    Fact(
                        "picture-unlike-its-aperture",
                        width=width,
                        height=height,
                        aperture=aperture.name,
                        aperture_width=camera.width,
                        aperture_height=camera.height,
                    ),
                )
            if image.dtype != images[0].dtype:
                raise FormatError(
                    path,
                    Fact("depth-unlike-the-reference", dtype=str(image.dtype), reference_dtype=str(images[0].dtype)),
                )
        planes = [plane_of(image, aperture.role) for image, aperture in zip(images, rig.apertures, strict=True)]
        return fuse_apertures(planes, rig, self.canvas(), self.options)


def write_maps(disparities: Path, depths: Path, name: str, fused: Fused) -> None:
    """Write ``NAME.npy`` into both folders, float32, nan where nothing was measured."""
    disparity = np.where(fused.measured, fused.disparity_px, np.float32(np.nan))
    for folder, values in ((disparities, disparity), (depths, fused.depth)):
        target = path_in(folder, f"{name}.npy")
        target.parent.mkdir(parents=True, exist_ok=True)
        np.save(target, values.astype(np.float32))
