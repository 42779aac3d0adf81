"""The command line: each command's arguments in a file named like it, one call each, errors as one line.

Nothing heavy is imported before a command runs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from colmap_inertial import __version__
from colmap_inertial.cli.align import Align
from colmap_inertial.cli.apply import Apply
from colmap_inertial.cli.batch import Batch
from colmap_inertial.cli.calibrate_imu import CalibrateImu
from colmap_inertial.cli.command import Command, log_on_terminal, print_json
from colmap_inertial.cli.deblur import Deblur
from colmap_inertial.cli.diagnose import Diagnose
from colmap_inertial.cli.export import Export
from colmap_inertial.cli.fuse_apertures import FuseApertures
from colmap_inertial.cli.fuse_exposures import FuseExposures
from colmap_inertial.cli.help import list_options, print_help, print_overview
from colmap_inertial.cli.process import INTERRUPTED, TERMINATED, Terminated, answering_signals, require_limits
from colmap_inertial.cli.reconstruct import Reconstruct
from colmap_inertial.cli.scale import Scale
from colmap_inertial.cli.simulate import Simulate
from colmap_inertial.cli.validate import Validate
from colmap_inertial.cli.view import View
from colmap_inertial.core.choices import check_value
from colmap_inertial.core.errors import InertialError, describe_environment_fault, fact_of
from colmap_inertial.core.facts import with_sentences
from colmap_inertial.core.options import ReadLimits, ReconstructOptions
from colmap_inertial.core.printing import say

DESCRIPTION = """Metric, gravity-aligned COLMAP models from the gyroscope and accelerometer recorded beside the images.

Begin with `colmap-inertial diagnose CAPTURE`, which checks a recording within a minute; then `colmap-inertial
reconstruct CAPTURE OUT`.

Exit codes: 0 done, 1 a check failed, 2 bad input, 3 not observable (scale refused), 4 mapping failed, 5 target not
found, 130 interrupted.

--version prints the version; --tyro-print-completion bash (zsh, tcsh) a script that completes names and options."""

#: The commands, by what they begin with.
GROUPS: dict[str, dict[str, type[Command]]] = {
    "From a recording to metres": {
        "diagnose": Diagnose,
        "reconstruct": Reconstruct,
        "batch": Batch,
    },
    "With a result": {"view": View, "export": Export, "validate": Validate},
    "With a model that exists": {"scale": Scale, "apply": Apply},
    "Images alone": {"deblur": Deblur},
    "Calibrate a device": {"align": Align, "calibrate-imu": CalibrateImu},
    "Special cameras": {"fuse-apertures": FuseApertures, "fuse-exposures": FuseExposures},
    "For developers": {"simulate": Simulate},
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}

#: Values of positional arguments go by their names; an option that is not given is left out, not given as None; one of
#: several values is given once for each, so that it swallows no path.
_CONFIG = (tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone, tyro.conf.UseAppendAction)
_HELP, _HELP_ALL = ("-h", "--help"), "--help-all"


def parse(args: Sequence[str]) -> Command:
    """The command that the arguments describe; exits with code 2 and a message when they describe none.

    ``--help`` and ``--help-all`` print their pages and exit with code 0.

    Raises
    ------
    FormatError
        For a ``--config`` file that cannot be read.
    ValueError
        For an option's value that is impossible, or options that do not go together.
    """
    if not args or args[0] in (*_HELP, _HELP_ALL):
        print_overview(DESCRIPTION, GROUPS, ReadLimits)
        sys.exit(0 if args else 2)
    name = args[0].replace("_", "-")
    if name not in COMMANDS:  # to be told which there are, or to complete what one types
        choices: list[Any] = [Annotated[each, tyro.conf.subcommand(name)] for name, each in COMMANDS.items()]
        commands: Any = Union[tuple(choices)]  # noqa: UP007 (built at run time)
        return tyro.cli(commands, prog="colmap-inertial", description=DESCRIPTION, args=args, config=_CONFIG)
    command, options, prog = COMMANDS[name], args[1:], f"colmap-inertial {name}"
    if not {*_HELP, _HELP_ALL}.isdisjoint(options):
        print_help(name, command, everything=_HELP_ALL in options)
        sys.exit(0)
    _require_choices(command, options)
    return tyro.cli(command, prog=prog, args=options, default=_read_default(command, options, prog), config=_CONFIG)


def _require_choices(command: type[Command], args: Sequence[str]) -> None:
    """Refuse a value that is not among an option's choices, in the words in which a --config file is refused.

    Raises
    ------
    ValueError
    """
    choices = {option.label.split()[0]: option.choices for option in list_options(command) if option.choices}
    for given, following in pairwise([*args, ""]):
        name, equals, value = given.partition("=")
        name = name.replace("_", "-")
        if name in choices:
            check_value(name, value if equals else following, Literal[choices[name]])


@dataclass(frozen=True)
class _WithConfig:
    """What is read of the arguments before the others: their defaults are in that file."""

    config: Path | None = None


def _read_default(command: type[Command], args: Sequence[str], prog: str) -> Any:
    """The command with its options from ``--config``, so that flags go before the file and the file before defaults."""
    if "config" not in {f.name for f in dataclasses.fields(command)}:
        return tyro.MISSING_NONPROP
    file = tyro.cli(_WithConfig, prog=prog, args=args, return_unknown_args=True, add_help=False)[0].config
    if file is None:
        return tyro.MISSING_NONPROP
    from colmap_inertial.run.steps.config import read_config

    options = read_config(file, ReconstructOptions)
    values = {f.name: tyro.MISSING for f in dataclasses.fields(command) if _is_required(f)}
    return command(**values, options=options.scale if command is Scale else options)  # type: ignore[call-arg]


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of ``colmap-inertial``."""
    try:
        try:
            _main(args)
        finally:
            sys.stdout.flush()  # here, where it can be said what a failure means
    except BrokenPipeError:
        # whoever read has enough, as `head` does: end as a program that SIGPIPE ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)


def _main(args: Sequence[str] | None) -> None:
    args = sys.argv[1:] if args is None else args
    if list(args) == ["--version"]:
        print(__version__)
        return
    try:
        require_limits(to_load=True)
        command = parse(args)
    except (InertialError, ValueError) as error:  # options check their own values when they are built
        say(f"error: {error}", error=True)
        sys.exit(2)
    from colmap_inertial.io.files import reading_within, require_utf8

    try:
        require_limits()
        require_utf8(*args)
        with contextlib.ExitStack() as around:
            if not isinstance(command, View):  # Ctrl-C is how that one ends
                around.enter_context(answering_signals())
            around.enter_context(reading_within(command.limits))
            if command.verbose:
                around.enter_context(log_on_terminal())
            code = command.run()
    except InertialError as error:
        code = error.exit_code
        if command.answers_in_json:
            print_json({**with_sentences({"error": fact_of(error)}), "error": str(error), "exit_code": code})
        say("\n".join([f"error: {error}", *getattr(error, "__notes__", ())]), error=True)
    except KeyboardInterrupt as stop:
        again = "; run the same command again to continue" if command.resumes else ""
        say(f"interrupted{again}", error=True)
        code = TERMINATED if isinstance(stop, Terminated) else INTERRUPTED
    except (MemoryError, OSError, ImportError, RuntimeError) as error:
        reason = describe_environment_fault(error)
        if reason is None:
            raise
        say(f"error: {reason.with_advice}", error=True)
        code = 2
    sys.exit(code)
