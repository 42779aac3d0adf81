"""Scale from one fit of everything that the camera and the IMU measured; positions are never differentiated.

The most probable motion, calibration and scale given gyroscope, accelerometer and visual poses. States an eighth of a
second apart (at every frame where frames are sparser; fewer in recordings of many minutes): rotation, position,
velocity, gyroscope bias, and random walks of the accelerometer's bias and of the visual centres' error. Globals: scale,
gravity, accelerometer bias, gains and axis errors of both sensors, camera-IMU rotation, lever arm, time offsets of both
sensors and the rate between the clocks, what a rolling shutter does to rotations and centres, and how errors of the
centres go with errors of the rotations.
The IMU enters through preintegration (Forster et al., "On-manifold preintegration", 2017). The noise sits on the visual
centres, not on the inertial path that explains them: regression the other way round attenuates the scale. Noise levels
of the accelerometer and of the poses are estimated along (REML).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.sampling import MUCH_CUT
from colmap_inertial.core.types import (
    CAL,
    CameraImuCalibration,
    CameraTrajectory,
    ImuNoise,
    ScaleDrift,
    ScaleEstimate,
)
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.parameters import Prior
from colmap_inertial.inertial.core.priors import PRIORS, AccelPart, accel_part
from colmap_inertial.inertial.scale._declared import doubts_lever, find_contradicted_lever, leave_out_lever
from colmap_inertial.inertial.scale._fit import Fit, fit_jointly
from colmap_inertial.inertial.scale._gain import WrongGain, exceeds_usual
from colmap_inertial.inertial.scale._setup import Measurements, prepare
from colmap_inertial.inertial.scale._shape import (
    LIMITS as SHAPE_LIMITS,
    ShapeFault,
    confirm_fault,
    find_likeliest_fault,
)
from colmap_inertial.inertial.scale._suspects import Faults, find_filter_of_lag, find_strongest_suspicion
from colmap_inertial.inertial.scale.interval import (
    find_wrong_gain,
    metres_per_unit_of,
    scale_variances,
    variance_factor,
)
from colmap_inertial.inertial.scale.verdict import check_clocks, scale_drifts, verdict_of
from colmap_inertial.io.calibration import SIGMAS

#: So many times at most is something wrong with the accelerometer looked for, undone, and the rest fitted again.
_MOST_FAULTS = 6


@dataclass(frozen=True, kw_only=True)
class JudgementLimits:
    """Limits beyond which a fit is refused or doubtful."""

    #: Largest bias of the accelerometer.
    bias_m_s2: float = 2.0
    #: Largest of its gains and sines of angles between axes.
    gain: float = 0.2
    #: Its noise between states over the motion's acceleration: 0.02 to 0.1 in good recordings, 0.4 and more where an
    #: axis is mirrored.
    unexplained: float = 0.25
    #: Shorter clips say too little about their own noise for a number to be trusted.
    shortest_s: float = 6.0
    #: A scale that still moves by more than so many of its standard deviations in the end is none, where these are
    #: below the second; what moves less is in the interval.
    moves: float = 1.0
    known_log: float = 0.15
    #: A keyframe with a robust weight below this may be in the wrong place. Where three of 30 are, they swell the noise
    #: so that their weights are .27 to .57; others keep .8 and more.
    counts_little: float = 0.6
    #: An accelerometer whose stamps are off by more than so many standard deviations, and than the second, is moved;
    #: what is known of the delay of an unknown device.
    delay_sigmas: float = 3.0
    small_delay_s: float = 0.03
    unknown_delay_s: float = 0.02


_LIMITS = JudgementLimits()


@dataclass(frozen=True, kw_only=True)
class JointOptions:
    """Options of the joint estimator."""

    gravity_m_s2: float = 9.80665
    """Magnitude of gravity where the recording was made (``gravity_at_latitude_m_s2``)."""

    gravity_sigma_m_s2: float = PRIORS.gravity_m_s2
    """Its standard deviation; the default spans 9.78 at the equator to 9.83 at the poles."""

    states_hz: float = 8.0
    """Poses of a video are averaged to this many a second."""

    def __post_init__(self) -> None:
        if not (self.gravity_m_s2 > 0 and self.gravity_sigma_m_s2 > 0 and self.states_hz > 0):
            raise ValueError("gravity, its standard deviation and the rate of states must be positive")


def estimate_joint(
    trajectory: CameraTrajectory,
    timed: CameraTimedImu,
    options: JointOptions | None = None,
) -> ScaleEstimate:
    """Metres per model unit, gravity and accelerometer bias, with a refined calibration.

    Parameters
    ----------
    trajectory
        Camera poses, dense or sparse. ``pose_cov``, where given, weighs frames against each other.
    timed
        Recording of the same device, aligned with the camera. Its calibration's rotation, gyroscope bias and time
        offset are starting points with five times their standard deviations; lever arm, readout and the offset between
        the sensors are priors as they stand.
    options
        See ``JointOptions``.

    Returns
    -------
    ``method="joint"``. ``sigma_log`` combines the posterior standard deviation, inflated by chi-square where the fit is
    worse than its noise and widened as Student's distribution is where few residuals tell the noise, with the floor
    (``priors.model_scale_sigma``), what noise in the fitted path may take from the scale, and how uncertain it is what
    was undone of the accelerometer's faults. ``verdict`` is ``"refused"`` where the data cannot give a scale, with the
    reason.
    """
    options = options or JointOptions()
    accel, expected_s = accel_part(timed.imu), timed.calibration.accel_delay_s
    shape = ShapeFaults()
    try:
        timed, data, prior, fit, lever = _fit_without_contradicted_lever(trajectory, timed, options)
        fit, faults = _fit_undoing_accel_faults(fit, data, prior, timed.imu.noise)
        # a path that was smoothed has no shape to speak of
        if not faults.path_is_smoothed:
            sound, loose = faults.undo(data), faults.loosen_delay(prior)
            fit, shape = _fit_undoing_shape_faults(fit, sound, loose, timed.imu.noise)
    except NotObservableError as error:
        return ScaleEstimate.refused("joint", error.fact)
    except np.linalg.LinAlgError:
        return ScaleEstimate.refused("joint", Fact("fit-singular"))
    moved_s = timed.calibration.accel_delay_s - expected_s
    lags, taken_log = _find_lag(fit, moved_s) if "bandwidth" not in faults.values else ([], 0.0)
    left_open = sum(suspicion.scale_variance for suspicion in fit.suspicions if suspicion.name in faults.values)
    fit = replace(fit, variance_parts={**fit.variance_parts, "accel_faults": left_open + taken_log**2})
    declared = [] if lever is None else [lever]
    wrong = [*declared, *faults.as_facts(), *lags, *_check_saturation(data)]
    # what was taken from a path nobody can put back: its scale is too large by more than any interval says
    estimate = _judge_fit(fit, timed.calibration, accel, wrong, shape, worthless=faults.path_is_smoothed)
    notes = (*estimate.notes, *_note_moved_stamps(moved_s))
    return replace(estimate, notes=notes, jumped=_name_jumped_images(fit, data, trajectory))


def _find_lag(fit: Fit, moved_s: float) -> tuple[list[Fact], float]:
    """A doubt where the accelerometer lags as if it had been filtered, and what that would take from the scale."""
    sigma_s = float(fit.cov[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** 0.5
    constant_s = find_filter_of_lag(fit.suspicions, -(moved_s + fit.estimate.accel_delay_s), sigma_s)
    if constant_s == 0:
        return [], 0.0
    by_scale = next(one.by_scale for one in fit.suspicions if one.name == "bandwidth")
    return [Fact("accel-lags-as-filtered", lag_s=constant_s)], 0.5 * constant_s**2 * float(by_scale[0])


def _note_moved_stamps(moved_s: float) -> list[Fact]:
    """A note where the accelerometer's stamps were moved."""
    return [] if moved_s == 0 else [Fact("accel-delay-undone", delay_s=-moved_s)]


def _name_jumped_images(fit: Fit, data: Measurements, trajectory: CameraTrajectory) -> tuple[str, ...]:
    """Images by themselves that hardly count, or at which the path jumps, those that count least first.

    Behind a break the drift is free.
    """
    edges = np.concatenate([[True], data.broken, [True]])
    little = (fit.pose_weight < _LIMITS.counts_little) & ~np.append(False, data.broken)
    alone = (data.groups.count == 1) & (little | (edges[:-1] & edges[1:]))
    least_first = np.flatnonzero(alone)[np.argsort(fit.pose_weight[alone], kind="stable")]
    return tuple(trajectory.names[int(np.argmin(np.abs(trajectory.t_s - t)))] for t in data.t_s[least_first])


def _prepare(trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions) -> tuple[Measurements, Prior]:
    """Measurements and prior of the fit."""
    return prepare(
        trajectory,
        timed,
        gravity_m_s2=options.gravity_m_s2,
        gravity_sigma_m_s2=options.gravity_sigma_m_s2,
        states_hz=options.states_hz,
    )


def fit_path(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[Measurements, Fit, tuple[Fact, ...]]:
    """The measurements as they came, their fit, and what is wrong with the accelerometer or the model's shape.

    Raises
    ------
    NotObservableError
        When too few frames lie inside the IMU recording.
    numpy.linalg.LinAlgError
        When the data leave the system singular.
    """
    timed, data, prior, fit = _fit_moving_stamps(trajectory, timed, options)
    fit, faults = _fit_undoing_accel_faults(fit, data, prior, timed.imu.noise)
    _, shape = _fit_undoing_shape_faults(fit, faults.undo(data), faults.loosen_delay(prior), timed.imu.noise)
    widened = variance_factor(fit)
    return data, fit, (*faults.as_facts(), *(fault.as_fact(data.t_s, widened) for fault in shape.found))


def _fit_without_contradicted_lever(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[CameraTimedImu, Measurements, Prior, Fit, Fact | None]:
    """As :func:`_fit_moving_stamps`, without a declared lever arm that a fit without it contradicts; then that fact."""

    def fit_without(length_m: float) -> tuple[CameraTimedImu, Measurements, Prior, Fit]:
        calibration = leave_out_lever(timed.calibration, length_m=length_m)
        return _fit_moving_stamps(trajectory, replace(timed, calibration=calibration), options)

    believed = _fit_moving_stamps(trajectory, timed, options)
    _, _, prior, fit = believed
    if not doubts_lever(fit, prior, is_refused=bool(_find_refusals(fit))):
        return *believed, None
    length_m = float(np.linalg.norm(prior.mean.imu_in_cam_m))
    alone = fit_without(length_m)
    lever = None if _find_refusals(alone[-1]) else find_contradicted_lever(alone[-1], prior)
    if lever is None:
        return *believed, None
    return *(alone if length_m <= SIGMAS.unknown_lever_arm_m else fit_without(0.0)), lever


def _fit_moving_stamps(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[CameraTimedImu, Measurements, Prior, Fit]:
    """The recording, its measurements and their fit; with the accelerometer's stamps moved where they are far off.

    A delay beyond its prior is pulled towards it, and frames were averaged by readings of another moment: the fit
    starts again from what was found, which is as little known as that of an unknown device.
    """
    data, prior = _prepare(trajectory, timed, options)
    fit = fit_jointly(data, prior, timed.imu.noise)
    delay_s, expected_s = fit.estimate.accel_delay_s, float(prior.info[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** -0.5
    sigma_s = float(fit.cov[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** 0.5
    if not is_out_of_step(delay_s, sigma_s, expected_s):
        return timed, data, prior, fit
    timed = replace(timed, calibration=timed.calibration.shift_clock_offsets(0.0, delay_s))
    data, prior = _prepare(trajectory, timed, options)
    info, at = prior.info.copy(), par.ACCEL_DELAY
    info[at, at] = max(expected_s, _LIMITS.unknown_delay_s) ** -2
    prior = replace(prior, info=info)
    return timed, data, prior, fit_jointly(data, prior, timed.imu.noise)


def is_out_of_step(delay_s: float, sigma_s: float, expected_s: float) -> bool:
    """Whether an accelerometer's stamps are further off than was expected, than chance makes them, and than matters.

    Parameters
    ----------
    delay_s, sigma_s
        As fitted.
    expected_s
        Standard deviation of what was known before.
    """
    known = _LIMITS.delay_sigmas * max(sigma_s, expected_s)
    return abs(delay_s) > max(known, _LIMITS.small_delay_s)


def _fit_undoing_accel_faults(fit: Fit, data: Measurements, prior: Prior, sheet: ImuNoise | None) -> tuple[Fit, Faults]:
    """The fit, with what shows to be wrong with the accelerometer undone, and what that was."""
    faults, sound = Faults(values={}), data
    for _ in range(_MOST_FAULTS):
        if fit.gain_chi2 > par.LARGEST_GAIN_CHI2 and not prior.heavy_gains:
            # not from the start: on its way a fit passes gains that it would not find back from
            prior = replace(prior, heavy_gains=True)
            fit = fit_jointly(sound, faults.loosen_delay(prior), sheet)
        suspicion = find_strongest_suspicion(fit.suspicions, data.streams.accel, faults.values)
        # a fit of what does not belong together explains nothing
        if suspicion is None or _find_refusals(fit):
            break
        faults = faults.with_found(suspicion)
        if faults.path_is_smoothed:
            break
        sound = faults.undo(data)
        fit = fit_jointly(sound, faults.loosen_delay(prior), sheet)
    return fit, faults


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeFaults:
    """What seems to be wrong with a model's shape: what was undone, and what is only said."""

    undone: tuple[ShapeFault, ...] = ()
    said: tuple[ShapeFault, ...] = ()

    @property
    def found(self) -> tuple[ShapeFault, ...]:
        """All of them."""
        return (*self.undone, *self.said)

    @property
    def harmless(self) -> tuple[ShapeFault, ...]:
        """Those that make no scale weak: a stretch that is said alone leaves lengths right on average."""
        return tuple(fault for fault in self.said if fault.kind == "stretch")

    @property
    def doubtful(self) -> tuple[ShapeFault, ...]:
        """All others."""
        return tuple(fault for fault in self.found if fault not in self.harmless)


def _fit_undoing_shape_faults(
    fit: Fit, data: Measurements, prior: Prior, sheet: ImuNoise | None
) -> tuple[Fit, ShapeFaults]:
    """The fit of a model without what shows to be wrong with its shape, and what that was.

    What it does to the scale, or would do where there is too little evidence to undo it, is in the interval.
    """
    shape, before = ShapeFaults(), fit
    open_variance = 0.0
    # wrong gains look like a stretch
    sound = fit.gain_chi2 <= par.LARGEST_GAIN_CHI2 and not _find_refusals(fit)
    while sound and len(shape.undone) < SHAPE_LIMITS.most:
        suspected = find_likeliest_fault(fit.shape, variance_factor(fit))
        if suspected is None:
            break
        mended = replace(data.groups, centre=suspected.undo(data.t_s, data.groups.centre))
        trial_data = replace(data, groups=mended)
        trial = fit_jointly(trial_data, prior, sheet)
        widened = variance_factor(trial)
        fault = confirm_fault(suspected, trial.shape, widened)
        if fault is None:
            break
        if fault.chi2(widened) <= fault.undone_limit:
            shape = replace(shape, said=(fault,))
            open_variance += _log_ratio(trial, fit) ** 2
            break
        data, fit = trial_data, trial
        shape = replace(shape, undone=(*shape.undone, fault))
    open_variance += sum(float(one.by_scale @ one.cov @ one.by_scale) for one in shape.undone)
    open_variance += _log_ratio(fit, before) ** 2
    parts = {**fit.variance_parts, "model_shape": open_variance}
    return replace(fit, drift=before.drift, variance_parts=parts), shape


def _log_ratio(fit: Fit, before: Fit) -> float:
    """Logarithm of the scale of a fit over that of another."""
    return float(np.log(fit.estimate.metres_per_unit / before.estimate.metres_per_unit))


def _check_saturation(data: Measurements) -> list[Fact]:
    """Sensors of which much is cut off at the end of the range."""
    shares = {"gyroscope": data.gyro_cut_share, "accelerometer": data.accel_cut_share}
    return [
        Fact("readings-cut-off", sensor=sensor, share=share) for sensor, share in shares.items() if share > MUCH_CUT
    ]


def _judge_fit(
    fit: Fit,
    calibration: CameraImuCalibration,
    accel: AccelPart,
    wrong: Sequence[Fact],
    shape: ShapeFaults,
    *,
    worthless: bool,
) -> ScaleEstimate:
    """The estimate with its interval and verdict; with ``worthless``, ``wrong`` refuses it."""
    clock_rate = calibration.clock_rate + fit.estimate.clock_rate
    variances = scale_variances(fit, accel, clock_rate)
    metres_per_unit, sigma_log = metres_per_unit_of(fit), sum(variances.values()) ** 0.5
    refusals = [*_find_refusals(fit), *(wrong if worthless else ())]
    verdict, ci95, reasons = verdict_of(metres_per_unit, sigma_log, refusals=refusals)
    counted: tuple[Fact, ...] = ()
    if verdict == "refused":
        reasons = (*reasons, *(() if worthless else wrong))
    else:
        doubts, within = _find_doubts(fit, accel, clock_rate, wrong, shape)
        verdict, ci95, reasons = verdict_of(metres_per_unit, sigma_log, doubts)
        counted = tuple(Fact("counted-in-interval", found=fact) for fact in within)
    # what is in the interval makes nothing weak by itself; where the interval is wide, it may be why
    reasons, notes = (reasons, counted) if verdict == "trusted" else ((*reasons, *counted), ())
    refused = verdict == "refused"
    return ScaleEstimate(
        metres_per_unit=None if refused else metres_per_unit,
        sigma_log=None if refused else sigma_log,
        ci95=None if refused else ci95,
        verdict=verdict,
        method="joint",
        reasons=reasons,
        notes=(*notes, *_note_jumps(fit)),
        gravity_in_world_m_s2=fit.estimate.gravity_m_s2,
        accel_bias_m_s2=fit.estimate.accel_bias_m_s2,
        calibration=_refine_calibration(fit, calibration),
        cov=_estimate_cov(fit, sigma_log),
        chi2=sum(squares for squares, _ in fit.sums.values()),
        dof=max(1, round(sum(expected for _, expected in fit.sums.values()))),
        excitation_m_s2=fit.excitation_m_s2,
        drift=fit.drift,
        parts=None if refused else {cause: variance**0.5 for cause, variance in variances.items()},
        noise=fit.noise.imu_over_seconds(),
    )


def _find_doubts(
    fit: Fit, accel: AccelPart, clock_rate: float, wrong: Sequence[Fact], shape: ShapeFaults
) -> tuple[list[Fact], list[Fact]]:
    """Findings that make a scale weak, what was declared first, and others that are in its interval."""
    widened, wrong_gain = variance_factor(fit), find_wrong_gain(fit, accel)
    declared = _check_calibrated_gains(fit, wrong_gain) if accel.calibrated else []
    large, usual = ([], []) if accel.calibrated else _check_gains(fit, wrong_gain)
    bent = [fault.as_fact(fit.t_s, widened) for fault in shape.doubtful] or _check_drift(fit.drift)
    others = [*check_clocks(clock_rate), *_check_length(fit.t_s), *_check_rest(fit)]
    doubts = [*declared, *wrong, *others, *large, *bent]
    return doubts, [*usual, *(fault.as_fact(fit.t_s, widened) for fault in shape.harmless)]


def _note_jumps(fit: Fit) -> list[Fact]:
    """A note where poses jump."""
    return [Fact("poses-jump", since_s=[at_s - fit.t_s[0] for at_s in fit.jumped_s])] if len(fit.jumped_s) else []


def _estimate_cov(fit: Fit, sigma_log: float) -> Array:
    """(7, 7) of log scale, gravity and accelerometer bias; of the scale, only its own variance is the interval's."""
    kept = [par.SCALE, *range(par.GRAVITY.start, par.ACCEL_BIAS.stop)]
    # the fit's unknown is u, the inverse of the metres per unit
    signs = np.array([-1.0, *[1.0] * 6])
    cov = np.asarray(fit.cov[np.ix_(kept, kept)] * signs[:, None] * signs)
    cov[0, 0] = sigma_log**2
    return cov


def _find_refusals(fit: Fit) -> list[Fact]:
    """Findings that make the number worthless."""
    out = []
    x = fit.estimate
    sigma_log = float(fit.cov[par.SCALE, par.SCALE]) ** 0.5
    if fit.unsettled_log > _LIMITS.moves * sigma_log and sigma_log < _LIMITS.known_log:
        out.append(Fact("fit-not-converged"))
    bias = float(np.linalg.norm(x.accel_bias_m_s2))
    if bias > _LIMITS.bias_m_s2:
        out.append(Fact("accel-bias-impossible", bias_m_s2=bias))
    gain = float(np.abs(x.accel_gain).max())
    if gain > _LIMITS.gain:
        out.append(Fact("accel-gain-impossible", gain=gain))
    # Noise of the accelerometer averaged between states, against the acceleration that it should measure
    unexplained = fit.noise.accel_m_s2(float(np.median(np.diff(fit.t_s))))
    if unexplained > _LIMITS.unexplained * fit.excitation_m_s2:
        out.append(Fact("accel-contradicts-motion", unexplained_m_s2=unexplained, motion_m_s2=fit.excitation_m_s2))
    return out


def _check_length(t_s: Array) -> list[Fact]:
    """Whether a clip is too short for its number not to be doubtful."""
    span_s = float(t_s[-1] - t_s[0])
    if span_s >= _LIMITS.shortest_s:
        return []
    return [Fact("clip-short", span_s=span_s, needed_s=_LIMITS.shortest_s)]


def _check_rest(fit: Fit) -> list[Fact]:
    """A doubt where the fit has hardly come to rest."""
    return [] if fit.converged else [Fact("fit-hardly-converged", moves_log=fit.unsettled_log)]


def _check_calibrated_gains(fit: Fit, wrong_gain: WrongGain | None) -> list[Fact]:
    """A doubt where a calibrated accelerometer has gains, which contradict the calibration."""
    if fit.gain_chi2 > par.LARGEST_GAIN_CHI2:
        return [Fact("calibrated-gain-contradicted", gains=-np.diagonal(fit.estimate.accel_gain))]
    if wrong_gain is not None and wrong_gain.is_likely:
        return [Fact("calibrated-gain-contradicted", gains=(wrong_gain.gain,) * 3)]
    return []


def _check_gains(fit: Fit, wrong_gain: WrongGain | None) -> tuple[list[Fact], list[Fact]]:
    """Gains of an accelerometer that was not calibrated: larger than any sensor's, and others that are worth a word."""
    gains = fit.estimate.accel_gain
    if fit.gain_chi2 > par.LARGEST_GAIN_CHI2:
        sigma = np.sqrt(variance_factor(fit) * np.diagonal(fit.cov[par.ACCEL_GAIN, par.ACCEL_GAIN])).reshape(3, 3)
        found = Fact("accel-gain-large", gains=-np.diagonal(gains))
        return ([found], []) if exceeds_usual(gains, sigma).any() else ([], [found])
    if wrong_gain is None or not wrong_gain.is_likely:
        return [], []
    found = Fact("accel-gain-doubtful", gain=wrong_gain.gain, excess=wrong_gain.excess)
    return ([found], []) if wrong_gain.is_large else ([], [found])


def _check_drift(drift: ScaleDrift) -> list[Fact]:
    """A doubt where the scales of parts of the recording differ."""
    out = []
    if scale_drifts(drift.p_value, drift.trend_log_per_s, drift.trend_sigma_log_per_s):
        low, high = np.expm1(drift.log_ratio.min()), np.expm1(drift.log_ratio.max())
        part_s = drift.end_s[0] - drift.begin_s[0]
        out.append(Fact("scale-varies", lowest=low, highest=high, part_s=part_s))
    return out


def _refine_calibration(fit: Fit, calibration: CameraImuCalibration) -> CameraImuCalibration:
    """The calibration as the fit refines it; the readout stays."""
    x = fit.estimate
    # Rows of CALIBRATION_PARAMETERS from the globals and the mean gyroscope bias
    jacobian = np.zeros((CAL.COUNT, par.N_GLOBALS))
    jacobian[CAL.ROTATION, par.ROTATION] = np.eye(3)
    jacobian[CAL.TIME_OFFSETS, par.DELAY] = 1.0
    jacobian[CAL.ACCEL_TIME_OFFSET, par.ACCEL_DELAY] = 1.0
    jacobian[CAL.LEVER_ARM, par.LEVER] = np.eye(3)
    cov = jacobian @ fit.cov @ jacobian.T
    with_bias = jacobian @ fit.gyro_bias_with_globals
    cov[:, CAL.GYRO_BIAS] += with_bias
    cov[CAL.GYRO_BIAS, :] += with_bias.T
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = fit.gyro_bias_cov
    cov[CAL.READOUT, CAL.READOUT] = calibration.cov[CAL.READOUT, CAL.READOUT]
    return replace(
        calibration.shift_clock_offsets(x.delay_s, x.accel_delay_s),
        cam_from_imu_xyzw=quat_from_matrix(x.cam_from_imu),
        gyro_bias_rad_s=x.gyro_bias_rad_s.mean(axis=0),
        imu_in_cam_m=x.imu_in_cam_m,
        cov=0.5 * (cov + cov.T),
    )
