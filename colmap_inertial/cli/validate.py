"""Arguments of ``colmap-inertial validate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from tyro.conf import Positional

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_validation
from colmap_inertial.core.options import ValidateOptions


@dataclass(frozen=True, kw_only=True)
class Validate(ReadingCommand):
    """Compare the size of a model with a known target in its images.

    TARGET is checkerboard:COLSxROWS:SQUARE_M (inner corners), charuco:COLSxROWS:SQUARE_M:MARKER_M:DICT (squares),
    aprilgrid:COLSxROWS:TAG_M:GAP (GAP = gap / tag), or aruco:DICT:SIDE_M; +- after the length says how well it is known
    (standard deviation), as in checkerboard:8x6:0.03+-0.0001. Exit code 0 within the tolerance, 1 outside
    it, 5 when the target is not found.

    Example: colmap-inertial validate out/sparse/0 --images out/images --target checkerboard:8x6:0.03
    """

    common: ClassVar = ("images", "target", "tolerance", "pictures")

    model: Positional[Path]
    """COLMAP model folder."""
    images: Path
    """Folder with the model's images (OUT/images of a reconstruction)."""
    target: str
    """What to look for: checkerboard:COLSxROWS:SQUARE_M (inner corners), or a charuco, aprilgrid or aruco target
    (--help-all has their forms)."""
    pictures: Path | None = None
    """Folder for frames with the corners drawn in and a plot of the distances."""
    tolerance: float = 2.0
    """Largest scale error that passes, in per cent."""
    unscaled: bool = False
    """The model is not in metres: report the factor that makes it metric. Passes where enough images and all
    lengths agree."""
    apply: Path | None = None
    """With --unscaled: a new folder for the model in metres, scaled by the control distances alone."""
    bars: Path | None = None
    """Scale bars: a CSV with marker_a,marker_b,length_m of single markers and, where known, sigma_m."""
    check_points: Path | None = None
    """Check points: a CSV with marker,x,y,z of single markers in metres and, where known, sigma_m."""
    other_target: tuple[str, str] | None = None
    """A second board in the scene, as of --target, and the metres between the middles of both, as in 4.03+-0.002."""

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < 100:
            raise ValueError(f"tolerance must be from 0 to 100 per cent, not {self.tolerance:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.validate import KnownLengths, ValidationOutputs, validate_source

        result = validate_source(
            self.model,
            self.images,
            self.target,
            ValidateOptions(tolerance_pct=self.tolerance, unscaled=self.unscaled),
            ValidationOutputs(json=self.json_file, pictures=self.pictures, apply=self.apply),
            KnownLengths(bars=self.bars, check_points=self.check_points, other=self.other_target),
        )
        self.tell(lambda: show_validation(result), result.as_json(), written=True)
        return 0 if result.within_tolerance else 1
