"""Blur predicted from the gyroscope is the blur of the pictures."""

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import FrameTiming, ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import blur_field, predict_blur_px
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.tools.simulate.render import ShutterCamera, colmap_camera
from tests.helpers.turning_cameras import (
    FISHEYE,
    LENS,
    PINHOLE,
    STEPS,
    handheld,
    room,
    shutter_of,
    turning,
)


def test_a_turn_about_the_optical_axis_smears_in_circles():
    motion, shutter = turning([0.0, 0.0, 1.5]), FrameShutter(width=640, height=480, t_s=0.6, exposure_s=0.02)
    camera = colmap_camera(replace(PINHOLE, params=(500.0, 500.0, 330.0, 235.0)))
    field = blur_field(motion, camera, shutter, step_px=10)
    x, y = np.meshgrid(10 * np.arange(65) + 0.5 - 330, 10 * np.arange(49) + 0.5 - 235)
    expected = 2 * np.sin(0.5 * 1.5 * 0.02) * np.stack([-y, x], axis=-1)
    np.testing.assert_allclose(field.vector_px, expected, atol=1e-4)


def test_panning_smears_along_rows_by_the_focal_length_times_the_angle():
    motion, shutter = turning([0.0, 0.8, 0.0]), FrameShutter(width=640, height=480, t_s=0.6, exposure_s=0.01)
    field = blur_field(motion, colmap_camera(PINHOLE), shutter)
    x = (16 * np.arange(field.vector_px.shape[1]) + 0.5 - 330) / 500
    expected = 500 * (np.tan(np.arctan(x) + 0.004) - np.tan(np.arctan(x) - 0.004))
    np.testing.assert_allclose(field.vector_px[15, :, 0], expected, atol=1e-3)
    assert np.abs(field.vector_px[15, :, 1]).max() < 0.05


def test_the_field_is_the_path_of_content_in_the_sharp_rolling_picture(subtests):
    """Against a fine integration of the true motion, each line at its own time, solved by brute force."""
    motion, gyro = handheld(vigour=1.5)

    def world_from_cam(t):
        return matrix_from_quat(motion.world_from_cam_xyzw(np.atleast_1d(t)))

    i, j = 12, 31
    pixel = np.array([16 * j + 0.5, 16 * i + 0.5])
    for model, direction in product((PINHOLE, LENS, FISHEYE), ("down", "up", "right", "left")):
        with subtests.test(model=model.model, direction=direction):
            camera = ShutterCamera(model=model, exposure_s=0.02, readout_s=0.025, readout_direction=direction)
            shutter, lens = shutter_of(camera, 2.0), colmap_camera(model)
            field = blur_field(gyro, lens, shutter)
            by_row = direction in ("down", "up")
            line = int(pixel[1] if by_row else pixel[0])
            middle_s = camera.line_start_s(2.0)[line] + 0.01
            ray = np.append(lens.cam_from_img(pixel[None])[0, :2], 1.0)
            ends = []
            for t in (middle_s - 0.01, middle_s + 0.01):
                seen = world_from_cam(t)[0] @ ray
                # which line of the sharp picture looks there at its own instant
                lines = np.arange(len(camera.line_start_s(2.0)))
                at = camera.line_start_s(2.0) + 0.01
                points = lens.img_from_cam(np.einsum("nji,j->ni", world_from_cam(at), seen))
                off = points[:, 1 if by_row else 0] - (lines + 0.5)
                k = int(np.flatnonzero(np.diff(np.sign(off)))[0])
                fraction = off[k] / (off[k] - off[k + 1])
                ends.append(points[k] + fraction * (points[k + 1] - points[k]))
            assert np.linalg.norm(field.vector_px[i, j]) > 2
            np.testing.assert_allclose(field.vector_px[i, j], ends[1] - ends[0], atol=0.06)


@pytest.mark.parametrize("direction", ["down", "left"])
def test_smearing_the_sharp_picture_along_the_field_gives_the_rendered_blur(direction):
    model = replace(LENS, width=160, height=120, params=(300, 302, 81, 59, 0.12, -0.2, 0.001, -0.0005))
    motion, gyro = handheld(vigour=2.0)
    renderer = room()
    camera = ShutterCamera(model=model, exposure_s=0.02, readout_s=0.02, readout_direction=direction)
    blurred = renderer.linear(camera, motion, 2.0)
    sharp = renderer.linear(replace(camera, exposure_s=0.0), motion, 2.01)
    vectors = blur_field(gyro, colmap_camera(model), shutter_of(camera, 2.0)).per_pixel().astype(np.float32)
    x, y = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(120, dtype=np.float32))

    def smeared(field):
        parts = [
            cv2.remap(sharp, x + s * field[..., 0], y + s * field[..., 1], 1, borderMode=2)
            for s in STEPS.astype(np.float32)
        ]
        return np.mean(parts, axis=0)

    inside = (slice(20, -20), slice(20, -20))
    error = {
        name: float(np.sqrt(np.mean((smeared(field)[inside] - blurred[inside]) ** 2)))
        for name, field in (("none", 0 * vectors), ("right", vectors), ("mirrored", vectors * np.float32([1, -1])))
    }
    assert np.hypot(*vectors[60, 80]) > 5
    assert error["right"] < 0.15 * error["none"] and error["right"] < 0.2 * error["mirrored"]


def test_prediction_is_the_90th_percentile_of_the_field_for_thousands_of_frames():
    _, gyro = handheld()
    t_s = np.linspace(0.1, 5.8, 3000)
    timing = FrameTiming(
        names=tuple(map(str, range(3000))), t_s=t_s, exposure_s=np.full(3000, 0.015), readout_s=0.02, epoch_ns=0
    )
    predicted = predict_blur_px(gyro, colmap_camera(LENS), timing, width=640, height=480)
    assert not any(predicted.reasons)
    for k in (10, 700, 2500):
        field = blur_field(gyro, colmap_camera(LENS), FrameShutter.of(timing, k, width=640, height=480))
        inside = field.extent_px()[:30, :40]
        np.testing.assert_allclose(predicted.px[k], np.percentile(inside, 90), rtol=0.06, atol=0.05)


def test_what_is_not_known_is_not_predicted():
    gyro, camera = turning([0.1, 0.0, 0.0]), colmap_camera(PINHOLE)
    times = {"names": ("a", "b", "c"), "t_s": [0.2, 1.0, 2.4]}
    timing = FrameTiming(**times, exposure_s=[0.01, 0.01, 0.01])
    predicted = predict_blur_px(gyro, camera, timing, width=640, height=480)
    np.testing.assert_array_equal(np.isfinite(predicted.px), [False, True, False])
    assert "does not cover" in str(predicted.reasons[0]) and predicted.reasons[1] is None
    with pytest.raises(NotObservableError, match="does not cover"):
        blur_field(gyro, camera, FrameShutter.of(timing, 0, width=640, height=480))
    unknown = predict_blur_px(gyro, camera, FrameTiming(**times), width=640, height=480)
    assert np.isnan(unknown.px).all() and "exposure time is unknown" in str(unknown.reasons[1])
    with pytest.raises(NotObservableError, match="exposure time is unknown"):
        blur_field(gyro, camera, FrameShutter(width=640, height=480, t_s=1.0, exposure_s=None))


def test_the_camera_turns_as_the_motion_does_whatever_the_clocks():
    motion, gyro = handheld()
    t = np.array([1.0, 1.0437, 3.2])
    turns = np.swapaxes(gyro.start_from_cam(t[:-1]), 1, 2) @ gyro.start_from_cam(t[1:])
    q = motion.world_from_cam_xyzw(t)
    expected = np.swapaxes(matrix_from_quat(q[:-1]), 1, 2) @ matrix_from_quat(q[1:])
    np.testing.assert_allclose(turns, expected, atol=2e-5)
    np.testing.assert_allclose(gyro.rate_in_cam_rad_s(t), motion.rate_in_cam_rad_s(t), atol=1e-3)


def test_camera_and_gyroscope_count_from_epochs_of_their_own():
    t_s = np.arange(0.0, 4.0, 0.01)
    rate = np.stack([0 * t_s, t_s, 0 * t_s], axis=1)  # tells the gyroscope's own time
    imu = ImuRecording(
        gyro_t_s=t_s, gyro_rad_s=rate, accel_t_s=[], accel_m_s2=np.zeros((0, 3)), epoch_ns=107_000_000_000
    )
    calibration = calibration_prior(Declared(cam_from_imu_xyzw=[0.0, 0.0, 0.0, 1.0], gyro_time_offset_s=-4.0))
    gyro = GyroCamera.of(imu, calibration, camera_epoch_ns=102_000_000_000)
    # the camera's 102 + 2.5 s are the gyroscope's 108.5 s: 1.5 s after its epoch
    np.testing.assert_allclose(gyro.rate_in_cam_rad_s(np.array([2.5])), [[0.0, 1.5, 0.0]], atol=1e-9)
    assert gyro.covers(np.array([2.5, 0.5]), np.array([2.6, 0.6])).tolist() == [True, False]


def test_the_gyroscope_must_cover_the_last_line_s_exposure(subtests):
    for readout_s in (0.0, 0.03):
        with subtests.test(readout_s=readout_s):
            gyro, camera = turning([0.1, 0.0, 0.0], span_s=2.0), colmap_camera(PINHOLE)
            # the gyroscope's last sample is at 1.995 + 0.254 s
            timing = FrameTiming(names=("a",), t_s=[2.22], exposure_s=[0.01], readout_s=readout_s)
            predicted = predict_blur_px(gyro, camera, timing, width=640, height=480)
            assert np.isfinite(predicted.px[0]) == (readout_s == 0)
            shutter = FrameShutter.of(timing, 0, width=640, height=480)
            if readout_s:
                with pytest.raises(NotObservableError, match="does not cover"):
                    blur_field(gyro, camera, shutter)
            else:
                blur_field(gyro, camera, shutter)


def test_no_exposure_means_no_blur():
    field = blur_field(
        turning([1.0, 0, 0]), colmap_camera(LENS), FrameShutter(width=64, height=48, t_s=1, exposure_s=0)
    )
    assert np.abs(field.vector_px).max() == 0
