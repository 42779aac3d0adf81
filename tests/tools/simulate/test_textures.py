"""Procedural textures: reflectances that pictures can show, contrast at every scale, one for each seed."""

import cv2
import numpy as np
import pytest

from colmap_inertial.tools.simulate import textures

#: Usual reflectance of each, and how far a seed's may lie from it.
MEAN = {
    "poster": (0.42, 0.2),
    "terrazzo": (0.5, 0.3),
    "wood": (0.4, 0.3),
    "fabric": (0.37, 0.15),
    "marble": (0.67, 0.15),
    "carpet": (0.4, 0.3),
}


def test_reflectances_are_those_of_things_and_few_are_cut_off(subtests):
    for name in MEAN:
        with subtests.test(name=name):
            middle, away = MEAN[name]
            for seed in range(3):
                image = getattr(textures, name)(np.random.default_rng(seed), 200, 300)
                assert image.shape == (200, 300, 3) and image.dtype == np.float32
                assert image.min() >= 0 and image.max() <= 1
                assert image.mean() == pytest.approx(middle, abs=away)
                assert np.mean((image <= 0.02) | (image >= 0.92)) < 0.25
                again, other = (getattr(textures, name)(np.random.default_rng(s), 200, 300) for s in (seed, seed + 9))
                assert np.array_equal(image, again) and not np.array_equal(image, other)
                # something to see from near and from far
                for scale in (1, 4, 16):
                    small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
                    assert np.abs(np.diff(small, axis=1)).mean() > 0.004, scale


def test_a_tartan_is_the_mean_of_its_threads(monkeypatch):
    """Without wear: along a row it changes as along any other, and along a column as along any other."""
    monkeypatch.setattr(textures, "clouds", lambda rng, height, width, **_: np.zeros((height, width), np.float32))
    image = textures.fabric(np.random.default_rng(1), 80, 120).astype(float)
    inside = (image > 0.021) & (image < 0.919)
    both = inside[:, 1:] & inside[:, :-1]
    across = np.where(both, np.diff(image, axis=1), np.nan)
    assert np.nanmax(np.nanmax(across, axis=0) - np.nanmin(across, axis=0)) < 1e-6


def test_wood_is_brown_as_its_two_colours_are_on_average():
    """Dark grain of 13, 6 and 3 per cent, light of 50, 30 and 16, half of each; both vary in brightness alone."""
    mean = np.mean([textures.wood(np.random.default_rng(s), 60, 90).mean(axis=(0, 1)) for s in range(40)], axis=0)
    dark, light = 1.15 * np.array([0.13, 0.06, 0.03]), 1.05 * np.array([0.5, 0.3, 0.16])
    assert mean == pytest.approx((dark + light) / 2, rel=0.2)
