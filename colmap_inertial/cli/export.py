"""Arguments of ``colmap-inertial export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_exported
from colmap_inertial.core.options import ExportImages, ExportProgram


@dataclass(frozen=True, kw_only=True)
class Export(ReadingCommand):
    """Export a finished model to other programs, in metres and with gravity kept.

    Without --for, DIR is one folder for all splatting and NeRF trainers: images/ (undistorted, the principal point in
    the middle), sparse/0 (COLMAP), sparse_pc.ply, transforms.json, export.json. With --for, also the command line with
    which that program keeps metres and up. 3dgs-deblur gets velocities, instant-ngp poses of first and last rows. Other
    formats: metashape and bundler (cameras and undistorted images), ply and las (sparse points), tum, csv and gltf (the
    camera's path). las and gltf need the extra packages [las] and [gltf].

    A refused scale is refused here, too (exit code 3), unless --unscaled is given.

    Example: colmap-inertial export out/hall hall_splat --for gsplat
    """

    common: ClassVar = ("program", "images", "model")

    out: Positional[Path]
    """What reconstruct or apply wrote, or a COLMAP model folder; it is only read."""
    dir: Positional[Path]
    """A new or empty folder outside of OUT; it appears whole or not at all."""
    program: Annotated[ExportProgram | None, arg(name="for")] = None
    """The program or format; all trainers without it."""
    images: ExportImages = "rectified"
    """rectified: those that agree with the model; original: those with their rolling shutter, as COLMAP saw them."""
    model: int | None = None
    """Number of the model, where there are several; the largest otherwise."""
    image_folder: Path | None = None
    """Folder with the model's images, where they are not beside the model."""
    capture: Path | None = None
    """The capture that the run was made of: with --images original for frames that it deblurred or changed, with
    --georeference for its positions."""
    georeference: bool = False
    """Also write the position on Earth (georeference.json, columns of cameras.csv, LAS points in UTM): as the run
    found it, else by the positions (GPS) of the capture or in the images' EXIF."""
    unscaled: bool = False
    """Also export a model without a scale, whose units are not metres."""

    def __post_init__(self) -> None:
        if self.capture is not None and self.images != "original" and not self.georeference:
            raise ValueError("--capture goes with --images original or --georeference")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.export.whole import export_model

        self.check_json(self.out, self.dir)
        with self.progress() as progress:
            made = export_model(
                self.out,
                self.dir,
                self.program,
                images=self.images,
                model=self.model,
                image_folder=self.image_folder,
                capture=self.capture,
                georeference=self.georeference,
                unscaled=self.unscaled,
                progress=progress,
            )
        self.tell(lambda: show_exported(made), made.folder / "export.json", {"folder": made.folder})
        return 0
