"""Lengths of a target that contradict each other: each kind is held against its own length and its own uncertainty.

A wrong ratio of a board's parts changes its short lengths by much and its long ones by little: against the longest,
both look right.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.facts import Fact
from colmap_inertial.validate.targets import Target


class Distance(Protocol):
    """A known distance, as ``result.Distance``."""

    @property
    def pair(self) -> tuple[str, str]: ...
    @property
    def known_m(self) -> float: ...
    @property
    def measured(self) -> float: ...
    @property
    def residual_m(self) -> float: ...


class SeenView(Protocol):
    """The target in one image, as ``result.ViewResiduals``."""

    @property
    def corner(self) -> IndexArray: ...
    @property
    def observed_px(self) -> Array: ...


#: Corners of printed targets are found so far off, all alike: ink and light spread over edges, pixels.
_EDGE_PX = 0.5
#: A mean is off where it is so many of its standard deviations from what it should be, of so many lengths.
_SIGMAS, _LEAST = 4.0, 4


def find_contradictions(
    target: Target, distances: Sequence[Distance], views: Sequence[SeenView], tolerance_pct: float
) -> list[Fact]:
    """Kinds of lengths, by size and direction on the board, whose mean is off against their own length; else a board
    that is stretched in one direction.

    Parameters
    ----------
    target
        What was measured.
    distances
        Its known distances.
    views
        The target in each image, which tell how large a pixel is.
    tolerance_pct
        Share of a length that counts as off.

    Returns
    -------
    One fact, of the kinds that are off most; empty where none is.
    """
    pixel_m = _pixel_on_target(target, views)
    if pixel_m is None:
        return []
    index = {target.label(i): i for i in range(len(target.part))}
    kinds: dict[tuple[int, str], list[Distance]] = defaultdict(list)
    for distance in distances:
        a, b = (index.get(name) for name in distance.pair)
        if a is None or b is None:
            continue
        along = "row" if target.row[a] == target.row[b] else "column" if target.column[a] == target.column[b] else ""
        if along:
            kinds[round(1e5 * distance.known_m), along].append(distance)
    off = []
    for (_, along), group in kinds.items():
        known_m = float(np.mean([distance.known_m for distance in group]))
        residuals = np.array([distance.residual_m for distance in group])
        mean_m, spread_m = float(residuals.mean()), float(residuals.std(ddof=1)) if len(group) > 1 else np.inf
        limit_m = max(tolerance_pct / 100 * known_m, _EDGE_PX * pixel_m, _SIGMAS * spread_m / np.sqrt(len(group)))
        if len(group) >= _LEAST and abs(mean_m) > limit_m:
            off.append((abs(mean_m) / known_m, known_m, mean_m, along))
    worst = sorted(off, reverse=True)[:2] or _find_stretch(kinds, tolerance_pct)
    if not worst:
        return []
    return [
        Fact(
            "lengths-contradict",
            kind=target.kind,
            gap=target.gap,
            lengths_mm=[1000 * known_m for _, known_m, _, _ in worst],
            off_pct=[100 * mean_m / known_m for _, known_m, mean_m, _ in worst],
            along=[along for *_, along in worst],
            likely_gap=_likely_gap(target, distances, index),
        )
    ]


def _find_stretch(
    kinds: Mapping[tuple[int, str], Sequence[Distance]], tolerance_pct: float
) -> list[tuple[float, float, float, str]]:
    """Longest lengths in both directions of a board that is longer in one of them than it should be.

    A scale from all lengths lies between both, and each may look right against it. By the slope of errors over length:
    edges that are found beside where they are lengthen or shorten all alike.
    """
    slopes, longest = {}, []
    for way in ("row", "column"):
        groups = [group for (_, along), group in kinds.items() if along == way]
        known_m = np.array([distance.known_m for group in groups for distance in group])
        residual_m = np.array([distance.residual_m for group in groups for distance in group])
        if len(groups) < 2 or len(known_m) < _LEAST + 2:
            return []
        by = np.stack([np.ones_like(known_m), known_m], axis=1)
        fit = np.linalg.lstsq(by, residual_m, rcond=None)[0]
        variance = float(np.sum((residual_m - by @ fit) ** 2)) / (len(known_m) - 2)
        slopes[way] = float(fit[1]), variance * float(np.linalg.inv(by.T @ by)[1, 1])
        group = max(groups, key=lambda group: group[0].known_m)
        mean_m = float(np.mean([distance.residual_m for distance in group]))
        longest.append((abs(mean_m) / group[0].known_m, group[0].known_m, mean_m, way))
    (row, row_variance), (column, column_variance) = slopes["row"], slopes["column"]
    limit = max(tolerance_pct / 100, _SIGMAS * (row_variance + column_variance) ** 0.5)
    return longest if abs(row - column) > limit else []


def _pixel_on_target(target: Target, views: Sequence[SeenView]) -> float | None:
    """Size of a pixel on the target, metres: the median over the images."""
    sizes = []
    for view in views:
        for part in np.unique(target.part[view.corner]):
            own = np.flatnonzero(target.part[view.corner] == part)
            known = target.corners_m[view.corner[own]]
            if len(own) < 2:
                continue
            far = int(np.argmax(np.linalg.norm(known - known[0], axis=1)))
            px = float(np.linalg.norm(view.observed_px[own[far]] - view.observed_px[own[0]]))
            if px > 0:
                sizes.append(float(np.linalg.norm(known[far] - known[0])) / px)
    return float(np.median(sizes)) if sizes else None


def _likely_gap(target: Target, distances: Sequence[Distance], index: dict[str, int]) -> float | None:
    """Gap between an AprilGrid's tags by their side, as measured."""
    if target.kind != "aprilgrid":
        return None
    sides, gaps = [], []
    for distance in distances:
        a, b = index[distance.pair[0]], index[distance.pair[1]]
        if a // 4 == b // 4:
            sides.append(distance.measured)
        elif np.isclose(distance.known_m, target.gap * target.length_m):
            gaps.append(distance.measured)
    return float(np.median(gaps) / np.median(sides)) if sides and gaps else None
