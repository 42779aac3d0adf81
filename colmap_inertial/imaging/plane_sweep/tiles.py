"""Candidates of each part of an image, from depths at half its size."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array


@dataclass(frozen=True, kw_only=True)
class TileLimits:
    """Limits of tiles with candidates of their own."""

    #: Side of a tile: smaller ones need fewer candidates, but share more (2.2 times less work than all candidates; 1.8
    #: with 128 and 16).
    tile_px: int = 96
    #: What tiles share with their neighbours on each side.
    shared_px: int = 8
    #: Of a tile's depths at half the size, the share at the low end that is likeliest to be wrong,
    low_share: float = 0.002
    #: and up to which share they are believed;
    high_share: float = 0.998
    #: by how many candidates it may be off beyond the rest: three of the coarse ones.
    beyond: int = 6
    #: A tile of which a smaller share is known at half the size needs all candidates.
    least_known: float = 0.5
    #: Fewer candidates leave nothing to smooth over.
    fewest: int = 16


_LIMITS = TileLimits()


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A part of an image: what it is of, what is worked on for that, and the candidates."""

    rows: slice
    columns: slice
    inner_rows: slice
    inner_columns: slice
    candidates: slice

    @property
    def kept(self) -> tuple[slice, slice]:
        """The part of the worked area that belongs to the tile."""
        return _make_relative(self.inner_rows, self.rows), _make_relative(self.inner_columns, self.columns)


def cut_tiles(coarse: Array, shape: tuple[int, int], count: int) -> Iterator[Tile]:
    """Cut an image into tiles with the candidates that each needs.

    Parameters
    ----------
    coarse
        (h, w) candidates of a smaller image of the same, of those of the whole one; nan where unknown.
    shape
        Of the whole image.
    count
        How many candidates there are.
    """
    down, across = (small / whole for small, whole in zip(coarse.shape, shape, strict=True))
    for inner_rows, rows in _cut_side(shape[0]):
        for inner_columns, columns in _cut_side(shape[1]):
            coarse_tile = coarse[_scale_slice(rows, down), _scale_slice(columns, across)]
            known = coarse_tile[np.isfinite(coarse_tile)]
            candidates = slice(0, count)
            if len(known) >= max(1.0, _LIMITS.least_known * coarse_tile.size):
                low, high = np.quantile(known, (_LIMITS.low_share, _LIMITS.high_share))
                first, last = int(np.floor(low)) - _LIMITS.beyond, int(np.ceil(high)) + _LIMITS.beyond + 1
                more = max(0, _LIMITS.fewest - (last - first))
                first = min(max(0, first - more // 2), max(0, count - _LIMITS.fewest))
                candidates = slice(first, min(count, max(last + more, first + _LIMITS.fewest)))
            yield Tile(
                rows=rows,
                columns=columns,
                inner_rows=inner_rows,
                inner_columns=inner_columns,
                candidates=candidates,
            )


def _cut_side(length: int) -> list[tuple[slice, slice]]:
    """Tiles along a side, and the same with what they share."""
    number = -(-length // _LIMITS.tile_px)
    edges = [length * i // number for i in range(number + 1)]
    return [
        (slice(begin, end), slice(max(0, begin - _LIMITS.shared_px), min(length, end + _LIMITS.shared_px)))
        for begin, end in itertools.pairwise(edges)
    ]


def _scale_slice(part: slice, by: float) -> slice:
    return slice(int(np.floor(part.start * by)), int(np.ceil(part.stop * by)))


def _make_relative(inner: slice, outer: slice) -> slice:
    return slice(inner.start - outer.start, inner.stop - outer.start)
