"""Measurements, assumptions and parameters of the refinement, and their columns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Int64Array
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.core.types import CameraModel, ImuNoise
from colmap_inertial.inertial.core.preintegration import SensorStreams

# Columns of a frame's state. The first six are its pose, the first nine what its observations depend on.
THETA, POSITION, VELOCITY, GYRO_BIAS, ACCEL_BIAS = (slice(3 * i, 3 * i + 3) for i in range(5))
N_POSE, N_SEEN, N_STATE = 6, 9, 15

# Columns of what all frames share; the free numbers of the cameras stand between what observations see and the rest.
ROTATION, LEVER, OFFSET, CLOCK_RATE, READOUT = slice(0, 3), slice(3, 6), 6, 7, 8
FIRST_INTRINSIC = 9

# Fields of ImuNoise that a refinement estimates: the sensors' white noise.
ACCEL_DENSITY, GYRO_DENSITY = "accel_density_m_s2_rthz", "gyro_density_rad_s_rthz"


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of the shared parameters, which follow those of the cameras."""

    intrinsics: int

    @property
    def seen(self) -> slice:
        """Parameters of observations where all lines are exposed at once."""
        return slice(0, FIRST_INTRINSIC + self.intrinsics)

    @property
    def gyro_gain(self) -> slice:
        """Nine gains and axis errors of the gyroscope, row by row; observations of a rolling shutter see them, too."""
        return slice(self.seen.stop, self.seen.stop + 9)

    @property
    def accel_gain(self) -> slice:
        """The same of the accelerometer."""
        return slice(self.gyro_gain.stop, self.gyro_gain.stop + 9)

    @property
    def accel_delay(self) -> int:
        """The accelerometer's delay beyond the gyroscope's."""
        return self.accel_gain.stop

    @property
    def gravity(self) -> int:
        """The strength of gravity."""
        return self.accel_delay + 1

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.gravity + 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Observations:
    """Observations, ordered by point.

    Attributes
    ----------
    frame, point
        (M,) which frame sees which point; the points' numbers rise by at most one from one to the next.
    xy_px
        (M, 2) in the image as it was exposed.
    line
        (M,) how much later than the middle line its own was exposed, in readouts: from -.5 to .5.
    """

    frame: Int64Array
    point: Int64Array
    xy_px: Array
    line: Array

    @cached_property
    def first(self) -> Int64Array:
        """(P + 1,) the first observation of each point."""
        return np.searchsorted(self.point, np.arange(self.point[-1] + 2)).astype(np.int64)

    def select(self, keep: BoolArray) -> Observations:
        """Those of a mask; the points keep their numbers."""
        return replace(
            self, frame=self.frame[keep], point=self.point[keep], xy_px=self.xy_px[keep], line=self.line[keep]
        )

    def with_row_for_each_point(self) -> Observations:
        """With one more, of the first frame that sees it, after those of each point."""
        ends, firsts = self.first[1:], self.first[:-1]
        return Observations(
            frame=np.insert(self.frame, ends, self.frame[firsts]),
            point=np.insert(self.point, ends, self.point[firsts]),
            xy_px=np.insert(self.xy_px, ends, 0.0, axis=0),
            line=np.insert(self.line, ends, 0.0),
        )

    def select_points(self, kept: BoolArray) -> Observations:
        """Those of a mask of points, which are numbered anew."""
        mine = kept[self.point]
        return replace(self.select(mine), point=np.cumsum(kept)[self.point[mine]] - 1)


#: Standard deviation of the logarithm of a point's distance beforehand: COLMAP's points are seen under 1.5 degrees or
#: more, a tenth or better, so that only false ones notice, which would go to infinity for ever.
DISTANCE_SIGMA_LOG = 2.0
#: Longest step of such a logarithm.
_LONGEST_LOG = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Distances:
    """What is known beforehand of how far points are from a camera that sees them.

    Attributes
    ----------
    camera_in_world_m
        (P, 3) where that camera was at first.
    distance_m
        (P,) from there.
    """

    camera_in_world_m: Array
    distance_m: Array

    def select_points(self, kept: BoolArray) -> Distances:
        """Those of a mask of points."""
        return Distances(camera_in_world_m=self.camera_in_world_m[kept], distance_m=self.distance_m[kept])

    def residuals(self, points_m: Array) -> tuple[Array, Array]:
        """(P,) residuals of points (P, 3), over their standard deviation, and (P, 3) derivatives."""
        away = points_m - self.camera_in_world_m
        far_m = np.linalg.norm(away, axis=1)
        by_point = away / (DISTANCE_SIGMA_LOG * far_m**2)[:, None]
        return np.log(far_m / self.distance_m) / DISTANCE_SIGMA_LOG, by_point

    def after(self, points_m: Array, step_m: Array) -> Array:
        """Points (P, 3) after steps (P, 3): along rays by the distance's logarithm, so that none turns up behind."""
        away = points_m - self.camera_in_world_m
        far_m = np.linalg.norm(away, axis=1, keepdims=True)
        along = np.sum(step_m * away, axis=1, keepdims=True) / far_m**2
        turned = away + step_m - along * away
        turned *= far_m / np.linalg.norm(turned, axis=1, keepdims=True)
        return np.asarray(self.camera_in_world_m + np.exp(np.clip(along, -_LONGEST_LOG, _LONGEST_LOG)) * turned)


@dataclass(frozen=True, eq=False, kw_only=True)
class Turning:
    """Rotation and acceleration of each frame's IMU around the instant of its state.

    Attributes
    ----------
    powers
        (F, 5, 3) of the reading's rotation vector, by the powers 1 to 5 of the seconds since then.
    force_m_s2
        (F, 3) mean reading of the accelerometer.
    half_span_s
        How long before and after these instants.
    """

    powers: Array
    force_m_s2: Array
    half_span_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Inertial:
    """Inertial measurements of F frames, in order of time.

    Attributes
    ----------
    nodes_s
        (F,) the states' instants on the clock of ``streams``.
    linked
        (F - 1,) whether the IMU recorded what lies between a frame and the next.
    streams
        The readings.
    noise
        Densities and walks.
    turning
        What happens around the instants.
    down
        (3,) unit vector of gravity in the world.
    """

    nodes_s: Array
    linked: BoolArray
    streams: SensorStreams
    noise: ImuNoise
    turning: Turning
    down: Array

    @property
    def touched(self) -> BoolArray:
        """(F,) which frames it links to another."""
        return np.append(self.linked, False) | np.append(False, self.linked)

    @property
    def middle_s(self) -> float:
        """Reference time of the clock rate."""
        return 0.5 * float(self.nodes_s[0] + self.nodes_s[-1])


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeCamera:
    """A camera's intrinsics, and which of them are estimated.

    Attributes
    ----------
    model
        Where they start.
    free
        Places of those that are estimated.
    """

    model: CameraModel
    free: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """A point of the parameter space: F states, P points, and what all share.

    Attributes
    ----------
    world_from_imu, imu_in_world_m, velocity_m_s, gyro_bias_rad_s, accel_bias_m_s2
        (F, 3, 3), (F, 3) ... at the frames' nodes.
    points_m
        (P, 3).
    cam_from_imu, imu_in_cam_m
        (3, 3), (3,).
    offset_s
        Of the IMU's stamps beyond the first guess: a node is that much later on the camera's clock.
    clock_rate
        Growth of that offset per second, about ``Inertial.middle_s``.
    readout_s
        Of the rolling shutter.
    intrinsics
        (n,) free numbers of the cameras, one camera after the other.
    accel_delay_s
        Added to the accelerometer's times.
    gyro_gain, accel_gain
        (3, 3) errors E: ``rate = (I + E) reading - bias``.
    gravity_m_s2
        Its strength.
    """

    world_from_imu: Array
    imu_in_world_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    points_m: Array
    cam_from_imu: Array
    imu_in_cam_m: Array
    offset_s: float
    clock_rate: float
    readout_s: float
    intrinsics: Array
    accel_delay_s: float
    gyro_gain: Array
    accel_gain: Array
    gravity_m_s2: float

    @property
    def columns(self) -> Columns:
        """Columns of the shared parameters."""
        return Columns(intrinsics=len(self.intrinsics))

    def moved(self, states: Array, shared: Array, points: Array) -> Estimate:
        """After a step of the states (F, 15), the shared numbers and the points (P, 3).

        Rotations of states change on the right (body frame), that of the camera on the left (camera frame).
        """
        at = self.columns
        return replace(
            self,
            world_from_imu=self.world_from_imu @ so3_exp(states[:, THETA]),
            imu_in_world_m=self.imu_in_world_m + states[:, POSITION],
            velocity_m_s=self.velocity_m_s + states[:, VELOCITY],
            gyro_bias_rad_s=self.gyro_bias_rad_s + states[:, GYRO_BIAS],
            accel_bias_m_s2=self.accel_bias_m_s2 + states[:, ACCEL_BIAS],
            points_m=self.points_m + points,
            cam_from_imu=so3_exp(shared[ROTATION]) @ self.cam_from_imu,
            imu_in_cam_m=self.imu_in_cam_m + shared[LEVER],
            offset_s=self.offset_s + float(shared[OFFSET]),
            clock_rate=self.clock_rate + float(shared[CLOCK_RATE]),
            readout_s=self.readout_s + float(shared[READOUT]),
            intrinsics=self.intrinsics + shared[FIRST_INTRINSIC : at.seen.stop],
            accel_delay_s=self.accel_delay_s + float(shared[at.accel_delay]),
            gyro_gain=self.gyro_gain + shared[at.gyro_gain].reshape(3, 3),
            accel_gain=self.accel_gain + shared[at.accel_gain].reshape(3, 3),
            gravity_m_s2=self.gravity_m_s2 + float(shared[at.gravity]),
        )

    def shared_numbers(self) -> Array:
        """Those that are added to, in their columns; zero where the rotation stands."""
        at = self.columns
        out = np.zeros(at.count)
        out[LEVER], out[OFFSET], out[CLOCK_RATE] = self.imu_in_cam_m, self.offset_s, self.clock_rate
        out[READOUT] = self.readout_s
        out[FIRST_INTRINSIC : at.seen.stop] = self.intrinsics
        out[at.accel_delay], out[at.gravity] = self.accel_delay_s, self.gravity_m_s2
        out[at.gyro_gain], out[at.accel_gain] = self.gyro_gain.ravel(), self.accel_gain.ravel()
        return out


@dataclass(frozen=True, eq=False, kw_only=True)
class Prior:
    """Normal priors.

    Attributes
    ----------
    mean
        Where the shared numbers are expected; of the states, the first biases, the first pose, which is held, and the
        other poses, which nearly nothing holds.
    info
        (Q, Q) information of the shared numbers.
    gyro_bias_sigma_rad_s, accel_bias_sigma_m_s2
        Of the first state's.
    """

    mean: Estimate
    info: Array
    gyro_bias_sigma_rad_s: float
    accel_bias_sigma_m_s2: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """All that the refinement is given.

    Attributes
    ----------
    observations
        Of the points.
    cameras, camera_of
        The cameras, and (F,) that of each frame.
    inertial
        What the IMU says; ``None`` where images alone shall tell (all lines exposed at once).
    prior
        What is known beforehand.
    sigma_px
        What an observation's errors would be divided by, each coordinate, if they were independent.
    robust_px
        Scale of Cauchy's loss: of an error this long half the weight is left.
    informs
        What observations tell, over what their weights in the loss say that they do: for covariances.
    shared_errors
        Variance of a frame's pose by its observations, over what independent errors would make of it.
    distances
        Of the points; ``None`` where nothing is known of them.
    """

    observations: Observations
    cameras: tuple[FreeCamera, ...]
    camera_of: Int64Array
    inertial: Inertial | None
    prior: Prior
    sigma_px: float
    robust_px: float = 1.0
    informs: float = 1.0
    shared_errors: float = 1.0
    distances: Distances | None = None

    @property
    def weighed_px(self) -> float:
        """What errors of observations are divided by, where those of one frame are partly the same."""
        return self.sigma_px * float(np.sqrt(self.shared_errors))

    @property
    def rows(self) -> Observations:
        """The observations, and after those of each point a row for its distance."""
        return self.observations if self.distances is None else self.observations.with_row_for_each_point()
