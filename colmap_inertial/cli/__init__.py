"""The command line: arguments, one call each, errors as one line. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import itertools
import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from tyro.conf import subcommand

from colmap_inertial import __version__
from colmap_inertial.cli.captures import Batch, Deblur, FuseApertures, FuseExposures, Reconstruct, Simulate
from colmap_inertial.cli.help import options_of, print_help, print_overview
from colmap_inertial.cli.models import Align, Apply, CalibrateImu, Diagnose, Export, Scale, Validate, View
from colmap_inertial.cli.process import INTERRUPTED, TERMINATED, Terminated, answering_signals, require_limits
from colmap_inertial.cli.speech import Speaker, log_on_terminal, print_json
from colmap_inertial.core.errors import InertialError, describe_environment_fault, fact_of
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import ProjectOptions, ReadLimits, ReconstructOptions, ReferenceOptions
from colmap_inertial.core.printing import say

DESCRIPTION = """Metric, gravity-aligned COLMAP models from the gyroscope and accelerometer recorded beside the images.

Begin with `colmap-inertial diagnose CAPTURE`, which checks a recording within a minute; then `colmap-inertial
reconstruct CAPTURE OUT`.

Exit codes: 0 done, 1 a check failed, 2 bad input, 3 not observable (scale refused), 4 mapping failed, 5 target not
found, 130 interrupted.

--version prints the version; --tyro-print-completion bash (zsh, tcsh) a script that completes names and options."""

#: Values of positional arguments go by their names; an option that is not given is left out, not given as None.
_CONFIG = (tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)

#: By what they begin with.
_GROUPS: dict[str, dict[str, type[Speaker]]] = {
    "From a recording to metres": {
        "diagnose": Diagnose,
        "reconstruct": Reconstruct,
        "batch": Batch,
        "simulate": Simulate,
    },
    "With a model that exists": {"scale": Scale, "apply": Apply, "validate": Validate, "view": View, "export": Export},
    "Calibrate a device": {"align": Align, "calibrate-imu": CalibrateImu},
    "Images only": {"deblur": Deblur, "fuse-apertures": FuseApertures, "fuse-exposures": FuseExposures},
}
_COMMANDS: dict[str, type[Speaker]] = {name: cls for group in _GROUPS.values() for name, cls in group.items()}
#: Options that most people use, by field; in the help they come first. Without an entry all do, in their order.
_COMMON: dict[str, tuple[str, ...]] = {
    "reconstruct": ("dense", "calibration", "deblur", "rolling_shutter", "world", "config", "force", "overwrite"),
    "batch": ("workers", "config", "dense", "allow_stages", "overwrite"),
    "scale": ("imu", "frame_times", "calibration", "json"),
    "align": ("imu", "frame_times", "out", "remember"),
    "diagnose": ("imu", "frame_times", "json"),
    "validate": ("images", "target", "tolerance", "pictures"),
    "calibrate-imu": ("out", "latitude_deg", "height_m", "remember"),
    "fuse-apertures": ("refocus", "lens_width", "depth", "disparity_px"),
    "apply": ("scale", "factor", "sim3", "undo", "world"),
    "export": ("program", "images", "model"),
}
_HELP, _HELP_ALL = ("-h", "--help"), "--help-all"
#: Options that take several values, and what is said where none follows.
_LISTS = {
    "--calibration": "calibration-takes-files",
    "--colmap": "colmap-takes-settings",
}
_SETTING = re.compile(r"\w+\.\w+=")


def parse(args: Sequence[str]) -> Speaker:
    """The command that the arguments describe; exits with code 2 and a message when they describe none.

    ``--help`` prints its page and exits with code 0.

    Raises
    ------
    FormatError
        For a ``--config`` file that cannot be read.
    InertialError
        For ``--calibration`` without a file, for a command or an option that there is not, with the nearest one, and
        for ``--quiet`` with ``--verbose``.
    """
    if not args or args[0] in (*_HELP, _HELP_ALL):
        print_overview(DESCRIPTION, _GROUPS, ReadLimits)
        sys.exit(0 if args else 2)
    name = args[0].replace("_", "-")
    if name in _COMMANDS and any(word in (*_HELP, _HELP_ALL) for word in args[1:]):
        titles = {
            ProjectOptions: "An existing COLMAP project in place of a capture",
            ReferenceOptions: "Metres without an IMU",
        }
        common, everything = _COMMON.get(name, ()), _HELP_ALL in args[1:]
        print_help(name, _COMMANDS[name], common, titles, Speaker, everything=everything)
        sys.exit(0)
    args = [*args[:1], *_expand_options(args)]
    _require_known(args)
    choices: list[Any] = []
    for name, cls in _COMMANDS.items():
        default = _read_default(cls, args) if list(args[:1]) == [name] else None
        settings = subcommand(name) if default is None else subcommand(name, default=default)
        choices.append(Annotated[cls, settings])
    args = _move_lists_last(args)
    command: Any = Union[tuple(choices)]  # noqa: UP007 (built at run time)
    made: Speaker = tyro.cli(command, prog="colmap-inertial", description=DESCRIPTION, args=list(args), config=_CONFIG)
    if made.quiet and made.verbose:
        raise InertialError(Fact("quiet-and-verbose"))
    return made


def _expand_options(args: Sequence[str]) -> list[str]:
    """Complete the abbreviated options after the command.

    The name of an option's group may be left out, and may stand where there is none: ``--latitude-deg`` and
    ``--scale.latitude-deg`` are the same in every command.

    Raises
    ------
    InertialError
        For an option that belongs to several groups.
    """
    command = args[0].replace("_", "-")
    if command not in _COMMANDS:
        return list(args[1:])
    options = _options(command)
    words = []
    for word in args[1:]:
        name, equals, value = word.partition("=")
        plain = "--" + name.removeprefix("--").replace("_", "-")
        if name.startswith("--") and len(name) > 2 and plain not in options:
            last = plain.rpartition(".")[2].removeprefix("--")
            meant = [option for option in options if option.rpartition(".")[2].removeprefix("--") == last]
            if len(meant) > 1:
                raise InertialError(Fact("option-ambiguous", command=args[0], options=meant, name=name))
            grouped = "." in plain and "." in "".join(meant)
            word = f"{meant[0]}{equals}{value}" if meant and not grouped else word
        words.append(word)
    return words


def _require_known(args: Sequence[str]) -> None:
    """Refuse a command or an option that there is not, also where something else is missing."""
    if not args or args[0].startswith("-"):
        if args and args[0] not in (*_HELP, "--version", "--tyro-print-completion"):
            raise InertialError(Fact("command-comes-first", word=args[0]))
        return
    command = args[0].replace("_", "-")
    if command not in _COMMANDS:
        raise InertialError(Fact("no-such-command", word=args[0], nearest=_find_nearest(args[0], _COMMANDS)))
    words = [word.partition("=")[0] for word in args[1:] if word.startswith("--") and word != "--"]
    options = _options(command)
    for word in words:
        if word.replace("_", "-") not in options:
            raise InertialError(
                Fact("no-such-option", command=args[0], option=word, nearest=_find_nearest(word, options))
            )


@functools.cache
def _options(command: str) -> tuple[str, ...]:
    """All options of a command, and the other form of each switch."""
    options = ["--tyro-print-completion"]
    for option in options_of(_COMMANDS[command], with_text=False):
        if option.positional:
            continue
        first = option.names[0]
        at = first.rfind(".") + 1 or 2
        options += [first] if option.value else [first, f"{first[:at]}no-{first[at:]}"]
    return tuple(options)


def _find_nearest(word: str, choices: Iterable[str]) -> str | None:
    like = difflib.get_close_matches(word, list(choices), n=1)
    return like[0] if like else None


def _move_lists_last(args: Sequence[str]) -> list[str]:
    """The same with what follows ``--calibration`` and ``--colmap`` at the end, where it swallows no path.

    The first takes one file, and a second one where that is another JSON file; the other takes settings. Each may be
    given several times.
    """
    rest, remaining = list[str](), list(args)
    lists: dict[str, list[str]] = {"--calibration": [], "--colmap": []}
    while remaining:
        word, equals, value = remaining[0].partition("=")
        if word not in lists:
            rest.append(remaining.pop(0))
            continue
        remaining[:1] = [value] if equals else []
        if not remaining or remaining[0].startswith("--"):
            raise InertialError(Fact(_LISTS[word]))
        lists[word].append(remaining.pop(0))
        while remaining and (
            remaining[0].lower().endswith(".json") if word == "--calibration" else _SETTING.match(remaining[0])
        ):
            lists[word].append(remaining.pop(0))
    return [*rest, *(argument for word, values in lists.items() if values for argument in (word, *values))]


def _read_default(cls: type[Speaker], args: Sequence[str]) -> Speaker | None:
    """The command with its options from ``--config``, so that flags go before the file and the file before defaults."""
    from colmap_inertial.run.steps.config import read_config

    given = [word.partition("=")[2] for word in args if word.startswith("--config=")]
    given += [value for word, value in itertools.pairwise(args) if word == "--config"]
    if not given or cls not in (Reconstruct, Scale, Batch):
        return None
    options: Any = read_config(Path(given[-1]), ReconstructOptions)
    if cls is Scale:
        options = options.scale
    missing = dataclasses.MISSING
    required = [f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is missing]
    return cls(**dict.fromkeys(required, tyro.MISSING), options=options)


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
        resumes = isinstance(command, Reconstruct | Deblur | FuseApertures | FuseExposures | Batch)
        again = "; started again with the same arguments, it continues" if resumes else ""
        say(f"interrupted{again}", error=True)
        code = TERMINATED if isinstance(stop, Terminated) else INTERRUPTED
    except (MemoryError, OSError, ImportError, RuntimeError) as error:
        reason = describe_environment_fault(error)
        if reason is None:
            raise
        say(f"error: {reason.with_advice}", error=True)
        code = 2
    sys.exit(code)
