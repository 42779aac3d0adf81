"""Preintegration of an IMU: relative rotation, velocity and position with covariance and derivatives.

Between nodes ``k`` and ``k + 1``, ``T`` apart, with the body frame at node ``k`` as reference (Lupton and Sukkarieh
2012; Forster et al. 2017)::

    rotation = R_k^T R_k+1
    velocity = R_k^T (v_k+1 - v_k - g T)
    position = R_k^T (p_k+1 - p_k - v_k T - g T^2/2)

Errors of the rotation are rotation vectors on its left, in the body frame at node ``k``. White gyroscope noise ``n``
at time ``s`` then acts on the three through ``G(s) = [I, -[V(s)]x, -[P(s)]x]``, where ``V(s)`` and ``P(s)`` are the
velocity still to come after ``s`` and the position that the force after ``s`` still adds. Covariance and derivatives
are integrals over ``G``, so that nothing has to be propagated step by step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array, BoolArray, Int64Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.sampling import find_clipped, is_gap
from colmap_inertial.core.types.imu import ImuRecording

#: Integration steps: as the samples come, within these. Steps of 5 instead of 2.5 ms change the scale by 0.003 %.
_SHORTEST_STEP_S, _LONGEST_STEP_S = 0.0025, 0.005
#: A longer pause between samples is a gap. It is bridged and its price is in the covariance, so that shorter ones
#: count here than where an interval with a gap is lost.
_GAP_S = 0.06
#: How far rate and acceleration may then be from the interpolation: a lively hand.
_GAP_RATE_RAD_S, _GAP_ACCEL_M_S2 = 2.0, 10.0
#: Half the span of the finite difference by the accelerometer's delay: vibration makes shorter ones meaningless.
DELAY_STEP_S = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorStream:
    """Samples of a vector over time, interpolated by cubic Hermite polynomials.

    Linear interpolation would lose 0.1 % of the amplitude at 2 Hz from samples at 100 Hz, and the scale with it.
    """

    t_s: Array
    value: Array
    slope: Array
    paused_s: Array  # by each sample, the sum of the pauses before it

    def gap_s(self, begin_s: Array, end_s: Array) -> Array:
        """Duration of the gaps in each interval from ``begin_s`` to ``end_s``."""
        ends = np.interp(end_s, self.t_s, self.paused_s) - np.interp(begin_s, self.t_s, self.paused_s)
        return np.asarray(ends)

    @classmethod
    def from_samples(cls, t_s: Array, value: Array, lost: BoolArray | None = None) -> SensorStream:
        """A stream of samples ``value`` (N, 3) at times ``t_s`` (N,).

        ``lost`` are samples that say nothing: what they cover is a gap, however short.
        """
        kept = np.arange(len(t_s)) if lost is None else np.flatnonzero(~lost)
        across = np.diff(kept) > 1
        t_s, value = t_s[kept], value[kept]
        paused_s = np.concatenate([[0.0], np.cumsum(np.where(across | is_gap(t_s, _GAP_S), np.diff(t_s), 0.0))])
        return cls(t_s=t_s, value=value, slope=_slope(t_s, value), paused_s=paused_s)

    def with_samples(self, t_s: Array, value: Array) -> SensorStream:
        """A stream with as many other samples, and the same pauses."""
        return replace(self, t_s=t_s, value=value, slope=_slope(t_s, value))

    def at(self, query_s: Array) -> tuple[Array, Array]:
        """Value and time derivative at ``query_s`` (M,); held constant outside the samples."""
        query_s = np.clip(query_s, self.t_s[0], self.t_s[-1])
        i = np.clip(np.searchsorted(self.t_s, query_s, side="right") - 1, 0, len(self.t_s) - 2)
        step = (self.t_s[i + 1] - self.t_s[i])[:, None]
        x = (query_s - self.t_s[i])[:, None] / step
        y0, y1, m0, m1 = self.value[i], self.value[i + 1], step * self.slope[i], step * self.slope[i + 1]
        rise = y1 - y0
        c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
        return y0 + x * (m0 + x * (c2 + x * c3)), (m0 + x * (2 * c2 + 3 * x * c3)) / step


def _slope(t_s: Array, value: Array) -> Array:
    if len(t_s) > 2:
        return np.asarray(np.gradient(value, t_s, axis=0))
    return np.repeat(np.diff(value, axis=0), 2, axis=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorStreams:
    """Readings of gyroscope (rad/s) and accelerometer (m/s2) over one clock."""

    gyro: SensorStream
    accel: SensorStream

    @classmethod
    def from_recording(cls, imu: ImuRecording, gyro_t_s: Array, accel_t_s: Array) -> SensorStreams:
        """The streams of a recording on another clock; saturated readings count as missing.

        Parameters
        ----------
        gyro_t_s, accel_t_s
            (N,), (M,) times of the recording's samples.
        """
        gyro_cut, accel_cut = find_saturated(imu)
        return cls(
            gyro=SensorStream.from_samples(gyro_t_s, imu.gyro_rad_s, gyro_cut),
            accel=SensorStream.from_samples(accel_t_s, imu.accel_m_s2, accel_cut),
        )

    @classmethod
    def from_camera(cls, timed: CameraTimedImu) -> SensorStreams:
        """The streams of a recording over camera time."""
        return cls.from_recording(timed.imu, timed.gyro_t_s, timed.accel_t_s)

    @cached_property
    def step_s(self) -> float:
        """Length of the steps of an integration, at most."""
        spacing = min(float(np.median(np.diff(stream.t_s))) for stream in (self.gyro, self.accel))
        return float(np.clip(spacing, _SHORTEST_STEP_S, _LONGEST_STEP_S))

    def gap_s(self, t_s: Array, accel_delay_s: float = 0.0) -> tuple[Array, Array]:
        """(K,) seconds of gaps of gyroscope and accelerometer between K + 1 times; the delay is the accelerometer's."""
        accel_s = t_s - accel_delay_s
        return self.gyro.gap_s(t_s[:-1], t_s[1:]), self.accel.gap_s(accel_s[:-1], accel_s[1:])


def find_saturated(imu: ImuRecording) -> tuple[BoolArray, BoolArray]:
    """(N,), (M,) which samples of gyroscope and accelerometer stand at the end of the sensor's range on any axis."""
    gyro, accel = imu.gyro_rad_s, imu.accel_m_s2
    if imu.calibration is not None:
        # digits that the corrections left behind would make one reading many
        gyro, accel = (np.round(values, 9) for values in imu.calibration.uncorrected(gyro, accel))
    return np.asarray(find_clipped(gyro).any(axis=1)), np.asarray(find_clipped(accel).any(axis=1))


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorErrors:
    """Errors of the readings in K intervals.

    Attributes
    ----------
    gyro_bias_rad_s, accel_bias_m_s2
        (K, 3), one for each interval.
    gyro_gain, accel_gain
        (3, 3) gain errors E: ``rate = (I + E) reading - bias``.
    accel_delay_s
        Added to the accelerometer's times.
    """

    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    gyro_gain: Array
    accel_gain: Array
    accel_delay_s: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Preintegrated:
    """Inertial increments over K intervals; rows of the 9-vectors are rotation, velocity, position.

    Attributes
    ----------
    dt_s
        (K,) lengths of the intervals.
    rotation, velocity, position
        (K, 3, 3), (K, 3), (K, 3) increments in the body frame at the start of the interval.
    cov_gyro, cov_accel
        (K, 9, 9) covariances for white noise of density one.
    cov_gaps
        (K, 9, 9) covariance for what gaps between samples hide.
    by_gyro_bias, by_accel_bias
        (K, 9, 3) derivatives.
    by_gyro_gain
        (K, 9, 9) derivative by the entries, row by row, of the gain error E in ``rate = (I + E) reading - bias``.
    by_accel_gain
        (K, 9, 9) the same of the accelerometer.
    by_accel_delay
        (K, 9) derivative by a later stamp of the accelerometer.
    rate_rad_s
        (K + 1, 3) angular velocity at the nodes, body frame.
    """

    dt_s: Array
    rotation: Array
    velocity: Array
    position: Array
    cov_gyro: Array
    cov_accel: Array
    cov_gaps: Array
    by_gyro_bias: Array
    by_accel_bias: Array
    by_gyro_gain: Array
    by_accel_gain: Array
    by_accel_delay: Array
    rate_rad_s: Array


def preintegrate(nodes_s: Array, streams: SensorStreams, errors: SensorErrors) -> Preintegrated:
    """Integrate both sensors between consecutive nodes, at (K + 1,) increasing times on the clock of the streams."""
    nodes_s = np.ascontiguousarray(nodes_s)
    gyro, accel = streams.gyro, streams.accel
    k, steps = len(nodes_s) - 1, integration_steps(nodes_s, streams)
    shapes = {"rotation": (3, 3), "velocity": (3,), "position": (3,)}
    shapes |= {"cov_gyro": (9, 9), "by_gyro_bias": (9, 3), "by_accel_bias": (9, 3)}
    shapes |= {"by_gyro_gain": (9, 9), "by_accel_gain": (9, 9), "by_accel_delay": (9,)}
    results = {name: np.empty((k, *shape)) for name, shape in shapes.items()}
    rate_rad_s = np.empty((k + 1, 3))
    _inertial.preintegrate(
        nodes_s=nodes_s,
        steps=steps,
        gyro_t_s=gyro.t_s,
        gyro=gyro.value,
        gyro_slope=gyro.slope,
        accel_t_s=accel.t_s,
        accel=accel.value,
        accel_slope=accel.slope,
        gyro_bias=errors.gyro_bias_rad_s,
        accel_bias=errors.accel_bias_m_s2,
        gyro_matrix=np.eye(3) + errors.gyro_gain,
        accel_matrix=np.eye(3) + errors.accel_gain,
        accel_delay_s=errors.accel_delay_s,
        delay_step_s=DELAY_STEP_S,
        rate=rate_rad_s,
        **results,
    )
    dt_s = np.diff(nodes_s)
    return Preintegrated(
        dt_s=dt_s,
        cov_accel=accel_noise_cov(dt_s),
        cov_gaps=gap_cov(nodes_s, *streams.gap_s(nodes_s, errors.accel_delay_s)),
        rate_rad_s=rate_rad_s,
        **results,
    )


def integration_steps(nodes_s: Array, streams: SensorStreams) -> Int64Array:
    """Number of integration steps of each interval."""
    return np.maximum(np.ceil(np.diff(nodes_s) / streams.step_s).astype(np.int64), 2)


def accel_noise_cov(dt: Array) -> Array:
    """(K, 9, 9) covariance for white noise of the accelerometer of density one."""
    cov = np.zeros((len(dt), 9, 9))
    for row, col, moment in ((3, 3, dt), (3, 6, dt**2 / 2), (6, 3, dt**2 / 2), (6, 6, dt**3 / 3)):
        cov[:, row : row + 3, col : col + 3] = moment[:, None, None] * np.eye(3)
    return cov


def gap_cov(nodes_s: Array, gyro_gap_s: Array, accel_gap_s: Array) -> Array:
    """(K, 9, 9) covariance for what gaps of so many seconds between (K + 1,) nodes hide."""
    # without its rotation a force has no direction
    force_s = gyro_gap_s + accel_gap_s
    hidden = [_GAP_RATE_RAD_S * gyro_gap_s, _GAP_ACCEL_M_S2 * force_s, _GAP_ACCEL_M_S2 * force_s * np.diff(nodes_s)]
    return np.asarray(np.repeat(np.stack(hidden, axis=1) ** 2, 3, axis=1)[:, :, None] * np.eye(9))
