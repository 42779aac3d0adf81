"""Split an image for a network into overlapping parts whose middles make the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array
from colmap_inertial.imaging._bilinear import bilinear
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath

#: Sides of what a network sees are multiples of this, and so are the places of parts: it halves images four times.
MULTIPLE = 16
#: How far a network sees around what is kept of its result: the package's look 182 px beyond squares of 16 px.
OVERLAP_PX = 192
#: Pixels that a network sees at once, as in 1920 x 1080; each takes about 250 bytes.
MOST_PX = 1920 * 1088
#: What networks call 1: a length of blur, and a distance between the middle of a path and its mean, which is a third of
#: how far the middle of an arc is from its chord.
UNIT_PX, BEND_UNIT_PX = 32.0, 32.0 / 12


@dataclass(frozen=True)
class Span:
    """A part along one axis, in pixels of the image with its sides made multiples of 16.

    Attributes
    ----------
    begin, end
        What the network sees.
    keep_begin, keep_end
        What is kept of its result.
    """

    begin: int
    end: int
    keep_begin: int
    keep_end: int

    @property
    def size(self) -> int:
        """Size of the network's input."""
        return self.end - self.begin

    def kept(self, limit: int) -> tuple[slice, slice]:
        """Place of the kept part in the image, which ends at ``limit``, and in the result."""
        end = min(self.keep_end, limit)
        return slice(self.keep_begin, end), slice(self.keep_begin - self.begin, end - self.begin)


def tiles(height: int, width: int, most_px: int = MOST_PX) -> list[tuple[Span, Span]]:
    """Rows and columns of the parts of an image.

    Of the grids whose parts have ``most_px`` pixels at most, the one with the fewest in all. (Parts of one grid cell
    of 16 px and its overlap are as small as they get.)
    """
    rows, columns = _cut_spans(height, -1), _cut_spans(width, -1)
    for i in range(1, -(-height // MULTIPLE) + 1):
        some_rows = _cut_spans(height, i)
        for j in range(1, -(-width // MULTIPLE) + 1):
            some_columns = _cut_spans(width, j)
            if _largest_size(some_rows) * _largest_size(some_columns) <= most_px:
                if _total_size(some_rows) * _total_size(some_columns) < _total_size(rows) * _total_size(columns):
                    rows, columns = some_rows, some_columns
                break
    return [(row, column) for row in rows for column in columns]


def feed(image: AnyArray, row: Span, column: Span) -> Float32Array:
    """(1, 3, H, W) a part of an image, mirrored beyond its edges, full scale = 1; grey is three times the same.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3); codes of uint8 or uint16, or float32.
    row, column
        The part.
    """
    part = image[row.begin : row.end, column.begin : column.end]
    beyond = [(0, row.size - part.shape[0]), (0, column.size - part.shape[1]), (0, 0)]
    part = np.pad(part, beyond[: part.ndim], mode="reflect")
    scale = np.float32(1) if image.dtype == np.float32 else np.float32(1 / np.iinfo(image.dtype).max)
    out = np.empty((1, 3, row.size, column.size), dtype=np.float32)
    for c in range(3):
        np.multiply(part[..., c] if part.ndim == 3 else part, scale, out=out[0, c], casting="unsafe")
    return out


def blur_feed(blur: BlurField, row: Span, column: Span) -> Float32Array:
    """(1, 3, H / 2, W / 2) the blur of a part: (L cos 2a, L sin 2a, L) / 32 for L px at angle a.

    The double angle is the same for a vector and its negative. Values hold at the centres of 2 x 2 pixels.
    """
    out = np.empty((1, 3, row.size // 2, column.size // 2), dtype=np.float32)
    x, y = np.moveaxis(_sample_centres(blur, row, column), -1, 0)
    cosine, sine, length = out[0]
    np.divide(np.hypot(x, y), np.float32(UNIT_PX), out=length)
    per_length = np.divide(1 / UNIT_PX**2, length, out=np.zeros_like(length), where=length > 0)
    np.multiply(x * x - y * y, per_length, out=cosine)
    np.multiply(2 * x * y, per_length, out=sine)
    return out


def path_feed(path: BlurPath, row: Span, column: Span) -> Float32Array:
    """(1, 5, H / 2, W / 2) the path of a part: its chord as :func:`blur_feed` has it, and its bend.

    The bend is the mean of the path, (x, y) in units of `BEND_UNIT_PX`: nothing for a line that is run through evenly,
    and the same for a path and its reverse in time, as their blur is.
    """
    mean = path.path_px.mean(axis=0)
    bend = BlurField(width=path.width, height=path.height, step_px=path.step_px, vector_px=mean)
    out = np.empty((1, 5, row.size // 2, column.size // 2), dtype=np.float32)
    out[:, :3] = blur_feed(path.field(), row, column)
    out[0, 3:] = np.moveaxis(_sample_centres(bend, row, column), -1, 0) / BEND_UNIT_PX
    return out


def _sample_centres(blur: BlurField, row: Span, column: Span) -> Array:
    """(H / 2, W / 2, 2) a field at the centres of 2 x 2 pixels."""
    at_rows, at_columns = (
        np.minimum(np.arange(span.begin + 0.5, span.end, 2), limit - 1) / blur.step_px
        for span, limit in ((row, blur.height), (column, blur.width))
    )
    return bilinear(blur.vector_px, at_rows, at_columns)


def put(image: AnyArray, restored: Float32Array, row: Span, column: Span) -> None:
    """Put what is kept of (3, H, W) into an image of any type that :func:`feed` takes; grey gets the mean."""
    to_row, from_row = row.kept(image.shape[0])
    to_column, from_column = column.kept(image.shape[1])
    planes = restored[:, from_row, from_column]
    if image.ndim == 2:
        planes = planes.mean(axis=0, keepdims=True)
    target = image[to_row, to_column]
    for c, plane in enumerate(planes):
        values = np.clip(plane, 0, 1)
        if image.dtype != np.float32:
            values *= np.iinfo(image.dtype).max
            np.rint(values, out=values)
        # codes are whole already
        np.copyto(target[..., c] if image.ndim == 3 else target, values, casting="unsafe")


def _cut_spans(size: int, parts: int) -> list[Span]:
    """An axis in parts of the same size, but for the last one; as many as there can be where negative."""
    whole = -(-size // MULTIPLE) * MULTIPLE
    kept = MULTIPLE if parts < 0 else -(-whole // (parts * MULTIPLE)) * MULTIPLE
    return [
        Span(
            begin=max(0, begin - OVERLAP_PX),
            end=min(whole, begin + kept + OVERLAP_PX),
            keep_begin=begin,
            keep_end=min(begin + kept, whole),
        )
        for begin in range(0, whole, kept)
    ]


def _largest_size(spans: list[Span]) -> int:
    return max(span.size for span in spans)


def _total_size(spans: list[Span]) -> int:
    return sum(span.size for span in spans)
