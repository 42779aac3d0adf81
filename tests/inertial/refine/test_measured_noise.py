"""How noisy the refinement finds pictures, accelerometer and gyroscope."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.inertial.refine import pictures, solve as solver
from colmap_inertial.inertial.refine._residuals import derivatives, imu_rows, project
from colmap_inertial.inertial.refine.solve import apply_measured_noise, factor_information, solve
from colmap_inertial.inertial.refine.values import LEVER
from tests.helpers.refine_walk import problem_of, tracks_of, walk

TRUE = {"accel_density_m_s2_rthz": 2e-3, "gyro_density_rad_s_rthz": 2e-4}


def at_levels(problem, times):
    inertial = problem.inertial
    levels = {name: times[name] * level for name, level in TRUE.items()}
    return replace(problem, inertial=replace(inertial, noise=replace(inertial.noise, **levels)))


def found(problem, x):
    noise = apply_measured_noise(problem, x).inertial.noise
    return {name: getattr(noise, name) / level for name, level in TRUE.items()}


@pytest.fixture(scope="module")
def solved():
    # pictures that tell the path much better than the accelerometer does
    options = walk(12.0, points_per_m=80.0, noise_px=0.05)
    problem, start, _ = problem_of(tracks_of(options), options)
    assert {name: getattr(problem.inertial.noise, name) for name in TRUE} == TRUE
    return problem, start


def test_the_noise_is_the_simulator_s_whatever_was_thought_of_it(subtests, solved):
    for times in (0.25, 1.0, 8.0):
        with subtests.test(times=times):
            problem, start = solved
            thought = at_levels(problem, dict.fromkeys(TRUE, times))
            x = solve(thought, start).estimate
            assert list(found(thought, x).values()) == pytest.approx([1.0, 1.0], rel=0.25)
            kept = dict.fromkeys(TRUE, times)
            measured = apply_measured_noise(thought, x)
            assert vars(at_levels(measured, kept).inertial.noise) == vars(thought.inertial.noise)


def test_levels_are_those_of_the_greatest_likelihood(solved, monkeypatch):
    problem, start = solved
    linked = np.arange(len(problem.inertial.linked)) % 5 > 0
    thought = dict.fromkeys(TRUE, 2.0)
    problem = at_levels(replace(problem, inertial=replace(problem.inertial, linked=linked)), thought)
    x = solve(problem, start).estimate
    # nothing was known of them before
    monkeypatch.setattr(solver, "_LEVEL_SPREAD", 100.0)
    best = found(problem, x)
    shares = imu_rows(at_levels(problem, best), x).shares

    def likelihood(times):
        now = at_levels(problem, {name: times[name] * level for name, level in best.items()})
        information = factor_information(now, x)
        halves = 0.5 * information.states.log_determinant() + np.log(np.diagonal(information.corner[0])).sum()
        cov = np.eye(9) + sum((times[name] ** 2 - 1) * share for name, share in shares.items())
        return -solve(now, x).cost - float(halves) - 0.5 * float(np.linalg.slogdet(cov)[1].sum())

    at_best = likelihood(dict.fromkeys(TRUE, 1.0))
    for name in TRUE:
        for times in (0.6, 1.6):
            assert at_best > likelihood(dict.fromkeys(TRUE, 1.0) | {name: times}) + 1


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
            noise = pictures.measure_image_noise(scaled, x)
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
    assert pictures.measure_image_noise(alone, solve(alone, start).estimate).sigma_px == pytest.approx(0.5, rel=0.03)


def _with_noise(problem, x, sigma_px):
    """Where the points would be seen, and noise."""
    exact = problem.observations.xy_px + project(problem, x, problem.observations).residual
    return exact + sigma_px * np.random.default_rng(5).standard_normal(exact.shape)


def test_independent_errors_are_not_shared():
    options = walk(6.0, points_per_m=200.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    assert pictures.measure_shared_errors(problem, solve(problem, start).estimate) == pytest.approx(1.0, abs=0.1)


def test_shared_errors_are_what_poses_err_by_more():
    options, rng = walk(4.0, points_per_m=500.0), np.random.default_rng(2)
    problem, start, _ = problem_of(tracks_of(options), options)
    x = solve(problem, start).estimate
    observations = problem.observations
    at = project(problem, x, observations)
    exact = observations.xy_px + at.residual
    by = derivatives(problem, x, observations, at, np.ones(len(exact))).by_frame[:, :, :6]
    # patches that are smaller than the cells in which errors are looked at, and lie across their edges
    place = (exact / 90).astype(int) @ [1, 15]
    found = {}
    for lasts in (1, 5, len(x.velocity_m_s)):
        patch = place + 1000 * (observations.frame // lasts)
        errors = 0.3 * rng.standard_normal(exact.shape) + 0.3 * rng.standard_normal((patch.max() + 1, 2))[patch]
        told = replace(problem, observations=replace(observations, xy_px=exact + errors))
        found[lasts] = pictures.measure_shared_errors(told, x) - 1
    ratios = []
    for frame in np.flatnonzero(np.bincount(observations.frame) >= 20):
        mine = observations.frame == frame
        jacobian = by[mine].reshape(-1, 6)
        together = place[mine][:, None] == place[mine]
        cov = np.kron(0.3**2 * (np.eye(mine.sum()) + together), np.eye(2))
        whole = np.linalg.inv(jacobian.T @ jacobian)
        ratios.append(np.trace(whole @ jacobian.T @ cov @ jacobian) / (6 * 2 * 0.3**2))
    more = float(np.mean(ratios)) - 1
    assert more > 0.2
    # edges cut a part of what is shared; what lasts counts more often
    assert 0.4 * more < found[1] < 1.2 * more
    assert min(found[5], found[len(x.velocity_m_s)]) > 1.1 * found[1]


def test_an_arm_is_as_sure_as_pictures_that_are_shifted_leave_it():
    errors = {}
    for shift_px in (0.0, 0.4):
        options = walk(16.0, points_per_m=60.0)
        tracks = tracks_of(options, seed=3)
        problem, start, _ = problem_of(tracks, options)
        shift = shift_px * np.random.default_rng(1).standard_normal((len(start.velocity_m_s), 2))
        observations = problem.observations
        shifted = replace(observations, xy_px=observations.xy_px + shift[observations.frame])
        problem = replace(problem, observations=shifted)
        problem = apply_measured_noise(problem, solve(problem, start).estimate)
        x = solve(problem, start).estimate
        cov = factor_information(problem, x).shared_cov()[LEVER, LEVER]
        off = x.imu_in_cam_m - tracks.calibration.imu_in_cam_m
        errors[shift_px] = off @ np.linalg.solve(cov, off), np.trace(cov)
        assert errors[shift_px][0] < 16.3  # once in a thousand
    assert errors[0.4][1] > 1.5 * errors[0.0][1]
