"""Size of the report: long series are thinned to their extremes, and numbers rounded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray


@dataclass(frozen=True, kw_only=True)
class ReportSizes:
    """Sizes of a page."""

    #: The largest models, which are shown in full.
    models: int = 3
    #: Frames in the plot of blur, images of the target, distances of the target.
    blur_frames: int = 3000
    #: Rows of the table of frames, and the width of their thumbnails.
    frame_rows: int = 120
    thumbnail_px: int = 112
    target_images: int = 4
    target_distances: int = 1500
    #: Points of a line: more than a screen has columns.
    line_points: int = 1200
    #: Of a model in 3-D: points, poses of the path, cameras drawn as pyramids, cells across the grid.
    scene_points: int = 12000
    scene_poses: int = 1200
    scene_cameras: int = 40
    grid_cells: int = 9
    #: Points that are seen this badly or by so few images tell little, and far ones make the rest small.
    worst_point_px: float = 2.0
    fewest_views: int = 3
    farthest_medians: float = 8.0
    #: Share of the points that boxes, extents and the ground leave out on each side.
    outside_pct: float = 1.5
    #: Images whose residuals are computed, cells across the longer side of the sensor and of the ground, cameras.
    residual_images: int = 300
    sensor_cells: int = 16
    ground_cells: int = 40
    cameras: int = 4
    #: Lengths of tracks are counted one by one up to here.
    longest_track: int = 12
    #: Points across an image at which its distortion is drawn.
    distortion_points: int = 15
    #: Of intrinsics, so that a row fits the narrowest page.
    most_decimals: int = 6
    #: Acceleration that filming by hand reaches, so that less looks like less.
    hand_m_s2: float = 1.0
    #: Paths longer than this bend and drift enough to say so: at 25 m, walks drift by millimetres.
    long_path_m: float = 30.0


SIZES = ReportSizes()


def nice_length(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten, at least ``value``."""
    power = 10.0 ** math.floor(math.log10(value)) if value > 0 else 1.0
    return next((m * power for m in (1, 2, 5) if m * power >= value * 0.999), 10 * power)


def round_values(values: Array, digits: int = 5) -> list[float | None]:
    """Numbers with so many significant digits; ``None`` for those that are not finite."""
    values = np.asarray(values, dtype=np.float64).ravel()
    finite = np.isfinite(values)
    size = np.abs(np.where(finite & (values != 0), values, 1.0))
    unit = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    short = np.rint(np.where(finite, values, 0.0) * unit) / unit
    return [value if known else None for value, known in zip(short.tolist(), finite.tolist(), strict=True)]


def thin_line(t_s: Array, values: Array, most: int = SIZES.line_points) -> dict[str, list[float | None]]:
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
    return {"t_s": times, "values": round_values(np.asarray(values)[keep])}


def _extremes(values: Array, parts: int) -> IndexArray:
    edges = np.linspace(0, len(values), parts + 1).astype(np.intp)[:-1]
    part = np.repeat(np.arange(parts), np.diff(np.append(edges, len(values))))
    kept = []
    for sign in (1.0, -1.0):
        # sorted by part, then by value, so that the first of each part is its extreme; gaps come last
        order = np.lexsort((np.where(np.isfinite(values), sign * values, np.inf), part))
        kept.append(order[edges])
    return np.unique(np.concatenate(kept))


def stride_indices(count: int, most: int) -> IndexArray:
    """At most ``most`` of ``count`` indices, evenly, first and last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.intp))
