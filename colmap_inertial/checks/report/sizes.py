"""How much the report shows, so that it stays readable and small for a recording of any length."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ReportSizes:
    """Of a page."""

    #: The largest models, which are shown in full.
    models: int = 3
    #: Frames in the plot of blur, images of the target, distances of the target.
    blur_frames: int = 3000
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
