"""Depths between a few points, and the blur that a translation adds."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_rotate
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax, parallax_from_points
from colmap_inertial.imaging.psf import blur_field, predict_blur_px
from colmap_inertial.run.preparation import translation
from colmap_inertial.tools.simulate import MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import ShutterCamera, colmap_camera
from tests.helpers.turning_cameras import LENS, PINHOLE, STEPS, room, shutter_of, turning

VELOCITY = np.array([0.3, -0.1, 0.4])


def flat(depth, velocity=VELOCITY, step_px=32):
    grid = np.full(BlurField.nodes(640, 480, step_px), 1 / depth)
    return Parallax(width=640, height=480, step_px=step_px, velocity_in_cam=velocity, inverse_depth=grid)


def slanted(count, rng, beyond=0.0):
    """Points of the plane z = 2 + 0.5 x - 0.3 y that a camera sees."""
    xy = np.column_stack([rng.uniform(-beyond, 640 + beyond, count), rng.uniform(-beyond, 480 + beyond, count)])
    rays = np.column_stack([np.asarray(colmap_camera(PINHOLE).cam_from_img(xy))[:, :2], np.ones(count)])
    return rays * (2 / (rays @ [-0.5, 0.3, 1.0]))[:, None]


def test_a_still_camera_that_slides_smears_by_its_way_over_the_depth():
    still, shutter = turning([0.0, 0.0, 0.0]), FrameShutter(width=640, height=480, t_s=1.0, exposure_s=0.02)
    field = blur_field(still, colmap_camera(PINHOLE), shutter, parallax=flat(1.5))
    fx, fy, cx, cy = PINHOLE.params
    way = VELOCITY * 0.02 / 1.5
    for i, j in ((0, 0), (12, 31), (25, 7)):
        x, y = (16 * j + 0.5 - cx) / fx, (16 * i + 0.5 - cy) / fy
        ends = [np.array([x, y]) + s * way[:2] / 2 for s in (-1, 1)]
        ends = [end / (1 + s * way[2] / 2) for s, end in zip((-1, 1), ends, strict=True)]
        np.testing.assert_allclose(field.vector_px[i, j], (ends[1] - ends[0]) * [fx, fy], atol=2e-3)
    timing = FrameTiming(names=("a", "b"), t_s=np.array([1.0, 1.1]), exposure_s=np.full(2, 0.02), epoch_ns=0)
    predicted = predict_blur_px(
        still, colmap_camera(PINHOLE), timing, width=640, height=480, parallaxes={"b": flat(1.5)}
    )
    assert predicted.px[0] < 1e-6
    np.testing.assert_allclose(predicted.px[1], np.percentile(field.extent_px(), 90), rtol=0.06)


def test_smearing_a_near_scene_along_the_field_gives_the_rendered_blur():
    model = replace(LENS, width=320, height=240, params=(300, 302, 161, 119, 0.12, -0.2, 0.001, -0.0005))
    motion = make_motion(
        MotionOptions(kind="orbit", duration_s=4.0, vigour=1.5, radius_m=1.0, height_m=0.5, heading_deg=40.0),
        np.random.default_rng(3),
    )
    t = np.arange(0.0, 4.0, 1 / 400)
    gyro = GyroCamera(
        path=GyroPath(t, motion.rate_in_cam_rad_s(t), np.zeros(3)), cam_from_imu_xyzw=np.array([0, 0, 0, 1.0]),
        offset_s=0.0,
    )  # fmt: skip
    camera = ShutterCamera(model=model, exposure_s=0.03, readout_s=0.02)
    sharp_camera = replace(camera, exposure_s=0.0)
    blurred = room().linear(camera, motion, 2.0)
    sharp = room().linear(sharp_camera, motion, 2.015)
    shutter = shutter_of(camera, 2.0)
    # true depths at a few hundred places, as a model has them
    rng = np.random.default_rng(0)
    depth = room().depth_m(camera, motion, shutter.reference_s())
    rows, columns = rng.integers(0, 240, 500), rng.integers(0, 320, 500)
    rays = np.asarray(colmap_camera(model).cam_from_img(np.column_stack([columns, rows]) + 0.5))[:, :2]
    points = np.column_stack([rays, np.ones(500)]) * depth[rows, columns, None]
    state = motion.at(np.array([shutter.reference_s()]))
    velocity = matrix_from_quat(state.world_from_cam_xyzw)[0].T @ state.velocity_in_world_m_s[0]
    parallax = parallax_from_points(points, velocity, colmap_camera(model), width=320, height=240)
    x, y = np.meshgrid(np.arange(320, dtype=np.float32), np.arange(240, dtype=np.float32))
    inside = (slice(20, -20), slice(20, -20))

    def error(field):
        vectors = field.per_pixel().astype(np.float32)
        parts = [
            cv2.remap(sharp, x + s * vectors[..., 0], y + s * vectors[..., 1], 1, borderMode=2)
            for s in STEPS.astype(np.float32)
        ]
        return float(np.sqrt(np.mean((np.mean(parts, axis=0)[inside] - blurred[inside]) ** 2)))

    turned = error(blur_field(gyro, colmap_camera(model), shutter))
    both = error(blur_field(gyro, colmap_camera(model), shutter, parallax=parallax))
    assert both < 0.45 * turned
    assert error(blur_field(gyro, colmap_camera(model), shutter, parallax=replace(
        parallax, velocity_in_cam=-parallax.velocity_in_cam))) > turned  # fmt: skip


def test_depths_between_points_of_a_slanted_plane_are_those_of_the_plane():
    points = slanted(600, np.random.default_rng(1), beyond=60)
    found = parallax_from_points(points, VELOCITY, colmap_camera(PINHOLE), width=640, height=480)
    rows, columns = found.inverse_depth.shape
    at = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * found.step_px + 0.5
    rays = np.column_stack([np.asarray(colmap_camera(PINHOLE).cam_from_img(at))[:, :2], np.ones(len(at))])
    inside = (at < [640, 480]).all(axis=1)
    ratio = found.inverse_depth.ravel() / (rays @ [-0.5, 0.3, 1.0] / 2)
    assert np.median(np.abs(ratio[inside] - 1)) < 0.01 and np.abs(ratio[inside] - 1).max() < 0.08
    # between nodes it is bilinear; on them it is theirs
    rate = found.rate_at(at[:3, 0], at[[0], 1])
    np.testing.assert_allclose(rate[0], found.inverse_depth[0, :3, None] * VELOCITY, rtol=1e-6)
    halfway = found.rate_at(at[:2, 0].mean(keepdims=True), at[[0], 1])
    np.testing.assert_allclose(halfway[0, 0], rate[0, :2].mean(axis=0), rtol=1e-6)


def test_points_behind_or_too_few_tell_nothing():
    points = slanted(600, np.random.default_rng(1))
    camera = colmap_camera(PINHOLE)
    assert parallax_from_points(points[:11], VELOCITY, camera, width=640, height=480) is None
    assert parallax_from_points(-points, VELOCITY, camera, width=640, height=480) is None
    assert parallax_from_points(points + np.array([9, 0, 0]), VELOCITY, camera, width=640, height=480) is None
    # one wrong point right before the lens does not count
    wrong = np.vstack([points, [0.0, 0.0, 1e-3]])
    clean, odd = (parallax_from_points(p, VELOCITY, camera, width=640, height=480) for p in (points, wrong))
    np.testing.assert_array_equal(clean.inverse_depth, odd.inverse_depth)


def test_a_parallax_is_written_and_read_without_its_unit_of_length():
    parallax = parallax_from_points(
        slanted(300, np.random.default_rng(2)), VELOCITY, colmap_camera(PINHOLE), width=640, height=480
    )
    again = Parallax.from_json(parallax.as_json())
    x, y = np.array([3.0, 200.0, 633.0]), np.array([0.5, 470.0])
    np.testing.assert_allclose(again.rate_at(x, y), parallax.rate_at(x, y), rtol=2e-3)
    assert again.as_json() == parallax.as_json()
    for wrong in ({"velocity_in_cam": [0.0, np.nan, 1.0]}, {"inverse_depth": [[1.0]]}):
        with pytest.raises(ValueError, match=r"velocity_in_cam|inverse_depth"):
            Parallax.from_json({**parallax.as_json(), **wrong})


# --- which frames a model tells about --------------------------------------------------------------------------------

WORLD_FROM_CAM_XYZW = quat_exp(np.array([0.3, -0.2, 1.1]))
ALONG_THE_WALL = quat_rotate(WORLD_FROM_CAM_XYZW, np.array([1.0, 0, 0]))


def wall_model(names, trajectory, depth):
    """As of COLMAP, of images at poses before a wall so many units away."""
    rng = np.random.default_rng(5)
    points, images = {}, {}
    for name, centre in zip(names, trajectory.cam_in_world, strict=True):
        px = np.column_stack([rng.uniform(-300, 940, 60), rng.uniform(-300, 780, 60)])
        rays = np.column_stack([np.asarray(colmap_camera(PINHOLE).cam_from_img(px))[:, :2], np.ones(60)])
        number = len(points)
        for k, place in enumerate(centre + quat_rotate(WORLD_FROM_CAM_XYZW, depth * rays)):
            points[number + k] = SimpleNamespace(xyz=place)
        seen = [SimpleNamespace(point3D_id=number + k, has_point3D=lambda: True) for k in range(60)]
        seen.append(SimpleNamespace(point3D_id=-1, has_point3D=lambda: False))
        images[name] = SimpleNamespace(points2D=seen)
    return SimpleNamespace(points3D=points, find_image_with_name=images.get, num_reg_images=lambda: len(names))


def told_of(monkeypatch, speed_m_s, sigma_m_s, *, registered=slice(12, 29, 2)):
    """Parallaxes of 45 frames 0.25 s apart by a model of some of them, at half a metre per unit, a metre from a wall.

    Velocities are so quick and so uncertain.
    """
    names = [f"{k:03}" for k in range(45)]
    t_s = 0.25 * np.arange(45)
    trajectory = CameraTrajectory(
        names=tuple(names[registered]),
        t_s=t_s[registered],
        cam_in_world=np.outer(t_s[registered], 0.1 * ALONG_THE_WALL),
        cam_from_world_xyzw=np.tile(WORLD_FROM_CAM_XYZW * [-1, -1, -1, 1], (len(names[registered]), 1)),
        length_unit="model",
    )
    model = wall_model(names[registered], trajectory, depth=2.0)

    def smoothed(metric, imu, estimate, gravity, also_at_s):
        assert np.array_equal(metric.cam_in_world, 0.5 * trajectory.cam_in_world) and metric.length_unit == "m"
        count = len(also_at_s)
        cov = np.zeros((count, 9, 9))
        cov[:, 3:6, 3:6] = sigma_m_s**2 / 3 * np.eye(3)
        return SimpleNamespace(
            t_s=also_at_s,
            cov=cov,
            velocity_in_world=np.tile([0, float(speed_m_s), 0], (count, 1)),
            cam_in_world=np.outer(also_at_s, 0.05 * ALONG_THE_WALL),
            cam_from_world_xyzw=np.tile(WORLD_FROM_CAM_XYZW * [-1, -1, -1, 1], (count, 1)),
        )

    estimate = SimpleNamespace(metres_per_unit=0.5, gravity_in_world_m_s2=np.array([0, 0, -9.8]), rotations=None)
    monkeypatch.setattr(translation, "trajectory_from_model", lambda *_: (trajectory, ()))
    monkeypatch.setattr(translation, "estimate_scale", lambda *_, **__: estimate)
    monkeypatch.setattr(translation, "smooth_path", smoothed)
    view = SimpleNamespace(
        calibration=None,
        timing=FrameTiming(names=tuple(names), t_s=t_s, readout_s=0.0),
        camera=PINHOLE,
        timed=lambda: SimpleNamespace(imu=None),
    )
    return translation.find_parallaxes([model], view)


def test_frames_within_two_seconds_of_a_model_s_have_its_depths_and_the_camera_s_velocity(monkeypatch):
    found = told_of(monkeypatch, 1.0, 0.1)
    # images from 3 to 7 s
    assert sorted(found) == [f"{k:03}" for k in range(4, 37)]
    velocity = quat_rotate(WORLD_FROM_CAM_XYZW * [-1, -1, -1, 1], np.array([0, 1.0, 0]))
    for one in found.values():
        assert one.velocity_in_cam == pytest.approx(velocity)
        assert np.abs(one.inverse_depth - 1).max() < 1e-5


def test_velocities_count_where_they_are_known_to_three_tenths_of_what_is_not_slow(subtests):
    for speed_m_s, sigma_m_s, known in (
        (1.0, 0.29, True),
        (1.0, 0.31, False),
        (0.2, 0.059, True),
        (0.2, 0.061, False),
        (0, 0.029, True),
        (0, 0.031, False),
    ):
        with (
            subtests.test(speed_m_s=speed_m_s, sigma_m_s=sigma_m_s, known=known),
            pytest.MonkeyPatch.context() as monkeypatch,
        ):
            assert bool(told_of(monkeypatch, speed_m_s, sigma_m_s)) == known


def test_a_model_of_few_images_tells_nothing(monkeypatch):
    assert told_of(monkeypatch, 1.0, 0.1, registered=slice(12, 20))
    assert not told_of(monkeypatch, 1.0, 0.1, registered=slice(12, 19))
