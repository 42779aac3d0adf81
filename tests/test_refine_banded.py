"""The band's factor, against dense algebra."""

import numpy as np
import pytest
from refine_walk import problem_of, tracks_of, walk

from colmap_inertial.inertial.refine import _system
from colmap_inertial.inertial.refine._residuals import moving
from colmap_inertial.inertial.refine._system import BandFactor
from colmap_inertial.inertial.refine.solve import factored


@pytest.mark.parametrize(("states", "reach"), [(1, 1), (7, 2), (23, 4), (24, 24), (60, 9)])
def test_solutions_and_marginals_are_those_of_the_dense_inverse(states, reach, monkeypatch):
    monkeypatch.setattr(_system, "_LEAST", 12)
    rng, count, width = np.random.default_rng(states), 3 * states, min(3 * reach, 3 * states) - 1
    row, column = np.indices((count, count))
    matrix = np.where(np.abs(row - column) <= width, rng.standard_normal((count, count)), 0.0)
    matrix = 0.5 * (matrix + matrix.T) + 2 * width * np.eye(count) + np.eye(count)
    band = np.zeros((count, width + 1))
    for below in range(width + 1):
        band[: count - below, below] = np.diagonal(matrix, -below)
    factor, inverse = BandFactor.of(band, 3), np.linalg.inv(matrix)
    rhs = rng.standard_normal((count, 4))
    assert factor.solve(rhs) == pytest.approx(inverse @ rhs, abs=1e-9)
    expected = inverse.reshape(states, 3, states, 3)[np.arange(states), :, np.arange(states)]
    assert factor.marginals(3) == pytest.approx(expected, abs=1e-9)
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_a_position_s_covariance_against_the_first_is_that_of_both():
    options = walk(3.0, readout_s=0.02, points_per_m=60.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    solved, by = factored(problem, start), moving(problem, start)
    frames = np.array([4, 9])
    both = solved.centres_cov(np.array([0, *frames]), by).reshape(3, 3, 3, 3)
    for i, cov in enumerate(solved.motion_covs(frames, by), start=1):
        expected = both[i, :, i] + both[0, :, 0] - both[i, :, 0] - both[0, :, i]
        assert cov[:3, :3] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    at_rest = solved.motion_covs(np.array([0]), by)[0]
    assert np.abs(at_rest[:3]).max() < 1e-9 and at_rest[3, 3] > 0


def test_what_is_not_positive_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        BandFactor.of(np.array([[1.0, 2.0], [1.0, 0.0]]), 1)
