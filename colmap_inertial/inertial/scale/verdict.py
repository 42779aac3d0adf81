"""Interval and verdict from a scale and its standard deviation, and the parts of the interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import Verdict

#: Half-widths of the 95 % interval, relative to the scale, up to which a scale is trusted, and given at all.
TRUSTED_HALF_WIDTH = 0.03
WEAK_HALF_WIDTH = 0.30
#: A drift of the scale is reported where chance would show as much once in ten thousand recordings.
_DRIFT_PROBABILITY, _DRIFT_SIGMAS = 1e-4, 3.89
#: Clocks of camera and IMU that part faster make a scale weak: action cameras' do by .2 % (one standard deviation;
#: none of 2,076 clean windows of other recordings does by .1), and what either makes of metres is in the interval.
_APART_RATE = 2.5e-3


def half_width(sigma_log: float) -> float:
    """Half-width of the log-symmetric 95 % interval relative to the scale: ``(hi - lo) / (2 scale)``."""
    exponent = Z95 * sigma_log
    return math.sinh(exponent) if exponent < 700 else math.inf


def student_factor(freedom: float) -> float:
    """Two-sided 95 % quantile of Student's distribution over that of the normal one, for any degrees of freedom.

    The expansion by Hill (Communications of the ACM 1970), within 1 % from three degrees of freedom on; fewer count as
    three.
    """
    n = max(freedom, 3.0)
    z = Z95
    terms = (
        (z**2 + 1) / 4,
        (5 * z**4 + 16 * z**2 + 3) / 96,
        (3 * z**6 + 19 * z**4 + 17 * z**2 - 15) / 384,
    )
    return 1 + sum(term / n**power for power, term in enumerate(terms, start=1))


def scale_drifts(p_value: float, trend_log_per_s: float, trend_sigma_log_per_s: float) -> bool:
    """Whether the scales of parts of a recording differ by more than chance, or steadily grow or shrink.

    Parameters
    ----------
    p_value, trend_log_per_s, trend_sigma_log_per_s
        Of a ``ScaleDrift``.
    """
    return p_value < _DRIFT_PROBABILITY or abs(trend_log_per_s) > _DRIFT_SIGMAS * trend_sigma_log_per_s


def check_clocks(clock_rate: float) -> list[str]:
    """A sentence where camera and IMU measure time so differently that metres, which go with its square, are in doubt.

    Parameters
    ----------
    clock_rate
        Of a ``CameraImuCalibration``.
    """
    if abs(clock_rate) <= _APART_RATE:
        return []
    return [
        f"the clocks of camera and IMU run {100 * abs(clock_rate):.2g} % apart; if it is the camera's that is wrong, "
        f"lengths are {200 * abs(clock_rate):.2g} % off: check first that frame times are those of the recorder, not "
        "counted at a nominal frame rate, then the stamps of the IMU"
    ]


def verdict_of(
    metres_per_unit: float,
    sigma_log: float,
    checks: Sequence[str] = (),
    *,
    refusals: Sequence[str] = (),
) -> tuple[Verdict, tuple[float, float], tuple[str, ...]]:
    """Judge a scale estimate.

    Parameters
    ----------
    metres_per_unit
        The estimate.
    sigma_log
        Standard deviation of its logarithm.
    checks
        A sentence for each check that failed. Any of them keeps the verdict from being ``"trusted"``.
    refusals
        A sentence for each finding that makes the number worthless whatever its width.

    Returns
    -------
    verdict
        ``"trusted"`` up to a half-width of 3 %, ``"weak"`` up to 30 %, else ``"refused"``.
    ci95
        (low, high), symmetric in the logarithm of the scale.
    reasons
        ``refusals``, ``checks``, and a sentence on the width where it decided.
    """
    if not (math.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise ValueError(f"metres_per_unit must be positive and finite, not {metres_per_unit}")
    if not sigma_log >= 0:
        raise ValueError(f"sigma_log must not be negative, not {sigma_log}")
    width = half_width(sigma_log)
    factor = math.exp(min(Z95 * sigma_log, 700.0))
    ci95 = (metres_per_unit / factor, metres_per_unit * factor)
    reasons = [*refusals, *checks]
    verdict: Verdict = "weak" if checks else "trusted"
    if width > TRUSTED_HALF_WIDTH:
        verdict = "weak"
    if width > WEAK_HALF_WIDTH:
        known = f"known to no better than +-{100 * width:.0f} %" if width < 10 else "not known at all"
        reasons.append(
            f"the scale is {known}: record a clip in which the camera itself speeds up and slows down "
            "(swing it back and forth by 20 cm or more, for 10 s or longer) while it sees texture"
        )
    elif width > TRUSTED_HALF_WIDTH:
        reasons.append(f"the 95 % interval is +-{100 * width:.1f} %: more or livelier motion would narrow it")
    if width > WEAK_HALF_WIDTH or refusals:
        verdict = "refused"
    return verdict, ci95, tuple(reasons)


@dataclass(frozen=True, kw_only=True)
class Cause:
    """One cause of uncertainty.

    Attributes
    ----------
    words
        What it is.
    advice
        What removes it.
    """

    words: str
    advice: str


_TURN = "turn the camera about all of its axes while it moves"
_LONGER = "record longer, with brisker movements of the camera itself in several directions"

#: Every part of an interval, by its key in ``ScaleEstimate.parts``.
CAUSES: dict[str, Cause] = {
    "accel_gain": Cause(words="the accelerometer's gain", advice="calibrate the IMU once (calibrate-imu)"),
    "lens": Cause(
        words="the lens and the model's shape",
        advice="film a target of known size, or two points whose distance is measured, and take the metres from them",
    ),
    "accel_noise": Cause(words="the accelerometer's noise", advice=_LONGER),
    "lost_readings": Cause(
        words="readings that are missing", advice="record without pauses, and within the ranges of the sensors"
    ),
    "accel_bias": Cause(words="the accelerometer's bias", advice=_TURN),
    "camera_path": Cause(
        words="the camera's path",
        advice=f"{_LONGER}; sharper frames, more texture and more frames a second make the path better",
    ),
    "gyro": Cause(words="the gyroscope", advice=_TURN),
    "camera_imu": Cause(
        words="how camera and IMU stand to each other",
        advice="calibrate camera and IMU once (align), or give what is known of them",
    ),
    "clocks": Cause(
        words="whether camera or IMU measures time rightly",
        advice="give frames and IMU times of one clock, not of a nominal frame rate",
    ),
    "gravity": Cause(words="the strength of gravity", advice="give the latitude"),
    "accel_faults": Cause(
        words="what was undone of the accelerometer's faults", advice="record what is undone here rightly"
    ),
    "model_shape": Cause(
        words="what was undone of the model's wrong shape", advice="close loops, and film what overlaps more"
    ),
    "rolling_shutter": Cause(
        words="a rolling shutter that the model ignores",
        advice="declare readout_s before mapping, or refine it (--refine inertial)",
    ),
    "noise_levels": Cause(words="how little the clip says of its own noise", advice="record longer"),
}


#: Parts below this share of the whole half-width are not worth a word.
_WORTH_SAYING = 0.2


def parts_in_words(parts: Mapping[str, float]) -> tuple[str, str]:
    """Parts of an interval in words, and what would narrow it most.

    Parameters
    ----------
    parts
        ``ScaleEstimate.parts``: standard deviations of the logarithm, whose squares add up.

    Returns
    -------
    Half-widths in per cent that the interval would have with each part alone, the largest first, and the advice for
    that one.
    """
    whole = sum(sigma**2 for sigma in parts.values()) ** 0.5
    largest = sorted(parts.items(), key=lambda part: -part[1])
    words = [
        f"{CAUSES[name].words} +-{100 * half_width(sigma):.2g} %"
        for name, sigma in largest
        if sigma >= _WORTH_SAYING * whole
    ]
    return f"{', '.join(words)}; they combine as root sum of squares", CAUSES[largest[0][0]].advice
