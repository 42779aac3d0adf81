"""Bundle adjustment with the IMU and the rolling shutter in it."""

import functools
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial._kernels import _inertial
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.inertial.refine import (
    _residuals,
    _system,
    judging_points,
    pictures,
    refinement,
    setup,
    solve as solver,
)
from colmap_inertial.inertial.refine._panels import Layout
from colmap_inertial.inertial.refine._residuals import moving
from colmap_inertial.inertial.refine._system import System
from colmap_inertial.inertial.refine.motion import find_motion_covs
from colmap_inertial.inertial.refine.solve import (
    _evaluate,
    _is_plausible,
    _weight_rows,
    evaluate_held_out,
    factor_information,
    solve,
)
from colmap_inertial.inertial.refine.values import Distances, FreeCamera
from tests.helpers.refine_walk import PINHOLE, known_of, nudged, problem_of, tracks_of, walk


def steps_of(x, kind, column):
    """Zero steps, with a one in a column of the states, the shared numbers, or the points."""
    frames, shared, points = len(x.velocity_m_s), x.columns.count, len(x.points_m)
    step = [np.zeros((frames, 15)), np.zeros(shared), np.zeros((points, 3))]
    step[kind][..., column] = 1.0
    return step


def slope(function, x, kind, column, size=1e-6):
    """Central difference of a function of the estimate."""
    step = steps_of(x, kind, column)
    ends = [function(x.moved(*(sign * size * part for part in step))) for sign in (1, -1)]
    return (ends[0] - ends[1]) / (2 * size)


@pytest.fixture(scope="module", params=[0.0, 0.025], ids=["global", "rolling"])
def small(request):
    options = walk(4.0, readout_s=request.param, points_per_m=100.0)
    tracks = tracks_of(options)
    problem, start, seen = problem_of(tracks, options)
    return tracks, problem, start, seen


def test_derivatives_of_observations_are_those_of_finite_differences(small):
    _, problem, start, _ = small
    x = nudged(start, np.random.default_rng(0))
    at = _residuals.project(problem, x, problem.observations)
    by = _residuals.derivatives(problem, x, problem.observations, at, np.ones(len(at.seen)))

    def residual(y):
        return _residuals.project(problem, y, problem.observations).residual

    for kind, values in ((0, by.by_frame), (1, by.by_shared), (2, by.by_point)):
        for column in range(values.shape[2]):
            expected = slope(residual, x, kind, column)
            assert np.abs(values[:, :, column] - expected).max() < 1e-5 * (1 + np.abs(expected).max())


def test_derivatives_of_the_camera_s_motion_are_those_of_finite_differences(small):
    _, problem, start, _ = small
    x = replace(nudged(start, np.random.default_rng(3)), offset_s=4e-3)
    x = replace(x, imu_in_cam_m=np.array([0.05, -0.08, 0.02]))
    by, now = moving(problem, x), setup.move_to_middle_lines(problem, x)
    centres, turn = now.cam_in_world, now.cam_from_world

    def motion(y):
        written = setup.move_to_middle_lines(problem, y)
        turned = so3_log(written.cam_from_world.transpose(0, 2, 1) @ turn)
        return np.concatenate([written.cam_in_world, moving(problem, y).velocity_m_s, turned], axis=1)

    assert motion(x)[:, :3] == pytest.approx(centres)
    for kind, values in ((0, by.by_state), (1, by.by_shared)):
        for column in range(values.shape[2]):
            expected = slope(motion, x, kind, column, size=1e-5)
            # what gravity's strength and the accelerometer's gains do within an offset is left out, and how the arm
            # swings ever faster, of which an offset of microseconds makes nothing
            bound = 6e-3 if kind == 0 or column not in (6, 7) else 0.5
            bound = 0.05 if kind == 1 and column >= x.columns.accel_gain.start else bound
            away = np.abs(values[:, :, column] - expected)
            assert away[:, :3].max() < 6e-3 * (1 + np.abs(expected).max())
            assert away.max() < bound * (1 + np.abs(expected).max())
    # and the velocity is how the position changes with time
    later = setup.move_to_middle_lines(problem, replace(x, offset_s=x.offset_s - 1e-4)).cam_in_world
    before = setup.move_to_middle_lines(problem, replace(x, offset_s=x.offset_s + 1e-4)).cam_in_world
    assert by.velocity_m_s == pytest.approx((later - before) / 2e-4, abs=2e-3)


def test_what_derivatives_leave_out_is_a_hundredth_of_a_pixel(small):
    _, problem, start, _ = small

    def residual(y):
        return _residuals.project(problem, y, problem.observations).residual

    for column in range(9, 15):  # by biases: what a milliradian a second and a hundredth of a m/s2 do
        assert np.abs(slope(residual, start, 0, column)).max() * 1e-3 < 0.02


def test_derivatives_of_the_imu_are_those_of_finite_differences(subtests, small):
    _, problem, start, _ = small
    x = nudged(start, np.random.default_rng(1))

    def residual_of(name, y):
        return _residuals.all_rows(problem, y)[name].residual

    for name in ("imu", "walk", "states"):
        with subtests.test(name):
            residual = functools.partial(residual_of, name)
            at = _residuals.all_rows(problem, x)[name]
            count = len(at.residual)
            whole = np.zeros((*at.residual.shape, len(x.velocity_m_s), 15))
            whole[np.arange(count), :, np.arange(count)] = at.here
            if at.after is not None:
                whole[np.arange(count), :, np.arange(count) + 1] = at.after
            # a quarter of a second's readings are not linear in their bias, nor whitened alike
            for column in range(15):
                expected = slope(residual, x, 0, column)
                found = whole[..., column].sum(axis=2)
                assert np.abs(found - expected).max() < 5e-3 * (1 + np.abs(whole[..., column]).max())
            if at.by_shared is not None:
                # the delay's derivative is one over 20 ms, as vibration makes shorter ones meaningless
                others = [column for column in range(x.columns.count) if column != x.columns.accel_delay]
                for column in others:
                    expected = slope(residual, x, 1, column)
                    assert np.abs(at.by_shared[:, :, column] - expected).max() < 5e-3 * (1 + np.abs(expected).max())


def dense(problem, at, by, residual):
    """The whole system without taking points out: (information, right-hand side)."""
    x, observations = at.estimate, problem.rows
    frames, points, shared = len(x.velocity_m_s), len(x.points_m), x.columns.count
    n = 15 * frames
    rows = []
    for o, (f, p) in enumerate(zip(observations.frame, observations.point, strict=True)):
        block = np.zeros((2, n + shared + 3 * points))
        block[:, 15 * f : 15 * f + 9] = by.by_frame[o]
        block[:, n : n + by.by_shared.shape[2]] = by.by_shared[o]
        block[:, n + shared + 3 * p : n + shared + 3 * p + 3] = by.by_point[o]
        rows.append((block, residual[o]))
    for one in at.rows.values():
        for i in range(len(one.residual)):
            block = np.zeros((one.here.shape[1], n + shared + 3 * points))
            block[:, 15 * i : 15 * i + 15] = one.here[i]
            if one.after is not None:
                block[:, 15 * i + 15 : 15 * i + 30] = one.after[i]
            if one.by_shared is not None:
                block[:, n : n + shared] = one.by_shared[i]
            rows.append((block, one.residual[i]))
    jacobian, values = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    info, rhs = jacobian.T @ jacobian, -jacobian.T @ values
    info[n : n + shared, n : n + shared] += problem.prior.info
    rhs[n : n + shared] -= problem.prior.info @ at.offset
    return info, rhs


def test_the_compiled_step_and_covariance_are_those_of_the_whole_system(subtests):
    for instruction_set in _inertial.instruction_sets():
        for folded in (False, True):
            with (
                subtests.test(instruction_set=instruction_set, folded=folded),
                pytest.MonkeyPatch.context() as monkeypatch,
            ):
                kernel = functools.partial(_inertial.reduce_points, instruction_set=instruction_set)
                monkeypatch.setattr(_system, "_inertial", SimpleNamespace(reduce_points=kernel))
                options = walk(4.0, readout_s=0.02, points_per_m=30.0, frame_rate_hz=3.0)
                problem, start, _ = problem_of(tracks_of(options), options)
                x = nudged(start, np.random.default_rng(2))
                at = _evaluate(problem, x, problem.observations)
                by, residual = _weight_rows(problem, at)
                layout = Layout.of(problem.observations, len(x.velocity_m_s))
                if folded:
                    count = len(layout.place)
                    layout = Layout.make(
                        np.random.default_rng(0).permutation(count), 15, *np.indices((count, count)).reshape(2, -1)
                    )
                prior = (problem.prior.info, -problem.prior.info @ at.offset)
                system = System.build(layout, problem.rows, by, residual, at.rows, prior, damping=0.0)
                solved = system.factor()
                step = solved.step(system, problem.rows, by)
                states, shared, points = step.states, step.shared, step.points
                info, rhs = dense(problem, at, by, residual)
                unit = 1 / np.sqrt(np.diagonal(info))
                scaled = np.linalg.inv(info * unit[:, None] * unit)
                expected = unit * (scaled @ (unit * rhs))
                n, q = states.size, len(shared)
                sigma = unit * np.sqrt(np.diagonal(scaled))
                found = np.concatenate([states.ravel(), shared, points.ravel()])
                assert np.abs((found - expected) / sigma).max() < 1e-3
                cov = (scaled * unit[:, None] * unit)[n : n + q, n : n + q]
                assert np.sqrt(np.diagonal(solved.shared_cov())) == pytest.approx(np.sqrt(np.diagonal(cov)), rel=1e-4)


def test_frames_stand_in_order_of_time_unless_a_loop_closes():
    options = walk(40.0, points_per_m=20.0)
    problem, start, _ = problem_of(tracks_of(options), options)
    frames, observations = len(start.velocity_m_s), problem.observations
    plain = Layout.of(observations, frames)
    assert np.array_equal(plain.place, np.arange(frames))
    assert plain.size_bytes < 0.6 * 8 * (15 * frames) ** 2
    # the last frame sees what the first saw
    first = np.flatnonzero(observations.frame == 0)[0]
    frame = observations.frame.copy()
    frame[np.flatnonzero(observations.point == observations.point[first])[-1]] = frames - 1
    closed = Layout.of(replace(observations, frame=frame), frames)
    assert sorted(closed.place) == list(range(frames))
    assert not np.array_equal(closed.place, np.arange(frames))


def test_a_walk_is_found_from_a_start_that_is_off(small):
    tracks, problem, start, _ = small
    rng = np.random.default_rng(3)
    solution = solve(problem, nudged(start, rng, 2e-3))
    assert solution.converged
    again = solve(problem, start)
    assert solution.cost == pytest.approx(again.cost, abs=0.2)
    centres = setup.move_to_middle_lines(problem, again.estimate).cam_in_world
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    change = centres - centres.mean(axis=0) - (truth - truth.mean(axis=0))
    assert np.sqrt(np.mean(np.sum(change**2, axis=1))) < 0.025
    if tracks.timing.readout_s:
        assert again.estimate.readout_s == pytest.approx(0.025, abs=1e-3)


def test_two_solutions_are_the_same_bit_for_bit(small):
    _, problem, start, _ = small
    a, b = solve(problem, start).estimate, solve(problem, start).estimate
    assert np.array_equal(a.imu_in_world_m, b.imu_in_world_m)
    assert np.array_equal(a.points_m, b.points_m)


def test_a_frame_that_the_imu_did_not_record_hangs_on_the_pictures():
    options = walk(6.0, points_per_m=100.0)
    tracks = tracks_of(options)
    imu, names = tracks.imu, tracks.timing.names
    keep = tracks.imu.gyro_t_s < tracks.imu.gyro_t_s[0] + 5.5
    short = replace(tracks, imu=replace(imu, gyro_t_s=imu.gyro_t_s[keep], gyro_rad_s=imu.gyro_rad_s[keep]))
    problem, start, _ = problem_of(short, options)
    assert 0 < problem.inertial.linked.sum() < len(names) - 1
    solution = solve(problem, start)
    assert solution.converged
    off = setup.move_to_middle_lines(problem, solution.estimate).cam_in_world
    assert np.linalg.norm(off - tracks.motion.cam_in_world_m(tracks.timing.pose_t_s()), axis=1).max() < 0.1


def test_what_only_damping_holds_is_not_at_rest(small, monkeypatch):
    _, problem, start, _ = small
    off = nudged(start, np.random.default_rng(3), 2e-3)
    free = solve(problem, off)
    monkeypatch.setattr(solver, "SOLVE", replace(solver.SOLVE, first_damping=1e7))
    held = solve(problem, off)
    assert held.converged
    assert held.cost == pytest.approx(free.cost, abs=0.2)
    # where no step gains anything, nothing rests
    monkeypatch.setattr(solver, "_evaluate", lambda *given: replace(_evaluate(*given), cost=0.0))
    assert not solve(problem, off).converged


def test_points_that_no_step_mends_do_not_keep_frames_from_rest(small, monkeypatch):
    """Points that are off alone promise much, and frames nothing beyond them."""
    _, problem, start, _ = small
    rested = solve(problem, start).estimate
    off = rested.points_m + 3e-4 * np.random.default_rng(4).standard_normal(rested.points_m.shape)
    monkeypatch.setattr(solver, "_evaluate", lambda *given: replace(_evaluate(*given), cost=0.0))
    assert solve(problem, replace(rested, points_m=off)).converged
    assert not solve(problem, nudged(rested, np.random.default_rng(3), 2e-3)).converged


def test_frames_that_hardly_see_anything_stop_nothing(subtests, small):
    for fewest in (0, 2):
        with subtests.test(fewest=fewest):
            _, problem, start, _ = small
            seen = problem.observations
            keep = np.ones(len(seen.frame), dtype=bool)
            for frame in (5, len(start.velocity_m_s) - 1):
                keep[np.flatnonzero(seen.frame == frame)[fewest:]] = False
            problem = replace(problem, observations=seen.select(keep))
            linked = problem.inertial.linked.copy()
            linked[-1] = False  # nor does the IMU hold the last one
            problem = replace(problem, inertial=replace(problem.inertial, linked=linked))
            rng = np.random.default_rng(4)
            off = nudged(start, rng)
            alone = solve(pictures.pictures_alone(problem, problem.observations.xy_px), off)
            whole = solve(problem, off)
            assert alone.converged
            assert whole.converged
            assert not np.array_equal(alone.estimate.points_m, off.points_m)
            sigma = np.sqrt(np.diagonal(factor_information(problem, whole.estimate).shared_cov()))
            assert np.isfinite(sigma).all()


def test_a_recording_of_less_than_half_is_refused():
    options = walk(6.0, points_per_m=100.0)
    tracks = tracks_of(options)
    imu = tracks.imu
    for seconds in (2.0, 2.8):
        keep = imu.gyro_t_s < imu.gyro_t_s[0] + seconds
        short = replace(tracks, imu=replace(imu, gyro_t_s=imu.gyro_t_s[keep], gyro_rad_s=imu.gyro_rad_s[keep]))
        with pytest.raises(NotObservableError, match="less than half"):
            problem_of(short, options)


def test_a_model_of_which_no_two_images_see_the_same_point_is_refused():
    options = walk(6.0, points_per_m=20.0)
    tracks = tracks_of(options)
    model = tracks.reconstruction()
    for number in list(model.points3D):
        model.delete_point3D(number)
    seen = setup.read_seen(model, tracks.timing)
    with pytest.raises(NotObservableError, match="no two of its images see the same point"):
        setup.make_problem(seen, tracks.timing, tracks.imu, known_of(tracks, options), seen.observations.xy_px)


def test_points_behind_the_camera_are_no_gain(small):
    _, problem, start, _ = small
    behind = replace(start, points_m=start.points_m - 100.0)
    assert not _residuals.project(problem, behind, problem.observations).seen.all()
    assert _evaluate(problem, behind, problem.observations).cost > _evaluate(problem, start, problem.observations).cost
    assert (
        evaluate_held_out(problem, behind, problem.observations).mean()
        > evaluate_held_out(problem, start, problem.observations).mean()
    )


def test_a_point_behind_all_cameras_stops_nothing(small):
    _, problem, start, _ = small
    points = start.points_m.copy()
    points[3] -= 100.0 * (points[3] - start.imu_in_world_m.mean(axis=0))
    solution = solve(problem, replace(start, points_m=points))
    assert np.isfinite(solution.cost)
    assert np.isfinite(solution.estimate.points_m).all()


def test_every_camera_model_of_colmap_is_differentiated(subtests):
    def residual_of(problem, y):
        return _residuals.project(problem, y, problem.observations).residual

    for model, params in (
        ("SIMPLE_RADIAL", (1000.0, 640.0, 480.0, -0.05)),
        ("OPENCV", (1000.0, 990.0, 640.0, 480.0, -0.05, 0.01, 0.001, -0.002)),
        ("OPENCV_FISHEYE", (700.0, 690.0, 640.0, 480.0, -0.01, 0.002, 0.0, 0.0)),
        ("FULL_OPENCV", (1000.0, 990.0, 640.0, 480.0, -0.05, 0.01, 0.001, -0.002, 0.0, 0.01, 0.0, 0.0)),
    ):
        with subtests.test(model):
            options = walk(3.0, points_per_m=60.0, camera=replace(PINHOLE, model=model, params=params))
            problem, start, _ = problem_of(tracks_of(options), options)
            every = FreeCamera(model=problem.cameras[0].model, free=tuple(range(len(params))))
            problem, x = replace(problem, cameras=(every,)), replace(start, intrinsics=np.array(params))
            at = _residuals.project(problem, x, problem.observations)
            by = _residuals.derivatives(problem, x, problem.observations, at, np.ones(len(at.seen)))
            residual = functools.partial(residual_of, problem)
            for kind, values, columns in ((0, by.by_frame, range(6)), (1, by.by_shared, range(9, 9 + len(params)))):
                for column in columns:
                    expected = slope(residual, x, kind, column)
                    assert np.abs(values[:, :, column] - expected).max() < 1e-4 * (1 + np.abs(expected).max())


def test_a_gap_of_the_gyroscope_links_nothing():
    options = walk(6.0, points_per_m=60.0)
    tracks = tracks_of(options)
    imu = tracks.imu
    since_s = imu.gyro_t_s - imu.gyro_t_s[0]
    keep = (since_s < 3.0) | (since_s > 4.0)
    gappy = replace(tracks, imu=replace(imu, gyro_t_s=imu.gyro_t_s[keep], gyro_rad_s=imu.gyro_rad_s[keep]))
    whole, gap = (problem_of(one, options)[0] for one in (tracks, gappy))
    t_s = gap.inertial.streams.gyro.t_s
    begin_s, end_s = t_s[int(np.argmax(np.diff(t_s))) + np.arange(2)]
    nodes_s = gap.inertial.nodes_s
    across = (nodes_s[1:] > begin_s) & (nodes_s[:-1] < end_s)
    assert across.sum() > 2
    assert whole.inertial.linked.all()
    assert not gap.inertial.linked[across].any()
    assert gap.inertial.linked[~across].sum() >= (~across).sum() - 2
    # each chain's residuals less its velocities; nothing of what hangs between
    chains = 2
    assert refinement._count_freedom(gap) == 6 * gap.inertial.linked.sum() - 3 * chains
    assert refinement._count_freedom(whole) == 6 * whole.inertial.linked.sum() - 3


def test_frames_more_than_ten_seconds_apart_are_not_linked():
    options = walk(30.0, points_per_m=10.0)
    tracks = tracks_of(options)
    since_s = dict(zip(tracks.timing.names, tracks.timing.t_s - tracks.timing.t_s[0], strict=True))
    for until_s, apart in ((13.0, 0), (17.0, 1)):
        model = tracks.reconstruction()
        for image in list(model.images.values()):
            if 5.0 < since_s[image.name] < until_s:
                model.deregister_frame(image.frame_id)
        seen = setup.read_seen(model, tracks.timing)
        known = known_of(tracks, options)
        problem, _ = setup.make_problem(seen, tracks.timing, tracks.imu, known, seen.observations.xy_px)
        assert np.sum(~problem.inertial.linked) == apart


def test_speed_costs_nothing_where_the_imu_says_it(small):
    _, problem, start, _ = small
    fast = replace(start, velocity_m_s=start.velocity_m_s + 30.0)
    rows = _residuals.state_rows(problem, fast)
    assert np.all(rows.residual[:, 6:9] == 0.0)
    alone = replace(problem, inertial=replace(problem.inertial, linked=np.zeros_like(problem.inertial.linked)))
    assert np.all(_residuals.state_rows(alone, fast).residual[:, 6:9] > 2.0)


def test_an_offset_beyond_the_readings_that_were_looked_up_is_refused(small):
    _, problem, start, _ = small
    reach_s = problem.inertial.turning.half_span_s - 0.5 * abs(start.readout_s)
    near_s, far_s = reach_s - 0.001, reach_s + 0.001
    assert refinement._find_late_clock(problem, replace(start, offset_s=near_s)) is None
    late = refinement._find_late_clock(problem, replace(start, offset_s=-far_s))
    assert late.code == "refined-times-far" and abs(late.values["shift_s"]) == pytest.approx(far_s, abs=1e-6)
    drifting = replace(start, offset_s=near_s, clock_rate=0.002 / np.ptp(problem.inertial.nodes_s) * 2)
    assert abs(refinement._find_late_clock(problem, drifting).values["shift_s"]) == pytest.approx(far_s, abs=1e-4)
    longer = replace(start, offset_s=near_s, readout_s=start.readout_s + 0.004)
    assert refinement._find_late_clock(problem, longer).values["readout_s"] == pytest.approx(longer.readout_s)


def test_a_step_that_leaves_no_camera_is_not_tried(small):
    _, _, start, _ = small
    for factor, plausible in ((1.4, True), (1.6, False), (-1.0, False)):
        numbers = start.intrinsics.copy()
        numbers[0] *= factor
        assert _is_plausible(start, replace(start, intrinsics=numbers)) == plausible


def test_what_is_held_out_must_be_predicted_better_than_chance_does(small):
    _, problem, start, _ = small
    rests = solver._make_solution(_evaluate(problem, start, problem.observations), 1, converged=True)
    assert refinement._find_doubt(rests, rests, 1.0, -0.02, 0.01) is None
    for change, spread in ((-0.009, 0.01), (0.0, 0.0), (-1.0, np.inf)):
        assert "did not improve" in str(refinement._find_doubt(rests, rests, 1.0, change, spread))


def test_what_is_held_out_leaves_each_point_enough(small):
    _, problem, _, _ = small
    chosen = refinement._choose_held_out(problem.observations)
    assert 0.05 < chosen.mean() < 0.12
    left = problem.observations.select(~chosen)
    assert np.diff(left.first).min() >= 2


def test_of_many_observations_a_share_judges_and_all_refine(monkeypatch):
    options = walk(6.0, readout_s=0.025, points_per_m=400.0)
    problem, start, seen = problem_of(tracks_of(options), options)
    nearly = nudged(start, np.random.default_rng(1))
    at_once_px = problem.observations.xy_px
    whole = refinement.refine(problem, nearly, at_once_px, seen.t_s)
    assert judging_points.draw_points(problem.observations, len(seen.t_s)) is None
    monkeypatch.setattr(judging_points, "JUDGING", judging_points.JudgingLimits(observations=200, each=30))
    points = judging_points.draw_points(problem.observations, len(seen.t_s))
    counts, left = (
        np.bincount(observations.frame, minlength=len(seen.t_s))
        for observations in (problem.observations, problem.observations.select_points(points))
    )
    assert np.all(left >= np.minimum(counts, 30)) and left.sum() < 0.8 * counts.sum()
    shared = refinement.refine(problem, nearly, at_once_px, seen.t_s)
    assert shared.accepted and whole.accepted, (shared.reason, whole.reason)
    assert shared.held_out < 0.8 * whole.held_out
    sigma_m = np.sqrt([np.trace(cov[:3, :3]) for cov in whole.motion_covs.values()]).max()
    assert shared.estimate.imu_in_world_m == pytest.approx(whole.estimate.imu_in_world_m, abs=0.3 * sigma_m)
    assert shared.estimate.points_m == pytest.approx(whole.estimate.points_m, abs=0.05)


def test_all_observations_come_back_with_what_a_share_of_them_found(small):
    _, problem, _, _ = small
    points = np.arange(problem.observations.point[-1] + 1) % 2 == 0
    judging = judging_points.select_points(problem, points)
    assert judging_points.restore_points(problem, judging).observations == problem.observations
    still = replace(judging.observations, line=np.zeros_like(judging.observations.line))
    noise = replace(problem.inertial.noise, accel_density_m_s2_rthz=0.5)
    found = replace(judging, observations=still, inertial=replace(problem.inertial, noise=noise))
    back = judging_points.restore_points(problem, found)
    assert not back.observations.line.any() and back.inertial.noise == noise
    assert np.array_equal(back.observations.xy_px, problem.observations.xy_px)


def test_points_are_carried_along_by_a_frame_that_sees_them(small):
    """By a motion of the whole world, and by frames that move one by one."""
    _, problem, start, _ = small
    observations = problem.observations
    few = np.arange(len(start.points_m)) % 3 == 0
    turn, shift = so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, -2.0, 0.5])
    moved = replace(
        start,
        world_from_imu=turn @ start.world_from_imu,
        imu_in_world_m=start.imu_in_world_m @ turn.T + shift,
        points_m=start.points_m[few],
    )
    assert judging_points.carry_points(observations, start, moved).points_m == pytest.approx(
        start.points_m @ turn.T + shift, abs=1e-9
    )
    away = 0.1 * np.arange(len(start.velocity_m_s))[:, None] * np.array([0.0, 0.0, 1.0])
    carried = judging_points.carry_points(
        observations, start, replace(start, imu_in_world_m=start.imu_in_world_m + away)
    )
    up = carried.points_m - start.points_m
    by = np.round(up[:, 2] / 0.1).astype(int)
    assert up == pytest.approx(away[by], abs=1e-9)
    for point in range(0, len(up), 17):
        assert by[point] in observations.frame[observations.point == point]


def test_the_model_that_is_written_is_the_one_that_was_found(small):
    tracks, problem, start, seen = small
    model = tracks.reconstruction()
    back = setup.write_back(model, seen, problem, start)
    for image_id in model.reg_image_ids():
        a, b = model.image(image_id), back.image(image_id)
        assert b.projection_center() == pytest.approx(a.projection_center(), abs=1e-9)
    for point_id, point in model.points3D.items():
        assert back.points3D[point_id].xyz == pytest.approx(point.xyz, abs=1e-9)
    # all lines at once: what noise leaves of a true model
    assert back.compute_mean_reprojection_error() < 0.7


def test_standard_deviations_of_the_calibration_are_honest(small):
    tracks, problem, start, _ = small
    x = solve(problem, start).estimate
    sigma = np.sqrt(np.diagonal(factor_information(problem, x).shared_cov()))
    assert np.all(np.abs(x.imu_in_cam_m - tracks.calibration.imu_in_cam_m) < 4 * sigma[3:6])
    assert abs(x.offset_s) < 4 * sigma[6]
    assert abs(x.offset_s) < 3e-4


def test_what_a_small_step_promises_is_what_it_gives(subtests, small):
    """A gain of the whole cost, robust and with all priors, by the linear model of the solver."""
    for share in (1e-3, -1e-3):
        with subtests.test(share=share):
            _, problem, start, _ = small
            at = _evaluate(problem, nudged(start, np.random.default_rng(11), 3e-4), problem.observations)
            by, residual = _weight_rows(problem, at)
            layout = Layout.of(problem.observations, len(start.velocity_m_s))
            system = solver._build_system(problem, layout, at, by, residual, 1e-4)
            step = solver._find_step(system, problem.rows, by)
            step = replace(step, **{field.name: share * getattr(step, field.name) for field in fields(step)})
            promised = solver._predict_decrease(problem, at, residual, step)
            gained = (
                at.cost
                - _evaluate(problem, step.apply_to(at.estimate, 1.0, problem.distances), problem.observations).cost
            )
            assert np.sign(promised) == np.sign(share) and gained == pytest.approx(promised, rel=0.01)


def test_observations_that_tell_more_pull_as_much_and_hold_so_many_times_as_firmly(small):
    _, problem, start, _ = small
    problem = replace(problem, distances=None)
    at = _evaluate(problem, nudged(start, np.random.default_rng(12), 3e-4), problem.observations)
    plain, firm = _weight_rows(problem, at), _weight_rows(problem, at, 4.0)

    def sums(by, residual):
        points = by.by_point
        return np.einsum("nij,nik->jk", points, points), np.einsum("nij,ni->j", points, residual)

    (held, pull), (firmly, pull_firm) = sums(*plain), sums(*firm)
    np.testing.assert_allclose(firmly, 4.0 * held, rtol=1e-9)
    np.testing.assert_allclose(pull_firm, pull, rtol=1e-9)


def test_what_is_known_of_distances_and_its_derivatives():
    rng = np.random.default_rng(13)
    known = Distances(camera_in_world_m=rng.normal(0, 1, (6, 3)), distance_m=rng.uniform(1, 5, 6))
    points = known.camera_in_world_m + rng.normal(0, 4, (6, 3))
    step = 1e-6 * rng.standard_normal((6, 3))
    residual, by_point = known.residuals(points)
    far_m = np.linalg.norm(points - known.camera_in_world_m, axis=1)
    np.testing.assert_allclose(np.exp(2.0 * residual) * known.distance_m, far_m)
    np.testing.assert_allclose(known.residuals(points + step)[0] - residual, np.sum(by_point * step, axis=1), rtol=1e-4)
    # a short step is the step; of a long one towards the camera and beyond, the point stays before it
    np.testing.assert_allclose(known.after(points, step) - points, step, atol=1e-11)
    away = points - known.camera_in_world_m
    for share in (-3.0, 100.0):
        ahead = known.after(points, share * away) - known.camera_in_world_m
        np.testing.assert_allclose(ahead / np.linalg.norm(ahead, axis=1)[:, None], away / far_m[:, None])


def test_a_point_whose_rays_part_does_not_keep_a_solution_from_rest(small):
    """Of false matches rays may not meet before the cameras, and the likeliest point is at infinity."""
    _, problem, start, _ = small
    observations = problem.observations
    assert problem.distances is not None
    lengths = np.diff(observations.first)
    false = np.flatnonzero(lengths >= 4)[:3]
    away = start.points_m - problem.distances.camera_in_world_m
    infinite = replace(start, points_m=problem.distances.camera_in_world_m + 1e7 * away)
    at_infinity = observations.xy_px + _residuals.project(problem, infinite, observations).residual
    mine = np.isin(observations.point, false)
    parted = np.where(mine[:, None], 2 * at_infinity - observations.xy_px, observations.xy_px)
    problem = replace(problem, observations=replace(observations, xy_px=parted))
    solution = solve(problem, start)
    assert solution.converged and solution.steps < 30
    far = np.linalg.norm(solution.estimate.points_m - problem.distances.camera_in_world_m, axis=1)
    assert (far[false] > 3 * problem.distances.distance_m[false]).all() and far.max() < 1e4
    away = np.sum((solution.estimate.points_m - problem.distances.camera_in_world_m) * away, axis=1)
    assert (away > 0).all()
    without = solve(replace(problem, distances=None), start).estimate.points_m - problem.distances.camera_in_world_m
    # where nothing is known of distances, they are still on their way
    assert (np.linalg.norm(without, axis=1)[false] > 4 * far[false]).all()


def test_weights_are_the_slope_of_the_robust_cost(subtests):
    for robust_px in (0.5, 3.0):
        with subtests.test(robust_px=robust_px):
            residual = np.random.default_rng(1).normal(0, 2.0, (40, 2))
            costs, step = solver.robust_cost(residual, 0.4, robust_px), 1e-6
            for axis in range(2):
                ends = [
                    solver.robust_cost(residual + sign * step * np.eye(2)[axis], 0.4, robust_px) for sign in (1, -1)
                ]
                weight = 1 / 0.4**2 / (1 + np.sum(residual**2, axis=1) / robust_px**2)
                np.testing.assert_allclose(
                    (ends[0] - ends[1]) / (2 * step), weight * residual[:, axis], rtol=1e-6, atol=1e-8
                )
            # of small residuals, half squares over variances
            small = 1e-4 * residual
            squares = 0.5 * np.sum(small**2, axis=1) / 0.4**2
            np.testing.assert_allclose(solver.robust_cost(small, 0.4, robust_px), squares, rtol=1e-5)
            assert (costs < 0.5 * np.sum(residual**2, axis=1) / 0.4**2).all()


def test_known_numbers_stay_where_they_are(small):
    tracks, _, _, _ = small
    options = walk(4.0, readout_s=tracks.timing.readout_s or 0.0, points_per_m=100.0)
    problem, start, _ = problem_of(tracks, options, refine_intrinsics=False)
    assert problem.cameras[0].free == ()
    x = solve(problem, start).estimate
    assert _residuals.cameras_of(problem, x)[0].params == tracks.camera.params
    assert known_of(tracks, options).prior.readout_s == 0.0


def test_points_stand_in_order_of_time(small):
    _, problem, _, seen = small
    first = problem.observations.frame[problem.observations.first[:-1]]
    assert np.all(np.diff(first) >= 0) and len(seen.point_ids) == len(first)
    assert sorted(seen.point_ids) != list(seen.point_ids)


def test_the_drift_map_names_what_was_stretched_and_how_sure_it_is(small, monkeypatch):
    _, problem, start, seen = small
    monkeypatch.setattr(refinement, "LIMITS", refinement.RefineLimits(part_s=1.0))
    half = len(seen.t_s) // 2
    middle = start.imu_in_world_m[half]
    longer = start.imu_in_world_m.copy()
    longer[half:] = middle + 1.1 * (longer[half:] - middle)
    solved = factor_information(problem, start)
    by = moving(problem, start)
    parts = refinement.drift_map(problem, start, replace(start, imu_in_world_m=longer), seen.t_s, solved, by)
    assert len(parts) == 4
    assert parts[-1].percent - parts[0].percent == pytest.approx(10.0, abs=1.5)
    # by the whole covariance
    n, shared = solved.solved.shape[0], start.columns.count
    cov = np.concatenate(solved.solve(np.eye(n, n + shared), np.eye(shared, n + shared, n)))
    first, last = 15 * solved.layout.place[[0, -1]]
    jacobian = np.zeros((9, n + shared))
    jacobian[:, last : last + 15], jacobian[:, n:] = by.by_state[-1], by.by_shared[-1]
    jacobian[:3, first : first + 15] -= by.by_state[0, :3]
    jacobian[:3, n:] -= by.by_shared[0, :3]
    (found,) = find_motion_covs(np.array([len(seen.t_s) - 1]), solved, by)
    assert found == pytest.approx(jacobian @ cov @ jacobian.T, rel=1e-5, abs=1e-12)
    assert np.array(parts[-1].end_sigma_m) == pytest.approx(np.sqrt(np.diagonal(found)[:3]), rel=1e-9)
    assert 0 < parts[0].sigma_percent < 50
    # of a frame by itself nothing is said
    alone_s = np.append(seen.t_s[:-1], seen.t_s[-1] + 3.0)
    again = refinement.drift_map(problem, start, replace(start, imu_in_world_m=longer), alone_s, solved, by)
    assert len(again) == 4 and again[-1].end_s < alone_s[-1]
