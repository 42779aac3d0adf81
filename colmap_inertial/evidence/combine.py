"""All evidence of scale together: weights by covariance, sensors that may be wrong, contradictions by name.

Each sensor's logarithm of the scale is normal about the true one. Errors of one cause that several share are one error.
Beside, each sensor may be wrong (``FAULTS``), then by any amount of ``FAULT_SIGMA``, or seldom of ``GROSS_SIGMA``. Of
all cases of who is wrong, each counts by its probability given what all say. So sensors that agree confirm each other,
and where two differ the interval reaches to both. A sensor that agrees never makes the interval wider than the surest
one's by itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.evidence import AbsentSensor, CombinedScale, DeviceDrift, ScaleEvidence, ScalePart
from colmap_inertial.evidence.inertial import length_of
from colmap_inertial.evidence.priors import FAULT_SIGMA, FAULTS, GROSS_SHARE, GROSS_SIGMA
from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, half_width, verdict_of, without_width

#: Sensors as far apart are said to contradict each other: by chance, one recording in a hundred shows as much.
_CHANCE = 0.01
#: Sensors agree where chance would set every second recording's farther apart.
_AGREE = 0.5


def covariance_of(evidence: Sequence[ScaleEvidence]) -> Array:
    """(N, N) covariance of the logarithms of scales: what is random is each one's own, a shared cause all have."""
    causes = sorted({cause for one in evidence for cause in one.systematic})
    loading = np.array([[one.systematic.get(cause, 0.0) for cause in causes] for one in evidence])
    random = np.diag([one.random_sigma**2 for one in evidence])
    return np.asarray(random + loading.reshape(len(evidence), len(causes)) @ loading.reshape(len(evidence), -1).T)


def weigh(cov: Array) -> Array:
    """(N,) weights, none below zero, of the mean of least variance: a shared error cannot be subtracted."""
    kept = np.ones(len(cov), dtype=bool)
    while True:
        index = np.flatnonzero(kept)
        inside = np.linalg.solve(cov[np.ix_(index, index)], np.ones(len(index)))
        weights = np.zeros(len(cov))
        weights[index] = inside / inside.sum()
        if (weights >= 0).all():
            return weights
        kept[int(np.argmin(weights))] = False


@dataclass(frozen=True, eq=False, kw_only=True)
class _Cases:
    """The mean over all cases of who is wrong.

    ``sigma`` makes an interval that is the wider of that by the variance and that by probability: where few cases
    lie far away, either is too narrow by itself. ``sound_chi2`` is that nobody is wrong; ``faulty`` (N,) are
    the probabilities, ``alone`` (N,) relative ones that it is this one and no other.
    """

    mean: float
    sigma: float
    shares: Array
    sound_chi2: float
    faulty: Array
    alone: Array


def _weigh_cases(values: Array, cov: Array, faults: Array) -> _Cases:
    n = len(values)
    sigmas, shares = np.array([0.0, FAULT_SIGMA, GROSS_SIGMA]), np.array([1 - GROSS_SHARE, GROSS_SHARE])
    kinds = np.array(list(itertools.product(range(3), repeat=n)) if n > 1 else [(0,)])
    wrong_of = kinds > 0
    widened = cov + (sigmas[kinds] ** 2)[:, :, None] * np.eye(n)
    inverse = np.linalg.inv(widened)
    information = inverse.sum(axis=(1, 2))
    weights = inverse.sum(axis=1) / information[:, None]
    apart = values - (weights @ values)[:, None]
    chi2 = np.einsum("ki,kij,kj->k", apart, inverse, apart)
    prior = np.log(np.where(wrong_of, faults * shares[kinds - 1], 1 - faults)).sum(axis=1)
    logs = prior - 0.5 * (np.linalg.slogdet(widened)[1] + np.log(information) + chi2)
    for k in np.flatnonzero((weights < 0).any(axis=1)).tolist():
        weights[k] = weigh(widened[k])
    share = np.exp(logs - logs.max())
    share /= share.sum()
    means, variances = weights @ values, np.einsum("ki,kij,kj->k", weights, widened, weights)
    mean = float(share @ means)
    single = wrong_of.sum(axis=1) == 1
    alone = share[single] @ wrong_of[single] if single.any() else np.zeros(n)
    return _Cases(
        mean=mean,
        sigma=_spread(mean, share, means, variances),
        shares=share @ weights,
        sound_chi2=float(chi2[0]),
        faulty=share @ wrong_of,
        alone=alone,
    )


def _spread(mean: float, share: Array, means: Array, variances: Array) -> float:
    """Standard deviation of the normal distribution whose 95 % interval holds that of a mixture."""
    from scipy.special import ndtr

    sigmas = np.sqrt(variances)
    by_variance = math.sqrt(float(share @ (variances + (means - mean) ** 2)))
    low, high = 0.0, float(np.max(np.abs(means - mean) + 8 * sigmas))
    # the larger of the two sides: how far each reaches beyond the mean
    for _ in range(60):
        half = 0.5 * (low + high)
        above = float(share @ ndtr((means - mean - half) / sigmas))
        below = float(share @ ndtr((mean - half - means) / sigmas))
        low, high = (half, high) if max(above, below) > 0.025 else (low, half)
    return max(by_variance, high / Z95)


def combine(evidence: Sequence[ScaleEvidence], absent: Sequence[AbsentSensor] = ()) -> CombinedScale:
    """One scale by all sensors.

    Parameters
    ----------
    evidence
        What each says; sensors of one kind count once.
    absent
        Those that say nothing, which are listed.

    Raises
    ------
    NotObservableError
        Where none says anything.
    """
    from scipy.stats import chi2 as chi2_distribution

    if not evidence:
        reasons = tuple(reason for one in absent for reason in one.reasons)
        raise NotObservableError("scale", Fact("no-sensor-gives-scale", reasons=reasons))
    evidence = tuple(evidence)
    values = np.array([one.log_scale for one in evidence])
    cov = covariance_of(evidence)
    cases = _weigh_cases(values, cov, np.array([FAULTS[one.sensor] for one in evidence]))
    n = len(evidence)
    p_value = float(chi2_distribution.sf(cases.sound_chi2, n - 1)) if n > 1 else 1.0
    doubts = [Fact("sensor-in-doubt", sensor=one.sensor, why=reason) for one in evidence for reason in one.reasons]
    if p_value < _CHANCE:
        doubts.append(_contradiction(evidence, cov, cases, p_value))
    sigma = cases.sigma
    if p_value >= _AGREE:
        # alone, the surest has no allowance for faults; one that agrees with it gives no reason for more
        sigma = min(sigma, *(one.sigma for one in evidence))
    verdict, _, reasons = verdict_of(math.exp(cases.mean), sigma, doubts)
    width = half_width(sigma)
    if width > TRUSTED_HALF_WIDTH and any(one.sensor != "imu" for one in evidence):
        # the usual reason advises livelier motion, which helps the IMU alone
        reasons = (*without_width(reasons), Fact("combined-interval-wide", half_width=width))
    return CombinedScale(
        evidence=evidence,
        absent=tuple(absent),
        log_scale=cases.mean,
        sigma=sigma,
        shares=tuple(cases.shares.tolist()),
        p_value=p_value,
        faulty=tuple(cases.faulty.tolist()),
        verdict=verdict,
        reasons=reasons,
    )


def _contradiction(evidence: Sequence[ScaleEvidence], cov: Array, cases: _Cases, p_value: float) -> Fact:
    """The two that are farthest apart, and which of all is likeliest wrong."""
    pairs = list(itertools.combinations(range(len(evidence)), 2))

    def apart(pair: tuple[int, int]) -> float:
        i, j = pair
        spread = math.sqrt(max(cov[i, i] + cov[j, j] - 2 * cov[i, j], 1e-12))
        return abs(evidence[i].log_scale - evidence[j].log_scale) / spread

    first, second = max(pairs, key=apart)
    culprit = int(np.argmax(cases.alone))
    total = float(cases.alone.sum())
    return Fact(
        "sensors-contradict",
        first=evidence[first].sensor,
        second=evidence[second].sensor,
        ratio=math.exp(evidence[first].log_scale - evidence[second].log_scale),
        chance=p_value,
        culprit=evidence[culprit].sensor,
        probability=float(cases.alone[culprit]) / total if total > 0 else 0.0,
    )


def judge_device(combined: CombinedScale, trajectory: CameraTrajectory) -> DeviceDrift | None:
    """How wrong the device's own metres are, by all other sensors; ``None`` where there is no other, or no device.

    Parameters
    ----------
    combined
        With the device's own evidence among the others.
    trajectory
        The device's path.
    """
    device = combined.of("device")
    others = [one for one in combined.evidence if one.sensor != "device"]
    if device is None or not others:
        return None
    by_others = combine(others)
    log_error = device.log_scale - by_others.log_scale
    length = length_of(trajectory) * math.exp(-device.log_scale)
    length_m = length * by_others.metres_per_unit
    return DeviceDrift(
        log_error=log_error,
        sigma=math.hypot(by_others.sigma, device.random_sigma),
        length_m=length_m,
        error_m=length_m * math.expm1(log_error),
        parts=_combine_parts(others, device),
    )


def _combine_parts(evidence: Sequence[ScaleEvidence], device: ScaleEvidence) -> tuple[ScalePart, ...]:
    """The device's error by the shortest parts that any sensor tells of, each by all that tell of it."""
    finest = min((one.parts for one in evidence if one.parts), key=_length, default=())
    out = []
    for span in finest:
        middle_s = 0.5 * (span.begin_s + span.end_s)
        rows = [
            (part.log_scale, part.sigma)
            for one in evidence
            for part in one.parts
            if part.begin_s <= middle_s < part.end_s
        ]
        values, sigmas = np.array(rows).T
        weight = 1 / sigmas**2
        mean, sigma = float(weight @ values / weight.sum()), float(1 / np.sqrt(weight.sum()))
        by_device = next((part for part in device.parts if part.begin_s <= middle_s < part.end_s), None)
        error = (device.log_scale if by_device is None else by_device.log_scale) - mean
        sigma = sigma if by_device is None else math.hypot(sigma, by_device.sigma)
        if sigma < _SHOWN:
            out.append(ScalePart(begin_s=span.begin_s, end_s=span.end_s, log_scale=error, sigma=sigma))
    return tuple(out)


def _length(parts: Sequence[ScalePart]) -> float:
    return float(np.median([part.end_s - part.begin_s for part in parts]))


#: Parts that are known no better are not shown.
_SHOWN = 0.5 / Z95
