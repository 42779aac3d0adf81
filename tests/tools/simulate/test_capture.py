"""A simulated capture is what our own readers read, and what its truth says."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError, OutputExistsError
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.imu import read_imu
from colmap_inertial.tools.simulate import MotionOptions
from colmap_inertial.tools.simulate.capture import write_capture
from colmap_inertial.tools.simulate.recipe import SceneRecipe, load_recipe, recipe_text
from colmap_inertial.tools.simulate.render import ShutterCamera, colmap_camera
from colmap_inertial.tools.simulate.scene import make_scene
from colmap_inertial.tools.simulate.truth import read_truth, true_metres_per_unit
from colmap_inertial.tools.simulate.world import WALLS_M
from tests.helpers.cases import loop_over

SCENES = Path(__file__).resolve().parents[3] / "example_scenes"
CAMERA = ShutterCamera(
    model=CameraModel(model="OPENCV", width=160, height=120, params=(130, 130, 80, 60, 0.08, -0.12, 0.0005, -0.0003)),
    exposure_s=0.003,
)
RECIPE = SceneRecipe(
    motion=MotionOptions(kind="orbit", duration_s=1.6, heading_deg=-90.0, vigour=0.5), frame_rate_hz=2.5, camera=CAMERA
)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "pictures"
    recipe = replace(
        RECIPE,
        depth_maps=True,
        rig={"right": replace(CAMERA, cam_in_body_m=(0.1, 0.0, 0.0), exposure_s=0.001, delay_s=0.002)},
    )
    seen = []
    write_capture(recipe, folder, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i + 1, 8) for i in range(8)]
    return recipe, folder


def test_pictures_imu_and_camera_come_back_through_the_readers(written):
    recipe, folder = written
    scene = make_scene(recipe)
    capture = load_capture(folder)
    assert capture.camera.params == CAMERA.model.params and capture.target == "checkerboard:8x6:0.04"
    timing, frames = read_frames(capture)
    assert timing.names == ("000000.jpg", "000001.jpg", "000002.jpg", "000003.jpg")
    np.testing.assert_allclose(timing.t_s, scene.trigger_s, atol=1e-8)
    np.testing.assert_allclose(timing.exposure_s, 0.003)
    assert timing.readout_s == 0
    assert all(frame.image.shape == (120, 160, 3) and frame.image.std() > 20 for frame in frames)
    imu, expected = read_imu(folder), scene.imu.recording
    np.testing.assert_allclose(imu.gyro_t_s + imu.epoch_ns * 1e-9, expected.gyro_t_s, atol=1e-6)
    np.testing.assert_allclose(imu.accel_t_s + imu.epoch_ns * 1e-9, expected.accel_t_s, atol=1e-6)
    np.testing.assert_allclose(imu.gyro_rad_s, expected.gyro_rad_s, atol=1e-6)
    np.testing.assert_allclose(imu.accel_m_s2, expected.accel_m_s2, atol=1e-6)


def test_truth_holds_poses_calibration_and_depth(written):
    recipe, folder = written
    scene, truth = make_scene(recipe), read_truth(folder / "truth.json")
    middle_s = scene.trigger_s + 0.0015
    np.testing.assert_allclose(truth.trajectory.t_s, middle_s, atol=1e-12)
    np.testing.assert_allclose(truth.trajectory.cam_in_world, scene.motion.cam_in_world_m(middle_s), atol=1e-12)
    assert truth.calibration.gyro_time_offset_s == scene.imu.errors.gyro_time_offset_s
    assert truth.target == recipe.board.spec() and truth.target_corners_m.shape == (48, 3)
    depth = np.load(folder / "depth" / "000002.npy")
    rotation = matrix_from_quat(truth.trajectory.cam_from_world_xyzw[2])
    corners = (truth.target_corners_m - truth.trajectory.cam_in_world[2]) @ rotation.T
    x, y = np.floor(colmap_camera(CAMERA.model).img_from_cam(corners)).astype(int).T
    # a pixel is several millimetres of a tilted board
    np.testing.assert_allclose(depth[y, x], corners[:, 2], rtol=0.02)
    assert sorted(p.name for p in (folder / "frames_right").iterdir()) == list(truth.trajectory.names)


def test_a_camera_beside_the_body_has_its_own_pose_and_lever_arm(tmp_path):
    turn = tuple(quat_exp(np.array([0.0, 0.3, 0.1])))
    shifted = replace(RECIPE, camera=replace(CAMERA, cam_in_body_m=(0.05, 0.02, 0.0), body_from_cam_xyzw=turn))
    scene = make_scene(shifted)
    cam_from_world, centre = scene.camera_pose(shifted.camera, np.array([0.5]))
    world_from_body = scene.motion.world_from_cam_xyzw([0.5])
    np.testing.assert_allclose(
        quat_rotate(quat_conjugate(world_from_body), centre - scene.motion.cam_in_world_m([0.5]))[0],
        [0.05, 0.02, 0.0],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        quat_log(quat_multiply(quat_conjugate(world_from_body), quat_conjugate(cam_from_world)))[0],
        [0.0, 0.3, 0.1],
        atol=1e-9,
    )
    write_capture(replace(shifted, motion=replace(shifted.motion, duration_s=0.9)), tmp_path / "c")
    calibration = read_truth(tmp_path / "c" / "truth.json").calibration
    imu_in_body = np.array([0.05, 0.02, 0.0]) + quat_rotate(np.array(turn), calibration.imu_in_cam_m)
    np.testing.assert_allclose(imu_in_body, scene.imu.errors.imu_in_cam_m, atol=1e-12)


def test_video_frames_carry_exact_presentation_stamps(tmp_path):
    recipe = replace(RECIPE, format="h264", frame_rate_hz=3.7, crf=10)
    write_capture(recipe, tmp_path / "v")
    timing, frames = read_frames(tmp_path / "v")
    scene, truth = make_scene(recipe), read_truth(tmp_path / "v" / "truth.json")
    np.testing.assert_allclose(timing.t_s + timing.epoch_ns * 1e-9, scene.trigger_s, atol=2e-9)
    assert timing.names == truth.trajectory.names
    assert all(frame.image.shape == (120, 160, 3) and frame.image.std() > 20 for frame in frames)


def test_same_recipe_same_bytes_with_one_process_or_two(written, tmp_path):
    recipe = replace(RECIPE, format="png")
    write_capture(recipe, tmp_path / "once")
    write_capture(recipe, tmp_path / "again", workers=2)
    assert contents(tmp_path / "again") == contents(tmp_path / "once")
    with pytest.raises(OutputExistsError, match="exists already"):
        write_capture(recipe, tmp_path / "again")


def test_a_path_out_of_the_room_is_refused_before_any_frame_is_rendered(tmp_path):
    straight = MotionOptions(
        kind="constant_velocity", duration_s=6.0, vigour=0.0, speed_m_s=1.0, heading_deg=0.0, look_deg=90.0
    )
    recipe = replace(RECIPE, world="room", frame_rate_hz=2.0, motion=straight)
    with pytest.raises(InertialError) as refused:
        write_capture(recipe, tmp_path / "out")
    # the wall is 3.2 m away: frames at 0 to 3 s of 0 to 5.5 s are inside
    assert refused.value.code == "path-leaves-room"
    assert [refused.value.fact.values[key] for key in ("first_s", "outside", "frames")] == [3.5, 5, 12]
    assert list(tmp_path.iterdir()) == []


def test_a_default_walk_stays_in_every_room():
    for world, (low_m, high_m) in WALLS_M.items():
        for seed in range(12):
            scene = make_scene(SceneRecipe(seed=seed, world=world, motion=MotionOptions(kind="walk")))
            k = scene.motion.at(scene.trigger_s)
            assert np.all((np.array(low_m) < k.cam_in_world_m) & (k.cam_in_world_m < np.array(high_m))), (world, seed)


def test_a_walk_goes_in_a_circle_only_where_it_cannot_go_straight_on():
    walk = MotionOptions(kind="walk", vigour=0.0, speed_m_s=0.8, heading_deg=90.0)
    straight, round_about = (
        make_scene(replace(RECIPE, world="room", motion=replace(walk, duration_s=s))).motion.at(np.linspace(0, s, 500))
        for s in (2.0, 20.0)
    )
    np.testing.assert_allclose(straight.cam_in_world_m[-1], [0.0, 1.6, 0.0], atol=0.03)
    # 0.6 m are kept free of the wall to the left, 3.2 m away: the circle is 2.6 m wide
    away = round_about.cam_in_world_m - [-1.3, 0.0, 0.0]
    np.testing.assert_allclose(np.hypot(away[:, 0], away[:, 1]), 1.3, atol=0.03)
    turned = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))[-1]
    assert turned == pytest.approx(0.8 * 20.0 / 1.3, abs=0.03)
    # looking where one goes
    ahead = quat_rotate(round_about.world_from_cam_xyzw, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(np.sum(ahead * away, axis=1), 0.0, atol=0.03)
    assert (np.cross(away, ahead)[:, 2] > 1.2).all()


def test_recipes_survive_writing_and_reading(tmp_path, written):
    recipe, folder = written
    assert recipe_text(load_recipe(folder / "recipe.toml")) == recipe_text(recipe)
    assert load_recipe(folder / "recipe.toml").rig["right"].delay_s == 0.002
    for path in sorted(SCENES.glob("*/recipe.toml")):
        again = tmp_path / f"{path.parent.name}.toml"
        again.write_text(recipe_text(load_recipe(path)))
        assert again.read_text() == recipe_text(load_recipe(again))
        assert load_recipe(again).motion == load_recipe(path).motion
        assert load_recipe(again).imu == load_recipe(path).imu


@loop_over(
    ("text", "complaint"),
    [
        ("[motion]\nvigor = 1.0", "vigour"),
        ("[motion]\nkind = 'dance'", "kind"),
        ("[motion]\nduration_s = -1.0", "duration_s"),
        ("[imu]\npreset = 'drone'", "preset"),
        ("[camera]\nwidth = 0", "width"),
        ("quality = 120", "quality"),
        ("seed = 1.5", "seed"),
        ("[rig.left]\nexposure = 0.1", "exposure_s"),
    ],
)
def test_a_wrong_recipe_is_named(tmp_path, text, complaint):
    path = tmp_path / "recipe.toml"
    path.write_text(text + "\n")
    with pytest.raises(FormatError, match=complaint):
        load_recipe(path)


def test_the_true_scale_is_that_of_the_similarity(written):
    truth = read_truth(written[1] / "truth.json").trajectory
    turned = quat_rotate(quat_exp(np.array([0.4, -1.0, 2.0])), truth.cam_in_world) / 0.37 + np.array([1.0, 2.0, 3.0])
    assert abs(true_metres_per_unit(truth.names, turned, truth) - 0.37) < 1e-9
    extra = (*truth.names, "other.jpg")
    assert abs(true_metres_per_unit(extra, np.vstack([turned, [[9, 9, 9]]]), truth) - 0.37) < 1e-9
    with pytest.raises(ValueError, match="at least three"):
        true_metres_per_unit(("a", "b"), turned[:2], truth)
    with pytest.raises(FormatError, match="truth"):
        (written[1] / "other.json").write_text("{}")
        read_truth(written[1] / "other.json")


def test_the_committed_scene_agrees_with_its_truth():
    import cv2

    folder = SCENES / "desk"
    assert sum(p.stat().st_size for p in folder.rglob("*")) < 4e6
    capture, truth = load_capture(folder), read_truth(folder / "truth.json")
    timing, frames = read_frames(capture)
    assert timing.names == truth.trajectory.names
    errors = []
    for i, frame in enumerate(frames):
        if i % 9:
            continue
        rotation = matrix_from_quat(truth.trajectory.cam_from_world_xyzw[i])
        corners = (truth.target_corners_m - truth.trajectory.cam_in_world[i]) @ rotation.T
        expected = np.asarray(colmap_camera(capture.camera).img_from_cam(corners))
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        start = (expected - 0.5).astype(np.float32)
        found = cv2.cornerSubPix(grey, start, (3, 3), (-1, -1), (3, 60, 1e-3)).reshape(-1, 2)
        errors.append(found + 0.5 - expected)
    assert np.abs(np.median(np.concatenate(errors), axis=0)).max() < 0.05
    # the gyroscope turned as the camera did, by the true calibration and clock
    imu, calibration = read_imu(folder), truth.calibration
    t = imu.gyro_t_s + imu.epoch_ns * 1e-9 + calibration.gyro_time_offset_s
    inside = (t >= truth.trajectory.t_s[4]) & (t < truth.trajectory.t_s[5])
    rate = quat_rotate(calibration.cam_from_imu_xyzw, imu.gyro_rad_s[inside] - calibration.gyro_bias_rad_s)
    turned = np.array([0.0, 0.0, 0.0, 1.0])
    for step in quat_exp(rate * np.median(np.diff(t))):
        turned = quat_multiply(turned, step)
    a, b = truth.trajectory.cam_from_world_xyzw[4:6]
    np.testing.assert_allclose(quat_log(turned), quat_log(quat_multiply(a, quat_conjugate(b))), atol=0.02)


def test_synchronised_cameras_are_described_as_a_rig(tmp_path):
    right = replace(CAMERA, cam_in_body_m=(0.1, 0.02, 0.0), body_from_cam_xyzw=(0.0, 0.1, 0.0, np.sqrt(0.99)))
    later = replace(right, delay_s=0.01)
    recipe = replace(RECIPE, motion=replace(RECIPE.motion, duration_s=0.5), rig={"right": right, "later": later})
    write_capture(recipe, tmp_path / "c")
    (camera,) = load_capture(tmp_path / "c").rig
    assert camera.name == "right" and camera.camera.params == CAMERA.model.params
    truth = json.loads((tmp_path / "c" / "truth.json").read_text())
    first, second = (read_pose(frames[0]) for frames in (truth["frames"], truth["rig"]["right"]["frames"]))
    np.testing.assert_allclose(camera.cam_from_reference @ first, second, atol=1e-9)


def read_pose(frame):
    """(4, 4) cam_from_world."""
    pose = np.eye(4)
    pose[:3, :3] = matrix_from_quat(np.array(frame["cam_from_world_xyzw"]))
    pose[:3, 3] = -pose[:3, :3] @ frame["cam_in_world_m"]
    return pose
