"""Arguments of ``colmap-inertial deblur``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_deblurred
from colmap_inertial.core.options import BlurRemover, DeblurPurpose


@dataclass(frozen=True, kw_only=True)
class Deblur(ReadingCommand):
    """Undo the motion blur of images by the gyroscope.

    Writes OUT/images with the frames' names, sizes, formats and metadata, and OUT/result.json with what happened to
    each of them and why. Frames that are sharp, or in which the gyroscope's blur does not show, are copied as they
    are. Exit code 3 where the gyroscope does not belong to the pixels, as in stabilised video.

    Example: colmap-inertial deblur my_capture/capture.toml out --sheet before_after.png
    """

    resumes: ClassVar = True

    capture: Positional[Path]
    """A capture.toml, a folder that holds one, or an EuRoC/ASL dataset; with exposure times."""
    out: Positional[Path]
    """A new folder for the results, or that of an earlier run on the same capture, which is continued."""
    method: BlurRemover = "wiener"
    """wiener: a Wiener filter along the path of each pixel. path: along the same path, a filter that expects few and
    strong edges (slower). deepgyro: a network, which is also given the result of a filter (slower;
    needs the extra `restore`)."""
    purpose: Annotated[DeblurPurpose, arg(name="for")] = "viewing"
    """viewing: as sharp as the method makes them. matching: smoothed a little, as `reconstruct` shows them to
    COLMAP."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""
    rectify: bool = False
    """Undo the rolling shutter, too (needs its readout time); OUT/colmap/images are those with it."""
    sheet: Path | None = None
    """Write a PNG with parts of the most blurred frames before and after."""
    overwrite: bool = False
    """If OUT holds a finished result of other options, make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import deblur_capture

        self.check_json(self.capture)
        with self.progress() as progress:
            result = deblur_capture(
                self.capture,
                self.out,
                method=self.method,
                purpose=self.purpose,
                calibration=self.calibration,
                rectify=self.rectify,
                sheet=self.sheet,
                overwrite=self.overwrite,
                progress=progress,
            )
        self.tell(
            lambda: show_deblurred(result), result.workspace.result, {"out": self.out, "unchanged": result.unchanged}
        )
        return 0
