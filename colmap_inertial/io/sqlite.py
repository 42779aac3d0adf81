"""SQLite databases from outside: nothing in one may run, and none takes longer than its size explains."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import require_regular


@dataclass(frozen=True, kw_only=True)
class _Bounds:
    """Limits of the work of reading a database.

    SQLite's ``quick_check``, the slowest of what is asked, reads 2 GB in a second of processor time.
    """

    #: Processor time, beside what its size explains.
    seconds: float = 4.0
    #: Of a file, for each second of processor time more.
    bytes_per_s: float = 1e7
    #: Of one value: twenty times the descriptors of 100,000 features.
    value_bytes: int = 1 << 28
    #: Instructions of SQLite's machine between two looks at the clock; less than a millisecond.
    instructions: int = 10_000


BOUNDS = _Bounds()


@contextlib.contextmanager
def open_foreign(
    path: Path,
    *,
    mode: Literal["immutable=1", "mode=ro", "mode=rw"] = "immutable=1",
    source: Path | None = None,
    fault: Fact | None = None,
) -> Iterator[sqlite3.Connection]:
    """Open a database that others may have written, and close it.

    Views and triggers would run in place of what is asked of a table, and virtual tables code that they name; COLMAP
    and ROS write none.

    Parameters
    ----------
    path
        Of an existing file.
    mode
        As in SQLite's addresses: not to be locked (nobody else has it open), to be read, or to be changed.
    source
        What the file is a copy of, for messages.
    fault
        What messages say of it, by default that SQLite cannot read it.

    Raises
    ------
    FormatError
        For one that holds views, triggers or virtual tables, that SQLite cannot read, or that takes too long.
    OSError
        Where the disk is full or fails.
    """
    named = path if source is None else source
    fault = fault or Fact("sqlite-cannot-read")
    require_regular(path)
    end_s = time.thread_time() + BOUNDS.seconds + path.stat().st_size / BOUNDS.bytes_per_s
    try:
        with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, BOUNDS.value_bytes)
            database.set_progress_handler(lambda: time.thread_time() > end_s, BOUNDS.instructions)
            _refuse_code(database, named, fault)
            yield database
    except (sqlite3.Error, UnicodeDecodeError) as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            number = errno.ENOSPC if code == sqlite3.SQLITE_FULL else errno.EIO
            raise OSError(number, os.strerror(number), str(named)) from None
        if code == sqlite3.SQLITE_INTERRUPT:
            raise FormatError(named, Fact("database-takes-long", fault=fault)) from None
        raise FormatError(named, Fact("database-not-readable", fault=fault, detail=str(error))) from None


def _refuse_code(database: sqlite3.Connection, named: Path, fault: Fact) -> None:
    query = (
        "SELECT type, name FROM sqlite_master WHERE type NOT IN ('table', 'index') OR (type = 'table' AND rootpage = 0)"
    )
    row = database.execute(query).fetchone()
    if row is not None:
        kind = "virtual table" if row[0] == "table" else row[0]
        raise FormatError(named, Fact("code-in-database", fault=fault, kind=kind, name=str(row[1])[:80]))
