"""The gyroscope integrated to orientations that can be read at any instant, and gravity directions by it."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    cross,
    matrix_from_quat,
    quat_conjugate,
    quat_cumulative,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from colmap_inertial.core.sampling import Coverage
from colmap_inertial.core.types.imu import ImuRecording
from colmap_inertial.core.types.recorded import FrameTiming

#: Order of the differences by which noise is told from motion; what the median of a normal distribution's sizes is.
_DIFFERENCES, _NORMAL_MEDIAN = 5, 0.6745


class GyroPath:
    """Orientation of the IMU along a recording, against its orientation at the first sample.

    This is how the package integrates a gyroscope. Between samples the rate is linear; the rotation follows from
    Magnus' series up to its second term (without which coning motion looks like a bias): the error of the integration
    itself is of the fourth order in the step between samples, that of interpolating a rate linearly of the second.
    ``inertial.core.preintegration`` does the same, compiled, on a finer interpolation, with its derivatives; only
    ``inertial.scale._setup``, over a sixteenth of a second, and ``io.plausible``, which looks for degrees, make do
    with the midpoint rule of order two.

    Parameters
    ----------
    t_s
        (N,) stamps.
    rate_rad_s
        (N, 3) readings, IMU frame.
    bias_rad_s
        (3,) subtracted from the readings.
    """

    def __init__(self, t_s: Array, rate_rad_s: Array, bias_rad_s: Array) -> None:
        self.t_s = t_s
        self.rate_rad_s = rate_rad_s - bias_rad_s
        self._step_s = np.diff(t_s)
        self.start_from_imu_xyzw = quat_cumulative(_turn(self.rate_rad_s[:-1], self.rate_rad_s[1:], self._step_s))
        self._coverage = Coverage(t_s)

    def covers(self, begin_s: Array, end_s: Array) -> BoolArray:
        """Whether each interval lies inside the recording and contains no gap."""
        return self._coverage.covers(begin_s, end_s)

    def at(self, query_s: Array) -> tuple[Array, Array]:
        """``start_from_imu`` quaternions (M, 4) and rates (M, 3) in rad/s at ``query_s``; the ends are continued."""
        i, since_s, rate = self._locate(query_s)
        return quat_multiply(self.start_from_imu_xyzw[i], _turn(self.rate_rad_s[i], rate, since_s)), rate

    @cached_property
    def noise_rad_s_rthz(self) -> float:
        """Density of white noise, at most: what each reading has of its own.

        Of differences of the fifth order, which leave little of any motion that is slow against the readings.
        """
        if len(self.rate_rad_s) <= _DIFFERENCES:
            return 0.0
        own = np.abs(np.diff(self.rate_rad_s, n=_DIFFERENCES, axis=0))
        of_each = float(np.median(own)) / (_NORMAL_MEDIAN * np.sqrt(math.comb(2 * _DIFFERENCES, _DIFFERENCES)))
        return float(of_each * np.sqrt(np.median(self._step_s)))

    @cached_property
    def fastest_rad_s(self) -> float:
        """Angular speed that one reading in a thousand exceeds."""
        return float(np.percentile(np.linalg.norm(self.rate_rad_s, axis=1), 99.9))

    def turn_rad(self, begin_s: Array, end_s: Array) -> Array:
        """(M, 3) rotation vectors ``begin_from_end`` of intervals, IMU frame."""
        return quat_log(quat_multiply(quat_conjugate(self.at(begin_s)[0]), self.at(end_s)[0]))

    def at_with_levers(self, query_s: Array) -> tuple[Array, Array, Array, Array]:
        """What :meth:`at` returns, then two integrals from the first sample on: what errors of bias and gain turn.

        (M, 3, 3) of ``start_from_imu``, in seconds. A change ``db`` of the bias turns the interval from i to j, seen in
        the IMU frame at j, by ``-R_j' (A_j - A_i) db`` with A these integrals.

        (M, 3, 6) of ``start_from_imu S rate`` for symmetric ``S`` with a one in xx, yy, zz, yz, xz, xy. A gain error S
        (the true rate is ``(I + S) rate``) turns the interval by ``R_j' (G_j - G_i) S``.
        """
        i, since_s, rate = self._locate(query_s)
        attitude = quat_multiply(self.start_from_imu_xyzw[i], _turn(self.rate_rad_s[i], rate, since_s))
        here, since_s = matrix_from_quat(attitude), since_s[:, None, None]
        bias_lever = self._levers[i] + 0.5 * (self._rotation[i] + here) * since_s
        by_gain = here @ _differentiate_symmetric(rate)
        return attitude, rate, bias_lever, self._gain_levers[i] + 0.5 * (self._by_gain[i] + by_gain) * since_s

    @cached_property
    def _rotation(self) -> Array:
        return matrix_from_quat(self.start_from_imu_xyzw)

    @cached_property
    def _levers(self) -> Array:
        return self._integral(self._rotation)

    @cached_property
    def _by_gain(self) -> Array:
        return np.asarray(self._rotation @ _differentiate_symmetric(self.rate_rad_s))

    @cached_property
    def _gain_levers(self) -> Array:
        return self._integral(self._by_gain)

    def _integral(self, values: Array) -> Array:
        steps = 0.5 * (values[1:] + values[:-1]) * self._step_s[:, None, None]
        return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(steps, axis=0)])

    def _locate(self, query_s: Array) -> tuple[IndexArray, Array, Array]:
        i = np.clip(np.searchsorted(self.t_s, query_s, side="right") - 1, 0, len(self.t_s) - 2)
        since_s = query_s - self.t_s[i]
        # outside the recording the rate stays at the end's instead of running away
        fraction = np.clip(since_s / self._step_s[i], 0.0, 1.0)[:, None]
        return i, since_s, self.rate_rad_s[i] + fraction * (self.rate_rad_s[i + 1] - self.rate_rad_s[i])


def _turn(rate_before: Array, rate_after: Array, step_s: Array) -> Array:
    """Rotations (K, 4) over steps in which the rate goes linearly from one value to the other (Magnus, two terms)."""
    step = step_s[:, None]
    return quat_exp(0.5 * step * (rate_before + rate_after) + step**2 / 12 * cross(rate_before, rate_after))


def _differentiate_symmetric(rate: Array) -> Array:
    """(K, 3, 6) derivatives of ``S rate`` by the entries xx, yy, zz, yz, xz, xy of a symmetric matrix S."""
    out = np.zeros((len(rate), 3, 6))
    for axis in range(3):
        out[:, axis, axis] = rate[:, axis]
    for entry, (i, j) in enumerate(((1, 2), (0, 2), (0, 1)), start=3):
        out[:, i, entry], out[:, j, entry] = rate[:, j], rate[:, i]
    return out


#: Hand and walking accelerations average out over this time; the gyro carries the attitude meanwhile.
_AVERAGING_S = 3.0


def estimate_up_in_imu(imu: ImuRecording, gyro_bias_rad_s: Array, query_s: Array, accel_delay_s: float = 0.0) -> Array:
    """The direction against gravity in the IMU frame.

    The gyroscope gives the attitude relative to the first sample; in that slowly drifting frame the specific force is
    averaged with a Gaussian window, forward and backward in time, so there is no lag.

    Parameters
    ----------
    imu
        The recording.
    gyro_bias_rad_s
        (3,) subtracted from the gyroscope.
    query_s
        (Q,) times on the gyroscope's clock, seconds since the recording's epoch.
    accel_delay_s
        Added to accelerometer stamps to get gyroscope time.

    Returns
    -------
    (Q, 3) unit vectors. An acceleration of 0.2 m/s2 on average over six seconds tilts them by 1 degree, and so does an
    accelerometer bias of that size, which no averaging removes.

    Raises
    ------
    NotObservableError
        Where the recording has no accelerometer.
    """
    if not imu.has_accel:
        raise NotObservableError("gravity", Fact("no-accelerometer-for-gravity"))
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, gyro_bias_rad_s)
    accel_t = imu.accel_t_s + accel_delay_s
    force_in_start = quat_rotate(path.at(accel_t)[0], imu.accel_m_s2)
    spacing = 0.1
    grid = np.arange(accel_t[0], accel_t[-1] + spacing, spacing)
    cell = np.clip(np.round((accel_t - grid[0]) / spacing).astype(int), 0, len(grid) - 1)
    reach = np.arange(-4 * _AVERAGING_S, 4 * _AVERAGING_S + spacing, spacing)
    window = np.exp(-0.5 * (reach / _AVERAGING_S) ** 2)
    # Normalised convolution: gaps and unequal rates carry their own weight.
    weight = _convolve_same(np.bincount(cell, minlength=len(grid)), window)
    summed = np.stack(
        [_convolve_same(np.bincount(cell, force_in_start[:, k], len(grid)), window) for k in range(3)], axis=1
    )
    mean = summed / np.maximum(weight, 1e-12)[:, None]
    up_in_start = np.stack([np.interp(query_s, grid, mean[:, k]) for k in range(3)], axis=1)
    up = quat_rotate(quat_conjugate(path.at(query_s)[0]), up_in_start)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def _convolve_same(signal: AnyArray, window: Array) -> Array:
    """Convolution of the signal's length, whichever of the two is longer."""
    half = len(window) // 2
    return np.convolve(signal, window)[half : half + len(signal)]


def gravity_in_cam(timed: CameraTimedImu, timing: FrameTiming) -> dict[str, Array]:
    """Each frame's gravity direction (down, unit vector, camera frame) by name, for frames that the IMU covers;
    none without an accelerometer."""
    imu, calibration = timed.imu, timed.calibration
    if not imu.has_accel:
        return {}
    query_s = timing.pose_t_s() - timed.gyro_offset_s
    covered = (query_s >= imu.gyro_t_s[0]) & (query_s <= imu.gyro_t_s[-1])
    up = estimate_up_in_imu(imu, calibration.gyro_bias_rad_s, query_s[covered], calibration.accel_delay_s)
    down_in_cam = -quat_rotate(calibration.cam_from_imu_xyzw, up)
    names = [name for name, inside in zip(timing.names, covered, strict=True) if inside]
    return dict(zip(names, down_in_cam, strict=True))
