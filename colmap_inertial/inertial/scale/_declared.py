"""A declared lever arm against what a fit finds without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CAL, CameraImuCalibration
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Prior
from colmap_inertial.inertial.scale._fit import Fit
from colmap_inertial.io.calibration import SIGMAS


@dataclass(frozen=True, kw_only=True)
class LeverLimits:
    """Limits beyond which a recording contradicts a declared lever arm."""

    #: One that is known worse was not declared; one that is longer than three standard deviations of an unknown one is
    #: not what devices have, and one longer than the third may have been written in millimetres.
    known_m: float = 0.03
    usual_m: float = 3 * SIGMAS.unknown_lever_arm_m
    metre: float = 1.0
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

Likely = Literal["inverse", "sign", "millimetres"]


def doubts_lever(fit: Fit, prior: Prior, *, is_refused: bool) -> bool:
    """Whether a fit with a declared lever arm asks for another without it: it may be wrong.

    Without its prior, the fit would find ``declared + P0 (P0 - P)^-1 (fitted - declared)``, where P0 and P are the
    covariances of prior and fit. A fit that is refused, and one with an arm that no usual device has, tell nothing.
    """
    at = par.LEVER
    before = np.asarray(np.linalg.inv(prior.info[at, at]), dtype=np.float64)
    if float(np.diagonal(before).max()) ** 0.5 > _LIMITS.known_m:
        return False
    declared = np.asarray(prior.mean.imu_in_cam_m)
    if is_refused or np.linalg.norm(declared) > _LIMITS.usual_m:
        return True
    after = fit.cov[at, at]
    told = before - 0.5 * (after + after.T)
    # directions of which the recording tells nothing stay as declared
    values, vectors = np.linalg.eigh(told)
    telling = values > 1e-3 * np.diagonal(before).max()
    if not telling.any():
        return False
    inverse = (vectors[:, telling] / values[telling]) @ vectors[:, telling].T
    off = before @ inverse @ (fit.estimate.imu_in_cam_m - declared)
    of_fit = before @ inverse @ before - before if telling.all() else 1e3 * before
    cov = _cov_between(before, np.asarray(of_fit, dtype=np.float64))
    chi2 = float(off @ np.linalg.solve(cov, off))
    return bool(np.linalg.norm(off) > _LIMITS.matters_m and chi2 > _LIMITS.chi2_of_mistakes)


def find_contradicted_lever(alone: Fit, prior: Prior) -> Fact | None:
    """A declared lever arm that is not the one which the recording shows; ``None`` where it agrees.

    Parameters
    ----------
    alone
        A fit without what was declared.
    prior
        With what was declared.
    """
    at = par.LEVER
    declared, found = np.asarray(prior.mean.imu_in_cam_m), alone.estimate.imu_in_cam_m
    before = np.asarray(np.linalg.inv(prior.info[at, at]), dtype=np.float64)
    cov = _cov_between(before, alone.cov[at, at])

    def chi2(arm_m: Array) -> float:
        return float((found - arm_m) @ np.linalg.solve(cov, found - arm_m))

    own = chi2(declared)
    if np.linalg.norm(found - declared) <= _LIMITS.matters_m or own <= _LIMITS.chi2_of_mistakes:
        return None
    others: dict[Likely, float] = {
        "inverse": chi2(-alone.estimate.cam_from_imu @ declared),
        "sign": chi2(-declared),
    }
    if np.linalg.norm(declared) > _LIMITS.metre:
        others["millimetres"] = chi2(1e-3 * declared)
    likely = min(others, key=lambda name: others[name])
    explained = others[likely] < min(_LIMITS.chi2_of_mistakes, own - _LIMITS.better)
    if not explained and own <= _LIMITS.chi2:
        return None
    return Fact(
        "declared-lever-arm",
        declared_m=declared,
        found_m=found,
        sigma_m=float(np.diagonal(cov).max()) ** 0.5,
        likely=likely if explained else "",
    )


def _cov_between(declared: Array, fitted: Array) -> Array:
    """Covariance of the difference between a declared arm and a fitted one."""
    return np.asarray(declared + _LIMITS.sigmas**2 * fitted + _LIMITS.least_m**2 * np.eye(3))


def leave_out_lever(calibration: CameraImuCalibration, *, length_m: float = 0.0) -> CameraImuCalibration:
    """The calibration of a device whose lever arm nobody declared, but that it may be so long."""
    cov, at = calibration.cov.copy(), CAL.LEVER_ARM
    cov[at, :] = cov[:, at] = 0.0
    cov[at, at] = max(SIGMAS.unknown_lever_arm_m, length_m) ** 2 * np.eye(3)
    return replace(calibration, imu_in_cam_m=np.zeros(3), cov=cov)
