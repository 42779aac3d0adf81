"""The most probable places of submodels, by all that their fits say, the IMU between them, and images of two of them.

Each submodel comes as a normal distribution over its nodes next to others, its scale, gravity, clock, and what the
submodels share of the device; the IMU between two nodes is a preintegrated factor; images are similarity constraints.
Unknown beside them: the placements of the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import matrix_from_quat, rotation_between, skew, so3_exp, so3_log
from colmap_inertial.core.types import CameraTrajectory, ImuNoise
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.factors import imu_group
from colmap_inertial.inertial.core.preintegration import Preintegrated, SensorErrors, SensorStreams, preintegrate
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.scale import posterior as post
from colmap_inertial.inertial.scale.posterior import FittedPath, Posterior
from colmap_inertial.model.submodels.graph import (
    PLACEMENT,
    Convergence,
    Equations,
    Placements,
    SimilarityConstraint,
    chain_placements,
    columns_of,
    minimise_placements,
)

#: Stamps are no better than this.
LEAST_STAMP_S = 1e-5


@dataclass(frozen=True, kw_only=True)
class JointPlacement:
    """Limits of placing fitted submodels."""

    #: Standard deviations about where a submodel starts, for what nothing ties: next to nothing.
    free_rad: float = 30.0
    free_m: float = 1e4
    #: Directions and strengths of gravity of two submodels are one.
    gravity_m_s2: float = 1e-4
    #: Step of the differences by the stamps: vibration makes shorter ones meaningless.
    stamp_step_s: float = 2e-3


PLACEMENT_OPTIONS = JointPlacement()
#: What contradicts itself never lies quite still: it is settled where squares change by so little.
CONVERGENCE = Convergence(rounds=15, step=1e-4, squares=0.1, squares_share=0.01)


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedSubmodel:
    """A submodel that its own scale estimate made metric.

    Attributes
    ----------
    number
        COLMAP's.
    trajectory
        Its poses, in metres.
    path
        The same fitted to the IMU once more: the posterior of its motion.
    cameras
        Names for its cameras, to distinguish those of two submodels; empty where they are unknown.
    """

    number: int
    trajectory: CameraTrajectory
    path: FittedPath
    cameras: frozenset[str] = frozenset()

    @property
    def world_from_cam(self) -> Array:
        """(F, 3, 3) of its images."""
        return matrix_from_quat(self.trajectory.cam_from_world_xyzw).transpose(0, 2, 1)


@dataclass(frozen=True, kw_only=True)
class ImuLink:
    """The IMU between a node of one submodel and the next node of another one.

    Attributes
    ----------
    first, second
        Places of the submodels, the earlier one first.
    from_node, to_node
        Nodes of their paths.
    """

    first: int
    second: int
    from_node: int
    to_node: int

    @property
    def ends(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Submodel and node of both ends."""
        return (self.first, self.from_node), (self.second, self.to_node)

    def seconds(self, submodels: Sequence[FittedSubmodel]) -> float:
        """Duration of the gap."""
        begin_s, end_s = (float(submodels[k].path.nodes_s[node]) for k, node in self.ends)
        return end_s - begin_s


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """Placement of K submodels.

    Attributes
    ----------
    places
        In the world of the submodel that was held, with its origin where that one's positions count from; scales are on
        the submodels' own metres.
    origins
        (K, 3) points of the submodels' own worlds that their positions count from.
    cov
        (7 K, 7 K) of the placements, submodel by submodel.
    gravity_m_s2
        (3,) in that world.
    squares
        Sum over variances.
    misfits
        (L, 6) of each link: the second node's visual pose as seen from the first's, less what the fitted motion between
        them makes of it; rotation and position along the world's axes. The motion may slide against the poses of a
        submodel that has a break; the submodel as a whole is moved as its poses are.
    inflation
        Factor on covariances of places against each other: by how much the constraints contradict the submodels beyond
        their noise.
    """

    places: Placements
    origins: Array
    cov: Array
    gravity_m_s2: Array
    squares: float
    misfits: Array
    inflation: float = 1.0

    def points(self, k: int, points: Array) -> Array:
        """(N, 3) points of a submodel, in the world."""
        places = self.places
        moved = places.scale[k] * (points - self.origins[k]) @ places.rotation[k].T
        return np.asarray(moved + places.translation[k])


class Problem:
    """Submodels and what ties them.

    Columns of the unknowns: the placements, of each submodel its nodes and what it has for itself, and what all share.
    """

    def __init__(
        self,
        submodels: Sequence[FittedSubmodel],
        streams: SensorStreams,
        links: Sequence[ImuLink],
        constraints: Sequence[SimilarityConstraint] = (),
        held: int = 0,
    ) -> None:
        self.submodels, self.streams, self.links, self.constraints = submodels, streams, links, constraints
        self.held = held
        used: list[set[int]] = [{0, len(submodel.path.nodes_s) - 1} for submodel in submodels]
        for link in links:
            for k, node in link.ends:
                used[k].add(node)
        self.nodes = [np.array(sorted(of_one), dtype=np.int64) for of_one in used]
        self.fits = [submodel.path.at(nodes) for submodel, nodes in zip(submodels, self.nodes, strict=True)]
        # the scale, first of what a submodel has for itself, is a column of its placement
        sizes = [post.NODE * len(nodes) + post.OWN - 1 for nodes in self.nodes]
        self.begin = (PLACEMENT * len(submodels) + np.concatenate([[0], np.cumsum(sizes)])).astype(int).tolist()
        self.shared = int(self.begin[-1])
        self.size = self.shared + post.SHARED
        # what the submodels' own estimates of the device differ by from the held one's
        self.device_offset = [_device_offset(fit, self.fits[held]) for fit in self.fits]
        self.info = [_information(fit.cov) for fit in self.fits]

    def own(self, k: int) -> int:
        """First column of submodel k's own parameters."""
        return int(self.begin[k + 1]) - post.OWN

    def columns(self, k: int) -> Int64Array:
        """The columns of submodel k's posterior, in its order."""
        own, shared = self.own(k), self.shared
        return np.r_[self.begin[k] : own + 1, columns_of(k).start, own + 1 : own + post.OWN, shared : self.size].astype(
            np.int64
        )

    def start(self) -> Placements:
        """Start: submodels placed by one constraint after the other, from the held one on."""
        origin = Placements.at_origin(np.array([fit.metres_per_unit for fit in self.fits]), self.size)

        def attach(state: Placements, tie: SimilarityConstraint | ImuLink, new: int) -> None:
            if isinstance(tie, ImuLink):
                self._attach_by_imu(state, tie, new)
            else:
                tie.attach(state, new, scaled=False)

        ties: list[SimilarityConstraint | ImuLink] = [*self.constraints, *self.links]
        return chain_placements(origin, self.held, ties, attach)

    def _attach_by_imu(self, state: Placements, link: ImuLink, new: int) -> None:
        """Place one end's submodel by the other's and the IMU between; gravity stays down."""
        begin, end = (Node.of(self, state, k, node) for k, node in link.ends)
        pre = self.preintegrate_between(state, begin, end)
        dt_s, (gravity, _) = float(pre.dt_s[0]), self.gravity(state, self.held)
        turn = begin.world_from_imu @ pre.rotation[0] @ end.world_from_imu.T
        rotation = turn if new == link.second else turn.T
        state.rotation[new] = (
            matrix_from_quat(rotation_between(rotation @ self.fits[new].gravity_m_s2, gravity)) @ rotation
        )
        begin, end = (Node.of(self, state, k, node) for k, node in link.ends)
        carried = begin.velocity_m_s * dt_s + 0.5 * gravity * dt_s**2 + begin.world_from_imu @ pre.position[0]
        away = begin.imu_in_world_m + carried - end.imu_in_world_m
        state.translation[new] += away if new == link.second else -away

    def gravity(self, state: Placements, k: int) -> tuple[Array, Array]:
        """(3,) a submodel's gravity in the common world, and (3, N) its derivatives."""
        columns = slice(self.own(k) + post.GRAVITY.start, self.own(k) + post.GRAVITY.stop)
        gravity = state.rotation[k] @ (self.fits[k].gravity_m_s2 + state.change[columns])
        by = np.zeros((3, self.size))
        by[:, columns] = state.rotation[k]
        by[:, PLACEMENT * k + 1 : PLACEMENT * k + 4] = -skew(gravity)
        return gravity, by

    def accel_gain(self, state: Placements) -> Array:
        """(3, 3) the device's, as it is thought of now."""
        change = state.change[self.shared :][post.ACCEL_GAIN].reshape(3, 3)
        return np.asarray(self.fits[self.held].accel_gain + change)

    def preintegrate_between(self, state: Placements, begin: Node, end: Node) -> Preintegrated:
        """Preintegrated motion with the current parameters of the device."""
        reference, change = self.fits[self.held], state.change[self.shared :]
        errors = SensorErrors(
            gyro_bias_rad_s=0.5 * (begin.gyro_bias_rad_s + end.gyro_bias_rad_s)[None],
            accel_bias_m_s2=0.5 * (begin.accel_bias_m_s2 + end.accel_bias_m_s2)[None],
            gyro_gain=reference.gyro_gain + change[post.GYRO_GAIN].reshape(3, 3),
            accel_gain=self.accel_gain(state),
            accel_delay_s=reference.accel_delay_s + float(change[post.ACCEL_DELAY]),
        )
        return preintegrate(np.array([begin.stamp_s, end.stamp_s]), self.streams, errors)

    def equations(self, state: Placements, *, by_imu: bool) -> Equations:
        """Normal equations and the sum of squares where the unknowns are."""
        out, shared, every = Equations(self.size), np.arange(self.shared, self.size), np.arange(self.size)
        for k, fit in enumerate(self.fits):
            columns = self.columns(k)
            away = state.change[columns]
            away[-post.SHARED :] -= self.device_offset[k]
            out.add(away, columns, info=self.info[k])
            if k == self.held:
                continue
            # each submodel's fit holds what was known beforehand: it counts once
            out.add(away[-post.SHARED :] + fit.prior_offset, shared, info=fit.prior_info, sign=-1.0)
            (here, by), (there, by_held) = (self.gravity(state, i) for i in (k, self.held))
            sigma = PLACEMENT_OPTIONS.gravity_m_s2
            out.add((here - there) / sigma, every, (by - by_held) / sigma)
            loose = np.diag([PLACEMENT_OPTIONS.free_rad**-2] * 3 + [PLACEMENT_OPTIONS.free_m**-2] * 3)
            out.add(np.zeros(6), np.arange(PLACEMENT * k + 1, PLACEMENT * (k + 1)), info=loose)
        for link in self.links:
            self._add_link(state, link, out, by_imu=by_imu)
        for constraint in self.constraints if by_imu else ():
            constraint.add_to(out, state)
        out.hold(slice(PLACEMENT * self.held + 1, PLACEMENT * (self.held + 1)))
        return out

    def _add_link(self, state: Placements, link: ImuLink, equations: Equations, *, by_imu: bool) -> None:
        """Add the preintegrated motion between two nodes, and the random walk of its biases and clock."""
        begin, end = (Node.of(self, state, k, node) for k, node in link.ends)
        noise, every = self._noise(link), np.arange(self.size)
        dt_s = end.t_s - begin.t_s
        for rows, change, sigma in (
            (post.GYRO_BIAS, end.gyro_bias_rad_s - begin.gyro_bias_rad_s, noise.gyro_walk_rad_s2_rthz),
            (post.ACCEL_BIAS, end.accel_bias_m_s2 - begin.accel_bias_m_s2, noise.accel_walk_m_s3_rthz),
        ):
            info = 1 / (sigma * dt_s**0.5)
            equations.add(change * info, every, info * (end.by[rows] - begin.by[rows]))
        # both submodels have the same clock: at one instant, stamps of one and the other agree
        info = 1 / float(np.hypot(PRIORS.clock_rate * dt_s, LEAST_STAMP_S))
        away = np.array([end.stamp_s - begin.stamp_s - dt_s])
        equations.add(away * info, every, info * (end.stamp_by - begin.stamp_by)[None])
        if not by_imu:
            return
        gravity, gravity_by = self.gravity(state, self.held)
        both = par.InertialStates(
            world_from_imu=np.stack([begin.world_from_imu, end.world_from_imu]),
            imu_in_world_m=np.stack([begin.imu_in_world_m, end.imu_in_world_m]),
            velocity_m_s=np.stack([begin.velocity_m_s, end.velocity_m_s]),
            gravity_m_s2=gravity,
            accel_gain=self.accel_gain(state),
        )
        group = imu_group(noise, both, self.preintegrate_between(state, begin, end))
        assert group.after is not None and group.by_globals is not None and group.root is not None
        # the mean of both ends' biases is that of the time between
        here, after = (of_end[0][:, : post.NODE].copy() for of_end in (group.here, group.after))
        here[:, post.GYRO_BIAS.start :] *= 0.5
        after[:, post.GYRO_BIAS.start :] = here[:, post.GYRO_BIAS.start :]
        by = here @ begin.by + after @ end.by
        by_globals, first = group.by_globals[0], par.IMU_GLOBALS.start
        by += by_globals[:, par.GRAVITY.start - first : par.GRAVITY.stop - first] @ gravity_by
        # delay and gains, in the same order
        by[:, self.shared : self.shared + post.ACCEL_GAIN.stop] = by_globals[:, par.ACCEL_DELAY - first :]
        for moved in (True, False):
            node = begin if moved else end
            by += np.outer(self._by_stamp(state, begin, end, group.root[0], first=moved), node.stamp_by)
        equations.add(group.residual[0], every, by)

    def _by_stamp(self, state: Placements, begin: Node, end: Node, root: Array, *, first: bool) -> Array:
        """(9,) change of the residuals by a later stamp of the first or the second node."""
        step_s, sides = PLACEMENT_OPTIONS.stamp_step_s, []
        for sign in (-1, 1):
            moved = replace(begin if first else end, stamp_s=(begin if first else end).stamp_s + sign * step_s)
            sides.append(self.preintegrate_between(state, *((moved, end) if first else (begin, moved))))
        before, after = sides
        change = [so3_log(after.rotation[0] @ before.rotation[0].T)]
        change += [after.velocity[0] - before.velocity[0], after.position[0] - before.position[0]]
        return np.asarray(-root @ np.concatenate(change) / (2 * step_s))

    def _noise(self, link: ImuLink) -> ImuNoise:
        """Noise of the IMU between two submodels: that of the noisier one."""
        first, second = (vars(self.submodels[k].path.noise.imu_over_seconds()) for k in (link.first, link.second))
        return ImuNoise(**{name: max(first[name], second[name]) for name in first})

    def misfit(self, state: Placements, link: ImuLink) -> Array:
        """(6,) by how much two submodels as they lie contradict the motion between them, at one link's ends."""
        change, reference = state.change[self.shared :], self.fits[self.held]
        cam_from_imu = so3_exp(change[post.ROTATION]) @ reference.cam_from_imu
        lever_m = reference.imu_in_cam_m + change[post.LEVER]
        seen, moved = [], []
        for k, index in link.ends:
            path = self.submodels[k].path
            world_from_cam, centre = path.seen(index)
            arm = state.scale[k] * state.rotation[k] @ (centre - path.origin)
            seen.append((state.rotation[k] @ world_from_cam, arm + state.translation[k]))
            node = Node.of(self, state, k, index)
            camera = node.world_from_imu @ cam_from_imu.T
            moved.append((camera, node.imu_in_world_m - camera @ lever_m))
        # both as seen from the first node as it lies
        turn = seen[0][0] @ moved[0][0].T
        rotation = so3_log(seen[1][0] @ (turn @ moved[1][0]).T)
        return np.concatenate([rotation, seen[1][1] - seen[0][1] - turn @ (moved[1][1] - moved[0][1])])


@dataclass(frozen=True, eq=False, kw_only=True)
class Node:
    """A node in the common world; ``by`` (15, N) and ``stamp_by`` (N,) are its derivatives by all unknowns."""

    t_s: float
    stamp_s: float
    world_from_imu: Array
    imu_in_world_m: Array
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    by: Array
    stamp_by: Array

    @classmethod
    def of(cls, problem: Problem, state: Placements, k: int, node: int) -> Node:
        """A node of a submodel as it lies."""
        fit, i = problem.fits[k], int(np.searchsorted(problem.nodes[k], node))
        column, own, place = problem.begin[k] + post.NODE * i, problem.own(k), PLACEMENT * k
        change, turn = state.change[column : column + post.NODE], state.rotation[k]
        stamp_by = np.zeros(problem.size)
        stamp_by[[own + post.DELAY, own + post.CLOCK_RATE]] = -1.0, -float(fit.since_middle_s[i])
        world_from_imu = turn @ fit.world_from_imu[i] @ so3_exp(change[post.THETA])
        arm = turn @ (fit.imu_in_world_m[i] + change[post.POSITION])
        velocity = turn @ (fit.velocity_m_s[i] + change[post.VELOCITY])
        by = np.zeros((post.NODE, problem.size))
        by[:, column : column + post.NODE] = np.eye(post.NODE)
        for rows in (post.POSITION, post.VELOCITY):
            by[rows, column + rows.start : column + rows.stop] = turn
        # the submodel as a whole turns about the world's axes
        turned = [world_from_imu.T, -skew(arm), -skew(velocity)]
        by[: post.VELOCITY.stop, place + 1 : place + 4] = np.concatenate(turned)
        by[post.POSITION, place + 4 : place + 7] = np.eye(3)
        return cls(
            t_s=float(fit.t_s[i]),
            stamp_s=float(fit.stamp_s[i] + stamp_by @ state.change),
            world_from_imu=world_from_imu,
            imu_in_world_m=arm + state.translation[k],
            velocity_m_s=velocity,
            gyro_bias_rad_s=fit.gyro_bias_rad_s[i] + change[post.GYRO_BIAS],
            accel_bias_m_s2=fit.accel_bias_m_s2[i] + change[post.ACCEL_BIAS],
            by=by,
            stamp_by=stamp_by,
        )


def place_submodels(problem: Problem, *, by_imu: bool = True) -> Placed:
    """Place submodels that are tied together; every one must be tied to the held one, by others where need be.

    ``by_imu``: without, neither the IMU between the submodels nor images count: what the submodels say of each other
    then, the rest of their places left open.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where it does not converge.
    """
    state, cov, squares = minimise_placements(
        problem.start(), lambda state: problem.equations(state, by_imu=by_imu), CONVERGENCE
    )
    count, own = len(problem.submodels), problem.own(problem.held)
    change = state.change[own + post.GRAVITY.start : own + post.GRAVITY.stop]
    return Placed(
        places=state,
        origins=np.array([submodel.path.origin for submodel in problem.submodels]),
        cov=cov[: PLACEMENT * count, : PLACEMENT * count],
        gravity_m_s2=problem.fits[problem.held].gravity_m_s2 + change,
        squares=squares,
        misfits=np.array([problem.misfit(state, link) for link in problem.links]).reshape(-1, 6),
    )


def _information(cov: Array) -> Array:
    """The inverse of a covariance; rounding must not make a direction certain."""
    sigma = np.sqrt(np.diagonal(cov))
    return np.asarray(np.linalg.inv(cov + 1e-9 * np.diag(sigma**2)), dtype=np.float64)


def _device_offset(first: Posterior, second: Posterior) -> Array:
    """(25,) what one submodel has of the device, less what another one has."""
    out = np.zeros(post.SHARED)
    out[post.ACCEL_DELAY] = first.accel_delay_s - second.accel_delay_s
    out[post.GYRO_GAIN] = (first.gyro_gain - second.gyro_gain).ravel()
    out[post.ACCEL_GAIN] = (first.accel_gain - second.accel_gain).ravel()
    out[post.ROTATION] = so3_log(first.cam_from_imu @ second.cam_from_imu.T)
    out[post.LEVER] = first.imu_in_cam_m - second.imu_in_cam_m
    return out
