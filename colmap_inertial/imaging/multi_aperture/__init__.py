"""Cameras of several small apertures, each with its own colour filter: one RGB image without parallax.

:func:`rectify` prepares a rig once; :func:`fuse_apertures` fuses an exposure, :func:`estimate_disparity` and
:func:`fuse_with` are its two halves; :func:`refocus` blurs what lies off a plane.
"""

from colmap_inertial.imaging.multi_aperture._geometry import Rectified as Rectified, rectify as rectify
from colmap_inertial.imaging.multi_aperture.disparity import (
    Disparity as Disparity,
    estimate_disparity as estimate_disparity,
)
from colmap_inertial.imaging.multi_aperture.fusion import (
    Fused as Fused,
    fuse_apertures as fuse_apertures,
    fuse_with as fuse_with,
    plane_of as plane_of,
    require_colours as require_colours,
)
from colmap_inertial.imaging.multi_aperture.refocus import refocus as refocus
