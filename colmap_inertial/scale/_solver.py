"""Normal equations of a chain of states with a few globals: block-tridiagonal with an arrow, solved in linear time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial._kernels import _inertial
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

    def add(self, here: Array, after: Array | None, by_globals: Array | None, *, first: int, column: int) -> None:
        """Add the information of residuals.

        Parameters
        ----------
        here, after
            (N, r, m) derivatives by the states ``first ..`` and, where there are any, by the ones after them.
        by_globals
            (N, r, g) derivatives by the globals ``column ..``.
        """
        _inertial.add_information(
            here,
            after,
            by_globals,
            first=first,
            column=column,
            diagonal=self.diagonal,
            below=self.below,
            border=self.border,
            corner=self.corner,
        )

    def add_reference(
        self, here: Array, after: Array | None, by_globals: Array | None, *, first: int, column: int
    ) -> None:
        """As :meth:`add`, in numpy."""
        n, g = len(here), 0 if by_globals is None else by_globals.shape[2]
        z = np.zeros((*here.shape[:2], 0)) if by_globals is None else by_globals
        now, then, columns = slice(first, first + n), slice(first + 1, first + 1 + n), slice(column, column + g)
        here_t, flat = here.transpose(0, 2, 1), z.reshape(n * here.shape[1], g)
        self.diagonal[now] += here_t @ here
        self.border[now, :, columns] += here_t @ z
        self.corner[columns, columns] += flat.T @ flat
        if after is not None:
            after_t = after.transpose(0, 2, 1)
            self.diagonal[then] += after_t @ after
            self.below[now] += after_t @ here
            self.border[then, :, columns] += after_t @ z

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
        unit, rhs = self._scaling(rhs_states)
        n, q = len(self.corner), rhs.shape[2]
        products = np.empty((n, n + q))
        factor = _inertial.eliminate(self.diagonal, self.below, self.border, rhs_states, unit, products)
        if factor is None:
            raise np.linalg.LinAlgError("the normal equations are singular")
        x_globals, cov = self._solve_globals(products, rhs_globals)
        rest = np.ascontiguousarray(rhs - (self.border @ x_globals) * unit[:, :, None])
        factor.substitute(rest)
        return rest * unit[:, :, None], x_globals, cov

    def solve_reference(self, rhs_states: Array, rhs_globals: Array) -> tuple[Array, Array, Array]:
        """As :meth:`solve`, by LAPACK's routines for banded matrices."""
        from scipy.linalg import cho_solve_banded, cholesky_banded

        unit, rhs = self._scaling(rhs_states)
        k, m, n = self.border.shape
        band = np.zeros((2 * m, k, m))
        diagonal = self.diagonal * unit[:, :, None] * unit[:, None, :]
        below = self.below * unit[1:, :, None] * unit[:-1, None, :]
        for j in range(m):
            band[: m - j, :, j] = diagonal[:, j:, j].T
            band[m - j : 2 * m - j, :-1, j] = below[:, :, j].T
        band = band.reshape(2 * m, k * m)
        factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        sides = np.concatenate([self.border * unit[:, :, None], rhs], axis=2).reshape(k * m, -1)
        products = sides[:, :n].T @ cho_solve_banded((factor, True), sides, check_finite=False)
        x_globals, cov = self._solve_globals(products, rhs_globals)
        rest = rhs - (self.border @ x_globals) * unit[:, :, None]
        x_states = cho_solve_banded((factor, True), rest.reshape(k * m, -1), check_finite=False)
        return x_states.reshape(k, m, -1) * unit[:, :, None], x_globals, cov

    def _scaling(self, rhs_states: Array) -> tuple[Array, Array]:
        """What makes the diagonal one, and the right-hand sides multiplied by it.

        Radians, metres and bias walks differ by many orders of magnitude.
        """
        unit = 1 / np.sqrt(np.diagonal(self.diagonal, axis1=1, axis2=2))
        if not (np.isfinite(unit).all() and (unit > 0).all()):
            raise np.linalg.LinAlgError("the normal equations are not finite")
        return unit, rhs_states * unit[:, :, None]

    def _solve_globals(self, products: Array, rhs_globals: Array) -> tuple[Array, Array]:
        """The globals and their covariance, from the products of ``L^-1 border`` with ``L^-1 [border, rhs]``."""
        n = len(self.corner)
        schur = self.corner - products[:, :n]
        schur = 0.5 * (schur + schur.T)
        spread = np.diagonal(schur)
        if not (spread > 0).all():
            raise np.linalg.LinAlgError("a global parameter is not determined")
        spread = 1 / np.sqrt(spread)
        inverse = np.linalg.inv(np.linalg.cholesky(schur * spread[:, None] * spread))
        cov = (inverse.T @ inverse) * spread[:, None] * spread
        return cov @ (rhs_globals - products[:, n:]), cov
