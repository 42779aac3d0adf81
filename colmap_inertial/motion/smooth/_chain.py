"""A linear-Gaussian Markov chain observed with noise: smoothed states, their covariance, the likelihood, outliers.

This is the Rauch-Tung-Striebel smoother in its batch form: all times are solved at once by a banded Cholesky
factorisation of the posterior precision, in linear time, and the covariances follow in one backward recursion. Axes
that share noise share the factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """``x[k+1] = transition[k] x[k] + drive[k] + noise``, ``y[k] = observed . x[k] + noise``; no prior on ``x[0]``.

    Attributes
    ----------
    transition, process_cov
        (T-1, n, n).
    drive
        (T-1, n, m) known inputs, one column for each of m axes.
    observed
        (n,) the combination of the state that is measured.
    measured
        (T, m).
    measured_var
        (T,) variances, shared by the axes.
    initial_information
        (n, n) precision of a zero-mean prior of ``x[0]``; zero rows for what is free.
    """

    transition: Array
    process_cov: Array
    drive: Array
    observed: Array
    measured: Array
    measured_var: Array
    initial_information: Array

    @cached_property
    def _weight(self) -> Array:
        return np.asarray(np.linalg.inv(self.process_cov), dtype=np.float64)

    @cached_property
    def _factor(self) -> tuple[Array, Array]:
        """Banded Cholesky factor of the precision (2n, T n) and right-hand side (T n, m)."""
        from scipy.linalg import cholesky_banded

        count, n = len(self.measured), len(self.observed)
        f, w = self.transition, self._weight
        fw = f.transpose(0, 2, 1) @ w
        diagonal = np.zeros((count, n, n))
        diagonal += np.outer(self.observed, self.observed) / self.measured_var[:, None, None]
        diagonal[0] += self.initial_information
        diagonal[:-1] += fw @ f
        diagonal[1:] += w
        below = -(w @ f)
        bands = np.zeros((2 * n, count, n))
        for row in range(n):
            for column in range(n):
                if row >= column:
                    bands[row - column, :, column] = diagonal[:, row, column]
                bands[n + row - column, :-1, column] = below[:, row, column]
        rhs = self.observed[None, :, None] * (self.measured / self.measured_var[:, None])[:, None, :]
        rhs[:-1] -= fw @ self.drive
        rhs[1:] += w @ self.drive
        factor = np.asarray(cholesky_banded(bands.reshape(2 * n, -1), lower=True), dtype=np.float64)
        return factor, rhs.reshape(count * n, -1)

    @cached_property
    def states(self) -> Array:
        """(T, n, m) smoothed states."""
        from scipy.linalg import cho_solve_banded

        factor, rhs = self._factor
        return np.asarray(cho_solve_banded((factor, True), rhs).reshape(len(self.measured), len(self.observed), -1))

    @cached_property
    def energy(self) -> float:
        """Sum of squared whitened residuals of all measurements, transitions and the prior."""
        x = self.states
        wrong = self.measured - np.einsum("i,kim->km", self.observed, x)
        jump = self._process_residual
        return float(
            np.sum(wrong**2 / self.measured_var[:, None])
            + np.sum(jump * (self._weight @ jump))
            + np.sum(x[0] * (self.initial_information @ x[0]))
        )

    @property
    def _process_residual(self) -> Array:
        x = self.states
        return np.asarray(x[1:] - self.transition @ x[:-1] - self.drive)

    @cached_property
    def log_determinant(self) -> float:
        """Of the measurements' covariance, up to a constant that does not depend on the noise."""
        return float(
            2 * np.sum(np.log(self._factor[0][0]))
            + np.sum(np.linalg.slogdet(self.process_cov)[1])
            + np.sum(np.log(self.measured_var))
        )

    @property
    def log_likelihood(self) -> float:
        """Of all axes, up to a constant; free directions of the first state are integrated out."""
        return -0.5 * (self.energy + self.measured.shape[1] * self.log_determinant)

    @cached_property
    def _backward(self) -> tuple[Array, Array]:
        """Covariances (T, n, n) of the states, shared by the axes, and gains (T-1, n, n): cov(k, k+1) = gain cov."""
        count, n = len(self.measured), len(self.observed)
        bands = self._factor[0].reshape(2 * n, count, n)
        low, below = np.zeros((count, n, n)), np.zeros((count - 1, n, n))
        for row in range(n):
            for column in range(n):
                if row >= column:
                    low[:, row, column] = bands[row - column, :, column]
                below[:, row, column] = bands[n + row - column, :-1, column]
        inverse = np.linalg.inv(low)
        own = inverse.transpose(0, 2, 1) @ inverse
        gain = -(inverse[:-1].transpose(0, 2, 1) @ below.transpose(0, 2, 1))
        # cov[k] = own[k] + g cov[k+1] g' with g = -L_kk^-T L_(k+1,k)'
        cov = own.copy()
        transposed = gain.transpose(0, 2, 1)
        for k in range(count - 2, -1, -1):
            cov[k] += gain[k] @ cov[k + 1] @ transposed[k]
        return 0.5 * (cov + cov.transpose(0, 2, 1)), gain

    @property
    def cov(self) -> Array:
        """(T, n, n) covariance of the states of one axis."""
        return self._backward[0]

    def outlier_statistics(self) -> tuple[Array, Array]:
        """Auxiliary residuals (Harvey and Koopman 1992), squared: where the data contradict the model.

        Returns
        -------
        (T,) for a wrong measurement, (T-1,) for a jump of the first state between two measurements. Each is the sum
        over m axes of squares of a standard normal variable if all is well, and ignores its own datum.
        """
        h, x = self.observed, self.states
        cov, gain = self._backward
        wrong = self.measured - np.einsum("i,kim->km", h, x)
        spread = np.maximum(self.measured_var - np.einsum("i,kij,j->k", h, cov, h), 1e-9 * self.measured_var)
        measured = np.sum(wrong**2, axis=1) / spread

        # of w = x[k+1] - F x[k] - drive, the part along the first state, weighed by the inverse process covariance
        w, f = self._weight, self.transition
        cross = gain @ cov[1:]
        left = f @ cross
        cov_jump = cov[1:] + f @ cov[:-1] @ f.transpose(0, 2, 1) - left - left.transpose(0, 2, 1)
        pull = np.einsum("kj,kjm->km", w[:, 0, :], self._process_residual)
        spread = w[:, 0, 0] - np.einsum("ki,kij,kj->k", w[:, 0, :], cov_jump, w[:, 0, :])
        jumped = np.sum(pull**2, axis=1) / np.maximum(spread, 1e-8 * w[:, 0, 0])
        return measured, jumped
