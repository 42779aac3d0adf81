"""Arguments of ``colmap-inertial fuse-apertures``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_fused
from colmap_inertial.core.options import ApertureOptions, FuseAperturesOptions


@dataclass(frozen=True, kw_only=True)
class FuseApertures(ReadingCommand):
    """Make RGB images from the sub-images of a multi-aperture camera.

    One disparity map from all apertures takes their parallax out. Writes OUT/images, seen through the first aperture,
    with the names of its images; with --refocus OUT/refocused; with --depth OUT/disparity and OUT/depth.

    Example: colmap-inertial fuse-apertures my_capture/capture.toml out --refocus 0.8
    """

    common: ClassVar = ("refocus", "lens_width", "depth", "disparity_px")
    resumes: ClassVar = True

    capture: Positional[Path]
    """A capture.toml with [images] and [apertures], or a folder that holds one; no IMU is needed."""
    out: Positional[Path]
    """A new folder, or that of an earlier run on the same capture, which is continued."""
    refocus: float | None = None
    """Also write images that are sharp at this depth only, in metres."""
    lens_width: float = 1.0
    """Width of the lens that refocused images show, in distances between the first two apertures."""
    fusion: Annotated[ApertureOptions, arg(name="")] = dataclasses.field(default_factory=ApertureOptions)
    overwrite: bool = False
    """If OUT holds a finished result of other options, make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import fuse_aperture_capture
        from colmap_inertial.run.steps.workspace import Workspace

        options = FuseAperturesOptions(fusion=self.fusion, refocus=self.refocus, lens_width=self.lens_width)
        self.check_json(self.capture)
        with self.progress() as screen:
            written = fuse_aperture_capture(self.capture, self.out, options, overwrite=self.overwrite, progress=screen)
        lines = [f"{len(written)} images in {self.out / 'images'}"]
        self.tell(
            lambda: show_fused(lines, screen),
            Workspace(self.out).result,
            {"out": self.out, "unchanged": screen.unchanged},
        )
        return 0
