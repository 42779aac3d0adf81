"""The scale of a joint fit and its interval, an equation of ``docs/dev/scale.md#interval-and-verdict`` each.

The scale makes residuals orthogonal to the fitted path. That path follows the visual noise with as many degrees of
freedom as the states take from the centres; where the accelerometer is less noisy than the fit says, it follows too
willingly, which lowers the scale. Part of the fitted noise is no white noise at all, but slow (rotors), and the rest is
in the accelerometer's own stream or data sheet.
"""

from __future__ import annotations

import numpy as np

from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.priors import PRIORS, AccelPart, clock_scale_sigma
from colmap_inertial.inertial.scale._fit import Fit
from colmap_inertial.inertial.scale._gain import WrongGain, judge_gain
from colmap_inertial.inertial.scale.verdict import student_factor

#: Real visual errors are not those of the model (alike over .1 to 1 s and longer), which counts the more the shorter a
#: clip is: standard deviations grow by this over its length. Measured on handheld and flown recordings with motion
#: capture, cut to 3 to 20 s.
_UNMODELLED_S = 1.5
#: Standard deviation of what lies anywhere between none and all.
_UNIFORM = 12**-0.5


def metres_per_unit_of(fit: Fit) -> float:
    """``s = s_0 exp(shift)``: the scale, where it is not refused."""
    return fit.estimate.metres_per_unit * float(np.exp(scale_shift(fit)))


def scale_shift(fit: Fit) -> float:
    """Added to the logarithm of the scale for noise that the fitted path follows: ``min(h (1 - ...), sqrt(v))``."""
    overstated = max(0.0, 1 - (fit.expected_accel_m_s2_rthz / fit.noise.accel_density_m_s2_rthz) ** 2)
    # to first order only: not by more than what the recording leaves open
    open_log = (_fitted_variance(fit) * _excess_of_squares(fit)) ** 0.5
    return float(min(overstated * _largest_shift(fit), open_log))


def variance_factor(fit: Fit) -> float:
    """``v / v_0 k^2 (1 + 1.5 s / T)^2``: squares beyond expectation, few degrees of freedom, what no model has."""
    short = 1 + _UNMODELLED_S / float(fit.t_s[-1] - fit.t_s[0])
    return _excess_of_squares(fit) * (student_factor(fit.freedom) * short) ** 2


def scale_variances(fit: Fit, accel: AccelPart, clock_rate: float = 0.0) -> dict[str, float]:
    """Variance of the logarithm of the scale by cause (``verdict.CAUSES``); their sum is that of ``sigma_log``.

    Parameters
    ----------
    accel
        Of the recording.
    clock_rate
        Between camera and IMU, of the alignment and the fit together.
    """
    widened = variance_factor(fit)
    wrong_gain = find_wrong_gain(fit, accel)
    variances = {cause: widened * variance for cause, variance in fit.variance_parts.items()}
    by_gain = variances["accel_gain"] * fit.gain_surprise + accel.model_sigma**2
    by_wrong_gain = 0.0 if wrong_gain is None else wrong_gain.variance
    variances["accel_gain"] = (by_gain + by_wrong_gain) * accel.factor**2
    variances["noise_levels"] = (student_factor(fit.freedom) * _UNIFORM * _largest_shift(fit)) ** 2 + fit.level_variance
    variances["lens"] = PRIORS.lens**2
    variances["clocks"] = clock_scale_sigma(clock_rate) ** 2
    return variances


def find_wrong_gain(fit: Fit, accel: AccelPart) -> WrongGain | None:
    """What gravity's length says of the accelerometer's gain; a calibrated one is believed unless contradicted."""
    wrong_gain = judge_gain(fit.estimate, fit.cov, fit.prior_info, variance_factor(fit))
    return None if accel.calibrated and not wrong_gain.is_likely else wrong_gain


def _fitted_variance(fit: Fit) -> float:
    """``v_0``: the fit's own variance of the logarithm of the scale."""
    return float(fit.cov[par.SCALE, par.SCALE])


def _excess_of_squares(fit: Fit) -> float:
    """``v / v_0 = max(1, max_i Q_i / f_i)``: the worst level's squares of residuals over their expectation."""
    return max(1.0, *(squares / expected for squares, expected in fit.sums.values()))


def _largest_shift(fit: Fit) -> float:
    """``h = (v_0 - c_E) max(0, 3 K - f_c - f_d)``: what the path's noise takes from a scale of no inertial noise."""
    taken = 3 * len(fit.t_s) - fit.sums["centre_m"][1] - fit.sums["drift_m_rts"][1]
    # a gain follows the noise the other way, so that what both have in common stays where it is
    gains = fit.cov[par.SCALE, par.ACCEL_GAIN].reshape(3, 3)
    return max(0.0, _fitted_variance(fit) + float(np.trace(gains)) / 3) * max(0.0, taken)
