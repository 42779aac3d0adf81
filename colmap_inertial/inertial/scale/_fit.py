"""The joint fit: from a recording to the most probable parameters, their covariance and the noise levels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import ImuNoise, ScaleDrift
from colmap_inertial.inertial.core import factors as fac, parameters as par
from colmap_inertial.inertial.core.arrow import ArrowSystem, Inverse
from colmap_inertial.inertial.core.parameters import Estimate, Noise, Prior
from colmap_inertial.inertial.core.preintegration import Preintegrated
from colmap_inertial.inertial.core.priors import model_scale_sigma
from colmap_inertial.inertial.scale import _noise as levels, _residuals as res, _shape as shape, _suspects as sus
from colmap_inertial.inertial.scale._noise import Expected, LevelSearch
from colmap_inertial.inertial.scale._setup import Measurements

#: Length of a part, and how many there are at most.
_PART_S, _MOST_PARTS = 10.0, 12
#: Of a part that knows nothing of its scale, by how much its logarithm may be off.
_NOTHING_KNOWN = 1e3


def chi2_tail(chi2: float, dof: int) -> float:
    """Probability that a chi-squared variable is larger: the finite sum for an integer number of degrees of freedom."""
    half = 0.5 * chi2
    term, total = (math.exp(-half), 0.0) if dof % 2 == 0 else (0.0, math.erfc(math.sqrt(half)))
    if dof % 2:
        term = 2 * math.exp(-half) * math.sqrt(half / math.pi)
    for order in range(2 + dof % 2, dof + 1, 2):
        total += term
        term *= 2 * half / order
    return total


def scale_drift(data: Measurements, noise: Noise, optimum: _Optimum, inflation: float, taken: float) -> ScaleDrift:
    """Scales of parts of the recording, and a test of whether they are the same.

    Each part gets a scale of its own, to first order about the joint fit; all other parameters follow. A deviation of a
    part's scale stretches the visual path within that part and shifts all that comes after.

    Parameters
    ----------
    data, noise, optimum
        The joint fit.
    inflation
        By how much variances are larger than the noise levels say.
    taken
        How many of the visual noise's degrees of freedom the fitted path follows. A part that stands still has that
        noise for a path, and no scale: each may be off by up to its variance times its share of them.
    """
    # standard deviation of the parts' scales that is no drift to speak of
    tolerated_log = model_scale_sigma()
    span_s = float(data.t_s[-1] - data.t_s[0])
    parts = int(np.clip(round(span_s / _PART_S), 2, _MOST_PARTS))
    edges_s = np.linspace(data.t_s[0], data.t_s[-1], parts + 1)
    path = shape.camera_path(optimum.estimate)
    nodes = np.searchsorted(data.t_s, edges_s[:-1]), np.searchsorted(data.t_s, edges_s[1:])
    columns = np.zeros((*path.shape, parts))
    for i, (first, last) in enumerate(zip(*nodes, strict=True)):
        columns[first:last, :, i] = path[first] - path[first:last]
        columns[last:, :, i] = path[first] - path[last]
    score = optimum.score(columns, data, noise)
    # All parts together are the scale itself, so that only contrasts between parts are known
    contrasts = np.linalg.qr(np.column_stack([np.ones(parts), np.eye(parts)[:, 1:]]))[0][:, 1:]
    fitted = np.linalg.inv(contrasts.T @ score.information @ contrasts)
    # The columns are those of u, the inverse of the metres per unit
    log_ratio = fitted @ (contrasts.T @ -score.score)
    counts = (nodes[1] - nodes[0]) / len(data.t_s)
    biases = np.minimum(taken * counts / np.maximum(np.diagonal(score.information), 1e-9), _NOTHING_KNOWN)
    cov = inflation * fitted + contrasts.T @ np.diag(biases**2 / 3) @ contrasts
    tested = np.linalg.inv(cov + tolerated_log**2 * np.eye(parts - 1))
    chi2 = float(log_ratio @ tested @ log_ratio)
    middle_s = 0.5 * (edges_s[1:] + edges_s[:-1])
    slope = contrasts.T @ (middle_s - middle_s.mean())
    trend_information = float(slope @ tested @ slope)
    return ScaleDrift(
        begin_s=edges_s[:-1],
        end_s=edges_s[1:],
        log_ratio=contrasts @ log_ratio,
        sigma_log=np.sqrt(np.diagonal(contrasts @ cov @ contrasts.T)),
        chi2=chi2,
        dof=parts - 1,
        p_value=chi2_tail(chi2, parts - 1),
        trend_log_per_s=float(slope @ tested @ log_ratio) / trend_information,
        trend_sigma_log_per_s=trend_information**-0.5,
    )


_MAX_ITERATIONS, _MAX_ROTATION_ITERATIONS = 40, 4
#: At rest: what the scale would still move by, in its standard deviations.
_SETTLED, _FEWEST_ITERATIONS = 0.1, 4
#: The same at the last iteration; of so many steps the largest is what a scale that is not at rest moves by.
_AT_REST, _LAST_STEPS = 0.2, 4
#: A robust weight below this: five times as far off as errors usually are.
_HARDLY = 0.35
#: Fewer of the gains than this are never said to be determined: no surprise is made of nothing.
_LEAST_DETERMINED = 0.3
#: With levels at rest, a step that takes back more than this share of the one before goes half the way: two states
#: in turn have their middle.
_TURNS_BACK = 0.7
#: The scale changes by at most this factor (in the logarithm) in one iteration.
_LARGEST_STEP = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """Result of the joint fit.

    Attributes
    ----------
    t_s
        (K,) camera times of the states.
    estimate, noise
        Parameters and levels.
    cov
        (79, 79) of the globals; the scale's entry is that of its logarithm (of ``u``: its sign is turned).
    gyro_bias_cov, gyro_bias_with_globals
        (3, 3) covariance of the mean gyroscope bias and (79, 3) covariance with the globals.
    sums
        Sum of squares and expectation for each noise level.
    level_variance, freedom
        Variance of the logarithm of the scale that comes from the noise levels' own uncertainty, and degrees of freedom
        that its variance rests on.
    expected_accel_m_s2_rthz
        The accelerometer's noise as its own stream and its data sheet have it.
    converged, unsettled_log
        Whether the scale came to rest; else, by how much its logarithm still moved.
    drift
        Scales of parts of the recording.
    excitation_m_s2
        Standard deviation of the camera's acceleration between nodes.
    pose_weight
        (K,) robust weights of the states' poses, of rotation or centre, whichever is less.
    jumped_s
        When states' poses hardly count or lie behind a break of the path, camera time.
    gain_chi2
        Squared deviation of the accelerometer's nine gains and axis errors from their prior.
    gain_surprise
        The same against the prior as it was used in the end, over what chance makes of it: one standard deviation more
        than is to be expected. At least 1.
    variance_parts
        What the variance of the logarithm of the scale comes from, by the keys of ``verdict.CAUSES``.
    suspicions
        What an accelerometer with faults that the model does not have would explain.
    shape
        What a model with another shape would explain.
    system, rate_rad_s, prior_info
        The normal equations at the end, (K, 3) angular velocities at the nodes, and (79, 79) what of the globals'
        information is the prior's.
    """

    t_s: Array
    estimate: Estimate
    noise: Noise
    cov: Array
    gyro_bias_cov: Array
    gyro_bias_with_globals: Array
    sums: dict[str, tuple[float, float]]
    level_variance: float
    freedom: float
    expected_accel_m_s2_rthz: float
    converged: bool
    unsettled_log: float
    drift: ScaleDrift
    excitation_m_s2: float
    pose_weight: Array
    jumped_s: Array
    gain_chi2: float
    gain_surprise: float
    variance_parts: dict[str, float]
    suspicions: list[sus.Suspicion]
    shape: list[shape.ShapeFault]
    system: ArrowSystem
    rate_rad_s: Array
    prior_info: Array


def fit_jointly(data: Measurements, prior: Prior, sheet: ImuNoise | None) -> Fit:
    """Gauss-Newton on all states and globals, with noise levels from the residuals.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the data leave the system singular.
    """
    search = LevelSearch(expected=Expected.of(data, sheet))
    at, unsettled_log = _find_optimum(data, prior, search)
    x, groups, inverse = at.estimate, at.groups, at.inverse
    cov = inverse.cov
    noise, sums = search.noise, search.sums

    # Solved once more, for the mean gyroscope bias, the scale, and the suspicions
    k = len(data.t_s)
    imu = groups["imu"]
    assert isinstance(imu, fac.Group)
    where, columns = sus.derive_columns(data, x, imu)
    of_bias, of_scale, of_suspicions = slice(0, 3), slice(3, 4), slice(4, None)
    count = of_suspicions.start + columns.shape[2]
    rhs, rhs_z = np.zeros((k, par.N_STATE, count)), np.zeros((par.N_GLOBALS, count))
    rhs[:, par.GYRO_BIAS, of_bias] = np.eye(3) / k
    rhs_z[par.SCALE, of_scale] = 1.0
    imu.pull_back(columns, rhs[:, :, of_suspicions], rhs_z[:, of_suspicions])
    states, z = inverse.solve(rhs, rhs_z)
    explained = imu.apply(states[:, :, of_suspicions], z[:, of_suspicions])
    residual = (imu.residual[:, :, None] + imu.apply(*at.step))[:, :, 0]
    suspicions = sus.score_suspicions(where, columns, explained, residual, z[par.SCALE, of_suspicions])
    by_scale, by_scale_z = states[:, :, of_scale], z[:, of_scale]
    variance_parts = _split_variance(groups, at.prior, x, at.pre.cov_gaps, by_scale, by_scale_z[:, 0])
    level_variance, freedom = search.scale_variance(groups, by_scale, by_scale_z)
    inflation = max(1.0, *(squares / expected for squares, expected in sums.values()))
    taken = max(0.0, 3 * k - sums["centre_m"][1] - sums["drift_m_rts"][1])
    drift = scale_drift(data, noise, at, inflation, taken)
    weights = [groups[name].weight for name in ("rotation", "centre")]
    weight = np.min([each for each in weights if each is not None], axis=0)
    return Fit(
        t_s=data.t_s,
        estimate=x,
        noise=noise,
        cov=cov,
        gyro_bias_cov=np.mean(states[:, par.GYRO_BIAS, of_bias], axis=0),
        gyro_bias_with_globals=z[:, of_bias],
        sums=sums,
        level_variance=level_variance + unsettled_log**2,
        freedom=freedom,
        expected_accel_m_s2_rthz=search.expected.noise.accel_density_m_s2_rthz,
        converged=unsettled_log == 0,
        unsettled_log=unsettled_log,
        drift=drift,
        excitation_m_s2=_excitation_m_s2(data, x),
        pose_weight=weight,
        jumped_s=data.t_s[np.append(False, data.broken) | (weight < _HARDLY)],
        gain_chi2=prior.gain_chi2(x),
        gain_surprise=_measure_gain_surprise(at.prior, x, cov),
        variance_parts=variance_parts,
        suspicions=suspicions,
        shape=_find_shape_faults(data, noise, at, taken),
        system=at.system,
        rate_rad_s=at.pre.rate_rad_s,
        prior_info=at.prior.info,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Optimum:
    """The last step of Gauss-Newton: where it leads to, and the linear system that it solves."""

    estimate: Estimate
    prior: Prior
    pre: Preintegrated
    groups: dict[str, fac.Group | fac.Direct]
    system: ArrowSystem
    inverse: Inverse
    step: tuple[Array, Array]

    def score(self, columns: Array, data: Measurements, noise: Noise) -> shape.Scores:
        """Score of the visual centres for changes (K, 3, q) of their path."""
        centre = self.groups["centre"]
        assert isinstance(centre, fac.Group)
        return shape.score_columns(columns, data, noise, centre, self.inverse, self.step)


def _find_optimum(data: Measurements, prior: Prior, search: LevelSearch) -> tuple[_Optimum, float]:
    """Gauss-Newton with the noise levels along; also what the scale moved by in the end, 0 where it came to rest."""
    x = _fit_rotations(data, search.noise, prior)
    scale = _guess_scale(data, x)
    x = replace(x, metres_per_unit=scale, imu_in_world_m=data.groups.centre * scale)
    settled, signed, steps = False, 0.0, [0.0]
    integrated, there = res.integrate(data, x), x
    for iteration in range(_MAX_ITERATIONS):
        if settled or not fac.still_near(there, x, data.t_s, tolerance=4.0 if iteration <= _FEWEST_ITERATIONS else 1.0):
            integrated, there = res.integrate(data, x), x
        pre = fac.correct_increments(integrated, there, x)
        local = prior.at(x)
        groups = res.all_groups(data, search.noise, local, x, pre, robust=iteration > 2)
        system, rhs, rhs_z = fac.normal_equations(list(groups.values()), local, x)
        inverse = system.invert()
        states, z = inverse.solve(rhs, rhs_z)
        turned = search.at_rest and float(z[par.SCALE, 0]) * signed < -_TURNS_BACK * signed**2
        signed = float(z[par.SCALE, 0])
        step = abs(signed)
        shrink = min(1.0, _LARGEST_STEP / max(step, 1e-12)) * (0.5 if turned else 1.0)
        x = x.moved(states[:, :, 0] * shrink, z[:, 0] * shrink, pre.rate_rad_s, data.t_s)
        sigma = float(inverse.cov[par.SCALE, par.SCALE]) ** 0.5
        steps.append(step)
        search.update(groups, inverse, states, z, moving=not settled)
        if settled:
            break
        moves = max(step, search.scale_moves())
        settled = iteration >= _FEWEST_ITERATIONS and moves < _SETTLED * sigma and search.at_rest
    optimum = _Optimum(
        estimate=x,
        prior=local,
        pre=pre,
        groups=groups,
        system=system,
        inverse=inverse,
        step=(states, z),
    )
    return optimum, 0.0 if step < _AT_REST * sigma else max(steps[-_LAST_STEPS:])


#: Which part of the scale's variance priors of the globals belong to.
_CAUSE_OF_GLOBALS = {
    "accel_gain": [par.ACCEL_GAIN],
    "accel_bias": [par.ACCEL_BIAS],
    "gyro": [par.GYRO_GAIN],
    "camera_path": [par.SHUTTER, par.COUPLING],
    "camera_imu": [
        par.ROTATION,
        par.LEVER,
        slice(par.DELAY, par.CLOCK_RATE + 1),
        slice(par.ACCEL_DELAY, par.ACCEL_DELAY + 1),
    ],
}


def _find_shape_faults(data: Measurements, noise: Noise, at: _Optimum, taken: float) -> list[shape.ShapeFault]:
    """What may be wrong with the model's shape; nothing where the clip is too short to tell."""
    if data.t_s[-1] - data.t_s[0] < shape.LIMITS.shortest_s:
        return []
    kinds, columns = shape.shape_columns(data.t_s, shape.camera_path(at.estimate))
    scores = at.score(columns, data, noise)
    return shape.find_faults(kinds, scores, shaken=levels.vibrates(data), t_s=data.t_s, taken=taken)


def _measure_gain_surprise(prior: Prior, x: Estimate, cov: Array) -> float:
    """Squared distance of the gains from their prior beyond chance; see :class:`Fit`.

    What of the gains the data do not determine stays at the prior's mean: ``9 - trace(information covariance)`` of them
    are determined.
    """
    info = prior.gain_info
    determined = max(_LEAST_DETERMINED, len(info) - float(np.sum(info * cov[par.ACCEL_GAIN, par.ACCEL_GAIN])))
    return max(1.0, prior.gain_chi2(x) / (determined + (2 * determined) ** 0.5))


def _split_variance(
    groups: dict[str, fac.Group | fac.Direct], prior: Prior, x: Estimate, cov_gaps: Array, states: Array, z: Array
) -> dict[str, float]:
    """The scale's variance, by the errors it comes from.

    With the information ``A = sum J^T J``, the covariance's column ``c`` of the scale has ``c^T A c`` as its entry for
    the scale: each residual's part of the variance is its change along ``c``, squared.

    Parameters
    ----------
    cov_gaps
        (K, 9, 9) part of the covariance of the inertial increments that stands for missing readings.
    states, z
        (K, m, 1), (n,) that column.
    """
    others = ("lost_readings", "gravity")
    parts = dict.fromkeys((*res.CAUSE_OF_GROUP.values(), *_CAUSE_OF_GLOBALS, *others), 0.0)
    for name, group in groups.items():
        values = group.apply(states, z[:, None])
        parts[res.CAUSE_OF_GROUP[name]] += float(np.sum(values**2))
    imu = groups["imu"]
    along = imu.apply(states, z[:, None])
    white = float(np.sum(along * levels.differentiate_by_level(imu, along)))
    parts["accel_noise"] += white
    assert isinstance(imu, fac.Group) and imu.root is not None
    unwhitened = imu.root.transpose(0, 2, 1) @ along
    parts["lost_readings"] = float(np.sum(unwhitened * (cov_gaps @ unwhitened)))
    parts["gyro"] -= white + parts["lost_readings"]
    by_prior = z * (prior.info @ z)
    for part, places in _CAUSE_OF_GLOBALS.items():
        parts[part] += sum(float(by_prior[place].sum()) for place in places)
    up = x.gravity_m_s2 / float(np.linalg.norm(x.gravity_m_s2))
    parts["gravity"] = float(up @ z[par.GRAVITY] / prior.gravity_sigma_m_s2) ** 2
    # what errors of two sensors have in common counts for either, and may take from one
    left = {name: max(variance, 0.0) for name, variance in parts.items()}
    return {name: variance * float(z[par.SCALE]) / sum(left.values()) for name, variance in left.items()}


def _fit_rotations(data: Measurements, noise: Noise, prior: Prior) -> Estimate:
    """Rotations, gyroscope bias and time offset from gyroscope and visual rotations alone."""
    x = prior.mean
    for _ in range(_MAX_ROTATION_ITERATIONS):
        pre = res.integrate(data, x)
        groups = res.rotation_groups(data, noise, prior, x, pre)
        system, rhs, rhs_z = fac.normal_equations(list(groups.values()), prior, x)
        held = np.arange(par.GRAVITY.stop)
        system.corner[held, held] += 1.0
        rhs_z[held] = 0.0
        states, z, _ = system.solve(rhs, rhs_z)
        z[held] = 0.0
        moved = x.moved(states[:, :, 0], z[:, 0], pre.rate_rad_s, data.t_s)
        settled, x = fac.still_near(x, moved, data.t_s), moved
        if settled:
            break
    return x


def _guess_scale(data: Measurements, x: Estimate) -> float:
    """Metres per unit at which visual and inertial second differences, less gravity and bias, are equally large."""
    pre = res.integrate(data, x)
    dt = pre.dt_s[:, None]
    per_s = 2 / (dt[1:] + dt[:-1])
    visual = np.diff(np.diff(data.groups.centre, axis=0) / dt, axis=0) * per_s

    def second_difference(velocity: Array, position: Array) -> Array:
        along = x.world_from_imu[:-1] @ position / dt[:, :, None]
        return (along[1:] - along[:-1] + x.world_from_imu[:-2] @ velocity[:-1]) * per_s[:, :, None]

    inertial = second_difference(pre.velocity[:, :, None], pre.position[:, :, None])
    bias = second_difference(pre.by_accel_bias[:, 3:6], pre.by_accel_bias[:, 6:])
    gravity = np.tile(np.eye(3), (len(per_s), 1, 1))
    nuisance = np.concatenate([gravity, bias], axis=2).reshape(-1, 6)
    both = np.stack([visual, inertial[:, :, 0]], axis=-1).reshape(-1, 2)
    rest = both - nuisance @ np.linalg.lstsq(nuisance, both, rcond=None)[0]
    visual_size, inertial_size = np.linalg.norm(rest, axis=0)
    if not (visual_size > 0 and inertial_size > 0):
        raise np.linalg.LinAlgError("no motion")
    return float(inertial_size / visual_size)


def _excitation_m_s2(data: Measurements, x: Estimate) -> float:
    """Standard deviation of the camera's acceleration; on its lever arm the IMU swings even where the camera stays."""
    path = shape.camera_path(x)
    dt_s = np.diff(data.t_s)[:, None]
    accel = np.diff(np.diff(path, axis=0) / dt_s, axis=0) / (0.5 * (dt_s[1:] + dt_s[:-1]))
    return float(np.sqrt(np.sum(np.var(accel, axis=0))))
