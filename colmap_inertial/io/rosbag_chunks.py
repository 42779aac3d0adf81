"""Unpacked sizes of ROS recordings, checked before ``rosbags`` unpacks them: it holds chunks and messages whole.

Chunks are found where ``rosbags`` finds them: by the index of a ROS 1 bag, and by the index and the order of records of
MCAP.
"""

from __future__ import annotations

import bz2
import os
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_yaml, reading
from colmap_inertial.io.sqlite import open_foreign


@dataclass(frozen=True, kw_only=True)
class _Bounds:
    """Bounds of a recording's unpacked bytes. A message takes up to five times its bytes in Python."""

    #: For each packed byte; chunks of cameras and IMUs have 2 to 10.
    ratio: int = 20
    #: In any recording.
    anyway: int = 64 << 20
    #: Of the header of a record.
    header: int = 1 << 20
    #: Unpacked at a time.
    step: int = 1 << 20


_BOUNDS = _Bounds()
_NOT_PACKED = ("", "none")
_MCAP = b"\x89MCAP0\r\n"
_FOOTER, _CHUNK, _CHUNK_INDEX, _SUMMARY_OFFSET = 0x02, 0x06, 0x08, 0x0E


@dataclass(frozen=True, kw_only=True)
class _Packed:
    """Bytes of a file that are unpacked together, with the name of their compression."""

    begin: int
    size: int
    compression: str
    beside: int = 0


def require_modest_recording(path: Path) -> None:
    """Refuse a recording that unpacks to much more than it is.

    Raises
    ------
    FormatError
        For one that does, that holds bytes more than once, that is damaged, or an SQLite database as of
        :func:`~colmap_inertial.io.sqlite.open_foreign`.
    """
    with reading(path, Fact("not-readable-as", what="a ROS recording")):
        if not path.is_dir():
            _check_file(path, "")
            return
        about = read_yaml(path / "metadata.yaml", "a ROS recording").get("rosbag2_bagfile_information")
        mode = str((about if isinstance(about, dict) else {}).get("compression_mode") or "").lower()
        if mode == "file":
            raise FormatError(path, Fact("bag-files-packed"))
        for file in sorted(path.iterdir()):
            if file.suffix in (".db3", ".mcap"):
                _check_file(file, mode)


def _check_file(path: Path, mode: str) -> None:
    with open(path, "rb") as file:
        head, size = file.read(16), os.fstat(file.fileno()).st_size
        if head.startswith(b"SQLite format 3\0"):
            _check_database(path, size, mode)
        elif head.startswith(_MCAP):
            if mode == "message":
                raise FormatError(path, Fact("bag-messages-packed"))
            known: dict[_Packed, int] = {}
            for chunks in (_read_indexed_chunks(file, size), _read_chunks_in_order(file, size)):
                _check_chunks(path, file, size, chunks, known)
        elif head.startswith(b"#ROSBAG V2"):
            _check_chunks(path, file, size, _ros1_chunks(file), {})


def _check_database(path: Path, size: int, mode: str) -> None:
    with open_foreign(path) as database:
        if mode == "message":
            held = 0
            for (data,) in database.execute("SELECT data FROM messages"):
                held = _add(path, size, held, _count_unpacked(path, data, "zstd", _limit_unpacked(size) - held))


def _check_chunks(path: Path, file: IO[bytes], size: int, chunks: Iterator[_Packed], known: dict[_Packed, int]) -> None:
    """Add up what chunks unpack to; ``known`` are those that were unpacked before."""
    passed = held = 0
    for chunk in chunks:
        passed += chunk.size + chunk.beside
        if passed > size:
            raise FormatError(path, Fact("bag-index-repeats"))
        if chunk not in known:
            file.seek(chunk.begin)
            packed = b"" if chunk.compression in _NOT_PACKED else file.read(chunk.size)
            known[chunk] = (
                _count_unpacked(path, packed, chunk.compression, _limit_unpacked(size) - held) if packed else chunk.size
            )
        held = _add(path, size, held, known[chunk])


def _limit_unpacked(size: int) -> int:
    return _BOUNDS.anyway + _BOUNDS.ratio * size


def _add(path: Path, size: int, held: int, more: int) -> int:
    if held + more > _limit_unpacked(size):
        raise FormatError(path, Fact("bag-out-of-proportion", most_mb=_limit_unpacked(size) >> 20, size=size))
    return held + more


def _decompressors() -> dict[str, Callable[[], Any]]:
    from lz4.frame import LZ4FrameDecompressor

    if sys.version_info >= (3, 14):
        from compression.zstd import ZstdDecompressor
    else:
        from backports.zstd import ZstdDecompressor
    return {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor, "zstd": ZstdDecompressor}


def _count_unpacked(path: Path, packed: bytes, compression: str, most: int) -> int:
    """Number of bytes after unpacking, or more than ``most``."""
    made = _decompressors().get(compression)
    if made is None:
        raise FormatError(path, Fact("bag-compression-unknown", compression=compression[:40]))
    unpacker, size = made(), 0
    part = unpacker.decompress(packed, _BOUNDS.step)
    while part and size <= most:
        size += len(part)
        part = b"" if unpacker.eof else unpacker.decompress(b"", _BOUNDS.step)
    if size <= most and unpacker.eof and unpacker.unused_data:
        raise FormatError(path, Fact("bag-chunk-followed"))
    return size


def _ros1_record(file: IO[bytes]) -> tuple[dict[bytes, bytes], int]:
    """Fields of a record's header, and how many bytes of data follow."""
    (length,) = struct.unpack("<I", file.read(4))
    header, fields, at = file.read(min(length, _BOUNDS.header)), dict[bytes, bytes](), 0
    while at < length:
        (size,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields, struct.unpack("<I", file.read(4))[0]


def _ros1_chunks(file: IO[bytes]) -> Iterator[_Packed]:
    file.seek(0)
    file.readline(100)
    header, _ = _ros1_record(file)
    (index,) = struct.unpack("<Q", header[b"index_pos"])
    if not index:  # rosbags says what to do
        return
    file.seek(index)
    connections, chunks = (struct.unpack("<I", header[name])[0] for name in (b"conn_count", b"chunk_count"))
    for _ in range(connections):
        file.seek(_ros1_record(file)[1], os.SEEK_CUR)
    places = []
    for _ in range(chunks):
        info, size = _ros1_record(file)
        places.append(tuple(struct.unpack("<Q", info[b"chunk_pos"])) + struct.unpack("<I", info[b"count"]))
        file.seek(size, os.SEEK_CUR)
    for place, indices in places:
        file.seek(place)
        header, size = _ros1_record(file)
        begin = file.tell()
        file.seek(size, os.SEEK_CUR)
        for _ in range(indices):
            file.seek(_ros1_record(file)[1], os.SEEK_CUR)
        beside = file.tell() - begin - size
        yield _Packed(begin=begin, size=size, compression=header[b"compression"].decode(), beside=beside)


def _mcap_records(file: IO[bytes], begin: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Kind, begin and size of the records in a part of a file."""
    while begin + 9 <= end:
        file.seek(begin)
        kind, size = struct.unpack("<BQ", file.read(9))
        yield kind, begin + 9, size
        begin += 9 + size


def _mcap_ends(file: IO[bytes], size: int) -> tuple[int, int]:
    """Ends of data and summary; of the data where the summary begins."""
    file.seek(size - 28)
    (summary,) = struct.unpack("<Q", file.read(8))
    return summary or size - 37, size - 37


def _read_indexed_chunks(file: IO[bytes], size: int) -> Iterator[_Packed]:
    for kind, begin, length in _mcap_records(file, *_mcap_ends(file, size)):
        if kind in (_FOOTER, _SUMMARY_OFFSET):
            return
        if kind == _CHUNK_INDEX:
            file.seek(begin)
            record = file.read(min(length, _BOUNDS.header))
            (chunk,), (offsets,) = struct.unpack_from("<Q", record, 16), struct.unpack_from("<I", record, 32)
            at = 36 + offsets + 8
            name = record[at + 4 : at + 4 + struct.unpack_from("<I", record, at)[0]]
            (packed,) = struct.unpack_from("<Q", record, at + 4 + len(name))
            yield _Packed(begin=chunk + 49 + len(name), size=packed, compression=name.decode())


def _read_chunks_in_order(file: IO[bytes], size: int) -> Iterator[_Packed]:
    """Read where the index is not enough."""
    for kind, begin, _ in _mcap_records(file, len(_MCAP), _mcap_ends(file, size)[0]):
        if kind == _CHUNK:
            file.seek(begin + 28)
            (length,) = struct.unpack("<I", file.read(4))
            name = file.read(min(length, 40))
            (packed,) = struct.unpack("<Q", file.read(8))
            yield _Packed(begin=begin + 40 + len(name), size=packed, compression=name.decode())
