"""The most probable places of parts, by all that their fits say, the IMU between them, and images that they share.

Each part comes as a normal distribution over its nodes next to others, its scale, gravity, clock, and what the parts
share of the device; the IMU between two nodes is a preintegrated factor. Unknown beside them: rotation and translation
of each part but the first. A few dozen numbers a part; Gauss and Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, rotation_between, so3_exp, so3_log
from colmap_inertial.inertial.join._problem import (
    At,
    End,
    Equations,
    Problem,
    Ties,
    columns_of,
    felt_between,
    gravity_of,
)
from colmap_inertial.inertial.join._ties import add_gravity, add_link, add_shared
from colmap_inertial.inertial.join.values import Link, Part, Placement, SharedImages
from colmap_inertial.inertial.scale import posterior as post

#: At rest: steps of the places (rad, m), or changes of the sum of squares, in all and of itself.
_ROUNDS, _AT_REST, _SETTLED, _SETTLED_SHARE = 15, 1e-4, 0.1, 0.01
#: Standard deviations about where a part starts, for what nothing ties: next to nothing (rad, m).
_ANY_RAD, _ANY_M = 30.0, 1e4
_LOOSE: Array = np.diag([_ANY_RAD**-2] * 3 + [_ANY_M**-2] * 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """Where K parts come to lie.

    Attributes
    ----------
    placements
        In the world of the part that was held, with its origin where that part's positions count from.
    cov
        (7 K, 7 K) of the logarithms of the scales, rotations (left, world) and translations, part by part.
    gravity_m_s2
        (3,) in that world.
    squares
        Sum over variances.
    misfits
        (L, 6) of each link: the second node's visual pose as seen from the first's, less what the fitted motion between
        them makes of it; rotation and position along the world's axes. The motion may slide against the poses of a part
        that has a break; the part as a whole is moved as its poses are.
    inflation
        Factor on covariances of places against each other: by how much the ties contradict the parts beyond their
        noise.
    """

    placements: tuple[Placement, ...]
    cov: Array
    gravity_m_s2: Array
    squares: float
    misfits: Array
    inflation: float = 1.0


def place(parts: Sequence[Part], ties: Ties, held: int, *, by_imu: bool = True) -> Placed:
    """Place parts that are tied together.

    Parameters
    ----------
    parts, ties
        Every part must be tied to the held one, by others where need be.
    held
        Whose world it is.
    by_imu
        Without, neither the IMU between the parts nor shared images count: what the parts say of each other then, the
        rest of their places left open.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where it does not come to rest.
    """
    problem = Problem(parts, ties, held)
    at = _first_places(problem)
    step, squares = np.inf, np.inf
    for _ in range(_ROUNDS):
        equations = _equations(problem, at, by_imu=by_imu)
        # what contradicts itself never lies quite still
        if step < _AT_REST or abs(squares - equations.squares) < _SETTLED + _SETTLED_SHARE * equations.squares:
            break
        squares = equations.squares
        change, _ = _solved(equations)
        at = _moved(problem, at, change)
        step = float(np.abs(change[problem.placed :]).max())
    else:
        raise np.linalg.LinAlgError("the places of the parts do not come to rest")
    _, cov = _solved(equations)
    rows = [
        [problem.own(k) + post.LOG_SCALE, *range(*problem.place(k).indices(problem.size))] for k in range(len(parts))
    ]
    keep = np.concatenate(rows)
    placements = tuple(
        Placement(
            scale=known.metres_per_unit * float(np.exp(at.y[problem.own(k) + post.LOG_SCALE])),
            rotation=at.rotation[k],
            translation_m=at.translation_m[k],
            origin=part.path.origin,
        )
        for k, (part, known) in enumerate(zip(parts, problem.known, strict=True))
    )
    own = problem.own(held)
    return Placed(
        placements=placements,
        cov=cov[np.ix_(keep, keep)],
        gravity_m_s2=problem.known[held].gravity_m_s2 + at.y[own + post.GRAVITY.start : own + post.GRAVITY.stop],
        squares=equations.squares,
        misfits=np.array([_misfit(problem, at, placements, link) for link in ties.links]).reshape(-1, 6),
    )


def _misfit(problem: Problem, at: At, placements: Sequence[Placement], link: Link) -> Array:
    """(6,) by how much two parts as they lie contradict the motion between them, at one link's ends."""
    seen, moved = [], []
    shared = at.y[problem.shared : problem.placed]
    reference = problem.known[problem.held]
    cam_from_imu = so3_exp(shared[post.ROTATION]) @ reference.cam_from_imu
    lever_m = reference.imu_in_cam_m + shared[post.LEVER]
    for k, node in ((link.first, link.from_node), (link.second, link.to_node)):
        world_from_cam, centre = problem.parts[k].path.seen(node)
        seen.append((placements[k].rotation @ world_from_cam, placements[k].points(centre[None])[0]))
        end = End.of(problem, at, k, node)
        camera = end.world_from_imu @ cam_from_imu.T
        moved.append((camera, end.imu_in_world_m - camera @ lever_m))
    # both as seen from the first node as it lies
    (here, there), (begin, end_pose) = seen, moved
    turn = here[0] @ begin[0].T
    rotation = so3_log(there[0] @ (turn @ end_pose[0]).T)
    away = there[1] - here[1] - turn @ (end_pose[1] - begin[1])
    return np.concatenate([rotation, away])


def _moved(problem: Problem, at: At, change: Array) -> At:
    moved = change[problem.placed :].reshape(-1, 6)
    return At(
        y=at.y + change[: problem.placed],
        rotation=so3_exp(moved[:, :3]) @ at.rotation,
        translation_m=at.translation_m + moved[:, 3:],
    )


def _solved(equations: Equations) -> tuple[Array, Array]:
    """The step, and the covariance of all unknowns."""
    unit = 1 / np.sqrt(np.diagonal(equations.matrix))
    if not np.isfinite(unit).all():
        raise np.linalg.LinAlgError("nothing determines the places of the parts")
    root = np.linalg.inv(np.linalg.cholesky(equations.matrix * unit[:, None] * unit))
    cov = (root.T @ root) * unit[:, None] * unit
    return -cov @ equations.gradient, cov


def _equations(problem: Problem, at: At, *, by_imu: bool) -> Equations:
    """Normal equations and the sum of squares where the unknowns are."""
    size = problem.size
    equations = Equations(matrix=np.zeros((size, size)), gradient=np.zeros(size))
    shared = np.arange(problem.shared, problem.placed)
    for k, known in enumerate(problem.known):
        columns = np.r_[np.arange(problem.begin[k], problem.begin[k + 1]), shared]
        away = at.y[columns]
        away[-post.SHARED :] -= problem.apart[k]
        equations.add_normal(away, columns, problem.info[k])
        if k == problem.held:
            continue
        # each part's fit holds what was known beforehand: it counts once
        equations.add_normal(away[-post.SHARED :] + known.prior_offset, shared, known.prior_info, -1.0)
        add_gravity(problem, at, k, equations)

        equations.add_normal(np.zeros(6), columns_of(problem.place(k)), _LOOSE)
    for link in problem.ties.links:
        add_link(problem, at, link, equations, by_imu=by_imu)
    if by_imu:
        for images in problem.ties.shared:
            add_shared(problem, at, images, equations)
    held = problem.place(problem.held)  # does not move, and is sure
    for rows in (equations.matrix, equations.matrix.T):
        rows[held] = 0.0
    equations.matrix[held, held] = np.eye(6) * 1e12
    equations.gradient[held] = 0.0
    return equations


def _first_places(problem: Problem) -> At:
    """Where parts come to lie by one tie after the other, from the held part on."""
    k = len(problem.parts)
    at = At(y=np.zeros(problem.placed), rotation=np.tile(np.eye(3), (k, 1, 1)), translation_m=np.zeros((k, 3)))
    done, left = {problem.held}, set(range(k)) - {problem.held}
    while left:
        tie = next((one for one in _ties(problem) if (one.first in done) != (one.second in done)), None)
        if tie is None:
            raise ValueError("every part must be tied to the held one")
        new = tie.second if tie.first in done else tie.first
        rotation, translation_m = (
            _by_link(problem, at, tie, new) if isinstance(tie, Link) else _by_images(problem, at, tie, new)
        )
        at.rotation[new], at.translation_m[new] = rotation, translation_m
        done.add(new)
        left.remove(new)
    return at


def _ties(problem: Problem) -> list[Link | SharedImages]:
    return [*problem.ties.shared, *problem.ties.links]


def _by_link(problem: Problem, at: At, link: Link, new: int) -> tuple[Array, Array]:
    """Rotation and translation of one end's part by the other's and the IMU between; gravity stays down."""
    begin = End.of(problem, at, link.first, link.from_node)
    end = End.of(problem, at, link.second, link.to_node)
    pre = felt_between(problem, at, begin, end)
    dt_s, gravity = float(pre.dt_s[0]), gravity_of(problem, at, problem.held)

    def levelled(rotation: Array) -> Array:
        own = problem.known[new].gravity_m_s2
        return np.asarray(matrix_from_quat(rotation_between(rotation @ own, gravity)) @ rotation)

    def carried(begin: End) -> Array:
        felt = begin.world_from_imu @ pre.position[0]
        return np.asarray(begin.imu_in_world_m + begin.velocity_m_s * dt_s + 0.5 * gravity * dt_s**2 + felt)

    if new == link.second:
        rotation = levelled(begin.world_from_imu @ pre.rotation[0] @ end.world_from_imu.T)
        return rotation, carried(begin) - rotation @ end.imu_in_world_m
    rotation = levelled(end.world_from_imu @ pre.rotation[0].T @ begin.world_from_imu.T)
    turned = replace(
        begin,
        world_from_imu=rotation @ begin.world_from_imu,
        imu_in_world_m=rotation @ begin.imu_in_world_m,
        velocity_m_s=rotation @ begin.velocity_m_s,
    )
    return rotation, end.imu_in_world_m - carried(turned)


def _by_images(problem: Problem, at: At, images: SharedImages, new: int) -> tuple[Array, Array]:
    """Rotation and translation of one part by the poses of images that it shares with one that has its place."""
    there = images.first if new == images.second else images.second
    (mine, own), (theirs, others) = (images.poses(problem.parts, k) for k in (new, there))
    turns = at.rotation[there] @ theirs @ mine.transpose(0, 2, 1)
    rotation = turns[0] @ so3_exp(np.median(so3_log(turns[0].T @ turns), axis=0))
    centres = [
        problem.known[k].metres_per_unit * (places - problem.parts[k].path.origin)
        for k, places in ((new, own), (there, others))
    ]
    away = centres[1] @ at.rotation[there].T + at.translation_m[there] - centres[0] @ rotation.T
    return rotation, np.median(away, axis=0)
