"""Tables in a zip, or in the folder that it was unpacked to."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path, PurePosixPath

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.files import first_line, read_text

#: An unpacked table larger than this is no recording.
_LARGEST_MEMBER = 1 << 31
#: What the standard library raises for damaged archives is not documented as one class.
_DAMAGED = (OSError, EOFError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error)


def members_of(path: Path) -> dict[str, str]:
    """The tables of a recording: file name to where it lies. A zip may hold them in one folder."""
    if path.is_dir():
        return {file.name: file.name for file in path.glob("*.csv")}
    try:
        if not path.is_file() or not zipfile.is_zipfile(path):
            return {}
        with zipfile.ZipFile(path) as archive:
            names = [info.filename for info in archive.infolist() if info.filename.endswith(".csv")]
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return {}
    return {PurePosixPath(name).name: name for name in names if len(PurePosixPath(name).parts) <= 2}


def head_of(path: Path, member: str) -> str:
    """The first line of a table, or as much of it as a thousand bytes hold; empty where it is damaged."""
    if path.is_dir():
        return first_line(path / member)
    try:
        with zipfile.ZipFile(path) as archive, archive.open(member) as file:
            return file.read(1000).decode("utf-8-sig", errors="replace").partition("\n")[0]
    except _DAMAGED:
        return ""


def text_of(path: Path, member: str) -> str:
    """The text of a table.

    Raises
    ------
    FormatError
        Where it is damaged, or too large.
    """
    if path.is_dir():
        return read_text(path / member)
    try:
        with zipfile.ZipFile(path) as archive:
            told = archive.getinfo(member)
            if told.compress_size > path.stat().st_size:  # as much memory would be asked for as it says
                raise FormatError(path, f"its {member} cannot be unpacked: it is said to be larger than the file")
            if told.file_size > _LARGEST_MEMBER:
                raise FormatError(path, f"its {member} unpacks to more than {_LARGEST_MEMBER >> 30} GiB")
            return archive.read(member).decode("utf-8-sig", errors="replace")
    except _DAMAGED as error:
        raise FormatError(path, f"its {member} cannot be unpacked: {error}") from None
