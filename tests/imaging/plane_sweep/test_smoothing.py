"""Depths of planes through what looks alike: against planes that are known, and noise that is known."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.imaging.plane_sweep import PLANE_MEASURES, keep_certain, measure_planes, smooth_depth, smoothing
from tests.helpers.sweep_scenes import camera

REFERENCE = camera((0.1, -0.4, 0.3))
OTHERS = [camera((0.1 + x, -0.4, 0.3 + z)) for x, z in ((1, 0), (-1, 0), (0, 1), (0, -1))]
Y, X = np.indices((REFERENCE.height, REFERENCE.width), dtype=float)
#: Two slanted things before each other, of different brightness; the border is at column 60.
NEAR = X < 60
INVERSE = np.where(NEAR, 0.9 + 0.002 * X - 0.001 * Y, 0.5 + 0.0005 * X + 0.001 * Y)
PICTURE = np.where(NEAR, 60, 180).astype(np.uint8)


def depths(noise_px=0.0, seed=0):
    """Depths that are off as matches that are off by so many pixels, and standard deviations twice as large."""
    motion_px = measure_planes(*exact(), PICTURE, REFERENCE, OTHERS)[2]
    rng = np.random.default_rng(seed)
    inverse = INVERSE + rng.normal(0, 1, INVERSE.shape) * noise_px / motion_px
    return (1 / inverse).astype("f4"), (2 * noise_px / motion_px / INVERSE**2).astype("f4")


def exact():
    return (1 / INVERSE).astype("f4"), np.full(INVERSE.shape, 0.001, dtype="f4")


def smoothed(depth, sigma, picture=PICTURE):
    return smooth_depth(depth, sigma, picture, REFERENCE, OTHERS)


def test_holes_get_the_depth_of_the_plane_on_their_side_of_an_edge():
    depth, sigma = exact()
    hole = np.zeros(depth.shape, dtype=bool)
    hole[30:36, 20:26] = hole[50:56, 52:57] = hole[50:56, 62:67] = hole[70:73, 90:93] = True
    depth[hole] = sigma[hole] = 0
    filled, of_filled = smoothed(depth, sigma)
    np.testing.assert_allclose(1 / filled[hole], INVERSE[hole], rtol=0.01)
    assert (np.abs(filled - 1 / INVERSE) <= 2 * of_filled)[hole].all()
    # what is in the middle of a hole is less certain than what is at its rim
    assert of_filled[33, 23] > of_filled[30, 20]
    # a picture that does not show the edge leaves its sides mixed
    mixed, _ = smoothed(depth, sigma, np.full_like(PICTURE, 60))
    assert np.abs(mixed * INVERSE - 1)[50:56, 52:67].max() > 0.05


def test_planes_are_closer_than_noisy_depths_and_say_by_how_much():
    for noise_px in (0.2, 0.3):
        depth, sigma = depths(noise_px)
        found, of_found = smoothed(depth, sigma)
        inner = np.abs(X - 59.5) > 6
        before, after = (np.abs(1 / values - INVERSE)[inner] for values in (depth, found))
        assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
        within = (np.abs(found - 1 / INVERSE) <= 2 * of_found)[inner]
        assert within.mean() > 0.95
        # also of a depth of its own, the smaller of two standard deviations is stated wider
        assert np.median(of_found[inner]) < smoothing._LIMITS.chosen * np.median(sigma[inner])


def test_uncertain_depths_count_less():
    depth, sigma = exact()
    wrong = np.random.default_rng(1).random(depth.shape) < 0.3
    depth[wrong] *= np.float32(1.1)
    sigma[wrong] = 0.2 * depth[wrong]
    found, _ = smoothed(depth, sigma)
    inner = np.abs(X - 59.5) > 6
    assert np.abs(found * INVERSE - 1)[inner].max() < 0.01


def test_far_from_all_depths_nothing_is_kept():
    depth, sigma = exact()
    depth[:, 30:] = sigma[:, 30:] = 0
    kept, of_kept = keep_certain(*smoothed(depth, sigma))
    assert not kept[:, 60:].any() and not of_kept[:, 60:].any()
    assert kept[:, :30].all()
    # a plane is extended, but not beyond all depths
    assert kept[kept > 0].min() >= 1 / INVERSE.max() - 1e-3
    # what has no depth at all stays so
    nothing = np.zeros_like(depth)
    for values in smoothed(nothing, nothing):
        assert not values.any()


def test_nothing_is_made_up_in_a_large_plain_picture():
    wide = camera((0, 0, 0), width=1200, height=300, focal=(1000.0, 1000.0))
    partners = [camera((x, 0, 0), width=1200, height=300, focal=(1000.0, 1000.0)) for x in (0.6, -0.6)]
    depth = np.zeros((300, 1200), dtype="f4")
    depth[:, :300] = 2
    kept, _ = keep_certain(*smooth_depth(depth, 0.002 * depth, np.full_like(depth, 90, dtype=np.uint8), wide, partners))
    assert kept[:, :300].all() and not kept[:, 340:].any()


def test_strips_leave_no_seam(monkeypatch):
    depth, sigma = depths(0.5)
    whole = smoothed(depth, sigma)
    monkeypatch.setattr(smoothing, "_LIMITS", replace(smoothing._LIMITS, rows=20))
    for parts, values in zip(smoothed(depth, sigma), whole, strict=True):
        np.testing.assert_allclose(parts, values, rtol=2e-3)


def test_colours_and_greys_give_planes_alike():
    depth, sigma = depths(0.5)
    colour = np.repeat(PICTURE[..., None], 3, axis=2)
    for grey, coloured in zip(smoothed(depth, sigma), smoothed(depth, sigma, colour), strict=True):
        np.testing.assert_array_equal(grey, coloured)


def test_measures_of_a_plane_are_its_support_scatter_and_leverage():
    depth, sigma = exact()
    motion_px = measure_planes(depth, sigma, PICTURE, REFERENCE, OTHERS)[2]
    sigma = (0.7 * depth**2 / motion_px).astype("f4")
    measures, inverse, _ = measure_planes(depth, sigma, PICTURE, REFERENCE, OTHERS)
    found = dict(zip(PLANE_MEASURES, measures, strict=True))
    inner = (np.abs(X - 59.5) > 8) & (X > 20) & (X < 100) & (Y > 20) & (Y < 70)
    np.testing.assert_allclose(inverse[inner], INVERSE[inner], rtol=2e-3)
    # all depths count in full, lie on the plane, and around the pixel
    np.testing.assert_allclose(found["support"][inner], np.log(1.003), atol=0.02)
    assert np.median(np.exp(found["scatter"][inner]) - 0.05) < 0.1
    noisy, _, _ = measure_planes(depths(0.6)[0], sigma, PICTURE, REFERENCE, OTHERS)
    assert np.median(np.exp(noisy[2][inner]) - 0.05) == pytest.approx(0.6, rel=0.15)
    np.testing.assert_allclose(found["leverage"][inner], np.log(0.1), atol=0.2)
    # twice as uncertain as what counts in full: a quarter of the weight
    quarter, _, _ = measure_planes(depth, 1.5 / 0.7 * sigma, PICTURE, REFERENCE, OTHERS)
    assert np.exp(quarter[1][inner]) - 0.003 == pytest.approx(0.25, abs=0.01)
