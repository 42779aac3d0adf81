"""The smaller files of a COLMAP project that carry length: depth and normal maps, option files, OBJ meshes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import advise

_CHUNK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 20
#: Keys of COLMAP's option files that are lengths in model units; not positive means "automatic".
_DEPTH_KEYS = ("depth_min", "depth_max")
_BOX_KEYS = ("bounding_box", "bbox_path")


def check_map(path: Path, channels: int) -> int:
    """Compare a depth or normal map's size with its header ``width&height&channels&``.

    Returns
    -------
    int
        Length of the header in bytes; float32 values follow, little-endian.

    Raises
    ------
    FormatError
        When they disagree.
    """
    with open(path, "rb") as file:
        head = file.read(64)
    match = re.match(rb"(\d{1,9})&(\d{1,9})&(\d{1,3})&", head)
    if match is None:
        raise FormatError(path, Fact("not-a-depth-map"))
    width, height, channel_count = (int(text) for text in match.groups())
    if channel_count != channels:
        raise FormatError(path, Fact("map-of-other-channels", found=channel_count, expected=channels))
    if width == 0 or height == 0:
        raise FormatError(path, Fact("map-of-no-size", width=width, height=height))
    size, expected = path.stat().st_size, match.end() + 4 * width * height * channels
    if size != expected:
        raise FormatError(
            path,
            Fact(
                "map-of-other-length",
                size_bytes=size,
                expected_bytes=expected,
                width=width,
                height=height,
                channels=channels,
            ),
        )
    return match.end()


def transform_depth_map(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a depth map times the scale; 0, which means unknown, stays 0. What was changed: ``"depths"``."""
    header = check_map(source, 1)
    buffer = bytearray(_CHUNK_BYTES)
    view = memoryview(buffer)
    values = np.frombuffer(buffer, "<f4")
    scale = np.float32(similarity.scale)
    with open(source, "rb") as file, open(target, "wb") as out:
        advise(file.fileno(), "SEQUENTIAL")
        out.write(file.read(header))
        while n := file.readinto(view):
            if n % 4:
                raise FormatError(source, Fact("truncated-while-read"))
            part = values[: n // 4]
            with np.errstate(over="ignore", invalid="ignore"):
                np.multiply(part, scale, out=part)
            out.write(view[:n])
    return ("depths",)


def transform_options(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of an option file with its depth range times the scale, everything else as it is.

    Returns
    -------
    tuple of str
        The keys that were changed.

    Raises
    ------
    FormatError
        For a depth that is no number, and for a bounding box, which has axes that a rotation does not keep.
    """
    section, changed, lines = "", [], []
    for number, line in enumerate(source.read_bytes().splitlines(keepends=True), 1):
        if header := re.match(rb"\s*\[([^\]]*)\]", line):
            section = header[1].decode("latin-1").strip()
        match = re.match(rb"(\s*([\w.]+)\s*=\s*)(.*?)(\s*)$", line, re.DOTALL)
        if match is not None:
            key = match[2].decode("latin-1").rpartition(".")
            where, name = key[0] or section, key[2]
            if name in _BOX_KEYS and match[3]:
                raise FormatError(source, Fact("bounding-box", key=name), line=number)
            if name in _DEPTH_KEYS and where.startswith("PatchMatch"):
                try:
                    value = float(match[3])
                except ValueError:
                    raise FormatError(source, Fact("setting-no-number", key=name), line=number) from None
                if value > 0:
                    line = match[1] + repr(value * similarity.scale).encode() + match[4]
                    changed.append(f"{where}.{name}")
        lines.append(line)
    target.write_bytes(b"".join(lines))
    return tuple(changed)


def transform_obj(source: Path, target: Path, similarity: Similarity) -> tuple[str, ...]:
    """Write a copy of an OBJ mesh with its ``v`` and ``vn`` lines moved; whatever follows x y z stays.

    Raises
    ------
    FormatError
        For a vertex without three numbers.
    """
    turn = matrix_from_quat(similarity.rotation_xyzw)
    parts = {b"v": (similarity.scale * turn, similarity.translation_m), b"vn": (turn, np.zeros(3))}
    changed: set[bytes] = set()
    with open(source, "rb") as file, open(target, "wb") as out:
        for number, line in enumerate(_lines(source, file), 1):
            match = re.match(rb"(\s*(vn?)[ \t]+)(\S+)([ \t]+)(\S+)([ \t]+)(\S+)(.*)$", line, re.DOTALL)
            if match is not None:
                try:
                    xyz = np.array([float(match[i]) for i in (3, 5, 7)])
                except ValueError:
                    raise FormatError(source, Fact("not-three-numbers", text=repr(line[:60])), line=number) from None
                matrix, offset = parts[match[2]]
                x, y, z = (repr(value).encode() for value in (matrix @ xyz + offset).tolist())
                line = b"".join((match[1], x, match[4], y, match[6], z, match[8]))
                changed.add(match[2])
            elif line.split(maxsplit=1)[:1] in ([b"v"], [b"vn"]):
                raise FormatError(source, Fact("vertex-incomplete"), line=number)
            out.write(line)
    return tuple(name for key, name in ((b"v", "positions"), (b"vn", "normals")) if key in changed)


def _lines(path: Path, file: BufferedReader) -> Iterator[bytes]:
    for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), b""), start=1):
        if len(line) == _LONGEST_LINE:
            raise FormatError(path, Fact("line-without-end"), line=number)
        yield line


def read_map(path: Path, channels: int = 1) -> Float32Array:
    """Read a map.

    Returns
    -------
    (H, W) depths, 0 where unknown, or (H, W, channels).

    Raises
    ------
    FormatError
        Where it is damaged, or holds another number of channels.
    """
    start = check_map(path, channels)
    data = path.read_bytes()
    width, height = (int(text) for text in data[:start].split(b"&")[:2])
    values = np.frombuffer(data, "<f4", offset=start)
    if len(values) != width * height * channels:
        raise FormatError(path, Fact("changed-while-read"))
    planes = values.reshape(channels, height, width)
    return np.asarray(planes[0] if channels == 1 else np.moveaxis(planes, 0, -1), dtype=np.float32)


def write_map(path: Path, values: Float32Array) -> None:
    """Write (H, W) depths or (H, W, 3) normals; the file appears whole or not at all, its folders are made."""
    planes = values[None] if values.ndim == 2 else np.moveaxis(values, -1, 0)
    channels, height, width = planes.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with open(partial, "wb") as file:
        file.write(b"%d&%d&%d&" % (width, height, channels))
        file.write(np.ascontiguousarray(planes, dtype="<f4").tobytes())
    os.replace(partial, path)
