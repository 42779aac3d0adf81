"""Scale by the magnitudes of acceleration spectra: the method of Mustaniemi et al. (IROS 2017).

Mustaniemi, Kannala, Sarkka, Matas, Heikkila: "Inertial-based scale estimation for structure from motion on mobile
devices". Positions are smoothed and differentiated, turned into the IMU frame, and compared with the accelerometer:
first by a linear fit of scale, gravity and bias, then, with the strength of gravity fixed, by the magnitudes of their
spectra below about 1.2 Hz, which do not mind a small error of the time offset.

What is different here: lengths are normalised and the noise is estimated per recording; the accelerometer goes through
the same smoother as the positions; orientation comes from gyroscope and camera together; the lever arm between camera
and IMU takes part within its prior; frequencies weigh by their noise, of which the camera's share belongs to the
camera's side, so that noise there does not shrink the scale; and the result has an uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ScaleEstimate
from colmap_inertial.inertial.scale._spectra import SHORTEST_S, Signals
from colmap_inertial.inertial.scale._spectral_fit import SpectralFit, fit_spectra
from colmap_inertial.inertial.scale.verdict import verdict_of

#: An accelerometer's bias this large is another mistake (m/s2).
_BIAS_LIMIT_M_S2 = 1.5
#: Halves of the recording further apart than this many standard deviations contradict each other; from this length on.
_HALVES_SIGMAS, _HALVES_FROM_S = 2.5, 16.0


@dataclass(frozen=True, kw_only=True)
class SpectralOptions:
    """The spectral method's choices."""

    gravity_m_s2: float = 9.80665
    """Strength of gravity where the recording was made."""

    highest_hz: float = 1.2
    """Frequencies up to this one are compared: hand motion is slower, noise of positions is quicker."""


def estimate_spectral(
    trajectory: CameraTrajectory,
    timed: CameraTimedImu,
    options: SpectralOptions | None = None,
) -> ScaleEstimate:
    """Metres per unit, gravity and accelerometer bias from acceleration spectra.

    Parameters
    ----------
    trajectory
        Dense poses (frames at most 0.2 s apart), any unit.
    timed
        Both sensors; rotation and gyroscope bias; the lever arm with its covariance is a prior.
    options
        Gravity and bandwidth.

    Returns
    -------
    ``cov`` is that of log scale, gravity (m/s2, world) and bias (m/s2): Gauss-Newton's, scaled by the residuals where
    they exceed the estimated noise; the scale's variance also contains the accelerometer's gain (0.5 %) and what is
    unknown of the noise's share between the sensors. Where the data cannot give a scale, a refused estimate.
    """
    options, calibration = options or SpectralOptions(), timed.calibration
    try:
        signals = Signals.of(trajectory, timed)
        if not signals.segments:
            needed = f"no stretch of {SHORTEST_S:g} s is covered by camera and accelerometer without a pause"
            raise NotObservableError("scale", f"{needed}: record longer")
        fit = fit_spectra(signals.spectra(options.highest_hz), calibration, options.gravity_m_s2)
    except NotObservableError as error:
        return ScaleEstimate.refused("spectral", error.hint, calibration=calibration)
    checks, refusals = _checks(signals, calibration, options, fit)
    verdict, ci95, reasons = verdict_of(fit.metres_per_unit, fit.sigma_log, checks, refusals=refusals)
    if verdict == "refused":
        return ScaleEstimate.refused("spectral", *reasons, calibration=calibration)
    return ScaleEstimate(
        metres_per_unit=fit.metres_per_unit,
        sigma_log=fit.sigma_log,
        ci95=ci95,
        verdict=verdict,
        method="spectral",
        reasons=reasons,
        gravity_in_world_m_s2=fit.gravity,
        accel_bias_m_s2=fit.bias,
        calibration=calibration,
        cov=fit.cov,
        chi2=fit.chi2,
        dof=fit.dof,
        excitation_m_s2=signals.excitation * fit.metres_per_unit,
    )


def _checks(
    signals: Signals, calibration: CameraImuCalibration, options: SpectralOptions, fit: SpectralFit
) -> tuple[list[str], list[str]]:
    """Findings that lower the verdict, and findings that refuse the scale."""
    checks, refusals = [], []
    if np.linalg.norm(fit.bias) > _BIAS_LIMIT_M_S2:
        refusals.append(
            f"the accelerometer would have a bias of {np.linalg.norm(fit.bias):.1f} m/s2: check its axes, sign and unit"
        )
    if signals.duration_s >= _HALVES_FROM_S:
        halves = []
        for which in (0, 1):
            try:
                spectra = signals.half(which).spectra(options.highest_hz)
                halves.append(fit_spectra(spectra, calibration, options.gravity_m_s2))
            except NotObservableError:
                checks.append("half of the recording alone gives no scale")
                return checks, refusals
        first, second = halves
        apart = np.log(second.metres_per_unit / first.metres_per_unit)
        if abs(apart) > _HALVES_SIGMAS * np.hypot(first.sigma_log, second.sigma_log):
            checks.append(
                f"the second half of the recording gives a scale {100 * np.expm1(apart):+.1f} % from the first"
            )
    return checks, refusals
