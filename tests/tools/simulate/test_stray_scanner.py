"""A simulated Stray Scanner folder is read without a description, and its sensors find the truth."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.device_folders import read_device_folder
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.imu import read_imu
from colmap_inertial.run.commands.scale import ScaleSource, scale_source
from colmap_inertial.tools.simulate import MotionOptions, SceneRecipe, ShutterCamera, write_capture
from colmap_inertial.tools.simulate.recipe import load_recipe, recipe_text
from colmap_inertial.tools.simulate.scene import make_scene
from colmap_inertial.tools.simulate.truth import SceneTruth, read_truth, true_metres_per_unit
from tests.helpers.cases import loop_over

CAMERA = ShutterCamera(
    model=CameraModel(model="PINHOLE", width=96, height=72, params=(69.0, 70.0, 48.5, 35.2)), exposure_s=0.001
)
RECIPE = SceneRecipe(
    seed=6,
    format="stray-scanner",
    frame_rate_hz=3.0,
    motion=MotionOptions(kind="orbit", duration_s=12.0, sweep_s=12.0, heading_deg=-90.0, vigour=0.7),
    camera=CAMERA,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stray") / "8653a2142b"
    assert write_capture(RECIPE, folder) == folder
    return folder


@pytest.fixture(scope="module")
def truth(folder: Path) -> SceneTruth:
    return read_truth(folder / "truth.json")


def device_of(folder: Path) -> dict[str, float]:
    values: dict[str, float] = json.loads((folder / "truth.json").read_text())["device"]
    return values


def test_the_video_is_a_capture_of_its_own_without_a_description(folder: Path, truth: SceneTruth):
    capture = load_capture(folder)
    assert capture.shared_clock and capture.camera is not None
    np.testing.assert_allclose(capture.camera.params, CAMERA.model.params, atol=1e-9)
    timing, frames = read_frames(capture)
    assert timing.names == truth.trajectory.names
    np.testing.assert_allclose(timing.t_s + timing.epoch_ns * 1e-9, truth.trajectory.t_s, atol=2e-9)
    assert all(frame.image.shape == (72, 96, 3) and frame.image.std() > 20 for frame in frames)


def test_imu_samples_come_back_in_metres_and_with_the_sign_of_specific_force(folder: Path):
    imu, expected = read_imu(folder), make_scene(RECIPE).imu
    assert expected.errors.gyro_time_offset_s == 0
    at_s = imu.gyro_t_s + imu.epoch_ns * 1e-9
    for axis in range(3):
        np.testing.assert_allclose(
            imu.gyro_rad_s[:, axis],
            np.interp(at_s, expected.recording.gyro_t_s, expected.recording.gyro_rad_s[:, axis]),
            atol=1e-6,
        )
        # between samples of the accelerometer: its noise is .03 m/s2
        between = np.interp(at_s, expected.recording.accel_t_s, expected.recording.accel_m_s2[:, axis])
        assert np.std(imu.accel_m_s2[:, axis] - between) < 0.03
    assert np.linalg.norm(imu.accel_m_s2.mean(axis=0)) > 8


def test_the_path_is_the_true_one_in_another_world_and_in_the_device_s_metres(folder: Path, truth: SceneTruth):
    found, true = read_device_folder(folder).trajectory, truth.trajectory
    scale = true_metres_per_unit(true.names, found.cam_in_world, true)
    assert scale == pytest.approx(device_of(folder)["path_metres_per_unit"], rel=1e-6)
    # what is up in the simulator, z, is y for ARKit
    np.testing.assert_allclose(np.corrcoef(found.cam_in_world[:, 1], true.cam_in_world[:, 2])[0, 1], 1.0, atol=0.01)
    of_found, of_true = (matrix_from_quat(path.cam_from_world_xyzw) for path in (found, true))
    steps = [turns[1:] @ np.swapaxes(turns[:-1], 1, 2) for turns in (of_found, of_true)]
    np.testing.assert_allclose(steps[0], steps[1], atol=0.01)


def test_depth_at_the_board_is_that_of_its_corners_times_the_sensor_s_factor(folder: Path, truth: SceneTruth):
    maps = read_device_folder(folder).depth
    assert maps is not None and len(maps) == len(truth.trajectory)
    ratios = []
    for i in range(0, len(maps), 3):
        rotation = matrix_from_quat(truth.trajectory.cam_from_world_xyzw[i])
        corners = (truth.target_corners_m - truth.trajectory.cam_in_world[i]) @ rotation.T
        depth = maps.read(f"{i:06d}")
        view = depth.view
        x, y = (corners[:, :2] / corners[:, 2:] * view.focal_px + view.centre_px).T
        inside = (x > 0) & (x < view.width) & (y > 0) & (y < view.height)
        column, row = x[inside].astype(int), y[inside].astype(int)
        ratios.append(depth.depth_m[row, column] / corners[inside, 2])
    assert np.nanmedian(np.concatenate(ratios)) == pytest.approx(device_of(folder)["depth_factor"], abs=0.004)


def test_its_sensors_find_the_scale_of_its_path(folder: Path):
    estimate = scale_source(ScaleSource(source=folder), ScaleOptions())
    assert estimate.sensors is not None
    assert [one.sensor for one in estimate.sensors.evidence] == ["imu", "depth", "device"]
    true_log = np.log(device_of(folder)["path_metres_per_unit"])
    for one in estimate.sensors.evidence:
        assert abs(one.log_scale - true_log) < 3 * one.sigma
    assert abs(estimate.sensors.log_scale - true_log) < 3 * estimate.sensors.sigma
    depth = estimate.sensors.of("depth")
    assert depth is not None
    known = depth.log_scale - np.log(device_of(folder)["depth_factor"])
    assert known == pytest.approx(true_log, abs=4 * depth.random_sigma)


def test_without_an_imu_depth_and_the_path_itself_give_metres(folder: Path, tmp_path: Path):
    shutil.copytree(folder, tmp_path / "a", ignore=shutil.ignore_patterns("imu.csv", "rgb.mp4"))
    shutil.copy(folder / "rgb.mp4", tmp_path / "a")
    assert read_device_folder(tmp_path / "a").imu is None
    estimate = scale_source(ScaleSource(source=tmp_path / "a"), ScaleOptions())
    assert estimate.sensors is not None
    assert [one.sensor for one in estimate.sensors.evidence] == ["depth", "device"]
    assert [one.sensor for one in estimate.sensors.absent] == ["imu"]
    true_log = np.log(device_of(folder)["path_metres_per_unit"])
    assert abs(estimate.sensors.log_scale - true_log) < 3 * estimate.sensors.sigma


@loop_over(
    "wrong",
    ["depth_maps = true", "[camera]\nmodel = 'OPENCV'", "[device]\nedge_seen = 2.0", "[device]\ndepth_noise = -1"],
)
def test_what_the_app_cannot_write_is_refused(wrong: str, tmp_path: Path):
    file = tmp_path / "recipe.toml"
    pinhole = "" if "camera" in wrong else "\n[camera]\nmodel = 'PINHOLE'\nparams = [500.0, 500.0, 320.0, 240.0]\n"
    file.write_text(f"format = 'stray-scanner'\n{wrong}\n{pinhole}")
    with pytest.raises(FormatError) as error:
        load_recipe(file)
    assert error.value.fact.values["fault"].code == "invalid-values"


def test_its_recipe_survives_writing_and_reading(folder: Path):
    assert recipe_text(load_recipe(folder / "recipe.toml")) == recipe_text(RECIPE)
