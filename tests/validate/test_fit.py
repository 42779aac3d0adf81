"""The estimator behind the validator, against simulated corners with known truth."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.validate import parse_target
from colmap_inertial.validate.detect import Detection
from colmap_inertial.validate.fit import (
    compute_restricted_likelihood,
    estimate_ratio,
    fit_scale,
    normal_equations,
    settle,
    weigh_equations,
)
from colmap_inertial.validate.measure import fit_without_outliers
from colmap_inertial.validate.observations import Placement, linearise, triangulate
from colmap_inertial.validate.place import _place_by_pair, observe
from colmap_inertial.validate.views import View, sight
from tests.helpers.validate_scenes import default_camera, orbit

TARGET = parse_target("checkerboard:9x6:0.03")
CAMERA = default_camera()
START = Placement(log_scale=0.0, rotation=np.eye(3)[None], centre=np.zeros((1, 3)))


def simulate(
    rng, views=8, *, noise_px=0.3, wrong_px=0.0, turn_rad=0.0, shift_m=0.0, orbit_rad=0.0, range_m=0.0, poses=None
):
    """Observations of a target that the model holds at scale 1: pixels of true cameras, poses with errors."""
    poses = orbit(rng, views) if poses is None else poses
    known, sightings = [], []
    for i, pose in enumerate(poses):
        px = CAMERA.img_from_cam(TARGET.corners_m @ pose.rotation.T + pose.translation)
        px = px + rng.normal(0, noise_px, px.shape) + (wrong_px[i] if np.ndim(wrong_px) else 0)
        sightings.append(sight(i, CAMERA, Detection(part=0, corner=np.arange(len(px)), xy_px=px)))
        about_target = so3_exp(orbit_rad * rng.normal(size=3))
        rotation = so3_exp(turn_rad * rng.normal(size=3)) @ pose.rotation @ about_target.T
        centre = about_target @ pose.centre + shift_m * rng.normal(size=3)
        centre = centre * (1 + range_m * rng.normal() / np.linalg.norm(centre))
        known.append(
            View(name=str(i), path=None, camera=CAMERA, cam_from_world=rotation, cam_from_world_t=-rotation @ centre)
        )
    return observe(sightings, [0] * len(poses), [0] * len(poses), TARGET, known)


def coverage(fits) -> float:
    return float(np.mean([abs(fit.placement.log_scale) < fit.half_width_log() for fit in fits]))


def test_without_noise_the_fit_is_exact():
    fit = fit_scale(simulate(np.random.default_rng(0), noise_px=0.0), START)
    assert abs(fit.placement.log_scale) < 1e-6  # the derivative of the projection is numeric
    assert np.abs(fit.residual_px).max() < 1e-3


def test_residuals_and_their_derivative_agree_with_colmaps_projection():
    rng = np.random.default_rng(1)
    obs = simulate(rng, 2, noise_px=0.0)
    residual, in_cam, jacobian = linearise(obs, START)
    moved = in_cam + 1e-4 * rng.normal(size=in_cam.shape)
    change = CAMERA.img_from_cam(moved) - CAMERA.img_from_cam(in_cam)
    np.testing.assert_allclose(np.einsum("mij,mj->mi", jacobian, moved - in_cam), change, atol=2e-4)
    np.testing.assert_allclose(residual, 0, atol=1e-5)


def test_the_interval_covers_the_truth_as_often_as_it_says_under_corner_noise():
    rng = np.random.default_rng(2026)
    hits, log_scales, widths = 0, [], []
    runs = 140
    for _ in range(runs):
        _, fit, _ = fit_without_outliers(simulate(rng, 8, noise_px=0.3), START)
        log_scales.append(fit.placement.log_scale)
        widths.append(fit.half_width_log())
        hits += abs(log_scales[-1]) < widths[-1]
    # as close as 400 runs would be
    assert abs(hits / runs - 0.95) < 2 * np.sqrt(0.95 * 0.05 / 400)
    spread = np.std(log_scales)
    assert abs(np.mean(log_scales)) < 4 * spread / np.sqrt(400)  # no bias
    assert np.median(widths) == pytest.approx(1.96 * spread, rel=0.1)


@pytest.mark.parametrize(
    "errors",
    [{"turn_rad": 1e-3, "shift_m": 1e-3}, {"orbit_rad": 2e-3, "range_m": 2e-3}, {"turn_rad": 2e-4, "shift_m": 2e-4}],
    ids=["independent", "about the target", "small"],
)
def test_the_interval_allows_for_pose_errors_of_the_model(errors):
    rng = np.random.default_rng(3)
    fits = [fit_scale(simulate(rng, 12, **errors), START) for _ in range(40)]
    assert 0.9 <= coverage(fits) <= 0.99
    assert np.median([fit.noise.corner_px for fit in fits]) == pytest.approx(0.3, rel=0.05)


def test_the_degrees_of_freedom_are_those_of_the_scatter_of_the_variance():
    """A variance with d degrees of freedom scatters by 2 / d of its square; 40 fits say so to a quarter."""
    rng = np.random.default_rng(31)
    poses = orbit(np.random.default_rng(7), 12)
    fits = [fit_scale(simulate(rng, 12, poses=poses, orbit_rad=2e-3, range_m=2e-3), START) for _ in range(40)]
    variance = np.array([fit.sigma_log**2 for fit in fits])
    assert np.median([fit.dof for fit in fits]) == pytest.approx(2 * variance.mean() ** 2 / variance.var(), rel=0.3)


def test_treating_corners_as_independent_would_not():
    rng = np.random.default_rng(3)
    observations = [simulate(rng, 12, orbit_rad=6e-4, range_m=6e-4) for _ in range(24)]
    fits = [fit_scale(obs, START) for obs in observations]
    naive = [fit_scale(obs, START, noise=_no_pose_errors(fit)) for obs, fit in zip(observations, fits, strict=True)]
    assert coverage(naive) < 0.8 < coverage(fits)


def _no_pose_errors(fit):
    return replace(fit.noise, pose_ratio=np.zeros(5), corner_px=float(np.sqrt(np.mean(fit.residual_px**2))))


def test_the_restricted_likelihood_is_that_of_the_whole_covariance_matrix():
    rng = np.random.default_rng(4)
    obs = simulate(rng, 3, orbit_rad=1e-3)
    obs = obs.select(obs.corner % 7 == 0)
    n, b, residual = normal_equations(obs, START)
    ratio = np.array([3e-5, 2e-4, 1e-4, 4e-4, 2e-5])

    # the same from the dense covariance of all residuals
    size = n.count
    cov = np.eye(size)
    for v in range(3):
        rows = np.flatnonzero(np.repeat(obs.view == v, 2))
        bv = b[obs.view == v].reshape(-1, 6)
        cov[np.ix_(rows, rows)] += bv @ np.einsum("k,kij->ij", ratio, n.shapes[:, v]) @ bv.T
    y = residual.ravel()

    def moved(step):
        at = Placement(
            log_scale=step[0], rotation=so3_exp(step[None, 1:4]) @ START.rotation, centre=START.centre + step[4:]
        )
        return linearise(obs, at)[0].ravel()

    a = np.array([(moved(-e) - moved(e)) / 2e-6 for e in 1e-6 * np.eye(7)]).T
    inverse = np.linalg.inv(cov)
    s = a.T @ inverse @ a
    projected = inverse - inverse @ a @ np.linalg.solve(s, a.T @ inverse)
    expected = (size - 7) * np.log(y @ projected @ y) + np.linalg.slogdet(cov)[1] + np.linalg.slogdet(s)[1]
    value, gradient = compute_restricted_likelihood(n, ratio)
    assert value == pytest.approx(expected, rel=1e-6)
    for k in range(5):
        step = 1e-3 * ratio[k] * np.eye(5)[k]
        numeric = compute_restricted_likelihood(n, ratio + step)[0] - compute_restricted_likelihood(n, ratio - step)[0]
        assert gradient[k] * 2e-3 * ratio[k] == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_sizes_of_pose_errors_are_recovered():
    rng = np.random.default_rng(5)
    obs = simulate(rng, 60, orbit_rad=3e-3)
    at = fit_scale(obs, START).placement
    ratio = estimate_ratio(normal_equations(obs, at)[0])
    assert 0.3 * np.sqrt(ratio[3]) == pytest.approx(3e-3, rel=0.25)


def test_without_pose_errors_none_are_assumed():
    rng = np.random.default_rng(6)
    none = [not fit_scale(simulate(rng, 8), START).noise.pose_ratio.any() for _ in range(30)]
    assert np.mean(none) > 0.7


def test_wrong_corners_and_a_wrong_view_are_left_out():
    rng = np.random.default_rng(8)
    wrong_px = np.zeros((8, 54, 2))
    wrong_px[:4, 20:23] = [15.0, -9.0]
    wrong_px[5] = rng.normal(0, 3, (54, 2))
    obs = simulate(rng, 8, wrong_px=wrong_px)
    kept, fit, dropped = fit_without_outliers(obs, START)
    assert set(dropped) == {5}
    assert len(kept) == 7 * 54 - 12
    assert not np.isin(kept.corner[kept.view < 4], [20, 21, 22]).any()
    assert abs(fit.placement.log_scale) < fit.half_width_log() < 1e-3


def test_two_views_from_one_place_give_no_scale():
    rng = np.random.default_rng(8)
    pose = orbit(rng, 1)[0]
    fit = fit_scale(simulate(rng, poses=[pose, pose, pose]), START)
    assert fit.sigma_log > 10


def test_too_few_corners_are_refused():
    obs = simulate(np.random.default_rng(9), 2)
    with pytest.raises(NotObservableError, match="too few"):
        fit_scale(obs.select(np.arange(len(obs)) < 3), START)


def test_corners_are_triangulated_from_the_cameras_alone():
    rng = np.random.default_rng(10)
    obs = simulate(rng, 6, noise_px=0.0)
    wrong = Placement(log_scale=0.02, rotation=so3_exp(np.array([[0.01, 0, 0.02]])), centre=np.full((1, 3), 0.005))
    corner, in_world, determined = triangulate(obs, wrong)
    assert determined.all()
    np.testing.assert_allclose(in_world, TARGET.corners_m[corner], atol=1e-7)
    once = obs.select(obs.view == 0)
    assert not triangulate(once, START)[2].any()


def test_a_start_that_is_far_off_comes_to_rest_at_the_truth(subtests):
    for axis in range(3):
        for turn_rad in (-2.1, 2.1):
            with subtests.test(axis=axis, turn_rad=turn_rad):
                obs = simulate(np.random.default_rng(14), 4, noise_px=0.0)
                turned = Placement(
                    log_scale=0.1,
                    rotation=so3_exp(turn_rad * np.eye(3)[axis])[None],
                    centre=np.array([[0.05, -0.05, 0.02]]),
                )
                found = settle(obs, turned)
                assert abs(found.log_scale) < 1e-6
                np.testing.assert_allclose(found.rotation[0], np.eye(3), atol=1e-6)
                with pytest.raises(NotObservableError, match="does not converge"):
                    settle(obs, turned, most_iterations=1)


def test_with_pose_errors_the_fit_rests_where_these_weigh_as_they_are():
    obs = simulate(np.random.default_rng(15), 6, turn_rad=2e-3, shift_m=2e-3)
    plain = settle(obs, START)
    none = settle(obs, START, pose_ratio=np.zeros(5))
    assert none.log_scale == pytest.approx(plain.log_scale, abs=1e-12)
    ratio = (2e-3 / 0.3) ** 2 * np.ones(5)
    weighed = settle(obs, START, pose_ratio=ratio)
    _, s, rhs, _ = weigh_equations(normal_equations(obs, weighed)[0], ratio)
    _, s_plain, rhs_plain, _ = weigh_equations(normal_equations(obs, plain)[0], ratio)
    assert rhs @ np.linalg.solve(s, rhs) < 1e-3 * (rhs_plain @ np.linalg.solve(s_plain, rhs_plain))


def test_two_views_place_a_target_in_a_model_of_any_unit(subtests):
    for unit in (0.01, 1.0, 100.0):
        with subtests.test(unit=unit):
            rng, views, sightings = np.random.default_rng(16), [], []
            for i, pose in enumerate(orbit(rng, 2)):
                px = CAMERA.img_from_cam(TARGET.corners_m @ pose.rotation.T + pose.translation)
                sightings.append(sight(i, CAMERA, Detection(part=0, corner=np.arange(len(px)), xy_px=px)))
                views.append(
                    View(
                        name=str(i), path=None, camera=CAMERA, cam_from_world=pose.rotation,
                        cam_from_world_t=unit * np.asarray(pose.translation),
                    )
                )  # fmt: skip
            found = _place_by_pair(*sightings, 0, TARGET, views)
            assert found is not None and found.log_scale == pytest.approx(np.log(unit), abs=1e-5)
            # a camera that looks the other way saw nothing in front of it
            about = np.diag([-1.0, 1, -1])
            for i, view in enumerate(views):
                turned = views.copy()
                turned[i] = replace(
                    view, cam_from_world=about @ view.cam_from_world, cam_from_world_t=about @ view.cam_from_world_t
                )
                assert _place_by_pair(*sightings, 0, TARGET, turned) is None


@pytest.mark.parametrize("axis", [0, 1])
def test_corners_whose_ray_does_not_lead_back_are_left_out(axis):
    class Bent:
        """A camera that forgets a part of its distortion on one side, as a fit of it may do."""

        cam_from_img = staticmethod(CAMERA.cam_from_img)

        def img_from_cam(self, direction):
            xy = CAMERA.img_from_cam(direction)
            xy[:, axis] += 0.1 * (xy[:, axis] > 250)
            return xy

    xy = np.stack([np.linspace(100, 400, 20), np.linspace(120, 390, 20)], axis=1)
    seen = sight(0, Bent(), Detection(part=0, corner=np.arange(20), xy_px=xy))
    assert seen.corner.tolist() == np.flatnonzero(xy[:, axis] < 250).tolist()
