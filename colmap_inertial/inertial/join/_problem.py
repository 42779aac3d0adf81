"""The unknowns of a placement, and the IMU between two nodes by what they are thought to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.preintegration import (
    Preintegrated,
    SensorErrors,
    SensorStreams,
    preintegrate,
)
from colmap_inertial.inertial.join.values import Link, Part, SharedImages
from colmap_inertial.inertial.scale import posterior as post
from colmap_inertial.inertial.scale.posterior import Posterior


@dataclass(frozen=True, eq=False, kw_only=True)
class Ties:
    """All that ties parts together.

    Attributes
    ----------
    links, shared
        Between which nodes and images.
    streams
        Readings by the stamps of the gyroscope, the accelerometer's own delay left to the parts.
    """

    links: tuple[Link, ...]
    shared: tuple[SharedImages, ...]
    streams: SensorStreams

    @classmethod
    def of(cls, imu: ImuRecording, links: Sequence[Link], shared: Sequence[SharedImages]) -> Ties:
        """Of a recording as it was read."""
        streams = SensorStreams.from_recording(imu, imu.gyro_t_s, imu.accel_t_s)
        return cls(links=tuple(links), shared=tuple(shared), streams=streams)


class Problem:
    """Parts and ties, linearised about where the parts are."""

    def __init__(self, parts: Sequence[Part], ties: Ties, held: int) -> None:
        self.parts, self.ties, self.held = parts, ties, held
        used: list[set[int]] = [{0, len(part.path.nodes_s) - 1} for part in parts]
        for link in ties.links:
            used[link.first].add(link.from_node)
            used[link.second].add(link.to_node)
        self.nodes = [np.array(sorted(one), dtype=np.int64) for one in used]
        self.known = [part.path.at(nodes) for part, nodes in zip(parts, self.nodes, strict=True)]
        sizes = [post.NODE * len(nodes) + post.OWN for nodes in self.nodes]
        self.begin = np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist()
        self.shared = int(self.begin[-1])
        self.placed = self.shared + post.SHARED
        self.size = self.placed + 6 * len(parts)
        # what the parts' own estimates of the device differ by from the held part's
        self.apart = [_device_offset(one, self.known[held]) for one in self.known]
        self.info = [_information(one.cov) for one in self.known]

    def own(self, k: int) -> int:
        """The first column of what part k has for itself beside its nodes."""
        return int(self.begin[k + 1]) - post.OWN

    def node(self, k: int, node: int) -> tuple[int, int]:
        """A node's place among those used, and its first column."""
        i = int(np.searchsorted(self.nodes[k], node))
        return i, int(self.begin[k]) + post.NODE * i

    def place(self, k: int) -> slice:
        """Columns of part k's rotation and translation."""
        return slice(self.placed + 6 * k, self.placed + 6 * k + 6)


@dataclass(frozen=True, eq=False, kw_only=True)
class At:
    """Where the unknowns are: changes ``y`` from what the parts say, rotations (K, 3, 3) and translations (K, 3)."""

    y: Array
    rotation: Array
    translation_m: Array


@dataclass(eq=False, kw_only=True)
class Equations:
    """Normal equations as they grow, and the sum of squares over variances."""

    matrix: Array
    gradient: Array
    squares: float = 0.0

    def add(self, residual: Array, columns: Int64Array, by: Array) -> None:
        """Residuals over their standard deviations, with derivatives by some columns."""
        self.matrix[np.ix_(columns, columns)] += by.T @ by
        self.gradient[columns] += by.T @ residual
        self.squares += float(residual @ residual)

    def add_normal(self, away: Array, columns: Int64Array, info: Array, sign: float = 1.0) -> None:
        """A normal distribution over some columns; with a sign of -1, one that is in there twice."""
        self.matrix[np.ix_(columns, columns)] += sign * info
        self.gradient[columns] += sign * (info @ away)
        self.squares += sign * float(away @ info @ away)


def columns_of(columns: slice) -> Int64Array:
    return np.arange(columns.start, columns.stop)


def _information(cov: Array) -> Array:
    """The inverse of a covariance; rounding must not make a direction certain."""
    sigma = np.sqrt(np.diagonal(cov))
    return np.asarray(np.linalg.inv(cov + 1e-9 * np.diag(sigma**2)), dtype=np.float64)


def _device_offset(one: Posterior, other: Posterior) -> Array:
    """(25,) what one part has of the device, less what another one has."""
    out = np.zeros(post.SHARED)
    out[post.ACCEL_DELAY] = one.accel_delay_s - other.accel_delay_s
    out[post.GYRO_GAIN] = (one.gyro_gain - other.gyro_gain).ravel()
    out[post.ACCEL_GAIN] = (one.accel_gain - other.accel_gain).ravel()
    out[post.ROTATION] = so3_log(one.cam_from_imu @ other.cam_from_imu.T)
    out[post.LEVER] = one.imu_in_cam_m - other.imu_in_cam_m
    return out


@dataclass(frozen=True, eq=False, kw_only=True)
class End:
    """A node in the common world."""

    world_from_imu: Array
    imu_in_world_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    stamp_s: float

    @classmethod
    def of(cls, problem: Problem, at: At, k: int, node: int) -> End:
        known, (i, column) = problem.known[k], problem.node(k, node)
        y, own = at.y[column : column + post.NODE], problem.own(k)
        turn, later = at.rotation[k], at.y[own + post.DELAY] + known.since_middle_s[i] * at.y[own + post.CLOCK_RATE]
        return cls(
            world_from_imu=turn @ known.world_from_imu[i] @ so3_exp(y[post.THETA]),
            imu_in_world_m=turn @ (known.imu_in_world_m[i] + y[post.POSITION]) + at.translation_m[k],
            velocity_m_s=turn @ (known.velocity_m_s[i] + y[post.VELOCITY]),
            gyro_bias_rad_s=known.gyro_bias_rad_s[i] + y[post.GYRO_BIAS],
            accel_bias_m_s2=known.accel_bias_m_s2[i] + y[post.ACCEL_BIAS],
            stamp_s=float(known.stamp_s[i] - later),
        )


def gravity_of(problem: Problem, at: At, k: int) -> Array:
    """(3,) a part's gravity in the common world."""
    own = problem.own(k)
    change = at.y[own + post.GRAVITY.start : own + post.GRAVITY.stop]
    return np.asarray(at.rotation[k] @ (problem.known[k].gravity_m_s2 + change))


def accel_gain_of(problem: Problem, at: At) -> Array:
    """(3, 3) the device's, as it is thought of now."""
    change = at.y[problem.shared : problem.placed][post.ACCEL_GAIN]
    return np.asarray(problem.known[problem.held].accel_gain + change.reshape(3, 3))


def felt_between(problem: Problem, at: At, begin: End, end: End) -> Preintegrated:
    """What the IMU felt, by the device as it is thought of now."""
    reference, y = problem.known[problem.held], at.y[problem.shared : problem.placed]
    errors = SensorErrors(
        gyro_bias_rad_s=0.5 * (begin.gyro_bias_rad_s + end.gyro_bias_rad_s)[None],
        accel_bias_m_s2=0.5 * (begin.accel_bias_m_s2 + end.accel_bias_m_s2)[None],
        gyro_gain=reference.gyro_gain + y[post.GYRO_GAIN].reshape(3, 3),
        accel_gain=accel_gain_of(problem, at),
        accel_delay_s=reference.accel_delay_s + float(y[post.ACCEL_DELAY]),
    )
    return preintegrate(np.array([begin.stamp_s, end.stamp_s]), problem.ties.streams, errors)


def inertial_states(problem: Problem, at: At, begin: End, end: End) -> par.InertialStates:
    """Two nodes as the factor of the IMU between them takes them."""
    return par.InertialStates(
        world_from_imu=np.stack([begin.world_from_imu, end.world_from_imu]),
        imu_in_world_m=np.stack([begin.imu_in_world_m, end.imu_in_world_m]),
        velocity_m_s=np.stack([begin.velocity_m_s, end.velocity_m_s]),
        gravity_m_s2=gravity_of(problem, at, problem.held),
        accel_gain=accel_gain_of(problem, at),
    )
