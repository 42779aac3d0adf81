"""Files that stand in for others: pointers of Git LFS and git-annex, AppleDouble, web pages, archives, zeros.

Each has the name of what was wanted, so that a reader would call it damaged.
"""

from __future__ import annotations

from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_bytes

_HEAD = 512
_PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"7z\xbc\xaf": "7-Zip"}
#: What ISO media files of images say of themselves.
_HEIF = (b"heic", b"heix", b"mif1", b"msf1", b"heim", b"heis", b"hevc", b"avif", b"avis")


def is_apple_double(head: bytes) -> bool:
    """Whether a file begins as those that macOS leaves beside others (RFC 1740)."""
    return head[:4] == b"\x00\x05\x16\x07"


def is_pointer(head: bytes) -> bool:
    """Whether a file begins as the pointers of Git LFS or git-annex."""
    return _pointer(head) is not None


def _pointer(head: bytes) -> Fact | None:
    if head.startswith(b"version https://git-lfs.github.com/spec/") or head.startswith(b"version https://hawser"):
        return Fact("git-lfs-pointer")
    if head.startswith((b"/annex/objects/", b"../.git/annex/objects/", b".git/annex/objects/")):
        return Fact("git-annex-pointer")
    return None


def what_stands_in(head: bytes, *, packed: bool = True) -> Fact | None:
    """What a file is in place of what its name says, by its first bytes; ``None`` where they do not tell.

    ``packed``: whether an archive is none of what was wanted either.
    """
    pointer = _pointer(head)
    if pointer is not None:
        return pointer
    if is_apple_double(head):
        return Fact("apple-double")
    start = head.lstrip()[:15].lower()
    if start.startswith((b"<!doctype html", b"<html")):
        return Fact("web-page")
    kind = next((name for magic, name in _PACKED.items() if head.startswith(magic)), None) if packed else None
    if kind is not None:
        return Fact("packed-file", kind=kind)
    if len(head) >= 64 and not any(head):
        return Fact("zeros")
    return None


def refuse_stand_in(path: Path, head: bytes | None = None) -> None:
    """Raise :class:`FormatError` for a file that is something else than its name says, and say what."""
    found = what_stands_in(read_bytes(path, _HEAD) if head is None else head)
    if found is not None:
        raise FormatError(path, found)


def foreign_picture(head: bytes) -> Fact | None:
    """The format of an image that is none of those that are read."""
    if head[4:8] == b"ftyp" and head[8:12] in _HEIF:
        return Fact("picture-format", kind="HEIF or AVIF")
    kinds = {
        b"\xff\x0a": "JPEG XL",
        b"\0\0\0\x0cJXL ": "JPEG XL",
        b"GIF8": "GIF",
        b"8BPS": "Photoshop",
        b"v/1\x01": "OpenEXR",
        b"#?RADIANCE": "Radiance HDR",
        b"FUJIFILMCCD-RAW": "raw",
        b"PF\n": "PFM",
        b"DDS ": "DDS",
        b"qoif": "QOI",
    }
    kind = next((name for magic, name in kinds.items() if head.startswith(magic)), None)
    return None if kind is None else Fact("picture-format", kind=kind)
