"""Submodels that become one model, and covariances of the relative poses between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew
from colmap_inertial.inertial.join.placement import FittedSubmodel, ImuLink, Placed
from colmap_inertial.model.submodels.graph import Pair, SimilarityConstraint, columns_of


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinedGroup:
    """Submodels that become one model.

    Attributes
    ----------
    members
        Places of the submodels; the first one is held.
    placed
        Where they come to lie, in this order.
    shared
        Constraints by images whose poses agree, by places within ``members``.
    matched
        COLMAP's numbers of pairs of submodels whose matches helped to place them, the larger submodel first.
    """

    members: tuple[int, ...]
    placed: Placed
    shared: tuple[SimilarityConstraint, ...]
    matched: frozenset[Pair] = frozenset()


def end_images(submodels: Sequence[FittedSubmodel], tie: ImuLink | SimilarityConstraint) -> tuple[int, int]:
    """The images on both sides of a link; or the first one that a constraint was measured by."""
    if isinstance(tie, SimilarityConstraint):
        first, second = tie.images[0].tolist()
        return first, second
    before_s, after_s = (submodels[k].trajectory.t_s for k, _ in tie.ends)
    middle_s = 0.5 * sum(float(submodels[k].path.nodes_s[node]) for k, node in tie.ends)
    return int(np.searchsorted(before_s, middle_s, side="right")) - 1, int(np.searchsorted(after_s, middle_s))


def tie_cov(submodels: Sequence[FittedSubmodel], placed: Placed, tie: ImuLink | SimilarityConstraint) -> Array:
    """(6, 6) covariance of the second image's pose as seen from the first one's, of :func:`end_images`."""
    pair, images = (tie.first, tie.second), end_images(submodels, tie)
    members = [submodels[k] for k in pair]
    if isinstance(tie, ImuLink):
        nodes = [tie.from_node, tie.to_node]
    else:
        ends_s = [member.trajectory.t_s[i] for member, i in zip(members, images, strict=True)]
        nodes = [int(np.argmin(np.abs(member.path.nodes_s - t_s))) for member, t_s in zip(members, ends_s, strict=True)]
    points = [member.trajectory.cam_in_world[i] for member, i in zip(members, images, strict=True)]
    return relative_cov(submodels, placed, points, pair, nodes)


def relative_cov(
    submodels: Sequence[FittedSubmodel],
    placed: Placed,
    points: Sequence[Array],
    pair: tuple[int, int],
    nodes: Sequence[int] = (),
    *,
    swung: Array | None = None,
) -> Array:
    """(6, 6) covariance of rotation and position of one submodel's point as seen from another one's.

    Parameters
    ----------
    points
        (3,) of each of the two, in its own world.
    pair
        Places of the two.
    nodes
        Of each, the node by which the visual pose there is uncertain; without, the submodels' places alone count.
    swung
        (3, 3) projection to the part of the first submodel's rotation that the other one is seen by; not given, all.
    """
    here, there = (placed.points(k, point[None])[0] for k, point in zip(pair, points, strict=True))
    by, swung = np.zeros((6, 14)), np.eye(3) if swung is None else swung
    for columns, k, at, sign in ((columns_of(0), pair[0], here, -1.0), (columns_of(1), pair[1], there, 1.0)):
        arm = at - placed.places.translation[k]
        by[:3, columns][:, 1:4] = np.eye(3) if sign > 0 else -swung
        by[3:, columns] = sign * np.c_[arm, -skew(arm), np.eye(3)]
    # as seen from the first: its own rotation swings the other around it
    by[3:, 1:4] += skew(there - here) @ swung
    rows = np.r_[columns_of(pair[0]), columns_of(pair[1])]
    cov = placed.inflation * by @ placed.cov[np.ix_(rows, rows)] @ by.T
    # lens and accelerometer leave a share of any length, of all submodels alike
    between = (there - here) * max(submodels[k].path.floor_log for k in pair)
    cov[3:, 3:] += np.outer(between, between)
    for k, node, arm in zip(pair, nodes, (there - here, np.zeros(3)), strict=False):
        by = np.eye(6)
        by[3:, :3] = -skew(arm)
        by = by @ np.kron(np.eye(2), placed.places.rotation[k])
        cov += by @ submodels[k].path.seen_cov(node) @ by.T
    return np.asarray(cov)


def worst_sigmas(cov: Array) -> tuple[float, float]:
    """Standard deviations (m, rad) along the worst directions, of a pose's covariance: rotation, position."""
    largest = [float(np.linalg.eigvalsh(cov[part, part])[-1]) for part in (slice(3, 6), slice(0, 3))]
    return largest[0] ** 0.5, largest[1] ** 0.5
