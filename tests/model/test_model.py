"""COLMAP models: everything that carries length is scaled together, and nothing else changes."""

import shutil

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import AlreadyMetricError, FormatError, OutputExistsError, TimingError
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, so3_log
from colmap_inertial.core.types import CameraModel, FrameTiming, Similarity
from colmap_inertial.model import (
    apply_similarity,
    colmap_camera,
    find_models,
    mean_reprojection_error_px,
    read_model,
    trajectory_from_model,
)
from colmap_inertial.model.rigs import frames_of_rigs
from tests.helpers.versions import version_of

SIMILARITY = Similarity(
    scale=0.3721,
    rotation_xyzw=quat_exp(np.array([0.4, -1.1, 0.3])),
    translation_m=np.array([5.0, -2.0, 0.5]),
    cov=np.zeros((7, 7)),
    provenance="a test",
)


@pytest.fixture(scope="module")
def rig_model(tmp_path_factory):
    """A synthetic model with a two-camera rig and noisy observations, binary and text."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 7, 120
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.7
    pycolmap.synthesize_noise(noise, reconstruction)
    root = tmp_path_factory.mktemp("model")
    for kind in ("bin", "txt"):
        (root / kind).mkdir()
    reconstruction.write_binary(str(root / "bin"))
    reconstruction.write_text(str(root / "txt"))
    return root


def reprojection_errors(reconstruction):
    errors = []
    for image_id in sorted(reconstruction.reg_image_ids()):
        image = reconstruction.image(image_id)
        for point2D in image.points2D:
            if point2D.has_point3D():
                projected = image.project_point(reconstruction.point3D(point2D.point3D_id).xyz)
                errors.append(np.linalg.norm(projected - point2D.xy))
    return np.array(errors)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_cameras_points_and_rigs_scale_together(rig_model, tmp_path, kind):
    apply_similarity(rig_model / kind, tmp_path / "metric", SIMILARITY)
    before, after = read_model(rig_model / kind), read_model(tmp_path / "metric")
    rotation = matrix_from_quat(SIMILARITY.rotation_xyzw)

    def moved(x):
        return SIMILARITY.scale * rotation @ x + SIMILARITY.translation_m

    for image_id in before.reg_image_ids():
        centre = moved(before.image(image_id).projection_center())
        np.testing.assert_allclose(after.image(image_id).projection_center(), centre, atol=1e-9)
    for point_id in before.point3D_ids():
        np.testing.assert_allclose(after.point3D(point_id).xyz, moved(before.point3D(point_id).xyz), atol=1e-9)
    lengths = [
        [
            np.linalg.norm(rig.sensor_from_rig(sensor).translation)
            for rig in model.rigs.values()
            for sensor in rig.non_ref_sensors
        ]
        for model in (before, after)
    ]
    assert len(lengths[0]) == 1
    np.testing.assert_allclose(lengths[1], SIMILARITY.scale * np.array(lengths[0]), rtol=1e-9)

    errors = reprojection_errors(before)
    assert errors.mean() > 0.3
    np.testing.assert_allclose(reprojection_errors(after), errors, atol=1e-9)
    assert mean_reprojection_error_px(after) == pytest.approx(mean_reprojection_error_px(before), abs=1e-9)


def test_the_source_stays_and_a_second_time_is_refused(rig_model, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(rig_model / "bin", source)
    files = {p.name: p.read_bytes() for p in source.iterdir()}
    apply_similarity(source, tmp_path / "metric", SIMILARITY)
    assert {p.name: p.read_bytes() for p in source.iterdir()} == files
    with pytest.raises(AlreadyMetricError, match="a test"):
        apply_similarity(tmp_path / "metric", tmp_path / "again", SIMILARITY)
    with pytest.raises(OutputExistsError):
        apply_similarity(source, tmp_path / "metric", SIMILARITY)
    assert not (tmp_path / "again").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["metric", "source"]


def test_damaged_and_missing_models_are_named(rig_model, tmp_path):
    with pytest.raises(FormatError, match="no COLMAP model here"):
        find_models(tmp_path)
    broken = tmp_path / "broken"
    shutil.copytree(rig_model / "bin", broken)
    data = (broken / "points3D.bin").read_bytes()
    (broken / "points3D.bin").write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match="broken"):
        read_model(broken)


def test_submodels_are_found_by_number(rig_model, tmp_path):
    for name in ("10", "2", "notes"):
        shutil.copytree(rig_model / "txt", tmp_path / name)
    assert list(find_models(tmp_path)) == [2, 10]
    assert list(find_models(tmp_path / "10")) == [0]


def test_poses_join_with_times_by_name(rig_model):
    model = read_model(rig_model / "bin")
    names = sorted(set(frames_of_rigs([model]).values()))  # both cameras of a rig have one time
    assert len(names) == 7
    shuffled = list(np.random.default_rng(0).permutation(names))
    timing = FrameTiming(names=tuple(shuffled), t_s=10.0 + np.arange(len(names)), exposure_s=np.full(len(names), 0.02))
    trajectory, notes = trajectory_from_model(model, timing)
    assert list(trajectory.names) == shuffled
    assert notes == ()
    np.testing.assert_allclose(trajectory.t_s, timing.t_s + 0.01)
    for name, q, centre in zip(trajectory.names, trajectory.cam_from_world_xyzw, trajectory.cam_in_world, strict=True):
        pose = model.find_image_with_name(name).cam_from_world()
        np.testing.assert_allclose(-matrix_from_quat(q).T @ pose.translation, centre, atol=1e-9)

    fewer = FrameTiming(names=tuple(shuffled[:5]), t_s=np.arange(5))
    trajectory, notes = trajectory_from_model(model, fewer)
    assert len(trajectory) == 5
    assert "2 of the model's 7 images have no frame time" in str(notes[0])
    with pytest.raises(TimingError, match="names must agree"):
        trajectory_from_model(model, FrameTiming(names=("x", "y"), t_s=[0, 1]))


def test_camera_parameters_are_checked_before_colmap_sees_them():
    camera = colmap_camera(CameraModel(model="SIMPLE_RADIAL", width=640, height=480, params=(500, 320, 240, 0.1)))
    assert camera.params_info == "f, cx, cy, k"
    with pytest.raises(ValueError, match="takes fx, fy, cx, cy"):
        colmap_camera(CameraModel(model="PINHOLE", width=640, height=480, params=(500, 320, 240)))
    with pytest.raises(ValueError, match="no COLMAP camera model"):
        colmap_camera(CameraModel(model="PINHOLEE", width=640, height=480, params=(500, 500, 320, 240)))


def test_pose_covariances_are_the_scatter_of_resected_poses():
    # Truth by another library: resect each image again and again from the true points and noisy pixels.
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 300
    truth = pycolmap.synthesize_dataset(options)
    sigma_px = 0.8
    rng = np.random.default_rng(8)
    images = sorted((truth.image(i) for i in truth.reg_image_ids()), key=lambda image: image.name)
    clean = {image.name: np.array([p.xy for p in image.points2D if p.has_point3D()]) for image in images}
    scatter = {}
    for image in images:
        world = np.array([truth.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()])
        pose = image.cam_from_world()
        errors = []
        for _ in range(250):
            noisy = clean[image.name] + sigma_px * rng.standard_normal(clean[image.name].shape)
            found = pycolmap.refine_absolute_pose(pose, noisy, world, np.ones(len(world), bool), image.camera)
            turn = so3_log(pose.rotation.matrix() @ found["cam_from_world"].rotation.matrix().T)
            centre = found["cam_from_world"].inverse().translation
            errors.append(np.concatenate([turn, image.projection_center() - centre]))
        scatter[image.name] = np.cov(np.array(errors).T)
    for image in images:
        for point in image.points2D:
            if point.has_point3D():
                point.xy = point.xy + sigma_px * rng.standard_normal(2)
    timing = FrameTiming(names=tuple(image.name for image in images), t_s=np.arange(4.0))
    trajectory, _ = trajectory_from_model(truth, timing)
    assert trajectory.pose_cov is not None
    for name, cov in zip(trajectory.names, trajectory.pose_cov, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(cov))
        # Whitened scatter: the unit matrix, but for the factor of 250 draws and of the estimated noise of the pixels.
        # Before 4.2 pycolmap draws other scenes, whose worst direction comes out at 0.54 to 0.6.
        low = 0.6 if version_of("pycolmap") >= (4, 2) else 0.5
        whitened = root @ scatter[name] @ root.T
        assert np.all(np.linalg.eigvalsh(whitened) > low) and np.all(np.linalg.eigvalsh(whitened) < 1.7)


def test_poses_without_enough_observations_have_no_covariance():
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 3, 6
    model = pycolmap.synthesize_dataset(options)
    names = tuple(sorted(model.image(i).name for i in model.reg_image_ids()))
    trajectory, _ = trajectory_from_model(model, FrameTiming(names=names, t_s=np.arange(3.0)))
    assert trajectory.pose_cov is None
