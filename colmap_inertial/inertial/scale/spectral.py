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

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, ComplexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CAL, CameraImuCalibration, CameraTrajectory, ScaleEstimate
from colmap_inertial.inertial.core.priors import clock_scale_sigma
from colmap_inertial.inertial.scale._spectra import SHORTEST_S, Signals, Spectra
from colmap_inertial.inertial.scale.verdict import check_clocks, verdict_of

#: Standard deviation of the accelerometer's bias before anything is known (m/s2).
_BIAS_SIGMA_M_S2 = 1.0
#: Sensors of phones lie in the plane of the image: the lever arm along the optical axis is short (m).
_LEVER_ALONG_AXIS_M = 0.01
#: What no such recording can show: the accelerometer's gain, and the angles between its axes.
_GAIN_SIGMA, _AXIS_SIGMA_RAD = 0.005, 0.002
#: Least noise of a sample of the accelerometer at frame rate (m/s2), and where the search for it starts.
_LEAST_NOISE, _USUAL_NOISE = 1e-3, 0.05
#: Columns of the parameters: logarithm of the scale, lever arm, bias, two angles of gravity.
_SCALE, _LEVER, _BIAS, _TILT, _N = 0, slice(1, 4), slice(4, 7), slice(7, 9), 9


@dataclass(frozen=True, eq=False, kw_only=True)
class SpectralFit:
    """Fit to the spectra; ``cov`` (7, 7) of log scale, gravity and bias."""

    metres_per_unit: float
    gravity: Array
    bias: Array
    lever: Array
    cov: Array
    chi2: float
    dof: int

    @property
    def sigma_log(self) -> float:
        return float(np.sqrt(self.cov[0, 0]))


@dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    scale: float
    lever: Array
    bias: Array
    gravity: Array

    def moved(self, step: Array) -> _State:
        gravity = self.gravity + _tangent(self.gravity) @ step[_TILT]
        return _State(
            scale=self.scale * float(np.exp(step[_SCALE])),
            lever=self.lever + step[_LEVER],
            bias=self.bias + step[_BIAS],
            gravity=gravity * (np.linalg.norm(self.gravity) / np.linalg.norm(gravity)),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Noise:
    """Power by frequency (F,): of the accelerometer's side, and of the camera's side for a scale of one."""

    inertial: Array
    visual: Array

    def power(self, scale: float) -> Array:
        return self.inertial + scale**2 * self.visual


def fit_spectra(spectra: Spectra, calibration: CameraImuCalibration, gravity_m_s2: float) -> SpectralFit:
    """Scale, gravity and bias from spectra of accelerations.

    Parameters
    ----------
    spectra
        Below the frequency where noise of positions takes over.
    calibration
        Its lever arm and covariance are a prior.
    gravity_m_s2
        Strength of gravity, held.

    Raises
    ------
    NotObservableError
        Where camera and accelerometer have no acceleration in common.
    """
    if 6 * len(spectra.frequency_hz) < 2 * _N:
        raise NotObservableError("scale", Fact("recording-too-short"))
    unit = float(np.sqrt(np.mean(np.abs(spectra.visual[1:]) ** 2)))
    if not unit > 0:
        raise NotObservableError("scale", Fact("camera-still-in-spectra"))
    # lengths normalised: accelerations of the camera have a mean square of one
    data = replace(spectra, visual=spectra.visual / unit, visual_noise=spectra.visual_noise / unit**2)
    prior = _make_prior(calibration)
    state, noise = _linear_start(data, prior, gravity_m_s2)
    for _ in range(3):
        state = _descend(data, noise, prior, state)
        noise = _estimate_noise(data, state, noise)
    state = _descend(data, noise, prior, state)
    residual, jacobian = _compare_magnitudes(data, noise, prior, state)
    dof = len(residual) - _N
    chi2 = float(residual @ residual)
    cov = np.linalg.inv(jacobian.T @ jacobian) * max(1.0, chi2 / dof)
    cov[_SCALE, _SCALE] += _GAIN_SIGMA**2 + _share_variance(data, noise, prior, state)
    cov[_SCALE, _SCALE] += clock_scale_sigma(calibration.clock_rate) ** 2
    # a gain error of the accelerometer makes a bias of gravity, axes that are not square a tilt
    cov[_BIAS, _BIAS] += (_GAIN_SIGMA * gravity_m_s2) ** 2 * np.eye(3)
    cov[_TILT, _TILT] += _AXIS_SIGMA_RAD**2 * np.eye(2)
    into = np.zeros((7, _N))
    into[0, _SCALE] = 1.0
    into[1:4, _TILT] = _tangent(state.gravity)
    into[4:7, _BIAS] = np.eye(3)
    full = into @ cov @ into.T
    return SpectralFit(
        metres_per_unit=state.scale / unit,
        gravity=state.gravity,
        bias=state.bias,
        lever=state.lever,
        cov=0.5 * (full + full.T),
        chi2=chi2,
        dof=dof,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Prior:
    """Prior of lever arm and bias: mean (6,) and the root of the information (6, 6)."""

    mean: Array
    root: Array


def _make_prior(calibration: CameraImuCalibration) -> _Prior:
    cov = np.zeros((6, 6))
    lever = calibration.cov[CAL.LEVER_ARM, CAL.LEVER_ARM].copy()
    along = min(1.0, _LEVER_ALONG_AXIS_M / max(float(np.sqrt(lever[2, 2])), 1e-9))
    lever[2] *= along
    lever[:, 2] *= along
    cov[:3, :3] = lever + 1e-4**2 * np.eye(3)
    cov[3:, 3:] = _BIAS_SIGMA_M_S2**2 * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(cov))
    return _Prior(mean=np.concatenate([calibration.imu_in_cam_m, np.zeros(3)]), root=root)


def _tangent(gravity: Array) -> Array:
    """(3, 2) two directions along which gravity can tilt, per radian."""
    across = np.cross(gravity, np.eye(3)[np.argmin(np.abs(gravity))])
    across /= np.linalg.norm(across)
    return np.stack([np.linalg.norm(gravity) * across, np.cross(gravity, across)], axis=1)


def _predict_accelerations(data: Spectra, state: _State) -> tuple[ComplexArray, ComplexArray]:
    """(F, 3), (F, 3): the IMU's acceleration according to the camera, and according to the accelerometer."""
    visual = state.scale * data.visual + data.lever_by @ state.lever
    inertial = data.inertial - data.bias_by @ state.bias + data.gravity_by @ state.gravity
    return visual, inertial


def _linear_start(data: Spectra, prior: _Prior, gravity_m_s2: float) -> tuple[_State, _Noise]:
    """Complex least squares for all of them at once, gravity free; the noise along with it."""
    columns = np.concatenate([data.visual[:, :, None], data.lever_by, data.bias_by, -data.gravity_by], axis=2)
    noise = _Noise(inertial=np.full(len(data.frequency_hz), _USUAL_NOISE**2), visual=data.visual_noise)
    scale = float(np.sqrt(np.mean(np.abs(data.inertial[1:]) ** 2)))
    for _ in range(5):
        weight = 1 / np.sqrt(noise.power(scale))[:, None]
        a = (columns * weight[:, :, None]).reshape(-1, 10)
        b = (data.inertial * weight).ravel()
        pull = np.zeros((6, 10))
        pull[:, 1:7] = prior.root
        left = np.concatenate([a.real, a.imag, pull])
        right = np.concatenate([b.real, b.imag, prior.root @ prior.mean])
        x = np.asarray(np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64)
        if not x[0] > 0:
            raise NotObservableError("scale", Fact("motion-not-felt"))
        state = _State(scale=float(x[0]), lever=x[1:4], bias=x[4:7], gravity=x[7:])
        scale = state.scale
        noise = _estimate_noise(data, state, noise)
    return replace(state, gravity=state.gravity * (gravity_m_s2 / np.linalg.norm(state.gravity))), noise


def _estimate_noise(data: Spectra, state: _State, before: _Noise) -> _Noise:
    """Noise of both sides from what the fit leaves, by Whittle's likelihood.

    The camera's has the spectrum of twice differentiated white noise and at least the power that the smoother found
    (errors of positions are correlated, which adds power at low frequencies); the accelerometer's is white.
    """
    from scipy.optimize import minimize

    visual, inertial = _predict_accelerations(data, state)
    power = np.sum(np.abs(visual - inertial) ** 2, axis=1)
    white = state.scale**2 * data.visual_noise

    def cost(logs: Array) -> float:
        expected = np.exp(logs[0]) + np.exp(logs[1]) * white
        return float(np.sum(3 * np.log(expected) + power / expected))

    least = 2 * np.log(_LEAST_NOISE)
    start = np.array([max(float(np.log(before.inertial[0])), least), 1.0])
    minimum = minimize(
        cost,
        start,
        method="Nelder-Mead",
        bounds=[(least, 10.0), (0.0, 10.0)],
        options={"xatol": 0.02, "fatol": 0.02, "initial_simplex": start + np.array([[0, 0], [2.0, 0], [0, 2.0]])},
    )
    level, factor = np.exp(minimum.x)
    return _Noise(inertial=np.full(len(power), level), visual=factor * data.visual_noise)


def _compare_magnitudes(data: Spectra, noise: _Noise, prior: _Prior, state: _State) -> tuple[Array, Array]:
    """Whitened differences of magnitudes and of the prior, with derivatives by the nine parameters.

    The noise that belongs to the camera's side grows with the scale: as in total least squares, dividing by it keeps
    the scale from shrinking towards where there would be less of it.
    """
    visual, inertial = _predict_accelerations(data, state)
    # a constant has a sign, not a phase: it keeps it, whatever the clocks do
    constant = (data.frequency_hz == 0)[:, None]
    visual_by = np.concatenate([(state.scale * data.visual)[:, :, None], data.lever_by], axis=2)
    inertial_by = np.concatenate([-data.bias_by, data.gravity_by @ _tangent(state.gravity)], axis=2)
    visual_length = np.where(constant, np.sign(visual.real), 1) * np.maximum(np.abs(visual), 1e-12)
    inertial_length = np.where(constant, np.sign(inertial.real), 1) * np.maximum(np.abs(inertial), 1e-12)
    power = noise.power(state.scale)[:, None]
    # of complex noise, half the power is along the signal
    weight = np.sqrt(np.where(constant, 1, 2) / power)
    difference = (visual_length - inertial_length) * weight
    jacobian = np.empty((*difference.shape, _N))
    jacobian[:, :, :4] = np.real(np.conj(visual)[:, :, None] * visual_by) / visual_length[:, :, None]
    jacobian[:, :, 4:] = -np.real(np.conj(inertial)[:, :, None] * inertial_by) / inertial_length[:, :, None]
    jacobian *= weight[:, :, None]
    jacobian[:, :, _SCALE] -= difference * (state.scale**2 * noise.visual[:, None] / power)
    pull = np.zeros((6, _N))
    pull[:, 1:7] = prior.root
    from_prior = prior.root @ (np.concatenate([state.lever, state.bias]) - prior.mean)
    return np.concatenate([difference.ravel(), from_prior]), np.concatenate([jacobian.reshape(-1, _N), pull])


def _descend(data: Spectra, noise: _Noise, prior: _Prior, state: _State) -> _State:
    """Levenberg-Marquardt on the differences of magnitudes."""
    damping = 1e-3
    residual, jacobian = _compare_magnitudes(data, noise, prior, state)
    for _ in range(40):
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ residual
        step = -np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=np.float64)
        step[_SCALE] = np.clip(step[_SCALE], -0.3, 0.3)
        trial = state.moved(step)
        after, jacobian_after = _compare_magnitudes(data, noise, prior, trial)
        if after @ after < residual @ residual:
            state, residual, jacobian, damping = trial, after, jacobian_after, damping / 5
            if np.all(np.abs(step) < 1e-6):
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return state


def _share_variance(data: Spectra, noise: _Noise, prior: _Prior, state: _State) -> float:
    """Variance of the log scale because the noise's share between camera and accelerometer is not really known.

    All on the accelerometer's side gives the smallest scale, all on the camera's the largest; in between, anything.
    """
    power = noise.power(state.scale)
    extremes = [
        _descend(data, _Noise(inertial=power, visual=np.zeros_like(power)), prior, state).scale,
        _descend(data, _Noise(inertial=np.zeros_like(power), visual=power / state.scale**2), prior, state).scale,
    ]
    return float(np.log(extremes[1] / extremes[0])) ** 2 / 12


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
            raise NotObservableError("scale", Fact("never-covered", needed_s=SHORTEST_S))
        fit = fit_spectra(signals.spectra(options.highest_hz), calibration, options.gravity_m_s2)
    except NotObservableError as error:
        return ScaleEstimate.refused("spectral", error.fact, calibration=calibration)
    doubts, refusals = _judge_fit(signals, calibration, options, fit)
    verdict, ci95, reasons = verdict_of(fit.metres_per_unit, fit.sigma_log, doubts, refusals=refusals)
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


def _judge_fit(
    signals: Signals, calibration: CameraImuCalibration, options: SpectralOptions, fit: SpectralFit
) -> tuple[list[Fact], list[Fact]]:
    """Findings that lower the verdict, and findings that refuse the scale."""
    doubts, refusals = check_clocks(calibration.clock_rate), []
    bias_m_s2 = float(np.linalg.norm(fit.bias))
    if bias_m_s2 > _BIAS_LIMIT_M_S2:
        refusals.append(Fact("spectral-bias-large", bias_m_s2=bias_m_s2))
    if signals.duration_s >= _HALVES_FROM_S:
        halves = []
        for which in (0, 1):
            try:
                spectra = signals.half(which).spectra(options.highest_hz)
                halves.append(fit_spectra(spectra, calibration, options.gravity_m_s2))
            except NotObservableError:
                doubts.append(Fact("half-without-scale"))
                return doubts, refusals
        first, second = halves
        apart = np.log(second.metres_per_unit / first.metres_per_unit)
        if abs(apart) > _HALVES_SIGMAS * np.hypot(first.sigma_log, second.sigma_log):
            doubts.append(Fact("halves-differ", difference=np.expm1(apart)))
    return doubts, refusals
