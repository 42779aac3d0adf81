"""The fit of an IMU's errors to what it read in rests, and on the way from one to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.geometry import find_tangents, matrix_from_quat
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.sampling import Coverage
from colmap_inertial.core.types import IMU_CAL, ImuRecording
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.static_calibration._rests import Rests

#: Entries of the accelerometer's matrix that are fitted, row by row: the frame takes the others.
_LOWER = np.array([0, 3, 4, 6, 7, 8])
#: Columns: lower entries, bias, gravity, the gyroscope's entries; then two for the direction of gravity in each rest.
_ACCEL, _BIAS, _GRAVITY, _GYRO = slice(0, 6), slice(6, 9), 9, slice(10, 19)

_COUNT = 19


@dataclass(frozen=True, kw_only=True)
class FitLimits:
    """Noise floors and the rounds of the fit."""

    #: Instability of biases within minutes, each mean: 40 ug and 8 degrees an hour, as good consumer MEMS have.
    accel_floor_m_s2: float = 4e-4
    gyro_floor_rad_s: float = 4e-5
    #: Error of a turn's integral beside noise and drift, of its angle: curvature between samples, delays, sensitivity
    #: to acceleration.
    turn_share: float = 5e-5
    #: A turn of fewer samples is none.
    fewest_samples: int = 8
    #: How many squared residuals the noise known beforehand is worth, against those of the fit.
    freedom_before: float = 8.0
    #: Steps are small against standard deviations, and factors against themselves.
    iterations: int = 6
    rounds: int = 12
    settled: float = 0.01
    #: A device that warms up settles within the recording, by so many time constants.
    warming: float = 3.0


_LIMITS = FitLimits()

#: A misalignment is that of one axis against another, each of which has the prior's.
MISALIGNMENT_SIGMA = np.sqrt(2) * PRIORS.accel_gain


@dataclass(frozen=True, eq=False, kw_only=True)
class RestFit:
    """Result of the fit.

    Attributes
    ----------
    accel_gain, accel_bias_m_s2, gyro_gain, gyro_bias_rad_s, cov
        As in ``ImuCalibration``.
    up_in_imu
        (K, 3) unit vectors away from the ground.
    accel_residual_m_s2
        (K,) length of the corrected mean reading, less gravity.
    turn_residual_rad
        (K-1,) angle between the direction that the gyroscope carries to the next rest and the one that the
        accelerometer finds there; nan for turns that were not used.
    accel_noise, turn_noise
        Factors on the standard deviations that were known beforehand.
    drift_m_s2, drift_p_value
        (3,) change of the accelerometer's bias from the first rest to the last, had it been fitted along, and the
        probability of one as large where there is none.
    """

    accel_gain: Array
    accel_bias_m_s2: Array
    gyro_gain: Array
    gyro_bias_rad_s: Array
    cov: Array
    up_in_imu: Array
    accel_residual_m_s2: Array
    turn_residual_rad: Array
    accel_noise: float
    turn_noise: float
    drift_m_s2: Array
    drift_p_value: float


@dataclass(frozen=True, eq=False, kw_only=True)
class _Turns:
    """The ways between consecutive rests on which no sample is missing.

    Attributes
    ----------
    before
        (T,) the rest that each begins at; it ends at the next one.
    first, last
        (T,) its samples, in
    t_s, rate_rad_s
        the gyroscope's, less their mean in both rests, of all turns after one another.
    sigma_rad
        (T,) standard deviation of the direction that is carried along.
    """

    before: IndexArray
    first: IndexArray
    last: IndexArray
    t_s: Array
    rate_rad_s: Array
    sigma_rad: Array

    @classmethod
    def of(cls, imu: ImuRecording, rests: Rests) -> _Turns:
        whole = Coverage(imu.gyro_t_s).covers(rests.end_s[:-1], rests.begin_s[1:])
        step_s = float(np.median(np.diff(imu.gyro_t_s)))
        before, sizes, sigmas = [], [0], []
        t_s, rates = [np.zeros(0)], [np.zeros((0, 3))]
        for i in np.flatnonzero(whole):
            inside = slice(*np.searchsorted(imu.gyro_t_s, [rests.end_s[i], rests.begin_s[i + 1]]))
            rate = imu.gyro_rad_s[inside] - 0.5 * (rests.gyro_rad_s[i] + rests.gyro_rad_s[i + 1])
            if len(rate) < _LIMITS.fewest_samples:
                continue
            duration_s = rests.begin_s[i + 1] - rests.end_s[i]
            angle = step_s * float(np.sum(np.linalg.norm(rate, axis=1)))
            walk = rests.gyro_deviation_rad_s * np.sqrt(step_s * duration_s)
            drift = duration_s * np.hypot(
                _LIMITS.gyro_floor_rad_s, 0.5 * float(np.hypot(*rests.gyro_sigma_rad_s[i : i + 2]))
            )
            before.append(i)
            sizes.append(len(rate))
            t_s.append(imu.gyro_t_s[inside])
            rates.append(rate)
            sigmas.append(float(np.linalg.norm([walk, drift, _LIMITS.turn_share * angle])))
        edges = np.cumsum(sizes)
        return cls(
            before=np.array(before, dtype=np.intp),
            first=edges[:-1],
            last=edges[1:] - 1,
            t_s=np.concatenate(t_s),
            rate_rad_s=np.concatenate(rates),
            sigma_rad=np.array(sigmas),
        )

    @classmethod
    def none(cls) -> _Turns:
        empty, index = np.zeros(0), np.zeros(0, dtype=np.intp)
        return cls(before=index, first=index, last=index, t_s=empty, rate_rad_s=np.zeros((0, 3)), sigma_rad=empty)

    def integrate(self, gain: Array) -> tuple[Array, Array]:
        """(T, 3, 3) ``begin_from_end``, and (T, 3, 9) how ends turn with the entries of ``gain``, in their frames."""
        if len(self.before) == 0:
            return np.zeros((0, 3, 3)), np.zeros((0, 3, 9))
        path = GyroPath(self.t_s, self.rate_rad_s @ (np.eye(3) + gain).T, np.zeros(3))
        rotation = matrix_from_quat(path.start_from_imu_xyzw)
        # a change of gain turns by the integral of rotation times change times reading
        change = (rotation[:, :, :, None] * self.rate_rad_s[:, None, None, :]).reshape(-1, 3, 9)
        steps = 0.5 * (change[1:] + change[:-1]) * np.diff(self.t_s)[:, None, None]
        lever = np.add.reduceat(steps, np.stack([self.first, self.last], axis=1).ravel()[:-1], axis=0)[::2]
        ends = rotation[self.last].transpose(0, 2, 1)
        return rotation[self.first].transpose(0, 2, 1) @ rotation[self.last], ends @ lever


def fit_rests(
    imu: ImuRecording, rests: Rests, gravity_m_s2: float, gravity_sigma_m_s2: float, *, accel_only: bool = False
) -> RestFit:
    """Weighted least squares of accelerometer and gyroscope together, with the directions of gravity in the rests.

    In each rest the corrected mean reading of the accelerometer is gravity; on the way to the next one the corrected
    gyroscope carries its direction. What both leave over sets the noise, together with what it is expected to be. A
    device that turns out worse than the priors assume widens them, so that they do not pull.
    """
    turns = _Turns.none() if accel_only else _Turns.of(imu, rests)
    sigma_a = np.hypot(rests.accel_sigma_m_s2, _LIMITS.accel_floor_m_s2)
    sigma_t = turns.sigma_rad
    state = _State.start(rests, gravity_m_s2)
    factor_a = factor_t = 1.0
    freedom = np.full(2, _LIMITS.freedom_before)
    beforehand = _prior_sigma(gravity_sigma_m_s2)
    prior_sigma = beforehand
    for _ in range(_LIMITS.rounds):
        for _ in range(_LIMITS.iterations):
            system = _system(state, rests, turns, sigma_a * factor_a, sigma_t * factor_t, gravity_m_s2, prior_sigma)
            cov = np.asarray(np.linalg.inv(system.jacobian.T @ system.jacobian))
            step = cov @ (system.jacobian.T @ system.residual)
            state = state.moved(step)
            if np.all(np.abs(step) < _LIMITS.settled * np.sqrt(np.diagonal(cov))):
                break
        # Förstner's components of variance: each group's squares against its redundancy
        system = _system(state, rests, turns, sigma_a * factor_a, sigma_t * factor_t, gravity_m_s2, prior_sigma)
        cov = np.asarray(np.linalg.inv(system.jacobian.T @ system.jacobian))
        variances = []
        for i, (rows, factor) in enumerate(((system.accel_rows, factor_a), (system.turn_rows, factor_t))):
            jacobian, residual = system.jacobian[rows], system.residual[rows]
            redundancy = max(len(residual) - float(np.einsum("ij,jk,ik->", jacobian, cov, jacobian)), 0.0)
            freedom[i] = _LIMITS.freedom_before + redundancy
            variances.append((_LIMITS.freedom_before + factor**2 * float(residual @ residual)) / freedom[i])
        before, (factor_a, factor_t) = (factor_a, factor_t), np.sqrt(variances)
        prior_sigma = beforehand * _find_prior_factor(state.errors(gravity_m_s2) / beforehand)
        if np.allclose(before, (factor_a, factor_t), rtol=_LIMITS.settled):
            break
    fit = _result(state, rests, turns, cov, freedom, (factor_a, factor_t), gravity_m_s2)
    drift_m_s2, p_value = _find_drift(system, cov, rests, sigma_a * before[0], freedom, before)
    return replace(fit, drift_m_s2=drift_m_s2, drift_p_value=p_value)


def _find_drift(
    system: _System, cov: Array, rests: Rests, sigma_m_s2: Array, freedom: Array, factors: tuple[float, float]
) -> tuple[Array, float]:
    """A change of the accelerometer's bias as by warming, to first order, and the probability of it by chance.

    The noise that it is compared with is what is left once it is undone: it swells the noise of the fit.
    """
    from scipy.stats import f

    middle_s = 0.5 * (rests.begin_s + rests.end_s)
    warmed = -np.expm1(-_LIMITS.warming * (middle_s - middle_s[0]) / np.ptp(middle_s))
    since = (warmed - warmed.mean()) / warmed[-1]
    columns = np.zeros((len(system.residual), 3))
    columns[system.accel_rows] = np.kron((-since / sigma_m_s2)[:, None], np.eye(3))
    common = system.jacobian.T @ columns
    information = columns.T @ columns - common.T @ cov @ common
    score = columns.T @ system.residual - common.T @ cov @ (system.jacobian.T @ system.residual)
    drift_m_s2 = np.asarray(np.linalg.solve(information, score), dtype=np.float64)
    explained = float(score @ drift_m_s2)
    measured = system.residual[: system.turn_rows.stop]
    left = float(measured @ measured) - explained + _LIMITS.freedom_before * sum(factor**-2 for factor in factors)
    count = float(freedom.sum()) - 3
    return drift_m_s2, float(f.sf(explained / 3 / (left / count), 3, count))


def _prior_sigma(gravity_sigma_m_s2: float) -> Array:
    """(19,) standard deviations beforehand, in the order of the columns."""
    sigma = np.empty(_COUNT)
    sigma[_ACCEL] = np.where(np.isin(_LOWER, [0, 4, 8]), PRIORS.accel_gain, MISALIGNMENT_SIGMA)
    sigma[_BIAS], sigma[_GRAVITY], sigma[_GYRO] = PRIORS.accel_bias_m_s2, gravity_sigma_m_s2, PRIORS.gyro_gain
    return sigma


def _find_prior_factor(ratio: Array) -> Array:
    """Factor, at least 1, by which the priors of each kind of error are too narrow for this device."""
    factor = np.ones(_COUNT)
    for kind in (_ACCEL, _BIAS, _GYRO):
        factor[kind] = max(1.0, float(np.sqrt(np.mean(ratio[kind] ** 2))))
    return factor


@dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    accel_gain: Array
    accel_bias: Array
    gravity: float
    gyro_gain: Array
    up: Array

    @classmethod
    def start(cls, rests: Rests, gravity_m_s2: float) -> _State:
        """A bias that makes all mean readings as long as each other, where their attitudes tell; no other error."""
        mean = rests.accel_m_s2
        # |a - b|^2 = r^2 is linear in b and r^2 - |b|^2; the prior keeps what is not seen near zero
        design = np.column_stack([2 * mean, np.ones(len(mean))])
        squares = np.sum(mean**2, axis=1)
        known = np.vstack([design, np.diag([1.0, 1.0, 1.0, 0.0])])
        bias = np.linalg.lstsq(known, np.concatenate([squares, np.zeros(4)]), rcond=None)[0][:3]
        force = mean - bias
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        zeros = np.zeros((3, 3))
        return cls(accel_gain=zeros, accel_bias=bias, gravity=gravity_m_s2, gyro_gain=zeros, up=up)

    def errors(self, gravity_m_s2: float) -> Array:
        """(19,) what has a prior of mean 0, in the order of the columns."""
        off = [self.gravity - gravity_m_s2]
        return np.concatenate([self.accel_gain.ravel()[_LOWER], self.accel_bias, off, self.gyro_gain.ravel()])

    def moved(self, step: Array) -> _State:
        gain = self.accel_gain.copy().ravel()
        gain[_LOWER] += step[_ACCEL]
        tangent = np.einsum("kij,kj->ki", find_tangents(self.up), step[_COUNT:].reshape(-1, 2))
        up = self.up + tangent
        return _State(
            accel_gain=gain.reshape(3, 3),
            accel_bias=self.accel_bias + step[_BIAS],
            gravity=self.gravity + float(step[_GRAVITY]),
            gyro_gain=self.gyro_gain + step[_GYRO].reshape(3, 3),
            up=up / np.linalg.norm(up, axis=1, keepdims=True),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _System:
    """Whitened residuals (to be made small by a step) and their derivative by the step."""

    jacobian: Array
    residual: Array
    accel_rows: slice
    turn_rows: slice


def _system(
    state: _State,
    rests: Rests,
    turns: _Turns,
    sigma_a: Array,
    sigma_t: Array,
    gravity_m_s2: float,
    prior_sigma: Array,
) -> _System:
    k, m = len(rests), len(turns.before)
    accel_rows, turn_rows = slice(0, 3 * k), slice(3 * k, 3 * k + 2 * m)
    jacobian = np.zeros((3 * k + 2 * m + _COUNT, _COUNT + 2 * k))
    residual = np.zeros(len(jacobian))
    tangents = find_tangents(state.up)
    mean = rests.accel_m_s2
    left = state.gravity * state.up - (mean @ (np.eye(3) + state.accel_gain).T - state.accel_bias)
    for i in range(k):
        rows = slice(3 * i, 3 * i + 3)
        by_gain = np.kron(np.eye(3), mean[i])
        jacobian[rows, _ACCEL] = by_gain[:, _LOWER]
        jacobian[rows, _BIAS] = -np.eye(3)
        jacobian[rows, _GRAVITY] = -state.up[i]
        jacobian[rows, _COUNT + 2 * i : _COUNT + 2 * i + 2] = -state.gravity * tangents[i]
        jacobian[rows] /= sigma_a[i]
        residual[rows] = left[i] / sigma_a[i]
    for j, (i, sigma, rotation, lever) in enumerate(
        zip(turns.before, sigma_t, *turns.integrate(state.gyro_gain), strict=True)
    ):
        rows = slice(3 * k + 2 * j, 3 * k + 2 * j + 2)
        carried, basis = rotation.T @ state.up[i], tangents[i + 1]
        # turned by d at the end, the carried direction moves by carried x d
        jacobian[rows, _GYRO] = basis.T @ np.cross(carried, lever.T).T
        jacobian[rows, _COUNT + 2 * i : _COUNT + 2 * i + 2] = basis.T @ rotation.T @ tangents[i]
        jacobian[rows, _COUNT + 2 * i + 2 : _COUNT + 2 * i + 4] = -np.eye(2)
        jacobian[rows] /= sigma
        residual[rows] = -basis.T @ carried / sigma
    own = np.arange(_COUNT)
    jacobian[3 * k + 2 * m + own, own] = 1 / prior_sigma
    residual[3 * k + 2 * m + own] = -state.errors(gravity_m_s2) / prior_sigma
    return _System(jacobian=jacobian, residual=residual, accel_rows=accel_rows, turn_rows=turn_rows)


def _result(
    state: _State,
    rests: Rests,
    turns: _Turns,
    cov: Array,
    freedom: Array,
    factors: tuple[float, float],
    gravity_m_s2: float,
) -> RestFit:
    widening = _student(freedom)
    full = np.zeros((IMU_CAL.COUNT, IMU_CAL.COUNT))
    columns: IndexArray = np.concatenate([np.arange(9), np.arange(10, 19)])
    target = np.concatenate([_LOWER, np.arange(9, 12), np.arange(12, 21)])
    scale = np.concatenate([np.full(9, widening[0]), np.full(9, widening[1])])
    full[np.ix_(target, target)] = cov[np.ix_(columns, columns)] * np.outer(scale, scale)
    gyro_matrix = np.eye(3) + state.gyro_gain
    means = rests.gyro_rad_s @ gyro_matrix.T
    bias = means.mean(axis=0)
    count = len(rests)
    # by differences, so that a slow walk is not taken for scatter about its mean
    scatter = float(np.sum(np.diff(means, axis=0) ** 2)) / (6 * max(count - 1, 1))
    known = float(np.mean(rests.gyro_sigma_rad_s**2)) + _LIMITS.gyro_floor_rad_s**2
    spread = (_LIMITS.freedom_before * known + 3 * (count - 1) * scatter) / (_LIMITS.freedom_before + 3 * (count - 1))
    full[IMU_CAL.GYRO_BIAS, IMU_CAL.GYRO_BIAS] = np.eye(3) * spread / count
    left = np.linalg.norm(rests.accel_m_s2 @ (np.eye(3) + state.accel_gain).T - state.accel_bias, axis=1)
    angles = np.full(max(count - 1, 0), np.nan)
    carried = np.einsum("tji,tj->ti", turns.integrate(state.gyro_gain)[0], state.up[turns.before])
    angles[turns.before] = np.linalg.norm(np.cross(carried, state.up[turns.before + 1]), axis=1)
    return RestFit(
        accel_gain=state.accel_gain,
        accel_bias_m_s2=state.accel_bias,
        gyro_gain=state.gyro_gain,
        gyro_bias_rad_s=bias,
        cov=0.5 * (full + full.T),
        up_in_imu=state.up,
        accel_residual_m_s2=left - gravity_m_s2,
        turn_residual_rad=angles,
        accel_noise=factors[0],
        turn_noise=factors[1],
        drift_m_s2=np.zeros(3),
        drift_p_value=1.0,
    )


def _student(freedom: Array) -> Array:
    """Factor of 95 % intervals against normal ones where few residuals estimate the noise."""
    from scipy.stats import t

    return np.asarray(t.ppf(0.975, freedom) / 1.959963984540054)
