"""Room on a disk, and removal of a run's own files."""

from __future__ import annotations

import contextlib
import errno
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.facts import Fact


def remove(path: Path) -> None:
    """Remove a file or folder of our own, if it is there, with the side files of an SQLite database."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        for suffix in ("", "-journal", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)


@contextlib.contextmanager
def full_disk_is_an_error(root: Path) -> Iterator[None]:
    """Turn the system's complaint about a full disk (or a quota, or a limit of file sizes) into one of ours."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        if error.errno == errno.EFBIG:
            raise OutputError(Fact("file-would-be-too-large", folder=str(root))) from error
        raise OutputError(Fact("disk-full", folder=str(root), detail=error.strerror)) from error


def require_room(file: Path, num_bytes: int, *, copies: int = 1) -> None:
    """Raise :class:`OutputError` where a file cannot grow by ``num_bytes``: its disk is full, or it is not allowed to.

    The disk is to hold ``copies`` of them, the file one.
    For what COLMAP writes: its threads end the process when a database cannot grow, and its models end early.
    """
    free = shutil.disk_usage(file.parent).free
    if free < copies * num_bytes:
        raise OutputError(
            Fact("disk-nearly-full", folder=str(file.parent), free_bytes=free, needed_bytes=copies * num_bytes)
        )
    largest, size = _largest_file_bytes(), file.stat().st_size if file.is_file() else 0
    if largest < size + num_bytes:
        raise OutputError(
            Fact("file-size-limited", path=str(file), largest_bytes=largest, needed_bytes=size + num_bytes)
        )


def _largest_file_bytes() -> float:
    """The limit of this process."""
    try:
        import resource
    except ImportError:  # Windows has none
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return math.inf if limit == resource.RLIM_INFINITY else limit
