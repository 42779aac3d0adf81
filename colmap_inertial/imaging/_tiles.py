"""Division of an image for filters in the Fourier domain: overlapping tiles with one blur path each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.imaging._bilinear import bilinear
from colmap_inertial.imaging.blur_path import BlurPath


@dataclass(frozen=True, kw_only=True)
class TilingLimits:
    """Limits of the layout of tiles."""

    #: Part of a tile's side that is left out, since the filter has less than all of the blur there,
    margin: float = 48 / 256
    #: and the ramp over which neighbours are blended. What is left of the side between the ramps is flat.
    ramp: float = 64 / 256
    #: With shorter blur, tiles need less of the margin
    short_margin: float = 40 / 256
    #: and of the ramp:
    short_ramp: float = 48 / 256
    #: up to so many px of blur, tiles of the shortest side are laid out for short blur; above, for long blur.
    short_blur_px: float = 25.0
    #: Tiles of chroma, whose detail is coarse, are further apart where blur is below this, px of the half size:
    coarse_blur_px: float = 12.5
    #: with this part of the margin,
    coarse_margin: float = 24 / 256
    #: and of the ramp.
    coarse_ramp: float = 32 / 256
    #: A side is at least so many times as long as the blur.
    blurs_per_side: float = 5.0
    #: Shortest side of a tile,
    shortest_side_px: int = 256
    #: and longest one.
    longest_side_px: int = 2048


TILING = TilingLimits()


class TiledPaths(NamedTuple):
    """(Ty, Tx, S, 2) the path of each tile, px, and (Ty, Tx, 3) the covariance of its chord."""

    px: Float32Array
    cov_px2: Float32Array


@dataclass(frozen=True, kw_only=True)
class Tiling:
    """Squares that cover an image and more: the first begins before its corner, by its margin.

    Attributes
    ----------
    width, height
        Size of the image, px.
    side
        Of a tile, px, a power of two.
    margin
        That the result leaves out at each of a tile's borders; the input fades to nothing over it.
    ramp
        Over which neighbours are blended.
    """

    width: int
    height: int
    side: int
    margin: int
    ramp: int

    @classmethod
    def covering(cls, width: int, height: int, extent_px: float, *, coarse: bool = False) -> Tiling:
        """Tiles of an image with blur of at most this length; ``coarse`` for chroma."""
        side = TILING.shortest_side_px
        while side < TILING.blurs_per_side * extent_px and side < TILING.longest_side_px:
            side *= 2
        if coarse and extent_px <= TILING.coarse_blur_px:
            margin, ramp = TILING.coarse_margin, TILING.coarse_ramp
        elif extent_px <= TILING.short_blur_px:
            margin, ramp = TILING.short_margin, TILING.short_ramp
        else:
            margin, ramp = TILING.margin, TILING.ramp
        return cls(width=width, height=height, side=side, margin=int(margin * side), ramp=int(ramp * side))

    @property
    def hop(self) -> int:
        """Distance between neighbours."""
        return self.side - 2 * self.margin - self.ramp

    @property
    def before(self) -> int:
        """Distance from the beginning of the first tile to the image."""
        return self.margin

    @property
    def count(self) -> tuple[int, int]:
        """Rows and columns of tiles: all but the margin of the last ones reaches the image's end."""
        rows, columns = (max(1, -(-(n - self.ramp) // self.hop)) for n in (self.height, self.width))
        return rows, columns

    def paths(self, path: BlurPath) -> Float32Array:
        """(Ty, Tx, S, 2) the path in the middle of each tile, or at the image's border where that lies beyond."""
        return np.ascontiguousarray(path.at(*self._middles()), dtype=np.float32)

    def spreads(self, path: BlurPath) -> Float32Array:
        """(Ty, Tx, 3) covariance of the chords there: how uncertain they are, and how they change within the tile.

        To a filter with one path for all of a tile, the latter is no other than the former. A chord that changes
        evenly by d from one end of the tile's inner square to the other has the variance ``d^2 / 12``.
        """
        rows, columns = self._middles()
        out = path.cov_at(rows, columns)
        chords, step = path.field().vector_px.astype(np.float64), path.step_px
        reach = self.side / 2 - self.margin
        ends_y, ends_x = (
            [np.clip(at + end, 0, size - 1) / step for end in (-reach, reach)]
            for at, size in ((rows, self.height), (columns, self.width))
        )
        for (y0, y1), (x0, x1) in ((ends_y, [columns / step] * 2), ([rows / step] * 2, ends_x)):
            change = bilinear(chords, y1, x1) - bilinear(chords, y0, x0)
            out = out + change[..., [0, 0, 1]] * change[..., [0, 1, 1]] / 12
        return np.ascontiguousarray(out, dtype=np.float32)

    def _middles(self) -> tuple[Array, Array]:
        rows, columns = (
            np.clip(self.hop * np.arange(n) - self.before + self.side / 2 - 0.5, 0, size - 1)
            for n, size in zip(self.count, (self.height, self.width), strict=True)
        )
        return rows, columns

    def window_in(self) -> Float32Array:
        """(side,) by which rows and columns of a tile are multiplied before it is transformed."""
        rise = np.sin(0.5 * np.pi * (np.arange(self.margin) + 0.5) / self.margin) ** 2
        return self._mirror(np.concatenate([rise, np.ones(self.side // 2 - self.margin)]))

    def window_out(self) -> Float32Array:
        """(side,) shares of a tile in the result; those of neighbours add up to one.

        Of the first tile the half before its middle counts in full, of the last one that behind it.
        """
        rise = np.sin(0.5 * np.pi * (np.arange(self.ramp) + 0.5) / self.ramp) ** 2
        flat = np.ones(self.side // 2 - self.margin - self.ramp)
        return self._mirror(np.concatenate([np.zeros(self.margin), rise, flat]))

    @staticmethod
    def _mirror(half: Array) -> Float32Array:
        return np.concatenate([half, half[::-1]]).astype(np.float32)
