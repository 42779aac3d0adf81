"""What is said of models: how they were refined, joined, adjusted and put on the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from colmap_inertial.messages import message, state


def _say(fact: Any) -> str:
    """A fact with its advice."""
    return str(getattr(fact, "with_advice", fact))


# A refinement's choice and outcome.

state("refine-without-scale", "it has no scale")
state("refine-without-noise", "its scale was not estimated by the joint method, which gives the IMU's noise")


@message(example={"needed": 10})
def refine_images_few(needed: int) -> str:
    return f"it has fewer than {needed} images"


@message(example={"needed": 50})
def refine_points_few(needed: int) -> str:
    return f"it has fewer than {needed} points"


state("refine-several-cameras", "its images are of several cameras, each with its own lever arm")
state(
    "refine-accel-faults",
    "the accelerometer has faults, which the scale estimate corrected and the refinement would not",
)
state("refine-keypoints-moved", "its keypoints were moved by a stage that cannot be inverted")
state("refine-not-determined", "camera and IMU do not determine its shape")
state("refine-no-common-points", "no two of its images see the same point")
state("refine-imu-missing", "IMU data cover less than half of the time between the images")


@message(example={"made_from": "mesh.ply"})
def refine_shape_in_use(made_from: str) -> str:
    kept = f"{made_from} was made from it" if made_from else "the project also holds its parts"
    return f"{kept} and would keep the old shape (--refine inertial refines anyway)"


@message(example={"size_bytes": 5_000_000_000})
def refine_too_large(size_bytes: int) -> str:
    return f"frames far apart in time see the same points, and solving for all of them needs {1e-9 * size_bytes:.1f} GB"


@message(example={"share": 0.4})
def refine_takes_long(share: float) -> str:
    return f"it would take {100 * share:.0f} % of the time that features and mapping take"


@message(example={"alone_m": 0.002, "share": 0.0004})
def refine_shape_held(alone_m: float, share: float) -> str:
    error = f"{1e3 * alone_m:.2g} mm, {100 * share:.2g} % of its size"
    return f"the images alone fix the shape (expected error {error})"


def _expect(alone_m: float, refined_m: float) -> str:
    return f"expected error {1e3 * alone_m:.2g} mm by images alone, {1e3 * refined_m:.2g} mm"


@message(example={"alone_m": 0.02, "refined_m": 0.018, "risk": 0.2})
def refine_risky(alone_m: float, refined_m: float, risk: float) -> str:
    expected = _expect(alone_m, refined_m)
    return f"{expected} with the IMU, but {100 * risk:.0f} % of such paths become worse"


state("pictures-not-converged", "the adjustment by images alone, for comparison, does not converge")
state("refinement-not-converged", "the refinement does not converge")
state("refinement-not-converged-whole", "with all observations, the refinement does not converge")
state("refinement-unsure", "its uncertainty cannot be determined")
state("refinement-no-better", "it did not improve the held-out observations")


@message(example={"chi2": 5.2})
def imu_contradicts_images(chi2: float) -> str:
    return (
        f"the IMU contradicts the images (residuals {chi2:.1f} times the expected variance): check that both "
        "recordings belong together, and the IMU's axes and gains"
    )


@message(example={"shift_s": 0.05, "readout_s": 0.03})
def refined_times_far(shift_s: float, readout_s: float) -> str:
    return (
        f"the refined time offset ({1e3 * shift_s:+.0f} ms) and readout ({1e3 * readout_s:.0f} ms) are outside the "
        "range of the IMU data used: declare them"
    )


@message(
    example={"held_out": 800, "before_px": 0.71, "after_px": 0.65, "chi2": 1.1, "alone_m": None, "refined_m": None}
)
def refinement_evidence(
    held_out: int,
    before_px: float,
    after_px: float,
    chi2: float,
    alone_m: float | None = None,
    refined_m: float | None = None,
) -> str:
    chosen = "" if alone_m is None or refined_m is None else f"{_expect(alone_m, refined_m)} with the IMU; "
    return (
        f"{chosen}{held_out} held-out observations: {before_px:.4f} -> "
        f"{after_px:.4f} px; IMU residuals are {chi2:.2f} times the expected variance"
    )


@message(example={"why": "it has no scale"})
def not_refined(why: Any) -> str:
    return f"not refined: {_say(why)}"


@message(
    example={
        "why": "the refinement does not converge",
        "evidence": "IMU residuals are 1.10 times the expected variance",
    }
)
def refinement_rejected(why: Any, evidence: Any) -> str:
    return f"not refined, refinement discarded: {why} ({evidence})"


@message(
    example={
        "reasons": ("the scale is not known at all",),
        "evidence": "IMU residuals are 1.10 times the expected variance",
    }
)
def refined_scale_refused(reasons: Sequence[Any], evidence: Any) -> str:
    return f"not refined, refinement discarded: with it, {'; '.join(map(str, reasons))} ({evidence})"


@message(example={"evidence": "IMU residuals are 1.10 times the expected variance", "rolling_readout_s": 0.02})
def refined(evidence: Any, rolling_readout_s: float | None) -> str:
    if rolling_readout_s is None:
        return f"refined by the IMU ({evidence})"
    upwards = "" if rolling_readout_s > 0 else " from the last row to the first"
    return (
        f"refined by the IMU ({evidence}); poses are those of the middle row, and images and keypoints keep "
        f"their rolling "
        f"shutter of {1e3 * abs(rolling_readout_s):.1f} ms{upwards}"
    )


@message(example={"done": "refined by the IMU"})
def model_was(done: Any) -> str:
    return f"the model was {done}"


@message(example={"shift_px": 0.4, "before_px": 0.71, "after_px": 0.68, "accepted": True})
def readout_settled(shift_px: float, before_px: float, after_px: float, accepted: bool) -> str:
    return (
        f"translation within the readout moves points by {shift_px:.2f} px; reprojection error "
        f"{before_px:.3f} -> {after_px:.3f} px{'' if accepted else ': discarded'}"
    )


# Gaps between models.


@message(example={"why": "the scale of model 1 was refused"})
def model_apart(why: Any) -> str:
    return _say(why)


state("gap-not-judged", "it was not judged")
state("other-mounting", "their cameras are mounted differently on the IMU")
state("other-imu", "the two disagree on the IMU's biases, gains or clock, which changed in between")
state("no-pose-fits", "no relative pose of the two models fits the IMU's motion between them")
state("other-cameras", "the two models are of different cameras")


@message(example={"images": 40})
def same_part_twice(images: int) -> str:
    return f"{images} images are in both: they are two models of the same part of the recording"


@message(example={"images": 12})
def shared_images_disagree(images: int) -> str:
    return f"the {images} images in both models have different relative poses in the two"


@message(example={"first": 0, "second": 2})
def group_contradicts(first: int, second: int) -> str:
    return f"it would join models {first} and {second}, which contradict each other"


@message(example={"why": "it is longer than 5 s"})
def group_not_joined(why: Any) -> str:
    return f"with the parts joined to either: {why}"


@message(example={"chi2": 90.0, "dof": 9})
def gap_motion_contradicts(chi2: float, dof: int) -> str:
    return (
        f"the IMU's motion in the gap contradicts the motion before and after it (chi-square {chi2:.0f}, expected "
        f"{dof})"
    )


@message(example={"sigmas": 8.0})
def gap_poses_contradict(sigmas: float) -> str:
    return (
        f"the poses before and after the gap contradict the IMU or the shared images ({sigmas:.0f} standard deviations)"
    )


@message(example={"longest_s": 30.0})
def gap_too_long(longest_s: float) -> str:
    return f"it is longer than {longest_s:.0f} s"


@message(example={"silent_s": 0.5})
def gap_without_imu(silent_s: float) -> str:
    return f"the IMU recorded nothing for {silent_s:.2f} s of it"


@message(example={"sigma_m": 0.5, "limit_m": 0.1})
def gap_position_unsure(sigma_m: float, limit_m: float) -> str:
    return (
        f"the position after it is only known to {100 * sigma_m:.0f} cm (limit "
        f"{100 * limit_m:.3g} cm, --join-options.sigma-m)"
    )


@message(example={"sigma_deg": 4.0, "limit_deg": 2.0})
def gap_direction_unsure(sigma_deg: float, limit_deg: float) -> str:
    return (
        f"the direction after it is only known to {sigma_deg:.1f} deg (limit "
        f"{limit_deg:.3g} deg, --join-options.sigma-deg)"
    )


@message(example={"shared_images": 3, "matched_images": 5})
def gap_joined(shared_images: int, matched_images: int) -> str:
    by = [f"{shared_images} shared images"] if shared_images else []
    by += [f"{matched_images} matched images"] if matched_images else []
    return f"joined by {', '.join(by)}, and the IMU" if by else "joined by the IMU"


state("gap-joined-by-others", "joined through other models")


@message(example={"reason": "joined by the IMU"})
def gap_matches_left_out(reason: Any) -> str:
    return f"{reason} (contradicting matches between the two are left out)"


@message(example={"reason": "joined by the IMU"})
def gap_without_database(reason: Any) -> str:
    return f"{reason} (without matches between the two: COLMAP's database is missing)"


@message(example={"colmap_index": 1})
def join_scale_refused(colmap_index: int) -> str:
    return f"the scale of model {colmap_index} was refused"


state("join-other-method", "joining needs scales by the joint method")


@message(example={"colmap_index": 1})
def join_rig(colmap_index: int) -> str:
    return f"the cameras of model {colmap_index} are a rig"


@message(example={"numbers": (0, 2), "images": 120})
def models_joined(numbers: Sequence[int], images: int) -> str:
    return f"joined from COLMAP's models {', '.join(map(str, numbers))}, {images} images"


# Models on the map.


@message(example={"count": 2, "needed": 4})
def positions_too_few(count: int, needed: int) -> str:
    return f"{count} positions are too few: {needed} are needed"


@message(example={"half_width_deg": 60.0, "reach_m": 2.0, "error_m": 4.0})
def heading_unsure(half_width_deg: float, reach_m: float, error_m: float) -> str:
    return (
        f"+-{half_width_deg:.0f} deg: the path extends {reach_m:.1f} m to either side, "
        f"and the positions are accurate to {error_m:.1f} m; walk farther"
    )


@message(example={"ratio": 3.2})
def positions_of_another_path(ratio: float) -> str:
    return (
        f"the positions are {ratio:.2f} times as far apart as in the model: they are of another path, or the "
        "receiver stood still while the camera moved"
    )


@message(example={"ratio": 1.08, "half_width": 0.02})
def positions_of_another_scale(ratio: float, half_width: float) -> str:
    return (
        f"the positions are {ratio:.3f} times as far apart as in the model (+-{half_width:.3f}): "
        "either is wrong; the model's scale is unchanged"
    )


@message(example={"slow_m": 3.0, "factor": 2.0})
def accuracy_assumed(slow_m: float, factor: float) -> str:
    return f"no accuracy is stated: slow errors of {slow_m:g} m (within a factor of {factor:g}) are assumed"


@message(example={"height_above": "sea"})
def heights_not_of_ellipsoid(height_above: str | None) -> str:
    zero = "sea level" if height_above == "sea" else "the receiver's own zero"
    return f"heights are above {zero}, not above the ellipsoid; the two differ by up to 100 m"


# Exports without metres or up.

state("units-not-metres", "the scale was refused: units are not metres")
state(
    "units-never-scaled",
    "this model was never scaled: units are not metres",
)
state("up-unknown", "the direction of gravity is not known: z is assumed to be up")
