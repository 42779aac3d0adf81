"""Depth of posed pictures by a plane sweep: partners, candidates, matching, agreement, normals. Touches no file.

Views are pinhole cameras whose pixel centres are whole numbers. Depth is along the optical axis; 0 is unknown.
"""

from colmap_inertial.imaging.plane_sweep.agreement import DepthView, agreed_depth
from colmap_inertial.imaging.plane_sweep.depth import Partner, sweep_depth
from colmap_inertial.imaging.plane_sweep.normals import normals_of
from colmap_inertial.imaging.plane_sweep.partners import Sights, chosen_partners, depth_range, partner_scores
from colmap_inertial.imaging.plane_sweep.pinhole import Pinhole

__all__ = [
    "DepthView",
    "Partner",
    "Pinhole",
    "Sights",
    "agreed_depth",
    "chosen_partners",
    "depth_range",
    "normals_of",
    "partner_scores",
    "sweep_depth",
]
