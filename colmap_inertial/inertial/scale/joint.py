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
from colmap_inertial.inertial.core.priors import PRIORS, AccelPart, accel_part, clock_scale_sigma
from colmap_inertial.inertial.scale._declared import doubts_lever, find_contradicted_lever, leave_out_lever
from colmap_inertial.inertial.scale._fit import Fit, fit_jointly
from colmap_inertial.inertial.scale._gain import WrongGain, exceeds_usual, judge_gain
from colmap_inertial.inertial.scale._setup import Data, prepare
from colmap_inertial.inertial.scale._shape import LIMITS as SHAPE_LIMITS, ShapeFault, confirmed, suspect
from colmap_inertial.inertial.scale._suspects import Faults, filter_of_lag, worst
from colmap_inertial.inertial.scale.verdict import check_clocks, scale_drifts, student_factor, verdict_of
from colmap_inertial.io.calibration import SIGMAS

#: So many times at most is something wrong with the accelerometer looked for, undone, and the rest fitted again.
_MOST_FAULTS = 6
#: Real visual errors are not those of the model (alike over .1 to 1 s and longer), which counts the more the shorter a
#: clip is: standard deviations grow by this over its length. Measured on handheld and flown recordings with motion
#: capture, cut to 3 to 20 s.
_UNMODELLED_S = 1.5
#: Standard deviation of what lies anywhere between none and all.
_UNIFORM = 12**-0.5


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
    try:
        timed, data, prior, fit, lever = _fit_believed(trajectory, timed, options)
        fit, faults = _fit_soundly(fit, data, prior, timed.imu.noise)
        shape = Shape()
        # a path that was smoothed has no shape to speak of
        if not faults.path_is_smoothed:
            fit, shape = _fit_shapely(fit, faults.undone(data), faults.loosened(prior), timed.imu.noise, accel=accel)
    except NotObservableError as error:
        return ScaleEstimate.refused("joint", error.fact)
    except np.linalg.LinAlgError:
        return ScaleEstimate.refused("joint", Fact("fit-singular"))
    left_open = sum(suspicion.scale_variance for suspicion in fit.suspicions if suspicion.name in faults.values)
    moved_s = timed.calibration.accel_delay_s - expected_s
    lags, taken_log = _find_lag(fit, moved_s) if "bandwidth" not in faults.values else ([], 0.0)
    fit = replace(fit, variance_parts={**fit.variance_parts, "accel_faults": left_open + taken_log**2})
    declared = [] if lever is None else [lever]
    wrong = [*declared, *faults.as_facts(), *lags, *_cut_off(data)]
    # what was taken from a path nobody can put back: its scale is too large by more than any interval says
    estimate = _judged(fit, data.t_s, timed.calibration, accel, wrong, shape, worthless=faults.path_is_smoothed)
    notes = (*estimate.notes, *_out_of_step(moved_s))
    return replace(estimate, notes=notes, jumped=_name_jumped(fit, data, trajectory))


def _find_lag(fit: Fit, moved_s: float) -> tuple[list[Fact], float]:
    """A doubt where the accelerometer lags as if it had been filtered, and what that would take from the scale."""
    sigma_s = float(fit.cov[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** 0.5
    constant_s = filter_of_lag(fit.suspicions, -(moved_s + fit.estimate.accel_delay_s), sigma_s)
    if constant_s == 0:
        return [], 0.0
    by_scale = next(one.by_scale for one in fit.suspicions if one.name == "bandwidth")
    return [Fact("accel-lags-as-filtered", lag_s=constant_s)], 0.5 * constant_s**2 * float(by_scale[0])


def _out_of_step(moved_s: float) -> list[Fact]:
    """A note where the accelerometer's stamps were moved."""
    return [] if moved_s == 0 else [Fact("accel-delay-undone", delay_s=-moved_s)]


def _name_jumped(fit: Fit, data: Data, trajectory: CameraTrajectory) -> tuple[str, ...]:
    """Images by themselves that hardly count, or at which the path jumps, those that count least first.

    Behind a break the drift is free.
    """
    edges = np.concatenate([[True], data.broken, [True]])
    little = (fit.pose_weight < _LIMITS.counts_little) & ~np.append(False, data.broken)
    alone = (data.groups.count == 1) & (little | (edges[:-1] & edges[1:]))
    least_first = np.flatnonzero(alone)[np.argsort(fit.pose_weight[alone], kind="stable")]
    return tuple(trajectory.names[int(np.argmin(np.abs(trajectory.t_s - t)))] for t in data.t_s[least_first])


def _prepared(trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions) -> tuple[Data, Prior]:
    return prepare(
        trajectory,
        timed,
        gravity_m_s2=options.gravity_m_s2,
        gravity_sigma_m_s2=options.gravity_sigma_m_s2,
        states_hz=options.states_hz,
    )


def fit_path(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[Data, Fit, tuple[Fact, ...]]:
    """The measurements as they came, their fit, and what is wrong with the accelerometer or the model's shape.

    Raises
    ------
    NotObservableError
        When too few frames lie inside the IMU recording.
    numpy.linalg.LinAlgError
        When the data leave the system singular.
    """
    timed, data, prior, fit = _fit_in_step(trajectory, timed, options)
    fit, faults = _fit_soundly(fit, data, prior, timed.imu.noise)
    accel = accel_part(timed.imu)
    sound = faults.undone(data), faults.loosened(prior)
    _, shape = _fit_shapely(fit, *sound, timed.imu.noise, accel=accel)
    widened = scale_of(fit, data.t_s, accel).widened
    wrong = (*shape.undone, *shape.said)
    return data, fit, (*faults.as_facts(), *(fault.as_fact(data.t_s, widened) for fault in wrong))


def _fit_believed(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[CameraTimedImu, Data, Prior, Fit, Fact | None]:
    """As :func:`_fit_in_step`, without a declared lever arm where a fit without it contradicts it; then that fact."""

    def fit_without(length_m: float) -> tuple[CameraTimedImu, Data, Prior, Fit]:
        return _fit_in_step(
            trajectory,
            replace(timed, calibration=leave_out_lever(timed.calibration, length_m=length_m)),
            options,
        )

    believed = _fit_in_step(trajectory, timed, options)
    _, data, prior, fit = believed
    if not doubts_lever(fit, prior, is_refused=bool(_refusals(fit, data.t_s))):
        return *believed, None
    length_m = float(np.linalg.norm(prior.mean.imu_in_cam_m))
    alone = fit_without(length_m)
    lever = None if _refusals(alone[-1], data.t_s) else find_contradicted_lever(alone[-1], prior)
    if lever is None:
        return *believed, None
    return *(alone if length_m <= SIGMAS.unknown_lever_arm_m else fit_without(0.0)), lever


def _fit_in_step(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: JointOptions
) -> tuple[CameraTimedImu, Data, Prior, Fit]:
    """The recording, its measurements and their fit; with the accelerometer's stamps moved where they are far off.

    A delay beyond its prior is pulled towards it, and frames were averaged by readings of another moment: the fit
    starts again from what was found, which is as little known as that of an unknown device.
    """
    data, prior = _prepared(trajectory, timed, options)
    fit = fit_jointly(data, prior, timed.imu.noise)
    delay_s, expected_s = fit.estimate.accel_delay_s, float(prior.info[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** -0.5
    sigma_s = float(fit.cov[par.ACCEL_DELAY, par.ACCEL_DELAY]) ** 0.5
    if not is_out_of_step(delay_s, sigma_s, expected_s):
        return timed, data, prior, fit
    timed = replace(timed, calibration=timed.calibration.shift_clock_offsets(0.0, delay_s))
    data, prior = _prepared(trajectory, timed, options)
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


def _fit_soundly(fit: Fit, data: Data, prior: Prior, sheet: ImuNoise | None) -> tuple[Fit, Faults]:
    """The fit, with what shows to be wrong with the accelerometer undone, and what that was."""
    faults, sound = Faults(values={}), data
    for _ in range(_MOST_FAULTS):
        if fit.gain_chi2 > par.LARGEST_GAIN_CHI2 and not prior.heavy_gains:
            # not from the start: on its way a fit passes gains that it would not find back from
            prior = replace(prior, heavy_gains=True)
            fit = fit_jointly(sound, faults.loosened(prior), sheet)
        suspicion = worst(fit.suspicions, data.streams.accel, faults.values)
        # a fit of what does not belong together explains nothing
        if suspicion is None or _refusals(fit, data.t_s):
            break
        faults = faults.with_found(suspicion)
        if faults.path_is_smoothed:
            break
        sound = faults.undone(data)
        fit = fit_jointly(sound, faults.loosened(prior), sheet)
    return fit, faults


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    """What seems to be wrong with a model's shape: what was undone, and what is only said."""

    undone: tuple[ShapeFault, ...] = ()
    said: tuple[ShapeFault, ...] = ()

    @property
    def doubtful(self) -> tuple[ShapeFault, ...]:
        """Those that make a scale weak: a stretch that is said alone leaves lengths right on average."""
        return (*self.undone, *(fault for fault in self.said if fault.kind != "stretch"))


def _fit_shapely(fit: Fit, data: Data, prior: Prior, sheet: ImuNoise | None, *, accel: AccelPart) -> tuple[Fit, Shape]:
    """The fit of a model without what shows to be wrong with its shape, and what that was.

    What it does to the scale, or would do where there is too little evidence to undo it, is in the interval.
    """
    shape, before = Shape(), fit
    open_variance = 0.0
    # wrong gains look like a stretch
    sound = fit.gain_chi2 <= par.LARGEST_GAIN_CHI2 and not _refusals(fit, data.t_s)
    while sound and len(shape.undone) < SHAPE_LIMITS.most:
        suspected = suspect(fit.shape, scale_of(fit, data.t_s, accel).widened)
        if suspected is None:
            break
        mended = replace(data.groups, centre=suspected.undo(data.t_s, data.groups.centre))
        trial_data = replace(data, groups=mended)
        trial = fit_jointly(trial_data, prior, sheet)
        widened = scale_of(trial, data.t_s, accel).widened
        fault = confirmed(suspected, trial.shape, widened)
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


def _cut_off(data: Data) -> list[Fact]:
    out = []
    for sensor, share in (("gyroscope", data.gyro_cut_share), ("accelerometer", data.accel_cut_share)):
        if share > MUCH_CUT:
            out.append(Fact("readings-cut-off", sensor=sensor, share=share))
    return out


def _judged(
    fit: Fit,
    t_s: Array,
    calibration: CameraImuCalibration,
    accel: AccelPart,
    wrong: Sequence[Fact],
    shape: Shape,
    *,
    worthless: bool,
) -> ScaleEstimate:
    x = fit.estimate
    squares = sum(s for s, _ in fit.sums.values())
    expected = sum(e for _, e in fit.sums.values())
    clock_rate = calibration.clock_rate + x.clock_rate
    scale = scale_of(fit, t_s, accel, clock_rate)
    metres_per_unit, sigma_log = scale.metres_per_unit, scale.sigma_log
    refusals = [*_refusals(fit, t_s), *(wrong if worthless else ())]
    verdict, ci95, reasons = verdict_of(metres_per_unit, sigma_log, refusals=refusals)
    notes: tuple[Fact, ...] = ()
    if verdict == "refused":
        reasons = (*reasons, *(() if worthless else wrong))
    else:
        bent = [fault.as_fact(t_s, scale.widened) for fault in shape.doubtful] or _check_drift(fit.drift)
        declared = _check_calibrated(fit, scale) if accel.calibrated else []
        large, usual = ([], []) if accel.calibrated else _check_gains(fit, scale)
        # what was declared is named first
        doubts = [*declared, *wrong, *check_clocks(clock_rate), *_check_length(t_s), *_check_rest(fit), *large, *bent]
        verdict, ci95, reasons = verdict_of(metres_per_unit, sigma_log, doubts)
        # what is in the interval makes nothing weak by itself; where the interval is wide, it may be why
        said = [fault for fault in shape.said if fault not in shape.doubtful]
        within = [*usual, *(fault.as_fact(t_s, scale.widened) for fault in said)]
        counted = tuple(Fact("counted-in-interval", found=one) for one in within)
        if verdict == "trusted":
            notes = counted
        else:
            reasons = (*reasons, *counted)
    if len(fit.jumped_s):
        notes = (*notes, Fact("poses-jump", since_s=[at_s - t_s[0] for at_s in fit.jumped_s]))
    refused = verdict == "refused"
    keep = [par.SCALE, *range(par.GRAVITY.start, par.ACCEL_BIAS.stop)]
    signs = np.array([-1.0, *[1.0] * 6])
    cov = fit.cov[np.ix_(keep, keep)] * signs[:, None] * signs
    cov[0, 0] = sigma_log**2
    return ScaleEstimate(
        metres_per_unit=None if refused else metres_per_unit,
        sigma_log=None if refused else sigma_log,
        ci95=None if refused else ci95,
        verdict=verdict,
        method="joint",
        reasons=reasons,
        notes=notes,
        gravity_in_world_m_s2=x.gravity_m_s2,
        accel_bias_m_s2=x.accel_bias_m_s2,
        calibration=_refined(fit, calibration),
        cov=cov,
        chi2=squares,
        dof=max(1, round(expected)),
        excitation_m_s2=fit.excitation_m_s2,
        drift=fit.drift,
        parts=None if refused else scale.parts,
        noise=fit.noise.imu_over_seconds(),
    )


@dataclass(frozen=True, kw_only=True)
class FoundScale:
    """Scale of a fit.

    Attributes
    ----------
    metres_per_unit, sigma_log, parts
        As :class:`ScaleEstimate` has them.
    shift
        Of the logarithm of the scale, for noise that the fitted path follows; it is in ``metres_per_unit``.
    widened
        Factor on variances of the fit: squares beyond their expectation, few degrees of freedom, what no model has.
    wrong_gain
        Whether the accelerometer is off in gain; ``None`` of a calibrated one that nothing contradicts.
    """

    metres_per_unit: float
    sigma_log: float
    parts: dict[str, float]
    shift: float
    widened: float
    wrong_gain: WrongGain | None


def scale_of(fit: Fit, t_s: Array, accel: AccelPart, clock_rate: float = 0.0) -> FoundScale:
    """The scale and the standard deviation of its logarithm, with what the fit takes for granted put right.

    The scale makes residuals orthogonal to the fitted path. That path follows the visual noise with as many degrees of
    freedom as the states take from the centres; where the accelerometer is less noisy than the fit says, it follows
    too willingly, which lowers the scale by ``share * (1 - true variance / fitted variance)``. Part of the fitted noise
    is no white noise at all, but slow (rotors), and the rest is in the accelerometer's own stream or data sheet.
    """
    worst = max(s / e for s, e in fit.sums.values())
    bare = float(fit.cov[par.SCALE, par.SCALE])
    taken = 3 * len(t_s) - fit.sums["centre_m"][1] - fit.sums["drift_m_rts"][1]
    # A gain follows the noise the other way, so that what both have in common stays where it is
    gains = fit.cov[par.SCALE, par.ACCEL_GAIN].reshape(3, 3)
    share = max(0.0, bare + float(np.trace(gains)) / 3) * max(0.0, taken)
    overstated = max(0.0, 1 - (fit.expected_accel_m_s2_rthz / fit.noise.accel_density_m_s2_rthz) ** 2)
    # To first order only: not by more than what the recording leaves open
    shift = min(overstated * share, (bare * max(1.0, worst)) ** 0.5)
    student = student_factor(fit.freedom)
    widened = max(1.0, worst) * (student * (1 + _UNMODELLED_S / float(t_s[-1] - t_s[0]))) ** 2
    variances = {name: widened * variance for name, variance in fit.variance_parts.items()}
    variances["accel_gain"] *= fit.gain_surprise
    variances["noise_levels"] = (student * _UNIFORM * share) ** 2 + fit.level_variance
    variances["accel_gain"] += accel.model_sigma**2
    wrong_gain: WrongGain | None = judge_gain(fit.estimate, fit.cov, fit.prior_info, widened)
    if accel.calibrated and wrong_gain is not None and not wrong_gain.is_likely:
        wrong_gain = None  # what was calibrated is believed unless it is contradicted
    variances["accel_gain"] += 0.0 if wrong_gain is None else wrong_gain.variance
    variances["accel_gain"] *= accel.factor**2
    variances["lens"] = PRIORS.lens**2
    variances["clocks"] = clock_scale_sigma(clock_rate) ** 2
    return FoundScale(
        metres_per_unit=fit.estimate.metres_per_unit * float(np.exp(shift)),
        sigma_log=sum(variances.values()) ** 0.5,
        parts={name: variance**0.5 for name, variance in variances.items()},
        shift=shift,
        widened=widened,
        wrong_gain=wrong_gain,
    )


def _refusals(fit: Fit, t_s: Array) -> list[Fact]:
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
    unexplained = fit.noise.accel_m_s2(float(np.median(np.diff(t_s))))
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


def _check_calibrated(fit: Fit, scale: FoundScale) -> list[Fact]:
    """A doubt where a calibrated accelerometer has gains, which contradict the calibration."""
    wrong_gain = scale.wrong_gain
    if fit.gain_chi2 > par.LARGEST_GAIN_CHI2:
        return [Fact("calibrated-gain-contradicted", gains=-np.diagonal(fit.estimate.accel_gain))]
    if wrong_gain is not None and wrong_gain.is_likely:
        return [Fact("calibrated-gain-contradicted", gains=(wrong_gain.gain,) * 3)]
    return []


def _check_gains(fit: Fit, scale: FoundScale) -> tuple[list[Fact], list[Fact]]:
    """Gains of an accelerometer that was not calibrated: larger than any sensor's, and others that are worth a word."""
    gains, wrong_gain = fit.estimate.accel_gain, scale.wrong_gain
    if fit.gain_chi2 > par.LARGEST_GAIN_CHI2:
        sigma = np.sqrt(scale.widened * np.diagonal(fit.cov[par.ACCEL_GAIN, par.ACCEL_GAIN])).reshape(3, 3)
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


def _refined(fit: Fit, calibration: CameraImuCalibration) -> CameraImuCalibration:
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
