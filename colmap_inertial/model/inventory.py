"""Files of a workspace that are not moved: known to be free of lengths, or named.

The list is open: what is not known to be free of lengths may hold some, and the user is told.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.images import PNG, TIFF_ORDERS, tiff_entries
from colmap_inertial.io.stand_ins import is_apple_double, is_pointer
from colmap_inertial.model.other_files import is_rig_in_one_place

Lengths = Literal["carried", "possible", "depths"]

#: Formats that carry length and are left as they are.
_CARRY = (
    *(".stl", ".off", ".glb", ".gltf", ".fbx", ".dae", ".las", ".laz", ".pcd", ".xyz", ".pts", ".e57", ".splat"),
    *(".mvs", ".nvm", ".out", ".ksplat", ".spz", ".sog", ".tum", ".wrl", ".vrml", ".x3d", ".usd", ".usda", ".usdc"),
    *(".usdz", ".abc", ".3ds", ".blend", ".ptx", ".asc", ".b3dm", ".pnts", ".osgb", ".drc", ".gpx", ".kml", ".kmz"),
)
_CARRY_NAMES = ("georeference.json", "cameras.csv", "dataparser_transforms.json", "poses_bounds.npy", "cameras.json")
_PICTURES = (
    *(".jpg", ".jpeg", ".png", ".bmp", ".gif", ".webp", ".jp2", ".jxl", ".heic", ".heif", ".avif", ".tif", ".tiff"),
    *(".ppm", ".pgm", ".pnm", ".pbm", ".dng", ".cr2", ".cr3", ".arw", ".nef", ".raf", ".rw2", ".orf", ".svg", ".ico"),
)
_FREE = {
    *_PICTURES,
    *(".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".insv", ".lrv", ".thm", ".wav", ".mp3", ".aac"),
    *(".md", ".rst", ".pdf", ".html", ".htm", ".css", ".js", ".docx", ".odt", ".log", ".bib", ".lock"),
    *(".py", ".sh", ".bat", ".ps1", ".cpp", ".cc", ".c", ".h", ".hpp", ".cu", ".ipynb", ".cmake"),
    *(".mtl", ".vis", ".swp", ".bak~", ".fbow", ".srt"),
}
_FREE_NAMES = {
    *("patch-match.cfg", "fusion.cfg", ".ds_store", "thumbs.db", "desktop.ini", ".gitignore", ".gitattributes"),
    *(
        "license",
        "readme",
        "makefile",
        "pair.txt",
        "run-colmap-geometric.sh",
        "run-colmap-photometric.sh",
        ".nojekyll",
        ".gitkeep",
    ),
}
#: Folders of COLMAP's maps without lengths; patch matching's own check of normal maps is in ``layout``.
_FREE_FOLDERS = ("normal_maps", "consistency_graphs")
_TEXT = {".txt", ".csv", ".tsv", ".cfg", ".conf", ".ini", ".list", ".lst", ""}
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
#: Rows of so many numbers are taken for a table, and so much of a file is looked at.
_ROW, _LOOKED = 3, 1 << 16


@dataclass(frozen=True, kw_only=True)
class Unmoved:
    """Files of one kind that were left as they are.

    Attributes
    ----------
    kind
        Ending, or name.
    count, example
        How many, and the path of one of them.
    lengths
        ``carried`` for formats that have them, ``depths`` for images of depths, ``possible`` where nothing is known.
    """

    kind: str
    count: int
    example: str
    lengths: Lengths


def lengths_of(file: Path, path: Path, depths: frozenset[Path] = frozenset()) -> tuple[str, Lengths] | None:
    """Kind of a file that is not moved, and what is known of lengths in it; ``None`` where it is free of them.

    Parameters
    ----------
    file, path
        The file, and its path in the project.
    depths
        Paths of images that hold depths.
    """
    name, suffix = path.name.lower(), path.suffix.lower()
    if name in _CARRY_NAMES:
        return path.name, "carried"
    if suffix in _CARRY:
        return suffix, "carried"
    if path in depths or suffix in _PICTURES:
        return (f"depths ({suffix})", "depths") if path in depths or _is_deep(file, path) else None
    is_free = _is_free_by_name(path) or _is_free_by_content(_head(file), suffix) or is_rig_in_one_place(file)
    return None if is_free else (suffix or path.name, "possible")


def _is_free_by_name(path: Path) -> bool:
    """Whether a file of this name has no lengths."""
    name, suffix = path.name.lower(), path.suffix.lower()
    if suffix in _FREE or name in _FREE_NAMES or path.stem.lower() in _FREE_NAMES or "vocab" in name:
        return True
    return suffix == ".bin" and any(folder in path.parts[:-1] for folder in _FREE_FOLDERS)


def _is_free_by_content(head: bytes, suffix: str) -> bool:
    """Whether a file that begins so has no lengths."""
    if not head or is_apple_double(head) or is_pointer(head):
        return True
    if suffix in _TEXT and b"\0" not in head and not _has_rows_of_numbers(head):
        return True
    return suffix == ".db" or head.startswith(b"SQLite format 3\0")


def _head(file: Path) -> bytes:
    try:
        return read_bytes(file, _LOOKED)
    except FormatError:
        return b""


def _has_rows_of_numbers(text: bytes) -> bool:
    for line in text.splitlines():
        words = re.split(rb"[\s,;]+", line.strip())
        if sum(_NUMBER.fullmatch(word) is not None for word in words) >= _ROW:
            return True
    return False


def _is_deep(file: Path, path: Path) -> bool:
    """Whether an image may hold depths: grey values of 16 bit or more, or floating-point numbers."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        head = _begin(file, 32)
        return head.startswith(PNG) and len(head) > 25 and head[24] == 16 and head[25] == 0
    if suffix == ".pgm":
        maximum = re.match(rb"P[25]\s+(?:#[^\n]*\n\s*)*\d+\s+\d+\s+(\d+)", _begin(file, 512))
        return maximum is not None and int(maximum[1]) > 255
    if suffix in (".tif", ".tiff"):
        return _is_deep_tiff(file)
    return False


def _begin(file: Path, size: int) -> bytes:
    with open(file, "rb") as opened:
        return opened.read(size)


def _is_deep_tiff(file: Path) -> bool:
    data = _begin(file, 1 << 22)
    order = TIFF_ORDERS.get(data[:4])
    if order is None:
        return False
    try:
        entries = tiff_entries(data, order, struct.unpack_from(f"{order}I", data, 4)[0])
        values = {tag: struct.unpack_from(f"{order}H", entries[tag][2])[0] for tag in (258, 277, 339) if tag in entries}
    except struct.error:
        return False
    grey = values.get(277, 1) == 1
    return values.get(339, 1) == 3 or (grey and entries.get(258, (0, 0, b""))[1] == 1 and values.get(258, 8) >= 16)


class Inventory:
    """What is left as it is, kind by kind."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, Lengths], list[str]] = {}

    def add(self, path: Path, lengths: tuple[str, Lengths] | None) -> None:
        """Note a file, where it has lengths or may have some."""
        if lengths is not None:
            self._found.setdefault(lengths, []).append(path.as_posix())

    @property
    def unmoved(self) -> tuple[Unmoved, ...]:
        """By kind."""
        return tuple(
            Unmoved(kind=kind, count=len(paths), example=paths[0], lengths=lengths)
            for (kind, lengths), paths in sorted(self._found.items())
        )

    def notes(self, scales: Iterable[float]) -> list[Fact]:
        """What the user is told, where lengths became so many times as long."""
        facts: list[Fact] = []
        carried = [group for group in self.unmoved if group.lengths == "carried"]
        possible = [group for group in self.unmoved if group.lengths == "possible"]
        depths = [group for group in self.unmoved if group.lengths == "depths"]
        if carried:
            facts.append(Fact("carried-lengths", kinds=[f"{group.count} {group.kind}" for group in carried]))
        if possible:
            kinds = [f"{g.count} {g.kind} ({g.example})" if g.kind != g.example else g.kind for g in possible]
            facts.append(Fact("possible-lengths", kinds=kinds))
        if depths:
            factors = sorted(set(scales))
            count, example = sum(group.count for group in depths), depths[0].example
            facts.append(Fact("unmoved-depths", count=count, example=example, factors=factors))
        return facts

    def as_json(self) -> list[Mapping[str, object]]:
        """The groups in JSON types."""
        return [{"kind": g.kind, "count": g.count, "example": g.example, "lengths": g.lengths} for g in self.unmoved]
