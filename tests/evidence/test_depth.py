"""Scale of a path by depth maps, against rooms whose depth is computed by intersecting rays with walls."""

import math
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.types.depth import DepthMap, PinholeGrid
from colmap_inertial.evidence._surface import fit_surface
from colmap_inertial.evidence.depth import combine_blocks, scale_by_depth
from tests.helpers.depth_scenes import VIEW, Sensor, record


def test_the_scale_of_a_path_is_found_within_its_random_error():
    errors = []
    for seed in range(5):
        maps, path = record(count=40, seed=seed, unit_m=1.03)
        evidence = scale_by_depth(maps, path).evidence()
        errors.append((evidence.log_scale - math.log(1.03)) / evidence.random_sigma)
        assert evidence.random_sigma < 0.02
    assert np.mean(np.square(errors)) < 3.02  # of 5, by chance one time in a hundred
    assert abs(np.mean(errors)) < 3 / math.sqrt(5)


def test_a_sensor_that_measures_too_long_gives_a_scale_too_large_by_just_that():
    maps, path = record(count=40, seed=3)
    longer, _ = record(count=40, seed=3, sensor=Sensor(factor=1.05))
    change = scale_by_depth(longer, path).evidence().log_scale - scale_by_depth(maps, path).evidence().log_scale
    assert change == pytest.approx(math.log(1.05), abs=0.005)


@pytest.mark.parametrize("unit_m", [0.04, 7.0])
def test_a_path_of_any_unit_is_found_by_a_search(unit_m: float):
    maps, path = record(count=40, seed=5, unit_m=unit_m)
    evidence = scale_by_depth(maps, path, log_scale=None).evidence()
    assert evidence.metres_per_unit == pytest.approx(unit_m, rel=3 * evidence.random_sigma)


def test_parts_of_a_path_whose_scale_changes_tell_it():
    maps, path = record(count=60, seed=1)
    step = np.diff(path.cam_in_world, axis=0)
    step[30:] /= 1.08
    changed = np.vstack([path.cam_in_world[:1], path.cam_in_world[0] + np.cumsum(step, axis=0)])
    found = scale_by_depth(maps, replace(path, cam_in_world=changed))
    first, second = found.between(0, 9.5), found.between(10.5, 20)
    assert first is not None and second is not None
    apart = second.log_scale - first.log_scale
    assert apart == pytest.approx(math.log(1.08), abs=3 * math.hypot(first.sigma, second.sigma))


def test_a_single_wall_along_which_the_device_slides_gives_no_scale():
    wall = (((-50, -50, -3.0), (50, 50, 2.0)),)
    centres = np.stack([np.linspace(-0.8, 0.8, 30), np.zeros(30), np.zeros(30)], axis=1)
    still = np.tile(quat_from_matrix(np.eye(3)), (30, 1))
    maps, path = record(count=30, boxes=wall, path=(still, centres), sensor=Sensor(noise_m=0.002))
    with pytest.raises(NotObservableError) as error:
        scale_by_depth(maps, path)
    assert error.value.fact.code == "depth-pairs-too-few"


def test_maps_of_other_frames_are_said():
    maps, path = record(count=12)
    with pytest.raises(NotObservableError) as error:
        scale_by_depth(replace(maps, names=("x", "y")), path)
    assert error.value.fact.code == "depth-without-poses"


def test_planes_are_smooth_to_their_edges_and_steps_are_not():
    depth_m = np.full((72, 96), 2.0)
    depth_m[:, 40:] = 1.5
    depth_m += 0.001 * np.random.default_rng(0).normal(size=depth_m.shape)
    surface = fit_surface(DepthMap(depth_m=depth_m, view=VIEW))
    assert not surface.smooth[:, 38:42].any()
    assert surface.smooth[10:-10, 10:30].all() and surface.smooth[10:-10, 50:-10].all()
    assert np.abs(1 / surface.inverse[10:-10, 10:30] - 2.0).max() < 0.001


def test_an_oblique_plane_is_fitted_exactly():
    rays = VIEW.rays()
    normal = np.array([0.4, -0.3, 1.0])
    depth_m = 2.0 / (rays @ normal)  # of points with normal . x = 2
    surface = fit_surface(DepthMap(depth_m=depth_m, view=VIEW))
    inside = np.s_[10:-10, 10:-10]
    np.testing.assert_allclose(surface.inverse[inside], (rays @ normal / 2.0)[inside], rtol=1e-9)
    np.testing.assert_allclose(
        surface.slope[inside], np.broadcast_to(normal[:2] / 2 / 70, surface.slope[inside].shape), atol=1e-9
    )


def test_depth_out_of_range_or_unknown_is_no_surface():
    depth_m = np.full((72, 96), 6.0)
    depth_m[:, :48] = np.nan
    assert not fit_surface(DepthMap(depth_m=depth_m, view=VIEW)).smooth.any()


def test_the_mean_of_pairs_ignores_some_that_are_wrong_and_its_error_is_that_of_blocks():
    rng = np.random.default_rng(0)
    z = []
    for _ in range(100):
        t_s = np.sort(rng.uniform(0, 30, 90))
        slow = np.interp(t_s, np.linspace(0, 30, 31), 0.01 * rng.normal(size=31))
        values = slow + 0.02 * rng.normal(size=90)
        values[rng.integers(0, 90, 6)] += 0.5
        mean, sigma = combine_blocks(t_s, values, np.full(90, 0.01))
        z.append(mean / sigma)
    assert np.mean(np.abs(z) < 1.96) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / 100)


def test_a_view_counts_in_the_same_place_in_other_pixels():
    view = PinholeGrid(width=192, height=144, focal_px=(140.0, 140.0), centre_px=(96.6, 71.2))
    small = view.resized(96, 72)
    np.testing.assert_allclose(small.rays()[30, 40], 0.5 * (view.rays()[60, 80] + view.rays()[61, 81]))
