"""Recordings without images: the poses that structure from motion would give, and the IMU recorded with it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    skew,
)
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.tools.simulate.motion import Motion, MotionOptions
from colmap_inertial.tools.simulate.sensors import STANDARD_GRAVITY_M_S2, ImuOptions, SampledImu, simulate_imu


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Noise of structure from motion, in metres and radians of the true world.

    The defaults are of the size estimated from the recordings of Mustaniemi et al. (IROS 2017).
    """

    frame_rate_hz: float = 30.0
    """Poses per second."""
    position_white_m: float = 0.003
    """White noise of each coordinate of the camera centre."""
    position_correlated_m: float = 0.003
    """Correlated noise (Ornstein-Uhlenbeck), each coordinate."""
    rotation_white_rad: float = 0.001
    """White noise, each axis."""
    rotation_correlated_rad: float = 0.001
    """Correlated noise, each axis."""
    correlation_s: float = 0.35
    """Time constant of the correlated noise."""
    position_drift_m_rts: float = 0.0
    """Random walk of the position, each axis, per root second."""
    rotation_drift_rad_rts: float = 0.0
    """Random walk of the orientation, each axis, per root second."""
    scale_drift_rts: float = 0.0
    """Random walk of the logarithm of the scale, per root second."""
    readout_s: float = 0.0
    """Rolling shutter: poses come from a global-shutter fit to images whose rows are this far apart in time."""
    scene_depth_m: tuple[float, float] = (0.5, 3.0)
    """Range of the depths that the rolling shutter's effect on poses is computed from."""
    metres_per_unit: tuple[float, float] = (0.1, 10.0)
    """Range of the scale, drawn uniformly in its logarithm."""

    def __post_init__(self) -> None:
        if not (self.frame_rate_hz > 0 and self.correlation_s > 0 and self.metres_per_unit[0] > 0):
            raise ValueError("frame_rate_hz, correlation_s and metres_per_unit must be positive")


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """Everything about a simulated recording but its seed."""

    motion: MotionOptions = field(default_factory=MotionOptions)
    """How the hand moves."""
    imu: ImuOptions = field(default_factory=ImuOptions)
    """The device; see IMU_PRESETS."""
    sfm: SfmOptions = field(default_factory=SfmOptions)
    """How well the camera is seen."""
    gravity_m_s2: float = STANDARD_GRAVITY_M_S2
    """Strength of gravity."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordingTruth:
    """Truth of a simulated recording.

    Attributes
    ----------
    motion
        The camera's path in the metric world (z up), a function of camera time.
    metres_per_unit
        Scale of the model (of its first frame, where the scale drifts).
    model_from_world_xyzw, world_in_model
        ``x_model = R x_world / metres_per_unit + world_in_model``.
    gravity_in_world_m_s2
        (3,) points down, in the model's frame: what ``ScaleEstimate`` calls the same.
    calibration
        True camera-IMU calibration; its gyroscope bias is the mean over the recording, its ``cov`` zero.
    accel_bias_m_s2
        (3,) mean over the recording.
    imu
        Every parameter of the IMU's model; its samples with their true times and biases.
    """

    motion: Motion
    metres_per_unit: float
    model_from_world_xyzw: Array
    world_in_model: Array
    gravity_in_world_m_s2: Array
    calibration: CameraImuCalibration
    accel_bias_m_s2: Array
    imu: SampledImu

    def cam_in_model(self, t_s: Array) -> Array:
        """(N, 3) true camera centres in the model's frame and unit at (N,) camera times."""
        rotated = quat_rotate(self.model_from_world_xyzw, self.motion.cam_in_world_m(t_s))
        return np.asarray(rotated / self.metres_per_unit + self.world_in_model)

    def cam_from_model_xyzw(self, t_s: Array) -> Array:
        """(N, 4) true orientations against the model's frame at (N,) camera times."""
        model_from_cam = quat_multiply(self.model_from_world_xyzw, self.motion.world_from_cam_xyzw(t_s))
        return quat_normalize(quat_conjugate(model_from_cam))


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedRecording:
    """Inputs of an estimator, and the truth."""

    trajectory: CameraTrajectory
    imu: ImuRecording
    truth: RecordingTruth


def rolling_shutter_bias_s(readout_s: float, scene_depth_m: tuple[float, float], rng: np.random.Generator) -> Array:
    """(6, 6) what a global-shutter pose fitted to a rolling-shutter image is off by, per angular and linear velocity.

    To first order a point at image height ``y`` is seen ``tau(y)`` after the pose's instant, so it is displaced by
    ``tau J twist`` (J is the interaction matrix of visual servoing, Chaumette and Hutchinson 2006); the fit absorbs
    ``(sum J'J)^-1 sum tau J'J twist``. Rows and columns: rotation, translation, both in the camera frame.

    Parameters
    ----------
    readout_s
        From the first row to the last.
    scene_depth_m
        The image (about 66 x 53 degrees) shows points uniform in these depths.
    """
    if readout_s == 0:
        return np.zeros((6, 6))
    x, y = rng.uniform(-0.65, 0.65, 300), rng.uniform(-0.5, 0.5, 300)
    depth = rng.uniform(*scene_depth_m, 300)
    points = np.stack([x, y, np.ones_like(x)], axis=1) * depth[:, None]
    # in the camera frame a point moves by -v - w x P = -v + [P]x w
    motion = np.concatenate([skew(points), np.broadcast_to(-np.eye(3), (300, 3, 3))], axis=2)
    image = np.zeros((300, 2, 3))
    image[:, 0, 0] = image[:, 1, 1] = 1 / depth
    image[:, 0, 2], image[:, 1, 2] = -x / depth, -y / depth
    j = image @ motion
    normal = np.einsum("nki,nkj->nij", j, j)
    return np.linalg.solve(normal.sum(axis=0), np.einsum("n,nij->ij", readout_s * y, normal))


def _draw_correlated(n: int, dt_s: float, sigma: float, correlation_s: float, rng: np.random.Generator) -> Array:
    """(n, 3) samples of a stationary Ornstein-Uhlenbeck process."""
    from scipy.signal import lfilter

    decay = np.exp(-dt_s / correlation_s)
    noise = sigma * rng.standard_normal((n, 3))
    noise[1:] *= np.sqrt(1 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], noise, axis=0))


def perturb_poses(motion: Motion, t_s: Array, options: SfmOptions, rng: np.random.Generator) -> tuple[Array, Array]:
    """(N, 4) world_from_cam_xyzw and (N, 3) centres (metres, world) at (N,) times, with the errors of ``options``."""
    n, dt = len(t_s), 1 / options.frame_rate_hz
    k = motion.at(t_s)
    position, rotation = k.cam_in_world_m, k.world_from_cam_xyzw
    # drift accumulates along the path: every step is rotated and stretched by what has accumulated before it
    walk = rng.standard_normal((n, 7)) * np.sqrt(dt)
    walk[0] = 0
    rotated = quat_exp(options.rotation_drift_rad_rts * np.cumsum(walk[:, :3], axis=0))
    stretch = np.exp(options.scale_drift_rts * np.cumsum(walk[:, 6:], axis=0))
    steps = np.diff(position, axis=0, prepend=np.zeros((1, 3)))
    steps[1:] = quat_rotate(rotated[1:], steps[1:] * stretch[1:])
    position = np.cumsum(steps + options.position_drift_m_rts * walk[:, 3:6], axis=0)
    rotation = quat_multiply(rotated, rotation)

    world_from_cam = matrix_from_quat(rotation)
    bias_s = rolling_shutter_bias_s(options.readout_s, options.scene_depth_m, rng)
    velocity_in_cam = np.einsum("nji,nj->ni", world_from_cam, k.velocity_in_world_m_s)
    shift = np.concatenate([k.rate_in_cam_rad_s, velocity_in_cam], axis=1) @ bias_s.T
    turn = shift[:, :3] + options.rotation_white_rad * rng.standard_normal((n, 3))
    turn += _draw_correlated(n, dt, options.rotation_correlated_rad, options.correlation_s, rng)
    position = position + np.einsum("nij,nj->ni", world_from_cam, shift[:, 3:])
    position = position + options.position_white_m * rng.standard_normal((n, 3))
    position = position + _draw_correlated(n, dt, options.position_correlated_m, options.correlation_s, rng)
    return quat_multiply(rotation, quat_exp(turn)), position


def simulate_recording(options: RecordingOptions | None = None, *, seed: int) -> SimulatedRecording:
    """Draw a recording: a motion, a device, and the reconstruction's errors.

    Motion, IMU and reconstruction draw from separate streams: changing the options of one leaves the others as they
    were. The camera's clock starts at 0; the poses hold at their stamps.

    Parameters
    ----------
    options
        ``None`` is an orbit of 60 s with a phone.
    seed
        Same options and seed, same recording.
    """
    options = options or RecordingOptions()
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    motion, imu = simulate_imu(options.motion, options.imu, streams, gravity_m_s2=options.gravity_m_s2)
    rng = streams[2]
    metres_per_unit = float(np.exp(rng.uniform(*np.log(options.sfm.metres_per_unit))))
    model_from_world = quat_normalize(rng.standard_normal(4))
    world_in_model = rng.standard_normal(3)
    t_s = np.arange(int(options.motion.duration_s * options.sfm.frame_rate_hz)) / options.sfm.frame_rate_hz
    world_from_cam, position = perturb_poses(motion, t_s, options.sfm, rng)
    trajectory = CameraTrajectory(
        names=tuple(f"{i:06d}" for i in range(len(t_s))),
        t_s=t_s,
        cam_from_world_xyzw=quat_conjugate(quat_multiply(model_from_world, world_from_cam)),
        cam_in_world=quat_rotate(model_from_world, position) / metres_per_unit + world_in_model,
    )
    truth = RecordingTruth(
        motion=motion,
        metres_per_unit=metres_per_unit,
        model_from_world_xyzw=model_from_world,
        world_in_model=world_in_model,
        gravity_in_world_m_s2=quat_rotate(model_from_world, np.array([0.0, 0.0, -options.gravity_m_s2])),
        calibration=imu.calibration(options.sfm.readout_s),
        accel_bias_m_s2=imu.accel_bias_m_s2.mean(axis=0),
        imu=imu,
    )
    return SimulatedRecording(trajectory=trajectory, imu=imu.recording, truth=truth)
