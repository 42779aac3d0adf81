"""Arguments of ``colmap-inertial calibrate-imu``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_compared, show_imu_calibration
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import GravityOptions


@dataclass(frozen=True, kw_only=True)
class CalibrateImu(ReadingCommand):
    """Gains, misalignments and biases of an IMU, from a recording in which it lay still in twelve attitudes or more.

    Start the recording, lay the device still on its six sides, then leaning on six of its edges (a box or a book
    helps), five seconds each, and turn it over in between; no tools, no right angles. The rests are found by
    themselves. From nine attitudes on everything is determined; with six to eight, the misalignments are not; with
    fewer, exit code 3. Give the latitude: the gains are no better than the strength of gravity is known.

    The calibration file serves --calibration for recordings of the same device, beside that of align; a scale's
    interval then no longer has to allow for an unknown gain of the accelerometer. A page with the residuals of each
    rest is written beside it. Calibrate again after a year, or where the device is much warmer or colder.

    Without such a recording, results that contain a target do as well: give their output folders, each of another
    recording of the device. The less their scales and the target differ, the narrower are later intervals.

    Example: colmap-inertial calibrate-imu rests.csv --latitude-deg 47.4 --height-m 400 --out phone_imu.json
    """

    common: ClassVar = ("out", "latitude_deg", "height_m", "remember")

    recording: Positional[tuple[Path, ...]]
    """IMU recording (a file or folder of a known format, or a capture.toml), or output folders of `reconstruct`. These
    must be of captures with a [target] whose size is stated with its standard deviation (+-)."""
    out: Path
    """Where to write the calibration (JSON); of a recording, a page of the same name, ending in .html, is put beside
    it."""
    gravity: Annotated[GravityOptions, arg(name="")] = dataclasses.field(default_factory=GravityOptions)
    remember: str | None = None
    """Remember the calibration under this device name; `reconstruct` and `scale` then use it automatically."""

    def __post_init__(self) -> None:
        if not self.recording:
            raise ValueError("name the recording, or results that have a target")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        self.check_json(*self.recording, self.out)
        compares_results = len(self.recording) > 1 or (self.recording[0] / "result.json").is_file()
        return self._compare_results() if compares_results else self._fit_rests(self.recording[0])

    def _compare_results(self) -> int:
        from colmap_inertial.run.commands.calibrate_imu import calibrate_from_results

        if self.gravity != GravityOptions():
            raise InertialError(Fact("gravity-is-of-rests"))
        calibration = calibrate_from_results(self.recording, self.out, device=self.remember or "")
        kept = self._remember()
        self.tell(lambda: show_compared(calibration, self.out, kept), self.out, {"out": self.out, "kept": kept})
        return 0

    def _fit_rests(self, recording: Path) -> int:
        from colmap_inertial.run.commands.calibrate_imu import calibrate_source

        calibration = calibrate_source(recording, self.out, self.gravity, device=self.remember)
        kept = self._remember()
        self.tell(
            lambda: show_imu_calibration(calibration, recording, self.out, kept),
            self.out,
            {"out": self.out, "kept": kept, "verdict": calibration.verdict},
        )
        return 0

    def _remember(self) -> Path | None:
        from colmap_inertial.run.commands.calibrate_imu import remember

        return None if self.remember is None else remember(self.remember, self.out)
