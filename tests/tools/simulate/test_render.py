"""Rendered pictures are exact in geometry and time."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_from_matrix
from colmap_inertial.core.types import CameraModel
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import Renderer, ShutterCamera, colmap_camera, develop
from colmap_inertial.tools.simulate.textures import plaster, poster
from colmap_inertial.tools.simulate.world import Board, Quad, World, _Builder, make_world

WIDE = CameraModel(model="OPENCV", width=96, height=64, params=(80, 82, 47, 33, 0.08, -0.1, 0.001, -0.0005))
#: A small part of a picture of 640 x 480.
SMALL = CameraModel(model="OPENCV", width=48, height=32, params=(400, 404, 23, 17, 0.08, -0.1, 0.001, -0.0005))


@pytest.fixture(scope="module")
def world():
    return make_world("desk", 3)


@pytest.fixture(scope="module")
def desk(world):
    return Renderer(middle_of(world))


def middle_of(world):
    """What lies in the middle of the table, and the table: all that these tests look at."""
    near = [q for q in world.quads if np.abs(q.corner_m[:2]).max() < 0.4 or q.texture.shape == (1100, 1600, 3)]
    return replace(world, quads=tuple(near))


def handheld(vigour=1.0, seed=2):
    return make_motion(
        MotionOptions(kind="orbit", heading_deg=-90, duration_s=10.0, vigour=vigour), np.random.default_rng(seed)
    )


def brute_force(renderer, camera, motion, t_s, sub_frames=64):
    """The mean of instantaneous global-shutter pictures, each line over its own exposure.

    The readout must be a whole number of sub-frames per line.
    """
    still = replace(camera, exposure_s=0.0, readout_s=0.0)
    starts = camera.line_start_s(t_s)
    step = camera.exposure_s / sub_frames
    first = np.round((starts - starts.min()) / step).astype(int)
    np.testing.assert_allclose(starts.min() + first * step, starts, atol=1e-9)
    by_row = camera.readout_direction in ("down", "up")
    total = np.zeros((camera.model.height, camera.model.width, 3))
    for k in range(first.max() + sub_frames):
        picture = renderer.linear(still, motion, starts.min() + (k + 0.5) * step)
        line = (first <= k) & (k < first + sub_frames)
        if by_row:
            total[line] += picture[line]
        else:
            total[:, line] += picture[:, line]
    return total / sub_frames


@pytest.mark.parametrize("direction", ["down", "left"])
def test_blur_and_rolling_shutter_agree_with_64_sub_frames(desk, direction):
    lines = SMALL.height if direction == "down" else SMALL.width
    exposure_s = 0.02
    camera = ShutterCamera(
        model=SMALL, exposure_s=exposure_s, readout_s=lines * exposure_s / 64, readout_direction=direction
    )
    motion = handheld(vigour=2.0)
    picture = desk.linear(camera, motion, 4.0)
    expected = brute_force(desk, camera, motion, 4.0)
    difference = develop(picture, camera, None).astype(float) - develop(expected, camera, None)
    assert np.sqrt(np.mean(difference**2)) < 1.5
    # and both effects are there to be seen
    sharp = desk.linear(replace(camera, exposure_s=0.0, readout_s=0.0), motion, camera.middle_s(4.0))
    wrong = desk.linear(replace(camera, readout_s=0.0, exposure_s=exposure_s), motion, 4.0)
    for other in (sharp, wrong):
        visible = develop(picture, camera, None).astype(float) - develop(other, camera, None)
        assert np.sqrt(np.mean(visible**2)) > 3


def test_blur_alone_agrees_with_sub_frames_however_long(desk):
    for exposure_s in (0.004, 0.05):
        camera, motion = ShutterCamera(model=SMALL, exposure_s=exposure_s), handheld(vigour=1.5)
        difference = develop(desk.linear(camera, motion, 6.0), camera, None).astype(float) - develop(
            brute_force(desk, camera, motion, 6.0), camera, None
        )
        assert np.sqrt(np.mean(difference**2)) < 1.5


def still_at(position, turn=(0.0, 0.0, 0.0)):
    # a camera that looks along world y with z up, then turned
    base = matrix_from_quat(quat_exp(np.array(turn))) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return Motion(
        start_s=0.0,
        step_s=0.1,
        cam_in_world_m=np.tile(np.array(position, dtype=float), (20, 1)),
        world_from_cam_xyzw=np.tile(quat_from_matrix(base), (20, 1)),
    )


def wall(texture, *, size=(2.0, 1.5), distance=2.0):
    quad = Quad(
        corner_m=np.array([-size[0] / 2, distance, size[1] / 2]),
        edge_u_m=np.array([size[0], 0, 0]),
        edge_v_m=np.array([0, 0, -size[1]]),
        texture=texture,
    )
    return World(quads=(quad,), board=Board(), board_corners_m=np.zeros((48, 3)))


def test_depth_is_that_of_the_closed_form():
    renderer = Renderer(wall(np.ones((8, 8, 3), dtype=np.float32), size=(9.0, 9.0)))
    turn = np.array([0.2, -0.1, 0.3])
    motion = still_at((0.1, 0.2, -0.1), turn)
    depth = renderer.depth_m(ShutterCamera(model=WIDE), motion, 1.0)
    pixels = np.stack(np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5), axis=-1).reshape(-1, 2)
    rays = np.column_stack([colmap_camera(WIDE).cam_from_img(pixels), np.ones(len(pixels))])
    rotation = matrix_from_quat(motion.world_from_cam_xyzw([1.0]))[0]
    np.testing.assert_allclose(depth.ravel(), (2.0 - 0.2) / (rays @ rotation.T)[:, 1], rtol=1e-12)


def test_a_point_of_the_world_is_drawn_where_the_camera_projects_it(desk):
    motion, t = handheld(), 5.0
    model = CameraModel(model="OPENCV", width=640, height=480, params=(520, 522, 318, 242, 0.08, -0.1, 0.001, -0.0005))
    camera = ShutterCamera(model=model, exposure_s=1e-4)
    grey = develop(desk.linear(camera, motion, t), camera, None).mean(axis=2).astype(np.float32)
    import cv2

    world = desk.world
    at = camera.middle_s(t)
    rotation = matrix_from_quat(motion.world_from_cam_xyzw([at]))[0]
    in_cam = (world.board_corners_m - motion.cam_in_world_m([at])) @ rotation
    expected = np.asarray(colmap_camera(model).img_from_cam(in_cam))
    found = cv2.cornerSubPix(grey, (expected - 0.5).astype(np.float32), (4, 4), (-1, -1), (3, 60, 1e-4)).reshape(-1, 2)
    error = found + 0.5 - expected
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt(np.mean(error**2)) < 0.06
    depth = desk.depth_m(camera, motion, at)
    x, y = np.floor(expected).astype(int).T
    np.testing.assert_allclose(depth[y, x], in_cam[:, 2], rtol=0.01)


def test_brightness_of_a_uniform_wall_survives_development():
    renderer = Renderer(wall(np.full((64, 64, 3), 0.2, dtype=np.float32), size=(9.0, 9.0)))
    camera = ShutterCamera(model=WIDE, exposure_s=0.01, readout_s=0.02, gain=1.5, white_electrons=5000.0)
    linear = renderer.linear(camera, still_at((0, 0, 0)), 0.5)
    np.testing.assert_allclose(linear, 0.3, rtol=1e-5)
    assert np.all(develop(linear, camera, None) == round(255 * (1.055 * 0.3 ** (1 / 2.4) - 0.055)))
    noisy = develop(linear, camera, np.random.default_rng(0)).astype(float)
    light = ((noisy / 255 + 0.055) / 1.055) ** 2.4
    assert abs(light.std() / np.sqrt(0.3 / 5000 + (8 / 5000) ** 2) - 1) < 0.03


def test_cameras_of_a_rig_see_the_parallax_of_their_baseline():
    rng = np.random.default_rng(0)
    import cv2

    texture = cv2.GaussianBlur(rng.uniform(0, 1, (600, 800, 1)).astype(np.float32), (0, 0), 4)[..., None] * np.ones(3)
    renderer = Renderer(wall(texture.astype(np.float32), size=(4.0, 3.0)))
    left = ShutterCamera(model=CameraModel(model="PINHOLE", width=96, height=64, params=(80, 80, 48, 32)))
    right = replace(left, cam_in_body_m=(0.1, 0.0, 0.0))
    motion = still_at((0, 0, 0))
    a, b = (renderer.linear(camera, motion, 0.5)[..., 0] for camera in (left, right))
    # 80 px * 0.1 m / 2 m = 4 px
    np.testing.assert_allclose(a[8:-8, 12:-12], b[8:-8, 8:-16], atol=2e-3)


def test_a_room_is_closed_all_around():
    room = make_world("room", 5)
    assert len(room.quads) > 100
    motion = make_motion(MotionOptions(kind="roam", vigour=0.4), np.random.default_rng(0))
    coarse = replace(room, quads=tuple(replace(q, texture=q.texture[::16, ::16]) for q in room.quads))
    assert np.isfinite(Renderer(coarse).depth_m(ShutterCamera(model=WIDE), motion, 1.0)).all()


def test_posters_smaller_than_their_smallest_shapes_can_be_printed():
    for side in (4, 9, 12):
        assert poster(np.random.default_rng(side), side, 3 * side).shape == (side, 3 * side, 3)


def area_of(quad):
    assert quad.edge_u_m @ quad.edge_v_m == pytest.approx(0, abs=1e-12)
    return np.linalg.norm(quad.edge_u_m) * np.linalg.norm(quad.edge_v_m)


def centre_of(quad):
    return quad.corner_m + (quad.edge_u_m + quad.edge_v_m) / 2


def test_a_box_is_as_large_as_it_is_to_be_and_faces_outwards():
    builder, base, size = _Builder(np.random.default_rng(0)), np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.5, 0.7])
    builder.box(base, size, 0.4, plaster, texel_m=0.02)
    top, *sides = builder.quads
    assert top.normal == pytest.approx([0, 0, 1]) and centre_of(top) == pytest.approx(base + 0.7 * top.normal)
    # by the divergence theorem; the underside lies in the origin's plane
    volume = sum(area_of(quad) * quad.normal @ (centre_of(quad) - base) for quad in builder.quads) / 3
    assert volume == pytest.approx(size.prod())
    for quad, width, away in zip(sides, (0.3, 0.5, 0.3, 0.5), (0.25, 0.15, 0.25, 0.15), strict=True):
        assert area_of(quad) == pytest.approx(0.7 * width) and centre_of(quad)[2] == pytest.approx(0.85)
        assert quad.normal @ (centre_of(quad) - base) == pytest.approx(away)
        assert quad.texture.shape[:2] == (round(0.7 / 0.02), round(width / 0.02))
    assert np.linalg.norm(sides[1].normal - [np.cos(0.4), np.sin(0.4), 0]) == pytest.approx(0)


def test_a_tin_is_closed_all_around_and_on_top():
    builder, base = _Builder(np.random.default_rng(1)), np.array([0.2, 0.1, 0.0])
    builder.tin(base, 0.04, 0.1, plaster)
    sides, lid = builder.quads[:12], builder.quads[12:]
    for quad, following in zip(sides, [*sides[1:], sides[0]], strict=True):
        assert area_of(quad) == pytest.approx(0.1 * 2 * 0.04 * np.sin(np.pi / 12))
        assert quad.normal @ (centre_of(quad) - base) == pytest.approx(0.04 * np.cos(np.pi / 12))
        assert centre_of(quad)[2] == pytest.approx(0.05)
        assert quad.corner_m + quad.edge_u_m == pytest.approx(following.corner_m)
    ring = np.array([quad.corner_m for quad in sides])
    assert len(lid) == 6
    for quad in lid:
        assert quad.normal == pytest.approx([0, 0, 1]) and 0 <= 0.1 - centre_of(quad)[2] < 0.002
        assert centre_of(quad)[:2] == pytest.approx(base[:2])
        for corner in (quad.corner_m, quad.corner_m + quad.edge_u_m, quad.corner_m + quad.edge_v_m):
            assert np.linalg.norm((ring - corner)[:, :2], axis=1).min() < 1e-9


def test_what_faces_the_lamp_is_brighter_than_what_does_not():
    builder = _Builder(np.random.default_rng(2))
    white = np.ones((4, 6, 3), np.float32)
    right, back = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    builder.quad(np.zeros(3), right, -back, white)  # a table, from above
    builder.quad(np.zeros(3), right, back, white)  # and from below
    above, below = builder.quads
    assert above.normal == pytest.approx([0, 0, 1]) and below.normal == pytest.approx([0, 0, -1])
    assert below.texture.max() < above.texture.min() <= 1 and below.texture.min() > 0
