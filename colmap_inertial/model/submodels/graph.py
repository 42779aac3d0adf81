"""A graph of submodels: similarities between them as constraints, and the placement that suits all of them best.

A constraint is a measured similarity with its information, whatever it was measured by. The placement minimises the
squares over variances, by the method of Gauss and Newton. The unknowns of a submodel are the logarithm of its scale,
its rotation (left) and its translation; other terms may add unknowns and equations of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import skew, so3_exp, so3_log

if TYPE_CHECKING:
    import pycolmap

#: Places of two submodels, the smaller one first.
Pair = tuple[int, int]

#: Unknowns of a placement: logarithm of the scale, rotation, translation.
PLACEMENT = 7


#: What ties two submodels, by their places ``first`` and ``second``.
Tie = TypeVar("Tie", bound=Any)


def pair_of(constraint: Any) -> Pair:
    """The places of the two submodels, the smaller one first."""
    return min(constraint.first, constraint.second), max(constraint.first, constraint.second)


def find_connected(members: Sequence[int], pairs: Iterable[Pair]) -> list[list[int]]:
    """Connected components of a graph of submodels."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    index = {k: i for i, k in enumerate(members)}
    ends = np.array([(index[a], index[b]) for a, b in pairs if a in index and b in index], dtype=np.intp).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(index), len(index)))
    count, label = connected_components(graph, directed=False)
    return [[members[i] for i in np.flatnonzero(label == k).tolist()] for k in range(count)]


@dataclass(frozen=True, eq=False, kw_only=True)
class Placements:
    """Poses of K submodels: ``x_world = scale * rotation x_submodel + translation``, with further unknowns.

    Attributes
    ----------
    scale, rotation, translation
        (K,), (K, 3, 3), (K, 3).
    change
        (N,) sum of all steps by all unknowns; those of the placements come first.
    """

    scale: Array
    rotation: Array
    translation: Array
    change: Array

    @classmethod
    def at_origin(cls, scale: Array, size: int | None = None) -> Self:
        """Submodels of known scales that all lie at the origin."""
        k = len(scale)
        size = PLACEMENT * k if size is None else size
        rotation = np.tile(np.eye(3), (k, 1, 1))
        return cls(scale=scale.copy(), rotation=rotation, translation=np.zeros((k, 3)), change=np.zeros(size))

    def moved(self, step: Array) -> Self:
        """The placements after a step by all unknowns."""
        by = step[: PLACEMENT * len(self.scale)].reshape(-1, PLACEMENT)
        return replace(
            self,
            scale=self.scale * np.exp(by[:, 0]),
            rotation=so3_exp(by[:, 1:4]) @ self.rotation,
            translation=self.translation + by[:, 4:],
            change=self.change + step,
        )

    def similarity(self, k: int) -> pycolmap.Sim3d:
        """``world_from_submodel``."""
        import pycolmap

        return pycolmap.Sim3d(float(self.scale[k]), pycolmap.Rotation3d(self.rotation[k]), self.translation[k])


def columns_of(k: int) -> slice:
    """The columns of a submodel's placement."""
    return slice(PLACEMENT * k, PLACEMENT * (k + 1))


class Equations:
    """Normal equations as they grow, and the sum of squares over variances."""

    def __init__(self, size: int) -> None:
        self.matrix, self.gradient = np.zeros((size, size)), np.zeros(size)
        self.squares = 0.0

    def add(
        self,
        residual: Array,
        columns: Int64Array,
        by: Array | None = None,
        info: Array | None = None,
        sign: float = 1.0,
    ) -> None:
        """Add residuals.

        Parameters
        ----------
        residual
            (R,) over their standard deviations, or with an information matrix.
        columns
            (C,) of the unknowns that they depend on.
        by
            (R, C) derivatives; none where the unknowns themselves are the residuals.
        info
            (R, R) inverse of the residuals' covariance.
        sign
            -1 takes away a distribution that is in there twice.
        """
        by = np.eye(len(residual)) if by is None else by
        weighted, weighted_by = (residual, by) if info is None else (info @ residual, info @ by)
        self.matrix[np.ix_(columns, columns)] += sign * by.T @ weighted_by
        self.gradient[columns] += sign * by.T @ weighted
        self.squares += sign * float(residual @ weighted)

    def hold(self, columns: slice) -> None:
        """Keep some unknowns where they are."""
        for rows in (self.matrix, self.matrix.T):
            rows[columns] = 0.0
        self.matrix[columns, columns] = np.eye(columns.stop - columns.start) * 1e12
        self.gradient[columns] = 0.0

    def solve(self) -> tuple[Array, Array]:
        """The step, and the covariance of all unknowns.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where they are not determined.
        """
        unit = 1 / np.sqrt(np.diagonal(self.matrix))
        if not np.isfinite(unit).all():
            raise np.linalg.LinAlgError("nothing determines the places of the submodels")
        root = np.linalg.inv(np.linalg.cholesky(self.matrix * unit[:, None] * unit))
        cov = (root.T @ root) * unit[:, None] * unit
        return -cov @ self.gradient, cov


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Convergence of Gauss-Newton's method."""

    #: Rounds at most.
    rounds: int
    #: Step of all placements (rad, units of the world) below which they are at rest.
    step: float
    #: Change of the sum of squares, and its share of the sum, below which it is settled.
    squares: float
    squares_share: float


def minimise_placements(
    start: Placements, equations_of: Callable[[Placements], Equations], limits: Convergence
) -> tuple[Placements, Array, float]:
    """The most probable placements, their covariance with all unknowns, and the sum of squares.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where they are not determined, or do not converge.
    """
    state, largest, squares = start, np.inf, np.inf
    for _ in range(limits.rounds):
        equations = equations_of(state)
        settled = abs(squares - equations.squares) < limits.squares + limits.squares_share * equations.squares
        step, cov = equations.solve()
        if largest < limits.step or settled:
            return state, cov, equations.squares
        squares, state = equations.squares, state.moved(step)
        largest = float(np.abs(step[: PLACEMENT * len(state.scale)].reshape(-1, PLACEMENT)[:, 1:]).max())
    raise np.linalg.LinAlgError("the places of the submodels do not converge")


@dataclass(frozen=True, eq=False, kw_only=True)
class SimilarityConstraint:
    """A measured similarity between two submodels, ``x_first = scale * rotation (x_second - centre) + image``.

    Attributes
    ----------
    first, second
        Places of the submodels.
    scale, rotation, centre, image
        Of the similarity; (3, 3), (3,) a point of the second submodel and (3,) where it lies in the first one.
    info
        (7, 7) inverse covariance of log scale, rotation (left) and ``image``.
    squares
        Squares over variances that the single measurements leave.
    images
        (n, 2) the images of either submodel that it was measured by, where it was by their poses.
    equations
        How many independent equations it stands for.
    """

    first: int
    second: int
    scale: float
    rotation: Array
    centre: Array
    image: Array
    info: Array
    squares: float = 0.0
    images: Int64Array = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    equations: float = 0.0

    @classmethod
    def fitted(
        cls,
        first: int,
        second: int,
        points: tuple[Array, Array],
        sigma: Array | float,
        *,
        start: tuple[float, Array],
        rotations: tuple[Array, float] | None = None,
        **more: Any,
    ) -> Self:
        """Fit a similarity by least squares.

        Parameters
        ----------
        points
            (n, 3) the same points in the first and in the second submodel.
        sigma
            (n,) standard deviations of their differences, in units of the first one.
        start
            Scale and rotation to begin with.
        rotations
            (n, 3, 3) measured ``first_from_second``, and their standard deviation (rad).
        """
        in_first, in_second = points
        weight = np.broadcast_to(1 / np.square(sigma), len(in_first))
        centre, image = (np.average(of, axis=0, weights=weight) for of in (in_second, in_first))
        scale, rotation = start
        for _ in range(_FIT_ROUNDS):
            arms = scale * (in_second - centre) @ rotation.T
            by = np.concatenate([arms[:, :, None], -skew(arms), np.tile(np.eye(3), (len(arms), 1, 1))], axis=2)
            by = (by * np.sqrt(weight)[:, None, None]).reshape(-1, PLACEMENT)
            away = ((in_first - arms - image) * np.sqrt(weight)[:, None]).ravel()
            if rotations is not None:
                twists = so3_log(rotations[0] @ rotation.T).ravel() / rotations[1]
                turn = np.zeros((len(twists), PLACEMENT))
                turn[:, 1:4] = np.tile(np.eye(3) / rotations[1], (len(rotations[0]), 1))
                by, away = np.concatenate([by, turn]), np.concatenate([away, twists])
            step = np.linalg.lstsq(by, away, rcond=None)[0]
            scale, rotation = scale * float(np.exp(step[0])), so3_exp(step[1:4]) @ rotation
            image = image + step[4:]
        left = away - by @ step
        more |= {"info": by.T @ by, "squares": float(left @ left)}
        return cls(first=first, second=second, scale=scale, rotation=rotation, centre=centre, image=image, **more)

    def weighted(self, weight: float) -> Self:
        """The same with so much of its information."""
        return replace(self, info=weight * self.info, squares=weight * self.squares, equations=weight * self.equations)

    def residual(self, state: Placements) -> tuple[Array, Array]:
        """(7,) the similarity as submodels lie less the measured one, and (7, 14) derivatives by both placements."""
        a, b = self.first, self.second
        first_from_world = state.rotation[a].T / state.scale[a]
        arm = state.scale[b] * state.rotation[b] @ self.centre
        apart = arm + state.translation[b] - state.translation[a]
        image = first_from_world @ apart
        rotation = state.rotation[a].T @ state.rotation[b]
        scale = float(state.scale[b] / state.scale[a])
        twist = so3_log(rotation @ self.rotation.T)
        # derivative of the logarithm by a rotation on the left, to second order
        by_left = np.eye(3) - 0.5 * skew(twist) + skew(twist) @ skew(twist) / 12
        by = np.zeros((PLACEMENT, 2 * PLACEMENT))
        by[0, 0], by[0, 7] = -1.0, 1.0
        by[1:4, 8:11] = by_left @ state.rotation[a].T
        by[1:4, 1:4] = -by[1:4, 8:11]
        by[4:, 0], by[4:, 7] = -image, first_from_world @ arm
        by[4:, 1:4], by[4:, 8:11] = first_from_world @ skew(apart), -first_from_world @ skew(arm)
        by[4:, 4:7], by[4:, 11:] = -first_from_world, first_from_world
        return np.concatenate([[np.log(scale / self.scale)], twist, image - self.image]), by

    def add_to(self, equations: Equations, state: Placements) -> None:
        """Add the equations of this constraint."""
        away, by = self.residual(state)
        columns = np.r_[columns_of(self.first), columns_of(self.second)]
        equations.add(away, columns, by, self.info)
        equations.squares += self.squares

    def misfit(self, state: Placements) -> float:
        """Squares over variances by which submodels as they lie contradict it."""
        away, _ = self.residual(state)
        return float(away @ self.info @ away)

    def attach(self, state: Placements, new: int, *, scaled: bool) -> None:
        """Place one of the two by the other one; ``scaled``: its scale, too."""
        a, b = self.first, self.second
        if new == b:
            state.rotation[b] = state.rotation[a] @ self.rotation
            state.scale[b] = state.scale[a] * self.scale if scaled else state.scale[b]
        else:
            state.rotation[a] = state.rotation[b] @ self.rotation.T
            state.scale[a] = state.scale[b] / self.scale if scaled else state.scale[a]
        arms = [state.scale[k] * state.rotation[k] @ point for k, point in ((a, self.image), (b, self.centre))]
        if new == b:
            state.translation[b] = state.translation[a] + arms[0] - arms[1]
        else:
            state.translation[a] = state.translation[b] + arms[1] - arms[0]


#: Rounds of a fit; it converges quadratically from a robust estimate.
_FIT_ROUNDS = 5


def chain_placements(
    start: Placements, held: int, ties: Sequence[Tie], attach: Callable[[Placements, Tie, int], None]
) -> Placements:
    """Placements by one constraint after the other, from the held submodel on, the first ones of ``ties`` first."""
    state = replace(
        start, scale=start.scale.copy(), rotation=start.rotation.copy(), translation=start.translation.copy()
    )
    placed = {held}
    while len(placed) < len(start.scale):
        tie = next((link for link in ties if (link.first in placed) != (link.second in placed)), None)
        if tie is None:
            raise ValueError("every submodel must be tied to the held one")
        new = tie.second if tie.first in placed else tie.first
        attach(state, tie, new)
        placed.add(new)
    return state


def among(ties: Iterable[Tie], members: Sequence[int]) -> list[Tie]:
    """Constraints within a group, by places in the group."""
    index: Mapping[int, int] = {k: i for i, k in enumerate(members)}
    inside = (tie for tie in ties if tie.first in index and tie.second in index)
    return [replace(tie, first=index[tie.first], second=index[tie.second]) for tie in inside]
