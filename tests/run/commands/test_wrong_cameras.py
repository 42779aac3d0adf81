"""Projects in which cameras are wrong, through ``reconstruct`` and ``diagnose``: a part costs that part."""

import json
import shutil
from itertools import pairwise

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.options import JoinOptions, ProjectOptions, ReconstructOptions, ScaleOptions
from colmap_inertial.core.types import CAL
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.model import num_registered, read_model
from colmap_inertial.model.deregistration import deregister_images
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.model.similarities import read_scales
from colmap_inertial.model.submodels.registration import register_again
from colmap_inertial.run.commands.diagnose import diagnose_source
from colmap_inertial.run.commands.models import Submodels, run_models
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.commands.scale import ScaleSource, align_source, scale_source
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.steps.workspace import Workspace
from tests.helpers.box_project import build
from tests.helpers.sessions import recording_of, session_in


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """With few points, as every step reads them. Tests must not change it."""
    return build(tmp_path_factory.mktemp("box"), every=10, points=700)


def turned(model, names, deg, *, about=None):
    """Cameras turned, each by itself about its centre, or all as one about a point of the world; moved, too."""
    rng = np.random.default_rng(4)
    axis = rng.standard_normal(3)
    turn = pycolmap.Rotation3d(np.radians(deg) * axis / np.linalg.norm(axis))
    for image in [model.image(i) for i in sorted(model.reg_image_ids()) if model.image(i).name in names]:
        pose = image.cam_from_world()
        if about is None:
            pose = pycolmap.Rigid3d(turn, rng.standard_normal(3)) * pose
        else:
            world = pycolmap.Rigid3d(turn, about - turn.matrix() @ about + 0.3)
            pose = pose * world
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    return model


def make_folder(path):
    path.mkdir(parents=True)
    return path


def altered(box, folder, names, deg, **how):
    project = shutil.copytree(box.root, folder)
    sparse = project / "sparse" / "0"
    turned(read_model(sparse), names, deg, **how).write_binary(str(sparse))
    return project


def reconstructed(box, project, out):
    """The only model of ``result.json``, checked for the truth."""
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    reconstruct_project(project, out, source, ReconstructOptions(refine="off"))
    (model,) = json.loads((out / "result.json").read_text())["models"]
    low, high = model["ci95"]
    assert low < box.recording.truth.metres_per_unit < high
    return model


def database_of(model, path, reach=4):
    """COLMAP's database of a model: what images of one another's neighbourhood see alike."""
    with pycolmap.Database.open(str(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            database.write_frame(frame, use_frame_id=True)
        numbers = sorted(model.reg_image_ids())
        seen = {}
        for i in numbers:
            image = model.image(i)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(i, np.array([p.xy for p in image.points2D], dtype=np.float32))
            seen[i] = {p.point3D_id: k for k, p in enumerate(image.points2D) if p.has_point3D()}
        for k, i in enumerate(numbers):
            for j in numbers[k + 1 : k + 1 + reach]:
                both = sorted(seen[i].keys() & seen[j].keys())
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = np.array([[seen[i][p], seen[j][p]] for p in both], dtype=np.uint32)
                database.write_two_view_geometry(i, j, geometry)
    return path


@pytest.fixture(scope="module")
def placed(box, tmp_path_factory):
    """Two wrong cameras, a project with a database, what was made of it, and its model. Tests must not change them."""
    root = tmp_path_factory.mktemp("placed")
    names = [box.names[i] for i in (30, 45)]
    project = altered(box, root / "project", names, 54)
    database = database_of(read_model(box.root / "sparse" / "0"), project / "database.db")
    before = sorted(path.name for path in project.iterdir()), database.read_bytes()
    model = reconstructed(box, project, root / "out")
    assert (sorted(path.name for path in project.iterdir()), database.read_bytes()) == before
    return names, project, root / "out", model


def test_wrong_cameras_of_a_project_are_placed_by_the_matches_of_its_database(box, placed):
    names, _, out, model = placed
    assert model["rotations"]["registered_again"] == names
    assert model["rotations"]["wrong"] == model["rotations"]["left_out"] == []
    assert max(model["rotations"]["deviations_deg"].values()) < 2
    metric, sound = read_model(out / "sparse" / "0"), read_model(box.root / "sparse" / "0")
    assert metric.num_reg_images() == len(box.names)
    for name in names:
        against_first = [
            (
                model.find_image_with_name(name).cam_from_world()
                * model.find_image_with_name(box.names[0]).cam_from_world().inverse()
            ).rotation
            for model in (metric, sound)
        ]
        assert np.degrees((against_first[0] * against_first[1].inverse()).angle()) < 0.5


def test_apply_does_not_bring_back_the_wrong_poses_of_cameras_that_were_registered_again(box, placed, tmp_path):
    names, project, out, _ = placed
    apply_to_project(project, tmp_path / "metric", read_scales([str(out / "result.json")]))
    metric = read_model(tmp_path / "metric" / "sparse" / "0")
    assert {image.name for image in metric.images.values()} == set(box.names) - set(names)


@pytest.mark.parametrize("wrong", [[30], [1, 31, 45]])
def test_wrong_cameras_leave_the_metric_model_and_are_listed(box, tmp_path, wrong):
    names = [box.names[i] for i in wrong]
    project = altered(box, tmp_path / "project", names, 54)
    before = (project / "sparse" / "0" / "images.bin").read_bytes()
    model = reconstructed(box, project, tmp_path / "out")
    assert [one["name"] for one in model["rotations"]["wrong"]] == model["rotations"]["left_out"] == names
    assert [one["deg"] for one in model["rotations"]["wrong"]] == pytest.approx([54] * len(names), abs=1)
    metric = read_model(tmp_path / "out" / "sparse" / "0")
    assert {image.name for image in metric.images.values()} == set(box.names) - set(names)
    assert (project / "sparse" / "0" / "images.bin").read_bytes() == before
    assert len(read_model(project / "sparse" / "0").images) == len(box.names)
    assert names[0] in (tmp_path / "out" / "report.html").read_text()


def test_keyframes_in_the_wrong_place_alone_are_named_and_placed_by_matches(box, tmp_path):
    """Turned rightly, so that the gyroscope has nothing against them; without points, whose errors would tell."""
    every = {name for name in box.names if name not in box.names[::2]}
    names, source = box.names[4:50:18], read_model(box.root / "sparse" / "0")
    few = deregister_images(source, every)
    project = tmp_path / "project"
    (project / "sparse" / "0").mkdir(parents=True)
    moved, rng = pycolmap.Reconstruction(few), np.random.default_rng(2)
    for image in [moved.find_image_with_name(name) for name in names]:
        pose, away = image.cam_from_world(), rng.standard_normal(3)
        for k in [k for k, point in enumerate(image.points2D) if point.has_point3D()]:
            moved.delete_observation(image.image_id, k)
        beside = pycolmap.Rigid3d(pose.rotation, pose.translation + 2 * away / np.linalg.norm(away))
        moved.frame(image.frame_id).set_cam_from_world(image.camera_id, beside)
    moved.write_binary(str(project / "sparse" / "0"))
    model = reconstructed(box, project, tmp_path / "out")
    assert model["rotations"]["wrong"] == []
    assert model["rotations"]["moved"] == model["rotations"]["left_out"] == names
    database_of(few, project / "database.db")
    model = reconstructed(box, project, tmp_path / "again")
    assert model["rotations"]["moved"] == [] and model["rotations"]["registered_again"] == names
    assert read_model(tmp_path / "again" / "sparse" / "0").num_reg_images() == 30


def test_of_a_torn_model_the_largest_part_is_kept(box, tmp_path):
    names = box.names[15:30]
    project = altered(box, tmp_path / "project", names, 25, about=np.zeros(3))
    model = reconstructed(box, project, tmp_path / "out")
    assert [seam["name"] for seam in model["rotations"]["seams"]] == [box.names[15], box.names[30]]
    assert model["rotations"]["left_out"] == names


@pytest.mark.parametrize("first, last", [(15, 30), (0, 22)], ids=["a block", "the beginning"])
def test_parts_of_a_torn_model_are_joined_by_the_imu(box, tmp_path, first, last):
    """A capture's model: what a project has no place for goes on as a model of its own."""
    names = set(box.names[first:last])
    sound = read_model(box.root / "sparse" / "0")
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    turned(pycolmap.Reconstruction(sound), names, 25, about=np.zeros(3)).write_binary(
        str(make_folder(workspace.colmap_sparse / "0"))
    )
    imu, timing = box.recording.imu, read_frame_times(box.frame_times)
    stages = [MetricStage(imu=imu, calibration=None), JoinStage(imu=imu, calibration=None)]
    (model,), _, gaps = run_models(session_in(workspace), recording_of(imu, timing), stages, Submodels(after=()))
    assert all(gap.joined for gap in gaps) and gaps
    assert sorted(part.images for part in model.parts) == sorted((len(names), len(box.names) - len(names)))
    assert {one.name for one in model.scale.rotations.seams} <= {box.names[first], box.names[last]}
    assert set(model.scale.rotations.joined) == names and model.scale.rotations.left_out == ()
    codes = [note.code for note in model.scale.notes]
    assert "torn-parts-joined" in codes and not {"largest-part-kept", "other-parts-left-out"} & set(codes)
    (done,) = [one for one in model.treatments if one.stage == "rotations"]
    assert done.action == "joined" and "left out" not in str(done.reason) and not done.values["left_out"]
    joined = read_model(model.sparse_metric)
    centres, truth = (
        np.array([one.find_image_with_name(name).projection_center() for name in box.names]) for one in (joined, sound)
    )
    fitted = pycolmap.estimate_sim3d(truth, centres)
    away_m = np.linalg.norm(fitted * truth - centres, axis=1)
    assert np.sqrt(np.mean(away_m**2)) < 0.02
    assert np.linalg.norm(away_m[first:last]) / (last - first) ** 0.5 < 0.03


def test_of_a_torn_model_what_the_imu_cannot_join_is_left_out(box, tmp_path):
    """Where positions must be known to a tenth of a millimetre."""
    names = set(box.names[:22])
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    torn = turned(read_model(box.root / "sparse" / "0"), names, 25, about=np.zeros(3))
    torn.write_binary(str(make_folder(workspace.colmap_sparse / "0")))
    imu, timing = box.recording.imu, read_frame_times(box.frame_times)
    stages = [
        MetricStage(imu=imu, calibration=None),
        JoinStage(imu=imu, calibration=None, limits=JoinOptions(sigma_m=1e-4)),
    ]
    (model,), _, gaps = run_models(session_in(workspace), recording_of(imu, timing), stages, Submodels(after=()))
    assert [gap.joined for gap in gaps] == [False] and "known to" in str(gaps[0].reason)
    assert num_registered(model.sparse_metric) == len(box.names) - 22 and model.parts == ()
    assert set(model.scale.rotations.left_out) == names and model.scale.rotations.joined == ()
    assert any("the other parts were left out" in str(note) for note in model.scale.notes)


def test_diagnose_names_the_wrong_cameras(box, tmp_path):
    project = altered(box, tmp_path / "project", [box.names[30]], 54)
    source = ScaleSource(source=project / "sparse" / "0", imu=box.imu, frame_times=box.frame_times)
    (finding,) = [one for one in diagnose_source(source).findings if one.code == "cameras-turned"]
    assert finding.severity == "warning"
    assert box.names[30] in finding.evidence
    assert finding.numbers["wrong"] == 1
    assert set(finding.deviations_deg) == set(box.names)
    assert finding.deviations_deg[box.names[30]] == pytest.approx(54, abs=1)
    others = [deg for name, deg in finding.deviations_deg.items() if name != box.names[30]]
    assert 0 < max(others) < 2


def test_a_wrong_camera_is_registered_again_by_its_matches(box, tmp_path):
    sound = read_model(box.root / "sparse" / "0")
    database = database_of(sound, tmp_path / "database.db")
    names = [box.names[30], box.names[31]]
    wrong = turned(pycolmap.Reconstruction(sound), names, 54)
    placed, again = register_again(wrong, names, database)
    assert again == tuple(names)
    assert wrong.num_reg_images() == placed.num_reg_images() == len(box.names)
    for name in names:
        pose, truth = (model.find_image_with_name(name).cam_from_world() for model in (placed, sound))
        assert np.degrees((pose * truth.inverse()).rotation.angle()) < 0.5
    seen = [placed.find_image_with_name(name).num_points3D for name in names]
    assert min(seen) > 50
    assert placed.compute_mean_reprojection_error() == pytest.approx(sound.compute_mean_reprojection_error(), rel=0.1)


def test_deregistered_images_leave_the_original_as_it_is(box):
    model = read_model(box.root / "sparse" / "0")
    rest = deregister_images(model, box.names[:3])
    assert (model.num_reg_images(), rest.num_reg_images()) == (60, 57)
    assert all(point.track.length() >= 2 for point in rest.points3D.values())
    assert all(a < b for a, b in pairwise(sorted(rest.reg_image_ids())))


def test_the_alignment_of_a_project_goes_by_its_sound_cameras(box, tmp_path):
    project = altered(box, tmp_path / "project", [box.names[i] for i in (3, 20, 45)], 54)
    source = ScaleSource(source=project / "sparse" / "0", imu=box.imu, frame_times=box.frame_times)
    found = align_source(source, tmp_path / "calibration.json")
    truth = box.recording.truth.calibration
    between = quat_multiply(found.cam_from_imu_xyzw, quat_conjugate(truth.cam_from_imu_xyzw))
    assert np.degrees(np.linalg.norm(quat_log(between))) < 0.5
    # the lever arm comes with the scale, and is stated less surely than this recording has it
    off_m = found.imu_in_cam_m - truth.imu_in_cam_m
    sigma_m = np.sqrt(np.diagonal(found.cov[CAL.LEVER_ARM, CAL.LEVER_ARM]))
    assert np.all(np.abs(off_m) < 3 * sigma_m) and np.all((sigma_m > 0.003) & (sigma_m < 0.04))


def test_apply_leaves_the_same_images_out(box, tmp_path):
    name = box.names[30]
    project = altered(box, tmp_path / "project", [name], 54)
    source = ScaleSource(source=project / "sparse" / "0", imu=box.imu, frame_times=box.frame_times)
    estimate = scale_source(source, ScaleOptions(), json=tmp_path / "scale.json")
    low, high = estimate.ci95
    assert low < box.recording.truth.metres_per_unit < high
    applied = apply_to_project(project, tmp_path / "metric", read_scales([str(tmp_path / "scale.json")]))
    metric = read_model(tmp_path / "metric" / "sparse" / "0")
    assert {image.name for image in metric.images.values()} == set(box.names) - {name}
    assert any(name in str(note) for note in applied.notes)
