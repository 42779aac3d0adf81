"""Evidence for an offset between clocks where some of the camera's rotations are wrong: a mixture of two kinds.

A rotation over an interval either follows the gyroscope, with Gaussian errors, or it has nothing to do with it. With
``theta`` and ``phi`` of camera and gyroscope over ``T``, less a common rate, and ``r = theta - C phi``,

    l = log N(r; s^2 T) / N(theta; |theta|^2 T / 3),    Lambda = sum u log((1 - e) exp(l) + e).

The share ``e`` of wrong rotations, the errors' level ``s`` and the rotation ``C`` are fitted at each offset by
expectation maximisation, so that what is wrong costs ``log e`` and no more, however far it is off. What is unrelated is
given each interval's own amplitude, the likeliest there is: that both are quiet, or quick, at the same time is no
evidence, only that they turn the same way. Intervals weigh by ``u``, which is one where the gyroscope turns as it
usually does when it turns, and nothing at rest: a camera that stands still fits at any offset at which both do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray


@dataclass(frozen=True, kw_only=True)
class MixtureLimits:
    """Limits of the mixture of sound and wrong rotations."""

    #: At most so much is wrong, or nothing is judged; at least so much is expected to be.
    most_wrong: float = 0.5
    least_wrong: float = 0.02
    #: Squared errors are at least this share of the gyroscope's squared rotation: what no camera and gyroscope reach.
    least_error: float = 1e-3
    #: Rounds of expectation maximisation, those in which errors shrink to their level, and as many as choose offsets
    #: that are compared closely (in recordings, the best twenty are then within 1.6 nats, in their order).
    rounds: int = 24
    annealed: int = 8
    choosing: int = 12


MIXTURE = MixtureLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Mixture:
    """Fits at L offsets.

    Attributes
    ----------
    log_likelihood
        (L,) gained over unrelated recordings, if all intervals were independent.
    sound
        (L,) share of the rotations that follow the gyroscope.
    gain
        (L,) how far these turn for what the gyroscope turns: one, but for a wrong unit or focal length.
    cross, rate_v, rate_g
        (L, 3, 3), (L, 3), (L, 3) moments of these (``_clock_search._moments``).
    """

    log_likelihood: Array
    sound: Array
    gain: Array
    cross: Array
    rate_v: Array
    rate_g: Array


def fit_mixture(
    turn_rad: Array,
    inertial_rad: Array,
    dt_s: Array,
    inside: BoolArray,
    *,
    moments: Callable[[Array], tuple[Array, Array, Array]],
    best_rotation: Callable[[Array], Array],
    rounds: int = MIXTURE.rounds,
) -> Mixture:
    """Fit the share of wrong rotations, the level of errors, and the rotation, at L offsets of K intervals.

    Parameters
    ----------
    turn_rad, inertial_rad, dt_s, inside
        (K, 3) of the camera, (L, K, 3) of the gyroscope, (K,) lengths, (L, K) which intervals count.
    moments
        Cross moments and common rates of camera and gyroscope, of intervals weighted by (L, K).
    best_rotation
        Rotations (L, 3, 3) or (1, 3, 3) by cross moments.
    rounds
        Of expectation maximisation.
    """
    count = np.maximum(inside.sum(axis=1), 1)
    own_before, felt_before = np.sum(turn_rad**2, axis=1) / dt_s, np.einsum("lki,lki->lk", inertial_rad, inertial_rad)
    felt_before /= dt_s
    usual = np.maximum(np.sum(inside * felt_before, axis=1) / count, 1e-30)
    # what turns farther than the gyroscope ever does must not decide where the search begins
    sound = inside * np.minimum(1.0, (felt_before + usual[:, None]) / np.maximum(own_before, 1e-30))
    share = np.ones(len(inside))
    for k in range(rounds):
        cross, rate_v, rate_g = moments(sound)
        rotation = best_rotation(cross)
        # squares and products of rotations over time, less those of the common rates: no rotation less its rate is made
        rate = np.einsum("...ij,...j->...i", rotation, rate_g)
        own = own_before - 2 * rate_v @ turn_rad.T + np.sum(rate_v**2, axis=1)[:, None] * dt_s
        felt = felt_before - 2 * (inertial_rad @ rate_g[:, :, None])[:, :, 0]
        felt += np.sum(rate_g**2, axis=1)[:, None] * dt_s
        turned = inertial_rad @ np.swapaxes(rotation, 1, 2)
        common = np.einsum("ki,lki->lk", turn_rad / dt_s[:, None], turned) - rate @ turn_rad.T
        common += np.sum(rate_v * rate, axis=1)[:, None] * dt_s - (turned @ rate_v[:, :, None])[:, :, 0]
        off = np.maximum(own + felt - 2 * common, 0.0)
        usual = np.maximum(np.sum(inside * felt, axis=1) / count, 1e-30)
        turning = inside * np.minimum(1.0, felt / usual[:, None])
        informative = np.maximum(turning.sum(axis=1), 1e-12)
        of_sound = turning * sound
        level = np.sum(of_sound * off, axis=1) / np.maximum(3 * np.sum(of_sound, axis=1), 1e-12)
        # at first all errors count, whatever they are: the level comes down to that of sound rotations by and by
        spread = np.sum(turning * np.minimum(off, felt), axis=1) / (3 * informative)
        level = np.maximum(level, spread * max(0.0, 1 - k / MIXTURE.annealed) ** 2)
        scale = np.maximum(level, MIXTURE.least_error * usual / 3)[:, None]
        wrong = np.clip(1 - share, MIXTURE.least_wrong, MIXTURE.most_wrong)[:, None]
        odds = 1.5 * np.log(np.maximum(own, 1e-30)) - 0.5 * off / scale
        odds += 1.5 - 1.5 * np.log(3 * scale) + np.log1p(-wrong) - np.log(wrong)
        less = np.exp(-np.abs(odds))
        sound = inside * np.where(odds >= 0, 1.0, less) / (1 + less)
        # at rest, errors are small against those of quick turns, and say nothing of them
        of_sound = turning * sound
        share = np.sum(of_sound, axis=1) / informative
    both = np.log(wrong) + np.maximum(odds, 0.0) + np.log1p(less)
    return Mixture(
        log_likelihood=np.sum(turning * both, axis=1),
        sound=share,
        gain=np.sum(of_sound * common, axis=1) / np.maximum(np.sum(of_sound * felt, axis=1), 1e-15),
        cross=cross,
        rate_v=rate_v,
        rate_g=rate_g,
    )
