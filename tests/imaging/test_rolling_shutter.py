"""Rectified keypoints and images are those of a global shutter."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import FrameTiming
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.imaging.rolling_shutter import rectify_image, rectify_keypoints
from colmap_inertial.tools.simulate.render import ShutterCamera, colmap_camera, develop
from tests.helpers.turning_cameras import FISHEYE, LENS, PINHOLE, handheld, room, shutter_of, turning
from tests.helpers.versions import version_of

POINTS = np.random.default_rng(1).uniform([5, 5], [635, 475], (300, 2))


def test_the_reference_is_the_pose_s_instant_and_the_middle_line():
    timing = FrameTiming(names=("a",), t_s=[3.0], exposure_s=[0.01], readout_s=0.02)
    shutter = FrameShutter.of(timing, 0, width=640, height=480)
    assert shutter.reference_s() == timing.pose_t_s()[0] == pytest.approx(3.015)
    np.testing.assert_allclose(shutter.middle_s(np.array([3.0, 240.5])), 3.015)
    for direction, first in (("down", (9.0, 0.5)), ("up", (9, 479.5)), ("right", (0.5, 9)), ("left", (639.5, 9))):
        turned = replace(shutter, readout_direction=direction)
        np.testing.assert_allclose(turned.middle_s(np.array(first)), 3.005)


def test_steady_panning_shears_the_picture():
    gyro = turning([0.0, 1.0, 0.0])
    shutter = FrameShutter(width=640, height=480, t_s=0.7, exposure_s=0.004, readout_s=0.024)
    moved = rectify_keypoints(POINTS, gyro, colmap_camera(PINHOLE), shutter)
    angle = np.arctan((POINTS[:, 0] - 330) / 500) + (POINTS[:, 1] - 240.5) / 480 * 0.024
    np.testing.assert_allclose(moved[:, 0], 330 + 500 * np.tan(angle), atol=1e-3)


def test_points_go_where_a_global_shutter_sees_them(subtests):
    for direction in ("down", "up", "right", "left"):
        for model in (LENS, FISHEYE):
            with subtests.test(direction=direction, model=model.model):
                motion, gyro = handheld(vigour=2.0)
                camera = ShutterCamera(model=model, exposure_s=0.004, readout_s=0.03, readout_direction=direction)
                lens, shutter = colmap_camera(model), shutter_of(camera, 2.0)
                pixels = np.floor(POINTS) + 0.5
                by_row = direction in ("down", "up")
                seen_s = camera.line_start_s(2.0)[np.floor(pixels[:, 1 if by_row else 0]).astype(int)] + 0.002
                rays = np.concatenate([lens.cam_from_img(pixels)[:, :2], np.ones((300, 1))], axis=1)
                world = np.einsum("nij,nj->ni", matrix_from_quat(motion.world_from_cam_xyzw(seen_s)), rays)
                middle = matrix_from_quat(motion.world_from_cam_xyzw(np.array([camera.middle_s(2.0)])))[0]
                expected = lens.img_from_cam(world @ middle)
                moved = rectify_keypoints(pixels.astype(np.float32), gyro, lens, shutter)
                assert moved.dtype == np.float32 and np.abs(expected - pixels).max() > 4
                np.testing.assert_allclose(moved, expected, atol=5e-3)


def test_affine_shape_and_scale_with_orientation_follow_the_mapping():
    gyro = turning([0.3, 1.0, 2.0])
    shutter = FrameShutter(width=640, height=480, t_s=0.7, exposure_s=0.0, readout_s=0.03)
    camera = colmap_camera(LENS)
    scale, angle = 3.0, 0.7
    affine = scale * np.array([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)])
    six = np.hstack([POINTS, np.tile(affine, (300, 1))])
    four = np.hstack([POINTS, np.tile([scale, angle], (300, 1))])
    out_six = rectify_keypoints(six, gyro, camera, shutter)
    out_four = rectify_keypoints(four, gyro, camera, shutter)
    np.testing.assert_allclose(out_six[:, :2], out_four[:, :2])
    # a point a little beside the keypoint, along its first axis, goes to the same place beside the moved one
    beside = rectify_keypoints(POINTS + 0.01 * affine[[0, 2]], gyro, camera, shutter)
    np.testing.assert_allclose((beside - out_six[:, :2]) / 0.01, out_six[:, [2, 4]], atol=0.02)
    matrix = out_six[:, 2:].reshape(-1, 2, 2)
    np.testing.assert_allclose(out_four[:, 2], np.sqrt(np.linalg.det(matrix)), rtol=1e-6)
    np.testing.assert_allclose(out_four[:, 3], np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0]), atol=1e-6)
    assert np.abs(out_four[:, 2:] - [scale, angle]).max() > 0.01
    five = np.hstack([POINTS, np.ones((300, 3))])
    np.testing.assert_array_equal(rectify_keypoints(five, gyro, camera, shutter)[:, 2:], 1)


@pytest.mark.parametrize("direction", ["down", "right"])
def test_a_rectified_picture_is_the_global_shutter_s(direction):
    model = replace(LENS, width=320, height=240, params=(300, 302, 161, 119, 0.12, -0.2, 0.001, -0.0005))
    motion, gyro = handheld(vigour=2.0)
    renderer = room()
    rolling = ShutterCamera(model=model, exposure_s=0.0, readout_s=0.03, readout_direction=direction)
    still = replace(rolling, readout_s=0.0)
    picture = develop(renderer.linear(rolling, motion, 2.0), rolling, None)
    truth = develop(renderer.linear(still, motion, rolling.middle_s(2.0)), still, None).astype(float)
    rectified, covered = rectify_image(picture, gyro, colmap_camera(model), shutter_of(rolling, 2.0))
    assert covered.shape == (240, 320) and 0.85 < covered.mean() < 1 and not rectified[~covered].any()
    well = cv2.erode(covered.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    before = np.sqrt(np.mean((picture[well] - truth[well]) ** 2))
    after = np.sqrt(np.mean((rectified[well] - truth[well]) ** 2))
    assert after < 0.3 * before


def test_image_and_keypoints_are_moved_alike():
    _, gyro = handheld()
    lens = colmap_camera(LENS)
    shutter = FrameShutter(width=640, height=480, t_s=2.0, exposure_s=0.004, readout_s=0.03)
    ramp = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1) * 64
    for axis in (0, 1):
        out, covered = rectify_image(ramp[..., axis].astype(np.uint16), gyro, lens, shutter)
        v, u = np.nonzero(cv2.erode(covered.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0))
        source = out[v, u] / 64
        if axis == 0:
            x = source
        else:
            back = rectify_keypoints(np.stack([x, source], axis=1) + 0.5, gyro, lens, shutter) - 0.5
            # OpenCV's bicubic interpolation does not reproduce a ramp to better than this; OpenCV 4's at 29 points of
            # half a million
            atol = 0.08 if version_of("cv2") >= (5,) else 0.09
            np.testing.assert_allclose(back, np.stack([u, v], axis=1), atol=atol)


def test_a_global_shutter_and_no_keypoints_change_nothing():
    gyro, camera = turning([1.0, 0, 0]), colmap_camera(LENS)
    shutter = FrameShutter(width=640, height=480, t_s=1.0, exposure_s=None)
    np.testing.assert_array_equal(rectify_keypoints(POINTS, gyro, camera, shutter), POINTS)
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    out, covered = rectify_image(image, gyro, camera, shutter)
    np.testing.assert_array_equal(out, image)
    assert covered.all()
    rolling = replace(shutter, readout_s=0.02)
    assert rectify_keypoints(np.zeros((0, 6), np.float32), gyro, camera, rolling).shape == (0, 6)


def test_a_readout_without_gyroscope_is_refused():
    shutter = FrameShutter(width=640, height=480, t_s=9.0, exposure_s=0.01, readout_s=0.02)
    with pytest.raises(NotObservableError, match="does not cover"):
        rectify_keypoints(POINTS, turning([1.0, 0, 0]), colmap_camera(LENS), shutter)
    with pytest.raises(ValueError, match="640x480"):
        rectify_image(np.zeros((48, 64), np.uint8), turning([1.0, 0, 0]), colmap_camera(LENS), shutter)
