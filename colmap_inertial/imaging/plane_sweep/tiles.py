"""Which candidates each part of a picture needs, by depths that were found at half its size."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array

#: Sides of the tiles that have candidates of their own, and what they share with their neighbours on each side:
#: smaller tiles need fewer candidates, but share more (2.2 times less work than all candidates; 1.8 with 128 and 16).
_TILE_PX, _SHARED_PX = 96, 8
#: Of a tile's depths at half the size, the shares at each end that are likeliest to be wrong, and by how many
#: candidates it may be off beyond the rest: three of the coarse ones.
_LOW_SHARE, _HIGH_SHARE, _BEYOND = 0.002, 0.998, 6
#: A tile of which a smaller share is known at half the size needs all candidates.
_LEAST_KNOWN = 0.5
#: Fewer candidates leave nothing to smooth over.
_FEWEST = 16


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A part of a picture: what it is of, what is worked on for that, and the candidates."""

    rows: slice
    columns: slice
    inner_rows: slice
    inner_columns: slice
    candidates: slice

    @property
    def kept(self) -> tuple[slice, slice]:
        """Of what is worked on, what is of the tile."""
        return _within(self.inner_rows, self.rows), _within(self.inner_columns, self.columns)


def tiles_of(coarse: Array, shape: tuple[int, int], count: int) -> Iterator[Tile]:
    """Cut a picture into tiles with the candidates that each needs.

    Parameters
    ----------
    coarse
        (h, w) candidates of a smaller picture of the same, of those of the whole one; nan where unknown.
    shape
        Of the whole picture.
    count
        How many candidates there are.
    """
    down, across = (small / whole for small, whole in zip(coarse.shape, shape, strict=True))
    for inner_rows, rows in _cut(shape[0]):
        for inner_columns, columns in _cut(shape[1]):
            found = coarse[_scaled(rows, down), _scaled(columns, across)]
            known = found[np.isfinite(found)]
            candidates = slice(0, count)
            if len(known) >= max(1.0, _LEAST_KNOWN * found.size):
                low, high = np.quantile(known, (_LOW_SHARE, _HIGH_SHARE))
                first, last = int(np.floor(low)) - _BEYOND, int(np.ceil(high)) + _BEYOND + 1
                more = max(0, _FEWEST - (last - first))
                first = min(max(0, first - more // 2), max(0, count - _FEWEST))
                candidates = slice(first, min(count, max(last + more, first + _FEWEST)))
            yield Tile(
                rows=rows,
                columns=columns,
                inner_rows=inner_rows,
                inner_columns=inner_columns,
                candidates=candidates,
            )


def _cut(length: int) -> list[tuple[slice, slice]]:
    """Tiles along a side, and the same with what they share."""
    number = -(-length // _TILE_PX)
    edges = [length * i // number for i in range(number + 1)]
    return [
        (slice(begin, end), slice(max(0, begin - _SHARED_PX), min(length, end + _SHARED_PX)))
        for begin, end in itertools.pairwise(edges)
    ]


def _scaled(part: slice, by: float) -> slice:
    return slice(int(np.floor(part.start * by)), int(np.ceil(part.stop * by)))


def _within(inner: slice, outer: slice) -> slice:
    return slice(inner.start - outer.start, inner.stop - outer.start)
