"""Base classes of the commands: the options that several have, and the output of all.

Text for people, JSON for scripts, nothing, or the whole log.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import Positional, arg, create_mutex_group

from colmap_inertial.cli.screen import Screen, live_progress
from colmap_inertial.core.options import ReadLimits, ReconstructOptions
from colmap_inertial.core.printing import PrintableFormatter, say

if TYPE_CHECKING:
    from colmap_inertial.run.commands.scale import ScaleSource

#: ``--json -``.
_STANDARD_OUTPUT = Path("-")
_LOUDNESS = create_mutex_group(required=False)


@dataclass(frozen=True, kw_only=True)
class Command:
    """The options that all commands have. Errors go to standard error, whatever they say.

    Attributes
    ----------
    common
        Fields whose options ``--help`` shows, in this order; without any, it shows all.
    topics
        Titles of ``--help-all`` for the other options, and the fields (or groups of them) below each.
    resumes
        Whether it continues where an interruption ended it.
    """

    common: ClassVar[tuple[str, ...]] = ()
    topics: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    resumes: ClassVar[bool] = False

    json: Path | None = None
    """Also write the result as JSON there; - is standard output, which then holds nothing else."""
    quiet: Annotated[bool, _LOUDNESS] = False
    """Print errors only: no progress, no findings, no result."""
    verbose: Annotated[bool, _LOUDNESS] = False
    """Also print the log."""

    if TYPE_CHECKING:  # a field of some commands, computed by others

        @property
        def limits(self) -> ReadLimits:
            """Limits on the size of files."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        raise NotImplementedError

    @property
    def answers_in_json(self) -> bool:
        """Whether standard output is for a program."""
        return self.json == _STANDARD_OUTPUT

    @property
    def talks(self) -> bool:
        """Whether standard output is for a person."""
        return not self.quiet and not self.answers_in_json

    @property
    def json_file(self) -> Path | None:
        """The file that the result is wanted in."""
        return None if self.answers_in_json else self.json

    def check_json(self, *inputs: Path | None) -> None:
        """Refuse, before the work, a file for the JSON that is an input or not of ours."""
        if self.json_file is not None:
            from colmap_inertial.run.commands.paths import check_output

            check_output(self.json_file, inputs)

    def progress(self) -> AbstractContextManager[Screen]:
        """The screen of a command that takes a while."""
        return live_progress(quiet=self.quiet, verbose=self.verbose)

    def tell(
        self,
        show: Callable[[], None],
        content: Mapping[str, Any] | Path,
        more: Mapping[str, Any] | None = None,
        *,
        written: bool = False,
    ) -> None:
        """Say how it ended.

        Parameters
        ----------
        show
            Prints it for a person.
        content
            The same for a program, or the JSON file that has it.
        more
            What the program is told besides.
        written
            Whether the file that ``--json`` names has been written already.
        """
        if isinstance(content, Path):
            from colmap_inertial.io.files import read_json

            content = read_json(content)
        content = {**content, **(more or {})}
        if self.talks:
            show()
        if self.answers_in_json:
            print_json(content)
        elif self.json is not None and not written:
            from colmap_inertial.io.files import write_json

            write_json(self.json, content)


@dataclass(frozen=True, kw_only=True)
class ReadingCommand(Command):
    """Common options of commands without options of a reconstruction."""

    limits: ReadLimits = field(default_factory=ReadLimits)
    """Limits on files that are read."""


@dataclass(frozen=True, kw_only=True)
class ConfiguredCommand(Command):
    """Common options of commands with options of a reconstruction."""

    topics: ClassVar = {
        "An existing COLMAP project in place of a capture": (
            "imu", "frame_times", "name_times", "exif_times", "video", "images", "keep", "link", "follow_links",
        ),
        "Where metres come from": ("scale_from", "target", "between", "distance"),
        "Frame selection": ("frames",),
        "How COLMAP builds the model": (
            "mapping", "colmap", "colmap_project", "colmap_executable", "database", "database_images", "workers",
            "scheduler",
        ),
        "How metres come from the IMU": ("scale",),
        "Joining, refinement and place": ("join", "join_options", "refine", "georeference", "fragments"),
        "Dense reconstruction": ("dense_options",),
        "Remembered calibrations of a device": ("device", "remembered"),
        "Reproducible runs": ("deterministic", "seed"),
    }  # fmt: skip

    options: Annotated[ReconstructOptions, arg(name="")] = field(default_factory=ReconstructOptions)
    config: Path | None = None
    """TOML file with options, such as OUT/config.toml of an earlier run; options given here override it, or
    add to it where they may be repeated."""

    @property
    def limits(self) -> ReadLimits:
        """Limits on the size of files."""
        return self.options.limits


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """Common options of commands that use the stored calibrations of a device."""

    device: str | None = None
    """Device name that --remember was given (default: the name in the recording)."""
    remembered: bool = True
    """Use the calibrations that `align` and `calibrate-imu` kept of the device by --remember, where neither
    --calibration nor the capture gives one; never with --deterministic."""

    def add_remembered(self, calibration: tuple[Path, ...], recording: Path) -> tuple[Path, ...]:
        """These calibrations, and those kept of the recording's device."""
        if not self.remembered:
            return calibration
        from colmap_inertial.run.commands.calibrate_imu import read_remembered

        kept = read_remembered(recording, calibration, device=self.device)
        if self.talks:
            for path, kind in kept.files:
                say(f'{kept.device}: uses the remembered calibration "{kind}", {path} (--no-remembered leaves it out)')
        return (*calibration, *kept.paths)


@dataclass(frozen=True, kw_only=True)
class SourceCommand(ReadingCommand):
    """Common options of commands that read camera poses and the IMU recorded with them."""

    source: Positional[Path]
    """COLMAP model folder, trajectory in TUM format (a text file of t x y z qx qy qz qw), or InertialScale folder (text
    files of camera and IMU)."""
    imu: Path | None = None
    """IMU recording: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml."""
    name_times: str | None = None
    """Times are in the file names: the unit (s, ms, us, ns) of the longest number, its place as in
    cam0_{ns}_*, or a date as in PXL_%Y%m%d_%H%M%S%f."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""

    def __post_init__(self) -> None:
        if self.frame_times is not None and self.name_times is not None:
            raise ValueError("give one of --frame-times and --name-times")

    def read_from(self, calibration: tuple[Path, ...] | None = None) -> ScaleSource:
        """Source of poses and IMU, with these calibrations or the given ones."""
        from colmap_inertial.run.commands.scale import ScaleSource

        files = self.calibration if calibration is None else calibration
        return ScaleSource(
            source=self.source,
            imu=self.imu,
            frame_times=self.frame_times,
            name_times=self.name_times,
            calibration=files,
        )


def print_json(content: Mapping[str, Any]) -> None:
    """Print one JSON object."""
    from colmap_inertial.io.files import convert_to_plain

    print(json.dumps(convert_to_plain(content), indent=1, allow_nan=False))


class _StandardError(logging.StreamHandler[Any]):
    """Writes to whatever standard error is at that time, which a bar may have taken over."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(PrintableFormatter("%H:%M:%S"))

    @property
    def stream(self) -> Any:
        return sys.stderr

    @stream.setter
    def stream(self, _: Any) -> None:
        """The stream that the parent class stores."""


@contextlib.contextmanager
def log_on_terminal() -> Iterator[None]:
    """This package's log on standard error."""
    logger = logging.getLogger("colmap_inertial")
    handler, level = _StandardError(), logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
