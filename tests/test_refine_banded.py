"""The band's factor, against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from refine_walk import problem_of, tracks_of, walk

from colmap_inertial.core.geometry import so3_log
from colmap_inertial.inertial.refine import _system
from colmap_inertial.inertial.refine._residuals import moving, project
from colmap_inertial.inertial.refine._system import BandFactor
from colmap_inertial.inertial.refine.motion import find_drift, find_motion_covs
from colmap_inertial.inertial.refine.pictures import make_pictures
from colmap_inertial.inertial.refine.setup import move_to_middle_lines, read_seen
from colmap_inertial.inertial.refine.solve import factored, solve
from colmap_inertial.inertial.refine.world import derive_log_size, find_world


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
    for i, cov in enumerate(find_motion_covs(frames, solved, by), start=1):
        expected = both[i, :, i] + both[0, :, 0] - both[i, :, 0] - both[0, :, i]
        assert cov[:3, :3] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    at_rest = find_motion_covs(np.array([0]), solved, by)[0]
    assert np.abs(at_rest[:3]).max() < 1e-9 and at_rest[3, 3] > 0


def test_the_world_s_covariance_is_that_of_the_centres_split_by_cause():
    options = walk(4.0, points_per_m=60.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    solved, by = factored(problem, start), moving(problem, start)
    centres = move_to_middle_lines(problem, start).cam_in_world
    found = find_world(problem, start, centres, solved, by)
    by_size = derive_log_size(centres, np.arange(len(centres))).ravel()
    expected = by_size @ solved.centres_cov(np.arange(len(centres)), by) @ by_size
    assert found.cov[0, 0] == pytest.approx(expected, rel=1e-6)
    assert sum(found.parts.values()) == pytest.approx(expected, rel=1e-6)
    assert min(found.parts.values()) >= 0
    # a prior that knows the gains leaves them no part
    gains, info = start.columns.accel_gain, problem.prior.info.copy()
    info[gains, gains] *= 1e8
    known = replace(problem, prior=replace(problem.prior, info=info))
    solved = factored(known, start)
    surer = find_world(known, start, centres, solved, moving(known, start))
    assert surer.parts["accel_gain"] < 1e-6 * found.parts["accel_gain"]
    assert surer.cov[0, 0] < found.cov[0, 0]
    # gravity's strength is known by its prior alone in so short a walk
    assert found.cov[4, 4] == pytest.approx(5e-4**2, rel=0.1)


def test_a_path_of_pictures_is_as_unsure_as_models_of_other_noise_differ():
    """Bundle adjustments of one scene by other noise, brought to the true size, up and heading, scatter so."""
    options = walk(6.0, points_per_m=250.0)
    tracks = tracks_of(options)
    seen = read_seen(tracks.reconstruction(), tracks.timing)
    down = np.array([0.0, 0.0, -1.0])
    problem, start = make_pictures(seen)
    problem, rng, errors = replace(problem, sigma_px=options.noise_px), np.random.default_rng(0), []
    perfect = problem.observations.xy_px + project(problem, start, problem.observations).residual
    for _ in range(20):
        noisy = perfect + options.noise_px * rng.standard_normal(perfect.shape)
        drawn = replace(problem, observations=replace(problem.observations, xy_px=noisy))
        made = move_to_middle_lines(drawn, solve(drawn, start).estimate)
        rotation, centre = made.cam_from_world.transpose(0, 2, 1), made.cam_in_world
        true, at = seen.cam_from_world.transpose(0, 2, 1), seen.cam_in_world
        size = np.sum(derive_log_size(at, np.arange(len(at))) * (centre - at))
        turns = so3_log(rotation @ true.transpose(0, 2, 1))
        up = turns.mean(axis=0)
        turn = up - down * (down @ up) + down * (down @ turns[0])
        away = at - at[0]
        position = centre - centre[0] - away - size * away - np.cross(turn, away)
        errors.append(np.concatenate([position, turns - turn], axis=1))
    scatter = np.mean(np.square(errors), axis=0)
    told = np.diagonal(find_drift(seen, down).cov, axis1=1, axis2=2)
    assert not told[0, :3].any() and told[0, 5] == pytest.approx(0, abs=1e-12)
    ratio = scatter[3:] / told[3:]
    assert np.median(ratio) == pytest.approx(1, abs=0.35)
    assert ratio.max() < 5 and ratio.min() > 0.1


def test_what_is_not_positive_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        BandFactor.of(np.array([[1.0, 2.0], [1.0, 0.0]]), 1)
