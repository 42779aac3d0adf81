"""Colours for pixels that an aperture does not see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import BoolArray, Float32Array, IndexArray


@dataclass(frozen=True, kw_only=True)
class FillLimits:
    """Limits for the neighbours that colour a hidden pixel."""

    #: Neighbours on a square grid: this many steps to each side,
    steps: int = 3
    #: first as wide as the first spacing, then wider ones for pixels that have found too few.
    spacings_px: tuple[int, ...] = (3, 9, 27)
    #: How different a neighbour may be in the reference, share of full scale.
    similar: float = 0.05
    #: How different its disparity may be.
    same_depth_px: float = 1.0
    #: Sum of weights that makes a neighbourhood.
    enough_weight: float = 0.5
    #: Variance (share of full scale, squared) below which the reference says nothing about changes.
    flat_variance: float = 3e-4
    #: Pixels worked on at once.
    chunk: int = 1 << 16


_LIMITS = FillLimits()


def fill_hidden(values: Float32Array, seen: BoolArray, guide: Float32Array, disparity_px: Float32Array) -> Float32Array:
    """A colour's values where it was not seen, from how it goes with the reference's colour nearby.

    A line through (guide, value) of neighbours that are seen, of like brightness in the guide and of the same depth, by
    weighted least squares: the local linear model of the guided filter (He, Sun, Tang, PAMI 35(6), 2013) with the
    weights of a joint bilateral filter.

    Parameters
    ----------
    values
        (H, W), full scale 1.
    seen
        (H, W).
    guide
        (H, W) what the reference sees everywhere, full scale 1.
    disparity_px
        (H, W).
    """
    if seen.all():
        return values
    result = values.copy()
    rows, columns = np.nonzero(~seen)
    if not seen.any():
        result[rows, columns] = guide[rows, columns]
        return result
    slope, offset = _fit_line(values[seen], guide[seen])
    for spacing in _LIMITS.spacings_px:
        kept_rows, kept_columns = [], []
        for start in range(0, len(rows), _LIMITS.chunk):
            y, x = rows[start : start + _LIMITS.chunk], columns[start : start + _LIMITS.chunk]
            fitted, weight = _fit_neighbours(values, seen, guide, disparity_px, y, x, spacing)
            enough = weight > _LIMITS.enough_weight
            result[y[enough], x[enough]] = fitted[enough]
            kept_rows.append(y[~enough])
            kept_columns.append(x[~enough])
        rows, columns = np.concatenate(kept_rows), np.concatenate(kept_columns)
        if not len(rows):
            return result
    result[rows, columns] = slope * guide[rows, columns] + offset
    return result


def _fit_neighbours(
    values: Float32Array,
    seen: BoolArray,
    guide: Float32Array,
    disparity_px: Float32Array,
    y: IndexArray,
    x: IndexArray,
    spacing: int,
) -> tuple[Float32Array, Float32Array]:
    """(n,) values and (n,) sums of weights."""
    height, width = values.shape
    side = spacing * np.arange(-_LIMITS.steps, _LIMITS.steps + 1)
    dy, dx = (d.ravel() for d in np.meshgrid(side, side, indexing="ij"))
    at_y, at_x = y[:, None] + dy, x[:, None] + dx
    inside = (at_y >= 0) & (at_y < height) & (at_x >= 0) & (at_x < width)
    near = np.where(inside, at_y * width + at_x, 0)
    here = guide[y, x]
    of_guide, of_values = guide.ravel()[near], values.ravel()[near]
    difference = 0.5 * ((of_guide - here[:, None]) / np.float32(_LIMITS.similar)) ** 2
    difference += np.abs(disparity_px.ravel()[near] - disparity_px[y, x][:, None]) / np.float32(_LIMITS.same_depth_px)
    difference += (0.5 * (dy**2 + dx**2) / (2 * spacing) ** 2).astype(np.float32)
    weight = np.exp(-difference)
    weight *= inside & seen.ravel()[near]
    total = weight.sum(axis=1)
    share = weight / np.maximum(total, np.float32(1e-12))[:, None]
    mean_guide, mean_value = (share * of_guide).sum(axis=1), (share * of_values).sum(axis=1)
    variance = (share * of_guide**2).sum(axis=1) - mean_guide**2
    covariance = (share * of_guide * of_values).sum(axis=1) - mean_guide * mean_value
    fitted = mean_value + covariance / (np.maximum(variance, 0) + _LIMITS.flat_variance) * (here - mean_guide)
    return np.clip(fitted, 0, 1).astype(np.float32), total.astype(np.float32)


def _fit_line(values: Float32Array, guide: Float32Array) -> tuple[float, float]:
    """Slope and offset of values over the guide, for what has no neighbours."""
    mean_guide, mean_value = float(guide.mean()), float(values.mean())
    slope = float(np.mean((guide - mean_guide) * (values - mean_value))) / (float(guide.var()) + _LIMITS.flat_variance)
    return slope, mean_value - slope * mean_guide
