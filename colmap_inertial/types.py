"""The values that move through the package: frozen, checked when built, numpy only.

Conventions. Times are seconds on the clock that the name says, counted from the value's ``epoch_ns`` (so that
nanosecond stamps of the size 1e18 keep their precision). Transforms are ``target_from_source``, quaternions xyzw.
IMU frame: whatever the reader delivers, right-handed, the same for gyroscope and accelerometer. Accelerations are
specific force: at rest the accelerometer reads +9.8 m/s2 away from the ground.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_inertial.errors import NotObservableError

Array = NDArray[np.float64]
LengthUnit = Literal["model", "m"]
ReadoutDirection = Literal["down", "up", "right", "left"]
Verdict = Literal["trusted", "weak", "refused"]
WorldAxes = Literal["z-up", "y-down"]

#: The direction of gravity in a metric world with these axes: ``y-down`` is COLMAP's and computer vision's habit.
DOWN_IN_WORLD = {"z-up": np.array([0.0, 0.0, -1.0]), "y-down": np.array([0.0, 1.0, 0.0])}

#: Order of the parameters in ``CameraImuCalibration.cov``. The rotation error is in the camera frame, on the left:
#: true = exp(error) * estimate.
CALIBRATION_PARAMETERS = (
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad"),
    *("gyro_time_offset_s", "accel_time_offset_s"),
    *("gyro_bias_x_rad_s", "gyro_bias_y_rad_s", "gyro_bias_z_rad_s"),
    *("imu_in_cam_x_m", "imu_in_cam_y_m", "imu_in_cam_z_m"),
    "readout_s",
)


def _array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """A read-only float64 copy of ``value``; ``None`` in ``shape`` means any length."""
    out = np.array(value, dtype=np.float64)
    if out.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, out.shape, strict=True)):
        wanted = tuple("N" if n is None else n for n in shape)
        raise ValueError(f"{name}: shape {out.shape}, expected {wanted}")
    if not np.isfinite(out).all():
        raise ValueError(f"{name}: contains values that are not finite")
    out.setflags(write=False)
    return out


def _times(name: str, value: ArrayLike) -> Array:
    out = _array(name, value, (None,))
    if np.any(np.diff(out) <= 0):
        raise ValueError(f"{name}: times must increase strictly")
    return out


def _quaternions(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    out = _array(name, value, shape)
    norm = np.linalg.norm(out, axis=-1, keepdims=True)
    if np.any(np.abs(norm - 1) > 1e-3):
        raise ValueError(f"{name}: quaternions must have unit norm")
    out = out / norm
    out.setflags(write=False)
    return out


def _covariance(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    out = _array(name, value, shape)
    diagonal = np.diagonal(out, axis1=-2, axis2=-1)
    if np.any(diagonal < 0) or not np.allclose(out, np.swapaxes(out, -1, -2), rtol=1e-6, atol=1e-30):
        raise ValueError(f"{name}: not a covariance (must be symmetric with a non-negative diagonal)")
    return out


def _set(instance: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(instance, name, value)


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuNoise:
    """White-noise densities and bias walks of an IMU, as data sheets give them.

    Attributes
    ----------
    gyro_density_rad_s_rthz, accel_density_m_s2_rthz
        White noise, per square root of hertz.
    gyro_walk_rad_s2_rthz, accel_walk_m_s3_rthz
        Random walk of the biases.
    """

    gyro_density_rad_s_rthz: float
    accel_density_m_s2_rthz: float
    gyro_walk_rad_s2_rthz: float
    accel_walk_m_s3_rthz: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: must be finite and not negative")


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuRecording:
    """Gyroscope and accelerometer samples of one recording.

    Attributes
    ----------
    gyro_t_s, accel_t_s
        (N,), (M,) stamps in seconds since ``epoch_ns`` on the IMU's clock, strictly increasing. Two time bases: a
        gyroscope sample never belongs to an accelerometer sample by index.
    gyro_rad_s
        (N, 3) angular velocity in the IMU frame.
    accel_m_s2
        (M, 3) specific force in the IMU frame, gravity included.
    epoch_ns
        The clock's reading, in nanoseconds, where both time bases are zero.
    repairs
        What the reader had to sort, merge or drop, in words.
    device
        What recorded it, where known.
    noise
        The data sheet's noise, where the recording comes with one.
    """

    gyro_t_s: Array
    gyro_rad_s: Array
    accel_t_s: Array
    accel_m_s2: Array
    epoch_ns: int = 0
    repairs: tuple[str, ...] = ()
    device: str = ""
    noise: ImuNoise | None = None

    def __post_init__(self) -> None:
        gyro_t_s, accel_t_s = _times("gyro_t_s", self.gyro_t_s), _times("accel_t_s", self.accel_t_s)
        _set(
            self,
            gyro_t_s=gyro_t_s,
            accel_t_s=accel_t_s,
            gyro_rad_s=_array("gyro_rad_s", self.gyro_rad_s, (len(gyro_t_s), 3)),
            accel_m_s2=_array("accel_m_s2", self.accel_m_s2, (len(accel_t_s), 3)),
        )
        if len(gyro_t_s) < 2 or len(accel_t_s) < 2:
            raise ValueError("an ImuRecording needs at least two samples of each sensor")


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraModel:
    """Intrinsics in COLMAP's terms: model name, image size, parameters; the top-left pixel's centre is (0.5, 0.5)."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"image size {self.width}x{self.height} must be positive")
        params = tuple(float(p) for p in self.params)
        if not np.isfinite(params).all():
            raise ValueError("camera parameters must be finite")
        _set(self, params=params)


class Projector(Protocol):
    """Maps between pixels and normalised image coordinates; ``pycolmap.Camera`` is one."""

    def cam_from_img(self, image_points: Array, /) -> Array: ...

    def img_from_cam(self, cam_points: Array, /) -> Array: ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """One decoded frame on its way to feature extraction.

    Attributes
    ----------
    name
        File name that COLMAP will see; the frame's identity from here on.
    image
        (H, W) or (H, W, 3) pixels, RGB order, uint8 or uint16, read-only. A stage returns a new frame
        (``dataclasses.replace``) with a new array; one that leaves the array alone has the original file passed on.
    t_s
        Start of exposure of row 0, camera clock, seconds since the timing's ``epoch_ns``.
    exposure_s
        ``None`` where unknown.
    readout_s
        From the first row to one past the last; 0 is a global shutter; ``None`` where unknown.
    camera
        ``None`` lets COLMAP calibrate.
    """

    name: str
    image: NDArray[np.uint8] | NDArray[np.uint16]
    t_s: float
    exposure_s: float | None = None
    readout_s: float | None = None
    camera: CameraModel | None = None

    def __post_init__(self) -> None:
        if self.image.ndim not in (2, 3) or self.image.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"{self.name}: an image is (H, W) or (H, W, 3), uint8 or uint16")
        view = self.image.view()
        view.setflags(write=False)
        _set(self, image=view)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameTiming:
    """When each frame was exposed, on the camera's clock.

    Attributes
    ----------
    names
        (F,) file names, in order of time.
    t_s
        (F,) start of exposure of row 0, seconds since ``epoch_ns``, strictly increasing.
    exposure_s
        (F,) exposure times, or ``None`` where unknown.
    readout_s
        From the first row to one past the last; 0 is a global shutter; ``None`` where unknown.
    readout_direction
        Where the rows' exposure moves in the stored image.
    """

    names: tuple[str, ...]
    t_s: Array
    exposure_s: Array | None = None
    readout_s: float | None = None
    readout_direction: ReadoutDirection = "down"
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        t_s = _times("t_s", self.t_s)
        if len(self.names) != len(t_s) or len(set(self.names)) != len(t_s):
            raise ValueError("frame names must be unique, one for each time")
        _set(self, names=tuple(self.names), t_s=t_s)
        if self.exposure_s is not None:
            _set(self, exposure_s=_array("exposure_s", self.exposure_s, (len(t_s),)))
        if self.readout_s is not None and not 0 <= self.readout_s < 1:
            raise ValueError("readout_s must be from 0 to 1 second")

    def pose_t_s(self) -> Array:
        """(F,) the instants that whole-image poses hold: mid-exposure of the middle row."""
        exposure = 0.0 if self.exposure_s is None else self.exposure_s
        return np.asarray(self.t_s + 0.5 * exposure + 0.5 * (self.readout_s or 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraTrajectory:
    """Camera poses of a reconstruction with their times.

    Attributes
    ----------
    names
        (F,) image names (or the index as text, where there are no images).
    t_s
        (F,) the instant each pose holds, camera clock, seconds since ``epoch_ns``, strictly increasing.
    cam_from_world_xyzw
        (F, 4) rotations.
    cam_in_world
        (F, 3) camera centres, in ``length_unit``.
    pose_cov
        (F, 6, 6) optional covariance: rotation error (rad, camera frame, left), camera centre (``length_unit``, world).
    """

    names: tuple[str, ...]
    t_s: Array
    cam_from_world_xyzw: Array
    cam_in_world: Array
    length_unit: LengthUnit = "model"
    epoch_ns: int = 0
    pose_cov: Array | None = None

    def __post_init__(self) -> None:
        t_s = _times("t_s", self.t_s)
        n = len(t_s)
        if len(self.names) != n:
            raise ValueError("one name for each pose")
        _set(
            self,
            names=tuple(self.names),
            t_s=t_s,
            cam_from_world_xyzw=_quaternions("cam_from_world_xyzw", self.cam_from_world_xyzw, (n, 4)),
            cam_in_world=_array("cam_in_world", self.cam_in_world, (n, 3)),
        )
        if self.pose_cov is not None:
            _set(self, pose_cov=_covariance("pose_cov", self.pose_cov, (n, 6, 6)))

    def __len__(self) -> int:
        return len(self.t_s)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.intp] | slice) -> CameraTrajectory:
        """The poses that ``keep`` (mask, increasing indices or slice) picks."""
        index = np.arange(len(self))[keep]
        return CameraTrajectory(
            names=tuple(self.names[i] for i in index),
            t_s=self.t_s[index],
            cam_from_world_xyzw=self.cam_from_world_xyzw[index],
            cam_in_world=self.cam_in_world[index],
            length_unit=self.length_unit,
            epoch_ns=self.epoch_ns,
            pose_cov=None if self.pose_cov is None else self.pose_cov[index],
        )


def clock_shift_s(trajectory: CameraTrajectory, imu: ImuRecording) -> float:
    """What to add to an offset between raw stamps to get the offset between ``t_s`` values.

    With ``t_cam = t_stamp + offset`` on raw stamps, ``trajectory`` time = ``imu`` time + offset + this.
    """
    return (imu.epoch_ns - trajectory.epoch_ns) * 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraImuCalibration:
    """How the camera and the IMU of one device relate.

    Attributes
    ----------
    cam_from_imu_xyzw
        (4,) rotation.
    gyro_time_offset_s, accel_time_offset_s
        ``t_cam = t_stamp + offset`` between raw stamps (each clock's reading in seconds, epoch included).
    gyro_bias_rad_s
        (3,) IMU frame; the true rate is the reading minus this.
    imu_in_cam_m
        (3,) lever arm: the IMU's position in the camera frame.
    readout_s
        Rolling-shutter readout; 0 for a global shutter.
    cov
        (12, 12) in the order of ``CALIBRATION_PARAMETERS``. Wide where nothing is known.
    """

    cam_from_imu_xyzw: Array
    gyro_time_offset_s: float
    accel_time_offset_s: float
    gyro_bias_rad_s: Array
    imu_in_cam_m: Array
    readout_s: float
    cov: Array

    def __post_init__(self) -> None:
        n = len(CALIBRATION_PARAMETERS)
        _set(
            self,
            cam_from_imu_xyzw=_quaternions("cam_from_imu_xyzw", self.cam_from_imu_xyzw, (4,)),
            gyro_bias_rad_s=_array("gyro_bias_rad_s", self.gyro_bias_rad_s, (3,)),
            imu_in_cam_m=_array("imu_in_cam_m", self.imu_in_cam_m, (3,)),
            cov=_covariance("cov", self.cov, (n, n)),
        )

    def sigma(self, parameter: str) -> float:
        """Standard deviation of one of ``CALIBRATION_PARAMETERS``."""
        i = CALIBRATION_PARAMETERS.index(parameter)
        return float(np.sqrt(self.cov[i, i]))


@dataclass(frozen=True, eq=False, kw_only=True)
class SmoothedTrajectory:
    """Positions, velocities and accelerations with their covariance.

    Attributes
    ----------
    t_s
        (T,) camera clock, seconds since ``epoch_ns``.
    cam_in_world, velocity_in_world, accel_in_world
        (T, 3) in ``length_unit``, per second, per second squared; without gravity.
    cam_from_world_xyzw
        (T, 4) rotations.
    cov
        (T, 9, 9) of position, velocity, acceleration.
    """

    t_s: Array
    cam_in_world: Array
    velocity_in_world: Array
    accel_in_world: Array
    cam_from_world_xyzw: Array
    cov: Array
    length_unit: LengthUnit = "model"
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        t_s = _times("t_s", self.t_s)
        n = len(t_s)
        _set(
            self,
            t_s=t_s,
            cam_in_world=_array("cam_in_world", self.cam_in_world, (n, 3)),
            velocity_in_world=_array("velocity_in_world", self.velocity_in_world, (n, 3)),
            accel_in_world=_array("accel_in_world", self.accel_in_world, (n, 3)),
            cam_from_world_xyzw=_quaternions("cam_from_world_xyzw", self.cam_from_world_xyzw, (n, 4)),
            cov=_covariance("cov", self.cov, (n, 9, 9)),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleEstimate:
    """Metres per model unit, with its uncertainty and a verdict.

    Attributes
    ----------
    metres_per_unit
        ``None`` when refused.
    sigma_log
        Standard deviation of the logarithm of the scale; ``None`` when refused.
    ci95
        95 % interval of ``metres_per_unit``; ``None`` when refused.
    verdict, reasons
        What to make of it, and why, in words for the user.
    gravity_in_world_m_s2
        (3,) points down, in the source model's frame; ``None`` where it could not be estimated.
    accel_bias_m_s2
        (3,) IMU frame; the true specific force is the reading minus this.
    calibration
        The camera-IMU calibration that the estimate refined.
    cov
        (7, 7) of log scale, gravity (m/s2, world frame), accelerometer bias (m/s2).
    chi2, dof
        Of the fit, against the noise it assumed.
    excitation_m_s2
        Standard deviation of the camera's acceleration: what the scale rests on.
    method
        ``"spectral"`` or ``"joint"``.
    """

    metres_per_unit: float | None
    sigma_log: float | None
    ci95: tuple[float, float] | None
    verdict: Verdict
    method: str
    reasons: tuple[str, ...] = ()
    gravity_in_world_m_s2: Array | None = None
    accel_bias_m_s2: Array | None = None
    calibration: CameraImuCalibration | None = None
    cov: Array | None = None
    chi2: float | None = None
    dof: int | None = None
    excitation_m_s2: float | None = None
    runtime_s: float = field(default=0.0)

    def __post_init__(self) -> None:
        numbers = (self.metres_per_unit, self.sigma_log, self.ci95)
        if (self.verdict == "refused") != (self.metres_per_unit is None) or len({n is None for n in numbers}) > 1:
            raise ValueError("a refused scale has no number, and no other scale lacks one")
        if self.verdict == "refused" and not self.reasons:
            raise ValueError("a refusal needs a reason")
        if self.metres_per_unit is not None and not self.metres_per_unit > 0:
            raise ValueError("metres_per_unit must be positive")
        for name, shape in (("gravity_in_world_m_s2", (3,)), ("accel_bias_m_s2", (3,))):
            if getattr(self, name) is not None:
                _set(self, **{name: _array(name, getattr(self, name), shape)})
        if self.cov is not None:
            _set(self, cov=_covariance("cov", self.cov, (7, 7)))

    def as_json(self) -> dict[str, object]:
        """The estimate in JSON types; ``None`` where a refusal has no number."""

        def plain(value: Array | None) -> object:
            return None if value is None else value.tolist()

        calibration = self.calibration
        return {
            "metres_per_unit": self.metres_per_unit,
            "ci95": None if self.ci95 is None else list(self.ci95),
            "sigma_log": self.sigma_log,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "gravity_in_world_m_s2": plain(self.gravity_in_world_m_s2),
            "accel_bias_m_s2": plain(self.accel_bias_m_s2),
            "gyro_bias_rad_s": plain(None if calibration is None else calibration.gyro_bias_rad_s),
            "cam_from_imu_xyzw": plain(None if calibration is None else calibration.cam_from_imu_xyzw),
            "imu_in_cam_m": plain(None if calibration is None else calibration.imu_in_cam_m),
            "gyro_time_offset_s": None if calibration is None else calibration.gyro_time_offset_s,
            "accel_time_offset_s": None if calibration is None else calibration.accel_time_offset_s,
            "readout_s": None if calibration is None else calibration.readout_s,
            "cov": plain(self.cov),
            "chi2": self.chi2,
            "dof": self.dof,
            "excitation_m_s2": self.excitation_m_s2,
            "method": self.method,
            "runtime_s": self.runtime_s,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Similarity:
    """``x_target = scale * R x_source + translation``.

    Attributes
    ----------
    scale
        Target units (metres) per source unit.
    rotation_xyzw
        (4,) ``target_from_source``.
    translation_m
        (3,).
    cov
        (7, 7) of log scale, rotation (rad, target frame, left), translation (m).
    provenance
        Where it comes from, in words.
    """

    scale: float
    rotation_xyzw: Array
    translation_m: Array
    cov: Array
    provenance: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError("scale must be positive")
        _set(
            self,
            rotation_xyzw=_quaternions("rotation_xyzw", self.rotation_xyzw, (4,)),
            translation_m=_array("translation_m", self.translation_m, (3,)),
            cov=_covariance("cov", self.cov, (7, 7)),
        )

    @classmethod
    def from_scale(
        cls, estimate: ScaleEstimate, *, world: WorldAxes = "z-up", provenance: str = ""
    ) -> Similarity:
        """The similarity that makes a model metric with gravity along the chosen axis; origin kept.

        Raises
        ------
        NotObservableError
            When the scale was refused.
        """
        from colmap_inertial.geometry import matrix_from_quat, rotation_between, skew

        if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
            raise NotObservableError("scale", "; ".join(estimate.reasons))
        down = DOWN_IN_WORLD[world]
        gravity = estimate.gravity_in_world_m_s2
        rotation = rotation_between(gravity, down)
        cov = np.zeros((7, 7))
        if estimate.cov is not None:
            # A change of gravity dg turns the target frame by R (g x dg) / |g|^2; heading is free and carries none.
            jacobian = np.zeros((4, 4))
            jacobian[0, 0] = 1.0
            jacobian[1:, 1:] = matrix_from_quat(rotation) @ skew(gravity) / (gravity @ gravity)
            cov[:4, :4] = jacobian @ estimate.cov[:4, :4] @ jacobian.T
        return cls(
            scale=estimate.metres_per_unit,
            rotation_xyzw=rotation,
            translation_m=np.zeros(3),
            cov=0.5 * (cov + cov.T),
            provenance=provenance,
        )


__all__ = [
    "CALIBRATION_PARAMETERS",
    "DOWN_IN_WORLD",
    "Array",
    "CameraImuCalibration",
    "CameraModel",
    "CameraTrajectory",
    "Frame",
    "FrameTiming",
    "ImuNoise",
    "ImuRecording",
    "LengthUnit",
    "Projector",
    "ReadoutDirection",
    "ScaleEstimate",
    "Similarity",
    "SmoothedTrajectory",
    "Verdict",
    "WorldAxes",
    "clock_shift_s",
]
