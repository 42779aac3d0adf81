"""The command line: arguments, one call each, errors as one line. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import dataclasses
import difflib
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import subcommand

from colmap_inertial import __version__
from colmap_inertial.cli.captures import Batch, Deblur, FuseApertures, FuseExposures, Reconstruct, Simulate
from colmap_inertial.cli.limits import exhausted, require_limits
from colmap_inertial.cli.models import Align, Apply, CalibrateImu, Diagnose, Export, Scale, Validate, View
from colmap_inertial.errors import InertialError
from colmap_inertial.options import ReconstructOptions

DESCRIPTION = """Metric, gravity-aligned COLMAP models from the gyroscope and accelerometer that filmed along.

Exit codes: 0 done, 1 a check failed, 2 bad input, 3 not observable (scale refused), 4 mapping failed,
5 target not found.

--version prints the version; --tyro-print-completion bash (zsh, tcsh) a script that completes names and options."""

#: Values of positional arguments go by their names; an option that is not given is left out, not given as None.
_CONFIG = (tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)

Command = (
    Reconstruct
    | Scale
    | Apply
    | Align
    | CalibrateImu
    | Diagnose
    | Validate
    | View
    | Export
    | Deblur
    | FuseApertures
    | FuseExposures
    | Batch
    | Simulate
)
_COMMANDS: dict[str, type[Command]] = {
    "reconstruct": Reconstruct,
    "scale": Scale,
    "apply": Apply,
    "align": Align,
    "calibrate-imu": CalibrateImu,
    "diagnose": Diagnose,
    "validate": Validate,
    "view": View,
    "export": Export,
    "deblur": Deblur,
    "fuse-apertures": FuseApertures,
    "fuse-exposures": FuseExposures,
    "batch": Batch,
    "simulate": Simulate,
}


def parse(args: Sequence[str]) -> Command:
    """The command that the arguments describe; exits with code 2 and a message when they describe none.

    Raises
    ------
    FormatError
        For a ``--config`` file that cannot be read.
    InertialError
        For ``--calibration`` without a file, and for a command or an option that there is not, with the nearest one.
    """
    _require_known(args)
    choices: list[Any] = []
    for name, cls in _COMMANDS.items():
        default = _default_from_config(cls, args) if list(args[:1]) == [name] else None
        settings = subcommand(name) if default is None else subcommand(name, default=default)
        choices.append(Annotated[cls, settings])
    args = _calibrations_last(args)
    command: Any = Union[tuple(choices)]  # noqa: UP007 (built at run time)
    return tyro.cli(command, prog="colmap-inertial", description=DESCRIPTION, args=list(args), config=_CONFIG)


def _require_known(args: Sequence[str]) -> None:
    """Refuse a command or an option that there is not, also where something else is missing."""
    if not args or args[0].startswith("-"):
        return
    cls = _COMMANDS.get(args[0].replace("_", "-"))
    if cls is None:
        raise InertialError(f"there is no command {args[0]}{_nearest(args[0], _COMMANDS)} (--help lists them)")
    words = [word.partition("=")[0] for word in args[1:] if word.startswith("--") and word != "--"]
    if not words or "--help" in words:
        return
    options = _options(cls)
    for word in words:
        if word.replace("_", "-") not in options:
            raise InertialError(
                f"{args[0]} has no option {word}{_nearest(word, options)} ({args[0]} --help lists them)"
            )


def _options(cls: type[Any], prefix: str = "") -> list[str]:
    """All options of a command, as tyro names those of its fields."""
    options = ["--tyro-print-completion"]
    for field, hint in get_type_hints(cls, include_extras=True).items():
        kind, *settings = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        named = [setting.name for setting in settings if getattr(setting, "name", None) is not None]
        name = named[0] if named else field.replace("_", "-")
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            options += _options(kind, f"{prefix}{name}." if name else prefix)
        else:
            options += [f"--{prefix}{name}", *([f"--{prefix}no-{name}"] if bool in (kind, *get_args(kind)) else [])]
    return options


def _nearest(word: str, known: Iterable[str]) -> str:
    like = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {like[0]}?" if like else ""


def _calibrations_last(args: Sequence[str]) -> list[str]:
    """The same with what follows ``--calibration`` at the end, where it does not swallow the paths of the command.

    It takes one file, and a second one where that is another JSON file.
    """
    rest: list[str] = []
    files: list[str] = []
    remaining = list(args)
    while remaining:
        word = remaining.pop(0)
        if word != "--calibration":
            rest.append(word)
            continue
        if not remaining or remaining[0].startswith("--"):
            raise InertialError("--calibration takes a file, or two: from `align --out`, from `calibrate-imu --out`")
        files.append(remaining.pop(0))
        while remaining and remaining[0].lower().endswith(".json"):
            files.append(remaining.pop(0))
    return [*rest, "--calibration", *files] if files else rest


def _default_from_config(cls: type[Command], args: Sequence[str]) -> Command | None:
    """The command with its options from ``--config``, so that flags go before the file and the file before defaults."""
    from colmap_inertial.run.config import read_config

    path = None
    for i, text in enumerate(args):
        if text == "--config" and i + 1 < len(args):
            path = args[i + 1]
        elif text.startswith("--config="):
            path = text.removeprefix("--config=")
    if path is None or cls not in (Reconstruct, Scale, Batch):
        return None
    fields = {f.name: f for f in dataclasses.fields(cls)}
    options: Any = read_config(Path(path), ReconstructOptions)
    if cls is Scale:
        options = options.scale
    required = {
        name: tyro.MISSING for name, f in fields.items() if f.default is f.default_factory is dataclasses.MISSING
    }
    return cls(options=options, **required)


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
        command = parse(args)
    except (InertialError, ValueError) as error:  # options check their own values when they are built
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    from colmap_inertial.io.limits import reading_within

    try:
        require_limits()
        with reading_within(command.limits):
            code = command.run()
    except InertialError as error:
        print(f"error: {error}", *getattr(error, "__notes__", ()), sep="\n", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        resumes = isinstance(command, Reconstruct | Deblur | FuseApertures | FuseExposures | Batch)
        again = "; started again with the same arguments, it continues" if resumes else ""
        print(f"interrupted{again}", file=sys.stderr)
        code = 130
    except (MemoryError, OSError, ImportError, RuntimeError) as error:
        said = exhausted(error)
        if said is None:
            raise
        print(f"error: {said}", file=sys.stderr)
        code = 2
    sys.exit(code)
