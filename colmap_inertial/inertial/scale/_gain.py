"""Whether the length of gravity is the accelerometer's gain, which lengths follow, or its bias, which they do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Estimate
from colmap_inertial.inertial.core.priors import PRIORS


@dataclass(frozen=True, kw_only=True)
class SensorPriors:
    """Prior of uncalibrated accelerometers: sound, or off in bias, in gain, or in both.

    Normal distributions; the two faults are independent.
    """

    #: Bias along gravity of a sound sensor, and of one that is off in gain: .01 to .06 in clean recordings.
    bias_m_s2: float = 0.05
    #: Mean gain of a sensor that is off in gain; of others, the mean of three axes at the prior.
    large_gain: float = 0.03
    #: Share of sensors that are off in bias, as far as the prior allows, and of those that are off in gain.
    off: float = 0.1
    #: The gain that the motion shows is so many times less sure than the fit says: with a wrong gain it is up to 4.1 of
    #: the fit's standard deviations from what gravity says.
    motion_sigmas: float = 2.0
    #: From this probability on, a wrong gain is said.
    said: float = 1 / 3
    #: Gains as sensors have, which are in the interval; and the standard deviations by which one must be larger to make
    #: a scale weak by itself, once there is evidence that it is wrong.
    usual_gain: float = 0.02
    sigmas: float = 1.0


_PRIORS = SensorPriors()


@dataclass(frozen=True, kw_only=True)
class WrongGain:
    """That the accelerometer is off in gain.

    Attributes
    ----------
    probability
        Of it.
    gain, sigma, excess
        What it would be, with its standard deviation, and by what share gravity reads too long.
    variance
        Of the logarithm of the scale, as it may be so: the mean square of what it would change by.
    """

    probability: float
    gain: float
    sigma: float
    excess: float
    variance: float

    @property
    def is_likely(self) -> bool:
        """Whether the user should know."""
        return self.probability > _PRIORS.said

    @property
    def is_large(self) -> bool:
        """Whether no sensor's gain is that far off."""
        return self.is_likely and bool(exceeds_usual(np.array(self.gain), np.array(self.sigma)))


def exceeds_usual(gain: Array, sigma: Array) -> Array:
    """Which gains are larger than those of sensors, by more than chance: (|gain| - usual) in standard deviations."""
    return np.asarray(np.abs(gain) - _PRIORS.usual_gain > _PRIORS.sigmas * sigma)


def judge_gain(x: Estimate, cov: Array, prior_info: Array, widened: float) -> WrongGain:
    """Weigh what could make gravity read too long or too short, by Bayes' rule.

    Two things are observed: the mean gain that the motion shows, and the length of gravity, which is gain and bias
    along gravity together. Motion that turns much knows the gain itself; where it hardly turns, as in flights, gravity
    alone speaks, and cannot tell a wrong gain from a large bias.

    Parameters
    ----------
    x, cov, prior_info
        Estimate of a fit, (79, 79) covariance of its globals, and what of their information is the prior's.
    widened
        Factor on these variances.
    """
    mean_gain = np.zeros(par.N_GLOBALS)
    mean_gain[np.arange(par.ACCEL_GAIN.start, par.ACCEL_GAIN.stop)[::4]] = 1 / 3
    gravity = float(np.linalg.norm(x.gravity_m_s2))
    up = -x.gravity_m_s2 / gravity @ x.world_from_imu
    excess_m_s2 = float(np.mean(up @ x.accel_bias_m_s2 - gravity * np.einsum("ki,ij,kj->k", up, x.accel_gain, up)))
    variance = float(mean_gain @ cov @ mean_gain)
    # without the prior, which pulls all three alike
    information = max(1 / variance - 9 * float(mean_gain @ prior_info @ mean_gain), 1e-9)
    fitted = -float(np.trace(x.accel_gain)) / 3
    seen = np.array([fitted / (variance * information), excess_m_s2 / gravity])
    # sound, off in bias, off in gain, off in both: standard deviations of the gain and of what is observed of it
    off, usual, large = _PRIORS.off, 3**-0.5 * PRIORS.accel_gain, _PRIORS.large_gain
    shares = np.array([(1 - off) ** 2, (1 - off) * off, off * (1 - off), off**2])
    gain = np.array([usual, usual, large, large])
    bias = np.tile([_PRIORS.bias_m_s2, PRIORS.accel_bias_m_s2], 2) / gravity
    motion = np.full(4, _PRIORS.motion_sigmas * (widened / information) ** 0.5)
    observed = np.stack([motion, bias], axis=1) ** 2
    spread = np.einsum("ki,ij->kij", observed, np.eye(2)) + gain[:, None, None] ** 2
    exponent = -0.5 * np.einsum("i,kij,j->k", seen, np.linalg.inv(spread), seen)
    likely = shares * np.exp(exponent - exponent.max()) / np.linalg.det(spread) ** 0.5
    likely = (likely / likely.sum())[2:]
    known = np.sum(1 / observed, axis=1) + gain**-2
    expected = np.sum(seen / observed, axis=1) / known
    change = float(cov[par.SCALE] @ mean_gain) / variance * (expected[2:] - fitted)
    mean = float(likely @ expected[2:] / likely.sum())
    square = float(likely @ (expected[2:] ** 2 + 1 / known[2:]) / likely.sum())
    return WrongGain(
        probability=float(likely.sum()),
        gain=mean,
        sigma=max(square - mean**2, 0.0) ** 0.5,
        excess=excess_m_s2 / gravity,
        variance=float(likely @ change**2),
    )
