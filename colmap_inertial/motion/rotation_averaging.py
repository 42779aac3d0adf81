"""Rotations of single frames by those of pairs of them, some of which are wrong.

Rotations of two views that follow each other closely are poor: there is little parallax to tell a turn from a move, and
a plane has two solutions. Each frame of a video has such rotations to several others; around a loop they have to close,
so that what is wrong is outvoted (A. Chatterjee, V. M. Govindu, *Efficient and robust large-scale rotation averaging*,
ICCV 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.geometry import so3_exp, so3_log


@dataclass(frozen=True, kw_only=True)
class AveragingLimits:
    """Limits of rotation averaging."""

    #: Rounds of weighting; weights fall (Geman-McClure) beyond this angle at first, less by this factor each round, and
    #: in the end beyond so many times the usual error, which is at least this.
    rounds: int = 30
    widest_rad: float = np.radians(20.0)
    narrower: float = 0.75
    sigmas: float = 2.0
    least_rad: float = 1e-4
    #: Of frames that hang on others by this little; keeps the equations solvable.
    regular: float = 1e-9


_LIMITS = AveragingLimits()


def average_rotations(count: int, first: IndexArray, second: IndexArray, first_from_second: Array) -> Array:
    """(N - 1, 3) rotation vectors ``earlier_from_later`` of consecutive frames, by rotations of M pairs of them.

    Parameters
    ----------
    count
        Of frames, N.
    first, second
        (M,) places of the frames of each pair, the earlier one first.
    first_from_second
        (M, 3, 3) rotations.

    Returns
    -------
    NaN where pairs do not connect two frames.
    """
    from scipy.sparse import coo_matrix, eye
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    if not len(first):
        return np.full((count - 1, 3), np.nan)
    world_from_cam = _chain_rotations(count, first, second, first_from_second)
    rows, ones = np.arange(len(first)), np.ones(len(first))
    columns = np.concatenate([second, first])
    change = coo_matrix(
        (np.concatenate([ones, -ones]), (np.concatenate([rows, rows]), columns)), shape=(len(first), count)
    ).tocsc()
    small = _LIMITS.regular * eye(count, format="csc")
    for k in range(_LIMITS.rounds):
        predicted = world_from_cam[first] @ first_from_second
        off = so3_log(np.swapaxes(predicted, 1, 2) @ world_from_cam[second])
        angle = np.linalg.norm(off, axis=1)
        usual = max(float(np.median(angle)) / 1.538, _LIMITS.least_rad)  # of chi with 3 degrees of freedom
        scale = max(_LIMITS.sigmas * usual, _LIMITS.widest_rad * _LIMITS.narrower**k)
        weight = 1 / (1 + (angle / scale) ** 2) ** 2
        in_world = np.einsum("mij,mj->mi", world_from_cam[second], off)
        normal = (change.T @ change.multiply(weight[:, None])).tocsc() + small
        step = splu(normal).solve(-(change.T @ (weight[:, None] * in_world)))
        world_from_cam = so3_exp(step) @ world_from_cam
    turn_rad = so3_log(np.swapaxes(world_from_cam[:-1], 1, 2) @ world_from_cam[1:])
    _, part = connected_components(change.T @ change, directed=False)
    return np.where((part[:-1] == part[1:])[:, None], turn_rad, np.nan)


def _chain_rotations(count: int, first: IndexArray, second: IndexArray, first_from_second: Array) -> Array:
    """(N, 3, 3) rotations ``world_from_cam`` along the shortest step to an earlier frame; of none, the one before."""
    nearest: dict[int, int] = {}
    for pair in np.argsort(first - second, kind="stable").tolist():  # the longest steps first
        nearest[int(second[pair])] = pair
    world_from_cam = np.tile(np.eye(3), (count, 1, 1))
    for frame in range(1, count):
        pair_or_none = nearest.get(frame)
        if pair_or_none is None:
            world_from_cam[frame] = world_from_cam[frame - 1]
        else:
            world_from_cam[frame] = world_from_cam[first[pair_or_none]] @ first_from_second[pair_or_none]
    return world_from_cam
