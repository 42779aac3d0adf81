"""An IMU: what it reads when a motion carries it, with the errors of real ones.

Model, for the true angular velocity ``w`` and specific force ``f`` at the IMU, in the IMU frame::

    gyro reading  = (I + E_g) w + b_g(t) + n_g,      accel reading = (I + E_a) f + b_a(t) + n_a

with a full matrix ``E`` (scale factors on the diagonal, misalignments off it), biases that walk, white noise ``n``,
then saturation and quantisation. Readings are instantaneous: the motion has no content above the cut-off of a
sensor's own low-pass filter, whose effect is then a pure delay, and delays belong to the time offsets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply, quat_normalize
from colmap_inertial.core.types import CAL, CameraImuCalibration, ImuNoise, ImuRecording
from colmap_inertial.tools.simulate.motion import MARGIN_S, Motion, MotionOptions, Walls, make_motion

STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, kw_only=True)
class ImuOptions:
    """A kind of device: noise and the spread of everything that differs between devices and recordings.

    Names ending in ``_sd`` are standard deviations of zero-mean normal draws.
    """

    gyro_rate_hz: float = 200.0
    """Sample rate of the gyroscope, by its own clock."""
    accel_rate_hz: float = 200.0
    """Sample rate of the accelerometer, by its own clock."""
    gyro_density_rad_s_rthz: float = 2e-4
    """White noise."""
    accel_density_m_s2_rthz: float = 2e-3
    """White noise."""
    gyro_walk_rad_s2_rthz: float = 2e-5
    """Random walk of the bias."""
    accel_walk_m_s3_rthz: float = 2e-4
    """Random walk of the bias."""
    gyro_bias_rad_s_sd: float = 5e-3
    """Bias at the start."""
    accel_bias_m_s2_sd: float = 0.2
    """Bias at the start."""
    gyro_scale_sd: float = 0.005
    """Scale factor error of each axis."""
    gyro_misalignment_sd: float = 0.003
    """Each off-diagonal entry of the gyroscope's error matrix."""
    accel_scale_sd: float = 0.005
    """Scale factor error of each axis."""
    accel_misalignment_sd: float = 0.003
    """Each off-diagonal entry of the accelerometer's error matrix."""
    cam_from_imu_xyzw: tuple[float, float, float, float] | None = (1.0, 0.0, 0.0, 0.0)
    """Nominal mounting: by default of a phone filming in landscape with its rear camera (the IMU's x right, y up, z out
    of the screen); None draws any rotation."""
    mounting_rad_sd: float = 0.01
    """Deviation from the nominal mounting, each axis."""
    lever_arm_m_sd: tuple[float, float, float] = (0.04, 0.04, 0.005)
    """Position of the IMU in the camera frame (z is the optical axis)."""
    clock_offset_s: tuple[float, float] = (-600.0, 600.0)
    """Range of the difference between the clocks, drawn uniformly."""
    accel_delay_s: tuple[float, float] = (0.0, 0.0)
    """Mean and standard deviation of the accelerometer's time offset minus the gyroscope's."""
    clock_rate_sd: float = 2e-5
    """Relative error of the IMU clock's rate."""
    gyro_range_rad_s: float | None = None
    """Saturation."""
    accel_range_m_s2: float | None = None
    """Saturation."""
    gyro_resolution_rad_s: float = 0.0
    """Quantisation step; 0 is none."""
    accel_resolution_m_s2: float = 0.0
    """Quantisation step; 0 is none."""
    lead_s: tuple[float, float] = (0.1, 2.0)
    """Range of how long the IMU records before the camera starts, and after it ends, drawn uniformly."""

    def __post_init__(self) -> None:
        if not (self.gyro_rate_hz > 0 and self.accel_rate_hz > 0):
            raise ValueError("sample rates must be positive")
        if not -MARGIN_S < self.lead_s[0] <= self.lead_s[1] < MARGIN_S:
            raise ValueError(f"lead_s must lie within +-{MARGIN_S} s")
        if any(np.min(value) < 0 for name, value in vars(self).items() if name.endswith(("_sd", "_rthz"))):
            raise ValueError("densities and standard deviations must not be negative")

    def noise(self) -> ImuNoise:
        """The densities and walks, as a data sheet would give them."""
        return ImuNoise(**{f.name: getattr(self, f.name) for f in fields(ImuNoise)})


_PHONE = ImuOptions()
#: Devices by name. The figures are round numbers inside the ranges of these sources:
#:
#: * Densities: MEMS data sheets give 3.8-7 mdps/sqrt(Hz) = 0.7-1.2e-4 rad/s/sqrt(Hz) and 70-180 ug/sqrt(Hz) =
#:   0.7-1.8e-3 m/s2/sqrt(Hz) (ST LSM6DSO, Bosch BMI160); logged phones show 1e-4..1e-3 and 1e-3..1.5e-2.
#: * Zero-g offset 20-90 mg, sensitivity tolerance 1 % (the same data sheets); the gyroscope's offset of up to 3 deg/s
#:   is mostly removed by the operating system of a phone.
#: * Tablet: what was estimated from the recordings of Mustaniemi et al. (IROS 2017): 100 Hz, gyroscope 3e-4 with a walk
#:   of 3e-4 rad/s/sqrt(s), accelerometer bias 0.2-0.6 m/s2, accelerometer 8-13 ms late, gyroscope scale within 1 %.
#: * Action camera: 200 Hz and clock errors up to 1 % in GoPro telemetry; the camera is small, so is the lever arm.
IMU_PRESETS: dict[str, ImuOptions] = {
    "phone": _PHONE,
    "tablet": replace(
        _PHONE,
        gyro_rate_hz=100.0,
        accel_rate_hz=100.0,
        gyro_density_rad_s_rthz=3e-4,
        accel_density_m_s2_rthz=1e-2,
        gyro_walk_rad_s2_rthz=3e-4,
        accel_walk_m_s3_rthz=5e-4,
        accel_bias_m_s2_sd=0.3,
        gyro_scale_sd=0.01,
        accel_delay_s=(-0.010, 0.002),
    ),
    "action_camera": replace(
        _PHONE,
        accel_density_m_s2_rthz=3e-3,
        gyro_bias_rad_s_sd=1e-2,
        accel_bias_m_s2_sd=0.3,
        gyro_scale_sd=0.01,
        accel_scale_sd=0.01,
        gyro_misalignment_sd=0.005,
        accel_misalignment_sd=0.005,
        cam_from_imu_xyzw=None,
        lever_arm_m_sd=(0.015, 0.015, 0.01),
        clock_rate_sd=2e-3,
    ),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuErrors:
    """One device on one day: every parameter of the module's model.

    Attributes
    ----------
    cam_from_imu_xyzw, imu_in_cam_m
        Mounting; lever arm.
    gyro_matrix, accel_matrix
        (3, 3) ``E``: relative errors of scale (diagonal) and alignment.
    gyro_bias_rad_s, accel_bias_m_s2
        (3,) at the first sample.
    gyro_time_offset_s, accel_time_offset_s
        ``t_cam = t_stamp + offset``, at ``middle_s``.
    clock_rate
        The IMU's clock advances ``1 + clock_rate`` seconds in a second of the camera's.
    middle_s
        Camera time at which the offsets hold.
    """

    cam_from_imu_xyzw: Array
    imu_in_cam_m: Array
    gyro_matrix: Array
    accel_matrix: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    gyro_time_offset_s: float
    accel_time_offset_s: float
    clock_rate: float
    middle_s: float

    @property
    def clock_offsets_s(self) -> dict[str, float]:
        """The time offsets by their names."""
        return {name: getattr(self, name) for name in ("gyro_time_offset_s", "accel_time_offset_s")}

    def stamp_s(self, t_cam_s: Array, offset_s: float) -> Array:
        """The IMU clock's reading at camera times, for the gyroscope's or the accelerometer's offset."""
        return self.middle_s - offset_s + (np.asarray(t_cam_s) - self.middle_s) * (1 + self.clock_rate)

    def t_cam_s(self, stamp_s: Array, offset_s: float) -> Array:
        """Inverse of :meth:`stamp_s`."""
        return self.middle_s + (np.asarray(stamp_s) + offset_s - self.middle_s) / (1 + self.clock_rate)


def draw_imu_errors(options: ImuOptions, duration_s: float, rng: np.random.Generator) -> ImuErrors:
    """Draw a device and its clock for a recording of ``duration_s``."""
    if options.cam_from_imu_xyzw is None:
        mounting = quat_normalize(rng.standard_normal(4))
    else:
        nominal = quat_normalize(np.array(options.cam_from_imu_xyzw))
        mounting = quat_multiply(quat_exp(options.mounting_rad_sd * rng.standard_normal(3)), nominal)
    gyro_offset_s = rng.uniform(*options.clock_offset_s)
    return ImuErrors(
        cam_from_imu_xyzw=mounting,
        imu_in_cam_m=np.array(options.lever_arm_m_sd) * rng.standard_normal(3),
        gyro_matrix=_error_matrix(options.gyro_scale_sd, options.gyro_misalignment_sd, rng),
        accel_matrix=_error_matrix(options.accel_scale_sd, options.accel_misalignment_sd, rng),
        gyro_bias_rad_s=options.gyro_bias_rad_s_sd * rng.standard_normal(3),
        accel_bias_m_s2=options.accel_bias_m_s2_sd * rng.standard_normal(3),
        gyro_time_offset_s=gyro_offset_s,
        accel_time_offset_s=gyro_offset_s + options.accel_delay_s[0] + options.accel_delay_s[1] * rng.standard_normal(),
        clock_rate=options.clock_rate_sd * rng.standard_normal(),
        middle_s=duration_s / 2,
    )


def _error_matrix(scale_sd: float, misalignment_sd: float, rng: np.random.Generator) -> Array:
    sd = np.full((3, 3), misalignment_sd)
    np.fill_diagonal(sd, scale_sd)
    return np.asarray(sd * rng.standard_normal((3, 3)))


def true_rate_rad_s(motion: Motion, errors: ImuErrors, t_cam_s: Array) -> Array:
    """(N, 3) true angular velocity in the IMU frame at (N,) camera times."""
    return motion.rate_in_cam_rad_s(t_cam_s) @ matrix_from_quat(errors.cam_from_imu_xyzw)


def true_specific_force_m_s2(motion: Motion, errors: ImuErrors, t_cam_s: Array, gravity_m_s2: float) -> Array:
    """(N, 3) true specific force at the IMU, in the IMU frame, at (N,) camera times (world z is up)."""
    k = motion.at(t_cam_s)
    free = k.accel_in_world_m_s2 + np.array([0.0, 0.0, gravity_m_s2])
    in_cam = np.einsum("nji,nj->ni", matrix_from_quat(k.world_from_cam_xyzw), free)
    arm, rate = errors.imu_in_cam_m, k.rate_in_cam_rad_s
    in_cam += np.cross(k.rate_dot_in_cam_rad_s2, arm)  # Euler term
    in_cam += rate * (rate @ arm)[:, None] - np.sum(rate * rate, axis=1, keepdims=True) * arm  # centripetal term
    return np.asarray(in_cam @ matrix_from_quat(errors.cam_from_imu_xyzw))


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledImu:
    """An IMU's samples with their truth.

    Attributes
    ----------
    recording
        What a user would get.
    errors
        The device.
    gyro_t_cam_s, accel_t_cam_s
        (N,), (M,) true camera times of the samples.
    gyro_bias_rad_s, accel_bias_m_s2
        (N, 3), (M, 3) biases of the samples.
    """

    recording: ImuRecording
    errors: ImuErrors
    gyro_t_cam_s: Array
    accel_t_cam_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array

    def calibration(self, readout_s: float) -> CameraImuCalibration:
        """True camera-IMU calibration; its gyroscope bias is the mean over the recording, its ``cov`` zero."""
        return CameraImuCalibration(
            cam_from_imu_xyzw=self.errors.cam_from_imu_xyzw,
            **self.errors.clock_offsets_s,
            gyro_bias_rad_s=self.gyro_bias_rad_s.mean(axis=0),
            imu_in_cam_m=self.errors.imu_in_cam_m,
            readout_s=readout_s,
            cov=np.zeros((CAL.COUNT, CAL.COUNT)),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensor:
    """Gyroscope or accelerometer of one device on one day; units are those of its readings."""

    rate_hz: float
    offset_s: float
    matrix: Array
    bias: Array
    walk: float
    density: float
    limit: float | None
    step: float

    def stamps_s(self, errors: ImuErrors, interval_s: tuple[float, float], rng: np.random.Generator) -> Array:
        """Regular stamps, with a phase of their own, inside an interval of camera time."""
        first, last = errors.stamp_s(np.array(interval_s), self.offset_s)
        first += rng.uniform(0, 1 / self.rate_hz)
        return np.asarray(first + np.arange(max(2, int((last - first) * self.rate_hz))) / self.rate_hz)

    def readings(self, true: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Readings of the true values, and the bias of each, (N, 3)."""
        increments = rng.standard_normal(true.shape)
        increments *= self.walk / np.sqrt(self.rate_hz)
        increments[0] = self.bias
        biases = np.cumsum(increments, axis=0)
        noise = self.density * np.sqrt(self.rate_hz) * rng.standard_normal(true.shape)
        out = true + true @ self.matrix.T + biases + noise
        if self.limit is not None:
            out = np.clip(out, -self.limit, self.limit)
        if self.step > 0:
            out = self.step * np.round(out / self.step)
        return out, biases


def sensors_of(options: ImuOptions, errors: ImuErrors) -> tuple[Sensor, Sensor]:
    """Gyroscope and accelerometer of a device."""
    gyroscope = Sensor(
        rate_hz=options.gyro_rate_hz,
        offset_s=errors.gyro_time_offset_s,
        matrix=errors.gyro_matrix,
        bias=errors.gyro_bias_rad_s,
        walk=options.gyro_walk_rad_s2_rthz,
        density=options.gyro_density_rad_s_rthz,
        limit=options.gyro_range_rad_s,
        step=options.gyro_resolution_rad_s,
    )
    accelerometer = Sensor(
        rate_hz=options.accel_rate_hz,
        offset_s=errors.accel_time_offset_s,
        matrix=errors.accel_matrix,
        bias=errors.accel_bias_m_s2,
        walk=options.accel_walk_m_s3_rthz,
        density=options.accel_density_m_s2_rthz,
        limit=options.accel_range_m_s2,
        step=options.accel_resolution_m_s2,
    )
    return gyroscope, accelerometer


def sample_imu(
    motion: Motion,
    errors: ImuErrors,
    options: ImuOptions,
    *,
    duration_s: float,
    rng: np.random.Generator,
    gravity_m_s2: float = STANDARD_GRAVITY_M_S2,
) -> SampledImu:
    """Let the motion carry the IMU during the camera's recording, and a little before and after it.

    Parameters
    ----------
    motion
        From 0 to ``duration_s`` on the camera's clock, and ``MARGIN_S`` around it.
    errors, options
        The device; the options give rates, noise, range and resolution.
    """
    lead, lag = rng.uniform(*options.lead_s, size=2)
    interval = (-float(lead), duration_s + float(lag))
    gyroscope, accelerometer = sensors_of(options, errors)
    gyro_t_s, accel_t_s = (sensor.stamps_s(errors, interval, rng) for sensor in (gyroscope, accelerometer))
    gyro_t_cam_s = errors.t_cam_s(gyro_t_s, errors.gyro_time_offset_s)
    accel_t_cam_s = errors.t_cam_s(accel_t_s, errors.accel_time_offset_s)
    gyro, gyro_bias = gyroscope.readings(true_rate_rad_s(motion, errors, gyro_t_cam_s), rng)
    force = true_specific_force_m_s2(motion, errors, accel_t_cam_s, gravity_m_s2)
    accel, accel_bias = accelerometer.readings(force, rng)
    return SampledImu(
        recording=ImuRecording(
            gyro_t_s=gyro_t_s,
            gyro_rad_s=gyro,
            accel_t_s=accel_t_s,
            accel_m_s2=accel,
            device="simulated",
            noise=options.noise(),
        ),
        errors=errors,
        gyro_t_cam_s=gyro_t_cam_s,
        accel_t_cam_s=accel_t_cam_s,
        gyro_bias_rad_s=gyro_bias,
        accel_bias_m_s2=accel_bias,
    )


def simulate_imu(
    motion_options: MotionOptions,
    options: ImuOptions,
    streams: Sequence[np.random.Generator],
    *,
    gravity_m_s2: float = STANDARD_GRAVITY_M_S2,
    walls_m: Walls | None = None,
) -> tuple[Motion, SampledImu]:
    """Draw a motion, in a room or anywhere, from the first stream; a device and what it reads from the second."""
    duration_s = motion_options.duration_s
    motion = make_motion(motion_options, streams[0], walls_m)
    errors = draw_imu_errors(options, duration_s, streams[1])
    return motion, sample_imu(motion, errors, options, duration_s=duration_s, rng=streams[1], gravity_m_s2=gravity_m_s2)
