"""A target in the pictures that contradicts a scale is named, with what is likeliest wrong."""

from dataclasses import replace

import pytest

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ScaleEstimate
from colmap_inertial.validate import Validation, parse_target
from colmap_inertial.validate.agreement import contradict_scale, doubt_by_target

SCALE = ScaleEstimate(
    metres_per_unit=2.0, sigma_log=0.006, ci95=(1.976, 2.024), verdict="trusted", method="joint", reasons=()
)


def measured(error_pct: float | None, *, views: int = 30) -> Validation:
    """A target whose lengths are so far off, to +-0.2 %."""
    return Validation(
        **dict.fromkeys(("rms_px", "corner_noise_px", "pose_noise_px", "metres_per_unit"), 1.0),
        **dict.fromkeys(("views_searched", "corners_used", "corners_rejected"), 30),
        **dict.fromkeys(("distances", "corners", "views", "views_rejected", "reasons"), ()),
        **dict.fromkeys(("control", "check", "check_error_pct", "check_ci95_pct")),
        target=parse_target("checkerboard:8x6:0.04"),
        unscaled=error_pct is None,
        tolerance_pct=2.0,
        views_used=views,
        scale_error_pct=error_pct,
        ci95_pct=None if error_pct is None else (error_pct - 0.2, error_pct + 0.2),
        metres_per_unit_ci95=(0.9, 1.1),
    )


@pytest.mark.parametrize("error_pct", [0.5, -1.2, 2.3, None])
def test_what_both_intervals_explain_is_no_contradiction(error_pct: float | None) -> None:
    assert contradict_scale(SCALE, measured(error_pct)) is None
    assert doubt_by_target(SCALE, measured(error_pct)) is SCALE


def test_a_refused_scale_contradicts_nothing() -> None:
    refused = ScaleEstimate.refused("joint", Fact("fit-singular"))
    assert doubt_by_target(refused, measured(-24.0)) is refused


@pytest.mark.parametrize(
    ("reasons", "views", "error_pct", "likely"),
    [
        ((), 30, -24.0, "target"),
        ((), 1, -24.0, "target"),
        ((Fact("declared-focal-length", declared_px=700.0, found_px=530.0, sigma_px=4.0),), 30, -24.0, "camera"),
        ((Fact("accel-gain-doubtful", gain=0.03, excess=0.03),), 30, 4.0, "accelerometer"),
        ((Fact("accel-gain-doubtful", gain=0.03, excess=0.03),), 30, -24.0, ""),
        ((Fact("clip-short", span_s=5.0, needed_s=6.0),), 30, -24.0, ""),
    ],
)
def test_a_contradiction_is_named_first_with_what_is_likeliest(
    reasons: tuple[Fact, ...], views: int, error_pct: float, likely: str
) -> None:
    before = replace(SCALE, reasons=reasons, verdict="weak" if reasons else "trusted")
    doubted = doubt_by_target(before, measured(error_pct, views=views))
    assert doubted.verdict == "weak"
    (said,) = (reason for reason in doubted.reasons if reason.code == "target-contradicts-scale")
    # what is named as likeliest comes first, and what is named by itself before that
    assert doubted.reasons == ((*reasons, said) if likely == "camera" else (said, *reasons))
    assert said.values["likely"] == likely
    assert said.values["error_pct"] == error_pct and said.values["sigmas"] > 4
    # what is said twice is said once
    assert doubt_by_target(doubted, measured(error_pct, views=views)).reasons == doubted.reasons
