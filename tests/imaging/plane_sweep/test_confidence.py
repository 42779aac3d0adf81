"""Standard deviations of swept depths against noise that is known, and their measures against plain algebra."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.imaging.plane_sweep import (
    MEASURES,
    Agreement,
    confidence,
    confirm_depth,
    estimate_sigma,
    keep_certain,
    measure_pixels,
)
from colmap_inertial.imaging.plane_sweep.confidence import _measure_planes
from tests.helpers.sweep_scenes import camera, depth_of, depth_view

REFERENCE = camera((0.1, -0.4, 0.3))
OTHERS = [camera((0.1 + x, -0.4, 0.3 + z), (3 * z, -4 * x, 0)) for x, z in ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2))]


def noisy(view, sigma_px, rng):
    """Depths that are off as matches would be that are off by so many pixels."""
    exact = depth_view(view)
    _, motion_px = measured(view)
    return replace(
        exact, depth=(1 / (1 / exact.depth + rng.normal(0, sigma_px, motion_px.shape) / motion_px)).astype("f4")
    )


def measured(view):
    depth = depth_of(view)[0].astype("f4")
    ones = np.ones_like(depth)
    return measure_pixels(Agreement(depth=depth, agreeing=ones, beyond=0 * ones), view, OTHERS)


def test_noisier_depths_have_larger_standard_deviations():
    truth, typical = depth_of(REFERENCE)[0], []
    for sigma_px in (0.05, 0.15, 0.45):
        rng = np.random.default_rng(5)
        agreement = confirm_depth(noisy(REFERENCE, sigma_px, rng), [noisy(view, sigma_px, rng) for view in OTHERS])
        sigma = estimate_sigma(agreement, REFERENCE, OTHERS)
        known = agreement.depth > 0
        assert np.array_equal(sigma > 0, known)
        within = (np.abs(agreement.depth - truth) <= 2 * sigma)[known]
        assert within.mean() > 0.9
        typical.append(np.median((sigma / truth)[known]))
    # three times the noise each; in the last one few views agree
    assert 2 < typical[1] / typical[0] < 4
    assert 3 < typical[2] / typical[1] < 6


def test_depths_apart_from_their_neighbours_are_uncertain():
    exact = depth_of(REFERENCE)[0].astype("f4")
    off = exact.copy()
    off[40:43, 50:53] *= 1.15
    ones = np.ones_like(exact)
    agreement = Agreement(depth=off, agreeing=ones, beyond=0 * ones)
    sigma = estimate_sigma(agreement, REFERENCE, OTHERS)
    smooth = estimate_sigma(replace(agreement, depth=exact), REFERENCE, OTHERS)
    assert (sigma[40:43, 50:53] > 8 * smooth[40:43, 50:53]).all()
    # others see through it
    through = estimate_sigma(replace(agreement, beyond=ones), REFERENCE, OTHERS)
    assert (through > 1.5 * sigma).all()
    # nothing around that is known
    alone = np.zeros_like(exact)
    alone[20, 20] = exact[20, 20]
    lonely = estimate_sigma(replace(agreement, depth=alone), REFERENCE, OTHERS)
    assert lonely[20, 20] > 3 * smooth[20, 20] and np.count_nonzero(lonely) == 1


def test_depths_that_are_too_uncertain_are_dropped():
    depth = np.array([[1.0, 2.0, 2.0, 0.0]], dtype="f4")
    sigma = np.array([[0.044, 0.091, 0.089, 0.0]], dtype="f4")
    kept, of_kept = keep_certain(depth, sigma)
    np.testing.assert_array_equal(kept, np.array([[1.0, 0.0, 2.0, 0.0]], dtype="f4"))
    np.testing.assert_array_equal(of_kept, np.array([[0.044, 0.0, 0.089, 0.0]], dtype="f4"))


def test_motion_is_that_of_projected_points():
    _, motion_px = measured(REFERENCE)
    for x, y in ((0, 0), (60, 45), (119, 89), (10, 80)):
        squared = 0.0
        for other in OTHERS:
            # turned to the reference's orientation
            turned = replace(other, cam_from_world=REFERENCE.cam_from_world)
            places = []
            for inverse in (1e-9, 1e-6):
                matrix, offset = turned.seen_from(REFERENCE)
                u, v, w = matrix @ (x, y, 1) / inverse + offset
                places.append(np.array([u, v]) / w)
            squared += np.sum(((places[1] - places[0]) / (1e-6 - 1e-9)) ** 2)
        assert motion_px[y, x] == pytest.approx(np.sqrt(squared / len(OTHERS)), rel=1e-4)


def test_planes_are_least_squares(monkeypatch):
    rng = np.random.default_rng(2)
    inverse = (0.5 + 0.002 * np.arange(40) + 0.001 * np.arange(30)[:, None] + rng.normal(0, 0.003, (30, 40))).astype(
        "f4"
    )
    weight = (rng.random((30, 40)) * (rng.random((30, 40)) > 0.3)).astype("f4")
    found = _measure_planes(inverse, weight)
    for y, x in ((0, 0), (15, 20), (29, 39), (3, 37)):
        rows, columns = (a.ravel() for a in np.mgrid[max(0, y - 4) : min(30, y + 5), max(0, x - 4) : min(40, x + 5)])
        w, q = weight[rows, columns].astype(float), inverse[rows, columns].astype(float)
        design = np.stack([np.ones(len(rows)), columns - x, rows - y], axis=1)
        plane = np.linalg.lstsq(design * np.sqrt(w)[:, None], q * np.sqrt(w), rcond=None)[0]
        scatter = np.sqrt(np.sum(w * (q - design @ plane) ** 2) / w.sum())
        assert found[:, y, x] == pytest.approx(
            [w.sum() / 81, scatter, abs(inverse[y, x] - plane[0])], rel=2e-3, abs=1e-4
        )
    monkeypatch.setattr(confidence, "ROWS_AT_ONCE", 7)
    np.testing.assert_allclose(_measure_planes(inverse, weight), found, rtol=1e-4, atol=1e-7)


def test_measures_are_in_the_order_of_their_factors():
    measures, _ = measured(REFERENCE)
    assert len(measures) == len(MEASURES)
    agreement = confirm_depth(depth_view(REFERENCE), [depth_view(view) for view in OTHERS])
    found = dict(zip(MEASURES, measure_pixels(agreement, REFERENCE, OTHERS)[0], strict=True))
    assert (found["constant"] == 1).all()
    assert np.array_equal(found["beyond"], agreement.beyond)
