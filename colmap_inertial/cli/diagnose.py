"""Arguments of ``colmap-inertial diagnose``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from tyro.conf import Positional

from colmap_inertial.cli.command import SourceCommand
from colmap_inertial.cli.terminal import show_diagnosis, show_table
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact

#: Errors that a description of the table answers.
_TABLE_CODES = ("table-unclear", "table-open")


@dataclass(frozen=True, kw_only=True)
class Diagnose(SourceCommand):
    """Find problems of a recording, before any reconstruction.

    Each finding says what to do. Exit code 1 when something makes a scale wrong or impossible, 0 when nothing is worse
    than a warning.

    Example: colmap-inertial diagnose my_capture/capture.toml --json findings.json
    """

    common: ClassVar = ("imu", "frame_times", "json")

    source: Positional[Path]
    """What would be reconstructed: a capture.toml, a video or a recorder's folder. Or an IMU recording alone; or a
    COLMAP model folder, TUM trajectory or InertialScale folder."""
    capture: Path | None = None
    """For a table of samples: write the capture.toml that describes it, with "?" for what the table does not state."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.diagnose import describe_table, diagnose_source

        report = describe_table(self.read_from(), self.capture) if self.imu is None else None
        if report is not None and self.talks:
            show_table(report, self.capture)
        try:
            with self.progress() as progress:
                diagnosis = diagnose_source(self.read_from(), json=self.json_file, progress=progress)
        except InertialError as error:
            if report is None or not self.talks or error.code not in _TABLE_CODES:
                raise
            raise InertialError(Fact("table-described-above", source=self.source, found=error.fact)) from None
        self.tell(lambda: show_diagnosis(diagnosis, self.source), diagnosis.as_json(), written=True)
        return 1 if diagnosis.worst == "error" else 0
