"""References within a model's files: what observations, tracks, images and frames name is there, and says the same.

COLMAP's reader takes them as they are, or stops with an expression of C++. Here they are looked at before it reads:
what names something that is gone counts as naming nothing, and what is there twice is refused.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.model.notes import take_note
from colmap_inertial.model.soundness import NUM_PARAMETERS

_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_NOTHING = np.uint64(2**64 - 1)
_KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
_CAMERA_DATA = np.dtype([("type", "<i4"), ("sensor", "<u4"), ("data", "<u8")])


@dataclass(frozen=True, eq=False)
class _Images:
    """Images of a model: numbers, names, cameras, where their key points begin, and the points that these name."""

    numbers: NDArray[np.int64]
    names: list[str]
    cameras: NDArray[np.int64]
    first: NDArray[np.int64]
    point: NDArray[np.uint64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Sound:
    """A model's files after the check.

    Attributes
    ----------
    changed
        By name without ending, the files that were changed.
    untracked
        (image, key point, point) of observations of points whose tracks are empty: they may be right.
    """

    changed: Mapping[str, bytes]
    untracked: NDArray[np.int64]


def check_references(files: Mapping[str, bytes], folder: Path, suffix: str, *, unique_names: bool = True) -> Sound:
    """Check what the files of a binary model name in each other.

    Parameters
    ----------
    files
        Content by name without ending; complete ones.
    folder, suffix
        Where from, for messages.
    unique_names
        Whether names that images share are refused, or only noted.

    Raises
    ------
    FormatError
        For numbers and names that are there twice, and images of cameras that are not there.
    """
    images = _read_images(files["images"])
    _check_images(images, files["cameras"], folder, suffix, unique_names=unique_names)
    changed: dict[str, bytes] = {}
    numbers, starts, lengths, elements = _read_points(files["points3D"])
    _require_unique(numbers, "point", folder / f"points3D{suffix}")
    owner = np.repeat(np.arange(len(numbers)), lengths)
    # where the tracks' key points are among all key points of all images; -1 where there is none
    order = np.argsort(images.numbers)
    at = order[np.minimum(np.searchsorted(images.numbers, elements["image"], sorter=order), len(order) - 1)]
    counts = np.diff(np.append(images.first, len(images.point)))
    known = (images.numbers[at] == elements["image"]) & (elements["keypoint"] < counts[at])
    place = np.where(known, images.first[at] + elements["keypoint"], 0)
    agrees = known.copy()
    if len(images.point):
        agrees &= images.point[place] == numbers[owner]
    named = np.zeros(len(images.point), bool)
    named[place[agrees]] = True
    lost = (images.point != _NOTHING) & ~named
    untracked = np.empty((0, 3), np.int64)
    if lost.any():
        in_model = np.isin(images.point, numbers)
        if not agrees.any():  # no track says anything: what the images say may be right
            which = np.flatnonzero(lost & in_model)
            image = np.searchsorted(images.first, which, side="right") - 1
            untracked = np.stack(
                [images.numbers[image], which - images.first[image], images.point[which].astype(np.int64)], axis=1
            )
        gone = lost.copy()
        if len(untracked):
            gone &= ~in_model
        if gone.any():
            fact = Fact("lost-points", count=int(gone.sum()), points=len(np.unique(images.point[gone])))
            take_note(folder / f"images{suffix}", fact)
        changed["images"] = _clear_points(files["images"], images, lost)
    if not agrees.all():
        take_note(folder / f"points3D{suffix}", Fact("lost-observations", count=int((~agrees).sum())))
        changed["points3D"] = _shorten_tracks(files["points3D"], starts, lengths, elements, agrees)
    if "frames" in files:
        frames = _drop_images(files["frames"], set(images.numbers.tolist()), folder / f"frames{suffix}")
        if frames is not None:
            changed["frames"] = frames
    return Sound(changed=changed, untracked=untracked)


def _check_images(images: _Images, cameras: bytes, folder: Path, suffix: str, *, unique_names: bool) -> None:
    known = _camera_numbers(cameras)
    _require_unique(known, "camera", folder / f"cameras{suffix}")
    path = folder / f"images{suffix}"
    _require_unique(images.numbers, "image", path)
    lost = np.flatnonzero(~np.isin(images.cameras, known))
    if len(lost):
        raise FormatError(
            path, Fact("unknown-camera", image=images.names[lost[0]], camera=int(images.cameras[lost[0]]))
        )
    name, count = next(iter(Counter(images.names).most_common(1)), ("", 0))
    if count > 1:
        fact = Fact("repeated-name", count=count, name=name)
        if unique_names:
            raise FormatError(path, fact)
        take_note(path, fact)


def _require_unique(numbers: NDArray[np.integer], what: str, path: Path) -> None:
    values, counts = np.unique(numbers, return_counts=True)
    if (counts > 1).any():
        raise FormatError(path, Fact("repeated-number", what=what, number=int(values[counts > 1][0])))


def _camera_numbers(data: bytes) -> NDArray[np.int64]:
    at, numbers = 8, []
    for _ in range(_U64.unpack_from(data)[0]):
        number, model = struct.unpack_from("<Ii", data, at)
        numbers.append(number)
        at += 24 + 8 * NUM_PARAMETERS[model]
    return np.array(numbers, np.int64)


def _read_images(data: bytes) -> _Images:
    at, numbers, names, cameras, first, points = 8, [], [], [], [0], []
    for _ in range(_U64.unpack_from(data)[0]):
        end = data.find(b"\0", at + 64)
        numbers.append(_U32.unpack_from(data, at)[0])
        cameras.append(_U32.unpack_from(data, at + 60)[0])
        names.append(data[at + 64 : end].decode("utf-8", "surrogateescape"))
        count = _U64.unpack_from(data, end + 1)[0]
        points.append(np.frombuffer(data, _KEYPOINT, count, end + 9)["point"])
        first.append(first[-1] + count)
        at = end + 9 + 24 * count
    joined = np.concatenate(points) if points else np.empty(0, np.uint64)
    return _Images(
        np.array(numbers, np.int64), names, np.array(cameras, np.int64), np.array(first[:-1], np.int64), joined
    )


def _read_points(data: bytes) -> tuple[NDArray[np.uint64], list[int], list[int], NDArray[np.void]]:
    """Numbers of points, where their records begin, lengths of their tracks, and these one after the other."""
    at, numbers, starts, lengths, tracks = 8, [], [], [], []
    number_of, length_of = _U64.unpack_from, _U64.unpack_from
    for _ in range(_U64.unpack_from(data)[0]):
        (length,) = length_of(data, at + 43)
        numbers.append(number_of(data, at)[0])
        starts.append(at)
        lengths.append(length)
        tracks.append(data[at + 51 : at + 51 + 8 * length])
        at += 51 + 8 * length
    return np.array(numbers, np.uint64), starts, lengths, np.frombuffer(b"".join(tracks), _ELEMENT)


def _clear_points(data: bytes, images: _Images, lost: NDArray[np.bool_]) -> bytes:
    """Images whose lost key points name no point."""
    out, at = bytearray(data), 8
    for i in range(len(images.numbers)):
        end = data.find(b"\0", at + 64)
        count = _U64.unpack_from(data, end + 1)[0]
        rows = np.frombuffer(out, _KEYPOINT, count, end + 9)
        rows["point"][lost[images.first[i] : images.first[i] + count]] = _NOTHING
        at = end + 9 + 24 * count
        del rows
    return bytes(out)


def _shorten_tracks(
    data: bytes, starts: list[int], lengths: list[int], elements: NDArray[np.void], kept: NDArray[np.bool_]
) -> bytes:
    """Points whose tracks have the kept elements alone."""
    out, done = [data[:8]], 0
    for start, length in zip(starts, lengths, strict=True):
        track = elements[done : done + length][kept[done : done + length]]
        out += [data[start : start + 43], _U64.pack(len(track)), track.tobytes()]
        done += length
    return b"".join(out)


def _drop_images(data: bytes, known: set[int], path: Path) -> bytes | None:
    """Frames without images that are not there; ``None`` where all are."""
    out, at, lost, empty = [], 8, 0, 0
    for _ in range(_U64.unpack_from(data)[0]):
        (count,) = _U32.unpack_from(data, at + 64)
        rows = np.frombuffer(data, _CAMERA_DATA, count, at + 68)
        kept = np.array([row["type"] != 0 or int(row["data"]) in known for row in rows], bool)
        lost += int((~kept).sum())
        if kept.any():
            out.append(data[at : at + 64] + _U32.pack(int(kept.sum())) + rows[kept].tobytes())
        else:
            empty += 1
        at += 68 + 16 * count
    if not lost:
        return None
    take_note(path, Fact("lost-images", count=lost, frames=empty))
    return _U64.pack(len(out)) + b"".join(out)
