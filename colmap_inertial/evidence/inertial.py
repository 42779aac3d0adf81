"""What the IMU says of the scale, and what the device's own path says, as evidence beside that of other sensors."""

from __future__ import annotations

import math

import numpy as np

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory, ScaleEstimate
from colmap_inertial.core.types.evidence import ScaleEvidence, ScalePart
from colmap_inertial.evidence.priors import ACCEL_GAIN, DEVICE_FUSION, DEVICE_WANDER, LENS, PRIORS
from colmap_inertial.inertial.core.priors import PRIORS as INERTIAL_PRIORS, model_scale_sigma
from colmap_inertial.inertial.scale.verdict import without_width

#: Parts of an inertial scale's interval that are the device's or the model's own, whatever the recording's length.
_OWN = (ACCEL_GAIN, LENS, "gravity", "clocks", "accel_faults")


def evidence_of_imu(estimate: ScaleEstimate, span_s: tuple[float, float] | None = None) -> ScaleEvidence:
    """An inertial scale as evidence.

    Parameters
    ----------
    estimate
        Any that was not refused.
    span_s
        Begin and end of the path that it was measured on, seconds since the trajectory's epoch.

    Raises
    ------
    NotObservableError
        For a refused one.
    """
    known = estimate.accepted
    whole = known.sigma_log
    if estimate.parts is None:
        own = {ACCEL_GAIN: min(whole, model_scale_sigma())}
    else:
        own = {cause: float(estimate.parts[cause]) for cause in _OWN if estimate.parts.get(cause, 0.0) > 0}
    random = math.sqrt(max(whole**2 - sum(sigma**2 for sigma in own.values()), 0.0))
    log_scale = math.log(known.metres_per_unit)
    parts: tuple[ScalePart, ...] = ()
    if estimate.drift is not None:
        drift = estimate.drift
        rows = zip(
            drift.begin_s.tolist(),
            drift.end_s.tolist(),
            drift.log_ratio.tolist(),
            drift.sigma_log.tolist(),
            strict=True,
        )
        parts = tuple(
            ScalePart(begin_s=begin_s, end_s=end_s, log_scale=log_scale + ratio, sigma=sigma)
            for begin_s, end_s, ratio, sigma in rows
            if sigma < _SURE
        )
    return ScaleEvidence(
        sensor="imu",
        log_scale=log_scale,
        random_sigma=random,
        systematic=own,
        begin_s=None if span_s is None else span_s[0],
        end_s=None if span_s is None else span_s[1],
        parts=parts,
        reasons=tuple(without_width(estimate.reasons)),
    )


#: Parts that say less than this of the scale say nothing.
_SURE = 0.1


def evidence_of_device(
    log_scale: float = 0.0,
    random_sigma: float = 0.0,
    *,
    span_s: tuple[float, float] | None = None,
    parts: tuple[ScalePart, ...] = (),
    reasons: tuple[Fact, ...] = (),
) -> ScaleEvidence:
    """The device's own metres as evidence.

    They come from the same accelerometer as the IMU's, and its depth from the same filter.

    Parameters
    ----------
    log_scale, random_sigma
        Of the device's path against the path in question, where it is another one; a path is as long as itself.
    span_s, parts, reasons
        When it holds, by parts, and why it is in doubt.
    """
    return ScaleEvidence(
        sensor="device",
        log_scale=log_scale,
        random_sigma=random_sigma,
        systematic={
            DEVICE_WANDER: PRIORS.device_wander,
            DEVICE_FUSION: PRIORS.device_fusion,
            ACCEL_GAIN: INERTIAL_PRIORS.accel_model,
        },
        begin_s=None if span_s is None else span_s[0],
        end_s=None if span_s is None else span_s[1],
        parts=parts,
        reasons=reasons,
    )


def length_of(trajectory: CameraTrajectory, step_s: float = 0.5) -> float:
    """Length of a path in its own unit, in steps that leave out what the hand's tremor and noise add."""
    begin_s, end_s = float(trajectory.t_s[0]), float(trajectory.t_s[-1])
    at_s = np.linspace(begin_s, end_s, max(2, round((end_s - begin_s) / step_s) + 1))
    at = np.stack([np.interp(at_s, trajectory.t_s, column) for column in trajectory.cam_in_world.T], axis=1)
    return float(np.sum(np.linalg.norm(np.diff(at, axis=0), axis=1)))
