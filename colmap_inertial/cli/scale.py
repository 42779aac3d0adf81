"""Arguments of ``colmap-inertial scale``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import arg

from colmap_inertial.cli.command import DeviceCommand, SourceCommand
from colmap_inertial.cli.terminal import show_scale
from colmap_inertial.core.options import ScaleOptions


@dataclass(frozen=True, kw_only=True)
class Scale(DeviceCommand, SourceCommand):
    """Metres per unit of an existing model or trajectory.

    SOURCE is a COLMAP model folder (needs --imu, and --frame-times or --name-times), a trajectory in TUM
    format (needs --imu), or an InertialScale folder. Exit code 3 when the recording does not determine the scale; the
    reasons say why.

    Example: colmap-inertial scale project/sparse/0 --imu imu.csv --frame-times frames.csv --json scale.json
    """

    common: ClassVar = ("imu", "frame_times", "name_times", "calibration", "json")

    first_s: float | None = None
    """Use only this many seconds from the start of the camera's recording, and the IMU's samples around them."""
    force: bool = False
    """Continue where `diagnose` finds an error; the scale is then weak at most."""
    options: Annotated[ScaleOptions, arg(name="")] = dataclasses.field(default_factory=ScaleOptions)
    config: Path | None = None
    """TOML file as OUT/config.toml of a reconstruction: only its [scale] table is used; options given here
    override it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.first_s is not None and not self.first_s > 0:
            raise ValueError(f"first_s must be positive, not {self.first_s:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.scale import scale_as_json, scale_source

        calibration = self.add_remembered(self.calibration, self.imu or self.source)
        source = self.read_from(calibration)
        estimate = scale_source(source, self.options, json=self.json_file, first_s=self.first_s, force=self.force)
        self.tell(
            lambda: show_scale(estimate, self.source), scale_as_json(estimate, calibration, self.source), written=True
        )
        return 3 if estimate.verdict == "refused" else 0
