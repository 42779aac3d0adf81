"""Normal equations of the refinement: points taken out, frames in a band, what is shared as its border."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.inertial.refine._residuals import Derivatives, Moving, Rows
from colmap_inertial.inertial.refine.values import N_SEEN, N_STATE, Observations

#: A block has so many numbers at least, or Python takes longer than the products; of whole states.
_LEAST = 240


@dataclass(frozen=True, eq=False, kw_only=True)
class BandFactor:
    """Cholesky factor of a band, in dense blocks: LAPACK's solver takes one right-hand side after the other.

    Attributes
    ----------
    blocks
        (K, b, b) the factor's blocks on the diagonal, below their diagonals; above these, what lies below the block, as
        the band is no wider than one.
    count
        Of the numbers; the last block may have more.
    """

    blocks: Array
    count: int

    @classmethod
    def of(cls, band: Array, state: int) -> BandFactor:
        """Factor of the lower triangle (n, width + 1), column by column, of states of this size; it is overwritten.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where it is not positive definite.
        """
        from scipy.linalg import cholesky_banded

        count, rows = band.shape
        lower = np.asarray(cholesky_banded(band.T, lower=True, overwrite_ab=True, check_finite=False))
        size = min(-(-max(rows, _LEAST) // state) * state, -(-count // state) * state)
        size = max(size, rows)
        blocks = np.zeros((-(-count // size), size, size))
        # a column's rows follow each other from the diagonal on, into the next block
        columns = np.zeros((size, 2 * size))
        along = np.lib.stride_tricks.as_strided(columns, (size, rows), ((2 * size + 1) * 8, 8))
        for k, block in enumerate(blocks):
            some = lower.T[k * size : (k + 1) * size]
            wide = len(some)
            along[:wide], along[wide:] = some, 0.0
            np.add(columns[:, :size].T, columns[:, size:].T, out=block)
            if wide < size:
                block[wide:] = 0.0
                block[range(wide, size), range(wide, size)] = 1.0
        return cls(blocks=blocks, count=count)

    def solve(self, rhs: Array) -> Array:
        """(n, k) solutions of k right-hand sides."""
        from scipy.linalg import solve_triangular

        number, size, _ = self.blocks.shape
        x = np.zeros((number, size, rhs.shape[1]))
        x.reshape(number * size, -1)[: self.count] = rhs
        for k, block in enumerate(self.blocks):
            x[k] = solve_triangular(block, x[k], lower=True, check_finite=False)
            if k + 1 < number:
                x[k + 1] -= np.triu(block, 1) @ x[k]
        for k in range(number - 1, -1, -1):
            block = self.blocks[k]
            if k + 1 < number:
                x[k] -= np.triu(block, 1).T @ x[k + 1]
            x[k] = solve_triangular(block, x[k], lower=True, trans="T", check_finite=False)
        return np.asarray(x.reshape(number * size, -1)[: self.count])

    def marginals(self, state: int) -> Array:
        """(n / s, s, s) the inverse's blocks of states of s numbers, on the diagonal (Takahashi's recursion)."""
        from scipy.linalg import solve_triangular

        number, size, _ = self.blocks.shape
        each = size // state
        out, after = np.empty((number, each, state, state)), np.zeros((size, size))
        for k in range(number - 1, -1, -1):
            own = solve_triangular(self.blocks[k], np.eye(size), lower=True, check_finite=False)
            inverse = own.T @ own
            if k + 1 < number:
                along = np.triu(self.blocks[k], 1) @ own
                inverse += along.T @ after @ along
            after = 0.5 * (inverse + inverse.T)
            out[k] = after.reshape(each, state, each, state)[np.arange(each), :, np.arange(each)]
        return np.asarray(out.reshape(-1, state, state)[: self.count // state])

    def log_determinant(self) -> float:
        """Logarithm of the band's determinant."""
        return 2 * float(np.log(np.diagonal(self.blocks, axis1=1, axis2=2)).sum())


@dataclass(frozen=True, eq=False, kw_only=True)
class Order:
    """Order of the frames in the band, and its width.

    Attributes
    ----------
    place
        (F,) of each frame.
    width
        Numbers below the diagonal.
    """

    place: Int64Array
    width: int

    @classmethod
    def of(cls, observations: Observations, frames: int) -> Order:
        """Order by time, or by Cuthill and McKee's rule where that is narrower, as it is where loops close."""
        from scipy.sparse import coo_array, csr_array
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        ones = np.ones(len(observations.frame), dtype=np.int32)
        shape = (frames, int(observations.point[-1]) + 1)
        sees = csr_array(coo_array((ones, (observations.frame, observations.point)), shape=shape))
        following = np.arange(frames - 1)
        chain = coo_array((np.ones(frames - 1, dtype=np.int32), (following, following + 1)), shape=(frames, frames))
        together = csr_array(sees @ sees.T + chain + chain.T)
        row, column = together.nonzero()
        time = np.arange(frames)
        other = np.empty(frames, dtype=np.int64)
        other[reverse_cuthill_mckee(together, symmetric_mode=True)] = time
        reach, other_reach = (int(np.max(np.abs(place[row] - place[column]))) for place in (time, other))
        place, reach = (other, other_reach) if other_reach < 0.8 * reach else (time, reach)
        return cls(place=place.astype(np.int64), width=min((reach + 1) * N_STATE, frames * N_STATE) - 1)

    @property
    def size_bytes(self) -> int:
        """Memory of the band."""
        return 8 * N_STATE * len(self.place) * (self.width + 1)


@dataclass(eq=False, kw_only=True)
class System:
    """``H step = rhs`` without the points.

    Attributes
    ----------
    order
        Of the frames.
    band
        (15 F, width + 1) lower triangle of the states' part, column by column.
    border
        (15 F, Q) states against what is shared.
    corner
        (Q, Q).
    rhs, rhs_shared
        (15 F,), (Q,) minus the gradient.
    inverse, pull
        (P, 3, 3) inverses of the points' own blocks, (P, 3) their right-hand sides.
    """

    order: Order
    band: Array
    border: Array
    corner: Array
    rhs: Array
    rhs_shared: Array
    inverse: Array
    pull: Array

    @classmethod
    def build(
        cls,
        order: Order,
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
        frames, points, shared = len(order.place), len(observations.first) - 1, len(prior[1])
        n, seen = frames * N_STATE, by.by_shared.shape[2]
        band, border = np.zeros((n, order.width + 1)), np.zeros((n, seen))
        corner, rhs, rhs_shared = np.zeros((seen, seen)), np.zeros(n), np.zeros(seen)
        inverse, pull = np.empty((points, 3, 3)), np.empty((points, 3))
        inside = _inertial.reduce_points(
            first=observations.first,
            column=N_STATE * order.place[observations.frame],
            by_frame=by.by_frame,
            by_shared=by.by_shared,
            by_point=by.by_point,
            residual=residual,
            damping=damping,
            band=band,
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
            order=order,
            band=band,
            border=np.concatenate([border, np.zeros((n, shared - seen))], axis=1),
            corner=prior[0].copy(),
            rhs=rhs,
            rhs_shared=prior[1].copy(),
            inverse=inverse,
            pull=pull,
        )
        system.corner[:seen, :seen] += corner
        system.rhs_shared[:seen] += rhs_shared
        for block in rows.values():
            system._add(block)
        band[:, 0] *= 1 + damping
        system.corner[np.diag_indices(shared)] *= 1 + damping
        return system

    def _add(self, rows: Rows) -> None:
        count, at = len(rows.residual), N_STATE * self.order.place
        self._add_block(at[:count], at[:count], rows.here.transpose(0, 2, 1) @ rows.here)
        self._pull(at[:count], rows.here, rows)
        if rows.after is not None:
            self._add_block(at[1:], at[1:], rows.after.transpose(0, 2, 1) @ rows.after)
            self._add_block(at[1:], at[:count], rows.after.transpose(0, 2, 1) @ rows.here)
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

    def _add_block(self, row: Int64Array, column: Int64Array, block: Array) -> None:
        """Add (N, 15, 15) at (N,) rows and columns, either triangle of the matrix."""
        i = (row[:, None, None] + np.arange(N_STATE)[:, None]) + np.zeros((1, 1, N_STATE), dtype=np.int64)
        j = (column[:, None, None] + np.arange(N_STATE)) + np.zeros((1, N_STATE, 1), dtype=np.int64)
        same = (row == column)[:, None, None]
        keep = np.broadcast_to(~same, i.shape) | (i >= j)
        low, high = np.minimum(i, j)[keep], np.maximum(i, j)[keep]
        self.band[low, high - low] += block[keep]

    def factored(self) -> Factored:
        """The system solved for.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where it is not positive definite.
        """
        from scipy.linalg import cho_factor

        states = BandFactor.of(self.band, N_STATE)
        solved = states.solve(self.border)
        corner: Any = cho_factor(self.corner - self.border.T @ solved, lower=True, check_finite=False)
        return Factored(order=self.order, states=states, border=self.border, solved=solved, corner=corner)


@dataclass(frozen=True, eq=False, kw_only=True)
class Factored:
    """A system that was factored; its matrix was used up."""

    order: Order
    states: BandFactor
    border: Array
    solved: Array
    corner: Any

    def solve(self, rhs: Array, rhs_shared: Array) -> tuple[Array, Array]:
        """States (15 F, k) in the band's order and shared numbers (Q, k) for k right-hand sides."""
        from scipy.linalg import cho_solve

        shared = np.asarray(cho_solve(self.corner, rhs_shared - self.solved.T @ rhs, check_finite=False))
        return self.states.solve(rhs) - self.solved @ shared, shared

    def step(self, system: System, observations: Observations, by: Derivatives) -> tuple[Array, Array, Array]:
        """The step of the states (F, 15), of what is shared (Q,), and of the points (P, 3)."""
        states, shared = self.solve(system.rhs[:, None], system.rhs_shared[:, None])
        moved = states[:, 0].reshape(-1, N_STATE)[self.order.place]
        along = np.einsum("nri,ni->nr", by.by_frame, moved[observations.frame, :N_SEEN])
        along += by.by_shared @ shared[: by.by_shared.shape[2], 0]
        pulled = np.add.reduceat(np.einsum("nri,nr->ni", by.by_point, along), observations.first[:-1], axis=0)
        return moved, shared[:, 0], np.einsum("pij,pj->pi", system.inverse, system.pull - pulled)

    def cov_of(self, by_state: Array, by_shared: Array) -> tuple[Array, Array, Array]:
        """Covariance of k numbers with derivatives (k, F, 15) by the states and (k, Q) by what is shared.

        Returns
        -------
        (k, k) covariance; (F, 15, k) and (Q, k) the covariance of states and of what is shared with the numbers.
        """
        sides = np.zeros_like(by_state)
        sides[:, self.order.place] = by_state
        rhs = sides.reshape(len(sides), -1).T
        states, shared = self.solve(rhs, by_shared.T)
        cov = rhs.T @ states + by_shared @ shared
        return 0.5 * (cov + cov.T), states.reshape(-1, N_STATE, len(cov))[self.order.place], shared

    def centres_cov(self, frames: Int64Array, by: Moving) -> Array:
        """(3 K, 3 K) covariance of the camera's centres in K frames, all together."""
        by_state = np.zeros((len(frames), 3, len(self.order.place), N_STATE))
        by_state[np.arange(len(frames)), :, frames] = by.by_state[frames, :3]
        count = 3 * len(frames)
        return self.cov_of(by_state.reshape(count, -1, N_STATE), by.by_shared[frames, :3].reshape(count, -1))[0]

    def with_frames(self, frames: Int64Array, by: Moving, by_state: Array, by_shared: Array) -> Array:
        """(K, 9 + k, 9 + k) covariances of K frames' motion, each together with k numbers as in :meth:`cov_of`."""
        from scipy.linalg import cho_solve

        place, shared = self.order.place[frames], len(self.corner[0])
        others, states, followed = self.cov_of(by_state, by_shared)
        here = by.by_state[frames]
        left = by.by_shared[frames] - here @ self.solved.reshape(-1, N_STATE, shared)[place]
        solved = np.asarray(cho_solve(self.corner, left.reshape(-1, shared).T, check_finite=False))
        own = here @ self.states.marginals(N_STATE)[place] @ here.transpose(0, 2, 1)
        own += left @ solved.T.reshape(left.shape).transpose(0, 2, 1)
        across = here @ states[frames] + by.by_shared[frames] @ followed
        beside = np.broadcast_to(others, (len(frames), *others.shape))
        upper = np.concatenate([own, across], axis=2)
        return np.concatenate([upper, np.concatenate([across.transpose(0, 2, 1), beside], axis=2)], axis=1)

    def shared_cov(self) -> Array:
        """(Q, Q) covariance of what is shared."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve(self.corner, np.eye(len(self.corner[0])), check_finite=False))
