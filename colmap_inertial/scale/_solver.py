"""Normal equations of a chain of states with a few globals: block-tridiagonal with an arrow, solved in linear time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.types import Array


@dataclass(eq=False, kw_only=True)
class ArrowSystem:
    """``H x = b`` for K states of size m, each tied to its neighbours, and n globals tied to all.

    Attributes
    ----------
    diagonal
        (K, m, m) blocks of a state with itself.
    below
        (K - 1, m, m) blocks of state ``k + 1`` (rows) with state ``k`` (columns).
    border
        (K, m, n) blocks of a state with the globals.
    corner
        (n, n) block of the globals.
    """

    diagonal: Array
    below: Array
    border: Array
    corner: Array

    @classmethod
    def zeros(cls, states: int, state_size: int, n_globals: int) -> ArrowSystem:
        """An empty system."""
        return cls(
            diagonal=np.zeros((states, state_size, state_size)),
            below=np.zeros((states - 1, state_size, state_size)),
            border=np.zeros((states, state_size, n_globals)),
            corner=np.zeros((n_globals, n_globals)),
        )

    def solve(self, rhs_states: Array, rhs_globals: Array) -> tuple[Array, Array, Array]:
        """Solve for q right-hand sides at once.

        Parameters
        ----------
        rhs_states, rhs_globals
            (K, m, q), (n, q).

        Returns
        -------
        States (K, m, q), globals (n, q), and the covariance (n, n) of the globals.

        Raises
        ------
        numpy.linalg.LinAlgError
            When the matrix is not positive definite.
        """
        from scipy.linalg import cho_solve_banded, cholesky_banded

        k, m, n = self.border.shape
        # Unit diagonal: radians, metres and bias walks differ by many orders of magnitude
        unit = 1 / np.sqrt(np.diagonal(self.diagonal, axis1=1, axis2=2))
        band = np.zeros((2 * m, k, m))
        diagonal = self.diagonal * unit[:, :, None] * unit[:, None, :]
        below = self.below * unit[1:, :, None] * unit[:-1, None, :]
        for j in range(m):
            band[: m - j, :, j] = diagonal[:, j:, j].T
            band[m - j : 2 * m - j, :-1, j] = below[:, :, j].T
        band = band.reshape(2 * m, k * m)
        if not np.isfinite(band[0]).all():
            raise np.linalg.LinAlgError("the normal equations are not finite")
        factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        sides = (np.concatenate([self.border, rhs_states], axis=2) * unit[:, :, None]).reshape(k * m, -1)
        solved = cho_solve_banded((factor, True), sides, check_finite=False)
        coupling = sides[:, :n].T @ solved
        schur = self.corner - coupling[:, :n]
        schur = 0.5 * (schur + schur.T)
        spread = np.diagonal(schur)
        if not (spread > 0).all():
            raise np.linalg.LinAlgError("a global parameter is not determined")
        spread = 1 / np.sqrt(spread)
        inverse = np.linalg.inv(np.linalg.cholesky(schur * spread[:, None] * spread))
        cov = (inverse.T @ inverse) * spread[:, None] * spread
        x_globals = cov @ (rhs_globals - coupling[:, n:])
        x_states = (solved[:, n:] - solved[:, :n] @ x_globals).reshape(k, m, -1) * unit[:, :, None]
        return x_states, x_globals, cov
