"""Priors of the joint estimator. All are zero-mean normal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types.imu import IMU_CAL, ImuRecording


@dataclass(frozen=True, kw_only=True)
class JointPriors:
    """Standard deviations of the joint estimator's priors.

    The lever arm, the delay between the sensors and the readout have theirs in the calibration
    (``io.calibration.calibration_prior``: 8 cm along each axis, 20 ms, 20 ms); rotation, offset and gyroscope bias come
    from the alignment; scale and the direction of gravity have none.
    """

    gyro_gain: float = 0.01
    """Each of the nine gains and axis errors of the gyroscope: data sheets give 1 %."""
    accel_gain: float = 0.005
    """The same of the accelerometer: after the factory's calibration, half of what data sheets allow."""
    accel_bias_m_s2: float = 0.4
    """Each axis: data sheets give 20-90 mg over temperature and soldering."""
    clock_rate: float = 1e-4
    """Quartzes of camera and IMU against each other."""
    coupling_m: float = 5.0
    """Errors of visual centres by errors of visual rotations: of the size of the scene's depth."""
    gravity_m_s2: float = 0.02
    """Magnitude of gravity: 9.78 at the equator to 9.83 at the poles."""
    known_gravity_m_s2: float = 5e-4
    """The same where the latitude is known: what lies under the ground, 0.0003 m/s2 rms, is rarely more."""
    lens: float = 0.0015
    """Scale error by lens calibration between a measured part of the model and the camera's path: errors of focal
    length and distortion bend a model by tenths of a percent, and inertial data do not show it."""
    accel_model: float = 0.00477
    """Scale error of an uncalibrated accelerometer beside a constant gain: with the lens it makes the 0.5 % that real
    recordings show at least."""
    calibrated_gain: float = 0.001
    """Each gain and axis error of a calibrated sensor, beside its calibration's own covariance: age, and the few kelvin
    that nobody logs."""
    calibrated_gain_per_k: float = 2e-4
    """By how much a gain changes with the sensor's temperature: data sheets of phones' and cameras' IMUs give 0.005 to
    0.03 % a kelvin."""


PRIORS = JointPriors()
#: A gain that is known this well (standard deviation along any direction) counts as calibrated.
KNOWN_GAIN = 0.0025


@dataclass(frozen=True, kw_only=True)
class AccelPart:
    """The accelerometer's part of a scale's interval.

    Attributes
    ----------
    calibrated
        Whether the IMU is.
    factor
        On the standard deviation of the whole part, by results of the device that were compared with targets.
    """

    calibrated: bool = False
    factor: float = 1.0

    @property
    def model_sigma(self) -> float:
        """Standard deviation of the scale's logarithm beside the gains that a fit estimates."""
        return 0.0 if self.calibrated else PRIORS.accel_model


UNCALIBRATED = AccelPart()


def accel_part(imu: ImuRecording) -> AccelPart:
    """What the accelerometer of a recording adds to a scale's interval, by its calibration."""
    if is_calibrated(imu):
        return AccelPart(calibrated=True)
    compared = None if imu.calibration is None else imu.calibration.accel_factor
    return UNCALIBRATED if compared is None else AccelPart(factor=compared)


def model_scale_sigma(accel: AccelPart = UNCALIBRATED) -> float:
    """The least standard deviation of a scale's logarithm."""
    return math.hypot(PRIORS.lens, accel.model_sigma * accel.factor)


def clock_scale_sigma(clock_rate: float) -> float:
    """Standard deviation of the logarithm of the scale due to different rates of the clocks of camera and IMU.

    Metres go with the square of time. The scale holds where the camera's clock is right; it is off by twice the rate
    where the IMU's is, which is as likely, and the interval has to hold it then, too.
    """
    return 2 * abs(clock_rate)


def is_calibrated(imu: ImuRecording) -> bool:
    """Whether a calibration corrected the accelerometer's gain well enough, at this temperature."""
    if imu.calibration is None:
        return False
    return math.hypot(imu.calibration.gain_sigma, _sigma_of_warming(imu)) <= KNOWN_GAIN


def gains_cov(imu: ImuRecording) -> Array:
    """(18, 18) what stays unknown of a corrected recording's gains: the accelerometer's nine, then the gyroscope's.

    The calibration's own covariance, and how far each may have moved since, with age and with the temperature.

    Raises
    ------
    ValueError
        Where no calibration corrected it.
    """
    if imu.calibration is None:
        raise ValueError("the recording was not corrected by a calibration")
    entries = np.r_[IMU_CAL.ACCEL_GAIN, IMU_CAL.GYRO_GAIN]
    by_rests = imu.calibration.accel_factor is None
    moved = math.hypot(PRIORS.calibrated_gain, _sigma_of_warming(imu)) if by_rests else 0.0
    return np.asarray(imu.calibration.cov[np.ix_(entries, entries)] + moved**2 * np.eye(len(entries)))


def _sigma_of_warming(imu: ImuRecording) -> float:
    """Standard deviation of what a gain changed by since the calibration; 0 where a temperature was not logged."""
    return PRIORS.calibrated_gain_per_k * abs(imu.warmer_k or 0.0)
