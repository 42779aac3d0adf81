"""Matching of several views: costs of all candidates, and the candidate with the least sum of them along paths."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Float32Array, Int32Array, UInt8Array, UInt16Array

#: Pixels from the centre of the census window to its sides: 5 x 5 pixels, 24 comparisons.
CENSUS_RADIUS = 2
#: What a view can cost at most, of either kind.
MOST = (2 * CENSUS_RADIUS + 1) ** 2 - 1


@dataclass(frozen=True, kw_only=True)
class MatchingLimits:
    """Weights and memory of semi-global matching."""

    #: A pixel that no view sees costs this share of the most: more than a good match, less than a poor one.
    unseen: float = 0.25
    #: Penalty for disparities that change by one candidate, in shares of the most that all views can cost,
    small: float = 0.2
    #: and for those that change by more.
    jump: float = 2.0
    #: The jump's penalty is divided by the change of brightness over this many codes: edges of things are where they
    #: look different (Hirschmueller 2008, after equation 12).
    edge_codes: int = 8
    #: Costs and their sums that are held at once; larger images are matched in strips.
    memory_bytes: int = 512 * 2**20
    #: Rows that strips share with their neighbours on each side.
    overlap_rows: int = 48


MATCHING = MatchingLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class LightCost:
    """A cost of all views together: a weighted sum of their codes that would be zero.

    Attributes
    ----------
    blend
        (N + 1) weights of the reference, of the views, and a constant, in 1/256.
    table
        (256,) costs of what the sum is instead, in codes.
    """

    blend: Int32Array
    table: UInt8Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Pictures to compare, and how.

    Attributes
    ----------
    reference
        (H, W) codes.
    others
        (N, Hv, Wv) codes of the other views, each turned to the reference's orientation.
    least
        Difference of codes below which census passes over a comparison.
    tables
        (N, 256, 256) costs by the codes of the reference and a view, 0 to ``MOST``; ``None`` is census.
    light
        What colours that do not add up to luminance cost in addition.
    shown
        (N, Hv, 2) from and up to which column each row of a view shows something; ``None``: all of it. A window of
        which anything is looked up elsewhere has no say.
    """

    reference: UInt8Array
    others: UInt8Array
    least: int = 0
    tables: UInt8Array | None = None
    light: LightCost | None = None
    shown: Int32Array | None = None


def jump_table(views: int) -> tuple[int, UInt16Array]:
    """The small penalty, and (256,) that of a jump by the change of the reference's code."""
    most = MOST * _count_views(views)
    small = round(MATCHING.small * most)
    jump = MATCHING.jump * most / np.maximum(1, np.arange(256) / MATCHING.edge_codes)
    return small, np.maximum(small + 1, np.floor(jump)).astype(np.uint16)


def shares(views: int) -> Int32Array:
    """(views + 1,) factors in 1/256: a cost counts as if all views saw the pixel, and stays below 256."""
    by = np.maximum(1, np.arange(views + 1))
    return np.asarray(np.rint(256 * _count_views(views) / by), dtype=np.int32)


def _count_views(views: int) -> int:
    """The views that a cost of one byte can hold; those of more are scaled down."""
    return min(views, 255 // MOST)


def match_candidates(
    views: Views, columns: Int32Array, rows: Int32Array, *, threads: int
) -> tuple[Float32Array, UInt16Array]:
    """Semi-global matching of all views at once (Hirschmueller, PAMI 30(2), 2008).

    Parameters
    ----------
    columns, rows
        (N, D, W) and (N, D, H): where the reference's columns and rows lie in each view if a candidate is true, in
        1/16 px; outside of the view where it does not have them.
    threads
        0 takes all processors.

    Returns
    -------
    (H, W) candidates with the least sum of costs, between two where a parabola says so, and that sum.
    """
    from colmap_inertial._kernels import _apertures

    height, width = views.reference.shape
    count, number = columns.shape[:2]
    small, jump = jump_table(count)
    padded = -(-number // _apertures.PADDING) * _apertures.PADDING
    best = np.empty((height, width), dtype=np.float32)
    sums = np.empty((height, width), dtype=np.uint16)
    for begin, end, first, last in strips(height, width * (number + 2 * padded)):
        part = np.ascontiguousarray(views.reference[first:last])
        cost = np.empty((last - first, width, number), dtype=np.uint8)
        _apertures.matching_costs(
            part,
            views.others,
            columns=columns,
            rows=np.ascontiguousarray(rows[:, :, first:last]),
            cost=cost,
            share=shares(count),
            unseen=round(MATCHING.unseen * MOST * _count_views(count)),
            radius=CENSUS_RADIUS,
            least=views.least,
            tables=views.tables,
            blend=None if views.light is None else views.light.blend,
            blend_table=None if views.light is None else views.light.table,
            shown=views.shown,
            threads=threads,
        )
        total = np.empty((last - first, width, padded), dtype=np.uint16)
        _apertures.semi_global(cost, part, small=small, jump=jump, total=total, threads=threads)
        del cost
        least, index = (np.empty(part.shape, dtype=np.uint16) for _ in range(2))
        aside = np.empty(part.shape, dtype=np.float32)
        _apertures.winners(total, least=least, index=index, aside=aside, candidates=number, threads=threads)
        inner = slice(begin - first, end - first)
        best[begin:end] = (index + aside)[inner]
        sums[begin:end] = least[inner]
    return best, sums


def strips(height: int, bytes_a_row: int) -> list[tuple[int, int, int, int]]:
    """Rows of the result (begin, end) and rows to work on (first, last) for each strip that fits the memory."""
    fits = max(1, MATCHING.memory_bytes // bytes_a_row - 2 * MATCHING.overlap_rows)
    if height * bytes_a_row <= MATCHING.memory_bytes:
        fits = height
    count = -(-height // fits)
    edges = [height * i // count for i in range(count + 1)]
    return [
        (begin, end, max(0, begin - MATCHING.overlap_rows), min(height, end + MATCHING.overlap_rows))
        for begin, end in itertools.pairwise(edges)
    ]
