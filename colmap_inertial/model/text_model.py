"""COLMAP's text models as binary ones: whatever other programs and editors make of the text, its records are counted.

pycolmap's own reader cuts names at blanks, takes an image for the key points of the one before where empty lines are
missing, and answers to any other fault with an expression of C++.
"""

from __future__ import annotations

import codecs
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS
from colmap_inertial.io.stand_ins import refuse_stand_in
from colmap_inertial.model.notes import take_note

#: COLMAP's last model, of panoramas, which no capture has.
MODEL_NAMES = (*CAMERA_MODELS, "EQUIRECTANGULAR")
_NUM_PARAMETERS = (*(count for count, _ in CAMERA_MODELS.values()), 2)
_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_KEYPOINTS = "X Y POINT3D_ID ... of the image above, or an empty line"
_POINT = "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX ..."
_RIG = "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID ..."
_FRAME = "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS ..."
_SENSORS = {"CAMERA": 0, "IMU": 1}
_KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_STATED = re.compile(r"#\s*Number of (cameras|images|points|rigs|frames):\s*(\d{1,15})")


class _Lines:
    """Lines of a text file, without white space around them, and what is said of them."""

    def __init__(self, path: Path) -> None:
        refuse_stand_in(path)
        data = read_bytes(path)
        coding = "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
        self.path = path
        try:
            text = data.decode(coding, errors="surrogateescape")
        except UnicodeDecodeError as error:
            raise FormatError(path, Fact("not-text", detail=error.reason)) from None
        self.lines = [line.strip() for line in re.split(r"\r\n|\n|\r", text)]
        self.with_commas = 0

    def records(self) -> Iterator[tuple[int, str]]:
        """Number and text of lines that are neither empty nor comments."""
        for number, line in enumerate(self.lines, start=1):
            if line and not line.startswith("#"):
                yield number, line

    def fault(self, number: int, expects: str) -> FormatError:
        text = self.lines[number - 1].encode("utf-8", "replace").decode("utf-8")[:60]
        return FormatError(self.path, Fact("text-line", expects=expects, text=text), line=number)

    def numbers(self, tokens: Sequence[str]) -> list[str]:
        """Numbers with commas at their ends, or for points, as if these were not there."""
        if not any("," in token for token in tokens):
            return list(tokens)
        self.with_commas += 1
        plain = [token.removesuffix(",") for token in tokens]
        return [token.replace(",", ".") if token.count(",") == 1 and "." not in token else token for token in plain]

    def finish(self, what: str, found: int) -> None:
        """Compare the number of records with what the head states, and tell what was made of odd lines."""
        stated = [m for line in self.lines if line.startswith("#") and (m := _STATED.match(line))]
        counts = {int(m[2]) for m in stated if m[1] == what}
        if counts and found not in counts:
            take_note(self.path, Fact("other-count", stated=max(counts), found=found, what=what))
        if self.with_commas:
            take_note(self.path, Fact("decimal-commas", count=self.with_commas))


def text_model_as_binary(folder: Path) -> dict[str, bytes]:
    """The files of a text model as COLMAP's binary ones, by name without ending.

    Raises
    ------
    FormatError
        Naming file and line.
    """
    files = {}
    for name, convert in _CONVERTERS.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            files[name] = convert(_Lines(path))
    return files


def count_images(path: Path) -> int:
    """Number of images of an ``images.txt``."""
    return sum(1 for _ in _images(_Lines(path)))


def _cameras(lines: _Lines) -> bytes:
    out = []
    for number, line in lines.records():
        tokens = line.split()
        try:
            camera, width, height = int(tokens[0].removesuffix(",")), *map(_whole, lines.numbers(tokens[2:4]))
            model = MODEL_NAMES.index(tokens[1].removesuffix(","))
            params = list(map(float, lines.numbers(tokens[4:])))
            if len(params) != _NUM_PARAMETERS[model]:
                raise ValueError
            out.append(struct.pack(f"<IiQQ{len(params)}d", camera, model, width, height, *params))
        except (ValueError, IndexError, struct.error):
            raise lines.fault(number, _CAMERA) from None
    lines.finish("cameras", len(out))
    return struct.pack("<Q", len(out)) + b"".join(out)


def _whole(token: str) -> int:
    value = float(token)
    if value != int(value):
        raise ValueError(token)
    return int(value)


def _image_head(lines: _Lines, line: str) -> tuple[bytes, bytes] | None:
    """The first line of an image as bytes before and of its name; ``None`` for any other line."""
    tokens = line.split(None, 9)
    if len(tokens) < 10:
        return None
    before = lines.with_commas
    numbers = lines.numbers(tokens[:9])
    try:
        head = struct.pack("<I7dI", int(numbers[0]), *map(float, numbers[1:8]), int(numbers[8]))
    except (ValueError, struct.error):
        lines.with_commas = before
        return None
    return head, tokens[9].encode("utf-8", "surrogateescape")


def _keypoints(lines: _Lines, line: str) -> bytes | None:
    """Key points as bytes; ``None`` where the line holds anything else."""
    tokens = line.split()
    if len(tokens) % 3:
        return None
    before = lines.with_commas
    numbers = lines.numbers(tokens)
    rows = np.empty(len(numbers) // 3, _KEYPOINT)
    try:
        rows["x"], rows["y"] = list(map(float, numbers[::3])), list(map(float, numbers[1::3]))
        rows["point"] = [number - 2**64 if (number := int(text)) >= 2**63 else number for text in numbers[2::3]]
    except (ValueError, OverflowError):
        lines.with_commas = before
        return None
    return rows.tobytes()


def _images(lines: _Lines) -> Iterator[tuple[bytes, bytes, bytes, bool]]:
    """Head, name and key points of each image, and whether its second line is missing."""
    at, text = 0, lines.lines
    while at < len(text):
        line = text[at]
        at += 1
        if not line or line.startswith("#"):
            continue
        head = _image_head(lines, line)
        if head is None:
            raise lines.fault(at, _IMAGE)
        while at < len(text) and text[at].startswith("#"):
            at += 1
        second = text[at] if at < len(text) else ""
        points, missing = _keypoints(lines, second) if second else b"", False
        if points is None:
            if _image_head(lines, second) is None:
                raise lines.fault(at + 1, _KEYPOINTS)
            points, missing = b"", True
        else:
            at += 1
        yield *head, points, missing


def _images_binary(lines: _Lines) -> bytes:
    out, short = [], 0
    for head, name, points, missing in _images(lines):
        out.append(b"".join((head, name, b"\0", struct.pack("<Q", len(points) // _KEYPOINT.itemsize), points)))
        short += missing
    if short:
        take_note(lines.path, Fact("images-without-second-line", count=short))
    lines.finish("images", len(out))
    return struct.pack("<Q", len(out)) + b"".join(out)


def _points(lines: _Lines) -> bytes:
    out = []
    for number, line in lines.records():
        tokens = lines.numbers(line.split())
        try:
            if len(tokens) < 8 or len(tokens) % 2:
                raise ValueError
            rgb = [_whole(token) for token in tokens[4:7]]
            fields = int(tokens[0]), *map(float, tokens[1:4]), *rgb, float(tokens[7]), len(tokens) // 2 - 4
            track = np.array(list(map(int, tokens[8:])), "<u4").tobytes()
            out.append(struct.pack("<Q3d3BdQ", *fields) + track)
        except (ValueError, OverflowError, struct.error):
            raise lines.fault(number, _POINT) from None
    lines.finish("points", len(out))
    return struct.pack("<Q", len(out)) + b"".join(out)


def _rigs(lines: _Lines) -> bytes:
    out = []
    for number, line in lines.records():
        tokens = line.split()
        try:
            record = struct.pack("<II", int(tokens[0]), int(tokens[1]))
            if int(tokens[1]):
                record += struct.pack("<iI", _SENSORS[tokens[2]], int(tokens[3]))
            at = 4
            for _ in range(int(tokens[1]) - 1):
                record += struct.pack("<iIB", _SENSORS[tokens[at]], int(tokens[at + 1]), int(tokens[at + 2]))
                at += 3
                if tokens[at - 1] != "0":
                    record += struct.pack("<7d", *map(float, tokens[at : at + 7]))
                    at += 7
            out.append(record)
        except (ValueError, IndexError, KeyError, struct.error):
            raise lines.fault(number, _RIG) from None
    lines.finish("rigs", len(out))
    return struct.pack("<Q", len(out)) + b"".join(out)


def _frames(lines: _Lines) -> bytes:
    out = []
    for number, line in lines.records():
        tokens = line.split()
        try:
            count = int(tokens[9])
            record = struct.pack("<II7dI", int(tokens[0]), int(tokens[1]), *map(float, tokens[2:9]), count)
            for i in range(10, 10 + 3 * count, 3):
                record += struct.pack("<iIQ", _SENSORS[tokens[i]], int(tokens[i + 1]), int(tokens[i + 2]))
            out.append(record)
        except (ValueError, IndexError, KeyError, struct.error):
            raise lines.fault(number, _FRAME) from None
    lines.finish("frames", len(out))
    return struct.pack("<Q", len(out)) + b"".join(out)


_CONVERTERS: dict[str, Callable[[_Lines], bytes]] = {
    "cameras": _cameras,
    "images": _images_binary,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}
