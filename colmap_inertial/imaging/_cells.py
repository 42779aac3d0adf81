"""Division of an image into cells with one blur each, and where blur is too short to be undone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import BoolArray, Float32Array
from colmap_inertial.imaging.blur_field import BlurField

#: Side of a cell. The vector of its centre holds for all its pixels.
CELL_PX = 16
#: Blurs shorter than the first are left alone, longer than the second treated in full; between them, blended.
FADE_PX = (0.5, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Cells:
    """The blur of every cell, in C order.

    Attributes
    ----------
    extent_px
        (Ny, Nx) float32 length of the blur along its major axis, the axis of its larger component.
    slope
        (Ny, Nx) float32 minor over major component, within +-1.
    along_y
        (Ny, Nx) whether the major axis is y.
    fade
        (Ny + 1, Nx + 1) float32 share of the filter's result at the corners of the cells, 0 to 1.
    """

    extent_px: Float32Array
    slope: Float32Array
    along_y: BoolArray
    fade: Float32Array

    @classmethod
    def of(cls, blur: BlurField) -> Cells:
        """Of a field."""
        corner_y, corner_x = (np.arange(0, n + CELL_PX, CELL_PX) for n in (blur.height, blur.width))
        centre_y, centre_x = (
            (corner[:-1] + np.minimum(corner[1:], n) - 1) / 2
            for corner, n in ((corner_y, blur.height), (corner_x, blur.width))
        )
        centre = blur.at(centre_y, centre_x)
        size = np.abs(centre)
        along_y = size[..., 1] > size[..., 0]
        major, minor = np.where(along_y, centre[..., ::-1].transpose(2, 0, 1), centre.transpose(2, 0, 1))
        slope = np.divide(minor, major, out=np.zeros_like(major), where=major != 0)
        corner = blur.at(np.minimum(corner_y, blur.height - 1), np.minimum(corner_x, blur.width - 1))
        low, high = FADE_PX
        fade = np.clip((np.hypot(corner[..., 0], corner[..., 1]) - low) / (high - low), 0, 1)
        return cls(
            extent_px=np.ascontiguousarray(np.abs(major), dtype=np.float32),
            slope=np.ascontiguousarray(slope, dtype=np.float32),
            along_y=np.ascontiguousarray(along_y),
            fade=np.ascontiguousarray(fade, dtype=np.float32),
        )
