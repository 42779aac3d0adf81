"""Arguments of ``colmap-inertial align``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from colmap_inertial.cli.command import SourceCommand
from colmap_inertial.cli.terminal import show_calibration


@dataclass(frozen=True, kw_only=True)
class Align(SourceCommand):
    """Rotation, time offset and gyro bias between the camera and the IMU of one device, from one recording.

    Needs no scale, only a camera that turned. The calibration file serves --calibration for later recordings of the
    same device. Exit code 3 when no time offset stands out.

    Example: colmap-inertial align project/sparse/0 --imu imu.csv --frame-times frames.csv --out phone.json
    """

    common: ClassVar = ("imu", "frame_times", "out", "remember")

    out: Path
    """Where to write the calibration (JSON)."""
    remember: str | None = None
    """Remember the calibration under this device name; `reconstruct` and `scale` then use it automatically."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.calibrate_imu import remember
        from colmap_inertial.run.commands.scale import align_source

        self.check_json(self.source, self.imu, self.frame_times, self.out)
        calibration = align_source(self.read_from(), self.out)
        kept = None if self.remember is None else remember(self.remember, self.out)
        self.tell(lambda: show_calibration(calibration, self.source, kept), self.out, {"out": self.out, "kept": kept})
        return 0
