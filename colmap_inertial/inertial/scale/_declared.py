"""A declared lever arm against what a fit finds without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Prior
from colmap_inertial.inertial.scale._fit import Fit
from colmap_inertial.io.calibration import SIGMAS


@dataclass(frozen=True, kw_only=True)
class LeverLimits:
    """Limits beyond which a recording contradicts a declared lever arm."""

    #: One that is known worse was not declared.
    known_m: float = 0.03
    #: Chi-square of three differences that chance exceeds once in 10,000 recordings, and what matters.
    chi2: float = 21.1
    matters_m: float = 0.015
    #: Where a usual mistake explains the difference, chance may exceed it once in a hundred; it has to explain it
    #: better by three standard deviations.
    chi2_of_mistakes: float = 11.3
    better: float = 9.0
    #: What the fit's standard deviations count, and what is added to them (``LearnedLimits``: against known arms, 1.2
    #: of them in 20 s, and 3 mm where they are .5 mm).
    sigmas: float = 1.25
    least_m: float = 0.003


_LIMITS = LeverLimits()

Likely = Literal["inverse", "sign"]


def find_contradicted_lever(fit: Fit, prior: Prior) -> Fact | None:
    """A declared lever arm that is not the one which the recording shows; ``None`` where none is, or it agrees.

    Without its prior, the fit would find ``declared + P0 (P0 - P)^-1 (fitted - declared)``, where P0 and P are the
    covariances of prior and fit: no second fit is needed to ask.
    """
    at = par.LEVER
    before = np.linalg.inv(prior.info[at, at])
    if float(np.diagonal(before).max()) ** 0.5 > _LIMITS.known_m:
        return None
    after = fit.cov[at, at]
    told = before - 0.5 * (after + after.T)
    # directions of which the recording tells nothing stay as declared
    values, vectors = np.linalg.eigh(told)
    telling = values > 1e-3 * np.diagonal(before).max()
    if not telling.any():
        return None
    inverse = (vectors[:, telling] / values[telling]) @ vectors[:, telling].T
    declared = np.asarray(prior.mean.imu_in_cam_m)
    off = before @ inverse @ (fit.estimate.imu_in_cam_m - declared)
    of_fit = before @ inverse @ before - before if telling.all() else 1e3 * before
    cov = before + _LIMITS.sigmas**2 * of_fit + _LIMITS.least_m**2 * np.eye(3)

    def chi2(arm_m: Array) -> float:
        rest = declared + off - arm_m
        return float(rest @ np.linalg.solve(cov, rest))

    found, own = declared + off, chi2(declared)
    if np.linalg.norm(off) <= _LIMITS.matters_m or own <= _LIMITS.chi2_of_mistakes:
        return None
    others: dict[Likely, float] = {
        "inverse": chi2(-fit.estimate.cam_from_imu @ declared),
        "sign": chi2(-declared),
    }
    likely = min(others, key=lambda name: others[name])
    explained = others[likely] < min(_LIMITS.chi2_of_mistakes, own - _LIMITS.better)
    if not explained and own <= _LIMITS.chi2:
        return None
    sigma_m = float(np.diagonal(cov).max()) ** 0.5
    return Fact(
        "declared-lever-arm",
        declared_m=declared,
        found_m=found,
        sigma_m=sigma_m,
        likely=likely if explained else "",
    )


def open_lever(prior: Prior) -> Prior:
    """The prior of a device whose lever arm nobody declared."""
    info, at = prior.info.copy(), par.LEVER
    info[at, :] = info[:, at] = 0.0
    info[at, at] = SIGMAS.unknown_lever_arm_m**-2 * np.eye(3)
    return replace(prior, info=info, mean=replace(prior.mean, imu_in_cam_m=np.zeros(3)))
