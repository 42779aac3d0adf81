"""The parts of the imaging benchmark that its figures stand on."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.path_filters import deblur
from colmap_inertial.imaging.rolling_shutter import rectify_keypoints
from colmap_inertial.tools.simulate import SceneRecipe
from colmap_inertial.tools.simulate.render import colmap_camera
from scripts.benchmarks.imaging import kept_share, treated, verdict_on
from scripts.common import (
    imaging_baselines as baselines,
    imaging_colmap,
    imaging_metrics as metrics,
    imaging_scenes as scenes,
    imaging_shutter,
)

SIZE = (640, 360)


@cache
def pair():
    wall = scenes.drawn_walls(1, 3)[0][:620, :1000]
    return scenes.make_pairs([wall], 8.0, size=SIZE, seed=2)[0]


@cache
def frames():
    return tuple(pair().frame(i) for i in (0, 1))


def test_the_true_transfer_leads_back_and_agrees_with_the_package():
    points = np.random.default_rng(0).uniform([60, 60], [580, 300], (200, 2))
    there = pair().transferred(points)
    seen = np.isfinite(there).all(axis=1)
    assert seen.sum() > 100
    back = pair().transferred(there[seen], source=1)
    assert np.abs(back - points[seen])[np.isfinite(back).all(axis=1)].max() < 1e-3
    camera = colmap_camera(pair().model)
    rays = []
    for i, x in enumerate((points[seen], there[seen])):
        shutter = pair().shutters[i]
        at_once = rectify_keypoints(x, pair().gyro(), camera, shutter)
        ray = np.concatenate([camera.cam_from_img(at_once)[:, :2], np.ones((len(x), 1))], axis=1)
        ray = ray @ pair().turn(np.array([shutter.reference_s()]))[0].T
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    assert np.abs(rays[0] - rays[1]).max() * pair().model.params[0] < 0.05


def test_frames_are_as_blurred_as_asked_for_and_the_sharp_ones_are_not():
    for i in (0, 1):
        assert np.percentile(pair().blur(i).extent_px(), 90) == pytest.approx(8, rel=0.11)
        detail = [cv2.Laplacian(x, cv2.CV_32F).std() for x in (pair().sharp(i), pair().frame(i, noise=0))]
        assert detail[0] > 1.5 * detail[1]
    noisy = frames()[0].astype(float) - pair().frame(0, noise=0)
    assert 1 < noisy.std() < 12


def test_deblurring_helps_and_the_gate_refuses_a_wrong_axis():
    features = metrics.extract(frames()[0]), metrics.extract(frames()[1])
    before = metrics.correct_matches(pair(), *features)
    assert 20 < before[0] <= before[1]
    repeated, error_px = metrics.repeatability(pair(), *features)
    assert 0.1 < repeated < 1 and 0 < error_px < 3
    sharp = pair().sharp(0)
    blur = pair().blur(0)
    assert metrics.psnr_db(deblur(frames()[0], blur), sharp) > metrics.psnr_db(frames()[0], sharp)
    wrong = [
        replace(pair().blur(i), vector_px=pair().blur(i).vector_px[..., ::-1] * np.float32([1, -1])) for i in (0, 1)
    ]
    row = kept_share([pair()], [frames()], [wrong], verdict_on(frames(), wrong), [before[0]])
    assert row["kept"] >= 0.95


drawn_walls = cache(scenes.drawn_walls)


@pytest.mark.parametrize(("blur_px", "sky_px"), [(6.0, 330), (10.0, 420), (20.0, 420), (30.0, 420)])
def test_blurred_frames_are_treated_though_most_of_them_is_sky(blur_px, sky_px):
    rng = np.random.default_rng(4)
    walls = []
    for wall in drawn_walls(3, 8):
        below = wall[300:900, :1000].copy()
        below[:sky_px] = 0.5 + 0.003 * rng.standard_normal((sky_px, 1000), dtype=np.float32)
        walls.append(below)
    found = treated(scenes.make_pairs(walls, blur_px, size=(800, 450), seed=3))
    assert found["trusted"] is True and found["treated"] >= 0.9 * found["frames"] == 5.4, found


def test_point_spread_functions_are_lines_of_the_right_length():
    for vector in ((12.0, 5.0), (0.0, 20.0), (-3.5, 9.25)):
        spread = baselines.line(vector)
        r = spread.shape[0] // 2
        y, x = np.mgrid[-r : r + 1, -r : r + 1]
        assert spread.sum() == pytest.approx(1, abs=1e-5)
        covariance = [(spread * a * b).sum() for a, b in ((x, x), (y, y), (x, y))]
        expected = [vector[0] ** 2 / 12, vector[1] ** 2 / 12, vector[0] * vector[1] / 12]
        assert covariance == pytest.approx(expected, abs=0.4)


def test_every_way_undoes_a_uniform_blur(subtests):
    for way in (baselines.spatial_wiener, baselines.fourier_wiener, baselines.richardson_lucy_blocks, deblur):
        with subtests.test(way=way.__name__):
            sharp = pair().sharp(0)
            vector = (9.0, 4.0)
            light = cv2.filter2D(
                baselines.light_of(sharp), -1, baselines.line(vector), borderType=cv2.BORDER_REFLECT_101
            )
            blurred = baselines.encoded(light)
            result = way(blurred, BlurField.uniform(*SIZE, vector))
            assert metrics.psnr_db(result, sharp) > metrics.psnr_db(blurred, sharp) + 0.5
            assert metrics.ssim(result, sharp) > metrics.ssim(blurred, sharp)


def test_richardson_lucy_is_that_of_scikit_image():
    restoration = pytest.importorskip("skimage.restoration")
    image, spread = frames()[0], baselines.line((9.0, 4.0))
    theirs = restoration.richardson_lucy(baselines.light_of(image), spread, num_iter=baselines.ITERATIONS)
    ours = baselines.richardson_lucy(image, spread)
    assert np.abs(ours.astype(int) - baselines.encoded(theirs.astype(np.float32))).max() <= 1


def test_measures_of_likeness():
    image = frames()[0]
    assert metrics.ssim(image, image) == pytest.approx(1)
    assert metrics.psnr_db(np.full((90, 90), 110, np.uint8), np.full((90, 90), 100, np.uint8)) == pytest.approx(
        28.13, abs=0.01
    )


def test_matching_finds_a_permutation_and_nothing_in_noise():
    rng = np.random.default_rng(1)

    def features(descriptors):
        n = len(descriptors)
        unit = np.abs(descriptors) / np.linalg.norm(descriptors, axis=1, keepdims=True)
        return metrics.Features(rng.uniform(0, 100, (n, 2)), np.ones(n), unit.astype(np.float32))

    a = rng.exponential(size=(300, 128))
    order = rng.permutation(300)
    found = metrics.match(features(a), features(a[order] * rng.uniform(0.9, 1.1, (300, 128))))
    assert len(found) == 300 and (order[found[:, 1]] == found[:, 0]).all()
    assert len(metrics.match(features(a), features(rng.exponential(size=(300, 128))))) < 3


def test_rectified_keypoints_give_the_rotation_between_two_views():
    row = imaging_shutter.two_views(3, 0)
    assert row["rectified"]["rotation_deg"] < 0.2 < row["as filmed"]["rotation_deg"]
    assert row["rectified"]["inliers"] > 0.98


def test_the_exposure_of_a_recipe_gives_the_blur_asked_for():
    recipe = imaging_colmap.with_blur(SceneRecipe(seed=4), 10.0)
    again = imaging_colmap.with_blur(recipe, 20.0)
    assert again.camera.exposure_s / recipe.camera.exposure_s == pytest.approx(2, rel=0.1)


def test_similarities_are_found():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((10, 3))
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    scale, found, shift = imaging_colmap.similarity(points, 2.5 * points @ turn.T + [1, 2, 3])
    assert scale == pytest.approx(2.5) and np.allclose(found, turn) and np.allclose(shift, [1, 2, 3])
