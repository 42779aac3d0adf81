"""Estimates with their covariance: smoothed trajectory, scale, similarity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, check_field, check_fields, check_increasing, set_fields
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact, as_fact, with_sentences
from colmap_inertial.core.geometry import matrix_from_quat, rotation_between, skew
from colmap_inertial.core.options import WorldAxes
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types.consensus import RotationConsensus
from colmap_inertial.core.types.evidence import CombinedScale, Verdict
from colmap_inertial.core.types.imu import CameraImuCalibration, ImuCalibration, ImuNoise
from colmap_inertial.core.types.recorded import LengthUnit, ReadoutDirection

#: The direction of gravity in a metric world with these axes: ``y-down`` is COLMAP's and computer vision's habit.
DOWN_IN_WORLD = {"z-up": np.array([0.0, 0.0, -1.0]), "y-down": np.array([0.0, 1.0, 0.0])}


@prints_in_lines
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
        vectors = dict.fromkeys(("cam_in_world", "velocity_in_world", "accel_in_world"), ("T", 3))
        check_fields(self, t_s=("T",), **vectors, cam_from_world_xyzw=("T", 4), cov=("T", 9, 9))


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleDrift:
    """Scales of parts of a recording against the scale of the whole, and whether they are the same.

    Attributes
    ----------
    begin_s, end_s
        (W,) the parts, camera clock, seconds since the trajectory's epoch.
    log_ratio
        (W,) logarithm of the part's scale over the whole one's.
    sigma_log
        (W,) its standard deviation.
    chi2, dof, p_value
        Test of equal scales, small differences tolerated: how probable it would be to see as much by chance.
    trend_log_per_s, trend_sigma_log_per_s
        Steady growth of the logarithm of the scale, and its standard deviation.
    """

    begin_s: Array
    end_s: Array
    log_ratio: Array
    sigma_log: Array
    chi2: float
    dof: int
    p_value: float
    trend_log_per_s: float
    trend_sigma_log_per_s: float

    def __post_init__(self) -> None:
        check_fields(self, begin_s=("W",), end_s=("W",), log_ratio=("W",), sigma_log=("W",))
        check_increasing("begin_s", self.begin_s)

    def as_json(self, metres_per_unit: float | None) -> dict[str, object]:
        """The fields in JSON types; scales of the parts where the whole one is given."""
        parts = []
        for begin_s, end_s, log_ratio, sigma in zip(
            self.begin_s.tolist(), self.end_s.tolist(), self.log_ratio.tolist(), self.sigma_log.tolist(), strict=True
        ):
            # clipped: of a part that tells nothing, it may be anything
            scale = None if metres_per_unit is None else metres_per_unit * math.exp(min(max(log_ratio, -600.0), 600.0))
            parts.append({"begin_s": begin_s, "end_s": end_s, "metres_per_unit": scale, "sigma_log": sigma})
        return {
            "parts": parts,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "trend_log_per_s": self.trend_log_per_s,
            "trend_sigma_log_per_s": self.trend_sigma_log_per_s,
        }


#: What a scale's JSON says of the calibration, in this order, and where there is none.
_CALIBRATED: dict[str, float | None] = {
    "gyro_bias_rad_s": None,
    "cam_from_imu_xyzw": None,
    "imu_in_cam_m": None,
    "gyro_time_offset_s": None,
    "accel_time_offset_s": None,
    "clock_rate": 0.0,
    "clock_middle_s": 0.0,
    "readout_s": None,
}


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class AcceptedScale:
    """The numbers of a scale that was not refused.

    Attributes
    ----------
    metres_per_unit
        Metres per model unit.
    sigma_log
        Standard deviation of its logarithm.
    ci95
        Its 95 % interval.
    """

    metres_per_unit: float
    sigma_log: float
    ci95: tuple[float, float]


@prints_in_lines
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
        What to make of it, and what decided that.
    notes
        What else the user should know: repairs, pauses, clocks; none of it decided the verdict.
    gravity_in_world_m_s2
        (3,) points down, in the source model's frame; ``None`` where it could not be estimated.
    accel_bias_m_s2
        (3,) IMU frame; the true specific force is the reading minus this.
    calibration
        The camera-IMU calibration that the estimate refined.
    imu_calibration
        The IMU's own, by which the readings were corrected; ``None`` where they are as the sensor read.
    cov
        (7, 7) of log scale, gravity (m/s2, world frame), accelerometer bias (m/s2).
    chi2, dof
        Of the fit, against the noise it assumed.
    excitation_m_s2
        Standard deviation of the camera's acceleration: what the scale rests on.
    drift
        Whether the scale stays the same along the recording; ``None`` where the method does not tell.
    parts
        By cause (``scale.verdict.CAUSES``), the standard deviation of the logarithm that it alone would leave; their
        squares add up to that of ``sigma_log``. ``None`` where the method does not tell.
    noise
        Of the IMU, as the fit found it in the recording; ``None`` where the method does not tell.
    rotations
        Which cameras agree with the IMU; the estimate rests on those. ``None`` where they were not compared.
    jumped
        Keyframes whose positions may be wrong, as they count little, or as the path jumps there.
    method
        ``"spectral"`` or ``"joint"``; ``"none"`` where nothing could be estimated.
    sensors
        What each sensor says; the scale is then that of all together. ``None`` where the IMU alone was asked.
    """

    metres_per_unit: float | None
    sigma_log: float | None
    ci95: tuple[float, float] | None
    verdict: Verdict
    method: str
    reasons: tuple[Fact, ...] = ()
    gravity_in_world_m_s2: Array | None = None
    accel_bias_m_s2: Array | None = None
    calibration: CameraImuCalibration | None = None
    imu_calibration: ImuCalibration | None = None
    cov: Array | None = None
    chi2: float | None = None
    dof: int | None = None
    excitation_m_s2: float | None = None
    drift: ScaleDrift | None = None
    parts: Mapping[str, float] | None = None
    noise: ImuNoise | None = None
    rotations: RotationConsensus | None = None
    jumped: tuple[str, ...] = ()
    sensors: CombinedScale | None = None
    runtime_s: float = 0.0
    notes: tuple[Fact, ...] = ()

    def __post_init__(self) -> None:
        set_fields(self, reasons=tuple(map(as_fact, self.reasons)), notes=tuple(map(as_fact, self.notes)))
        numbers = (self.metres_per_unit, self.sigma_log, self.ci95)
        if (self.verdict == "refused") != (self.metres_per_unit is None) or len({n is None for n in numbers}) > 1:
            raise ValueError("a refused scale has no number, and no other scale lacks one")
        if self.verdict == "refused" and not self.reasons:
            raise ValueError("a refusal needs a reason")
        if self.metres_per_unit is not None and not self.metres_per_unit > 0:
            raise ValueError("metres_per_unit must be positive")
        check_fields(self, gravity_in_world_m_s2=(3,), accel_bias_m_s2=(3,), cov=(7, 7))

    @classmethod
    def refused(cls, method: str, *reasons: Fact, calibration: CameraImuCalibration | None = None) -> ScaleEstimate:
        """No scale, for these reasons."""
        return cls(
            metres_per_unit=None,
            sigma_log=None,
            ci95=None,
            verdict="refused",
            method=method,
            reasons=reasons,
            calibration=calibration,
        )

    @property
    def accepted(self) -> AcceptedScale:
        """The numbers, which a scale that was not refused has.

        Raises
        ------
        NotObservableError
            When it was refused.
        """
        if self.metres_per_unit is None or self.sigma_log is None or self.ci95 is None:
            raise NotObservableError("scale", Fact("scale-refused", reasons=self.reasons))
        return AcceptedScale(metres_per_unit=self.metres_per_unit, sigma_log=self.sigma_log, ci95=self.ci95)

    def as_json(self) -> dict[str, object]:
        """The estimate in JSON types; ``None`` where a refusal has no number."""

        def plain(value: object) -> object:
            return value.tolist() if isinstance(value, np.ndarray) else value

        return {
            "metres_per_unit": self.metres_per_unit,
            "ci95": None if self.ci95 is None else list(self.ci95),
            "sigma_log": self.sigma_log,
            "verdict": self.verdict,
            **with_sentences({"reasons": list(self.reasons), "notes": list(self.notes)}),
            "gravity_in_world_m_s2": plain(self.gravity_in_world_m_s2),
            "accel_bias_m_s2": plain(self.accel_bias_m_s2),
            # where camera and IMU could not be brought together, these are unknown
            **{name: plain(getattr(self.calibration, name, unknown)) for name, unknown in _CALIBRATED.items()},
            "imu_calibration": None if self.imu_calibration is None else self.imu_calibration.summary(),
            "cov": plain(self.cov),
            "chi2": self.chi2,
            "dof": self.dof,
            "excitation_m_s2": self.excitation_m_s2,
            "drift": None if self.drift is None else self.drift.as_json(self.metres_per_unit),
            "parts": None if self.parts is None else dict(self.parts),
            "rotations": None if self.rotations is None else self.rotations.as_json(),
            "sensors": None if self.sensors is None else self.sensors.as_json(),
            "method": self.method,
            "runtime_s": self.runtime_s,
        }


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Similarity:
    """``x_target = scale * R x_source + translation``.

    Attributes
    ----------
    scale
        Target units (metres) per source unit.
    rotation_xyzw, translation_m
        (4,) ``target_from_source``, and (3,).
    cov
        (7, 7) of log scale, rotation (rad, target frame, left), translation (m).
    provenance
        Where it comes from, in words.
    undoes
        The provenance of the similarity that this one takes back; ``None`` where it takes none back.
    """

    scale: float
    rotation_xyzw: Array
    translation_m: Array
    cov: Array
    provenance: str = ""
    undoes: str | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError("scale must be positive")
        check_fields(self, rotation_xyzw=(4,), translation_m=(3,), cov=(7, 7))

    @classmethod
    def from_scale(cls, estimate: ScaleEstimate, *, world: WorldAxes = "z-up", provenance: str = "") -> Similarity:
        """The similarity that makes a model metric with gravity along the chosen axis; origin kept.

        Raises
        ------
        NotObservableError
            When the scale was refused.
        """
        if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
            raise NotObservableError("scale", Fact("scale-refused", reasons=estimate.reasons))
        down = DOWN_IN_WORLD[world]
        gravity = estimate.gravity_in_world_m_s2
        rotation = rotation_between(gravity, down)
        cov = np.zeros((7, 7))
        if estimate.cov is not None:
            # A change of gravity dg turns the target frame by -R (g x dg) / |g|^2; heading is free and carries none.
            jacobian = np.zeros((4, 4))
            jacobian[0, 0] = 1.0
            jacobian[1:, 1:] = -matrix_from_quat(rotation) @ skew(gravity) / (gravity @ gravity)
            cov[:4, :4] = jacobian @ estimate.cov[:4, :4] @ jacobian.T
        return cls(
            scale=estimate.metres_per_unit,
            rotation_xyzw=rotation,
            translation_m=np.zeros(3),
            cov=0.5 * (cov + cov.T),
            provenance=provenance,
        )


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class Gap:
    """The gap between two sub-models, and whether they were joined across it.

    Attributes
    ----------
    first, second
        COLMAP's numbers, the earlier one first.
    seconds
        From the last image before it to the first one after it; below zero where the two overlap in time.
    shared_images
        How many images of both say where one lies in the other.
    matched_images
        How many images of one matches place in the other, in agreement with the IMU.
    sigma_m, sigma_deg
        Standard deviations of position and direction of the first image after it as seen from the last one before it,
        along the direction that is known worst; ``None`` where they were not found.
    chi2, dof
        How the IMU and shared images contradict the velocities, directions of gravity and scales of the two: sum of
        squares over variances, and what chance makes of it.
    joined, reason
        Whether they are one model, and why not.
    """

    first: int
    second: int
    seconds: float
    shared_images: int = 0
    matched_images: int = 0
    sigma_m: float | None = None
    sigma_deg: float | None = None
    chi2: float | None = None
    dof: int | None = None
    joined: bool
    reason: Fact

    def __post_init__(self) -> None:
        set_fields(self, reason=as_fact(self.reason))
        if not math.isfinite(self.seconds):
            raise ValueError("a gap's length must be finite")
        if self.joined and (self.sigma_m is None or self.sigma_deg is None):
            raise ValueError("what is joined has standard deviations")


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinedPart:
    """A sub-model within a joined one.

    Attributes
    ----------
    colmap_index
        COLMAP's number; the next free one of a part that was torn off a model.
    images
        How many it has.
    begin_s, end_s
        First and last image, camera clock.
    verdict, sigma_log
        Of its own scale, and the standard deviation of the logarithm of its scale once joined.
    similarity
        From COLMAP's sub-model to the joined one.
    sigma_m, sigma_deg
        Of its middle against the largest part, along the direction that is known worst: gaps, and what its own scale
        and direction leave open; 0 for the largest part itself.
    """

    colmap_index: int
    images: int
    begin_s: float
    end_s: float
    verdict: Verdict
    sigma_log: float
    similarity: Similarity
    sigma_m: float
    sigma_deg: float


#: An image stands where it stood within this part of its distance from the origin, and of one unit.
_UNMOVED = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraMotion:
    """Motion of a camera during the exposure of each of its frames, and its readout time.

    Attributes
    ----------
    names
        (F,) image names, in order of time.
    t_s
        (F,) the instants that poses hold, mid-exposure of the middle row: camera clock, seconds since ``epoch_ns``.
    velocity_in_world_m_s
        (F, 3) of the camera's centre, in the world of the metric model.
    angular_velocity_in_cam_rad_s
        (F, 3) camera axes (x right, y down, z forward).
    exposure_s
        (F,) exposure times, or ``None`` where unknown.
    readout_s, readout_direction
        Of the images as they were filmed, as in :class:`FrameTiming`.
    """

    names: tuple[str, ...]
    t_s: Array
    velocity_in_world_m_s: Array
    angular_velocity_in_cam_rad_s: Array
    exposure_s: Array | None = None
    readout_s: float | None = None
    readout_direction: ReadoutDirection = "down"
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        velocities = ("velocity_in_world_m_s", "angular_velocity_in_cam_rad_s")
        # without any frame, JSON keeps no shape
        set_fields(self, **{name: np.reshape(getattr(self, name), (-1, 3)) for name in velocities})
        check_fields(self, t_s=("F",), **dict.fromkeys(velocities, ("F", 3)), exposure_s=("F",))
        if len(self.names) != len(self.t_s):
            raise ValueError("one name for each instant")
        set_fields(self, names=tuple(self.names))


@dataclass(frozen=True, eq=False, kw_only=True)
class SolvedMotion:
    """Motion of a camera from a stage that solved for poses and velocities together.

    Attributes
    ----------
    cam_in_world
        By image name, (3,) where the camera's centre was, in the model's world and units; what is said of an image
        holds as long as it stands there.
    velocity_in_world
        By image name, (3,) of the camera's centre, in units a second; of images whose velocity is known.
    cov
        By image name, (9, 9) covariance of its position against the first one's, of its velocity and of its rotation
        (world, left; the first one's heading): of all images, or of some.
    readout_s
        Of the images as they were filmed; ``None`` where it was not solved for.
    """

    cam_in_world: Mapping[str, Array]
    velocity_in_world: Mapping[str, Array]
    cov: Mapping[str, Array]
    readout_s: float | None = None

    def __post_init__(self) -> None:
        for field, shape in (("cam_in_world", (3,)), ("velocity_in_world", (3,)), ("cov", (9, 9))):
            values = {n: check_field(f"{n}: {field}", v, shape) for n, v in getattr(self, field).items()}
            set_fields(self, **{field: values})

    def of(self, names: Sequence[str], cam_in_world: Array) -> SolvedMotion:
        """The motion of these images, without those that have moved since it was solved.

        Parameters
        ----------
        names
            (F,) images.
        cam_in_world
            (F, 3) their centres now.
        """
        unmoved = set()
        for name, centre in zip(names, cam_in_world, strict=True):
            solved = self.cam_in_world.get(name)
            if solved is not None and np.linalg.norm(centre - solved) <= _UNMOVED * (1 + np.linalg.norm(solved)):
                unmoved.add(name)
        velocity, cov = ({n: v for n, v in of.items() if n in unmoved} for of in (self.velocity_in_world, self.cov))
        return replace(self, velocity_in_world=velocity, cov=cov)

    def scaled(self, factor: float) -> SolvedMotion:
        """The motion in units of which a length has ``factor`` times as many."""
        by = np.array([*(factor,) * 6, 1.0, 1.0, 1.0])
        return replace(
            self,
            cam_in_world={name: factor * centre for name, centre in self.cam_in_world.items()},
            velocity_in_world={name: factor * velocity for name, velocity in self.velocity_in_world.items()},
            cov={name: cov * np.outer(by, by) for name, cov in self.cov.items()},
        )
