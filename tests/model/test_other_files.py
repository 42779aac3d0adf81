"""Cameras of stereo programs, rigs and trainings under a similarity, by readers of the tests' own."""

import json

import cv2
import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import ModelScale
from tests.helpers.foreign_models import HEIGHT, WIDTH, build, ply_points, save, write_json, write_ply
from tests.helpers.other_files import (
    in_order,
    into_training,
    mvsnet_text,
    read_mvsnet,
    read_rig,
    training_of,
    write_mvsnet,
    write_rig,
)

QUAT = np.array([0.5, -0.1, 0.3, 0.8062257748298549])
SIM3 = Similarity(
    scale=2.5,
    rotation_xyzw=QUAT,
    translation_m=np.array([1.0, -2.0, 0.5]),
    cov=np.zeros((7, 7)),
    provenance="test",
)
TURN = matrix_from_quat(QUAT)
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])


def moved(xyz):
    return SIM3.scale * np.asarray(xyz) @ TURN.T + SIM3.translation_m


def xyz_of(model):
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)])


@pytest.fixture
def project(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    return tmp_path / "p", model


def changed(applied):
    return {change.path for change in applied.changes}


@pytest.mark.parametrize("depths", ["0.5 0.0125 192.0 2.9", "0.5 0.0125"])
def test_cameras_of_mvsnet_move_and_come_back(project, tmp_path, depths):
    root, model = project
    write_mvsnet(root / "mvs", model, depths=depths)
    applied = apply_to_project(root, tmp_path / "out", SIM3)
    assert applied.unmoved == ()
    numbers = [float(word) for word in depths.split()]
    for i, image in enumerate(in_order(model)):
        path = f"mvs/cams/{i:08}_cam.txt"
        centre, rotation, inner, after = read_mvsnet(tmp_path / "out" / path)
        np.testing.assert_allclose(centre, moved(image.projection_center()), atol=1e-13)
        np.testing.assert_allclose(rotation @ TURN, image.cam_from_world().rotation.matrix(), atol=1e-14)
        assert inner == read_mvsnet(root / path)[2]
        times = [2.5, 2.5, 1.0, 2.5][: len(numbers)]  # the third number counts
        np.testing.assert_allclose(after, np.multiply(numbers, times), rtol=1e-15)
    undo_project(tmp_path / "out", tmp_path / "back")
    for path in sorted((root / "mvs" / "cams").iterdir()):
        before, after = read_mvsnet(path), read_mvsnet(tmp_path / "back" / "mvs" / "cams" / path.name)
        for a, b in zip(before, after, strict=True):
            np.testing.assert_allclose(b, a, atol=4e-15, rtol=4e-15)
    assert (tmp_path / "back" / "mvs" / "pair.txt").read_bytes() == (root / "mvs" / "pair.txt").read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("extrinsic", "extrinsics"),
        lambda text: text.replace("0.5 0.0125", "0.5 0.0125 192"),
        lambda text: text.replace("0.0 0.0 0.0 1.0", "0.0 0.0 0.5 1.0"),
        lambda text: text.replace("intrinsic", "intrinsic matrix"),
    ],
)
def test_cameras_that_are_not_mvsnets_are_named(project, tmp_path, change):
    root, model = project
    (root / "cams").mkdir()
    text = change(mvsnet_text(model.image(1), depths="0.5 0.0125"))
    (root / "cams" / "00000000_cam.txt").write_text(text)
    applied = apply_to_project(root, tmp_path / "out", SIM3)
    assert [group.example for group in applied.unmoved] == ["cams/00000000_cam.txt"]
    assert (tmp_path / "out" / "cams" / "00000000_cam.txt").read_text() == text


def test_cameras_of_mvsnet_of_another_model_are_named(project, tmp_path):
    root, model = project
    write_mvsnet(root / "mvs", build(offset=(5.0, 0.0, 0.0)))
    applied = apply_to_project(root, tmp_path / "out", SIM3)
    assert [(group.count, group.kind) for group in applied.unmoved] == [(len(model.images), ".txt")]


@pytest.mark.parametrize("key", ["cam_from_rig_translation", "rel_tvec"])
def test_a_rig_configuration_moves_and_comes_back(tmp_path, key):
    names = [f"left/{i:03}.png" for i in range(4)] + [f"right/{i:03}.png" for i in range(4)]
    model = build(names)
    save(model, tmp_path / "p" / "sparse" / "0")
    before = write_rig(tmp_path / "p" / "rig_config.json", model, ["left/", "right/"], key=key)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert "rig_config.json" in changed(applied)
    (place,) = read_rig(tmp_path / "out" / "rig_config.json", key)
    np.testing.assert_allclose(place, 2.5 * np.array(before[1][key]), rtol=1e-15)
    # as far apart as in the moved model, by its own centres
    centres = [moved(model.find_image_with_name(f"{side}/000.png").projection_center()) for side in ("left", "right")]
    assert np.linalg.norm(place) == pytest.approx(np.linalg.norm(centres[0] - centres[1]), rel=1e-12)
    undo_project(tmp_path / "out", tmp_path / "back")
    (place,) = read_rig(tmp_path / "back" / "rig_config.json", key)
    np.testing.assert_allclose(place, before[1][key], rtol=4e-15)


def test_a_rig_configuration_in_other_units_is_named(tmp_path):
    """As where it is in metres, and the model was not."""
    names = [f"left/{i:03}.png" for i in range(4)] + [f"right/{i:03}.png" for i in range(4)]
    model = build(names)
    save(model, tmp_path / "p" / "sparse" / "0")
    write_rig(tmp_path / "p" / "rig_config.json", model, ["left/", "right/"], times=2.5)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert [group.example for group in applied.unmoved] == ["rig_config.json"]
    (note,) = [note.values["found"] for note in applied.notes if note.values["found"].code == "rig-elsewhere"]
    assert note.values["ratio"] == pytest.approx(2.5, rel=0.1)
    same = [(folder / "rig_config.json").read_bytes() for folder in (tmp_path / "p", tmp_path / "out")]
    assert same[0] == same[1]


def test_a_rig_in_one_place_has_no_lengths(project, tmp_path):
    """As of the virtual cameras of a panorama."""
    cameras = [{"image_prefix": f"{i}/", "cam_from_rig_translation": [0, 0, 0]} for i in range(4)]
    write_json(project[0] / "rig_config.json", [{"cameras": cameras}])
    assert apply_to_project(project[0], tmp_path / "out", SIM3).unmoved == ()


@pytest.mark.parametrize(("centre", "fills"), [("poses", True), ("poses", False), ("focus", True)])
@pytest.mark.parametrize("applied", [None, APPLIED])
def test_a_training_stays_where_it_is(project, tmp_path, centre, fills, applied):
    """What leads to its world leads there from metres, and what lies in it, as its splats, is left alone."""
    root, model = project
    values = training_of(model, applied, centre=centre, fills=fills)
    run = root / "outputs" / "hall" / "splatfacto" / "1"
    write_json(run / "dataparser_transforms.json", values)
    splats = into_training(values, xyz_of(model))
    write_ply(root / "exports" / "splat.ply", splats)
    done = apply_to_project(root, tmp_path / "out", SIM3)
    assert changed(done) >= {"outputs/hall/splatfacto/1/dataparser_transforms.json"}
    after = json.loads((tmp_path / "out" / run.relative_to(root) / "dataparser_transforms.json").read_text())
    np.testing.assert_allclose(into_training(after, moved(xyz_of(model))), splats, atol=1e-13)
    same = [(folder / "exports" / "splat.ply").read_bytes() for folder in (root, tmp_path / "out")]
    assert same[0] == same[1]
    assert any(note.values["found"].code == "frame-of-training" for note in done.notes)
    undo_project(tmp_path / "out", tmp_path / "back")
    back = json.loads((tmp_path / "back" / run.relative_to(root) / "dataparser_transforms.json").read_text())
    np.testing.assert_allclose(back["transform"], values["transform"], atol=4e-15)
    assert back["scale"] == pytest.approx(values["scale"], rel=4e-15)


def test_a_training_of_something_else_is_named(project, tmp_path):
    root, model = project
    values = training_of(model)
    for row in values["transform"]:
        row[3] += 0.7
    write_json(root / "dataparser_transforms.json", values)
    done = apply_to_project(root, tmp_path / "out", SIM3)
    assert [group.kind for group in done.unmoved] == ["dataparser_transforms.json"]
    assert any("dataparser_transforms.json: copied unchanged" in str(note) for note in done.notes)


@pytest.mark.parametrize(("unit", "frame"), [("integer_depth_scale", "depth_path"), (None, "depth_file_path")])
def test_depths_of_whole_numbers_have_their_unit_moved_or_named(project, tmp_path, unit, frame):
    root, model = project
    frames = []
    (root / "depth").mkdir()
    for i, image in enumerate(in_order(model)):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:, 1:3] *= -1
        frames.append({"file_path": image.name, "transform_matrix": pose.tolist(), frame: f"depth/{i:03}.png"})
        cv2.imwrite(str(root / "depth" / f"{i:03}.png"), np.full((HEIGHT, WIDTH), 3000, np.uint16))
    write_json(root / "transforms.json", {"frames": frames, **({} if unit is None else {unit: 0.001})})
    done = apply_to_project(root, tmp_path / "out", SIM3)
    after = json.loads((tmp_path / "out" / "transforms.json").read_text())
    picture = cv2.imread(str(tmp_path / "out" / "depth" / "000.png"), cv2.IMREAD_UNCHANGED)
    assert picture.max() == picture.min() == 3000
    if unit is None:
        assert [group.lengths for group in done.unmoved] == ["depths"]
        assert "2.5 times as large" in " ".join(str(note) for note in done.notes)
        return
    assert done.unmoved == ()
    assert picture.max() * after[unit] == pytest.approx(2.5 * 3000 * 0.001, rel=1e-15)
    undo_project(tmp_path / "out", tmp_path / "back")
    assert json.loads((tmp_path / "back" / "transforms.json").read_text())[unit] == pytest.approx(0.001, rel=1e-15)


def test_files_of_several_models_go_with_the_one_whose_cameras_they_have(tmp_path):
    models = [build(), build([f"b{i}.png" for i in range(8)], offset=(9.0, 2.0, 1.0))]
    for i, model in enumerate(models):
        save(model, tmp_path / "p" / "sparse" / str(i))
    write_mvsnet(tmp_path / "p" / "mvs", models[1])
    other = Similarity(
        scale=0.5, rotation_xyzw=QUAT, translation_m=np.zeros(3), cov=np.zeros((7, 7)), provenance="the second"
    )
    apply_to_project(
        tmp_path / "p", tmp_path / "out", {0: ModelScale(similarity=SIM3), 1: ModelScale(similarity=other)}
    )
    centre = read_mvsnet(tmp_path / "out" / "mvs" / "cams" / "00000000_cam.txt")[0]
    np.testing.assert_allclose(centre, 0.5 * (TURN @ models[1].image(1).projection_center()), atol=1e-13)


def nerf(root, model, world, **more):
    """``transforms.json`` of a model in a world of its own."""
    frames, scale = [], np.cbrt(np.linalg.det(world[:3, :3]))
    for image in in_order(model):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose = world @ pose
        pose[:3, :3] /= scale
        pose[:, 1:3] *= -1
        frames.append({"file_path": image.name, "transform_matrix": pose.tolist()})
    write_json(root / "transforms.json", {"frames": frames, **more})


def test_a_world_that_was_scaled_and_points_that_lie_elsewhere_in_the_folders(project, tmp_path):
    """``applied_scale`` of nerfstudio; points of its world outside the folder of its cameras."""
    root, model = project
    world = np.vstack([APPLIED, [0, 0, 0, 1]])
    world[:3] *= 0.1
    nerf(root / "ns", model, world, applied_transform=APPLIED.tolist(), applied_scale=0.1)
    write_ply(root / "exports" / "cloud.ply", xyz_of(model) @ world[:3, :3].T + world[:3, 3])
    apply_to_project(root, tmp_path / "out", SIM3)
    want = moved(xyz_of(model)) @ world[:3, :3].T + world[:3, 3]
    np.testing.assert_allclose(ply_points(tmp_path / "out" / "exports" / "cloud.ply"), want, atol=1e-6)
    frames = json.loads((tmp_path / "out" / "ns" / "transforms.json").read_text())["frames"]
    for image, frame in zip(in_order(model), frames, strict=True):
        centre = world[:3, :3] @ moved(image.projection_center()) + world[:3, 3]
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], centre, atol=1e-14)
        turn = np.array(frame["transform_matrix"])[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-13)


def test_fields_of_cameras_that_nothing_is_known_of_are_named(project, tmp_path):
    root, model = project
    known = {"fl_x": 140.0, "w": 160, "k1": 0.1, "camera_angle_x": 0.8, "aabb_scale": 16, "camera_model": "OPENCV"}
    nerf(root, model, np.eye(4), aabb=[[-1, -1, -1], [1, 1, 1]], scene_radius=3.0, title="hall", **known)
    applied = apply_to_project(root, tmp_path / "out", SIM3)
    (note,) = [note.values["found"] for note in applied.notes]
    assert note.code == "fields-unmoved" and note.values["fields"] == ("aabb", "scene_radius")
