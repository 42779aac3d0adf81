"""How noisy the refinement finds the accelerometer."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.inertial.refine import pictures, solve as solver
from colmap_inertial.inertial.refine._residuals import imu_rows, project
from colmap_inertial.inertial.refine.solve import apply_measured_noise, factor_information, solve
from tests.helpers.refine_walk import problem_of, tracks_of, walk

TRUE = 2e-3


def at_level(problem, density):
    inertial = problem.inertial
    return replace(problem, inertial=replace(inertial, noise=replace(inertial.noise, accel_density_m_s2_rthz=density)))


def found(problem, x):
    return apply_measured_noise(problem, x).inertial.noise.accel_density_m_s2_rthz


@pytest.fixture(scope="module")
def solved():
    # pictures that tell the path much better than the accelerometer does
    options = walk(12.0, points_per_m=80.0, noise_px=0.05)
    problem, start, _ = problem_of(tracks_of(options), options)
    assert problem.inertial.noise.accel_density_m_s2_rthz == TRUE
    return problem, start


def test_the_noise_is_the_simulator_s_whatever_was_thought_of_it(subtests, solved):
    for times in (0.25, 1.0, 8.0):
        with subtests.test(times=times):
            problem, start = solved
            thought = at_level(problem, times * TRUE)
            x = solve(thought, start).estimate
            measured = apply_measured_noise(thought, x)
            assert measured.inertial.noise.accel_density_m_s2_rthz == pytest.approx(TRUE, rel=0.25)
            kept = vars(replace(measured.inertial.noise, accel_density_m_s2_rthz=times * TRUE))
            assert kept == vars(thought.inertial.noise)
            assert found(thought, x) == measured.inertial.noise.accel_density_m_s2_rthz


def test_the_level_is_that_of_the_greatest_likelihood(solved, monkeypatch):
    problem, start = solved
    linked = np.arange(len(problem.inertial.linked)) % 5 > 0
    problem = at_level(replace(problem, inertial=replace(problem.inertial, linked=linked)), 2 * TRUE)
    x = solve(problem, start).estimate
    # nothing was known of it before
    monkeypatch.setattr(solver, "_LEVEL_SPREAD", 100.0)
    best = found(problem, x)
    share = imu_rows(at_level(problem, best), x).share

    def likelihood(times):
        now = at_level(problem, times * best)
        information = factor_information(now, x)
        halves = 0.5 * information.states.log_determinant() + np.log(np.diagonal(information.corner[0])).sum()
        noise = np.linalg.slogdet(np.eye(9) + (times**2 - 1) * share)[1].sum()
        return -solve(now, x).cost - float(halves) - 0.5 * float(noise)

    values = [likelihood(times) for times in (0.6, 1.0, 1.6)]
    assert values[1] > max(values[0], values[2]) + 1


def test_observations_weigh_as_much_as_they_tell(subtests, solved):
    for times in (0.2, 1.0, 2.0):
        with subtests.test(times=times):
            from scipy.special import exp1

            problem, start = solved
            alone = pictures.pictures_alone(problem, problem.observations.xy_px)
            x = solve(alone, start).estimate
            # of normal errors and a loss of scale k standard deviations, half the squares are exponential
            sigma_px = times * 0.5
            scaled = replace(
                alone, observations=replace(alone.observations, xy_px=_with_noise(alone, x, sigma_px)), robust_px=1.0
            )
            noise = pictures.measure_picture_noise(scaled, x)
            k = 0.5 * (noise.robust_px / noise.sigma_px) ** 2
            weight = k * np.exp(k) * exp1(k)
            slope = k * (1 - weight)
            variance = k * (weight - slope)
            # nothing was fitted to these
            left = 1 - (3 * len(x.points_m) + 6 * len(x.velocity_m_s)) / (2 * len(alone.observations.frame))
            assert noise.sigma_px * left**0.5 == pytest.approx(sigma_px, rel=0.03)
            assert noise.robust_px == pytest.approx(max(1.0, 2 * noise.sigma_px))
            assert noise.weighed_px / noise.sigma_px == pytest.approx((variance / slope) ** 0.5, rel=0.03)
            assert noise.informs == pytest.approx(slope / weight, rel=0.03)


def test_noise_is_measured_beside_what_was_fitted_to_it():
    options = walk(6.0, points_per_m=80.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    alone = pictures.pictures_alone(problem, problem.observations.xy_px)
    assert pictures.measure_picture_noise(alone, solve(alone, start).estimate).sigma_px == pytest.approx(0.5, rel=0.03)


def _with_noise(problem, x, sigma_px):
    """Where the points would be seen, and noise."""
    exact = problem.observations.xy_px + project(problem, x, problem.observations).residual
    return exact + sigma_px * np.random.default_rng(5).standard_normal(exact.shape)
