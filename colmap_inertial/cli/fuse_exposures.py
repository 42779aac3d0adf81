"""Arguments of ``colmap-inertial fuse-exposures``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from tyro.conf import Positional

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_fused
from colmap_inertial.core.options import ExposureOptions


@dataclass(frozen=True, kw_only=True)
class FuseExposures(ReadingCommand):
    """Make one clean, sharp image of each short and long exposure.

    The long one is brought to the short one's geometry, by the gyroscope where there is one and by the pixels; a
    network makes one image of the two (needs the extra `restore`). Writes OUT/images with the short ones' names,
    sizes, formats and metadata, as bright as the long ones, and OUT/result.json with what was done to each.

    Example: colmap-inertial fuse-exposures my_capture/capture.toml out --fusion mertens
    """

    resumes: ClassVar = True

    capture: Positional[Path]
    """A capture.toml with [images] and [exposures], or a folder that holds one; times and an IMU are optional."""
    out: Positional[Path]
    """A new folder, or that of an earlier run on the same capture, which is continued."""
    fusion: Literal["none", "mertens"] = "none"
    """Blend the fused image with the short exposure, which shows what clips in the long one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What the network runs on; auto: CUDA where onnxruntime has it."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""
    overwrite: bool = False
    """If OUT holds a finished result of other options, make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import fuse_exposure_capture
        from colmap_inertial.run.steps.workspace import Workspace

        options = ExposureOptions(fusion=self.fusion, device=self.device)
        self.check_json(self.capture)
        with self.progress() as screen:
            pairs = fuse_exposure_capture(
                self.capture,
                self.out,
                options,
                calibration=self.calibration,
                overwrite=self.overwrite,
                progress=screen,
            )
        fused = sum(pair.fused for pair in pairs)
        lines = [f"{fused} of {len(pairs)} pairs fused in {self.out / 'images'}"]
        lines += [f"{pair.name} {pair.reason}" for pair in pairs if not pair.fused]
        self.tell(
            lambda: show_fused(lines, screen),
            Workspace(self.out).result,
            {"out": self.out, "unchanged": screen.unchanged},
        )
        return 0
