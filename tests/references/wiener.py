"""The directional Wiener filter in numpy: slow, plain, and the truth that the compiled one is tested against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, IndexArray
from colmap_inertial.imaging import wiener
from colmap_inertial.imaging._cells import CELL_PX, Cells
from colmap_inertial.imaging._taps import Prior, TapTable, blur_spectrum
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear

#: Spacing of the points at which the influence of lost light is worked out; between them it is bilinear.
NODE_PX = 4
#: The result counts nothing up to the first distance from lost light, and in full from the second one on; in blur
#: lengths, along the blur. The filter reaches two lengths, and a clipped lamp echoes most where it ends.
LOST_LIGHT_REACH = (2.0, 2.5)
#: The steepest that an image can be along its blur: from one pixel to the next by this times full scale over the length
#: of the blur. In theory 1, if the scene fits the sensor's range.
STEEPEST = 2.0


def deblur_reference(image: AnyArray, blur: BlurField, options: wiener.DeblurOptions | None = None) -> AnyArray:
    """`deblur` in plain numpy; hundreds of times slower."""
    planes, cells, noise = wiener._prepare(image, blur, options or wiener.DeblurOptions())
    table = wiener._table(cells, noise)
    top = np.iinfo(image.dtype).max
    light = decode_table(image.dtype)[planes].astype(np.float64)
    saturated = planes >= wiener.lowest_saturated_code(image.dtype)
    channels = range(planes.shape[2])
    lost = np.any([lost_light_reference(light[..., c], saturated[..., c], cells) for c in channels], axis=0)
    share = share_reference(lost, cells)
    result = planes.copy()
    for c in channels:
        blended = light[..., c] + share * (filter_reference(light[..., c], cells, table) - light[..., c])
        codes = np.floor(top * srgb_from_linear(blended) + 0.5).astype(image.dtype)
        result[..., c] = np.where(share == 0, planes[..., c], codes)
    return result.reshape(image.shape)


def filter_reference(light: Array, cells: Cells, table: TapTable, cell_px: int = CELL_PX) -> Array:
    """Deblur one channel of linear light.

    Parameters
    ----------
    light
        (H, W).
    cells
        The blur.
    table
        Taps for its lengths.
    cell_px
        Side of the cells; 1 gives every pixel its own taps.

    Returns
    -------
    (H, W) ``sum_j w_j g(x + j, y + j slope)`` along the major axis, linearly interpolated between rows (columns where
    the major axis is y), ``g`` the image smoothed as the table says, mirrored about the
    centres of its border pixels.
    """
    height, width = light.shape
    light = smoothed_reference(light, table.smoothing)
    y, x = np.mgrid[:height, :width]
    extent, slope, along_y = (
        a[y // cell_px, x // cell_px] for a in (cells.extent_px.astype(np.float64), cells.slope, cells.along_y)
    )
    slope = slope.astype(np.float64)
    row, fraction = table.at(extent)
    reach = table.weights.shape[1] - 1
    result = np.zeros((height, width))
    for j in range(-reach, reach + 1):
        taps = table.weights[:, abs(j)].astype(np.float64)
        weight = taps[row] * (1 - fraction) + taps[row + 1] * fraction
        minor = j * slope
        before = np.floor(minor).astype(np.intp)
        part = minor - before
        for step, share in ((before, 1 - part), (before + 1, part)):
            source_y = mirrored(y + np.where(along_y, j, step), height)
            source_x = mirrored(x + np.where(along_y, step, j), width)
            result += weight * share * light[source_y, source_x]
    return result


def smoothed_reference(light: Array, weights: NDArray[np.floating]) -> Array:
    """(H, W) smoothed along rows and columns with symmetric weights at the distances 0, 1, ... px; mirrored borders."""
    for axis, size in enumerate(light.shape):
        at, smoothed = np.arange(size), weights[0] * light
        for k, weight in enumerate(weights[1:], 1):
            smoothed = smoothed + weight * sum(np.take(light, mirrored(at + s * k, size), axis) for s in (-1, 1))
        light = smoothed
    return light


def mirrored(index: IndexArray, size: int) -> IndexArray:
    """Indices reflected into ``0 .. size - 1`` about the first and last element, as often as needed."""
    if size == 1:
        return np.zeros_like(index)
    index = np.abs(index) % (2 * size - 2)
    return np.minimum(index, 2 * size - 2 - index)


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


def wiener_spectrum(extent_px: float, frequency: Array, prior: Prior) -> Array:
    """Transfer function of the unlimited Wiener filter."""
    transfer = blur_spectrum(extent_px, frequency)
    return np.asarray(transfer / (transfer**2 + prior.eps + prior.alpha * 4 * np.sin(np.pi * frequency) ** 2))


def _bilinear(nodes: NDArray[np.floating], step_px: int, height: int, width: int) -> Array:
    """(height, width) interpolation of values at every ``step_px``-th pixel."""
    (i, s), (j, t) = (np.divmod(np.arange(n), step_px) for n in (height, width))
    s, t = s[:, None] / step_px, t / step_px
    upper = nodes[i][:, j] * (1 - t) + nodes[i][:, j + 1] * t
    lower = nodes[i + 1][:, j] * (1 - t) + nodes[i + 1][:, j + 1] * t
    return np.asarray(upper * (1 - s) + lower * s)
