"""Simulated pairs of all sorts: none is refused, none of two scenes is blended, and no picture is made worse.

``scripts/benchmarks/exposures.py`` does the same with photographs, recorded motion, larger pictures and more of them.
"""

import cv2
import numpy as np
import pytest

from colmap_inertial.imaging.exposure_pairs import better_alone, bring_together, first_brightness
from colmap_inertial.imaging.exposure_pairs._search import places
from colmap_inertial.imaging.restoration import load_network, lsd2
from scripts.common.simulated_exposures import TEXTURES, pairs
from scripts.common.turning_world import Turning
from tests.helpers.exposure_scenes import codes, psnr_db

SEED, WIDTH, WRONG_WIDTH = 3, 200, 240


@pytest.fixture(scope="module")
def turnings():
    return [Turning.simulated(k, duration_s=20.0) for k in range(2)]


@pytest.fixture(scope="module")
def good(turnings):
    """One of each sort near and far with a gyroscope, and far without."""
    makers = pairs(turnings, [], 4 * len(TEXTURES), SEED, width=WIDTH)
    chosen = [*range(0, len(TEXTURES), 2), *range(len(TEXTURES), 2 * len(TEXTURES), 2), *range(21, 28)]
    return [makers[k]() for k in chosen]


@pytest.fixture(scope="module")
def together(good):
    return [bring_together(p.short, p.long, gyro=p.gyro, stated_gain=p.gain) for p in good]


def test_no_good_pair_is_refused_however_far_the_camera_turned(good, together):
    assert len(good) >= 14 and sum(p.gyro is None for p in good) >= 7
    assert [p.kind for p, t in zip(good, together, strict=True) if not t.registered.alike] == []
    for pair, found in zip(good, together, strict=True):
        rows, columns = pair.shift_px.shape[:2]
        error = np.linalg.norm(found.registered.shift_px[:rows, :columns] - pair.shift_px, axis=2)
        # what hands do unevenly during the long exposure moves its centre
        assert np.nanmedian(error) < 0.02 * WIDTH, pair.kind


def test_a_shift_is_found_up_to_the_farthest_and_not_beyond():
    scene = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((220, 260)).astype(np.float32), (0, 0), 1.5)
    scene -= scene.mean()
    first, second = scene[40:168, 40:200], scene[60:188, 72:232]  # 38 px of 160 away
    tells = np.ones_like(first)
    near, far = (places(first, tells, second, tells, farthest=f, turns_deg=[0.0])[0] for f in (0.1, 0.3))
    np.testing.assert_allclose(far.mapping[:2, 2], [-32, -20])
    assert far.score > 0.5 and near.score < 0.2
    assert np.hypot(*near.mapping[:2, 2]) <= 16


def test_pictures_of_two_scenes_are_never_blended(turnings):
    for maker in pairs(turnings, [], 6, SEED, width=WRONG_WIDTH, good=False):
        pair = maker()
        assert not bring_together(pair.short, pair.long, gyro=pair.gyro).registered.alike, pair.kind


def test_what_is_made_of_a_pair_is_better_than_either(good, together):
    network = load_network("lsd2", device="cpu", threads=1)
    for pair, found in list(zip(good, together, strict=True))[::3]:
        fused = 255 * lsd2.fuse(found.short, found.long, blur=found.blur, network=network)
        best = max(psnr_db(255 * found.short, pair.truth), psnr_db(pair.long, pair.truth))
        assert psnr_db(fused, pair.truth) > best + 1, pair.kind


def test_a_picture_with_many_glints_tells_all_the_same():
    rng = np.random.default_rng(4)
    light = cv2.GaussianBlur(rng.uniform(0.0, 1.0, (240, 320, 3)).astype(np.float32), (0, 0), 3)
    light = 0.3 + 2 * (light - 0.5)
    light[rng.random(light.shape[:2]) < 0.02] = 5.0
    dark = light / 10 + 0.002 * rng.standard_normal(light.shape)
    found = bring_together(codes(np.clip(dark, 0, 1)), codes(np.clip(light, 0, 1)))
    # a pixel in fifty clips, and none is far from one
    assert found.registered.alike and found.registered.agreement > 0.7


def test_the_first_gain_needs_no_alignment():
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.uniform(0.02, 0.9, (40, 60, 3)).astype(np.float32), (960, 640), interpolation=cv2.INTER_CUBIC)
    wall = np.clip(wall, 0.01, 1)
    short, long = codes(wall[:, :640] / 9), codes(wall[:, 200:840])
    assert first_brightness(short, long).gain == pytest.approx(9, rel=0.15)
    assert first_brightness(short, long, stated=8.0).gain == 8.0
    wrong = first_brightness(short, long, stated=80.0)
    assert wrong.gain == pytest.approx(9, rel=0.15) and wrong.contradicts


def test_the_first_gain_is_found_where_bright_stripes_lie_on_dark_ones(subtests):
    for seed in (5, 6):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            wall = cv2.resize(
                rng.uniform(0.02, 0.9, (40, 60, 3)).astype(np.float32), (960, 640), interpolation=cv2.INTER_CUBIC
            )
            stripes = np.where(np.arange(960) // 64 % 2, np.float32(1), np.float32(0.25))
            wall = np.clip(wall, 0.01, 1) * stripes[None, :, None]
            short, long = codes(wall[:, :640] / 9), codes(wall[:, 192:832])  # three stripes on
            assert first_brightness(short, long).gain == pytest.approx(9, rel=0.02)


def test_of_two_that_do_not_go_together_the_one_that_shows_more_is_taken(good):
    sharp = good[0]
    noise = np.random.default_rng(6).standard_normal(sharp.truth.shape)
    blurred = cv2.blur(sharp.truth, (25, 1))

    def dark(sigma):
        return codes(np.clip((sharp.truth / 255) ** 2.2 / 8 + sigma * noise, 0, 1))

    for sigma, expected in ((0.0003, "short"), (0.06, "long")):
        short = dark(sigma)
        alone = better_alone(short, blurred, first_brightness(short, blurred, stated=8.0))
        assert alone.used == expected
        assert alone.image.mean() == pytest.approx(sharp.truth.mean() / 255, rel=0.25)
    # nothing tells the gain: what shows is made bright
    short, white = dark(0.0003), np.full_like(blurred, 255)
    alone = better_alone(short, white, None)
    assert alone.used == "short" and alone.image.max() > 0.95 and alone.gain > 4
    alone = better_alone(np.zeros_like(short), blurred, None)
    assert alone.used == "long" and alone.gain == 1.0 and np.array_equal(np.rint(255 * alone.image), blurred)
