"""What the search for a target and the fit of its size decide by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DetectionLimits:
    """What counts as a target in an image."""

    #: Checkerboards are searched in images whose longer side is at most this long, and refined in the original.
    search_size_px: int = 1600
    #: Boards that are looked for in one image.
    most_boards: int = 3
    smallest_marker_px: float = 12.0
    #: A pose needs three corners; a fourth one checks it.
    least_corners: int = 4
    #: Edges of a lone marker: profiles across them, sampled this finely, at least for cells of this size.
    profile_step_px: float = 0.25
    least_cell_px: float = 3.0
    edge_iterations: int = 4
    #: Grey values that an edge must rise by.
    least_contrast: float = 8.0
    #: Half step of the numeric derivative of the projection, as an angle.
    derivative_step_rad: float = 1e-4
    #: A corner whose ray is projected further off than this cannot be used.
    round_trip_px: float = 0.05


@dataclass(frozen=True, kw_only=True)
class PlacementLimits:
    """Where a target stands in a model, and which images agree on it."""

    #: Images with the target after which checkerboards are no longer searched thoroughly, and images searched so.
    enough_views: int = 10
    most_thorough_views: int = 60
    #: Smallest share of the images with sightings that must agree. Two boards in view leave half of them.
    smallest_agreement: float = 0.2
    #: Pairs of sightings that a place is computed from, and rounds of refining the best.
    most_pairs: int = 80
    refinements: int = 5
    #: Two sightings give a place where their lines of sight meet at this angle.
    least_parallax_deg: float = 0.5
    #: Images that are looked at for a mirrored target, and for a board of another size.
    mirror_views: int = 20
    hint_views: int = 10


@dataclass(frozen=True, kw_only=True)
class FitLimits:
    """The size of the target and its interval."""

    #: Corners beyond so many standard deviations do not belong.
    outlier_sigma: float = 5.0
    #: Views whose residuals are so many times those of the others do not belong.
    outlier_view_ratio: float = 4.0
    #: A half-width of the 95 % interval of this factor is no result.
    widest_factor: float = 1.3
    #: Single markers whose size differs by more (logarithm) are not what the description says.
    outlying_marker_log: float = 0.05
    #: Pose errors are assumed where they raise twice the log likelihood by more than this. Of data without any, one
    #: set in six passes; always assuming them would widen the intervals of such data to 97 % coverage, and a stricter
    #: test would miss small real ones.
    pose_error_evidence: float = 3.0
    #: A variance component whose effect in one view is below this share of the corner noise counts as zero.
    negligible_ratio: float = 2e-3
    largest_ratio: float = 1e6
    most_iterations: int = 50
    #: The fit has settled when a step would lower the cost by less than this share of the noise variance (a
    #: ten-thousandth of a standard deviation), or by less than this in all.
    settled_share: float = 1e-8
    settled_px2: float = 1e-14
    #: Points that a rigid motion needs, with one to spare.
    least_points: int = 4
    #: Shares of the model's diagonal below which a length says little of the whole, and above which it says much.
    short_share: float = 0.2
    long_share: float = 0.66
    #: Points left out on each side when the model's diagonal is taken.
    outside_pct: float = 1.5
    #: Least spread of the directions of the lengths along an axis, of the largest, to count as one of its own.
    own_direction: float = 0.1


DETECTION = DetectionLimits()
PLACEMENT = PlacementLimits()
FIT = FitLimits()
