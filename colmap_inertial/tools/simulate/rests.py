"""A phone that somebody lays still on its sides and edges, one after another, for ``calibrate_imu``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_log, quat_multiply, rotation_between
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.tools.simulate.sensors import (
    IMU_PRESETS,
    STANDARD_GRAVITY_M_S2,
    ImuErrors,
    ImuOptions,
    draw_imu_errors,
    sensors_of,
)

_PHONE = replace(
    IMU_PRESETS["phone"],
    accel_scale_sd=0.01,
    gyro_scale_sd=0.01,
    accel_resolution_m_s2=STANDARD_GRAVITY_M_S2 / 4096,
    gyro_resolution_rad_s=float(np.radians(1 / 16)),
)
_EDGES = [[1, 1, 0], [-1, 1, 0], [0, 1, 1], [0, -1, 1], [1, 0, 1], [1, 0, -1], [-1, -1, 0], [1, -1, 0], [0, 1, -1]]
#: Six sides, then edges: up in the device, before it is laid down carelessly.
_UP_IN_IMU = np.concatenate([np.eye(3), -np.eye(3), np.array(_EDGES, dtype=np.float64) / np.sqrt(2)])


@dataclass(frozen=True, kw_only=True)
class RestOptions:
    """Options of laying the device down."""

    attitudes: int = 12
    """Six sides first, then edges; at most fifteen."""
    rest_s: float = 5.0
    """How long it lies each time."""
    turn_s: tuple[float, float] = (1.5, 3.0)
    """Range of how long it is turned over."""
    careless_rad: float = 0.08
    """Standard deviation of each attitude against the one that was meant."""
    tremor_rad: float = 0.01
    """Amplitude of the hand's tremor while it turns the device over."""
    tremor_hz: float = 8.0
    """Frequency of the tremor."""
    hand_m_s2: float = 1.5
    """Acceleration by the hand that turns the device over."""
    knock_m_s2: float = 2.0
    """Noise of lifting the device and putting it down."""
    gravity_m_s2: float = 9.81
    """Strength of gravity."""
    imu: ImuOptions = field(default_factory=lambda: _PHONE)
    """The device."""

    def __post_init__(self) -> None:
        if not 1 <= self.attitudes <= len(_UP_IN_IMU):
            raise ValueError(f"attitudes must be from 1 to {len(_UP_IN_IMU)}, not {self.attitudes}")


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedRests:
    """A recording with rests, and the truth in the terms of ``ImuCalibration``.

    Attributes
    ----------
    recording
        What a user would get.
    accel_gain, accel_bias_m_s2, gyro_gain, gyro_bias_rad_s
        As in ``ImuCalibration``; biases are means over the recording.
    up_in_imu
        (K, 3) true attitudes, in the calibration's frame.
    """

    recording: ImuRecording
    accel_gain: Array
    accel_bias_m_s2: Array
    gyro_gain: Array
    gyro_bias_rad_s: Array
    up_in_imu: Array


def simulate_rests(options: RestOptions, *, seed: int, errors: ImuErrors | None = None) -> SimulatedRests:
    """Lay a device down, again and again; a seed gives one device (where none is given by its errors) in one hand."""
    rng = np.random.default_rng(seed)
    errors = draw_imu_errors(options.imu, 0.0, rng) if errors is None else errors
    ups = _UP_IN_IMU[: options.attitudes]
    ups = ups + options.careless_rad * rng.standard_normal(ups.shape)
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    turns = [_Turn.draw(ups[i], ups[i + 1], options, rng) for i in range(len(ups) - 1)]
    stop_s = np.cumsum([options.rest_s + turn.duration_s for turn in turns])
    begin_s = np.concatenate([[0.0], stop_s])
    gyro_t_s, accel_t_s = (
        np.arange(int((begin_s[-1] + options.rest_s) * hz)) / hz
        for hz in (options.imu.gyro_rate_hz, options.imu.accel_rate_hz)
    )
    rate = np.zeros((len(gyro_t_s), 3))
    force = np.zeros((len(accel_t_s), 3))
    for i, up in enumerate(ups):
        force[accel_t_s >= begin_s[i]] = options.gravity_m_s2 * up
        if i < len(turns):
            left_s = begin_s[i] + options.rest_s
            moving = (gyro_t_s >= left_s) & (gyro_t_s < begin_s[i + 1])
            rate[moving] = turns[i].rate_rad_s(gyro_t_s[moving] - left_s)
            moving = (accel_t_s >= left_s) & (accel_t_s < begin_s[i + 1])
            since_s = accel_t_s[moving] - left_s
            attitude = matrix_from_quat(turns[i].attitude(since_s))
            force[moving] = options.gravity_m_s2 * np.einsum("nji,j->ni", attitude, up)
            force[moving] += turns[i].handled_m_s2(since_s, rng)
    gyroscope, accelerometer = sensors_of(options.imu, errors)
    gyro, gyro_bias = gyroscope.readings(rate, rng)
    accel, accel_bias = accelerometer.readings(force, rng)
    turned, lower = _triangular(np.asarray(np.linalg.inv(np.eye(3) + errors.accel_matrix)))
    gyro_matrix = turned @ np.linalg.inv(np.eye(3) + errors.gyro_matrix)
    return SimulatedRests(
        recording=ImuRecording(
            gyro_t_s=gyro_t_s, gyro_rad_s=gyro, accel_t_s=accel_t_s, accel_m_s2=accel, device="simulated"
        ),
        accel_gain=lower - np.eye(3),
        accel_bias_m_s2=lower @ accel_bias.mean(axis=0),
        gyro_gain=gyro_matrix - np.eye(3),
        gyro_bias_rad_s=gyro_matrix @ gyro_bias.mean(axis=0),
        up_in_imu=ups @ turned.T,
    )


def _triangular(matrix: Array) -> tuple[Array, Array]:
    """The rotation that makes a matrix lower triangular, and what it makes of it."""
    q, upper = np.linalg.qr(matrix[:, ::-1])
    lower, turned = upper[::-1, ::-1], q[:, ::-1].T
    signs = np.sign(np.diagonal(lower))[:, None]
    return turned * signs, lower * signs


@dataclass(frozen=True, eq=False, kw_only=True)
class _Turn:
    """Motion from one rest to the next: about one axis, with a tremor about another."""

    options: RestOptions
    duration_s: float
    rotation_rad: Array
    tremor_axis: Array
    hand_axes: Array

    @classmethod
    def draw(cls, up: Array, up_next: Array, options: RestOptions, rng: np.random.Generator) -> _Turn:
        """A turn after which ``up_next`` points up, and the device heads anywhere."""
        duration_s = rng.uniform(*options.turn_s)
        spin = quat_exp(rng.uniform(-np.pi, np.pi) * up_next)
        axes = rng.standard_normal((3, 3))
        return cls(
            options=options,
            duration_s=float(duration_s),
            rotation_rad=quat_log(quat_multiply(rotation_between(up_next, up), spin)),
            tremor_axis=axes[0] / np.linalg.norm(axes[0]),
            hand_axes=axes[1:],
        )

    def attitude(self, since_s: Array) -> Array:
        """(N, 4) ``begin_from_imu``."""
        share, _ = self._share(since_s)
        tremor, _ = self._tremor(since_s)
        return quat_multiply(quat_exp(share[:, None] * self.rotation_rad), quat_exp(tremor[:, None] * self.tremor_axis))

    def rate_rad_s(self, since_s: Array) -> Array:
        """(N, 3) IMU frame."""
        _, share_rate = self._share(since_s)
        tremor, tremor_rate = self._tremor(since_s)
        shaken = matrix_from_quat(quat_exp(tremor[:, None] * self.tremor_axis))
        turning = np.einsum("nji,j->ni", shaken, self.rotation_rad) * share_rate[:, None]
        return np.asarray(turning + tremor_rate[:, None] * self.tremor_axis)

    def handled_m_s2(self, since_s: Array, rng: np.random.Generator) -> Array:
        """(N, 3) what a hand adds: it lifts the device, shakes it and knocks it."""
        swing = np.sin(2 * np.pi * since_s / self.duration_s)[:, None] * self.hand_axes[0]
        shaking = np.sin(2 * np.pi * 25.0 * since_s)[:, None] * self.hand_axes[1]
        noise = rng.standard_normal((len(since_s), 3))
        ends = np.exp(-np.minimum(since_s, self.duration_s - since_s) / 0.05)[:, None]
        hand_m_s2, knock_m_s2 = self.options.hand_m_s2, self.options.knock_m_s2
        return np.asarray(hand_m_s2 * swing + 0.3 * hand_m_s2 * shaking + noise * (0.3 + knock_m_s2 * ends))

    def _share(self, since_s: Array) -> tuple[Array, Array]:
        s = since_s / self.duration_s
        return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / self.duration_s

    def _tremor(self, since_s: Array) -> tuple[Array, Array]:
        amplitude_rad, rate_hz = self.options.tremor_rad, self.options.tremor_hz
        phase, slow = 2 * np.pi * rate_hz * since_s, np.pi * since_s / self.duration_s
        angle = amplitude_rad * np.sin(phase) * np.sin(slow) ** 2
        by_phase = 2 * np.pi * rate_hz * np.cos(phase) * np.sin(slow) ** 2
        by_slow = np.sin(phase) * np.sin(2 * slow) * np.pi / self.duration_s
        return angle, amplitude_rad * (by_phase + by_slow)
