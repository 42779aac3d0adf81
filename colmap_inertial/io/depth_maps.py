"""Depth maps beside frames: 16-bit images of millimetres, arrays of metres, with or without confidence."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray
from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types.depth import DepthMap, DepthMaps, PinholeGrid
from colmap_inertial.io.files import read_bytes, read_limits, reader
from colmap_inertial.io.images import read_image

#: Endings of files that hold depth.
SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".depth")
#: ARKit's levels of confidence, from the lowest, as it counts them and as images of them have them.
_HIGHEST_LEVEL, _HIGHEST_GREY = 2, 255
#: Depth of images, in metres for each step.
MILLIMETRES = 1e-3


@dataclass(frozen=True, kw_only=True)
class DepthFiles:
    """Where depth maps lie and what their numbers mean.

    Attributes
    ----------
    depth, confidence
        The files by the names of frames.
    view
        Intrinsics, of one for all or by the names of frames, in any size of the image: maps are smaller versions.
    metres
        Metres for each step of an image; arrays count in it, too.
    source
        What wrote them.
    is_fused
        As of :class:`DepthMaps`.
    """

    depth: Mapping[str, Path]
    confidence: Mapping[str, Path]
    view: PinholeGrid | Mapping[str, PinholeGrid]
    metres: float
    source: str
    is_fused: bool

    def maps(self) -> DepthMaps:
        """The maps of all frames, read as they are needed."""
        return DepthMaps(
            names=tuple(sorted(self.depth)),
            read=self._read,
            source=self.source,
            is_fused=self.is_fused,
            files={
                name: (str(path), str(self.confidence[name])) if name in self.confidence else (str(path),)
                for name, path in self.depth.items()
            },
        )

    def _read(self, name: str) -> DepthMap:
        view = self.view if isinstance(self.view, PinholeGrid) else self.view[name]
        confidence = self.confidence.get(name)
        return read_depth_map(self.depth[name], view, metres=self.metres, confidence=confidence)


@reader("a depth map")
def read_depth_map(
    path: Path, view: PinholeGrid, *, metres: float = MILLIMETRES, confidence: Path | None = None
) -> DepthMap:
    """Read one depth map.

    Parameters
    ----------
    path
        An image of one channel, an array of NumPy, or a Record3D ``.depth`` (float32, LZFSE).
    view
        Intrinsics; resized to the map's size.
    metres
        For each step of the file's numbers.
    confidence
        An image or array of the same size; only what has the highest level counts.

    Raises
    ------
    FormatError
        Where it is damaged, of another size than its confidence, or of another shape than the view.
    MissingExtraError
        For LZFSE without the package that reads it.
    """
    values = _read_values(path, view)
    if values.ndim != 2:
        raise FormatError(path, Fact("depth-not-one-channel", shape=values.shape))
    height, width = values.shape
    if abs(width * view.height - height * view.width) > max(view.width, view.height):
        raise FormatError(
            path, Fact("depth-of-other-shape", width=width, height=height, of_width=view.width, of_height=view.height)
        )
    depth_m = values.astype(np.float64) * metres
    if confidence is not None:
        sure = _read_values(confidence, view)
        if sure.shape != values.shape:
            raise FormatError(confidence, Fact("confidence-of-other-size", shape=sure.shape, depth=values.shape))
        depth_m = np.where(_is_sure(sure), depth_m, np.nan)
    return DepthMap(depth_m=depth_m, view=view.resized(width, height))


def _is_sure(confidence: AnyArray) -> BoolArray:
    highest = _HIGHEST_LEVEL if confidence.max(initial=0) <= _HIGHEST_LEVEL else _HIGHEST_GREY
    return np.asarray(confidence >= highest)


def _read_values(path: Path, view: PinholeGrid) -> AnyArray:
    if path.suffix.lower() == ".npy":
        data = read_bytes(path, what="depth map")
        array = np.load(io.BytesIO(data), allow_pickle=False)
        if array.dtype.kind not in "fui" or array.size > 1e6 * read_limits().megapixels:
            raise FormatError(path, Fact("depth-no-numbers", dtype=str(array.dtype)))
        return np.asarray(array)
    if path.suffix.lower() in (".depth", ".conf"):
        return _shape_of(path, unpack_lzfse(path, read_bytes(path, what="depth map")), view)
    return read_image(path)


def _shape_of(path: Path, data: bytes, view: PinholeGrid) -> AnyArray:
    """The array in bytes that do not state its shape: that of the view, in another size."""
    values: AnyArray = np.frombuffer(data, dtype=np.float32 if path.suffix.lower() == ".depth" else np.uint8)
    height = round((len(values) * view.height / view.width) ** 0.5)
    if height < 1 or len(values) % height:
        raise FormatError(path, Fact("depth-not-one-channel", shape=(len(values),)))
    return values.reshape(height, len(values) // height)


def unpack_lzfse(path: Path, data: bytes) -> bytes:
    """The content of an LZFSE file.

    Raises
    ------
    MissingExtraError
        Where it is compressed, and the package for that is not installed.
    """
    if data[:4] == b"bvx-" and data[-4:] == b"bvx$":  # stored as it is
        (count,) = struct.unpack("<I", data[4:8])
        if len(data) == 12 + count:
            return data[8 : 8 + count]
    if data[:3] != b"bvx":
        raise FormatError(path, Fact("not-lzfse"))
    try:
        import liblzfse
    except ImportError:
        raise MissingExtraError("record3d", Fact("lzfse-needs-package", path=str(path))) from None
    out: bytes = liblzfse.decompress(data)
    return out


def grid_of_matrix(width: int, height: int, matrix: Array) -> PinholeGrid:
    """A view by its intrinsics (3, 3), in which the top-left pixel's centre is (0, 0), as ARKit has it."""
    return PinholeGrid(
        width=width,
        height=height,
        focal_px=(float(matrix[0, 0]), float(matrix[1, 1])),
        centre_px=(float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5),
    )
