"""Files that are either whole or absent: a reader never meets one that was being written when the power went."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError
from colmap_inertial.io.limits import read_limits

_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.tmp")

#: What users may give for a path.
StrPath = str | os.PathLike[str]


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
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
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
def locked(path: Path, busy: str, *, wait_s: float = 0.0) -> Iterator[None]:
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
    if text.startswith("%YAML:"):
        text = "#" + text
    try:
        sheet = yaml.load(text, loader or yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        raise FormatError(path, f"not valid YAML: {error.problem}", line=line) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(path, f"not valid YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(sheet, dict):
        raise FormatError(path, f"not {what}: expected keys and values")
    return sheet


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
    text = read_text(path)
    try:
        value = json.loads(text, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise FormatError(path, f"not valid JSON: {error.msg}", line=error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"not valid JSON: {error}") from None
    if not isinstance(value, dict):
        raise FormatError(path, f"expected a JSON object, found {type(value).__name__}")
    return value


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
                raise FormatError(
                    path,
                    f"is larger than {largest_gib:g} GiB; such a {what} is not read (raise --limits.file-gib)",
                )
            return file.read(size)
    except FileNotFoundError:
        raise FormatError(path, f"no such {what}") from None
    except (OSError, ValueError) as error:  # the latter for a NUL in the path
        raise FormatError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def require_regular(path: Path) -> None:
    """Refuse what never ends or never begins.

    Raises
    ------
    FormatError
        For a device, a pipe or a socket.
    OSError
        Where there is nothing.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FormatError(path, "is a device, a pipe or a socket, not a file; copy what it gives into one")


def first_line(path: Path) -> str:
    """The beginning of a file's first line, to tell what it is; empty where it cannot be read."""
    if not path.is_file():
        return ""
    try:
        with open(path, encoding="utf-8-sig", errors="replace") as file:
            return file.readline(1000)
    except OSError:
        return ""


def as_plain(value: object) -> Any:
    """A value as :func:`read_json` gives it back after :func:`write_json`."""
    return json.loads(json.dumps(_plain(value, "$"), allow_nan=False))


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


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
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise ValueError(f"{where}: JSON keys must be text")
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        if all(type(item) is float for item in value) and all(map(math.isfinite, value)):
            return list(value)
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise ValueError(f"{where}: {type(value).__name__} cannot be written as JSON")
