"""Whole COLMAP projects: everything that carries length moves together, all or nothing, and back again."""

import errno
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import AlreadyMetricError, FormatError, InertialError, NotObservableError, OutputError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.model import copying, mean_reprojection_error_px, read_model, similarity_as_json
from colmap_inertial.model.artefacts import transform_depth_map, transform_obj, transform_options
from colmap_inertial.model.database import transform_database
from colmap_inertial.model.layout import read_layout
from colmap_inertial.model.notes import collecting_notes
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import ModelScale, plain_factor, read_scales, read_similarity
from colmap_inertial.model.soundness import check_binary_model
from tests.helpers.damage import refusals
from tests.helpers.files import write_anew
from tests.helpers.json_schemas import find_violations
from tests.helpers.model_project import HEIGHT, NAMES, WIDTH, fuse, prior_rows, write_project
from tests.helpers.similarities import SIMILARITY

ROTATION = matrix_from_quat(SIMILARITY.rotation_xyzw)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A project by COLMAP, the same in metres, and the same taken back. Tests must not change them."""
    root = tmp_path_factory.mktemp("apply")
    write_project(root / "project")
    before = digest(root / "project")
    apply_to_project(root / "project", root / "metric", SIMILARITY)
    undo_project(root / "metric", root / "back")
    assert digest(root / "project") == before
    return root


@pytest.fixture
def project(made, tmp_path):
    """A copy to change."""
    return Path(shutil.copytree(made / "project", tmp_path / "project"))


def digest(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def moved(points):
    return points @ (SIMILARITY.scale * ROTATION).T + SIMILARITY.translation_m


def vertices(path):
    """Vertices of a binary PLY of COLMAP, by a reader of this test's own."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    lines = data[:end].decode().split("\n")
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kinds = {"float": "<f4", "uchar": "u1", "double": "<f8"}
    dtype = [(w[2], kinds[w[1]]) for line in lines if (w := line.split())[:1] == ["property"] and w[1] in kinds]
    return data[:end], np.frombuffer(data[end:], dtype, count), data[end + count * np.dtype(dtype).itemsize :]


def xyz(rows, names=("x", "y", "z")):
    return np.stack([rows[name].astype(float) for name in names], -1)


def relative_error(values, truth):
    return np.abs(values - truth).max() / np.ptp(truth, axis=0).max()


def depth_map(path):
    depth = pycolmap.DepthMap()
    depth.read(str(path))
    return np.asarray(depth.to_array())


@pytest.mark.parametrize("folder", ["sparse/0", "dense/sparse"])
def test_models_move_and_come_back_with_their_errors_unchanged(made, folder):
    before, after, back = (read_model(made / name / folder) for name in ("project", "metric", "back"))
    points = np.array([before.point3D(i).xyz for i in sorted(before.point3D_ids())])
    wanted, returned = (np.array([m.point3D(i).xyz for i in sorted(m.point3D_ids())]) for m in (after, back))
    assert relative_error(wanted, moved(points)) <= 1e-9
    assert relative_error(returned, points) <= 1e-9
    for image_id in before.reg_image_ids():
        centre = before.image(image_id).projection_center()
        np.testing.assert_allclose(after.image(image_id).projection_center(), moved(centre), atol=1e-9)
        np.testing.assert_allclose(back.image(image_id).projection_center(), centre, atol=1e-9)
    assert mean_reprojection_error_px(before) > 0.2
    assert mean_reprojection_error_px(after) == pytest.approx(mean_reprojection_error_px(before), abs=1e-9)
    assert (made / "metric" / folder / "transform.json").is_file()
    assert not (made / "back" / folder / "transform.json").exists()


def test_text_beside_binary_moves_too(made):
    binary, text = (read_model(made / "metric" / "sparse" / "0", suffix) for suffix in (".bin", ".txt"))
    for i in binary.point3D_ids():
        np.testing.assert_allclose(text.point3D(i).xyz, binary.point3D(i).xyz, atol=1e-12)


def test_fused_cloud_keeps_count_colours_and_visibility(made):
    head, before, rest = vertices(made / "project" / "dense" / "fused.ply")
    head_after, after, rest_after = vertices(made / "metric" / "dense" / "fused.ply")
    _, back, _ = vertices(made / "back" / "dense" / "fused.ply")
    assert len(before) > 2000
    assert (head_after, rest_after, len(after)) == (head, rest, len(before))
    assert relative_error(xyz(after), moved(xyz(before))) <= 1e-6
    assert relative_error(xyz(back), xyz(before)) <= 1e-6
    normals = xyz(before, ("nx", "ny", "nz"))
    np.testing.assert_allclose(xyz(after, ("nx", "ny", "nz")), normals @ ROTATION.T, atol=1e-6)
    np.testing.assert_allclose(xyz(back, ("nx", "ny", "nz")), normals, atol=1e-6)
    for colour in ("red", "green", "blue"):
        assert np.array_equal(after[colour], before[colour])
    for name in ("metric", "back"):
        visible = Path("dense") / "fused.ply.vis"
        assert (made / name / visible).read_bytes() == (made / "project" / visible).read_bytes()


def test_meshes_keep_their_faces_and_colours(made):
    for name, n_rest in (("meshed-poisson.ply", 1000),):
        head, before, rest = vertices(made / "project" / "dense" / name)
        head_after, after, rest_after = vertices(made / "metric" / "dense" / name)
        assert len(rest) > n_rest
        assert (head_after, rest_after) == (head, rest)
        assert relative_error(xyz(after), moved(xyz(before))) <= 1e-6
        assert np.array_equal(after["red"], before["red"])
        assert relative_error(xyz(vertices(made / "back" / "dense" / name)[1]), xyz(before)) <= 1e-6


def test_text_meshes_by_opencv_move_and_keep_every_other_line(subtests, made):
    for name in ("textured.obj", "ascii.ply"):
        with subtests.test(name=name):
            before, after, back = (
                (made / p / "dense" / name).read_text().split("\n") for p in ("project", "metric", "back")
            )
            assert len(before) == len(after)
            points = []
            for old, new, old_again in zip(before, after, back, strict=True):
                words = old.removeprefix("v ").split()
                if len(words) == 3 and all("." in word for word in words):
                    points.append(
                        [[float(v) for v in line.removeprefix("v ").split()] for line in (old, new, old_again)]
                    )
                else:
                    assert old == new == old_again
            points = np.array(points)
            assert len(points) == 8
            assert relative_error(points[:, 1], moved(points[:, 0])) <= 1e-6
            assert relative_error(points[:, 2], points[:, 0]) <= 1e-6


def test_normals_of_an_obj_mesh_turn_and_keep_their_length(tmp_path):
    normals = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [2.0, 3.0, 6.0]])
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.25]])
    lines = [f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in points] + [f"vn {x} {y} {z}" for x, y, z in normals]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "vt 0.25 0.75", "f 1//1 2//2 1//3", ""]))
    changed = transform_obj(tmp_path / "a.obj", tmp_path / "b.obj", SIMILARITY)
    assert changed == ("positions", "normals")
    rows = [line.split() for line in (tmp_path / "b.obj").read_text().splitlines()]
    assert rows[5:] == [["vt", "0.25", "0.75"], ["f", "1//1", "2//2", "1//3"]]
    assert [row[4:] for row in rows[:2]] == 2 * [["0.5", "0.5", "0.5"]]
    found = np.array([[float(value) for value in row[1:4]] for row in rows[:5]])
    np.testing.assert_allclose(found[:2], moved(points), rtol=1e-12)
    np.testing.assert_allclose(found[2:], normals @ ROTATION.T, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found[2:], axis=1), [1.0, 1.0, 7.0], rtol=1e-12)


def test_depth_maps_scale_and_unknown_depth_stays_unknown(made):
    maps = Path("dense") / "stereo" / "depth_maps"
    files = sorted(p.name for p in (made / "project" / maps).iterdir())
    # standard deviations are lengths, too
    assert sum(name.endswith(".sigma.bin") for name in files) == len(NAMES) == len(files) / 3
    for name in files:
        before, after, back = (depth_map(made / p / maps / name) for p in ("project", "metric", "back"))
        assert np.array_equal(after == 0, before == 0)
        assert (before == 0).any() and (before > 0).any()
        np.testing.assert_allclose(after, SIMILARITY.scale * before.astype(float), rtol=2e-7)
        np.testing.assert_allclose(back, before, rtol=5e-7)


def test_depth_maps_and_points_agree_before_and_after(subtests, made):
    for name in ("project", "metric"):
        with subtests.test(name=name):
            # Every sparse point lies on the ball: its depth by the model is the depth map's where it is seen
            model = read_model(made / name / "dense" / "sparse")
            size = 1.0 if name == "project" else SIMILARITY.scale
            differences = []
            for image_id in model.reg_image_ids():
                image = model.image(image_id)
                depth = depth_map(made / name / "dense" / "stereo" / "depth_maps" / f"{image.name}.geometric.bin")
                for point in image.points2D:
                    if point.has_point3D():
                        cam = image.cam_from_world() * model.point3D(point.point3D_id).xyz
                        u, v = image.camera.img_from_cam(cam)
                        if 0 <= u < WIDTH and 0 <= v < HEIGHT and depth[int(v), int(u)] > 0:
                            differences.append(abs(depth[int(v), int(u)] - cam[2]) / size)
            assert len(differences) > 500
            assert np.median(differences) < 0.01


def test_colmap_fuses_the_metric_workspace_to_the_same_cloud(made, tmp_path):
    # All or nothing: with depth left in the old units, COLMAP would keep only what agrees by chance
    workspace = Path(shutil.copytree(made / "metric" / "dense", tmp_path / "dense"))
    fuse(workspace, tmp_path / "again.ply")
    again = xyz(vertices(tmp_path / "again.ply")[1])
    ours = xyz(vertices(made / "metric" / "dense" / "fused.ply")[1])
    assert len(again) == pytest.approx(len(ours), rel=0.01)
    centre = SIMILARITY.translation_m
    radius = np.linalg.norm(again - centre, axis=1) / SIMILARITY.scale
    assert np.median(np.abs(radius - 1)) < 0.01


def test_priors_in_the_models_frame_move_with_their_covariance(made):
    before, after, back = (prior_rows(made / p / "database.db") for p in ("project", "metric", "back"))
    assert len(before) == len(NAMES)
    for old, new, again in zip(before[:-1], after[:-1], back[:-1], strict=True):
        np.testing.assert_allclose(new[0], moved(old[0]), atol=1e-12)
        turned = SIMILARITY.scale**2 * ROTATION @ old[1].reshape(3, 3) @ ROTATION.T
        np.testing.assert_allclose(new[1].reshape(3, 3), turned, atol=1e-15)
        np.testing.assert_allclose(again[0], old[0], atol=1e-9)
        np.testing.assert_allclose(again[1], old[1], atol=1e-12)
        assert np.array_equal(new[2], old[2])
    for old, new in zip(before[-1][:3], after[-1][:3], strict=True):
        assert np.array_equal(old, new)
    copy = made / "copy.db"
    shutil.copy(made / "metric" / "database.db", copy)
    database = pycolmap.Database.open(str(copy))
    assert database.num_images() == len(NAMES)
    np.testing.assert_allclose(database.read_all_pose_priors()[0].position, after[0][0])
    database.close()


def test_a_database_of_colmap_3_keeps_its_version(made, project, tmp_path):
    with sqlite3.connect(project / "database.db") as database:
        rows = database.execute("SELECT corr_data_id, position, coordinate_system FROM pose_priors").fetchall()
        database.execute("DROP TABLE pose_priors")
        database.execute(
            "CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY, position BLOB, coordinate_system INTEGER)"
        )
        database.executemany("INSERT INTO pose_priors VALUES (?, ?, ?)", rows)
        database.execute("PRAGMA user_version = 3900")
    database.close()
    apply_to_project(project, tmp_path / "metric", SIMILARITY)
    with sqlite3.connect(tmp_path / "metric" / "database.db") as database:
        assert database.execute("PRAGMA user_version").fetchone() == (3900,)
        got = [np.frombuffer(row[0]) for row in database.execute("SELECT position FROM pose_priors")]
    database.close()
    np.testing.assert_allclose(got[0], moved(np.frombuffer(rows[0][1])), atol=1e-12)


def test_priors_in_a_frame_of_their_own_stay_and_are_mentioned(project, tmp_path):
    with sqlite3.connect(project / "database.db") as database:
        far = np.array([100.0, 200.0, 3.0]).tobytes()
        database.execute("UPDATE pose_priors SET position = ?", (far,))
    database.close()
    applied = apply_to_project(project, tmp_path / "metric", SIMILARITY)
    assert any("5 pose priors are not in a model's frame" in str(note) for note in applied.notes)
    assert all(np.array_equal(row[0], [100, 200, 3]) for row in prior_rows(tmp_path / "metric" / "database.db"))


def test_what_sqlite_has_not_yet_written_into_the_database_is_not_lost(project, tmp_path):
    database = sqlite3.connect(project / "database.db")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    database.execute("UPDATE pose_priors SET gravity = ? WHERE pose_prior_id = 1", (np.array([1.0, 0, 0]).tobytes(),))
    database.commit()
    assert (project / "database.db-wal").stat().st_size > 0
    apply_to_project(project, tmp_path / "metric", SIMILARITY)
    database.close()
    assert np.array_equal(prior_rows(tmp_path / "metric" / "database.db")[0][2], [1, 0, 0])
    assert not (tmp_path / "metric" / "database.db-shm").exists()


def test_depth_ranges_of_option_files_scale_and_automatic_ones_stay(made):
    wanted = f"[PatchMatchStereo]\r\ndepth_min={0.25 * SIMILARITY.scale} \r\ndepth_max = -1\r\nwindow_radius=5\r\n"
    assert (made / "metric" / "project.ini").read_bytes() == wanted.encode()


def test_everything_else_is_copied_and_the_record_says_what_was_done(made):
    before, after = digest(made / "project"), digest(made / "metric")
    record = json.loads((made / "metric" / "transform.json").read_text())
    assert find_violations("transform", record) == []
    changed = {f["path"] for f in record["files"]}
    for path, data in before.items():
        if path not in changed and str(Path(path).parent) not in changed:
            assert after[path] == data, path
    assert set(after) - set(before) == {
        "transform.json", "sparse/0/transform.json", "dense/sparse/transform.json"
    }  # fmt: skip
    assert record["scale"] == SIMILARITY.scale
    assert np.array(record["cov"]).shape == (7, 7)
    assert {"dense/fused.ply", "database.db", "project.ini", "sparse/0", "dense/sparse"} <= changed
    assert set(digest(made / "back")) == set(before)
    stamps = [(made / name / "notes.txt").stat().st_mtime_ns for name in ("project", "metric")]
    assert stamps[0] == stamps[1]


@pytest.fixture(scope="module")
def two_models(tmp_path_factory):
    """Two sub-models of a two-camera rig each, a database of either, and a dense workspace of the second."""
    root = tmp_path_factory.mktemp("two") / "project"
    pycolmap.set_random_seed(6)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 4, 60
    options.prior_position = True
    (root / "sparse").mkdir(parents=True)
    for index in (0, 1):
        database = pycolmap.Database.open(str(root / f"part{index}.db"))
        model = pycolmap.synthesize_dataset(options, database)
        database.close()
        for image in model.images.values():
            image.name = f"{index}_{image.name}"
        with sqlite3.connect(root / f"part{index}.db") as rows:
            rows.execute("UPDATE images SET name = ? || name", (f"{index}_",))
        rows.close()
        (root / "sparse" / str(index)).mkdir()
        (model.write_text if index else model.write_binary)(str(root / "sparse" / str(index)))
    (root / "dense" / "sparse").mkdir(parents=True)
    (root / "dense" / "stereo" / "depth_maps").mkdir(parents=True)
    model.write_binary(str(root / "dense" / "sparse"))
    pycolmap.DepthMap.from_array(np.ones((3, 4), "f4"), 0.1, 9).write(
        str(root / "dense" / "stereo" / "depth_maps" / "a.geometric.bin")
    )
    return root


def estimate(scale, verdict="trusted"):
    refused = verdict == "refused"
    return {
        "metres_per_unit": None if refused else scale,
        "sigma_log": None if refused else 0.01,
        "ci95": None if refused else [0.98 * scale, 1.02 * scale],
        "verdict": verdict,
        "reasons": ["the camera stood still"] if refused else [],
        "gravity_in_world_m_s2": None if refused else [0.0, 9.8, 0.0],
        "method": "joint",
        "cov": None,
    }


def write_scale(path, *args):
    path.write_text(json.dumps(estimate(*args)))
    return path


def test_each_sub_model_has_its_own_scale_and_what_was_made_from_it_follows(two_models, tmp_path):
    a, b = write_scale(tmp_path / "a.json", 2.0), write_scale(tmp_path / "b.json", 5.0)
    scales = read_scales([f"0={a}", f"1={b}"], world="z-up")
    applied = apply_to_project(two_models, tmp_path / "metric", scales)
    assert {i: s.similarity.scale for i, (_, s) in applied.models.items()} == {0: 2.0, 1: 5.0}
    for folder, scale in (("sparse/0", 2.0), ("sparse/1", 5.0), ("dense/sparse", 5.0)):
        before, after = read_model(two_models / folder), read_model(tmp_path / "metric" / folder)
        for i in before.point3D_ids():
            lengths = [np.linalg.norm(m.point3D(i).xyz) for m in (before, after)]
            assert lengths[1] == pytest.approx(scale * lengths[0], rel=1e-9)
        rigs = [next(iter(m.rigs.values())) for m in (before, after)]
        sensor = next(iter(rigs[0].non_ref_sensors))
        lengths = [np.linalg.norm(rig.sensor_from_rig(sensor).translation) for rig in rigs]
        assert lengths[1] == pytest.approx(scale * lengths[0], rel=1e-9)
    assert depth_map(tmp_path / "metric" / "dense" / "stereo" / "depth_maps" / "a.geometric.bin").max() == 5.0
    for index, scale in ((0, 2.0), (1, 5.0)):
        before, after = (prior_rows(p / f"part{index}.db") for p in (two_models, tmp_path / "metric"))
        for old, new in zip(before, after, strict=True):
            assert np.linalg.norm(new[0]) == pytest.approx(scale * np.linalg.norm(old[0]), rel=1e-9)
    undo_project(tmp_path / "metric", tmp_path / "back")
    for index in (0, 1):
        query = "SELECT sensor_from_rig FROM rig_sensors"
        rows = []
        for root in (two_models, tmp_path / "metric", tmp_path / "back"):
            with sqlite3.connect(root / f"part{index}.db") as database:
                rows.append(np.frombuffer(database.execute(query).fetchone()[0]))
            database.close()
        # Both models have the same sensors: where the cameras sit tells whose rig it is
        np.testing.assert_allclose(rows[1][4:], (2.0, 5.0)[index] * rows[0][4:], rtol=1e-9)
        np.testing.assert_array_equal(rows[1][:4], rows[0][:4])
        np.testing.assert_allclose(rows[2], rows[0], atol=1e-12)


def test_a_refused_sub_model_keeps_its_units(two_models, tmp_path):
    models = [{"index": 0, **estimate(2.0)}, {"index": 1, **estimate(1.0, "refused")}]
    (tmp_path / "result.json").write_text(json.dumps({"models": models}))
    applied = apply_to_project(two_models, tmp_path / "metric", read_scales([str(tmp_path / "result.json")]))
    assert applied.models[1][1].verdict == "refused"
    for name in ("sparse/1/points3D.txt", "dense/stereo/depth_maps/a.geometric.bin", "dense/sparse/points3D.bin"):
        assert (tmp_path / "metric" / name).read_bytes() == (two_models / name).read_bytes()
    record = json.loads((tmp_path / "metric" / "transform.json").read_text())
    assert find_violations("transform", record) == []
    assert [m["similarity"] is None for m in record["models"]] == [False, True]
    assert not (tmp_path / "metric" / "sparse" / "1" / "transform.json").exists()


def test_what_cannot_be_told_is_refused(two_models, tmp_path):
    scales = {0: ModelScale(similarity=plain_factor(2)), 1: ModelScale(similarity=plain_factor(3))}
    project = Path(shutil.copytree(two_models, tmp_path / "project"))
    with pytest.raises(InertialError, match="NUMBER=FILE"):
        apply_to_project(project, tmp_path / "out", {None: scales[0]})
    with pytest.raises(InertialError, match="scales of 0"):
        apply_to_project(project, tmp_path / "out", {0: scales[0]})
    cloud = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {n}\n" for n in "xyz")
    (project / "scan.ply").write_text(cloud + "end_header\n1 2 3\n")
    with pytest.raises(FormatError, match=r"scan\.ply: it is not known"):
        apply_to_project(project, tmp_path / "out", scales)
    apply_to_project(project, tmp_path / "kept", scales, keep=["scan.*"])
    assert (tmp_path / "kept" / "scan.ply").read_bytes() == (project / "scan.ply").read_bytes()
    (project / "scan.ply").unlink()
    # A dense workspace of an earlier mapping: the same images, another scale
    model = read_model(project / "dense" / "sparse")
    model.transform(pycolmap.Sim3d(1.4, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_binary(str(project / "dense" / "sparse"))
    with pytest.raises(FormatError, match="its cameras are elsewhere"):
        apply_to_project(project, tmp_path / "out", scales)
    for image in model.images.values():
        image.name = "x" + image.name
    model.write_binary(str(project / "dense" / "sparse"))
    with pytest.raises(FormatError, match="none of the sub-models"):
        apply_to_project(project, tmp_path / "out", scales)
    apply_to_project(project, tmp_path / "everything", plain_factor(2))
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".*"))


def test_a_dense_workspace_alone_is_a_project(made, tmp_path):
    apply_to_project(made / "project" / "dense", tmp_path / "metric", SIMILARITY)
    assert (tmp_path / "metric" / "fused.ply").read_bytes() == (made / "metric" / "dense" / "fused.ply").read_bytes()
    layout = read_layout(made / "project" / "dense", [Path("sparse"), Path("stereo")], one_for_all=False)
    assert layout.owner(Path("fused.ply")) == 0


def test_a_second_time_is_refused(made, tmp_path):
    for folder in ("", "sparse/0", "dense"):
        with pytest.raises(AlreadyMetricError, match="already holds a metric scale"):
            apply_to_project(made / "metric" / folder, tmp_path / "again", SIMILARITY)
    with pytest.raises(FormatError, match="nothing was applied here"):
        undo_project(made / "back", tmp_path / "again")
    assert not list(tmp_path.iterdir())


def test_out_must_be_new_and_elsewhere(made, project, tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(OutputError, match="exists already"):
        apply_to_project(project, tmp_path / "there", SIMILARITY)
    with pytest.raises(OutputError, match="lies within the other"):
        apply_to_project(project, project / "metric", SIMILARITY)
    assert digest(project) == digest(made / "project")


DAMAGE = {
    "dense/fused.ply": lambda data: data[:-1],
    "dense/meshed-poisson.ply": lambda data: data[:-5],
    "dense/ascii.ply": lambda data: data[: len(data) // 2],
    "dense/stereo/depth_maps/000.png.geometric.bin": lambda data: data[:-4],
    "dense/stereo/normal_maps/000.png.geometric.bin": lambda data: data + b"\0",
    "dense/sparse/images.bin": lambda data: data[:-30],
    "sparse/0/points3D.bin": lambda data: data[: len(data) // 3],
    "sparse/0/cameras.bin": lambda data: data[:-8],
    "database.db": lambda data: data[:9000],
    "project.ini": lambda data: data.replace(b"0.25", b"near"),
}


def test_a_damaged_artefact_is_named_and_nothing_is_left(subtests, made, tmp_path):
    for i, (name, damaged) in enumerate(DAMAGE.items()):
        with subtests.test(name=name):
            folder = tmp_path / str(i)
            project = Path(shutil.copytree(made / "project", folder / "project"))
            (project / name).write_bytes(damaged((project / name).read_bytes()))
            before = digest(project)
            with pytest.raises(FormatError) as caught:
                apply_to_project(project, folder / "out", SIMILARITY)
            assert str(project / name) in str(caught.value)
            assert [p.name for p in folder.iterdir()] == ["project"]
            assert digest(project) == before


def test_a_full_disk_is_an_error_that_says_so(project, tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "images/000.png")

    monkeypatch.setattr(copying, "_copy_bytes", full)
    with pytest.raises(OutputError, match=r"the disk is full \(.*nothing was left behind"):
        apply_to_project(project, tmp_path / "out", SIMILARITY)
    assert [p.name for p in tmp_path.iterdir()] == ["project"]


def test_all_of_it_is_on_the_disk_before_it_takes_its_name(project, tmp_path, monkeypatch):
    flushed = set()
    monkeypatch.setattr(os, "fsync", lambda file: flushed.add(os.fstat(file).st_ino))
    apply_to_project(project, tmp_path / "out", plain_factor(2))
    written = [tmp_path / "out", *(tmp_path / "out").rglob("*")]
    assert len(written) > 20 and [path for path in written if path.stat().st_ino not in flushed] == []


LIMITED = """
import resource, sys
from colmap_inertial.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
main(["apply", *sys.argv[2:]])
"""


@pytest.mark.parametrize("limit", [2_000, 28_000, 80_000, 100_000])
def test_files_that_cannot_be_written_whole_are_noticed_whoever_writes_them(project, tmp_path, limit):
    # The smallest limits stop COLMAP's own writers, which say nothing; the next one SQLite, then ours
    args = [sys.executable, "-c", LIMITED, str(limit), str(project), str(tmp_path / "out"), "--factor", "2"]
    done = subprocess.run(args, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"error: {tmp_path / 'out'}")
    assert [p.name for p in tmp_path.iterdir()] == ["project"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_run_leaves_nothing_that_looks_whole(project, tmp_path, number):
    code = (
        "import os, sys, pathlib\n"
        "from colmap_inertial.model.project import apply_to_project\n"
        "from colmap_inertial.model.similarities import plain_factor\n"
        "def stop(done, total):\n"
        f"    if done == total // 2: os.kill(os.getpid(), {int(number)})\n"
        "apply_to_project(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), plain_factor(2), progress=stop)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(project), str(tmp_path / "out")], capture_output=True)
    assert done.returncode == -number
    assert not (tmp_path / "out").exists()
    if number == signal.SIGTERM:
        assert [p.name for p in tmp_path.iterdir()] == ["project"]
    apply_to_project(project, tmp_path / "out", plain_factor(2))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "project"]


def test_links_are_kept_inside_and_followed_outside_only_on_request(project, tmp_path):
    shutil.move(project / "images", tmp_path / "pictures")
    (project / "images").symlink_to(tmp_path / "pictures")
    (project / "dense" / "latest.ply").symlink_to("fused.ply")
    (project / "dense" / "mesh.ply").symlink_to(project / "dense" / "meshed-poisson.ply")
    (project / "gone").symlink_to("nowhere")
    (tmp_path / "pictures" / "mask.txt").symlink_to("../mask.txt")
    (tmp_path / "mask.txt").write_text("outside")
    before = digest(tmp_path / "pictures")
    with pytest.raises(FormatError, match=r"images: is a link out of the project, to .*pictures; --follow-links"):
        apply_to_project(project, tmp_path / "out", SIMILARITY)
    assert not (tmp_path / "out").exists()
    apply_to_project(project, tmp_path / "out", SIMILARITY, follow_links=True)
    out = tmp_path / "out"
    assert digest(tmp_path / "pictures") == before
    assert not (out / "images").is_symlink() and digest(out / "images") == before
    assert os.readlink(out / "dense" / "latest.ply") == "fused.ply"
    assert not (out / "dense" / "mesh.ply").is_symlink()
    assert (out / "dense" / "mesh.ply").read_bytes() == (out / "dense" / "meshed-poisson.ply").read_bytes()
    assert os.readlink(out / "gone") == "nowhere"
    assert (out / "images" / "mask.txt").read_text() == "outside"
    (project / "loop").symlink_to(project)
    with pytest.raises(FormatError, match="leads back"):
        apply_to_project(project, tmp_path / "again", SIMILARITY, follow_links=True)


def test_the_command_line_follows_links_only_on_request(project, tmp_path, capsys):
    (tmp_path / "secret.txt").write_text("secret")
    (project / "notes2.txt").symlink_to(tmp_path / "secret.txt")
    command = ["apply", str(project), str(tmp_path / "out"), "--factor", "2"]
    with pytest.raises(SystemExit) as stopped:
        main(command)
    assert stopped.value.code == 2
    assert "notes2.txt: is a link out of the project" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit) as stopped:
        main([*command, "--follow-links"])
    assert stopped.value.code == 0
    assert (tmp_path / "out" / "notes2.txt").read_text() == "secret"
    assert not (tmp_path / "out" / "notes2.txt").is_symlink()


def test_hard_links_only_on_request_and_never_of_what_changes(project, tmp_path):
    apply_to_project(project, tmp_path / "copy", SIMILARITY)
    apply_to_project(project, tmp_path / "linked", SIMILARITY, link=True)
    for name, shared in (("images/000.png", True), ("dense/fused.ply", False), ("database.db", False)):
        assert not (tmp_path / "copy" / name).samefile(project / name)
        assert (tmp_path / "linked" / name).samefile(project / name) == shared


def test_similarities_and_scales_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "s.json"
    path.write_text(json.dumps(similarity_as_json(SIMILARITY)))
    read = read_similarity(path)
    assert read.scale == SIMILARITY.scale
    np.testing.assert_allclose(read.rotation_xyzw, SIMILARITY.rotation_xyzw, atol=1e-15)
    for text in ("{}", '{"scale": true}', '{"scale": -1}', '{"scale": 1, "translation_m": [1, 2]}', "[1]",
                 '{"scale": 1, "rotation_xyzw": [0, 0, 0, 0]}', '{"scale": 1, "cov": [[1, [2]]]}'):  # fmt: skip
        path.write_text(text)
        with pytest.raises(FormatError, match=r"s\.json"):
            read_similarity(path)
    refused = write_scale(tmp_path / "refused.json", 1.0, "refused")
    with pytest.raises(NotObservableError, match="stood still"):
        read_scales([str(refused)])
    scale = read_scales([str(write_scale(tmp_path / "scale.json", 2.0))], world="z-up")[None]
    np.testing.assert_allclose(matrix_from_quat(scale.similarity.rotation_xyzw) @ [0, 1, 0], [0, 0, -1], atol=1e-12)
    assert "trusted" in scale.similarity.provenance


def run(capsys, *args):
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in args])
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


def test_the_command_line(capsys, made, tmp_path):
    project, out = made / "project", tmp_path / "out"
    scale = write_scale(tmp_path / "scale.json", 2.0)
    assert run(capsys, "apply", "--help")[0] == 0
    code, _, err = run(capsys, "apply", project, out)
    assert (code, "give one of" in err) == (2, True)
    code, _, err = run(capsys, "apply", project, out, "--factor", 2, "--scale", scale)
    assert (code, "give one of" in err) == (2, True)
    code, _, err = run(capsys, "apply", project, out, "--scale", write_scale(tmp_path / "no.json", 1.0, "refused"))
    assert (code, "stood still" in err) == (3, True)
    assert not out.exists()
    code, text, err = run(capsys, "apply", project, out, "--scale", scale)
    assert code == 0, err
    assert "lengths times 2 (trusted)" in text and "database.db (5 pose priors)" in text
    assert run(capsys, "apply", out, tmp_path / "twice", "--scale", scale)[0] == 2
    assert run(capsys, "apply", out, tmp_path / "back", "--undo")[0] == 0
    assert set(digest(tmp_path / "back")) == set(digest(project))


def _ini(folder):
    (folder / "a.ini").write_text("top=1\n[PatchMatchStereo]\ndepth_min=0.5\ndepth_max=12.5\n[Other]\na=b\n")
    return folder / "a.ini"


def _obj(folder):
    lines = ["mtllib a.mtl", "v 1 2 3 0.5 0.5 0.5", "vn 0 0 1", "vt 0.5 0.5", "v -1.5 2e-3 7", "f 1/1/1 2/1/1 1/1/1"]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    return folder / "a.obj"


def _copy(name):
    def make(folder, project):
        return Path(shutil.copy(project / name, folder))

    return make


FUZZED = {
    "depth map": (
        _copy("dense/stereo/depth_maps/000.png.geometric.bin"),
        lambda path: transform_depth_map(path, path.with_name("new"), SIMILARITY),
    ),
    "options": (lambda folder, _: _ini(folder), lambda p: transform_options(p, p.with_name("new"), SIMILARITY)),
    "obj": (lambda folder, _: _obj(folder), lambda p: transform_obj(p, p.with_name("new"), SIMILARITY)),
    "database": (
        _copy("database.db"),
        lambda path: transform_database(path, path.with_name("new.db"), [], {}),
    ),
    "scale": (lambda folder, _: write_scale(folder / "a.json", 2.0), lambda path: read_scales([str(path)])),
}


def test_only_errors_of_our_own_escape_from_damaged_files(subtests, made, tmp_path):
    for kind, (build, read) in FUZZED.items():
        with subtests.test(kind=kind):
            folder = tmp_path / kind
            folder.mkdir()
            path = build(folder, made / "project")
            refusals(path, partial(read, path), key=kind, count=60)


def test_a_model_file_cut_anywhere_is_refused_before_colmap_reads_it(subtests, made, tmp_path):
    # COLMAP's own reader takes a cut cameras.bin for whole, and counts damaged points for hours
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        with subtests.test(name=name):
            model = Path(shutil.copytree(made / "project" / "sparse" / "0", tmp_path / name))
            path = model / f"{name}.bin"
            whole = path.read_bytes()
            check_binary_model(model)
            for n in np.random.default_rng(0).integers(0, len(whole), 60):
                write_anew(path, whole[:n])
                with pytest.raises(FormatError, match=rf"{name}\.bin"):
                    check_binary_model(model)
            path.write_bytes(whole + b"\0")
            with pytest.raises(FormatError, match="follow the last record"):
                check_binary_model(model)
            damaged = bytearray(whole)
            damaged[6] = 1
            path.write_bytes(bytes(damaged))
            with pytest.raises(FormatError, match="claims"):
                read_model(model)


def test_a_model_with_flipped_bits_is_read_or_refused_at_once(subtests, made, tmp_path):
    for suffix in (".bin", ".txt"):
        for name in ("cameras", "images", "points3D", "rigs", "frames"):
            with subtests.test(name=name, suffix=suffix):
                path = made / "project" / "sparse" / "0" / f"{name}{suffix}"
                whole = path.read_bytes()
                model = Path(shutil.copytree(path.parent, tmp_path / path.name))
                rng = np.random.default_rng(zlib.crc32(path.name.encode()))
                refused = 0
                for _ in range(40):
                    damaged = bytearray(whole)
                    for at in rng.integers(0, len(whole), 2):
                        damaged[at] ^= 1 << int(rng.integers(0, 8))
                    write_anew(model / path.name, bytes(damaged))
                    try:
                        with collecting_notes() as notes:
                            read_model(model, suffix).transform(pycolmap.Sim3d())
                        refused += bool(notes)  # what named something that is not there is told
                    except InertialError:
                        refused += 1
                assert refused > 0
