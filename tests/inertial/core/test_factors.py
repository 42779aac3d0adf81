"""Factors of states."""

import numpy as np
import pytest

from colmap_inertial.inertial.core.factors import lasting_group, state_group, walk_group
from colmap_inertial.inertial.core.parameters import DRIFT


def test_errors_that_last_weigh_as_by_the_whole_covariance(subtests):
    for kind in ("lasting", "walk", "lasting, broken", "each by itself"):
        with subtests.test(kind=kind):
            rng, sigma, lasting_s = np.random.default_rng(11), 0.3, 0.6
            t_s = np.cumsum([0.1, 0.05, 0.4, 2.0, 0.2, 0.9])
            values, dt_s = rng.standard_normal((len(t_s), 3)), np.diff(t_s)
            apart_s, first_s = np.abs(t_s[:, None] - t_s), np.minimum(t_s[:, None], t_s)
            variance = 0.5 * lasting_s * sigma**2
            whole = np.ones(len(dt_s), dtype=bool)
            if kind == "lasting":
                cov, group = (
                    variance * np.exp(-apart_s / lasting_s),
                    lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole),
                )
            elif kind == "each by itself":
                cov, group = variance * np.eye(len(t_s)), state_group(values, DRIFT, variance**0.5)
            elif kind == "walk":
                cov, group = sigma**2 * first_s, walk_group(values, DRIFT, sigma, dt_s)
            else:
                whole[2] = False
                cov, group = sigma**2 * first_s, lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole)
                # either side of the break is a walk of its own
                cov[:3, 3:] = cov[3:, :3] = 0.0
            squares = np.sum(values * np.linalg.solve(cov, values))
            starts = {"each by itself": [], "lasting, broken": [0, 3]}.get(kind, [0])
            first = sum(np.sum(values[i] ** 2) / cov[i, i] for i in starts)
            assert np.sum(group.residual**2) + first == pytest.approx(squares, rel=1e-4)
