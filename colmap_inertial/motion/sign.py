"""The sign of a gyroscope: blur does not show it, rotations from frame to frame do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.motion.flow import VisualRotation


@dataclass(frozen=True, kw_only=True)
class SignLimits:
    """Limits that decide on the sign."""

    #: Natural logarithm of the ratio of the likelihoods that one sign needs over the other: 400 to 1.
    log_ratio: float = 6.0
    #: Share of the rotation in the images that the negated gyroscope must explain to be called right: when a camera
    #: circles an object, its pixels turn against it, but by less.
    least_explained: float = 0.7
    #: Least scatter of a rotation from pixels as a share of its size: intrinsics and translation.
    least_scatter: float = 0.1


SIGN_LIMITS = SignLimits()


@dataclass(frozen=True, kw_only=True)
class SignCheck:
    """Result of comparing images with their gyroscope and with its negative.

    Attributes
    ----------
    right
        ``None`` where that cannot be told.
    log_ratio
        Natural logarithm of the likelihood of the gyroscope over that of its negative.
    reason
        Why.
    """

    right: bool | None
    log_ratio: float
    reason: Fact


def check_sign(rotation: VisualRotation, motion: GyroCamera) -> SignCheck:
    """Compare the rotations between frames with the gyroscope's and with their negatives.

    Parameters
    ----------
    rotation
        From ``motion.flow.measure_rotation``.
    motion
        The gyroscope with the calibration to check, on the same clock.
    """
    known = np.isfinite(rotation.turn_rad).all(axis=1) & motion.covers(rotation.t_s[:-1], rotation.t_s[1:])
    return compare_signs(rotation.turn_rad[known], motion.turn_rad(rotation.t_s)[known], rotation.sigma_rad[known])


def compare_signs(visual_rad: Array, inertial_rad: Array, sigma_rad: Array) -> SignCheck:
    """Compare (N, 3) rotations by pixels, of (N,) standard deviations, with a gyroscope's and with their negatives.

    Residuals are taken as Cauchy's, so that pairs that were measured wrongly decide nothing.
    """
    residuals = [np.linalg.norm(visual_rad - sign * inertial_rad, axis=1) for sign in (1, -1)]
    size = np.linalg.norm(visual_rad, axis=1)
    nearer = float(np.median(np.minimum(*residuals))) if len(size) else 0.0
    scatter = np.maximum(np.hypot(sigma_rad, SIGN_LIMITS.least_scatter * size), nearer)
    log_ratio = float(np.sum(np.log1p((residuals[1] / scatter) ** 2) - np.log1p((residuals[0] / scatter) ** 2)))
    if abs(log_ratio) < SIGN_LIMITS.log_ratio:
        return SignCheck(right=None, log_ratio=log_ratio, reason=Fact("sign-open", pairs=len(size)))
    explained = 1 - float(np.median(residuals[0 if log_ratio > 0 else 1] ** 2) / np.median(size**2))
    if explained < (0 if log_ratio > 0 else SIGN_LIMITS.least_explained):
        return SignCheck(right=None, log_ratio=log_ratio, reason=Fact("neither-sign"))
    if log_ratio > 0:
        return SignCheck(right=True, log_ratio=log_ratio, reason=Fact("sign-right"))
    return SignCheck(right=False, log_ratio=log_ratio, reason=Fact("sign-wrong"))
