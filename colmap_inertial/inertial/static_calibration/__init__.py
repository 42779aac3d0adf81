"""An IMU calibrated by laying it still: gains, misalignments and biases from rests in several attitudes.

The rests are found in the recording itself. In each of them the accelerometer feels gravity alone, whose strength is
known; on the way from one to the next, the gyroscope carries gravity's direction. After D. Tedaldi, A. Pretto and
E. Menegatti, "A robust and easy to implement method for IMU calibration without external equipments", ICRA 2014, with
a covariance of everything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import IMU_CAL, ImuCalibration, ImuRecording
from colmap_inertial.inertial.core.priors import KNOWN_GAIN, PRIORS
from colmap_inertial.inertial.static_calibration._fit import MISALIGNMENT_SIGMA, RestFit, fit_rests
from colmap_inertial.inertial.static_calibration._rests import Rests, candidate_rests
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2

#: From so many attitudes on, misalignments are determined, too; with fewer than the second, nothing is.
FULL_ATTITUDES, FEWEST_ATTITUDES = 9, 6
#: Largest standard deviations of a good calibration, beside ``KNOWN_GAIN`` of the accelerometer's gains: of its
#: misalignments (.1 degree), and of the gyroscope's gains.
_GOOD_MISALIGNMENT, _GOOD_GYRO_GAIN = 0.002, 0.003
#: A threshold is considered where it finds this share of the most attitudes that any finds.
_MOST_ATTITUDES = 0.9
#: Beyond this many standard deviations beforehand, residuals say that something else moved or shook.
_NOISY = 8.0
#: Drift of the accelerometer's bias that is less likely by chance. Of 60 simulated phones one without warming is below
#: .003 and none below .002, 57 that warm by .02 m/s2 are below .003.
_DRIFT_P_VALUE = 2e-3
#: Gains and angles beyond which the two sensors do not belong together.
_LARGEST_GAIN, _LARGEST_MISS_RAD = 0.5, np.radians(5.0)
_AXES = "xyz"


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class RestCalibration:
    """A calibration by rests, and what it rests on.

    Attributes
    ----------
    calibration
        To correct recordings by, and to keep.
    verdict
        ``"good"``, or ``"weak"`` where something is not determined; what determines too little is refused instead.
    reasons
        In words.
    rests
        What was found in the recording.
    before_m_s2, after_m_s2
        (K,) by how much each mean reading is longer than gravity, as it was read and corrected.
    turn_residual_rad
        (K-1,) angle by which the gyroscope misses gravity in the next rest; nan where samples are missing.
    """

    calibration: ImuCalibration
    verdict: Literal["good", "weak"]
    reasons: tuple[Fact, ...]
    rests: Rests
    before_m_s2: Array
    after_m_s2: Array
    turn_residual_rad: Array

    def rms_pct(self, residual_m_s2: Array) -> float:
        """Root mean square of ``before_m_s2`` or ``after_m_s2`` against gravity, per cent."""
        return float(100 * np.sqrt(np.mean(residual_m_s2**2)) / self.calibration.gravity_m_s2)


def calibrate_imu(
    imu: ImuRecording,
    *,
    gravity_m_s2: float = STANDARD_GRAVITY_M_S2,
    gravity_sigma_m_s2: float = PRIORS.gravity_m_s2,
    device: str | None = None,
) -> RestCalibration:
    """Find gains, misalignments and biases of an IMU that was laid still in several attitudes.

    Parameters
    ----------
    imu
        The recording, as the sensor read it; nominal factors within ten per cent do.
    gravity_m_s2, gravity_sigma_m_s2
        Strength of gravity where it was made (``gravity_at_latitude_m_s2``), and how sure that is: the gains are no
        better. The default spans the Earth.
    device
        What was calibrated; without it, what the recording says.

    Returns
    -------
    The calibration, with a covariance of all 24 parameters. From nine attitudes on, all nine parameters of the
    accelerometer are determined; with six to eight gains and biases, and the misalignments keep their prior. The
    gyroscope's nine are determined as far as the turns between rests reach, and keep their prior beyond.

    Raises
    ------
    NotObservableError
        With fewer than six attitudes, or where they lie so that a gain stays unknown.
    """
    if imu.calibration is not None:
        raise ValueError("the recording was corrected by a calibration already; give the sensor's own readings")
    if not imu.has_accel:
        raise NotObservableError("IMU calibration", Fact("rests-without-accelerometer"))
    with one_blas_thread():
        candidates = candidate_rests(imu)
        most = max((rests.attitudes for rests in candidates), default=0)
        if most < FEWEST_ATTITUDES:
            few = Fact("attitudes-too-few", attitudes=most, needed=FEWEST_ATTITUDES)
            raise NotObservableError("IMU calibration", few)
        usable = [r for r in candidates if r.attitudes >= max(FEWEST_ATTITUDES, _MOST_ATTITUDES * most)]
        alone = [(fit_rests(imu, rests, gravity_m_s2, gravity_sigma_m_s2, accel_only=True), rests) for rests in usable]
        of_accel, rests = min(alone, key=lambda pair: _residual(*pair))
        fit = fit_rests(imu, rests, gravity_m_s2, gravity_sigma_m_s2)
    apart = _apart(fit)
    if apart:
        fit = of_accel
    name = imu.device if device is None else device
    calibration = replace(_calibration(fit, rests, gravity_m_s2, name), temperature_c=imu.temperature_c)
    verdict, reasons = _judge_calibration(calibration, fit, rests, gravity_sigma_m_s2, apart=apart)
    return RestCalibration(
        calibration=calibration,
        verdict=verdict,
        reasons=reasons,
        rests=rests,
        before_m_s2=np.linalg.norm(rests.accel_m_s2, axis=1) - gravity_m_s2,
        after_m_s2=fit.accel_residual_m_s2,
        turn_residual_rad=fit.turn_residual_rad,
    )


def _residual(fit: RestFit, rests: Rests) -> float:
    """Mean square of what the fit leaves of gravity, for each residual that the parameters do not use up."""
    return float(np.sum(fit.accel_residual_m_s2**2)) / max(len(rests) - 9, 1)


def _apart(fit: RestFit) -> bool:
    """Whether the gyroscope does not turn as the accelerometer says, whatever its gains."""
    missed = fit.turn_residual_rad[np.isfinite(fit.turn_residual_rad)]
    gains = max(np.abs(fit.accel_gain).max(), np.abs(fit.gyro_gain).max())
    return bool(gains > _LARGEST_GAIN or (len(missed) > 0 and np.median(missed) > _LARGEST_MISS_RAD))


def _calibration(fit: RestFit, rests: Rests, gravity_m_s2: float, device: str) -> ImuCalibration:
    accel_gain, cov = fit.accel_gain.copy(), fit.cov.copy()
    if rests.attitudes < FULL_ATTITUDES:
        beside = np.array([3, 6, 7])  # yx, zx, zy: the misalignments
        accel_gain.ravel()[beside] = 0.0
        cov[beside, :] = cov[:, beside] = 0.0
        cov[beside, beside] = MISALIGNMENT_SIGMA**2
    return ImuCalibration(
        accel_gain=accel_gain,
        accel_bias_m_s2=fit.accel_bias_m_s2,
        gyro_gain=fit.gyro_gain,
        gyro_bias_rad_s=fit.gyro_bias_rad_s,
        cov=cov,
        gravity_m_s2=gravity_m_s2,
        device=device,
        attitudes=rests.attitudes,
    )


def _judge_calibration(
    calibration: ImuCalibration, fit: RestFit, rests: Rests, gravity_sigma_m_s2: float, *, apart: bool
) -> tuple[Literal["good", "weak"], tuple[Fact, ...]]:
    """The verdict on a calibration: whether the attitudes were spread enough, and what stays unknown.

    Raises
    ------
    NotObservableError
        Where a gain of the accelerometer stays as unknown as it was.
    """
    sigma = np.sqrt(np.diagonal(calibration.cov))
    gains = sigma[IMU_CAL.ACCEL_GAIN].reshape(3, 3)
    unknown = [axis for axis, s in zip(_AXES, np.diagonal(gains), strict=True) if s > 0.7 * PRIORS.accel_gain]
    if unknown:
        raise NotObservableError("IMU calibration", Fact("attitudes-alike", axes=unknown))
    weak, notes = [], []
    count = rests.attitudes
    if count < FULL_ATTITUDES:
        weak.append(
            Fact("misalignments-unknown", attitudes=count, misalignment=MISALIGNMENT_SIGMA, needed=FULL_ATTITUDES)
        )
    elif gains[np.tril_indices(3, -1)].max() > _GOOD_MISALIGNMENT:
        weak.append(Fact("misalignment-unknown"))
    if np.diagonal(gains).max() > KNOWN_GAIN:
        worst = _AXES[int(np.argmax(np.diagonal(gains)))]
        weak.append(Fact("accel-gain-unsure", axis=worst, sigma=np.diagonal(gains).max()))
    gyro = sigma[IMU_CAL.GYRO_GAIN].reshape(3, 3)
    slack = [axis for axis, s in zip(_AXES, np.diagonal(gyro), strict=True) if s > _GOOD_GYRO_GAIN]
    if apart:
        weak.append(Fact("gyro-contradicts-rests"))
    elif slack:
        weak.append(Fact("gyro-gain-unsure", axes=slack))
    if fit.accel_noise > _NOISY or fit.turn_noise > _NOISY:
        of = "lengths of gravity" if fit.accel_noise > fit.turn_noise else "turns"
        weak.append(Fact("rests-disagree", of=of, times=max(fit.accel_noise, fit.turn_noise)))
    if fit.drift_p_value < _DRIFT_P_VALUE:
        weak.append(Fact("accel-bias-drifted", drift_m_s2=np.linalg.norm(fit.drift_m_s2)))
    if gravity_sigma_m_s2 > 2e-3:
        notes.append(Fact("gravity-assumed", sigma=gravity_sigma_m_s2 / calibration.gravity_m_s2))
    return ("weak" if weak else "good"), (*weak, *notes)


__all__ = [
    "FEWEST_ATTITUDES",
    "FULL_ATTITUDES",
    "RestCalibration",
    "calibrate_imu",
]
