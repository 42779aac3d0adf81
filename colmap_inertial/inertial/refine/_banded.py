"""A banded system that was factored, in dense blocks: LAPACK's own solver takes one right-hand side after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array

#: A block has so many numbers at least, or Python takes longer than the products; of whole states.
_LEAST = 240


@dataclass(frozen=True, eq=False, kw_only=True)
class BandFactor:
    """Cholesky factor of a band.

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
        """Of the lower triangle (n, width + 1), column by column, of states of so many numbers; it is used up.

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
        i, j = np.ogrid[:size, :size]
        # within a column, rows follow each other from the diagonal on, into the next block
        along = (i - j) % size
        inside = along < rows
        for k, block in enumerate(blocks):
            some = lower[:, k * size : (k + 1) * size]
            wide = some.shape[1]
            block[:, :wide] = np.where(inside[:, :wide], some[np.minimum(along, rows - 1)[:, :wide], j[:, :wide]], 0.0)
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
        """Of the band."""
        return 2 * float(np.log(np.diagonal(self.blocks, axis1=1, axis2=2)).sum())
