"""Residuals of the refinement with derivatives: observations (each at its own line's instant), IMU, priors.

Also the camera's position and velocity at a solution, and how they depend on what is solved for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, Int64Array
from colmap_inertial.core.geometry import cross, skew, so3_exp, so3_log
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.factors import imu_group
from colmap_inertial.inertial.core.preintegration import SensorErrors, SensorStreams, preintegrate
from colmap_inertial.inertial.refine.values import (
    ACCEL_BIAS,
    ACCEL_DENSITY,
    CLOCK_RATE,
    GYRO_BIAS,
    GYRO_DENSITY,
    LEVER,
    N_SEEN,
    N_STATE,
    OFFSET,
    POSITION,
    ROTATION,
    THETA,
    VELOCITY,
    Estimate,
    FreeCamera,
    Observations,
    Problem,
    Turning,
)
from colmap_inertial.model import colmap_camera

#: Steps of the differences that the camera models are differentiated by, relative to the depth and to a number.
_STEP = 1e-6
#: Where the readings' rotation is looked up around a node, in half spans.
_KNOTS = np.array([-1.0, -0.6, -0.2, 0.2, 0.6, 1.0])


def turning_around(nodes_s: Array, streams: SensorStreams, half_span_s: float) -> Turning:
    """The readings' rotation and force within ``half_span_s`` of each node."""
    path = GyroPath(streams.gyro.t_s, streams.gyro.value, np.zeros(3))
    since_s = half_span_s * _KNOTS
    times_s = nodes_s[:, None] + since_s
    count = len(nodes_s)
    turn = path.turn_rad(np.repeat(nodes_s, len(since_s)), times_s.ravel()).reshape(count, len(since_s), 3)
    # five powers through six knots: the middle of the polynomial is zero by itself
    powers = np.linalg.pinv(_KNOTS[:, None] ** np.arange(1, 6)) @ turn
    powers = powers / half_span_s ** np.arange(1, 6)[:, None]
    force = streams.accel.at(times_s.ravel())[0].reshape(count, len(since_s), 3).mean(axis=1)
    return Turning(powers=powers, force_m_s2=force, half_span_s=half_span_s)


@dataclass(frozen=True, eq=False, kw_only=True)
class Poses:
    """Poses of the IMU at the exposure of each of N lines."""

    since_s: Array  # (N,) after the frame's node
    reading: Array  # (N, 3) rotation vector since then, by the readings
    vector: Array  # (N, 3) the same less their errors
    turn: Array  # (N, 3, 3) and as a matrix
    rate: Array  # (N, 3) at that instant, body frame
    world_from_imu: Array  # (N, 3, 3)
    imu_in_world_m: Array  # (N, 3)
    velocity_m_s: Array  # (N, 3)
    force: Array  # (N, 3) body frame at the node


def poses_at(problem: Problem, x: Estimate, frame: Int64Array, line: Array) -> Poses:
    """The IMU's poses at lines of frames: from the frame's state by the readings around it."""
    world_from_imu, position, velocity = x.world_from_imu[frame], x.imu_in_world_m[frame], x.velocity_m_s[frame]
    if problem.inertial is None:
        still = np.zeros((len(frame), 3))
        eye = np.broadcast_to(np.eye(3), world_from_imu.shape)
        return Poses(
            since_s=np.zeros(len(frame)),
            reading=still,
            vector=still,
            turn=eye,
            rate=still,
            world_from_imu=world_from_imu,
            imu_in_world_m=position,
            velocity_m_s=still,
            force=still,
        )
    turning = problem.inertial.turning
    since_s = line * x.readout_s - x.offset_s - x.clock_rate * time_since_middle_s(problem, frame)
    powers, t = turning.powers[frame], since_s[:, None]
    reading, rate = np.zeros((len(frame), 3)), np.zeros((len(frame), 3))
    for k in range(4, -1, -1):
        rate = rate * t + (k + 1) * powers[:, k]
        reading = (reading + powers[:, k]) * t
    gain = np.eye(3) + x.gyro_gain
    bias = x.gyro_bias_rad_s[frame]
    vector = reading @ gain.T - bias * t
    rate = rate @ gain.T - bias
    # the derivative of a rotation vector, seen in the body: Jr, to the second order of an angle of a few degrees
    turned = cross(vector, rate)
    rate = rate - 0.5 * turned + cross(vector, turned) / 6
    turn = so3_exp(vector)
    force = turning.force_m_s2[frame] @ (np.eye(3) + x.accel_gain).T - x.accel_bias_m_s2[frame]
    accel = np.einsum("nij,nj->ni", world_from_imu, force) + x.gravity_m_s2 * problem.inertial.down
    return Poses(
        since_s=since_s,
        reading=reading,
        vector=vector,
        turn=turn,
        rate=rate,
        world_from_imu=world_from_imu @ turn,
        imu_in_world_m=position + velocity * t + 0.5 * accel * t**2,
        velocity_m_s=velocity + accel * t,
        force=force,
    )


def time_since_middle_s(problem: Problem, frame: Int64Array) -> Array:
    """(M,) of frames' nodes, for the clock rate."""
    if problem.inertial is None:
        return np.zeros(len(frame))
    return problem.inertial.nodes_s[frame] - problem.inertial.middle_s


def camera_of(free: FreeCamera, numbers: Array) -> CameraModel:
    """The camera with other values of its free numbers."""
    params = np.array(free.model.params)
    params[list(free.free)] = numbers
    return replace(free.model, params=tuple(params))


def cameras_of(problem: Problem, x: Estimate) -> list[CameraModel]:
    """The cameras at an estimate."""
    first = np.cumsum([0, *(len(free.free) for free in problem.cameras)])
    return [camera_of(free, x.intrinsics[first[i] : first[i + 1]]) for i, free in enumerate(problem.cameras)]


def _group_by_camera(problem: Problem, observations: Observations) -> list[IndexArray]:
    """Indices of the observations of each camera."""
    if len(problem.cameras) == 1:
        return [np.arange(len(observations.frame))]
    of = problem.camera_of[observations.frame]
    return [np.flatnonzero(of == i) for i in range(len(problem.cameras))]


@dataclass(frozen=True, eq=False, kw_only=True)
class Projected:
    """M observations at an estimate, in px.

    Attributes
    ----------
    residual
        (M, 2) predicted less measured; zero where a point cannot be seen.
    seen
        (M,) whether it can be.
    in_imu, in_cam
        (M, 3) the points.
    poses, pose
        Of the IMU: of all frames, or of each observation's line; (M,) which one it is.
    """

    residual: Array
    seen: BoolArray
    in_imu: Array
    in_cam: Array
    poses: Poses
    pose: Int64Array


def project(problem: Problem, x: Estimate, observations: Observations) -> Projected:
    """Predicted image positions of the points."""
    count = len(observations.frame)
    if np.any(observations.line != 0):
        poses, pose = poses_at(problem, x, observations.frame, observations.line), np.arange(count)
    else:
        frames = np.arange(len(x.velocity_m_s))
        poses, pose = poses_at(problem, x, frames, np.zeros(len(frames))), observations.frame
    in_imu, in_cam = np.empty((count, 3)), np.empty((count, 3))
    _inertial.place_points(
        pose=pose,
        point=observations.point,
        world_from_imu=poses.world_from_imu,
        imu_in_world=poses.imu_in_world_m,
        points=x.points_m,
        cam_from_imu=x.cam_from_imu,
        imu_in_cam=x.imu_in_cam_m,
        in_imu=in_imu,
        in_cam=in_cam,
    )
    predicted = np.empty((count, 2))
    for model, mine in zip(cameras_of(problem, x), _group_by_camera(problem, observations), strict=True):
        predicted[mine] = colmap_camera(model).img_from_cam(in_cam[mine])
    seen: BoolArray = np.all(np.isfinite(predicted), axis=1)
    residual = np.where(seen[:, None], predicted - observations.xy_px, 0.0)
    return Projected(residual=residual, seen=seen, in_imu=in_imu, in_cam=in_cam, poses=poses, pose=pose)


@dataclass(frozen=True, eq=False, kw_only=True)
class Derivatives:
    """(M, 2, ...) of observations by nine numbers of the frame's state, by what is shared, and by the point."""

    by_frame: Array
    by_shared: Array
    by_point: Array


def derivatives(problem: Problem, x: Estimate, observations: Observations, at: Projected, weight: Array) -> Derivatives:
    """Derivatives of :func:`project`, px, times (M,) weights.

    What biases and the accelerometer's gains do within a readout is left out: a thousandth of a pixel.
    """
    count, poses = len(observations.frame), at.poses
    by_cam, by_intrinsics = np.zeros((count, 2, 3)), np.zeros((count, 2, len(x.intrinsics)))
    place = 0
    for free, model, mine in zip(
        problem.cameras, cameras_of(problem, x), _group_by_camera(problem, observations), strict=True
    ):
        in_cam = at.in_cam[mine]
        by_cam[mine] = _differentiate_by_direction(model, in_cam)
        for k in range(len(free.free)):
            by_intrinsics[mine, :, place + k] = _differentiate_by_number(model, free.free[k], in_cam)
        place += len(free.free)
    # beside the camera, a step of the difference may see nothing
    lost = ~at.seen | ~np.isfinite(by_cam).all(axis=(1, 2)) | ~np.isfinite(by_intrinsics).all(axis=(1, 2))
    by_cam[lost], by_intrinsics[lost] = 0.0, 0.0
    rolling = bool(np.any(observations.line != 0))
    seen = x.columns.gyro_gain.stop if rolling else x.columns.seen.stop
    by = Derivatives(
        by_frame=np.empty((count, 2, N_SEEN)), by_shared=np.empty((count, 2, seen)), by_point=np.empty((count, 2, 3))
    )
    _inertial.apply_chain_rule(
        pose=at.pose,
        since_s=poses.since_s,
        force=poses.force,
        rate=poses.rate,
        reading=poses.reading,
        vector=poses.vector,
        turn=poses.turn,
        world_from_imu=poses.world_from_imu,
        velocity=poses.velocity_m_s,
        cam_from_imu=x.cam_from_imu,
        imu_in_cam=x.imu_in_cam_m,
        in_imu=at.in_imu,
        in_cam=at.in_cam,
        by_cam=by_cam,
        by_intrinsics=by_intrinsics,
        line=observations.line,
        since_middle_s=time_since_middle_s(problem, observations.frame),
        weight=weight,
        by_frame=by.by_frame,
        by_shared=by.by_shared,
        by_point=by.by_point,
    )
    return by


def _differentiate_by_direction(model: CameraModel, in_cam: Array) -> Array:
    """(M, 2, 3) of pixels by points in the camera frame; along the ray nothing changes."""
    camera, depth = colmap_camera(model), in_cam[:, 2:]
    out = np.empty((len(in_cam), 2, 3))
    for axis in range(2):
        step = np.zeros((len(in_cam), 3))
        step[:, axis] = _STEP * depth[:, 0]
        ahead, behind = (np.asarray(camera.img_from_cam(in_cam + sign * step)) for sign in (1, -1))
        out[:, :, axis] = (ahead - behind) / (2 * _STEP * depth)
    out[:, :, 2] = -(out[:, :, 0] * in_cam[:, :1] + out[:, :, 1] * in_cam[:, 1:2]) / depth
    return out


def _differentiate_by_number(model: CameraModel, place: int, in_cam: Array) -> Array:
    """(M, 2) of pixels by one of the camera's numbers."""
    step = _STEP * max(abs(model.params[place]), 1.0)
    ends = []
    for sign in (1, -1):
        params = list(model.params)
        params[place] += sign * step
        ends.append(np.asarray(colmap_camera(replace(model, params=tuple(params))).img_from_cam(in_cam)))
    return (ends[0] - ends[1]) / (2 * step)


#: Standard deviations of the first position and heading, which nothing else determines.
_HELD_M, _HELD_RAD = 1e-5, 1e-6
#: Of every pose about where it starts: holds a frame that neither points nor the IMU hold.
_STAYS_M, _STAYS_RAD = 10.0, 1.0
#: Of a velocity that the IMU does not touch: holds a frame that the IMU did not record.
_SPEED_M_S = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows:
    """Residuals over their standard deviations, each of a state, of it and the next, and of what is shared.

    Attributes
    ----------
    residual
        (N, r).
    here, after
        (N, r, 15) derivatives by the states ``0 .. N`` and by the ones after them.
    by_shared
        (N, r, Q), or ``None`` where it is zero.
    shares
        (N, r, r) parts of the residuals' covariance that are white noise of a sensor, by the density's name in
        :class:`~colmap_inertial.core.types.ImuNoise`.
    """

    residual: Array
    here: Array
    after: Array | None = None
    by_shared: Array | None = None
    shares: Mapping[str, Array] = field(default_factory=dict)


def imu_rows(problem: Problem, x: Estimate) -> Rows:
    """Rotation, velocity, position between consecutive frames."""
    inertial = problem.inertial
    assert inertial is not None
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=x.accel_bias_m_s2[:-1],
        gyro_gain=x.gyro_gain,
        accel_gain=x.accel_gain,
        accel_delay_s=x.accel_delay_s,
    )
    pre = preintegrate(inertial.nodes_s, inertial.streams, errors)
    states = par.InertialStates(
        world_from_imu=x.world_from_imu,
        imu_in_world_m=x.imu_in_world_m,
        velocity_m_s=x.velocity_m_s,
        gravity_m_s2=x.gravity_m_s2 * inertial.down,
        accel_gain=x.accel_gain,
    )
    group = imu_group(inertial.noise, states, pre)
    assert group.after is not None and group.by_globals is not None
    at, start = x.columns, par.IMU_GLOBALS.start
    by = group.by_globals
    by_shared = np.zeros((*by.shape[:2], at.count))
    by_shared[:, :, at.gravity] = by[:, :, par.GRAVITY.start - start : par.GRAVITY.stop - start] @ inertial.down
    by_shared[:, :, at.accel_delay] = by[:, :, par.ACCEL_DELAY - start]
    for mine, theirs in ((at.gyro_gain, par.GYRO_GAIN), (at.accel_gain, par.ACCEL_GAIN)):
        by_shared[:, :, mine] = by[:, :, theirs.start - start : theirs.stop - start]
    counts = inertial.linked.astype(np.float64)[:, None]
    assert group.share is not None and group.root is not None
    turned = inertial.noise.gyro_density_rad_s_rthz * group.root
    shares = {ACCEL_DENSITY: group.share, GYRO_DENSITY: turned @ pre.cov_gyro @ turned.transpose(0, 2, 1)}
    return Rows(
        residual=group.residual * counts,
        here=group.here[:, :, :N_STATE] * counts[:, :, None],
        after=group.after[:, :, :N_STATE] * counts[:, :, None],
        by_shared=by_shared * counts[:, :, None],
        shares={name: share * counts[:, :, None] for name, share in shares.items()},
    )


def walk_rows(problem: Problem, x: Estimate) -> Rows:
    """Changes of the biases from frame to frame."""
    inertial = problem.inertial
    assert inertial is not None
    root_s = np.sqrt(np.maximum(np.diff(inertial.nodes_s), 1e-3))[:, None]
    noise, count = inertial.noise, len(root_s)
    residual, here = np.empty((count, 6)), np.zeros((count, 6, N_STATE))
    for rows, columns, values, sigma in (
        (slice(0, 3), GYRO_BIAS, x.gyro_bias_rad_s, noise.gyro_walk_rad_s2_rthz),
        (slice(3, 6), ACCEL_BIAS, x.accel_bias_m_s2, noise.accel_walk_m_s3_rthz),
    ):
        residual[:, rows] = np.diff(values, axis=0) / (sigma * root_s)
        here[:, rows, columns] = -np.eye(3) / (sigma * root_s[:, :, None])
    return Rows(residual=residual, here=here, after=-here)


def state_rows(problem: Problem, x: Estimate) -> Rows:
    """Priors of states: weak on poses and velocities; on biases, position and heading of the first one."""
    count, prior = len(x.velocity_m_s), problem.prior
    residual, here = np.zeros((count, 21)), np.zeros((count, 21, N_STATE))
    inertial = problem.inertial
    if inertial is None:  # what images do not show stays as it is
        for columns in (VELOCITY, GYRO_BIAS, ACCEL_BIAS):
            here[:, columns, columns] = np.eye(3)
        heading = np.eye(3)
        # of their scale nothing is known: the farthest frame stays as far away as it is
        away = prior.mean.imu_in_world_m - prior.mean.imu_in_world_m[0]
        far = int(np.argmax(np.sum(away**2, axis=1)))
        along = away[far] / (_HELD_M * max(float(np.linalg.norm(away[far])), 1e-12))
        residual[far, POSITION.start] = along @ (x.imu_in_world_m[far] - prior.mean.imu_in_world_m[far])
        here[far, POSITION.start, POSITION] = along
    else:
        untouched = ~inertial.touched
        residual[untouched, VELOCITY] = x.velocity_m_s[untouched] / _SPEED_M_S
        here[untouched, VELOCITY, VELOCITY] = np.eye(3) / _SPEED_M_S
        for columns, now, mean, sigma in (
            (GYRO_BIAS, x.gyro_bias_rad_s, prior.mean.gyro_bias_rad_s, prior.gyro_bias_sigma_rad_s),
            (ACCEL_BIAS, x.accel_bias_m_s2, prior.mean.accel_bias_m_s2, prior.accel_bias_sigma_m_s2),
        ):
            residual[0, columns] = (now[0] - mean[0]) / sigma
            here[0, columns, columns] = np.eye(3) / sigma
        heading = np.outer(inertial.down, inertial.down)
    residual[0, POSITION] = (x.imu_in_world_m[0] - prior.mean.imu_in_world_m[0]) / _HELD_M
    here[0, POSITION, POSITION] = np.eye(3) / _HELD_M
    turn = so3_log(prior.mean.world_from_imu.transpose(0, 2, 1) @ x.world_from_imu)
    by_turn = np.eye(3) + 0.5 * skew(turn)
    held = heading @ prior.mean.world_from_imu[0] / _HELD_RAD
    residual[0, THETA], here[0, THETA, THETA] = held @ turn[0], held @ by_turn[0]
    residual[:, 15:18] = (x.imu_in_world_m - prior.mean.imu_in_world_m) / _STAYS_M
    here[:, 15:18, POSITION] = np.eye(3) / _STAYS_M
    residual[:, 18:], here[:, 18:, THETA] = turn / _STAYS_RAD, by_turn / _STAYS_RAD
    return Rows(residual=residual, here=here)


def prior_offset(problem: Problem, x: Estimate) -> Array:
    """(Q,) shared numbers less their expected values."""
    mean = problem.prior.mean
    out = x.shared_numbers() - mean.shared_numbers()
    out[:3] = so3_log(x.cam_from_imu @ mean.cam_from_imu.T)
    return out


def all_rows(problem: Problem, x: Estimate) -> dict[str, Rows]:
    """Everything but observations and priors of shared numbers."""
    if problem.inertial is None:
        return {"states": state_rows(problem, x)}
    return {"imu": imu_rows(problem, x), "walk": walk_rows(problem, x), "states": state_rows(problem, x)}


#: Rows of :class:`Moving`.
CENTRE, SPEED, TURN = slice(0, 3), slice(3, 6), slice(6, 9)
N_MOVING = TURN.stop


@dataclass(frozen=True, eq=False, kw_only=True)
class Moving:
    """The camera when the middle lines of F frames were exposed.

    Attributes
    ----------
    velocity_m_s
        (F, 3) of its centre, in the world.
    by_state
        (F, 9, 15) derivatives of position, velocity and rotation (world, left) by the frame's own state.
    by_shared
        (F, 9, Q) by what is shared.
    """

    velocity_m_s: Array
    by_state: Array
    by_shared: Array


def moving(problem: Problem, x: Estimate) -> Moving:
    """The camera's motion; it is carried on the lever arm about the IMU."""
    count, at = len(x.velocity_m_s), x.columns
    frames = np.arange(count)
    poses = poses_at(problem, x, frames, np.zeros(count))
    t = poses.since_s[:, None, None]
    start, now, turn = x.world_from_imu, poses.world_from_imu, poses.turn
    arm = np.broadcast_to(-x.cam_from_imu.T @ x.imu_in_cam_m, (count, 3))
    swing = cross(poses.rate, arm)
    by_state, by_shared = np.zeros((count, N_MOVING, N_STATE)), np.zeros((count, N_MOVING, at.count))
    for rows, body, pushed in ((CENTRE, arm, 0.5 * t**2), (SPEED, swing, t)):
        turned = np.einsum("nij,nj->ni", turn, body)
        by_state[:, rows, THETA] = -start @ (skew(turned) + pushed * skew(poses.force))
        by_state[:, rows, ACCEL_BIAS] = -pushed * start
    by_state[:, CENTRE, POSITION] = np.eye(3)
    by_state[:, CENTRE, VELOCITY] = t * np.eye(3)
    by_state[:, SPEED, VELOCITY] = np.eye(3)
    by_state[:, TURN, THETA], by_shared[:, TURN, ROTATION] = start, -now @ x.cam_from_imu.T
    swinging = now @ skew(arm)
    by_state[:, SPEED, GYRO_BIAS] = swinging
    for columns, by_arm in ((LEVER, -x.cam_from_imu.T), (ROTATION, -x.cam_from_imu.T @ skew(x.imu_in_cam_m))):
        by_shared[:, CENTRE, columns] = now @ by_arm
        by_shared[:, SPEED, columns] = now @ skew(poses.rate) @ by_arm
    velocity = poses.velocity_m_s + np.einsum("nij,nj->ni", now, swing)
    if problem.inertial is not None:
        force = np.einsum("nij,nj->ni", start, poses.force) + x.gravity_m_s2 * problem.inertial.down
        # that the arm swings faster and faster is nothing within an offset
        turning = np.einsum("nij,nj->ni", now, poses.rate)
        by_time = np.concatenate([velocity, force, turning], axis=1)
        by_shared[:, :, OFFSET] = -by_time
        by_shared[:, :, CLOCK_RATE] = -time_since_middle_s(problem, frames)[:, None] * by_time
        by_gain = -swinging[:, :, :, None] * problem.inertial.turning.powers[:, 0][:, None, None, :]
        by_shared[:, SPEED, at.gyro_gain] = by_gain.reshape(count, 3, 9)
    return Moving(velocity_m_s=velocity, by_state=by_state, by_shared=by_shared)
