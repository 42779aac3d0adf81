"""The gate for names from outside: whatever a model, table or manifest calls a file passes here before it is a path."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from colmap_inertial.core.errors import FormatError

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
        For a name that is empty or absolute, that holds ``..`` or NUL, or that is too long.
    """
    for name in names:
        fault = _fault(name)
        if fault is not None:
            raise FormatError(source, f"names the file {name[:80]!r}, which {fault}; such names are not followed")


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
            path if source is None else source,
            f"names the file {name[:80]!r}, which a link leads out of {folder} to {real}; links are not followed: put "
            "the file itself there",
        )
    return path


def _fault(name: str) -> str | None:
    if not name or not name.strip("./\\ "):
        return "is empty"
    if "\0" in name:
        return "holds a NUL character"
    if name.startswith("/") or Path(name).anchor:
        return "is absolute"
    parts = re.split(r"[/\\]", name)
    if ".." in parts:
        return 'leads out of its folder by ".."'
    try:
        longest = max(len(os.fsencode(part)) for part in parts)
    except UnicodeEncodeError:
        return "no file system can hold"
    return f"is longer than {_LONGEST} bytes" if longest > _LONGEST else None
