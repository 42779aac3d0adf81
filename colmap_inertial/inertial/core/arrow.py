"""Normal equations of a chain of states with a few globals: block-tridiagonal with an arrow, solved in linear time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.arrays import Array


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
        unit, rhs = self.scaling(rhs_states)
        n, q = len(self.corner), rhs.shape[2]
        products = np.empty((n, n + q))
        factor = _inertial.eliminate(self.diagonal, self.below, self.border, rhs_states, unit, products)
        if factor is None:
            raise np.linalg.LinAlgError("the normal equations are singular")
        x_globals, cov = self.solve_globals(products, rhs_globals)
        rest = np.ascontiguousarray(rhs - (self.border @ x_globals) * unit[:, :, None])
        factor.substitute(rest)
        return rest * unit[:, :, None], x_globals, cov

    def invert(self) -> Inverse:
        """The inverse, as far as the system has blocks.

        Raises
        ------
        numpy.linalg.LinAlgError
            When the matrix is not positive definite.
        """
        (k, m), n = self.diagonal.shape[:2], len(self.corner)
        no_sides, products, lines = np.zeros((k, m, 0)), np.empty((n, n)), np.empty((k, m, n + -n % 8))
        unit, _ = self.scaling(no_sides)
        factor = _inertial.eliminate(self.diagonal, self.below, self.border, no_sides, unit, products, forward=lines)
        if factor is None:
            raise np.linalg.LinAlgError("the normal equations are singular")
        root = self._root_of_globals(products)
        here, beside = np.empty((k, m, m)), np.empty((k - 1, m, m))
        factor.selected_inverse(here, beside)
        here *= unit[:, :, None] * unit[:, None, :]
        beside *= unit[:-1, :, None] * unit[1:, None, :]
        factor.substitute(lines, half_done=True)  # in whole vectors, which it need not copy
        followed = lines[:, :, :n]
        followed *= unit[:, :, None]
        return Inverse(unit=unit, factor=factor, here=here, beside=beside, followed=followed, root=root)

    def scaling(self, rhs_states: Array) -> tuple[Array, Array]:
        """Scaling that makes the diagonal one, and the right-hand sides multiplied by it.

        Radians, metres and bias walks differ by many orders of magnitude.
        """
        unit = 1 / np.sqrt(np.diagonal(self.diagonal, axis1=1, axis2=2))
        if not (np.isfinite(unit).all() and (unit > 0).all()):
            raise np.linalg.LinAlgError("the normal equations are not finite")
        return unit, rhs_states * unit[:, :, None]

    def solve_globals(self, products: Array, rhs_globals: Array) -> tuple[Array, Array]:
        """The globals and their covariance, from the products of ``L^-1 border`` with ``L^-1 [border, rhs]``."""
        n = len(self.corner)
        root = self._root_of_globals(products[:, :n])
        cov = root @ root.T
        return cov @ (rhs_globals - products[:, n:]), cov

    def _root_of_globals(self, products: Array) -> Array:
        """An upper triangle (n, n) that is, times its transpose, the covariance of the globals."""
        schur = self.corner - products
        schur = 0.5 * (schur + schur.T)
        spread = np.diagonal(schur)
        if not (spread > 0).all():
            raise np.linalg.LinAlgError("a global parameter is not determined")
        spread = 1 / np.sqrt(spread)
        inverse = np.linalg.inv(np.linalg.cholesky(schur * spread[:, None] * spread))
        return np.asarray(inverse.T * spread[:, None])


@dataclass(frozen=True, eq=False, kw_only=True)
class Inverse:
    """The inverse of an arrow system, as far as traces with the information of residuals need it.

    Attributes
    ----------
    unit, factor
        (K, m) scaling of the chain of states, and its factor.
    here, beside
        (K, m, m), (K - 1, m, m) blocks of the chain's inverse: of a state, and of a state with the next.
    followed
        (K, m, n) the chain's inverse times its border: how states follow the globals.
    root
        (n, n) upper triangle; times its transpose, the covariance of the globals.
    """

    unit: Array
    factor: _inertial.ArrowFactor
    here: Array
    beside: Array
    followed: Array
    root: Array

    @property
    def cov(self) -> Array:
        """(n, n) of the globals."""
        return np.asarray(self.root @ self.root.T)

    def solve(self, rhs_states: Array, rhs_globals: Array) -> tuple[Array, Array]:
        """States (K, m, q) and globals (n, q) for q right-hand sides."""
        flat = self.followed.reshape(-1, len(self.root))
        z = self.cov @ (rhs_globals - flat.T @ rhs_states.reshape(len(flat), -1))
        return _solve_chain(self.factor, self.unit, rhs_states) - self.followed @ z, z


def _solve_chain(factor: _inertial.ArrowFactor, unit: Array, rhs: Array) -> Array:
    """(K, m, q) solution of the chain alone."""
    rest = rhs * unit[:, :, None]
    factor.substitute(rest)
    return np.asarray(rest * unit[:, :, None])
