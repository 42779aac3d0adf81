"""Whether a scale and a target of known size in the images agree; where not, which of them is likelier wrong."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import ScaleEstimate
from colmap_inertial.model import add_doubts
from colmap_inertial.validate.result import Validation

_CODE = "target-contradicts-scale"
#: They contradict each other from so many standard deviations of both on, as chance does once in 10,000 models, and
#: beyond the tolerance.
_SIGMAS = 4.0
#: A difference that an accelerometer's gain makes is at most so many times the gain that is found.
_GAINS = 2.0

Likely = Literal["camera", "readout", "declared", "target", "accelerometer", ""]
#: What is named in a scale's reasons already, and bends or scales a model, the likeliest first.
_NAMED: tuple[tuple[str, Likely], ...] = (
    ("declared-focal-length", "camera"),
    ("declared-distortion", "camera"),
    ("declared-readout", "readout"),
    ("rolling-shutter-ignored", "readout"),
    ("calibrated-gain-contradicted", "declared"),
    ("declared-lever-arm", "declared"),
)


def doubt_by_target(estimate: ScaleEstimate, validation: Validation) -> ScaleEstimate:
    """A scale with a doubt where a target of known size in the images contradicts it; the same where it does not.

    Parameters
    ----------
    estimate
        Of a metric model.
    validation
        Of a target in this model.
    """
    fact = contradict_scale(estimate, validation)
    if fact is None:
        return estimate
    # what is likeliest wrong comes before what it does
    named = {code for code, _ in _NAMED}
    first = tuple(reason for reason in estimate.reasons if reason.code in named)
    rest = tuple(reason for reason in estimate.reasons if reason.code not in {_CODE, *named})
    return replace(add_doubts(estimate, (fact,)), reasons=(*first, fact, *rest))


def contradict_scale(estimate: ScaleEstimate, validation: Validation) -> Fact | None:
    """By how much lengths of a target are off in a metric model, and what is likeliest wrong.

    ``None`` where the scale's interval and the target's explain the difference.
    """
    if validation.scale_error_pct is None or validation.ci95_pct is None or estimate.sigma_log is None:
        return None
    error, low, high = (math.log1p(pct / 100) for pct in (validation.scale_error_pct, *validation.ci95_pct))
    sigma = math.hypot(estimate.sigma_log, (high - low) / (2 * Z95))
    if abs(validation.scale_error_pct) <= validation.tolerance_pct or abs(error) <= _SIGMAS * sigma:
        return None
    return Fact(
        _CODE,
        target=validation.target.spec,
        error_pct=validation.scale_error_pct,
        sigmas=abs(error) / sigma,
        likely=_find_likely(estimate, validation, error),
    )


def _find_likely(estimate: ScaleEstimate, validation: Validation, error: float) -> Likely:
    codes = {reason.code: reason for reason in estimate.reasons}
    for code, likely in _NAMED:
        if code in codes:
            return likely
    # a board whose own lengths disagree, or that few images show, is not the stated one
    if validation.doubts:
        return "target"
    doubtful = codes.get("accel-gain-doubtful")
    if doubtful is not None and abs(error) < _GAINS * abs(float(doubtful.values["gain"])):
        return "accelerometer"
    # where nothing else speaks against a scale, a board's size is what was measured by hand
    return "" if codes.keys() - {_CODE} else "target"
