"""Matching costs and semi-global matching in numpy: slow, plain, and the truth that the compiled ones equal."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import BoolArray, Int32Array, Int64Array, UInt8Array, UInt16Array


def warped_reference(view: UInt8Array, columns: Int32Array, rows: Int32Array) -> tuple[UInt8Array, BoolArray]:
    """A view as the reference's pixels see it, bilinear, and where the view has them.

    Parameters
    ----------
    view
        (H, W) codes.
    columns, rows
        (W,), (H,) where the reference's columns and rows lie in the view, in sixteenths of a pixel.
    """
    height, width = view.shape
    x, y = np.clip(columns, 0, 16 * (width - 1)), np.clip(rows, 0, 16 * (height - 1))
    seen = (y == rows)[:, None] & (x == columns)
    (x, part_x), (y, part_y) = np.divmod(x, 16), np.divmod(y, 16)
    codes = view.astype(np.int32)
    lower = np.minimum(y + 1, height - 1)
    blended = (16 - part_y)[:, None] * codes[y] + part_y[:, None] * codes[lower]
    right = np.minimum(x + 1, width - 1)
    return (((16 - part_x) * blended[:, x] + part_x * blended[:, right] + 128) // 256).astype(np.uint8), seen


def census_reference(image: UInt8Array, radius: int) -> BoolArray:
    """(neighbours, H, W) whether each neighbour in a square window is darker than the pixel (Zabih, Woodfill 1994)."""
    return _neighbours(image, radius) < image


def _neighbours(image: UInt8Array, radius: int) -> UInt8Array:
    """(neighbours, H, W); beyond the border the image goes on as its border pixels."""
    height, width = image.shape
    padded = np.pad(image, radius, mode="edge")
    side = range(2 * radius + 1)
    return np.stack(
        [padded[dy : dy + height, dx : dx + width] for dy in side for dx in side if (dy, dx) != (radius, radius)]
    )


def matching_costs_reference(
    reference: UInt8Array,
    views: UInt8Array,
    *,
    columns: Int32Array,
    rows: Int32Array,
    share: Int32Array,
    unseen: int,
    radius: int,
    least: int = 0,
    tables: UInt8Array | None = None,
    blend: Int32Array | None = None,
    blend_table: UInt8Array | None = None,
    shown: Int32Array | None = None,
) -> UInt8Array:
    """(H, W, D) what each candidate costs, summed over the views; the arguments are the compiled kernel's."""
    count, candidates = columns.shape[:2]
    bits = census_reference(reference, radius)
    tells = np.abs(_neighbours(reference, radius).astype(np.int64) - reference) >= least
    costs = []
    for d in range(candidates):
        warped, seen = zip(*(warped_reference(views[k], columns[k, d], rows[k, d]) for k in range(count)), strict=True)
        if shown is not None:
            reach = radius if tables is None else 0
            seen = [
                one & _window_shown(columns[k, d], rows[k, d], shown[k], views.shape[1:], reach)
                for k, one in enumerate(seen)
            ]
        total = np.zeros(reference.shape, dtype=np.int64)
        for k in range(count):
            if tables is None:
                mismatch = np.count_nonzero((census_reference(warped[k], radius) != bits) & tells, axis=0)
            else:
                mismatch = tables[k][reference, warped[k]].astype(np.int64)
            total += mismatch * seen[k]
        by = np.sum(seen, axis=0)
        cost = np.where(by == 0, unseen, np.minimum(255, (share[by] * total + 128) >> 8))
        if blend is not None and blend_table is not None:
            residual = blend[0] * reference.astype(np.int64) + blend[-1]
            for k in range(count):
                residual += blend[k + 1] * warped[k].astype(np.int64)
            extra = blend_table[np.minimum(255, np.abs(residual) >> 8)].astype(np.int64)
            cost = np.where(by == count, np.minimum(255, cost + extra), cost)
        costs.append(cost.astype(np.uint8))
    return np.stack(costs, axis=-1)


def _window_shown(
    columns: Int32Array, rows: Int32Array, shown: Int32Array, shape: tuple[int, ...], reach: int
) -> BoolArray:
    """(H, W) whether all that a window's values are made of lies where a view shows something."""
    x, y = (np.clip(at, 0, 16 * (n - 1)) for at, n in ((columns, shape[1]), (rows, shape[0])))
    whole = np.ones((len(y), len(x)), dtype=bool)
    for row in (y // 16, (y + 15) // 16):
        for column in (x // 16, (x + 15) // 16):
            whole &= (column >= shown[row, :1]) & (column < shown[row, 1:])
    around = np.pad(whole, reach, mode="edge")
    size = 2 * reach + 1
    return np.all([around[i : i + len(y), j : j + len(x)] for i in range(size) for j in range(size)], axis=0)


def semi_global_reference(cost: UInt8Array, guide: UInt8Array, *, small: int, jump: UInt16Array) -> UInt16Array:
    """(H, W, D) costs summed along eight paths (Hirschmueller 2008, equations 12 to 14).

    Along a path ``L(p, d) = C(p, d) - min L(q) + min(L(q, d), L(q, d - 1) + small, L(q, d + 1) + small, min L(q) + j)``
    with ``q`` the pixel before ``p``, and ``j`` the jump for their difference in the guide.

    Parameters
    ----------
    cost
        (H, W, D).
    guide
        (H, W) codes.
    small
        Penalty for a change by one candidate.
    jump
        (256,) penalty for a larger one, by the difference of the guide's codes.
    """
    total = np.zeros(cost.shape, dtype=np.int64)
    for dy, dx in ((0, 1), (1, 1), (1, 0), (1, -1)):
        for flip in (slice(None), slice(None, None, -1)):
            view = (flip, flip)
            total[view] += _path(cost[view], guide[view], dy, dx, small, jump)
    return total.astype(np.uint16)


def _path(cost: UInt8Array, guide: UInt8Array, dy: int, dx: int, small: int, jump: UInt16Array) -> Int64Array:
    height, width, candidates = cost.shape
    if dy == 0:  # a row is a column of the transposed image
        turned = _path(cost.swapaxes(0, 1), guide.T, 1, 0, small, jump)
        return turned.swapaxes(0, 1)
    paths = cost.astype(np.int64)
    codes, jumps = guide.astype(np.int64), jump.astype(np.int64)
    here, there = slice(max(0, dx), width + min(0, dx)), slice(max(0, -dx), width + min(0, -dx))
    for y in range(1, height):
        before = paths[y - 1, there]
        if not before.size:
            continue
        least = before.min(axis=1, keepdims=True)
        best = np.minimum(before, least + jumps[np.abs(codes[y, here] - codes[y - 1, there])][:, None])
        if candidates > 1:
            best[:, 1:] = np.minimum(best[:, 1:], before[:, :-1] + small)
            best[:, :-1] = np.minimum(best[:, :-1], before[:, 1:] + small)
        paths[y, here] += best - least
    return paths
