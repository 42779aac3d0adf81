"""Identity of files: what tells an input of a run from another one."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact

#: Of a file this much is read to tell it from another one: all of it, or as many bytes in pieces of this size.
_READ_BYTES, _PIECE_BYTES = 4 << 20, 1 << 16


def fingerprint(path: Path) -> list[object]:
    """Identity of an input: names, sizes, modification times and content.

    Tools that edit metadata or copy with the old times leave size and time as they were, so the content counts, too: of
    files up to 4 MiB, as most images and tables are, each byte; of larger ones 64 pieces over their whole length. Not
    the time of the last change of the inode, which tells of an edit as well, but also of a hard link, which
    ``reconstruct PROJECT OUT --link`` makes itself, and of another owner.
    """
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    try:
        stats = [(file, file.stat()) for file in files]
    except FileNotFoundError as error:
        raise FormatError(error.filename, Fact("no-such-file", what="file")) from None
    return [[str(file.resolve()), stat.st_size, stat.st_mtime_ns, digest_of_file(file, stat)] for file, stat in stats]


def digest_of_file(path: Path, stat: os.stat_result) -> str:
    return _digest(path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)


@functools.lru_cache(maxsize=100_000)
def _digest(path: Path, size: int, _mtime_ns: int, _ctime_ns: int) -> str:
    """Digest of a file's content; once in a run, as several steps ask for the same inputs."""
    digest = hashlib.blake2b(digest_size=16)
    try:
        with open(path, "rb") as file:
            pieces = 1 if size <= _READ_BYTES else _READ_BYTES // _PIECE_BYTES
            for i in range(pieces):
                file.seek(i * (size - _PIECE_BYTES) // max(1, pieces - 1))
                piece = file.read(_READ_BYTES // pieces)
                if i == 0 and piece.startswith(b"SQLite format 3"):
                    # how often the database was opened to write: COLMAP does so also where it only reads
                    piece = piece[:24] + piece[28:92] + piece[100:]
                digest.update(piece)
    except OSError as error:
        raise FormatError(path, Fact("file-not-readable", detail=str(error.strerror or error))) from None
    return digest.hexdigest()
