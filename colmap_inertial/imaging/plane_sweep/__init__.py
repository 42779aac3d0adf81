"""Depth of posed pictures by a plane sweep: partners, candidates, matching, agreement, normals. Touches no file.

Views are pinhole cameras whose pixel centres are whole numbers. Depth is along the optical axis; 0 is unknown.
"""

from colmap_inertial.imaging.plane_sweep.agreement import DepthView as DepthView, agreed_depth as agreed_depth
from colmap_inertial.imaging.plane_sweep.depth import Partner as Partner, sweep_depth as sweep_depth
from colmap_inertial.imaging.plane_sweep.normals import normals_of as normals_of
from colmap_inertial.imaging.plane_sweep.partners import (
    Sights as Sights,
    chosen_partners as chosen_partners,
    depth_range as depth_range,
    partner_scores as partner_scores,
)
from colmap_inertial.imaging.plane_sweep.pinhole import Pinhole as Pinhole
