"""Arguments of ``colmap-inertial batch``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ConfiguredCommand
from colmap_inertial.core.options import BatchOptions


@dataclass(frozen=True, kw_only=True)
class Batch(ConfiguredCommand):
    """Reconstruct many captures, each in a process of its own; one that fails does not stop the rest.

    MANIFEST is a TOML file with a [[capture]] table for each: path (from the manifest's folder), and optionally name,
    config (a TOML file with options), options, project, reference (a known distance or target
    beside the IMU) and stages (with --allow-stages); or a folder in which every folder is a capture.
    Writes OUT/NAME for each capture as reconstruct does, OUT/status/NAME.json with how far it is,
    OUT/summary.csv and OUT/summary.json. Started again, it takes up what has no result yet. Exit code 0 when every
    capture is done, 1 when one is not.

    Example: colmap-inertial batch captures.toml out
    """

    common: ClassVar = ("workers", "config", "dense", "allow_stages", "overwrite")
    resumes: ClassVar = True

    manifest: Positional[Path]
    """A TOML file that lists captures, or a folder of captures."""
    out: Positional[Path]
    """A new folder, or that of an earlier run."""
    batch: Annotated[BatchOptions, arg(name="")] = dataclasses.field(default_factory=BatchOptions)
    allow_stages: bool = False
    """Import and run the stages that the manifest names: they are code of the manifest's author."""
    config: Path | None = None
    """TOML file with options for all captures; options given here override it, the manifest's override both."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.batch import run_batch
        from colmap_inertial.tools.batch.terminal import live_batch, show_batch

        self.check_json(self.manifest)
        with live_batch(quiet=self.quiet) as watch:
            result = run_batch(
                self.manifest, self.out, self.options, batch=self.batch, watch=watch, allow_stages=self.allow_stages
            )
        code, file = result.exit_code(), self.out / "summary.json"
        self.tell(lambda: show_batch(result), file, {"out": self.out, "unchanged": result.unchanged, "exit_code": code})
        return code
