"""Workspaces of other programs under a similarity: each file is moved, free of lengths, or named."""

import json
import struct

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import AlreadyMetricError, FormatError, InertialError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import ScaleEstimate, Similarity
from colmap_inertial.model import read_model
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import plain_factor, read_scales
from colmap_inertial.tools.export.whole import export_model
from tests.helpers.foreign_models import (
    COUNT,
    HEIGHT,
    WIDTH,
    build,
    centres,
    ply_points,
    points,
    save,
    write_json,
    write_ply as ply,
)
from tests.helpers.other_files import (
    in_order,
    into_training,
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
#: nerfstudio's, and one that scales, too.
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
GL = np.diag([1.0, -1.0, -1.0])


def moved(xyz):
    return SIM3.scale * np.asarray(xyz) @ TURN.T + SIM3.translation_m


def world_of(applied):
    return np.vstack([applied, [0, 0, 0, 1]])


def frames(model, applied=APPLIED, name=lambda n: f"images/{n}"):
    """Cameras as nerfstudio writes them."""
    out = []
    for image in model.images.values():
        pose = np.eye(4)
        pose[:3, :3] = image.cam_from_world().rotation.matrix().T @ GL
        pose[:3, 3] = image.projection_center()
        out.append({"file_path": name(image.name), "transform_matrix": (world_of(applied) @ pose).tolist()})
    return out


def xyz_of(model):
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)])


def nerfstudio(root, *, in_world=True, names=None, file_path=lambda n: f"images/{n}"):
    """A folder of ``ns-process-data``: model, cameras, points, depths of 16 bit."""
    model = build(names)
    save(model, root / "colmap" / "sparse" / "0")
    xyz = xyz_of(model)
    ply(root / "sparse_pc.ply", xyz @ APPLIED[:, :3].T + APPLIED[:, 3] if in_world else xyz)
    cameras = frames(model, name=file_path)
    for i, frame in enumerate(cameras):
        frame["depth_file_path"] = f"depth/{i:03}.png"
        (root / "depth").mkdir(exist_ok=True)
        cv2.imwrite(str(root / "depth" / f"{i:03}.png"), np.full((HEIGHT, WIDTH), 3000, np.uint16))
    content = {"frames": cameras, "applied_transform": APPLIED.tolist(), "ply_file_path": "sparse_pc.ply"}
    write_json(root / "transforms.json", content)
    return model


def error_px(folder, model):
    """Where points of ``sparse_pc.ply`` are seen in the cameras of ``transforms.json``, against the key points."""
    content = json.loads((folder / "transforms.json").read_text())
    xyz, numbers = ply_points(folder / "sparse_pc.ply"), sorted(model.points3D)
    camera, worst = model.camera(1), 0.0
    for image, frame in zip(model.images.values(), content["frames"], strict=True):
        back = np.linalg.inv(np.array(frame["transform_matrix"]))
        seen = camera.img_from_cam((xyz @ back[:3, :3].T + back[:3, 3]) @ GL)
        for point in image.points2D:
            worst = max(worst, np.linalg.norm(seen[numbers.index(point.point3D_id)] - point.xy))
    return worst


def test_points_of_transforms_are_moved_in_their_world(tmp_path):
    model = nerfstudio(tmp_path / "p")
    assert error_px(tmp_path / "p", model) < 1e-3
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert error_px(tmp_path / "out", model) < 1e-3
    want = world_of(APPLIED) @ np.append(moved(xyz_of(model)[0]), 1.0)
    np.testing.assert_allclose(ply_points(tmp_path / "out" / "sparse_pc.ply")[0], want[:3], atol=1e-5)
    assert any(
        note.startswith("depths in 8 integer images") and "2.5 times" in note for note in map(str, applied.notes)
    )
    assert [group.lengths for group in applied.unmoved] == ["depths"]
    undo_project(tmp_path / "out", tmp_path / "back")
    assert error_px(tmp_path / "back", model) < 1e-3


def test_points_in_the_models_world_stay_in_it(tmp_path):
    """As ``ns-process-data`` wrote them before it applied its transform to them."""
    model = nerfstudio(tmp_path / "p", in_world=False)
    apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    np.testing.assert_allclose(ply_points(tmp_path / "out" / "sparse_pc.ply"), moved(xyz_of(model)), atol=1e-5)


@pytest.mark.parametrize(
    "file_path",
    [lambda n: f"images/{n}", lambda n: n, lambda n: f"./images_2/{n}", lambda n: n.rpartition("/")[2]],
)
def test_names_that_differ_by_folder_alone_are_told_apart(tmp_path, file_path):
    names = [f"cam{i % 2}/{i // 2:05}.png" for i in range(COUNT)]
    nerfstudio(tmp_path / "p", names=names, file_path=file_path)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert "transforms.json" in [change.path for change in applied.changes]


def test_cameras_that_were_renamed_are_known_by_their_places(tmp_path):
    nerfstudio(tmp_path / "p", file_path=lambda n: f"images/frame_{int(n[:3]) + 1:05}.png")
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert "transforms.json" in [change.path for change in applied.changes]


def test_cameras_elsewhere_are_left_and_named(tmp_path):
    nerfstudio(tmp_path / "p")
    content = json.loads((tmp_path / "p" / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 2.0
    write_json(tmp_path / "p" / "transforms.json", content)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert any("transforms.json: copied unchanged" in note for note in map(str, applied.notes))


def test_points_of_another_frame_are_named(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    ply(tmp_path / "p" / "exports" / "splat.ply", 0.1 * xyz_of(model) + [4.0, 0, 0])
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert any("exports/splat.ply: transformed with the model" in note for note in map(str, applied.notes))


def inria(root, model, sparse=None):
    """What 3D Gaussian Splatting writes, and what LLFF does."""
    rows, bounds = [], []
    for i, image in enumerate(model.images.values()):
        turn, place = image.cam_from_world().rotation.matrix().T, image.projection_center()
        rows.append({"id": i, "img_name": image.name.rpartition(".")[0], "width": WIDTH, "height": HEIGHT})
        rows[-1] |= {"position": place.tolist(), "rotation": turn.tolist(), "fx": 140.0, "fy": 140.0}
        axes = np.stack([turn[:, 1], turn[:, 0], -turn[:, 2], place, [HEIGHT, WIDTH, 140.0]], axis=1)
        bounds.append(np.append(axes.ravel(), [1.5, 6.0]))
    write_json(root / "output" / "cameras.json", rows)
    np.save(root / "poses_bounds.npy", np.array(bounds))
    params = {image.name: {"scale": 0.8, "offset": 0.02} for image in model.images.values()}
    write_json((sparse or root / "sparse" / "0") / "depth_params.json", params)
    return rows, np.array(bounds), params


def test_cameras_of_splats_and_llff_move_and_come_back(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    rows, bounds, params = inria(tmp_path / "p", model)
    apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    after = json.loads((tmp_path / "out" / "output" / "cameras.json").read_text())
    for old, new in zip(rows, after, strict=True):
        np.testing.assert_allclose(new["position"], moved(old["position"]), atol=1e-12)
        np.testing.assert_allclose(new["rotation"], TURN @ np.array(old["rotation"]), atol=1e-12)
        assert new["fx"] == old["fx"]
    new = np.load(tmp_path / "out" / "poses_bounds.npy")
    poses = new[:, :15].reshape(-1, 3, 5)
    np.testing.assert_allclose(poses[:, :, 3], moved(bounds[:, :15].reshape(-1, 3, 5)[:, :, 3]), atol=1e-12)
    np.testing.assert_allclose(new[:, 15:], 2.5 * bounds[:, 15:], rtol=1e-14)
    np.testing.assert_array_equal(poses[:, :, 4], bounds[:, :15].reshape(-1, 3, 5)[:, :, 4])
    inverse = json.loads((tmp_path / "out" / "sparse" / "0" / "depth_params.json").read_text())
    assert inverse["000.png"] == pytest.approx({"scale": 0.8 / 2.5, "offset": 0.02 / 2.5}, rel=1e-14)
    undo_project(tmp_path / "out", tmp_path / "back")
    np.testing.assert_allclose(np.load(tmp_path / "back" / "poses_bounds.npy"), bounds, atol=4e-15)
    back = json.loads((tmp_path / "back" / "output" / "cameras.json").read_text())
    for old, new in zip(rows, back, strict=True):
        np.testing.assert_allclose(new["position"], old["position"], atol=4e-15)
    assert json.loads((tmp_path / "back" / "sparse" / "0" / "depth_params.json").read_text())["000.png"] == (
        pytest.approx(params["000.png"], rel=4e-15)
    )


NAMED = {
    "outputs/step-000029999.ckpt": b"\x80\x02model",
    "outputs/dataparser_transforms.json": b'{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0.5}',
    "outputs/config.yml": b"scene_scale: 2.0\n",
    "mvs/cams/00000_cam.txt": b"extrinsic\n1 0 0 2\n0 1 0 3\n0 0 1 4\n0 0 0 1\n",
    "scene.wrl": b"#VRML V2.0 utf8\n",
    "rig_config.json": b'[{"cameras": [{"cam_from_rig_translation": [0.1, 0, 0]}]}]',
    "point_cloud.npz": b"PK\x03\x04points",
    "depth/00001.npy": b"\x93NUMPY\x01\x00depths",
    "scene.parquet": b"PAR1rows",
    "something": b"\x00\x01\x02",
    "metadata.xml": b"<ModelMetadata><SRSOrigin>1,2,3</SRSOrigin></ModelMetadata>",
}
FREE = {
    "README.md": b"# A hall\n",
    "notes.txt": b"taken in March\n",
    "image_list.txt": b"000.png\n001.png\n",
    "masks/000.png": None,
    "stereo/fusion.cfg": b"000.png\n",
    "train.sh": b"python train.py\n",
    ".DS_Store": b"\0\0\0\1Bud1",
    "._model.ply": b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        ",
    "empty": b"",
}


def put(root, files):
    for name, data in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data is None:
            cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 255, np.uint8))
        else:
            path.write_bytes(data)


def test_what_may_hold_lengths_is_named_and_all_else_is_not(tmp_path):
    save(build(), tmp_path / "p" / "sparse" / "0")
    put(tmp_path / "p", {**NAMED, **FREE})
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert sorted(group.example for group in applied.unmoved) == sorted(NAMED)
    text = " ".join(map(str, applied.notes))
    assert all(group.kind in text for group in applied.unmoved)
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert {group["example"] for group in record["unmoved"]} == set(NAMED)
    for name in (*NAMED, *FREE):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "p" / name).read_bytes()


def test_pictures_of_depths_are_known_by_their_bits(tmp_path):
    save(build(), tmp_path / "p" / "sparse" / "0")
    folder = tmp_path / "p" / "maps"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((9, 9), 3000, np.uint16))
    cv2.imwrite(str(folder / "b.tiff"), np.full((9, 9), 1.5, np.float32))
    cv2.imwrite(str(folder / "c.pgm"), np.full((9, 9), 3000, np.uint16))
    cv2.imwrite(str(folder / "colour.png"), np.full((9, 9, 3), 3000, np.uint16))
    cv2.imwrite(str(folder / "grey.tiff"), np.full((9, 9), 30, np.uint8))
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert sorted(group.example for group in applied.unmoved) == ["maps/a.png", "maps/b.tiff", "maps/c.pgm"]


@pytest.mark.parametrize("pattern", ["._*", "old", "old/", "old/*", "./old/*", "**/old/*", "sub/old/mesh.ply"])
def test_patterns_are_names_or_paths(tmp_path, pattern):
    save(build(), tmp_path / "p" / "sparse" / "0")
    put(tmp_path / "p", {"sub/old/mesh.ply": b"no ply", "old/mesh.ply": b"no ply", "sub/._a.ply": b"no ply"})
    kept = {"._*": ["sub/._a.ply"], "old": ["sub/old/mesh.ply", "old/mesh.ply"], "old/": ["sub/old/mesh.ply"]}
    kept |= {"old/*": ["old/mesh.ply"], "./old/*": ["old/mesh.ply"], "**/old/*": ["old/mesh.ply"]}
    rest = {"sub/old/mesh.ply", "old/mesh.ply", "sub/._a.ply"} - set(kept.get(pattern, ["sub/old/mesh.ply"]))
    for name in rest - set(kept.get(pattern, [])):
        (tmp_path / "p" / name).unlink()
    if pattern == "**/old/*":
        put(tmp_path / "p", {"sub/old/mesh.ply": b"no ply"})
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3, keep=[pattern])
    assert not any("--keep" in note for note in map(str, applied.notes))


def test_patterns_of_nothing_are_told(tmp_path):
    save(build(), tmp_path / "p" / "sparse" / "0")
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", SIM3, keep=["odl/*"])
    assert any("--keep odl/* matches no path of the project" in note for note in map(str, applied.notes))


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (POINTER, "is a Git LFS pointer.*git lfs pull"),
        (b"/annex/objects/SHA256E-s1--1.bin\n", "is a git-annex pointer"),
        (b"<!DOCTYPE html><html><body>Sign in</body></html>", "is a web page"),
        (bytes(5000), "holds only zeros"),
        (b"\x1f\x8b\x08\x00" + bytes(90), r"is packed \(gzip\)"),
        (b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        ", "is a macOS metadata file"),
    ],
)
@pytest.mark.parametrize("name", ["sparse/0/points3D.bin", "sparse/0/images.txt", "mesh.ply", "database.db"])
def test_what_stands_in_for_a_file_is_called_what_it_is(tmp_path, data, match, name):
    save(build(), tmp_path / "p" / "sparse" / "0", text=name.endswith(".txt"))
    put(tmp_path / "p", {name: data})
    with pytest.raises(FormatError, match=match):
        apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    assert not (tmp_path / "out").exists()


def test_records_of_other_programs_are_no_scale(tmp_path):
    save(build(), tmp_path / "p" / "sparse" / "0")
    for content in ({"frames": []}, {"scale": 2.0}, {"matrix": [1, 0, 0]}):
        write_json(tmp_path / "p" / "assets" / "transform.json", content)
        applied = apply_to_project(tmp_path / "p", tmp_path / f"out{next(iter(content))}", SIM3)
        assert [group.example for group in applied.unmoved] == ["assets/transform.json"]
    write_json(tmp_path / "p" / "transform.json", {"frames": []})
    with pytest.raises(FormatError, match=r"not a record of colmap-inertial.*rename it"):
        apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    (tmp_path / "p" / "transform.json").unlink()
    apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)
    with pytest.raises(AlreadyMetricError):
        apply_to_project(tmp_path / "out", tmp_path / "again", SIM3)


# far from the origin

UTM = np.array([432_100.0, 5_664_733.0, 120.0])


def far_project(root, offset=UTM, kind="float"):
    model = build(offset=offset)
    save(model, root / "sparse" / "0")
    ply(root / "dense" / "fused.ply", xyz_of(model), kind=kind)
    return model


def test_far_models_are_scaled_about_their_own_place(tmp_path):
    model = far_project(tmp_path / "p")
    xyz = ply_points(tmp_path / "p" / "dense" / "fused.ply")
    with pytest.raises(SystemExit) as stopped:
        main(["apply", str(tmp_path / "p"), str(tmp_path / "out"), "--factor", "1.02"])
    assert stopped.value.code == 0
    before, after = centres(tmp_path / "p" / "sparse" / "0"), centres(tmp_path / "out" / "sparse" / "0")
    shift = [np.linalg.norm(after[name] - before[name]) for name in before]
    assert max(shift) < 0.2
    names = list(before)
    old, new = (np.linalg.norm(c[names[0]] - c[names[-1]]) for c in (before, after))
    assert new == pytest.approx(1.02 * old, rel=1e-8)
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    pivot = pivot_of(record)
    got = ply_points(tmp_path / "out" / "dense" / "fused.ply")
    np.testing.assert_allclose(got, 1.02 * (xyz - pivot) + pivot, atol=2e-9 * np.abs(UTM).max() * 1e-1)
    undo_project(tmp_path / "out", tmp_path / "back")
    assert (tmp_path / "back" / "dense" / "fused.ply").read_bytes() == (
        tmp_path / "p" / "dense" / "fused.ply"
    ).read_bytes()
    again = points(tmp_path / "back" / "sparse" / "0")
    assert all(np.abs(again[i] - model.points3D[i].xyz).max() < 4e-9 for i in again)


def pivot_of(record):
    return np.array(record["translation_m"]) / (1 - record["scale"])


def test_a_similarity_that_moves_a_far_model_away_is_told(tmp_path):
    far_project(tmp_path / "p")
    away = Similarity(
        scale=1.005,
        rotation_xyzw=np.array([0, 0, 0, 1.0]),
        translation_m=np.zeros(3),
        cov=np.zeros((7, 7)),
        provenance="file",
    )
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", away)
    assert any("moves it by 284" in note for note in map(str, applied.notes))


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("text", [True, False])
def test_points_that_come_to_lie_far_away_keep_their_precision(tmp_path, kind, text):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    path = tmp_path / "p" / "fused.ply"
    ply(path, xyz_of(model), kind=kind)
    if text:
        rows = "".join(f"{x!r} {y!r} {z!r} 7\n" for x, y, z in ply_points(path).tolist())
        head = path.read_bytes().partition(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
        path.write_bytes(head + b"end_header\n" + rows.encode())
    there = Similarity(scale=2.5, rotation_xyzw=QUAT, translation_m=UTM, cov=np.zeros((7, 7)), provenance="to the map")
    apply_to_project(tmp_path / "p", tmp_path / "out", there)
    want = 2.5 * ply_points(path) @ TURN.T + UTM
    assert np.abs(ply_points(tmp_path / "out" / "fused.ply") - want).max() < 4e-9
    undo_project(tmp_path / "out", tmp_path / "back")
    step = 6e-8 if kind == "float" else 0.0
    off = np.abs(ply_points(tmp_path / "back" / "fused.ply") - ply_points(path))
    assert (off <= 3e-9 + step * np.abs(ply_points(path))).all()
    head = (tmp_path / "back" / "fused.ply").read_bytes().partition(b"end_header")[0]
    assert head == path.read_bytes().partition(b"end_header")[0]


def test_near_models_are_scaled_about_the_origin_as_ever(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", plain_factor(2.0), about_origin=False)
    after = points(tmp_path / "out" / "sparse" / "0")
    assert all(np.array_equal(after[i], 2 * model.points3D[i].xyz) for i in after)
    assert applied.notes == ()


# whose scale it is


def write_scale(path, model=None):
    estimate = ScaleEstimate(
        metres_per_unit=2.0,
        sigma_log=0.01,
        ci95=(1.96, 2.04),
        verdict="trusted",
        method="joint",
        gravity_in_world_m_s2=np.array([0, 0, -9.81]),
        cov=1e-4 * np.eye(7),
    )
    known = {} if model is None else {"of_model": ModelIdentity.of(model).as_json()}
    write_json(path, {**estimate.as_json(), **known})
    return read_scales([str(path)])


def test_a_scale_is_that_of_its_model(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    own = write_scale(tmp_path / "own.json", model)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", own)
    assert not any("scale" in note for note in map(str, applied.notes))
    text = save(model, tmp_path / "text" / "sparse" / "0", text=True, old=False)
    assert apply_to_project(tmp_path / "text", tmp_path / "out_text", own).notes == ()
    assert ModelIdentity.of(read_model(text)).poses == ModelIdentity.of(model).poses
    nameless = apply_to_project(tmp_path / "p", tmp_path / "out2", write_scale(tmp_path / "nameless.json"))
    assert any("does not name its model" in note for note in map(str, nameless.notes))


@pytest.mark.parametrize(
    ("other", "match"),
    [
        (lambda: build(["a.png", "b.png", "c.png"]), "3 images instead of 8"),
        (lambda: build([f"other{i}.png" for i in range(COUNT)]), "other names"),
        (lambda: mapped_again(build()), "stand elsewhere"),
        (lambda: build(offset=(0.0, 0.0, 1.0)), "stand elsewhere"),
        (lambda: turned(build()), "stand elsewhere"),
    ],
)
def test_a_scale_of_another_model_is_refused(tmp_path, other, match):
    save(build(), tmp_path / "p" / "sparse" / "0")
    scales = write_scale(tmp_path / "other.json", other())
    with pytest.raises(InertialError, match=rf"of another model than sparse/0: .*{match}.*--any-model"):
        apply_to_project(tmp_path / "p", tmp_path / "out", scales)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", scales, any_model=True)
    assert any("applied anyway" in note for note in map(str, applied.notes))


def mapped_again(model):
    """The same images in other units, as another run of COLMAP makes them."""
    model.transform(pycolmap.Sim3d(1.02, pycolmap.Rotation3d(), np.zeros(3)))
    return model


def turned(model):
    """The same about its own middle, upside down."""
    middle = np.mean([image.projection_center() for image in model.images.values()], axis=0)
    flip = np.diag([1.0, -1.0, -1.0])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(flip), middle - flip @ middle))
    return model


#: As an exporter of another program wrote it: a colour, a position, a length in each.
OTHERS = {
    "outputs/hall/splatfacto/1/nerfstudio_models/step-000029999.ckpt": b"\x80\x02model",
    "outputs/hall/splatfacto/1/config.yml": b"scene_scale: 2.0\n",
    "scene.wrl": b"#VRML V2.0 utf8\nShape { geometry PointSet { coord Coordinate { point [ 1 2 3 ] } } }\n",
    "viewer/scene.glb": b"glTF\x02\x00\x00\x00 with COLOR_0",
    "rig_of_another_unit.json": b'[{"cameras": [{"image_prefix": "cam0/", "ref_sensor": true}, '
    b'{"image_prefix": "cam1/", "cam_from_rig_translation": [0.011, 0, 0]}]}]',
}


def write_workspace(root):
    """One workspace of many programs, of a model in ``colmap/sparse/0`` whose images have the same names in folders."""
    names = [f"cam{i % 4}/{i // 4:05}.png" for i in range(COUNT)]
    model = nerfstudio(root, names=names)
    picture = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    picture[..., 3] = np.where(np.arange(WIDTH) < WIDTH // 2, 0, 255)
    for name in names:
        for folder, content in (("images", picture), ("masks", picture[..., 3])):
            (root / folder / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / folder / name), content)
    made = inria(root, model, sparse=root / "colmap" / "sparse" / "0")
    write_mvsnet(root / "mvs", model)
    rig = write_rig(root / "rig_config.json", model, [f"cam{i}/" for i in range(4)])
    training = training_of(model, APPLIED)
    write_json(root / "outputs" / "hall" / "splatfacto" / "1" / "dataparser_transforms.json", training)
    ply(root / "exports" / "splat.ply", into_training(training, xyz_of(model)))
    mesh = xyz_of(model)[:30]
    ply(root / "dense" / "mesh.ply", mesh)
    (root / "dense" / "mesh.obj").write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.tolist()))
    write_json(root / "assets" / "transform.json", {"frames": []})
    put(root, {**OTHERS, **FREE})
    return model, made, rig, training


def assert_lengths(folder, model, made, rig, training, at, off):
    """All lengths of the workspace, where ``at`` moves points to, times the scale of that; to ``off`` in doubles."""
    rows, bounds, params = made
    sparse = folder / "colmap" / "sparse" / "0"
    scale = np.linalg.norm(at(np.array([1.0, 0, 0])) - at(np.zeros(3)))
    turn = np.stack([(at(axis) - at(np.zeros(3))) / scale for axis in np.eye(3)], axis=1)
    for image in model.images.values():
        np.testing.assert_allclose(centres(sparse)[image.name], at(image.projection_center()), atol=10 * off)
    found = points(sparse)
    for number, point in model.points3D.items():
        np.testing.assert_allclose(found[number], at(point.xyz), atol=off)
    # in the world of transforms.json, by what its cameras see
    assert error_px(folder, model) < 1e-3
    world = world_of(APPLIED)
    want = at(xyz_of(model)) @ world[:3, :3].T + world[:3, 3]
    np.testing.assert_allclose(ply_points(folder / "sparse_pc.ply"), want, atol=2e-6)
    for new, old in zip(json.loads((folder / "output" / "cameras.json").read_text()), rows, strict=True):
        np.testing.assert_allclose(new["position"], at(old["position"]), atol=off)
        np.testing.assert_allclose(new["rotation"], turn @ np.array(old["rotation"]), atol=off)
    new = np.load(folder / "poses_bounds.npy")
    np.testing.assert_allclose(new[:, [3, 8, 13]], at(bounds[:, [3, 8, 13]]), atol=off)
    np.testing.assert_allclose(new[:, 15:], scale * bounds[:, 15:], atol=10 * off)
    inverse = json.loads((sparse / "depth_params.json").read_text())
    for name, fields in params.items():
        np.testing.assert_allclose(inverse[name]["scale"] * scale, fields["scale"], rtol=off)
        np.testing.assert_allclose(inverse[name]["offset"] * scale, fields["offset"], rtol=off)
    for i, image in enumerate(in_order(model)):
        centre, _, _, depths = read_mvsnet(folder / "mvs" / "cams" / f"{i:08}_cam.txt")
        np.testing.assert_allclose(centre, at(image.projection_center()), atol=10 * off)
        np.testing.assert_allclose(depths, np.array([0.5, 0.0125, 192 / scale, 2.9]) * scale, rtol=10 * off)
    for new, camera in zip(read_rig(folder / "rig_config.json"), rig[1:], strict=True):
        np.testing.assert_allclose(new, scale * np.array(camera["cam_from_rig_translation"]), atol=off)
    after = json.loads((folder / "outputs" / "hall" / "splatfacto" / "1" / "dataparser_transforms.json").read_text())
    there = into_training(training, xyz_of(model))
    np.testing.assert_allclose(into_training(after, at(xyz_of(model))), there, atol=10 * off)
    np.testing.assert_allclose(ply_points(folder / "exports" / "splat.ply"), there, atol=1e-7)
    np.testing.assert_allclose(ply_points(folder / "dense" / "mesh.ply"), at(xyz_of(model)[:30]), atol=2e-6)
    lines = (folder / "dense" / "mesh.obj").read_text().splitlines()
    np.testing.assert_allclose(
        [[float(w) for w in line.split()[1:]] for line in lines], at(xyz_of(model)[:30]), atol=off
    )


def test_everything_at_once_moves_and_comes_back(tmp_path):
    """Each length of a workspace of many programs by a reader of this test's own; what has none is as it was."""
    root, out, back = tmp_path / "p", tmp_path / "out", tmp_path / "back"
    given = write_workspace(root)
    assert_lengths(root, *given, lambda xyz: np.asarray(xyz), 1e-14)
    before = {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    applied = apply_to_project(root, out, SIM3)
    assert_lengths(out, *given, moved, 1e-13)
    # what did not change is free of lengths, in the frame of a training, or named
    named = {group.kind for group in applied.unmoved}
    of_kind = {path.rpartition(".")[2] for path in OTHERS} | {"png"}
    assert {group.example.rpartition(".")[2] for group in applied.unmoved} == of_kind
    for path in before:
        if (out / path).read_bytes() != before[path]:
            continue
        is_free = str(path) in FREE or path.parts[0] in ("images", "masks") or path.name in ("pair.txt", "cameras.bin")
        assert is_free or {path.suffix, f"depths ({path.suffix})"} & named or path.parts[0] == "exports", path
    notes = " ".join(map(str, applied.notes))
    assert "depths in 8 integer images" in notes and "2.5 times as large" in notes
    assert "exports/splat.ply: copied unchanged" in notes and "rig_of_another_unit.json: copied unchanged" in notes
    undo_project(out, back)
    assert_lengths(back, *given, lambda xyz: np.asarray(xyz), 1e-14)
    made = {path.relative_to(back) for path in back.rglob("*") if path.is_file()}
    assert {path.name for path in made - set(before)} <= {"rigs.bin", "frames.bin"}  # which COLMAP of today writes
    assert set(before) <= made


def test_what_is_exported_of_it_has_its_lengths_colours_and_alpha(tmp_path):
    """Point 8: linear colours in glTF, alpha in pictures, masks by name."""
    root, out = tmp_path / "p", tmp_path / "out"
    model, *_ = write_workspace(root)
    apply_to_project(root, out, SIM3)
    sparse = out / "colmap" / "sparse" / "0"
    made = export_model(sparse, tmp_path / "splat", "gsplat", images=out / "images", unscaled=True)
    for path in (tmp_path / "splat" / "images").iterdir():
        shown = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert shown.shape == (HEIGHT, WIDTH, 4) and set(np.unique(shown[..., 3])) == {0, 255}
    assert len(list((tmp_path / "splat" / "images").iterdir())) == COUNT
    assert any("masks" in str(note) for note in made.notes)
    np.testing.assert_allclose(
        sorted(ply_points(tmp_path / "splat" / "sparse_pc.ply").tolist()),
        sorted(moved(xyz_of(model)).tolist()),
        atol=1e-5,
    )
    pytest.importorskip("pygltflib")
    export_model(sparse, tmp_path / "gltf", "gltf", unscaled=True)
    xyz, rgb = glb_points(tmp_path / "gltf" / "scene.glb")
    order = np.lexsort(np.round(xyz, 4).T)
    want = moved(xyz_of(model))
    colours = np.array([model.points3D[i].color for i in sorted(model.points3D)]) / 255
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    by = np.lexsort(np.round(want, 4).T)
    np.testing.assert_allclose(xyz[order], want[by], atol=1e-5)
    np.testing.assert_allclose(rgb[order], linear[by], atol=1e-4)


def glb_points(path):
    """Positions in the world, and linear colours, of the node ``points``."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    content, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
    nodes = content["nodes"]
    number = next(i for i, node in enumerate(nodes) if node.get("name") == "points")
    attributes = content["meshes"][nodes[number]["mesh"]]["primitives"][0]["attributes"]

    def values(name, kind, columns):
        accessor = content["accessors"][attributes[name]]
        start = content["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        return np.frombuffer(buffer, kind, columns * accessor["count"], start).reshape(-1, columns).astype(float)

    xyz, above = values("POSITION", "<f4", 3), number
    while (above := next((i for i, n in enumerate(nodes) if above in n.get("children", [])), None)) is not None:
        node = nodes[above]
        assert "matrix" not in node and "scale" not in node
        xyz = xyz @ matrix_from_quat(np.array(node.get("rotation", [0, 0, 0, 1.0]))).T + node.get(
            "translation", [0, 0, 0]
        )
    # glTF has y up, this world z
    return xyz @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), values("COLOR_0", "<u2", 4)[:, :3] / 65535


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda p: (p / "points3D.bin").rename(p / ".points3D.bin.icloud"),
            "points3D.bin is in iCloud only; open",
        ),
        (lambda p: (p / "points3D.bin").unlink(), r"points3D\.bin is missing"),
        (lambda p: [(p / f"{name}.bin").unlink() for name in ("images", "points3D")], "images.bin, points3D.bin are"),
    ],
)
def test_what_a_model_lacks_is_said(tmp_path, change, match):
    change(save(build(), tmp_path / "p"))
    with pytest.raises(FormatError, match=match):
        apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)


@pytest.mark.parametrize(
    ("data", "match"),
    [(b"PK\x03\x04" + bytes(60), r"is packed \(zip\)"), (b"anything", "not a folder; give the folder")],
)
def test_a_file_in_place_of_a_project_is_called_what_it_is(tmp_path, data, match):
    (tmp_path / "p").write_bytes(data)
    with pytest.raises(FormatError, match=match):
        apply_to_project(tmp_path / "p", tmp_path / "out", SIM3)


def test_what_was_never_applied_is_not_undone(tmp_path):
    save(build(), tmp_path / "p" / "sparse" / "0")
    with pytest.raises(FormatError, match="nothing was applied here"):
        undo_project(tmp_path / "p", tmp_path / "out")
