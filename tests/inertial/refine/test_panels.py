"""The factor of the states' information in panels, against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_log
from colmap_inertial.inertial.refine._panels import Layout, PanelFactor
from colmap_inertial.inertial.refine._residuals import moving, project
from colmap_inertial.inertial.refine.motion import find_drift, find_motion_covs
from colmap_inertial.inertial.refine.pictures import make_pictures
from colmap_inertial.inertial.refine.setup import move_to_middle_lines, read_seen
from colmap_inertial.inertial.refine.solve import factor_information, solve
from colmap_inertial.inertial.refine.world import derive_log_size, find_world
from tests.helpers.refine_walk import problem_of, tracks_of, walk


def test_solutions_and_marginals_are_those_of_the_dense_inverse(subtests):
    """Frames see as far as ``reach``, each otherwise; numbers that are not wide are coupled with neighbours alone."""
    for frames, reach, state, wide, group in (
        (1, 1, 5, 3, 3),
        (7, 2, 5, 3, 3),
        (23, 4, 5, 3, 4),
        (24, 24, 5, 3, 4),
        (60, 9, 5, 5, 8),
        (61, 15, 15, 9, 12),
    ):
        with subtests.test(frames=frames, reach=reach, state=state, wide=wide, group=group):
            rng = np.random.default_rng(frames)
            pairs = [(a, b) for a in range(frames) for b in range(a + 1) if a - b < max(2, rng.integers(1, reach + 2))]
            both = np.array([*pairs, *(pair[::-1] for pair in pairs)])
            place = rng.permutation(frames) if wide == state else np.arange(frames)
            layout = Layout.make(place, wide, *both.T, state=state, group=group)
            matrix = np.zeros((frames, state, frames, state))
            for a, b in pairs:
                block = rng.standard_normal((state, state))
                if a - b > 1:
                    block[wide:] = block[:, wide:] = 0.0
                matrix[a, :, b] += block
                matrix[b, :, a] += block.T
            whole = matrix.reshape(frames * state, -1)
            whole += np.abs(whole).sum(axis=1).max() * np.eye(len(whole))
            values = np.zeros(layout.size_bytes // 8)
            (own, lower), (following, _), diagonal = layout.entries
            values[own] = matrix[np.arange(frames), :, np.arange(frames)].ravel()[lower]
            values[following] = matrix[np.arange(1, frames), :, np.arange(frames - 1)].ravel()
            values[diagonal[whole.shape[0] :]] = 1.0
            offset, end = layout.offsets
            for a, b in pairs:
                if a - b > 1:
                    first, last = sorted((place[a], place[b]))
                    assert last < end[first]
                    block = matrix[a, :wide, b, :wide] if place[a] == last else matrix[a, :wide, b, :wide].T
                    at = offset[first] + (wide * last + np.arange(wide)[:, None]) * group * wide + np.arange(wide)
                    values[at] = block
            order = (np.argsort(place)[:, None] * state + np.arange(state)).ravel()
            inverse = np.linalg.inv(whole[np.ix_(order, order)])
            factor = PanelFactor.of(layout, values)
            rhs = rng.standard_normal((len(whole), 4))
            assert factor.solve(rhs) == pytest.approx(inverse @ rhs, abs=1e-12)
            expected = inverse.reshape(frames, state, frames, state)[np.arange(frames), :, np.arange(frames)]
            assert factor.marginals() == pytest.approx(expected, abs=1e-12)
            assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(whole)[1])


def test_marginals_of_a_long_walk_stay_those_of_its_solutions():
    """Rounding would grow from group to group, and make covariances of a thousand frames negative."""
    options = walk(240.0, points_per_m=30.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    states = factor_information(problem, start).states
    found = states.marginals()
    for k in (0, 5, 100):
        rhs = np.zeros((len(found), 15, 15))
        rhs[k] = np.eye(15)
        expected = states.solve(rhs.reshape(-1, 15)).reshape(rhs.shape)[k]
        unit = np.sqrt(np.diagonal(expected))
        assert np.abs((found[k] - expected) / np.outer(unit, unit)).max() < 1e-9


def test_a_position_s_covariance_against_the_first_is_that_of_both():
    options = walk(3.0, readout_s=0.02, points_per_m=60.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    solved, by = factor_information(problem, start), moving(problem, start)
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
    solved, by = factor_information(problem, start), moving(problem, start)
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
    solved = factor_information(known, start)
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
    nobody = np.zeros(0, dtype=np.int64)
    layout = Layout.make(np.arange(1), 2, nobody, nobody, state=2, group=1)
    with pytest.raises(np.linalg.LinAlgError):
        PanelFactor.of(layout, np.array([1.0, 0.0, 2.0, 1.0]))
