"""Files of text, JSON and YAML: limits of what is read, checks of names from outside, and writing without torn files.

A file is written to a temporary one beside it and renamed, so that a reader never meets an incomplete one. Values of
this package are written as JSON records by a run, and read back by the run that continues it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import os
import re
import secrets
import stat
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from colmap_inertial.core.errors import (
    FormatError,
    InertialError,
    OutputError,
    OutputExistsError,
    describe_environment_fault,
)
from colmap_inertial.core.facts import DETAILS, Fact, with_sentences
from colmap_inertial.core.options import ReadLimits
from colmap_inertial.core.printing import printable

if TYPE_CHECKING:
    from cattrs import Converter


#: What users may give for a path.
StrPath = str | os.PathLike[str]

_USUAL = ReadLimits()
_LIMITS: ContextVar[ReadLimits] = ContextVar("limits", default=_USUAL)


def read_limits() -> ReadLimits:
    """Those that hold here."""
    return _LIMITS.get()


@contextmanager
def reading_within(limits: ReadLimits) -> Iterator[None]:
    """Let these limits hold for all readers that are called inside, as context or decorator.

    ``reconstruct`` and ``reconstruct_project`` take theirs from their options, and ``run_batch`` from those of each
    capture.
    """
    token = _LIMITS.set(limits)
    try:
        yield
    finally:
        _LIMITS.reset(token)


#: The code of a :class:`FormatError` that the gate made, where a reader had no words of its own.
DAMAGED = "damaged"

F = TypeVar("F", bound=Callable[..., Any])


@contextmanager
def reading(path: StrPath, fault: Fact | None = None) -> Iterator[None]:
    """The gate of all readers: whatever the content of a file causes is an error that names it.

    Parameters
    ----------
    path
        What is read.
    fault
        What the message then says of it, by default that it is damaged.

    Raises
    ------
    FormatError
        With the code :data:`DAMAGED`, for any other exception than our own, those of used up memory or files, and those
        of a package that is missing or cannot be loaded.
    """
    try:
        yield
    except InertialError:
        raise
    except Exception as error:
        if describe_environment_fault(error) is not None:
            raise
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        raise FormatError(Path(path), Fact(DAMAGED, fault=fault or Fact("is-damaged"), detail=reason)) from error


def reader(what: str) -> Callable[[F], F]:
    """Decorator of a function that reads ``what`` its first argument names, through :func:`reading`."""

    def through(read: F) -> F:
        @functools.wraps(read)
        def gated(*args: Any, **kwargs: Any) -> Any:
            with reading(args[0] if args else next(iter(kwargs.values())), Fact("not-readable-as", what=what)):
                return read(*args, **kwargs)

        return typing.cast(F, gated)

    return through


_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.tmp")


def write_text(path: Path, text: str) -> None:
    """Write ``text`` (UTF-8) to ``path`` through a temporary file beside it and a rename.

    Raises
    ------
    OutputError
        Where it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "x", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(Fact("cannot-be-written", path=str(path), detail=str(error.strerror or error))) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_temporaries(*folders: Path) -> None:
    """Remove what a process that was killed within :func:`write_text` left behind, where nobody else is at work."""
    for folder in folders:
        for path in folder.glob(".*.tmp"):
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(path: Path, busy: Fact, *, wait_s: float = 0.0) -> Iterator[None]:
    """Hold the lock file ``path``; the system lets go of it when this process ends, whatever ends it.

    Raises
    ------
    OutputExistsError
        That says ``busy``, where another process still holds it after ``wait_s``.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False)
    try:
        lock.acquire(timeout=wait_s, poll_interval=0.5, blocking=wait_s > 0)
    except Timeout:
        raise OutputExistsError(busy) from None
    try:
        yield
    finally:
        lock.release()


def advise(handle: int, use: str) -> None:
    """Tell the system how an open file is used (``"SEQUENTIAL"``, ``"DONTNEED"``), where it takes such advice."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(handle, 0, 0, getattr(os, f"POSIX_FADV_{use}"))


def read_yaml(path: Path, what: str, loader: Any = None) -> dict[Any, Any]:
    """Keys and values of a YAML file; also of OpenCV's, whose version line YAML does not know.

    Parameters
    ----------
    path
        Of the file.
    what
        It should be, for messages: "a calibration".
    loader
        A loader of PyYAML that knows tags of its own; the safe one if not given.

    Raises
    ------
    FormatError
        Where it cannot be read, is no YAML, or has no keys.
    """
    import yaml

    text = read_text(path)
    if len(text) > 1 << 19:  # PyYAML takes 300 bytes and 20 us for each character
        raise FormatError(path, Fact("too-many-characters", what=what.removeprefix("a "), count=len(text)))
    if text.startswith("%YAML:"):
        text = "#" + text
    try:
        sheets = [sheet for sheet in yaml.load_all(text, loader or yaml.SafeLoader) if sheet is not None]
    except yaml.MarkedYAMLError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        raise FormatError(path, Fact("invalid-yaml", detail=str(error.problem)), line=line) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(path, Fact("invalid-yaml", detail=str(error).splitlines()[0])) from None
    if not sheets or not all(isinstance(sheet, dict) for sheet in sheets):
        raise FormatError(path, Fact("no-keys-and-values", what=what))
    # messages of ROS, one after another, differ in their headers
    said = [{key: value for key, value in sheet.items() if key != "header"} for sheet in sheets]
    if any(other != said[0] for other in said[1:]):
        raise FormatError(path, Fact("documents-differ", what=what, count=len(sheets)))
    return dict(sheets[0])


def write_json(path: Path, value: object, *, indent: int | None = 2) -> None:
    """Write ``value`` as JSON, whole or not at all.

    Parameters
    ----------
    path
        Replaced when it exists; its folder must exist.
    value
        Mappings with text keys, sequences, dataclass instances (as objects of their fields), numpy arrays and scalars
        (as lists and numbers), paths (as text), text, numbers, booleans, ``None``.
    indent
        For people to read; ``None`` keeps long lists of numbers on one line.

    Raises
    ------
    ValueError
        For a number that is not finite (JSON has none) or a value of another type; the message names where it is.
    """
    write_text(path, json.dumps(_plain(value, "$"), indent=indent, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``; a :class:`FormatError` where there is none."""
    value = read_json_value(path)
    if not isinstance(value, dict):
        raise FormatError(path, Fact("no-json-object", found=type(value).__name__))
    return value


def read_json_value(path: Path) -> Any:
    """The JSON value in ``path``, of finite numbers; a :class:`FormatError` where there is none."""
    text = read_text(path)
    try:
        return json.loads(text, parse_constant=_no_constant, parse_float=_finite, parse_int=_modest)
    except json.JSONDecodeError as error:
        raise FormatError(path, Fact("invalid-json", detail=str(error.msg)), line=error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise FormatError(path, Fact("invalid-json", detail=str(error))) from None


def read_text(path: Path) -> str:
    """The text of a file; bytes that are not UTF-8 become U+FFFD, so that the reader can name their line.

    Raises
    ------
    FormatError
        Where the file is missing or cannot be read.
    """
    return read_bytes(path).decode("utf-8-sig", errors="replace")


def read_bytes(path: Path, size: int = -1, *, what: str = "file") -> bytes:
    """The bytes of a file, or the first ``size`` of them; ``what`` it is, for the message.

    Raises
    ------
    FormatError
        Where the file is missing or cannot be read.
    """
    try:
        require_regular(path)
        with open(path, "rb") as file:
            largest_gib = read_limits().file_gib
            if size < 0 and os.fstat(file.fileno()).st_size > largest_gib * (1 << 30):
                raise FormatError(path, Fact("file-too-large", largest_gib=largest_gib, what=what))
            return file.read(size)
    except FileNotFoundError:
        raise FormatError(path, Fact("no-such-file", what=what)) from None
    except (OSError, ValueError) as error:  # the latter for a NUL in the path
        raise FormatError(
            path, Fact("file-not-readable", detail=str(getattr(error, "strerror", None) or error))
        ) from None


#: Files whose size the system does not know, and which may block for ever.
_KERNEL = ("/proc/", "/sys/")


def require_regular(path: Path) -> None:
    """Refuse what never ends or never begins.

    Raises
    ------
    FormatError
        For a device, a pipe, a socket, or what the kernel makes up as it is read.
    OSError
        Where there is nothing.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) or os.path.realpath(path).startswith(_KERNEL):
        raise FormatError(path, Fact("not-a-regular-file"))


def refuse_link(path: Path) -> None:
    """Raise :class:`FormatError` where a name in an output folder is a symbolic link."""
    if path.is_symlink():
        raise FormatError(path, Fact("link-in-output", target=str(path.readlink())))


def first_line(path: Path) -> str:
    """The beginning of a file's first line, to tell what it is; empty where it cannot be read."""
    try:
        return read_bytes(path, 1000).decode("utf-8-sig", errors="replace").replace("\r", "\n").partition("\n")[0]
    except FormatError:
        return ""


def convert_to_plain(value: object) -> Any:
    """A value as :func:`read_json` gives it back after :func:`write_json`."""
    return json.loads(json.dumps(_plain(value, "$"), allow_nan=False))


def _no_constant(name: str) -> float:
    raise ValueError(Fact("not-a-known-number", text=name[:40]))


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _no_constant(text)


def _modest(text: str) -> int | float:
    """A whole number that 64 bits hold."""
    return int(text) if len(text) < 19 or -(2**63) <= int(text[:99]) < 2**64 else _no_constant(text)


def _plain(value: object, where: str) -> object:
    if value is None or (isinstance(value, bool | str | int) and not isinstance(value, np.generic)):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), where)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where}: {value} cannot be written as JSON")
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Fact):
        return _plain(value.as_json(), where)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return {name: _plain(item, f"{where}.{name}") for name, item in with_sentences(fields).items()}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise ValueError(f"{where}: JSON keys must be text")
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        if all(type(item) is float for item in value) and all(map(math.isfinite, value)):
            return list(value)
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise ValueError(f"{where}: {type(value).__name__} cannot be written as JSON")


T = TypeVar("T")


def write_record(path: Path, value: object) -> None:
    """Write a frozen value for :func:`read_record`; raises as ``io.files.write_json``."""
    write_json(path, value, indent=None)


def read_record(path: Path, kind: type[T]) -> T:
    """The value that :func:`write_record` wrote.

    Raises
    ------
    FormatError
        Where the file was changed since.
    """
    values = read_json(path)
    with reading(path, Fact("changed-record")):
        return structured(kind, values)


def structured(kind: type[T], values: Any) -> T:
    """A value of type ``kind`` from JSON types, by the annotations of its fields."""
    return _converter().structure(without_sentences(values), kind)


def without_sentences(values: Any) -> Any:
    """JSON values with facts by their codes, where these stand beside sentences."""
    if isinstance(values, list):
        return [without_sentences(item) for item in values]
    if not isinstance(values, dict):
        return values
    coded = {name.removesuffix(DETAILS): item for name, item in values.items() if name.endswith(DETAILS)}
    return {
        name: coded.get(name, without_sentences(item)) for name, item in values.items() if not name.endswith(DETAILS)
    }


def _structure_fact(value: Any, _: Any) -> Fact:
    """A fact by its code and values; of an earlier version's record, its words."""
    return Fact.stated(value) if isinstance(value, str) else Fact(value["code"], **value["values"])


@functools.cache
def _converter() -> Converter:
    import cattrs

    converter = cattrs.Converter()
    converter.register_structure_hook_func(_is_array, lambda value, kind: np.array(value, _dtype(kind)))
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_structure_hook(Fact, _structure_fact)
    converter.register_structure_hook_func(lambda kind: kind is object or kind == int | float, lambda value, _: value)
    return converter


def _is_array(kind: Any) -> bool:
    return typing.get_origin(kind) is np.ndarray


def _dtype(kind: Any) -> Any:
    """The element type that ``NDArray[...]`` names."""
    return typing.get_args(typing.get_args(kind)[1])[0]


#: Of a folder or file, in bytes; common file systems hold no longer ones.
_LONGEST = 255


def check_names(names: Iterable[str], source: Path | str) -> None:
    """Refuse names that could not be those of files in a folder.

    Parameters
    ----------
    names
        Relative paths with forward slashes, as COLMAP has them.
    source
        Where they come from, for the message.

    Raises
    ------
    FormatError
        For a name that is empty or absolute, that holds ``..`` or a control character, that is no UTF-8 or too long.
    """
    for name in names:
        fault = name_fault(name)
        if fault is not None:
            raise FormatError(source, Fact("unsafe-name", name=name[:80], fault=fault))


def require_utf8(*paths: StrPath) -> None:
    """Raise :class:`FormatError` for a path that native libraries would end the process for, and JSON cannot hold."""
    for path in paths:
        if printable(absolute := os.path.abspath(path)) != absolute:
            raise FormatError(Path(path), Fact("unprintable-path"))


def path_in(folder: Path, name: str, source: Path | str | None = None) -> Path:
    """The path of a named file, there already or not, that stays in its folder wherever links lead.

    Parameters
    ----------
    folder
        Where the file belongs. It may itself be a link.
    name, source
        As of :func:`check_names`; the source is the folder where nothing else is known.

    Raises
    ------
    FormatError
        For a name that :func:`check_names` refuses, or one that a link leads out of the folder.
    """
    check_names((name,), folder if source is None else source)
    path = folder / name
    root, real = os.path.realpath(folder), os.path.realpath(path)
    if os.path.commonpath((root, real)) != root or root == real:
        raise FormatError(
            path if source is None else source, Fact("link-leads-out", name=name[:80], folder=str(folder), real=real)
        )
    return path


def name_fault(name: str) -> Fact | None:
    """What is wrong with a name of a file in a folder; ``None`` where nothing is."""
    if not name or not name.strip("./\\ "):
        return Fact("is-empty")
    if name.startswith("/") or Path(name).anchor:
        return Fact("name-absolute")
    parts = re.split(r"[/\\]", name)
    if ".." in parts:
        return Fact("name-leads-out")
    if printable(name) != name or "\n" in name or "\t" in name:
        return Fact("name-unprintable")
    longest = max(len(part.encode()) for part in parts)
    return Fact("name-too-long", longest=_LONGEST) if longest > _LONGEST else None


def a_record_of_ours(path: Path) -> AbstractContextManager[None]:
    """While a record of an earlier run is taken apart: what does not fit means that it was changed since."""
    return reading(path, Fact("changed-record"))
