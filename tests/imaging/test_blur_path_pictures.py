"""The path that a picture is blurred along is that of the pictures, with its sign, its middle and its curve."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.path_filters import half_quadratic, path_wiener
from colmap_inertial.imaging.psf import blur_field, blur_path
from colmap_inertial.imaging.rolling_shutter import project_by_lines, rays
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.tools.simulate.render import ShutterCamera, colmap_camera
from colmap_inertial.tools.simulate.textures import poster
from tests.helpers.far_scene import FarScene
from tests.helpers.turning_cameras import LENS, handheld, shutter_of

MODEL = replace(LENS, width=320, height=240, params=(300, 302, 161, 119, 0.12, -0.2, 0.001, -0.0005))
#: When the hand of this seed turns in a bend.
BEGIN_S, EXPOSURE_S = 2.4, 0.06


def of(path, change):
    return replace(path, path_px=change(path.path_px))


def reversed_in_time(gyro, about_s):
    """A camera that turns after an instant as it did before, and the other way round."""
    inner = gyro.path
    t = 2 * (about_s - gyro.offset_s) - inner.t_s[::-1]
    return replace(gyro, path=GyroPath(t, inner.rate_rad_s[::-1], np.zeros(3)))


@cache
def scene(direction="down", readout_s=0.02):
    """A blurred picture, the sharp one of the same shutter, and the path."""
    motion, gyro = handheld(vigour=2.0, seed=6)
    camera = ShutterCamera(model=MODEL, exposure_s=EXPOSURE_S, readout_s=readout_s, readout_direction=direction)
    lens, shutter = colmap_camera(MODEL), shutter_of(camera, BEGIN_S)
    # no finer than a sharp picture can show
    texture = cv2.GaussianBlur(poster(np.random.default_rng(5), 600, 600), (0, 0), 1)
    wall = FarScene(texture=texture, motion=motion)
    blurred = wall.linear(MODEL, shutter, samples=64)
    sharp = wall.linear(MODEL, replace(shutter, exposure_s=0.0, t_s=BEGIN_S + EXPOSURE_S / 2))
    late = reversed_in_time(gyro, shutter.reference_s())
    return (
        blurred,
        sharp,
        blur_path(gyro, lens, shutter),
        blur_path(late, lens, shutter),
        blur_field(gyro, lens, shutter),
    )


def smeared(sharp, path):
    """The mean of the picture along the path."""
    x, y = np.meshgrid(np.arange(path.width, dtype=np.float32), np.arange(path.height, dtype=np.float32))
    at = path.at(np.arange(path.height), np.arange(path.width)).astype(np.float32)
    parts = [
        cv2.remap(sharp, x + at[..., k, 0], y + at[..., k, 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        for k in range(at.shape[2])
    ]
    return np.mean(parts, axis=0)


def off(picture, truth):
    inside = (slice(24, -24), slice(24, -24))
    return float(np.sqrt(np.mean((picture[inside] - truth[inside]) ** 2)))


@pytest.mark.parametrize("direction", ["down", "left"])
def test_smearing_the_sharp_picture_along_the_path_gives_the_rendered_blur(direction):
    blurred, sharp, path, in_reverse, field = scene(direction)
    assert path.departure_px() > 1 and path.extent_px() > 8  # px
    error = {
        "right": off(smeared(sharp, path), blurred),
        "none": off(sharp, blurred),
        "straight": off(smeared(sharp, BlurPath.straight(field)), blurred),
        "sign": off(smeared(sharp, of(path, np.negative)), blurred),
        "reversed": off(smeared(sharp, in_reverse), blurred),
    }
    assert error["right"] < 0.1 * error["none"]
    assert all(error["right"] < 0.6 * error[wrong] for wrong in ("straight", "sign", "reversed")), error


def test_the_path_is_where_the_lines_see_the_content(subtests):
    """Against the fixed-point iteration that rectification uses, and the field's chord."""
    for direction in ("down", "up", "right", "left"):
        with subtests.test(direction=direction):
            _, gyro = handheld(vigour=2.0, seed=6)
            camera = ShutterCamera(model=MODEL, exposure_s=0.03, readout_s=0.02, readout_direction=direction)
            lens, shutter = colmap_camera(MODEL), shutter_of(camera, BEGIN_S)
            path = blur_path(gyro, lens, shutter)
            rows, columns = path.path_px.shape[1:3]
            nodes = np.stack(np.meshgrid(64 * np.arange(columns) + 0.5, 64 * np.arange(rows) + 0.5), axis=-1)
            directions = rays(lens, nodes.reshape(-1, 2)).reshape(rows, columns, 3)
            for k, since_s in ((0, -0.03 * 8 / 17), (8, 0.0), (13, 0.03 * 5 / 17)):
                world = np.einsum("yxij,yxj->yxi", gyro.start_from_cam(shutter.middle_s(nodes) + since_s), directions)
                seen = project_by_lines(world.reshape(-1, 3), nodes.reshape(-1, 2), gyro, lens, shutter)
                np.testing.assert_allclose(path.path_px[k], seen.reshape(nodes.shape) - nodes, atol=0.02)
            chord = blur_field(gyro, lens, shutter, step_px=64).vector_px
            np.testing.assert_allclose(path.field().vector_px, chord, atol=0.15)


def test_translation_past_what_is_near_bends_the_path_too():
    _, gyro = handheld(vigour=2.0, seed=6)
    camera = ShutterCamera(model=MODEL, exposure_s=0.03, readout_s=0.02, readout_direction="down")
    lens, shutter = colmap_camera(MODEL), shutter_of(camera, BEGIN_S)
    nodes = BlurField.nodes(320, 240, 20)
    parallax = Parallax(
        width=320, height=240, step_px=20, velocity_in_cam=[0.6, 0.2, 0.0], inverse_depth=np.full(nodes, 0.5)
    )
    alone, both = (blur_path(gyro, lens, shutter, parallax=p) for p in (None, parallax))
    field = blur_field(gyro, lens, shutter, parallax=parallax, step_px=64)
    np.testing.assert_allclose(both.field().vector_px, field.vector_px, atol=0.15)
    # 0.3 per second to the right for 0.03 s, times the focal length; the lens bends it at the corners
    moved = (both.field().vector_px - alone.field().vector_px)[1:3, 2:4]
    np.testing.assert_allclose(moved[..., 0], 300 * 0.3 * 0.03, rtol=0.1)


def test_a_longer_exposure_lengthens_the_path_around_the_same_middle():
    _, gyro = handheld(vigour=2.0, seed=6)
    lens = colmap_camera(MODEL)
    camera = ShutterCamera(model=MODEL, exposure_s=0.03, readout_s=0.02, readout_direction="down")
    short, long = shutter_of(camera, BEGIN_S), shutter_of(replace(camera, exposure_s=0.036), BEGIN_S - 0.003)
    expected = blur_path(gyro, lens, long).path_px
    np.testing.assert_allclose(blur_path(gyro, lens, short, extent_factor=1.2).path_px, expected, atol=1e-4)
    with pytest.raises(NotObservableError, match="exposure time is unknown"):
        blur_path(gyro, lens, replace(short, exposure_s=None))


def test_a_straight_path_is_the_field_and_departs_from_nothing():
    field = BlurField.uniform(300, 200, (12.0, -5.0))
    path = BlurPath.straight(field)
    np.testing.assert_allclose(path.field().vector_px, field.vector_px, rtol=1e-5)
    assert path.departure_px() < 1e-5
    bent = of(path, lambda q: q + 2.0 * np.linspace(-1, 1, len(q))[:, None, None, None] ** 2)
    assert 1.0 < bent.departure_px() < 2.0
    with pytest.raises(ValueError, match="path_px"):
        BlurPath(width=300, height=200, path_px=np.zeros((17, 2, 2, 2)))


def codes(light, seed=0, noise=0.004):
    noisy = light + noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.rint(255 * srgb_from_linear(noisy)).astype(np.uint8)


@pytest.mark.parametrize("restore", [path_wiener, half_quadratic])
def test_both_filters_undo_the_rendered_blur_along_its_path_and_no_other(restore):
    blurred, sharp, path, in_reverse, _ = scene()
    grey, truth = (np.ascontiguousarray(p[..., 1]) for p in (blurred, sharp))
    image, wanted = codes(grey), codes(truth, noise=0.0).astype(float)

    def error(along):
        return off(restore(image, along).astype(float), wanted)

    right = error(path)
    assert right < 0.75 * off(image.astype(float), wanted)
    assert right < 0.9 * error(in_reverse) and right < 0.9 * error(of(path, np.negative))
