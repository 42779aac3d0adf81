"""Assumptions and parameters of the estimators, and their columns in states and globals."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.core.types.imu import ImuNoise

# Columns of the globals: the scale, those that the IMU factors see, those that the visual factors see.
SCALE = 0
GRAVITY = slice(1, 4)
ACCEL_BIAS = slice(4, 7)
ACCEL_DELAY = 7
GYRO_GAIN = slice(8, 17)
ACCEL_GAIN = slice(17, 26)
IMU_GLOBALS = slice(1, 26)
ROTATION = slice(26, 29)
LEVER = slice(29, 32)
DELAY = 32
CLOCK_RATE = 33
SHUTTER = slice(34, 70)
COUPLING = slice(70, 79)
VISUAL_GLOBALS = slice(26, 79)
N_GLOBALS = 79
#: Chi-square of the accelerometer's nine gains and axis errors against their prior: the 8 recordings that this was
#: tried on have 3 to 9; by chance, 28 is exceeded once in a thousand.
LARGEST_GAIN_CHI2 = 28.0

# Columns of a state. The last three are errors that stay for a while: a random walk of the accelerometer's bias around
# its value in the middle of the recording, what the visual centres drift by, and what vibration does to the bias.
THETA, POSITION, VELOCITY, GYRO_BIAS, ACCEL_WALK, DRIFT, ACCEL_SLOW = (slice(3 * i, 3 * i + 3) for i in range(7))
N_STATE = 21
#: Errors of visual centres, and of an accelerometer that vibrates, are alike over about these times. Between .35 s, 1 s
#: and a random walk of the centres the scale of a minute hardly changes; a drift that never comes back takes more of
#: the motion in short clips.
DRIFT_S, ACCEL_SLOW_S = 0.35, 0.5

#: Where steps of the fields of :class:`Estimate` stand that change by addition: the states' and the globals.
_ADDED_STATES = dict(
    velocity_m_s=VELOCITY,
    gyro_bias_rad_s=GYRO_BIAS,
    accel_walk_m_s2=ACCEL_WALK,
    drift_m=DRIFT,
    accel_slow_m_s2=ACCEL_SLOW,
)
_ADDED_GLOBALS = dict(
    accel_bias_m_s2=ACCEL_BIAS,
    accel_delay_s=slice(ACCEL_DELAY, ACCEL_DELAY + 1),
    gyro_gain=GYRO_GAIN,
    accel_gain=ACCEL_GAIN,
    imu_in_cam_m=LEVER,
    delay_s=slice(DELAY, DELAY + 1),
    clock_rate=slice(CLOCK_RATE, CLOCK_RATE + 1),
    shutter=SHUTTER,
    coupling_m=COUPLING,
)


@dataclass(frozen=True, kw_only=True)
class Noise(ImuNoise):
    """Standard deviations: of an IMU as :class:`ImuNoise` has them, and visual and slow errors per state.

    ``drift_m_rts`` and ``accel_slow_m_s2_rts`` are what a Gauss-Markov process grows by in a short time.

    ``rotation_excess`` is the factor by which errors of visual rotations weigh more than white ones of their size,
    since those of neighbouring states are correlated: ``sqrt((1 + c) / (1 - c))`` for a correlation ``c``.
    """

    rotation_rad: float
    centre_m: float
    drift_m_rts: float
    accel_slow_m_s2_rts: float
    rotation_excess: float = 1.0

    @property
    def drift_m(self) -> float:
        """Standard deviation of the drift at any one time."""
        return self.drift_m_rts * (0.5 * DRIFT_S) ** 0.5

    @property
    def drift_m2(self) -> float:
        """Variance of the drift at any one time."""
        return 0.5 * DRIFT_S * self.drift_m_rts**2

    @property
    def accel_slow_m_s2(self) -> float:
        """Standard deviation of the accelerometer's slow error at any one time."""
        return self.accel_slow_m_s2_rts * (0.5 * ACCEL_SLOW_S) ** 0.5

    def accel_m_s2(self, dt_s: float) -> float:
        """Standard deviation of the accelerometer's mean over so short a time."""
        return math.hypot(self.accel_density_m_s2_rthz / dt_s**0.5, self.accel_slow_m_s2)

    def imu_over_seconds(self) -> ImuNoise:
        """The IMU's noise with the slow errors included in its white noise, as they act over seconds."""
        density = math.hypot(self.accel_density_m_s2_rthz, self.accel_slow_m_s2_rts * ACCEL_SLOW_S)
        imu = {field.name: getattr(self, field.name) for field in fields(ImuNoise)}
        return ImuNoise(**{**imu, "accel_density_m_s2_rthz": density})


@dataclass(frozen=True, eq=False, kw_only=True)
class InertialStates:
    """Arguments of the factor between two states of an IMU, beside its increments."""

    world_from_imu: Array  # (K, 3, 3)
    imu_in_world_m: Array  # (K, 3)
    velocity_m_s: Array  # (K, 3)
    gravity_m_s2: Array  # (3,) world frame
    accel_gain: Array  # (3, 3): force = (I + gain) reading - bias


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(InertialStates):
    """A point of the parameter space; K states and the globals."""

    metres_per_unit: float
    gyro_bias_rad_s: Array  # (K, 3)
    accel_walk_m_s2: Array  # (K, 3)
    drift_m: Array  # (K, 3)
    accel_slow_m_s2: Array  # (K, 3)
    accel_bias_m_s2: Array  # (3,)
    accel_delay_s: float  # beyond the gyroscope's, and beyond the first guess
    gyro_gain: Array  # (3, 3): rate = (I + gain) reading - bias
    cam_from_imu: Array  # (3, 3)
    imu_in_cam_m: Array  # (3,)
    delay_s: float  # of the IMU's stamps, beyond the first guess
    clock_rate: float  # growth of that delay per second, about the middle of the recording
    shutter: Array  # (4, 3, 3): rotation by rate, rotation by velocity, centre by rate, centre by velocity
    coupling_m: Array  # (3, 3): beyond Measurements.coupling

    @classmethod
    def at_start(
        cls,
        world_from_imu: Array,
        gravity_m_s2: Array,
        cam_from_imu: Array,
        imu_in_cam_m: Array,
        gyro_bias_rad_s: Array,
    ) -> Estimate:
        """Start of a fit: rotations, gravity and the calibration's values; scale one, all else zero."""
        zeros, none = np.zeros((len(world_from_imu), 3)), np.zeros((3, 3))
        return cls(
            metres_per_unit=1.0,
            world_from_imu=world_from_imu,
            imu_in_world_m=zeros,
            velocity_m_s=zeros,
            gyro_bias_rad_s=zeros + gyro_bias_rad_s,
            gravity_m_s2=gravity_m_s2,
            accel_bias_m_s2=np.zeros(3),
            accel_delay_s=0.0,
            gyro_gain=none,
            accel_gain=none,
            cam_from_imu=cam_from_imu,
            imu_in_cam_m=imu_in_cam_m,
            delay_s=0.0,
            clock_rate=0.0,
            shutter=np.zeros((4, 3, 3)),
            coupling_m=none,
            **dict.fromkeys(("accel_walk_m_s2", "drift_m", "accel_slow_m_s2"), zeros),
        )

    @property
    def accel_biases_m_s2(self) -> Array:
        """(K, 3) all that is subtracted from the accelerometer's readings."""
        return self.accel_bias_m_s2 + self.accel_walk_m_s2 + self.accel_slow_m_s2

    def moved(self, states: Array, z: Array, rate_rad_s: Array, t_s: Array) -> Estimate:
        """The estimate after a step of the states (K, 21) and the globals (79,).

        A later IMU clock makes each node an earlier instant of the IMU: rotations and positions move along.
        """
        later = (z[DELAY] + z[CLOCK_RATE] * (t_s - middle_s(t_s)))[:, None]
        return replace(
            self,
            metres_per_unit=self.metres_per_unit * float(np.exp(-z[SCALE])),
            world_from_imu=self.world_from_imu @ so3_exp(states[:, THETA] - rate_rad_s * later),
            imu_in_world_m=self.imu_in_world_m + states[:, POSITION] - self.velocity_m_s * later,
            gravity_m_s2=self.gravity_m_s2 + z[GRAVITY],
            cam_from_imu=so3_exp(z[ROTATION]) @ self.cam_from_imu,
            **{name: getattr(self, name) + states[:, columns] for name, columns in _ADDED_STATES.items()},
            **{name: self._add(name, z[columns]) for name, columns in _ADDED_GLOBALS.items()},
        )

    def _add(self, name: str, change: Array) -> Any:
        before = getattr(self, name)
        return before + change.reshape(np.shape(before))


@dataclass(frozen=True, eq=False, kw_only=True)
class Prior:
    """Gaussian priors.

    Attributes
    ----------
    mean
        Where the globals are expected.
    info
        (79, 79) information of the globals; the scale and gravity have none here.
    gravity_m_s2, gravity_sigma_m_s2
        Magnitude of gravity.
    gyro_bias_sigma_rad_s
        Of the first state's bias.
    speed_sigma_m_s
        Of every velocity: holds a keyframe between two long gaps.
    heavy_gains
        Whether gains of the accelerometer beyond ``LARGEST_GAIN_CHI2`` are pulled no more than there: one sensor in
        many is off by far more than the rest.
    """

    mean: Estimate
    info: Array
    gravity_m_s2: float
    gravity_sigma_m_s2: float
    gyro_bias_sigma_rad_s: float = 0.2
    speed_sigma_m_s: float = 10.0
    heavy_gains: bool = False

    def at(self, x: Estimate) -> Prior:
        """The normal prior that pulls at an estimate as much as this one does."""
        info = self.info.copy()
        if self.heavy_gains:
            kept = min(1.0, LARGEST_GAIN_CHI2 / max(self.gain_chi2(x), 1e-9))
            info[ACCEL_GAIN, ACCEL_GAIN] -= (1 - kept) * self.gain_info
        return replace(self, info=info)

    @property
    def gain_info(self) -> Array:
        """(9, 9) information of the accelerometer's gains, whatever the gyroscope's are."""
        across = self.info[ACCEL_GAIN, GYRO_GAIN]
        explained = across @ np.linalg.solve(self.info[GYRO_GAIN, GYRO_GAIN], across.T)
        return np.asarray(self.info[ACCEL_GAIN, ACCEL_GAIN] - explained)

    def gain_chi2(self, x: Estimate) -> float:
        """Squared deviation of the accelerometer's nine gains and axis errors, in standard deviations."""
        gain = (x.accel_gain - self.mean.accel_gain).ravel()
        return float(gain @ self.gain_info @ gain)

    def offset(self, x: Estimate) -> Array:
        """(79,) globals minus their expected values."""
        z, mean = np.zeros(N_GLOBALS), self.mean
        z[ROTATION] = so3_log(x.cam_from_imu @ mean.cam_from_imu.T)
        for name, columns in _ADDED_GLOBALS.items():
            z[columns] = np.ravel(getattr(x, name) - getattr(mean, name))
        return z


def middle_s(t_s: Array) -> float:
    """Reference time of the clock rate and of the accelerometer's random walk."""
    return 0.5 * float(t_s[0] + t_s[-1])
