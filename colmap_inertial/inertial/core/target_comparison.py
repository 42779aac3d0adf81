"""What a device's accelerometer adds to a scale, from results that were compared with targets of known size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import IMU_CAL, ImuCalibration
from colmap_inertial.inertial.core.priors import PRIORS


@dataclass(frozen=True, kw_only=True)
class TargetComparison:
    """The scale of one recording beside a target.

    Attributes
    ----------
    error_log
        Logarithm of the target's size in the result over its true size.
    accel_sigma_log
        Standard deviation of it due to the accelerometer, as of unknown devices.
    sigma_log
        Standard deviation due to all else but the target.
    target
        Results with the same target have its error in common.
    target_sigma_log
        Of the target's size, relative.
    """

    error_log: float
    accel_sigma_log: float
    sigma_log: float
    target: str
    target_sigma_log: float


def calibrate_by_targets(
    comparisons: Sequence[TargetComparison], *, gravity_m_s2: float, device: str = ""
) -> ImuCalibration:
    """Estimate what the accelerometer of a device adds to a scale; its readings stay as they are.

    The accelerometer's part of a scale's error, over its standard deviation, has a variance of 1 over all devices. A
    share of it is the device's, and the same in all its recordings; the rest differs from one to the next. The share is
    unknown and integrated over, each value weighed by the likelihood of the comparisons. ``accel_factor`` is the root
    mean square of what the next recording has, larger where the errors are beyond chance.

    Parameters
    ----------
    comparisons
        Of different recordings.
    gravity_m_s2
        The strength of gravity, for the file; nothing depends on it.
    device
        Its name.

    Returns
    -------
    A calibration without corrections: gains and biases are zero, and ``cov`` holds the priors.

    Raises
    ------
    NotObservableError
        Without a comparison.
    """
    if not comparisons:
        raise NotObservableError("IMU calibration", Fact("no-result-with-target"))
    error = np.array([one.error_log for one in comparisons])
    accel = np.array([one.accel_sigma_log for one in comparisons])
    of_target = np.array([[one.target == other.target for other in comparisons] for one in comparisons])
    target_sigma = np.array([one.target_sigma_log for one in comparisons])
    known = np.diag([one.sigma_log**2 for one in comparisons]) + of_target * np.outer(target_sigma, target_sigma)
    squares, chi2, log_likelihoods = [], [], []
    for share in np.linspace(0.0, 1.0, 41):  # none is likelier
        cov = known + (1 - share) * np.diag(accel**2) + share * np.outer(accel, accel)
        solved = np.linalg.solve(cov, np.stack([error, share * accel], axis=1))
        mean, left = share * float(accel @ solved[:, 0]), share - share * float(accel @ solved[:, 1])
        squares.append(mean**2 + left + 1 - share)
        chi2.append(float(error @ solved[:, 0]))
        log_likelihoods.append(-0.5 * (np.linalg.slogdet(cov)[1] + chi2[-1]))
    weight = np.exp(np.array(log_likelihoods) - max(log_likelihoods))
    # beyond two standard deviations of what chance makes of them, errors are larger than those of unknown devices
    unlikely = len(error) + 2 * (2 * len(error)) ** 0.5
    surprise = max(1.0, float(np.average(chi2, weights=weight)) / unlikely)
    sigma = np.empty(IMU_CAL.COUNT)
    sigma[IMU_CAL.ACCEL_GAIN], sigma[IMU_CAL.GYRO_GAIN] = PRIORS.accel_gain, PRIORS.gyro_gain
    # what nobody knows of a gyroscope: each recording's alignment finds its bias
    sigma[IMU_CAL.ACCEL_BIAS], sigma[IMU_CAL.GYRO_BIAS] = PRIORS.accel_bias_m_s2, 0.1
    return ImuCalibration(
        accel_gain=np.zeros((3, 3)),
        accel_bias_m_s2=np.zeros(3),
        gyro_gain=np.zeros((3, 3)),
        gyro_bias_rad_s=np.zeros(3),
        cov=np.diag(sigma**2),
        gravity_m_s2=gravity_m_s2,
        device=device,
        attitudes=0,
        compared=len(comparisons),
        accel_factor=(surprise * float(np.average(squares, weights=weight))) ** 0.5,
    )
