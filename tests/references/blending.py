"""Where the result of a filter counts, in numpy: the truth that the compiled blending is tested against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray
from colmap_inertial.imaging._cells import CELL_PX, Cells
from colmap_inertial.imaging.path_filters import SATURATED
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear

#: Spacing of the points at which the influence of lost light is worked out; between them it is bilinear.
NODE_PX = 4
#: The result counts nothing up to the first distance from lost light, and in full from the second one on; in blur
#: lengths, along the blur. The filter reaches two lengths, and a clipped lamp echoes most where it ends.
LOST_LIGHT_REACH = (2.0, 2.5)
#: The steepest that an image can be along its blur: from one pixel to the next by this times full scale over the length
#: of the blur. In theory 1, if the scene fits the sensor's range.
STEEPEST = 2.0


def blend_reference(image: AnyArray, light: Array, cells: Cells) -> AnyArray:
    """Codes of the light that a filter made of an (H, W, channels) image, where its share counts."""
    top = np.iinfo(image.dtype).max
    before = decode_table(image.dtype)[image].astype(np.float64)
    saturated = image >= np.ceil(SATURATED * top)
    channels = range(image.shape[2])
    lost = np.any([lost_light_reference(before[..., c], saturated[..., c], cells) for c in channels], axis=0)
    share = share_reference(lost, cells)[..., None]
    codes = np.floor(top * srgb_from_linear(before + share * (light - before)) + 0.5).astype(image.dtype)
    return np.where(share == 0, image, codes)


def lost_light_reference(light: Array, saturated: BoolArray, cells: Cells) -> BoolArray:
    """(H, W) where one channel is saturated by far more light than the sensor can hold.

    A blur of length L is the mean over L, so that a scene within the sensor's range changes by at most 1/L from pixel
    to pixel along it. Where a saturated pixel stands out more, it was a lamp or a glint. Most saturated pixels are not
    of that kind (sky, paper), and are deblurred like others: leaving them all out loses up to a third of the matches.
    """
    height, width = light.shape
    y, x = np.mgrid[:height, :width]
    extent, slope, along_y = (a[y // CELL_PX, x // CELL_PX] for a in (cells.extent_px, cells.slope, cells.along_y))
    major = np.maximum(1, np.floor(extent / 4 + np.float32(0.5)))
    minor = np.floor(major * slope + np.float32(0.5))
    dy, dx = (np.where(along_y, a, b).astype(np.intp) for a, b in ((major, minor), (minor, major)))
    darkest = np.minimum(
        *(light[np.clip(y + s * dy, 0, height - 1), np.clip(x + s * dx, 0, width - 1)] for s in (-1, 1))
    )
    return saturated & ((light - darkest) * extent > STEEPEST * major)


def share_reference(lost: BoolArray, cells: Cells) -> Array:
    """(H, W) share of the filter's result at every pixel, 0 to 1; the rest is the input.

    Short blurs fade out. So does the result near lost light.
    """
    height, width = lost.shape
    per_cell = CELL_PX // NODE_PX
    ny, nx = cells.extent_px.shape
    near = np.zeros((per_cell * ny + 1, per_cell * nx + 1), dtype=bool)  # lost light less than NODE_PX away
    rows, columns = np.nonzero(lost)
    for dy in (0, 1):
        for dx in (0, 1):
            near[rows // NODE_PX + dy, columns // NODE_PX + dx] = True
    i, j = np.mgrid[: near.shape[0], : near.shape[1]]
    cell = np.minimum(i // per_cell, ny - 1), np.minimum(j // per_cell, nx - 1)
    extent, slope, along_y = cells.extent_px[cell], cells.slope[cell], cells.along_y[cell]
    share = np.ones(near.shape, dtype=np.float32)
    zero_to, one_from = (np.float32(r) for r in LOST_LIGHT_REACH)
    for step in range(int(one_from * extent.max() / NODE_PX), -1, -1):
        minor = np.floor(np.float32(step) * slope + np.float32(0.5)).astype(np.intp)
        for sign in (-1, 1):
            at_y = i + sign * np.where(along_y, step, minor)
            at_x = j + sign * np.where(along_y, minor, step)
            inside = (at_y >= 0) & (at_y < near.shape[0]) & (at_x >= 0) & (at_x < near.shape[1])
            hit = (
                inside
                & near[np.where(inside, at_y, 0), np.where(inside, at_x, 0)]
                & (NODE_PX * step <= one_from * extent)
            )
            lengths = np.float32(NODE_PX * step) / np.maximum(extent, np.float32(1e-6))
            share = np.where(hit, np.clip((lengths - zero_to) / (one_from - zero_to), 0, 1), share)
    return _bilinear(cells.fade, CELL_PX, height, width) * _bilinear(share, NODE_PX, height, width)


def _bilinear(nodes: NDArray[np.floating], step_px: int, height: int, width: int) -> Array:
    """(height, width) interpolation of values at every ``step_px``-th pixel."""
    (i, s), (j, t) = (np.divmod(np.arange(n), step_px) for n in (height, width))
    s, t = s[:, None] / step_px, t / step_px
    upper = nodes[i][:, j] * (1 - t) + nodes[i][:, j + 1] * t
    lower = nodes[i + 1][:, j] * (1 - t) + nodes[i + 1][:, j + 1] * t
    return np.asarray(upper * (1 - s) + lower * s)
