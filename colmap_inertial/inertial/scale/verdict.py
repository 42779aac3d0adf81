"""Interval and verdict from a scale and its standard deviation, and the parts of the interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import Verdict
from colmap_inertial.messages.scale import PARTS

#: Half-widths of the 95 % interval, relative to the scale, up to which a scale is trusted, and given at all.
TRUSTED_HALF_WIDTH = 0.03
WEAK_HALF_WIDTH = 0.30
#: What is said of that width.
_WIDTHS = ("scale-unknown", "scale-interval-wide")
#: A drift of the scale is reported where chance would show as much once in ten thousand recordings.
_DRIFT_PROBABILITY, _DRIFT_SIGMAS = 1e-4, 3.89
#: Clocks of camera and IMU that part faster make a scale weak: action cameras' do by .2 % (one standard deviation;
#: none of 2,076 clean windows of other recordings does by .1), and what either makes of metres is in the interval.
_APART_RATE = 2.5e-3


def half_width(sigma_log: float) -> float:
    """Half-width of the log-symmetric 95 % interval relative to the scale: ``(hi - lo) / (2 scale)``."""
    exponent = Z95 * sigma_log
    return math.sinh(exponent) if exponent < 700 else math.inf


def finite(number: float) -> float | None:
    """A number as values of facts have it: JSON knows no other than finite ones."""
    return number if math.isfinite(number) else None


def without_width(reasons: Sequence[Fact]) -> list[Fact]:
    """Reasons of a verdict but for the width of its interval, which another standard deviation changes."""
    return [reason for reason in reasons if reason.code not in _WIDTHS]


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


def check_clocks(clock_rate: float) -> list[Fact]:
    """A doubt where camera and IMU measure time so differently that metres, which go with its square, are in doubt.

    Parameters
    ----------
    clock_rate
        Of a ``CameraImuCalibration``.
    """
    if abs(clock_rate) <= _APART_RATE:
        return []
    return [Fact("clocks-run-apart", rate=abs(clock_rate))]


def verdict_of(
    metres_per_unit: float,
    sigma_log: float,
    doubts: Sequence[Fact] = (),
    *,
    refusals: Sequence[Fact] = (),
) -> tuple[Verdict, tuple[float, float], tuple[Fact, ...]]:
    """Judge a scale estimate.

    Parameters
    ----------
    metres_per_unit
        The estimate.
    sigma_log
        Standard deviation of its logarithm.
    doubts
        The findings of which any keeps the verdict from being ``"trusted"``.
    refusals
        The findings that make the number worthless whatever its width.

    Returns
    -------
    verdict
        ``"trusted"`` up to a half-width of 3 %, ``"weak"`` up to 30 %, else ``"refused"``.
    ci95
        (low, high), symmetric in the logarithm of the scale.
    reasons
        ``refusals``, ``doubts``, and the width where it decided.
    """
    if not (math.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise ValueError(f"metres_per_unit must be positive and finite, not {metres_per_unit}")
    if not sigma_log >= 0:
        raise ValueError(f"sigma_log must not be negative, not {sigma_log}")
    width = half_width(sigma_log)
    factor = math.exp(min(Z95 * sigma_log, 700.0))
    ci95 = (metres_per_unit / factor, metres_per_unit * factor)
    reasons = [*refusals, *doubts]
    verdict: Verdict = "weak" if doubts else "trusted"
    if width > TRUSTED_HALF_WIDTH:
        verdict = "weak"
    if width > WEAK_HALF_WIDTH:
        reasons.append(Fact("scale-unknown", half_width=finite(width)))
    elif width > TRUSTED_HALF_WIDTH:
        reasons.append(Fact("scale-interval-wide", half_width=width))
    if width > WEAK_HALF_WIDTH or refusals:
        verdict = "refused"
    return verdict, ci95, tuple(reasons)


#: Every part of an interval, by its key in ``ScaleEstimate.parts``.
CAUSES = tuple(PARTS)
#: Parts below this share of the whole half-width are not worth a word.
_WORTH_SAYING = 0.2


def describe_parts(parts: Mapping[str, float]) -> Fact:
    """Half-widths that an interval would have with each part alone, the largest first; the advice is for that one.

    Parameters
    ----------
    parts
        ``ScaleEstimate.parts``: standard deviations of the logarithm, whose squares add up.
    """
    whole = sum(sigma**2 for sigma in parts.values()) ** 0.5
    largest = sorted(parts.items(), key=lambda part: -part[1])
    worth = [(name, half_width(sigma)) for name, sigma in largest if sigma >= _WORTH_SAYING * whole]
    return Fact("scale-parts", parts=[name for name, _ in worth], half_widths=[width for _, width in worth])
