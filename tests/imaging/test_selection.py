"""Corners that are followed from picture to picture, and what they say of the camera between the two."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, so3_exp, so3_log
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.imaging.selection import _Compare, _fit_rotation, _FollowedImage, _Follower
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.preparation import selection as choosing
from colmap_inertial.run.preparation.selection import _Clocks
from tests.helpers.turning_cameras import CAM_FROM_IMU, PINHOLE


def textured(seed=0, size=(700, 560)):
    noise = np.random.default_rng(seed).uniform(0, 255, size[::-1]).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def cut(picture, x, y):
    """480 by 360 px of it, as they are followed."""
    return np.ascontiguousarray(picture[y : y + 360, x : x + 480])


def test_corners_are_many_spread_over_the_picture_and_apart():
    found = _Follower().step(0, cut(textured(), 100, 100))
    xy = found.xy * 480
    assert len(found.ids) == len(set(found.ids.tolist())) >= 150
    apart = np.linalg.norm(xy[:, None] - xy, axis=2) + 1e9 * np.eye(len(xy))
    # of 200 corners each has a square of 29 px; half its side is kept free
    assert 13 < apart.min() < 20
    for right in (False, True):
        for below in (False, True):
            inside = ((xy[:, 0] > 240) == right) & ((xy[:, 1] > 180) == below)
            assert inside.mean() > 0.15


def test_corners_move_with_the_picture_and_new_ones_come_in_where_others_went():
    picture, follower = textured(1), _Follower()
    before = follower.step(0, cut(picture, 100, 100))
    now = follower.step(1, cut(picture, 106, 97))
    _, i, j = np.intersect1d(before.ids, now.ids, return_indices=True)
    moved = (now.xy[j] - before.xy[i]) * 480
    assert len(i) > 0.8 * len(before.ids) and set(now.ids.tolist()) <= set(before.ids.tolist())
    assert np.median(np.abs(moved - [-6, 3])) < 0.05
    for k in range(2, 12):  # until a third has left
        last = follower.step(k, cut(picture, 106 + 9 * k, 97 + 9 * k))
    fresh = last.ids > before.ids.max()
    assert fresh.any() and len(set(last.ids.tolist())) == len(last.ids)
    apart = np.linalg.norm(last.xy[fresh][:, None] - last.xy[~fresh], axis=2) * 480
    assert apart.min() > 10
    # a picture of another size begins anew
    other = follower.step(12, cut(picture, 0, 0)[:200])
    assert not set(other.ids.tolist()) & set(last.ids.tolist())


def test_a_sharper_picture_has_more_sharpness_and_a_small_one_is_not_enlarged():
    picture = cut(textured(), 50, 50)
    blurred = cv2.GaussianBlur(picture, (0, 0), 2)
    assert _Follower().step(0, picture).sharpness > 5 * _Follower().step(0, blurred).sharpness
    assert _Follower().step(0, np.full((40, 60), 9, np.uint8)).sharpness == 0


def test_a_rotation_is_that_of_most_rays(subtests):
    for share_wrong in (0.0, 0.25):
        with subtests.test(share_wrong=share_wrong):
            rng = np.random.default_rng(5)
            first = np.column_stack([rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)])
            turn = so3_exp(np.array([0.05, -0.12, 0.2]))
            second = first @ turn.T
            second[: int(200 * share_wrong)] += rng.uniform(-0.4, 0.4, (int(200 * share_wrong), 3))
            second *= rng.uniform(0.5, 2, (200, 1))
            found = _fit_rotation(first, second)
            assert np.linalg.norm(so3_log(found.T @ turn)) < (2e-3 if share_wrong else 1e-9)


def test_the_baseline_is_what_rotation_leaves_of_the_motion(subtests):
    """Points two metres away; a camera that turns, and one that moves by a tenth of a metre as well."""
    for by_gyroscope in (True, False):
        with subtests.test(by_gyroscope=by_gyroscope):
            rng, camera = np.random.default_rng(6), colmap_camera(PINHOLE)
            px = np.column_stack([rng.uniform(80, 560, 150), rng.uniform(80, 400, 150)])
            points = 2 * np.column_stack([np.asarray(camera.cam_from_img(px))[:, :2], np.ones(150)])
            turn = so3_exp(np.array([0.03, 0.05, -0.04]))
            known = np.stack([np.eye(3), turn.T])
            compare = _Compare(known if by_gyroscope else np.full((2, 3, 3), np.nan), camera, 640, 480)

            def followed(place, xy):
                return _FollowedImage(place, np.arange(150), np.asarray(xy) / 640, 1.0)

            before = followed(0, px)
            for step_m in (0.0, 0.1):
                moved = (points - [step_m, 0, 0]) @ turn.T
                seen = np.asarray(camera.img_from_cam(moved))
                baseline, motion, overlap = compare(before, followed(1, seen))
                assert motion == pytest.approx(np.median(np.linalg.norm(seen - px, axis=1)) / 640)
                assert overlap == 1
                turned = np.asarray(camera.img_from_cam(points @ turn.T))
                if by_gyroscope or step_m == 0:
                    off = np.median(np.linalg.norm(seen - turned, axis=1)) / 640
                    assert baseline == pytest.approx(off, abs=1e-6)
            # too few in common tell nothing but that
            few = _FollowedImage(1, np.arange(140, 290), px / 640, 1.0)
            baseline, motion, overlap = compare(before, few)
            assert np.isnan(baseline) and np.isnan(motion) and overlap == pytest.approx(10 / 150)


def test_a_clock_counts_up_to_the_limit_that_its_offset_may_err_by():
    limit_s = choosing._LIMITS.offset_s
    t_s = np.array([0.0, 61.0, 100.0, 139.0, 200.0])
    clocks = _Clocks(motion=None, oriented=False, camera=PINHOLE, note=Fact("one-clock"))
    assert clocks.usable(t_s).all() and replace(clocks, offset_sigma_s=limit_s).usable(t_s).all()
    assert not replace(clocks, offset_sigma_s=1.01 * limit_s).usable(t_s).any()
    # three and four make five, forty seconds from the middle
    walking = replace(clocks, offset_sigma_s=0.6 * limit_s, rate_sigma=0.02 * limit_s, middle_s=100.0)
    assert walking.usable(t_s).tolist() == [False, True, True, True, False]
    assert replace(walking, middle_s=170.0).usable(t_s).tolist() == [False, False, False, True, True]


AXIS = np.array([0.2, -0.6, 0.3])


def spinning(span_s=4.0):
    """A camera that turns ever quicker about one axis, and its gyroscope on another clock."""
    t_s = np.arange(0, span_s, 0.005)
    rate = np.outer(t_s, AXIS) @ matrix_from_quat(CAM_FROM_IMU)
    return GyroCamera(path=GyroPath(t_s + 7, rate, np.zeros(3)), cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=-7.0)


def clocks_of(motion, **changed):
    return _Clocks(motion=motion, oriented=False, camera=PINHOLE, note=Fact("one-clock"), **changed)


def test_without_exposures_frames_rank_by_the_mean_speed_of_a_sixtieth_or_half_the_interval():
    t_s = np.array([0.5, 1.0, 1.5, 3.0, 4.5])
    timing = FrameTiming(names=tuple("abcde"), t_s=t_s, readout_s=0.02)
    found, by = choosing._predicted(clocks_of(spinning()), timing)
    speed = np.linalg.norm(AXIS) * (t_s + (0.02 + 1 / 60) / 2)
    assert by == "speed" and found[:4] == pytest.approx(speed[:4], rel=1e-3) and np.isnan(found[4])
    quick = replace(timing, t_s=0.5 + 0.01 * np.arange(5))
    found, _ = choosing._predicted(clocks_of(spinning()), quick)
    assert found == pytest.approx(np.linalg.norm(AXIS) * (quick.t_s + (0.02 + 0.005) / 2), rel=1e-3)
    unknown, by = choosing._predicted(clocks_of(None), timing)
    assert np.isnan(unknown).all() and by == "speed"
    # where the clocks have walked apart too far, nobody knows
    walked = clocks_of(spinning(), rate_sigma=choosing._LIMITS.offset_s, middle_s=0.6)
    assert np.isnan(choosing._predicted(walked, timing)[0]).tolist() == [False, False, False, True, True]


def test_with_exposures_frames_rank_by_how_far_the_camera_turned_meanwhile():
    t_s, exposure_s = np.array([0.5, 1.0, 1.5]), np.array([0.03, 0.01, 0.02])
    timing = FrameTiming(names=tuple("abc"), t_s=t_s, exposure_s=exposure_s, readout_s=0.0)
    found, by = choosing._predicted(clocks_of(spinning()), timing)
    assert by == "speed"
    assert found == pytest.approx(np.linalg.norm(AXIS) * (t_s + exposure_s / 2) * exposure_s, rel=1e-3)
    # where the rotation between the sensors is known, by the blur in pixels
    found, by = choosing._predicted(replace(clocks_of(spinning()), oriented=True), timing)
    blur = predict_blur_px(spinning(), colmap_camera(PINHOLE), timing, width=640, height=480).px
    assert by == "blur" and np.array_equal(found, blur)


def test_a_guessed_focal_length_is_corrected_by_how_far_pixels_turn():
    guessed = CameraModel(model="SIMPLE_PINHOLE", width=640, height=480, params=(768.0, 320.0, 240.0))
    for gain, focal_px in (
        ((0.9, 1.1, 9.0), 768),
        ((0.5, 0.7, np.nan), 0.6 * 768),
        ((np.nan, 0.8, 1.0), 0.8 * 768),
        ((np.nan, np.nan, 1.0), 768),
        ((0.39, 1.0, 1.0), 768),
        ((1.0, 2.51, 1.0), 768),
        ((2.4, 2.4, 1.0), 2.4 * 768),
    ):
        assert choosing._correct_focal(guessed, gain).params == pytest.approx((focal_px, 320, 240))
