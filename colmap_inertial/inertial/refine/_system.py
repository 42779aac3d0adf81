"""Normal equations of the refinement: points taken out, frames in panels, what is shared as their border."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.inertial.refine._panels import Layout, PanelFactor
from colmap_inertial.inertial.refine._residuals import Derivatives, Moving, Rows
from colmap_inertial.inertial.refine.values import N_SEEN, N_STATE, Distances, Estimate, Observations


@dataclass(eq=False, kw_only=True)
class System:
    """``H step = rhs`` without the points.

    Attributes
    ----------
    layout, values
        Panels of the states' part, and their memory.
    border
        (15 F, Q) states against what is shared.
    corner
        (Q, Q).
    rhs, rhs_shared
        (15 F,), (Q,) minus the gradient.
    inverse, pull
        (P, 3, 3) inverses of the points' own blocks, (P, 3) their right-hand sides.
    """

    layout: Layout
    values: Array
    border: Array
    corner: Array
    rhs: Array
    rhs_shared: Array
    inverse: Array
    pull: Array

    @classmethod
    def build(
        cls,
        layout: Layout,
        observations: Observations,
        by: Derivatives,
        residual: Array,
        rows: dict[str, Rows],
        prior: tuple[Array, Array],
        *,
        damping: float,
    ) -> System:
        """Build the system from weighted observations, all other residuals, and the prior's information and right-hand
        side.
        """
        frames, points, shared = len(layout.place), len(observations.first) - 1, len(prior[1])
        n, seen = frames * N_STATE, by.by_shared.shape[2]
        values, border = np.zeros(layout.size_bytes // 8), np.zeros((n, seen))
        corner, rhs, rhs_shared = np.zeros((seen, seen)), np.zeros(n), np.zeros(seen)
        inverse, pull = np.empty((points, 3, 3)), np.empty((points, 3))
        inside = _inertial.reduce_points(
            first=observations.first,
            place=layout.place[observations.frame],
            by_frame=by.by_frame,
            by_shared=by.by_shared,
            by_point=by.by_point,
            residual=residual,
            damping=damping,
            wide=layout.wide,
            pitch=layout.group * layout.wide,
            offset=layout.offsets[0],
            end=layout.offsets[1],
            values=values,
            border=border,
            corner=corner,
            rhs=rhs,
            rhs_shared=rhs_shared,
            inverse=inverse,
            pull=pull,
        )
        if not inside:
            raise ValueError("two frames see one point, and the order of frames does not know it")
        system = cls(
            layout=layout,
            values=values,
            border=np.concatenate([border, np.zeros((n, shared - seen))], axis=1),
            corner=prior[0].copy(),
            rhs=rhs,
            rhs_shared=prior[1].copy(),
            inverse=inverse,
            pull=pull,
        )
        system.corner[:seen, :seen] += corner
        system.rhs_shared[:seen] += rhs_shared
        own, following = np.zeros((frames, N_STATE, N_STATE)), np.zeros((frames - 1, N_STATE, N_STATE))
        for block in rows.values():
            system._add(block, own, following)
        for (at, picked), blocks in zip(layout.entries[:2], (own, following), strict=True):
            values[at] += blocks.ravel()[picked]
        diagonal = layout.entries[2]
        values[diagonal[n:]] = 1.0
        values[diagonal] *= 1 + damping
        system.corner[np.diag_indices(shared)] *= 1 + damping
        return system

    def _add(self, rows: Rows, own: Array, following: Array) -> None:
        """Add to right-hand sides, border and corner, and to blocks of the states and of them with those before."""
        count, at = len(rows.residual), N_STATE * self.layout.place
        own[:count] += rows.here.transpose(0, 2, 1) @ rows.here
        self._pull(at[:count], rows.here, rows)
        if rows.after is not None:
            own[1:] += rows.after.transpose(0, 2, 1) @ rows.after
            following += rows.after.transpose(0, 2, 1) @ rows.here
            self._pull(at[1:], rows.after, rows)
        if rows.by_shared is not None:
            flat = rows.by_shared.reshape(-1, rows.by_shared.shape[2])
            self.corner += flat.T @ flat
            self.rhs_shared -= flat.T @ rows.residual.ravel()

    def _pull(self, at: Int64Array, derivative: Array, rows: Rows) -> None:
        """Add right-hand side and border of states at (N,) columns; no column comes twice."""
        columns = at[:, None] + np.arange(N_STATE)
        self.rhs[columns] -= np.einsum("nri,nr->ni", derivative, rows.residual)
        if rows.by_shared is not None:
            self.border[columns] += derivative.transpose(0, 2, 1) @ rows.by_shared

    def factor(self) -> Factored:
        """The system solved for.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where it is not positive definite.
        """
        from scipy.linalg import cho_factor

        states = PanelFactor.of(self.layout, self.values)
        solved = states.solve(np.column_stack([self.border, self.rhs]))
        solved, pulled = solved[:, :-1], solved[:, -1]
        corner: Any = cho_factor(self.corner - self.border.T @ solved, lower=True, check_finite=False)
        return Factored(layout=self.layout, states=states, solved=solved, pulled=pulled, corner=corner)


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """A step of the unknowns.

    Attributes
    ----------
    states, shared, points
        (F, 15), (Q,), (P, 3).
    change
        (M, 2) by which the weighted residuals of observations change, if they were linear.
    """

    states: Array
    shared: Array
    points: Array
    change: Array

    def apply_to(self, x: Estimate, length: float, distances: Distances | None) -> Estimate:
        """The estimate after so many times the step."""
        moved = x.moved(length * self.states, length * self.shared, length * self.points)
        if distances is None:
            return moved
        return replace(moved, points_m=distances.after(x.points_m, length * self.points))


@dataclass(frozen=True, eq=False, kw_only=True)
class Factored:
    """A system that was factored; its matrix was used up.

    Attributes
    ----------
    layout, states, corner
        Factors of the states' part, in its panels, and of what is shared.
    solved, pulled
        (15 F, Q), (15 F,) the states' part solved for the border and for the right-hand side.
    """

    layout: Layout
    states: PanelFactor
    solved: Array
    pulled: Array
    corner: Any

    def solve(self, rhs: Array, rhs_shared: Array) -> tuple[Array, Array]:
        """States (15 F, k) in the layout's order and shared numbers (Q, k) for k right-hand sides."""
        from scipy.linalg import cho_solve

        shared = np.asarray(cho_solve(self.corner, rhs_shared - self.solved.T @ rhs, check_finite=False))
        return self.states.solve(rhs) - self.solved @ shared, shared

    def step(self, system: System, observations: Observations, by: Derivatives) -> Step:
        """The step of all unknowns."""
        from scipy.linalg import cho_solve

        shared = np.asarray(
            cho_solve(self.corner, system.rhs_shared - system.border.T @ self.pulled, check_finite=False)
        )
        states = (self.pulled - self.solved @ shared).reshape(-1, N_STATE)[self.layout.place]
        change = np.einsum("nri,ni->nr", by.by_frame, states[observations.frame, :N_SEEN])
        change += by.by_shared @ shared[: by.by_shared.shape[2]]
        pulled = np.add.reduceat(np.einsum("nri,nr->ni", by.by_point, change), observations.first[:-1], axis=0)
        points = np.einsum("pij,pj->pi", system.inverse, system.pull - pulled)
        change += np.einsum("nri,ni->nr", by.by_point, points[observations.point])
        return Step(states=states, shared=shared, points=points, change=change)

    def cov_of(self, by_state: Array, by_shared: Array) -> tuple[Array, Array, Array]:
        """Covariance of k numbers with derivatives (k, F, 15) by the states and (k, Q) by what is shared.

        Returns
        -------
        (k, k) covariance; (F, 15, k) and (Q, k) the covariance of states and of what is shared with the numbers.
        """
        sides = np.zeros_like(by_state)
        sides[:, self.layout.place] = by_state
        rhs = sides.reshape(len(sides), -1).T
        states, shared = self.solve(rhs, by_shared.T)
        cov = rhs.T @ states + by_shared @ shared
        return 0.5 * (cov + cov.T), states.reshape(-1, N_STATE, len(cov))[self.layout.place], shared

    def centres_cov(self, frames: Int64Array, by: Moving) -> Array:
        """(3 K, 3 K) covariance of the camera's centres in K frames, all together."""
        by_state = np.zeros((len(frames), 3, len(self.layout.place), N_STATE))
        by_state[np.arange(len(frames)), :, frames] = by.by_state[frames, :3]
        count = 3 * len(frames)
        return self.cov_of(by_state.reshape(count, -1, N_STATE), by.by_shared[frames, :3].reshape(count, -1))[0]

    def with_frames(self, frames: Int64Array, by: Moving, by_state: Array, by_shared: Array) -> Array:
        """(K, 9 + k, 9 + k) covariances of K frames' motion, each together with k numbers as in :meth:`cov_of`."""
        from scipy.linalg import cho_solve

        place, shared = self.layout.place[frames], len(self.corner[0])
        others, states, followed = self.cov_of(by_state, by_shared)
        here = by.by_state[frames]
        left = by.by_shared[frames] - here @ self.solved.reshape(-1, N_STATE, shared)[place]
        solved = np.asarray(cho_solve(self.corner, left.reshape(-1, shared).T, check_finite=False))
        own = here @ self.states.marginals()[place] @ here.transpose(0, 2, 1)
        own += left @ solved.T.reshape(left.shape).transpose(0, 2, 1)
        across = here @ states[frames] + by.by_shared[frames] @ followed
        beside = np.broadcast_to(others, (len(frames), *others.shape))
        upper = np.concatenate([own, across], axis=2)
        return np.concatenate([upper, np.concatenate([across.transpose(0, 2, 1), beside], axis=2)], axis=1)

    def shared_cov(self) -> Array:
        """(Q, Q) covariance of what is shared."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve(self.corner, np.eye(len(self.corner[0])), check_finite=False))
