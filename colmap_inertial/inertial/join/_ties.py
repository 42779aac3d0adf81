"""Equations of what ties parts together: gravity, the IMU between them, its clock, shared images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew, so3_log
from colmap_inertial.core.types import ImuNoise
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.factors import imu_group
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.join._problem import (
    At,
    End,
    Equations,
    Problem,
    columns_of,
    felt_between,
    gravity_of,
    inertial_states,
)
from colmap_inertial.inertial.join.doubts import LEAST_STAMP_S
from colmap_inertial.inertial.join.values import Link, SharedImages
from colmap_inertial.inertial.scale import posterior as post

#: Directions and strengths of gravity of two parts are one (m/s2).
_ONE_GRAVITY_M_S2 = 1e-4
#: Step of the differences by the stamps: vibration makes shorter ones meaningless.
_STAMP_STEP_S = 2e-3


def _link_noise(problem: Problem, link: Link) -> ImuNoise:
    """Of the IMU between two parts: the louder one's."""
    one, other = (vars(problem.parts[k].path.noise.imu_over_seconds()) for k in (link.first, link.second))
    return ImuNoise(**{name: max(one[name], other[name]) for name in one})


def add_gravity(problem: Problem, at: At, k: int, equations: Equations) -> None:
    """Part k feels the held part's gravity."""
    here, there = gravity_of(problem, at, k), gravity_of(problem, at, problem.held)
    by = np.zeros((3, 12))
    by[:, :3], by[:, 3:6] = at.rotation[k], -at.rotation[problem.held]
    by[:, 6:9] = -skew(here)
    own, other = (problem.own(i) + post.GRAVITY.start for i in (k, problem.held))
    columns = np.r_[np.arange(own, own + 3), np.arange(other, other + 3), columns_of(problem.place(k))]
    equations.add((here - there) / _ONE_GRAVITY_M_S2, columns, by / _ONE_GRAVITY_M_S2)


def add_link(problem: Problem, at: At, link: Link, equations: Equations, *, by_imu: bool) -> None:
    """What the IMU felt between two nodes, and that its biases and its clock walk but little."""
    begin = End.of(problem, at, link.first, link.from_node)
    end = End.of(problem, at, link.second, link.to_node)
    (i, first), (j, second) = problem.node(link.first, link.from_node), problem.node(link.second, link.to_node)
    noise = _link_noise(problem, link)
    dt_s = problem.known[link.second].t_s[j] - problem.known[link.first].t_s[i]
    for columns, change, sigma in (
        (post.GYRO_BIAS, end.gyro_bias_rad_s - begin.gyro_bias_rad_s, noise.gyro_walk_rad_s2_rthz),
        (post.ACCEL_BIAS, end.accel_bias_m_s2 - begin.accel_bias_m_s2, noise.accel_walk_m_s3_rthz),
    ):
        info = 1 / (sigma * dt_s**0.5)
        at_columns = np.r_[first + columns_of(columns), second + columns_of(columns)]
        equations.add(change * info, at_columns, info * np.hstack([-np.eye(3), np.eye(3)]))
    _add_clock(problem, at, link, equations)
    if not by_imu:
        return
    pre = felt_between(problem, at, begin, end)
    group = imu_group(noise, inertial_states(problem, at, begin, end), pre)
    assert group.after is not None and group.by_globals is not None and group.root is not None
    by = np.zeros((9, problem.size))
    for k, column, world_from_imu, place, derivative in (
        (link.first, first, begin.world_from_imu, begin, group.here[0]),
        (link.second, second, end.world_from_imu, end, group.after[0]),
    ):
        turn, where = at.rotation[k], problem.place(k).start
        by[:, column + post.THETA.start : column + post.THETA.stop] = derivative[:, par.THETA]
        by[:, column + post.POSITION.start : column + post.POSITION.stop] = derivative[:, par.POSITION] @ turn
        by[:, column + post.VELOCITY.start : column + post.VELOCITY.stop] = derivative[:, par.VELOCITY] @ turn
        # the part as a whole turns about the world's axes
        by[:, where : where + 3] = (
            derivative[:, par.THETA] @ world_from_imu.T
            - derivative[:, par.POSITION] @ skew(place.imu_in_world_m - at.translation_m[k])
            - derivative[:, par.VELOCITY] @ skew(place.velocity_m_s)
        )
        by[:, where + 3 : where + 6] = derivative[:, par.POSITION]
        # the mean of both ends' biases is that of the time between
        for columns, theirs in ((post.GYRO_BIAS, par.GYRO_BIAS), (post.ACCEL_BIAS, par.ACCEL_WALK)):
            by[:, column + columns.start : column + columns.stop] = 0.5 * group.here[0][:, theirs]
    by_globals, start = group.by_globals[0], par.IMU_GLOBALS.start
    own = problem.own(problem.held) + post.GRAVITY.start
    turn = at.rotation[problem.held]
    by[:, own : own + 3] += by_globals[:, par.GRAVITY.start - start : par.GRAVITY.stop - start] @ turn
    shared = problem.shared
    by[:, shared + post.ACCEL_DELAY] = by_globals[:, par.ACCEL_DELAY - start]
    for mine, columns in ((post.GYRO_GAIN, par.GYRO_GAIN), (post.ACCEL_GAIN, par.ACCEL_GAIN)):
        by[:, shared + mine.start : shared + mine.stop] = by_globals[:, columns.start - start : columns.stop - start]
    for k, place, known, node in (
        (link.first, begin, problem.known[link.first], i),
        (link.second, end, problem.known[link.second], j),
    ):
        change = _by_stamp(problem, at, begin, end, group.root[0], of=place)
        by[:, problem.own(k) + post.DELAY] = -change
        by[:, problem.own(k) + post.CLOCK_RATE] = -change * known.since_middle_s[node]
    touched = np.flatnonzero(np.any(by != 0, axis=0))
    equations.add(group.residual[0], touched.astype(np.int64), by[:, touched])


def _by_stamp(problem: Problem, at: At, begin: End, end: End, root: Array, *, of: End) -> Array:
    """(9,) change of the residuals by a later stamp of one of two nodes."""
    sides = []
    for step_s in (-_STAMP_STEP_S, _STAMP_STEP_S):
        moved = replace(of, stamp_s=of.stamp_s + step_s)
        ends = (moved, end) if of is begin else (begin, moved)
        pre = felt_between(problem, at, *ends)
        sides.append((pre.rotation[0], np.concatenate([pre.velocity[0], pre.position[0]])))
    (before, other_before), (after, other_after) = sides
    turned = np.asarray(so3_log(after @ before.T))
    return np.asarray(-root @ np.concatenate([turned, other_after - other_before]) / (2 * _STAMP_STEP_S))


def _add_clock(problem: Problem, at: At, link: Link, equations: Equations) -> None:
    """Both parts have the same clock: at one instant, stamps of one and the other agree."""
    (i, _), (j, _) = problem.node(link.first, link.from_node), problem.node(link.second, link.to_node)
    begin = End.of(problem, at, link.first, link.from_node)
    end = End.of(problem, at, link.second, link.to_node)
    one, other = problem.known[link.first], problem.known[link.second]
    dt_s = float(other.t_s[j] - one.t_s[i])
    info = 1 / float(np.hypot(PRIORS.clock_rate * dt_s, LEAST_STAMP_S))
    columns, by = [], []
    for k, known, node, sign in ((link.first, one, i, 1.0), (link.second, other, j, -1.0)):
        columns += [problem.own(k) + post.DELAY, problem.own(k) + post.CLOCK_RATE]
        by += [sign, sign * float(known.since_middle_s[node])]
    away = end.stamp_s - begin.stamp_s - dt_s
    equations.add(np.array([away]) * info, np.array(columns, dtype=np.int64), np.array([by]) * info)


def add_shared(problem: Problem, at: At, images: SharedImages, equations: Equations) -> None:
    """Images of two parts have one pose."""
    root = images.weight**0.5
    variances = np.zeros(2)
    turned, centres, arms = [], [], []
    for k in (images.first, images.second):
        part, known = problem.parts[k], problem.known[k]
        world_from_cam, places = images.poses(problem.parts, k)
        variances += part.path.seen_variances
        turned.append(at.rotation[k] @ world_from_cam)
        scale = known.metres_per_unit * float(np.exp(at.y[problem.own(k) + post.LOG_SCALE]))
        arm = scale * (places - part.path.origin) @ at.rotation[k].T
        arms.append(arm)
        centres.append(arm + at.translation_m[k])
    info = root / np.sqrt(variances)
    twists = so3_log(turned[1] @ turned[0].transpose(0, 2, 1))
    signs = ((images.first, -1.0, arms[0]), (images.second, 1.0, arms[1]))
    columns = np.concatenate(
        [np.r_[problem.own(k) + post.LOG_SCALE, columns_of(problem.place(k))] for k, _, _ in signs]
    ).astype(np.int64)
    for i, twist in enumerate(twists):
        by = np.zeros((6, 14))
        for at_column, (_, sign, arm) in zip((0, 7), signs, strict=True):
            by[:3, at_column + 1 : at_column + 4] = sign * np.eye(3) * info[0]
            by[3:, at_column] = sign * arm[i] * info[1]
            by[3:, at_column + 1 : at_column + 4] = -sign * skew(arm[i]) * info[1]
            by[3:, at_column + 4 : at_column + 7] = sign * np.eye(3) * info[1]
        away = centres[1][i] - centres[0][i]
        equations.add(np.concatenate([twist * info[0], away * info[1]]), columns, by)
