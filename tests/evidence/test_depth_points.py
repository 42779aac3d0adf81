"""Scale of a model by depth maps at its points, in rooms whose depth is computed by intersecting rays with walls."""

import math
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types.depth import DepthMaps
from colmap_inertial.core.types.seen_points import SeenPoints
from colmap_inertial.evidence.depth_points import scale_by_points
from tests.helpers.depth_scenes import VIEW, Sensor, cast, record, walk

#: Images are four times as large as maps.
LARGER = 4
USUAL = Sensor()


def film(count=30, seed=0, *, unit_m=1.0, sensor=USUAL, points=60, depth_log=0.02):
    """Depth maps, and points of a model that counts in units of ``unit_m`` metres, at pixels of any place."""
    maps, path = record(count=count, seed=seed, sensor=sensor)
    rng = np.random.default_rng(500 + seed)
    xyzw, centres = walk(count, seed)
    seen = []
    for name, t_s, pose, centre in zip(path.names, path.t_s, matrix_from_quat(xyzw), centres, strict=True):
        xy = rng.uniform((0, 0), (VIEW.width, VIEW.height), (points, 2))
        rays = np.column_stack([(xy - VIEW.centre_px) / VIEW.focal_px, np.ones(points)])
        depth = cast(centre, rays @ pose) * np.exp(depth_log * rng.normal(size=points)) / unit_m
        size = {"width": LARGER * VIEW.width, "height": LARGER * VIEW.height}
        seen.append(
            SeenPoints(name=name, t_s=t_s, **size, xy_px=LARGER * xy, depth=depth, sigma_log=np.full(points, depth_log))
        )
    return maps, tuple(seen)


def test_the_scale_of_a_model_is_found_within_its_random_error():
    errors = []
    for seed in range(12):
        maps, seen = film(seed=seed, unit_m=0.31)
        evidence = scale_by_points(maps, seen).evidence()
        errors.append((evidence.log_scale - math.log(0.31)) / evidence.random_sigma)
        assert evidence.random_sigma < evidence.systematic_sigma
    assert np.mean(np.square(errors)) < 2.18  # of 12, by chance one time in a hundred
    assert abs(np.mean(errors)) < 3 / math.sqrt(12)


def test_a_sensor_that_measures_too_long_gives_a_scale_too_large_by_just_that():
    maps, seen = film(seed=3)
    longer, _ = film(seed=3, sensor=Sensor(factor=1.05))
    change = scale_by_points(longer, seen).evidence().log_scale - scale_by_points(maps, seen).evidence().log_scale
    assert change == pytest.approx(math.log(1.05), abs=0.003)


def test_points_of_what_hides_behind_an_edge_do_not_count():
    """Keypoints at edges belong to either surface: half of all points are put there, with the depth of the farther."""
    maps, seen = film(seed=2)
    spoilt = []
    for one in seen:
        depth_m = maps.read(one.name).depth_m
        step = np.abs(np.diff(depth_m, axis=1)) > 0.2
        rows, columns = np.nonzero(step)
        if len(rows) == 0:
            spoilt.append(one)
            continue
        at = np.random.default_rng(1).integers(0, len(rows), len(one.depth) // 2)
        xy, depth = one.xy_px.copy(), one.depth.copy()
        xy[: len(at)] = LARGER * np.column_stack([columns[at] + 1.0, rows[at] + 0.5])
        depth[: len(at)] = np.fmax(depth_m[rows[at], columns[at]], depth_m[rows[at], columns[at] + 1])
        spoilt.append(replace(one, xy_px=xy, depth=depth))
    clean, found = (scale_by_points(maps, some).evidence() for some in (seen, spoilt))
    assert abs(found.log_scale) < 2.6 * found.random_sigma
    assert found.log_scale == pytest.approx(clean.log_scale, abs=0.005)


def test_a_fifth_of_mismatches_changes_little():
    maps, seen = film(seed=4)
    wrong = [replace(one, depth=np.where(np.arange(len(one.depth)) % 5 == 0, 1.7, 1.0) * one.depth) for one in seen]
    assert scale_by_points(maps, wrong).evidence().log_scale == pytest.approx(0, abs=0.01)


def test_parts_of_a_model_whose_scale_changes_tell_it():
    maps, seen = film(count=60, seed=1)
    changed = [replace(one, depth=one.depth / (1.08 if k >= 30 else 1.0)) for k, one in enumerate(seen)]
    found = scale_by_points(maps, changed)
    middle_s = 0.5 * (seen[29].t_s + seen[30].t_s)
    first, second = found.between(0, middle_s), found.between(middle_s, seen[-1].t_s)
    assert first is not None and second is not None
    apart = second.log_scale - first.log_scale
    assert apart == pytest.approx(math.log(1.08), abs=3 * math.hypot(first.sigma, second.sigma))


def refused(maps, seen):
    with pytest.raises(NotObservableError) as error:
        scale_by_points(maps, seen)
    return error.value.fact.code


def test_what_does_not_belong_together_is_said():
    maps, seen = film(count=8)
    assert refused(replace(maps, names=("x",)), seen) == "depth-without-images"
    turned = [replace(one, width=one.height, height=one.width) for one in seen]
    assert refused(maps, turned) == "depth-of-other-images"
    few = [replace(one, xy_px=one.xy_px[:5], depth=one.depth[:5], sigma_log=one.sigma_log[:5]) for one in seen]
    assert refused(maps, few) == "depth-images-too-few"


def test_maps_under_other_names_are_the_same():
    maps, _ = film(count=4)
    own = dict(zip("abcd", maps.names, strict=True))
    renamed = maps.renamed({**own, "e": "none"})
    assert isinstance(renamed, DepthMaps) and renamed.names == tuple("abcd")
    np.testing.assert_array_equal(renamed.read("b").depth_m, maps.read(own["b"]).depth_m)
