"""Depth of posed images by a plane sweep: partners, matching, agreement, smoothing, normals. Touches no file.

Views are pinhole cameras whose pixel centres are whole numbers. Depth is along the optical axis; 0 is unknown.
"""

from colmap_inertial.imaging.plane_sweep.agreement import (
    Agreement as Agreement,
    DepthView as DepthView,
    confirm_depth as confirm_depth,
)
from colmap_inertial.imaging.plane_sweep.confidence import (
    MEASURES as MEASURES,
    estimate_sigma as estimate_sigma,
    keep_certain as keep_certain,
    measure_pixels as measure_pixels,
)
from colmap_inertial.imaging.plane_sweep.depth import Partner as Partner, sweep_depth as sweep_depth
from colmap_inertial.imaging.plane_sweep.normals import estimate_normals as estimate_normals
from colmap_inertial.imaging.plane_sweep.partners import (
    Sights as Sights,
    choose_partners as choose_partners,
    depth_range as depth_range,
    score_partners as score_partners,
)
from colmap_inertial.imaging.plane_sweep.pinhole import Pinhole as Pinhole
from colmap_inertial.imaging.plane_sweep.smoothing import (
    PLANE_MEASURES as PLANE_MEASURES,
    measure_planes as measure_planes,
    smooth_depth as smooth_depth,
)
