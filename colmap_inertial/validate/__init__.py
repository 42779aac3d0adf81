"""Is a reconstruction the right size? Checked with a target of known size in its images."""

from colmap_inertial.validate.markers import add_bars, add_check_points, add_other_target, distance_between
from colmap_inertial.validate.measure import validate_model
from colmap_inertial.validate.overlays import write_overlays
from colmap_inertial.validate.result import (
    Corner,
    Distance,
    RejectedView,
    SetScale,
    Validation,
    ViewResiduals,
    validation_table,
)
from colmap_inertial.validate.targets import Target, TargetSpecError, parse_target

__all__ = [
    "Corner",
    "Distance",
    "RejectedView",
    "SetScale",
    "Target",
    "TargetSpecError",
    "Validation",
    "ViewResiduals",
    "distance_between",
    "parse_target",
    "validate_model",
    "validation_table",
    "add_bars",
    "add_check_points",
    "add_other_target",
    "write_overlays",
]
