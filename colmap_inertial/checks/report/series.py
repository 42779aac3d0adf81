"""Long series made short without losing what matters, and numbers as short as they are true."""

from __future__ import annotations

import numpy as np

from colmap_inertial.checks.report.sizes import SIZES
from colmap_inertial.core.arrays import Array, IndexArray


def rounded(values: Array, digits: int = 5) -> list[float | None]:
    """Numbers with so many significant digits; ``None`` for those that are not finite."""
    values = np.asarray(values, dtype=np.float64).ravel()
    finite = np.isfinite(values)
    size = np.abs(np.where(finite & (values != 0), values, 1.0))
    unit = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    short = np.rint(np.where(finite, values, 0.0) * unit) / unit
    return [value if known else None for value, known in zip(short.tolist(), finite.tolist(), strict=True)]


def thinned(t_s: Array, values: Array, most: int = SIZES.line_points) -> dict[str, list[float | None]]:
    """A line of at most ``most`` points: of each of equally long parts, its smallest and its largest value.

    Parameters
    ----------
    t_s
        (N,) times, rising.
    values
        (N,); a part without any finite value stays a gap.

    Returns
    -------
    ``t_s`` and ``values``, ready for JSON, in order of time.
    """
    keep = np.arange(len(t_s)) if len(t_s) <= most else _extremes(np.asarray(values), most // 2)
    times = np.round(np.asarray(t_s)[keep], 4).tolist()
    return {"t_s": times, "values": rounded(np.asarray(values)[keep])}


def _extremes(values: Array, parts: int) -> IndexArray:
    edges = np.linspace(0, len(values), parts + 1).astype(np.intp)[:-1]
    part = np.repeat(np.arange(parts), np.diff(np.append(edges, len(values))))
    kept = []
    for sign in (1.0, -1.0):
        # sorted by part, then by value, so that the first of each part is its extreme; gaps come last
        order = np.lexsort((np.where(np.isfinite(values), sign * values, np.inf), part))
        kept.append(order[edges])
    return np.unique(np.concatenate(kept))


def strided(count: int, most: int) -> IndexArray:
    """At most ``most`` of ``count`` indices, evenly, first and last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.intp))
