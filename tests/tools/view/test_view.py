"""The viewer: what it shows is where it should be, what one measures is true, and a real browser shows it."""

import contextlib
import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
from functools import partial
from types import SimpleNamespace
from urllib.parse import urlsplit

import cv2
import numpy as np
import pycolmap
import pytest
from markdown_it import MarkdownIt

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, MissingExtraError, OutputError
from colmap_inertial.core.geometry import quat_exp, quat_rotate
from colmap_inertial.core.types import ScaleEstimate, Similarity
from colmap_inertial.model import apply_similarity
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.model.similarities import plain_factor
from colmap_inertial.tools.view import load_scene, measure_distance, nearest_to_ray, round_length
from colmap_inertial.tools.view.clouds import dense_cloud, read_mesh
from colmap_inertial.tools.view.drawing import AMBER, BLUE, RED, Drawing, path_colours
from colmap_inertial.tools.view.measure import ball_at_ray, length_text
from colmap_inertial.tools.view.panel import (
    camera_text,
    contents_text,
    describe_distance,
    scale_text,
    target_text,
    tolerance_html,
)
from colmap_inertial.tools.view.scene import LIMITS, _distance
from colmap_inertial.tools.view.sources import TargetFacts
from tests.helpers import model_project
from tests.helpers.chromium import Page, chromium_or_skip
from tests.helpers.foreign_models import build, save
from tests.helpers.report_runs import HOSTILE

METRES_PER_UNIT = 0.25
#: Gravity in the model's own world: neither along an axis nor of length 1.
GRAVITY = quat_rotate(quat_exp(np.array([0.4, -0.7, 0.2])), np.array([0.0, 0.0, -9.81]))
ESTIMATE = ScaleEstimate(
    metres_per_unit=METRES_PER_UNIT,
    sigma_log=0.01,
    ci95=(0.98 * METRES_PER_UNIT, 1.03 * METRES_PER_UNIT),
    verdict="trusted",
    method="joint",
    gravity_in_world_m_s2=GRAVITY,
    cov=np.diag([1e-4, 1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6]),
)
REFUSED = ScaleEstimate(
    metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="joint", reasons=("a *still* camera",)
)
#: Corners of a target that is 1 % too large in the model, metres.
CORNERS = {"r0c0": [0.0, 0.0, 0.0], "r0c1": [0.101, 0.0, 0.0], "r1c0": [0.0, 0.101, 0.0], "r1c1": [0.101, 0.101, 0.0]}


def synthesized(seed, frames=12, points=400):
    """A model without noise: its points and poses are the truth."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig, options.num_points3D = frames, points
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(seed)
    for point in model.points3D.values():
        point.color = rng.integers(60, 255, 3, dtype=np.uint8)
    return model


OLD = ("sparse", "sparse_metric")


def write_result(root, estimates, world="z-up", validation=None, places=("colmap/sparse", "sparse")):
    """An output folder as ``reconstruct`` leaves it, with a model for each estimate; returns these models.

    ``places``: where COLMAP's models are, and those in metres; ``OLD`` before the folder itself was the project.
    """
    (root / ".stages").mkdir(parents=True)
    models, records = [], []
    for index, estimate in enumerate(estimates):
        model = synthesized(index + 1, frames=8 + 4 * index)
        models.append(model)
        sparse = root / places[0] / str(index)
        sparse.mkdir(parents=True)
        model.write_binary(str(sparse))
        metric = None
        if estimate.verdict != "refused":
            metric = f"{places[1]}/{index}"
            (root / places[1]).mkdir(exist_ok=True)
            apply_similarity(sparse, root / metric, Similarity.from_scale(estimate, world=world, provenance="a test"))
        records.append(
            {"index": index, "registered_images": model.num_reg_images(), "sparse": f"{places[0]}/{index}",
             "sparse_metric": metric, "trajectory": None, "validation": validation, "dense": None, **estimate.as_json()}
        )  # fmt: skip
    (root / "result.json").write_text(json.dumps({"models": records}))
    return models


def validation_record():
    pairs = [("r0c0", "r0c1", 0.1), ("r0c0", "r1c0", 0.1), ("r1c0", "r1c1", 0.1), ("r0c0", "r1c1", 0.1 * 2**0.5)]
    return {
        "target": "checkerboard:2x2:0.1",
        "scale_error_pct": 1.0,
        "ci95_pct": [0.8, 1.2],
        "tolerance_pct": 2.0,
        "within_tolerance": True,
        "distances": [
            {"pair": [a, b], "known_m": known, "measured": 1.01 * known, "residual_m": 0.01 * known, "set": "check"}
            for a, b, known in pairs
        ],
        "corners": [{"name": name, "in_model": place} for name, place in CORNERS.items()],
    }


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A finished result with images; and its model in COLMAP's units."""
    root = tmp_path_factory.mktemp("view") / "garden"
    (model,) = write_result(root, [ESTIMATE], validation=validation_record())
    rng = np.random.default_rng(1)
    for image in model.images.values():
        (root / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(root / "images" / image.name), rng.integers(0, 255, (96, 128, 3), dtype=np.uint8))
    return root, model


def places_in_m(model):
    """(N, 3) points of a model, (F, 3) its cameras in the order of their names: what they should be in metres."""
    turn = Similarity.from_scale(ESTIMATE).rotation_xyzw
    images = sorted(model.images.values(), key=lambda image: image.name)
    points = np.array([model.points3D[i].xyz for i in sorted(model.point3D_ids())])
    cameras = np.array([image.projection_center() for image in images])
    return tuple(METRES_PER_UNIT * quat_rotate(turn, xyz) for xyz in (points, cameras))


def test_points_and_cameras_are_where_the_metric_model_has_them(out):
    root, model = out
    scene = load_scene(root)
    points, cameras = places_in_m(model)
    np.testing.assert_allclose(scene.cloud.xyz, points, atol=1e-5)
    np.testing.assert_array_equal(scene.cloud.rgb[3], model.points3D[sorted(model.point3D_ids())[3]].color)
    np.testing.assert_allclose(scene.cameras.cam_in_world, cameras, atol=1e-9)
    image = next(image for image in model.images.values() if image.name == scene.cameras.names[2])
    ahead = quat_rotate(Similarity.from_scale(ESTIMATE).rotation_xyzw, image.cam_from_world().rotation.matrix()[2])
    np.testing.assert_allclose(quat_rotate(scene.cameras.world_from_cam_xyzw[2], [0.0, 0, 1]), ahead, atol=1e-9)
    camera = image.camera
    assert scene.cameras.vertical_fov_rad[2] == pytest.approx(
        2 * np.arctan(camera.height / 2 / camera.mean_focal_length())
    )
    assert scene.image_of(2) == root / "images" / image.name
    assert scene.path.shape == (len(cameras) - 1, 2, 3)


def test_up_is_against_gravity_in_either_world(subtests, tmp_path_factory):
    for world, up in (("z-up", [0, 0, 1]), ("y-down", [0, -1, 0])):
        with subtests.test(world=world, up=up):
            tmp_path = tmp_path_factory.mktemp("given")
            write_result(tmp_path / "out", [ESTIMATE], world=world)
            scene = load_scene(tmp_path / "out")
            assert scene.gravity_known
            np.testing.assert_allclose(scene.up_in_world, up, atol=1e-12)
            np.testing.assert_allclose(
                [scene.ground.along @ scene.up_in_world, scene.ground.across @ scene.up_in_world], 0, atol=1e-12
            )


def test_the_scale_bar_is_round_level_as_long_as_it_says_and_in_view(out):
    scene = load_scene(out[0])
    ground = scene.ground
    bar = ground.bar[1] - ground.bar[0]
    assert np.linalg.norm(bar) == pytest.approx(ground.bar_m)
    assert bar @ scene.up_in_world == pytest.approx(0, abs=1e-9)
    assert ground.bar_m == round_length(ground.bar_m)
    assert 0.2 * scene.reach < ground.bar_m <= 0.6 * scene.reach
    assert ground.side_m >= 2 * scene.reach
    view = scene.centre - scene.start
    for end in [*ground.bar, *scene.cameras.cam_in_world[:2]]:
        seen = end - scene.start
        assert np.arccos(seen @ view / np.linalg.norm(seen) / np.linalg.norm(view)) < 0.75 * LIMITS.start_fov_rad


def test_round_lengths_are_1_2_5(subtests):
    for about, expected in ((1, 1), (1.99, 1), (2, 2), (4.9, 2), (0.0501, 0.05), (999, 500), (1000, 1000), (0.2, 0.2)):
        with subtests.test(about=about, expected=expected):
            assert round_length(about) == pytest.approx(expected, rel=1e-12)


def test_what_is_no_length_is_not_rounded(subtests):
    for about in (0.0, -1.0, np.inf, np.nan):
        with subtests.test(about=about), pytest.raises(ValueError, match="positive"):
            round_length(about)


def test_lengths_have_fitting_units():
    assert [length_text(x) for x in (2000, 1, 0.5, 0.02, 0.005)] == ["2 km", "1 m", "50 cm", "2 cm", "5 mm"]


def test_two_clicks_measure_the_true_distance_with_the_scale_s_interval(out):
    root, model = out
    scene = load_scene(root)
    truth, _ = places_in_m(model)
    candidates = scene.pickable()
    rng = np.random.default_rng(0)
    for a, b in rng.choice(len(truth), (30, 2), replace=False):
        found = []
        for target in (truth[a], truth[b]):
            # from close by, so that no other point is in front
            away = rng.standard_normal(3)
            origin = target + 0.02 * scene.reach * away / np.linalg.norm(away)
            index = nearest_to_ray(candidates, origin, target - origin)
            found.append(candidates[index])
        result = measure_distance(*found, scene.scale.unit, scene.scale.relative_ci95)
        length = np.linalg.norm(truth[a] - truth[b])
        assert result.length == pytest.approx(length, abs=1e-5)
        assert result.ci95 == pytest.approx((0.98 * length, 1.03 * length), abs=1e-5)


def test_a_measured_length_is_written_to_the_digits_of_its_uncertainty():
    result = measure_distance(np.zeros(3), np.array([1.23456, 0, 0]), "m", (0.98, 1.02))
    assert result.text == "1.235 ± 0.025 m"
    assert "1.21 m to 1.259 m" in describe_distance(result)
    assert measure_distance(np.zeros(3), np.array([0, 0.28, 0]), "m", (0.99, 1.01)).text == "280.0 ± 2.8 mm"
    assert measure_distance(np.zeros(3), np.array([0, 0, 2.0]), "m", None).text == "2 m"
    assert measure_distance(np.zeros(3), np.array([0, 0, 2.0]), "model", (0.9, 1.1)).text == "2 units (no scale)"


def test_a_click_takes_the_point_in_front_and_none_where_there_is_none():
    points = np.array([[0.001, 0, 5.0], [0.001, 0, 2.0], [0.5, 0, 2.0], [0, 0, -1.0]])
    ahead = np.array([0.0, 0, 1])
    assert nearest_to_ray(points, np.zeros(3), ahead) == 1
    assert nearest_to_ray(points, np.array([0, 0, 3.0]), ahead) == 0
    assert nearest_to_ray(points, np.zeros(3), np.array([0.5, 0, 2])) == 2
    assert nearest_to_ray(points, np.zeros(3), np.array([0, 1.0, 0.1])) is None
    assert nearest_to_ray(np.zeros((0, 3)), np.zeros(3), ahead) is None
    assert ball_at_ray(points, 0.1, np.zeros(3), ahead) == 1
    assert ball_at_ray(points, 0.1, np.zeros(3), np.array([0.0, 1, 0])) is None
    # beside the ray by 0.3, whatever the length of its direction
    for radius, found in ((0.29, None), (0.31, 0)):
        assert ball_at_ray(np.array([[0.3, 0, 2.0]]), radius, np.zeros(3), 7 * ahead) == found


def test_a_refused_scale_shows_the_model_in_its_own_units_and_says_so(tmp_path):
    (model,) = write_result(tmp_path / "out", [REFUSED])
    scene = load_scene(tmp_path / "out")
    assert scene.scale.unit == "model"
    assert scene.ground is None
    points = np.array([model.points3D[i].xyz for i in sorted(model.point3D_ids())])
    np.testing.assert_allclose(scene.cloud.xyz, points, rtol=1e-5, atol=1e-5)
    text = scale_text(scene)
    assert "no scale" in text
    assert r"a \*still\* camera" in text
    assert not scene.gravity_known
    assert "Gravity is not known" in text
    write_result(tmp_path / "knows", [dataclasses.replace(REFUSED, gravity_in_world_m_s2=GRAVITY)])
    scene = load_scene(tmp_path / "knows")
    assert scene.gravity_known
    np.testing.assert_allclose(scene.up_in_world, -GRAVITY / np.linalg.norm(GRAVITY), atol=1e-12)


def test_the_target_has_its_corners_lines_and_known_distances(out):
    scene = load_scene(out[0])
    assert set(scene.target.corners) == set(CORNERS)
    assert len(scene.target_lines) == 3  # the sides; not the diagonal
    np.testing.assert_allclose(np.linalg.norm(scene.target_lines[:, 1] - scene.target_lines[:, 0], axis=1), 0.101)
    assert max(d.known_m for d in scene.labelled) == pytest.approx(0.1 * 2**0.5)
    assert "| 100.0 | 101.00 | 3 |" in target_text(scene.target)
    old = dataclasses.replace(scene.target, corners={})
    assert "not in this result" in target_text(old)


def test_the_path_says_where_the_refinement_stretched_it(tmp_path):
    write_result(tmp_path, [ESTIMATE])
    rows = [f"{100 + t:.6f} {t} 0 0 0 0 0 1" for t in range(21)]
    (tmp_path / "trajectory.tum").write_text("\n".join(rows) + "\n")
    path = tmp_path / "result.json"
    record = json.loads(path.read_text())
    drift = [{"begin_s": b, "end_s": b + 10, "percent": p, "sigma_percent": 0.1} for b, p in ((50, -0.4), (60, 0.2))]
    done = {"stage": "refine", "reason": "refined", "action": "refined", "values": {"drift": drift}}
    record["models"][0] |= {"trajectory": "trajectory.tum", "treatments": [done]}
    path.write_text(json.dumps(record))
    scene = load_scene(tmp_path)
    assert scene.path_percent[:, 0] == pytest.approx(np.interp(np.arange(20), [5, 15], [-0.4, 0.2]))
    colours = path_colours(scene.path_percent)
    assert colours.shape == scene.path.shape
    assert tuple(colours[0, 0]) == BLUE and colours[-1, 1, 0] > colours[10, 0, 0] - 10
    assert "by up to 0.4 %" in contents_text(scene)
    # of the last refinement that did something, and of no other treatment
    idle, other = done | {"action": ""}, done | {"stage": "join"}
    for treatments, most in (([done, idle, other], 0.4), ([idle, other], None)):
        record["models"][0]["treatments"] = treatments
        path.write_text(json.dumps(record))
        percent = load_scene(tmp_path).path_percent
        assert percent is None if most is None else np.abs(percent).max() == pytest.approx(most)
    record["models"][0]["treatments"] = []
    path.write_text(json.dumps(record))
    assert load_scene(tmp_path).path_percent is None and path_colours(None) == AMBER
    # by the largest, however small
    both = path_colours(np.array([[2e-9, -1e-9]]))[0]
    assert tuple(both[0]) == RED and both[1] == pytest.approx((np.array(AMBER) + BLUE) / 2, abs=1)


def test_the_largest_model_is_shown_unless_another_is_asked_for(tmp_path):
    write_result(tmp_path / "out", [ESTIMATE, REFUSED])
    assert load_scene(tmp_path / "out").source.index == 1
    scene = load_scene(tmp_path / "out", model=0)
    assert (scene.source.index, scene.scale.unit, len(scene.cameras)) == (0, "m", 8)
    assert "Model 0 of 0, 1 (`--model`)" in contents_text(scene)
    write_result(tmp_path / "alone", [ESTIMATE])
    assert "--model" not in contents_text(load_scene(tmp_path / "alone"))
    assert len(load_scene(tmp_path / "out", max_points=1).cloud.xyz) == 1
    with pytest.raises(ValueError, match="max_points"):
        load_scene(tmp_path / "out", max_points=0)
    with pytest.raises(FormatError, match="--model takes one of 0, 1"):
        load_scene(tmp_path / "out", model=7)


def test_dense_points_and_mesh_go_before_sparse_points_and_are_thinned(tmp_path):
    project = tmp_path / "project"
    project.mkdir()
    model_project.write_project(project)
    fused = pycolmap.Reconstruction()
    fused.import_PLY(str(project / "dense" / "fused.ply"))
    scene = load_scene(project)
    assert scene.cloud.dense
    assert scene.cloud.total == len(scene.cloud.xyz) == fused.num_points3D()
    # the ball of model_project, in COLMAP's units
    assert np.median(np.linalg.norm(scene.cloud.xyz, axis=1)) == pytest.approx(1, abs=0.02)
    assert scene.scale.unit == "model"
    few = load_scene(project, max_points=50).cloud
    assert (len(few.xyz), few.total) == (50, scene.cloud.total)
    assert scene.mesh is not None
    corners = scene.mesh.vertices[scene.mesh.faces]
    assert np.median(np.linalg.norm(corners.mean(axis=1), axis=1)) == pytest.approx(1, abs=0.05)
    assert scene.image_of(0) is not None


VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0], [1, 1, 1]], "<f4")
TRIANGLES = [[0, 1, 2], [1, 2, 4], [2, 3, 4]]


def write_ply(path, vertices, faces=(), *, order="little", axes="xyz", lists="list uchar int vertex_indices", cut=0):
    """A PLY file of points, and of faces where there are some."""
    head = [f"format {'ascii' if order is None else f'binary_{order}_endian'} 1.0"]
    head += [f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in axes)]
    if faces is not None and len(faces):
        head += [f"element face {len(faces)}", *(f"property {one}" for one in lists.split("; "))]
    marks = ">" if order == "big" else "<"
    data = np.asarray(vertices, marks + "f4").tobytes()
    for face in faces or ():
        data += bytes([len(face)]) + np.array(face, marks + "i4").tobytes()
    path.write_bytes("\n".join(["ply", *head, "end_header", ""]).encode() + data[: len(data) - cut])
    return path


def test_a_mesh_is_read_without_what_is_not_finite(subtests, tmp_path_factory):
    for order in ("little", "big"):
        with subtests.test(order=order):
            tmp_path = tmp_path_factory.mktemp("given")
            path = write_ply(tmp_path / "mesh.ply", VERTICES, TRIANGLES, order=order)
            mesh = read_mesh(path, 3)
            # the fourth vertex goes, and with it the face that needs it
            assert mesh.vertices.tolist() == VERTICES[[0, 1, 2, 4]].tolist() and mesh.faces.tolist() == [
                [0, 1, 2],
                [1, 2, 3],
            ]
            assert mesh.rgb is None and read_mesh(path, 2) is None
            whole = dense_cloud(path, 5)
            assert whole.xyz.tolist() == mesh.vertices.tolist() and whole.total == 5 and whole.rgb.shape == (4, 3)
            assert len(dense_cloud(path, 2).xyz) <= 2


def test_what_is_no_mesh_of_triangles_is_refused(subtests, tmp_path_factory):
    for changed, said in (
        ({"faces": ()}, "a mesh without faces"),
        ({"faces": [[0, 1, 2, 4]]}, "faces other than triangles"),
        ({"faces": [[0, 1, 5]]}, "faces other than triangles"),
        ({"cut": 1}, "truncated"),
        ({"lists": "list uchar int vertex_indices; list uchar int more"}, "besides their lists of vertices"),
        ({"order": None}, "only binary PLY"),
        ({"axes": "xyw"}, "holds no points"),
        ({"vertices": VERTICES[:0]}, "holds no points"),
    ):
        with subtests.test(changed=changed, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            given = {"vertices": VERTICES, "faces": TRIANGLES} | changed
            path = write_ply(tmp_path / "mesh.ply", **given)
            with pytest.raises(FormatError, match=said):
                read_mesh(path, 10)


def test_points_that_are_cut_off_are_refused(tmp_path):
    with pytest.raises(FormatError, match="truncated"):
        dense_cloud(write_ply(tmp_path / "points.ply", VERTICES, cut=1), 10)
    with pytest.raises(FormatError, match="cannot be read"):
        dense_cloud(tmp_path, 10)


def test_an_applied_project_is_metric_with_its_interval_or_without_one(tmp_path):
    project = tmp_path / "project"
    project.mkdir()
    model_project.write_project(project)
    plain = load_scene(project)
    apply_to_project(project, tmp_path / "metric", Similarity.from_scale(ESTIMATE, provenance="a test"))
    scene = load_scene(tmp_path / "metric")
    assert scene.scale.unit == "m"
    np.testing.assert_allclose(scene.scale.relative_ci95, np.exp([-0.0196, 0.0196]), atol=1e-5)
    assert scene.gravity_known
    assert sorted(np.abs(scene.up_in_world)) == [0, 0, 1]
    assert np.ptp(scene.cameras.cam_in_world, axis=0).max() < np.ptp(plain.cameras.cam_in_world)
    apply_to_project(project, tmp_path / "factor", plain_factor(3.0))
    scene = load_scene(tmp_path / "factor")
    assert (scene.scale.unit, scene.scale.relative_ci95, scene.gravity_known) == ("m", None, False)
    assert "uncertainty is not known" in scale_text(scene)


def shown(text):
    """What Markdown makes of a text: kinds of its pieces, and the words."""
    tokens = [token for block in MarkdownIt().parse(text) for token in (block, *(block.children or []))]
    return {token.type for token in tokens}, "".join(token.content for token in tokens if not token.children)


def test_names_from_files_are_text_and_nothing_else(tmp_path):
    name = f"{HOSTILE} {{alert(1)}} &lt; `a` **b** [c](javascript:alert(1)) |\n\n# d\n- e\nwww.example.org 1. ~~f~~"
    once = " ".join(name.split())
    write_result(tmp_path / "out", [dataclasses.replace(ESTIMATE, reasons=(name,))])
    scene = load_scene(tmp_path / "out")
    scene = dataclasses.replace(
        scene, cameras=dataclasses.replace(scene.cameras, names=(name,) * len(scene.cameras.names))
    )
    target = TargetFacts(
        spec=name,
        error_pct=1.0,
        ci95_pct=(0.5, 1.5),
        tolerance_pct=2.0,
        within_tolerance=True,
        distances=(),
        corners={"a": np.zeros(3)},
    )
    for text in (scale_text(scene), camera_text(scene, 0, name), target_text(target)):
        kinds, words = shown(text)
        assert once in words
        assert not [kind for kind in kinds if kind.startswith(("html", "link", "image", "code", "heading", "em_"))]
        # MDX also runs what stands in braces
        assert not re.search(r"(?<!\\)[{}<>&]", text)


def test_what_is_not_finite_is_left_out(tmp_path):
    kind = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    table = np.array([(0, 0, 0), (1, 0, 0), (np.nan, 0, 0), (0, 1, 0), (1e300, 0, 0)], dtype=kind)
    corners = [(0, 1, 3), (1, 2, 3), (0, 1, 4)]
    faces = np.array([(3, corner) for corner in corners], dtype=[("count", "u1"), ("index", "<i4", (3,))])
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    path = tmp_path / "mesh.ply"
    path.write_bytes(header.encode() + table.tobytes() + faces.tobytes())
    cloud, mesh = dense_cloud(path, 100), read_mesh(path, 100)
    np.testing.assert_array_equal(cloud.xyz, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert cloud.total == 5
    np.testing.assert_array_equal(mesh.vertices, cloud.xyz)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])

    model = synthesized(1)
    ids = sorted(model.point3D_ids())
    model.points3D[ids[0]].xyz = np.array([np.nan, 0, 0])
    model.points3D[ids[1]].xyz = np.array([0, 1e300, 0])
    (tmp_path / "model").mkdir()
    model.write_binary(str(tmp_path / "model"))
    with pytest.raises(FormatError, match=r"points3D\.bin: damaged: point \d+ lies at"):
        load_scene(tmp_path / "model")


def test_cameras_that_see_all_around_are_drawn_with_a_nominal_field_of_view(tmp_path):
    model = synthesized(1)
    for camera in list(model.cameras.values()):
        model.cameras[camera.camera_id].model = pycolmap.CameraModelId.EQUIRECTANGULAR
        model.cameras[camera.camera_id].params = [camera.width, camera.height]
    (tmp_path / "model").mkdir()
    model.write_binary(str(tmp_path / "model"))
    scene = load_scene(tmp_path / "model")
    np.testing.assert_allclose(np.tan(0.5 * scene.cameras.vertical_fov_rad), 0.5)


def test_folders_of_both_layouts_are_shown_in_metres_with_the_images_that_fit(subtests, tmp_path_factory):
    for places, images in (
        (("colmap/sparse", "sparse"), ("images",)),
        (OLD, ("images_rectified", "images")),
        (OLD, ("images",)),
        (OLD, ("project_metric/images",)),
    ):
        with subtests.test(places=places, images=images):
            tmp_path = tmp_path_factory.mktemp("given")
            out = tmp_path / "out"
            (model,) = write_result(out, [ESTIMATE], places=places)
            for image in model.images.values():
                for folder in images:
                    (out / folder / image.name).parent.mkdir(parents=True, exist_ok=True)
                    (out / folder / image.name).touch()
            scene = load_scene(out)
            assert scene.source.scale.unit == "m"
            np.testing.assert_allclose(scene.cloud.xyz, places_in_m(model)[0], atol=1e-5)
            assert scene.image_of(0) == out / images[0] / scene.cameras.names[0]
            # and what is left of it when somebody keeps the project alone
            shutil.rmtree(out / ".stages")
            (out / "result.json").unlink()
            scene = load_scene(out)
            assert scene.source.scale.unit == "m" and scene.source.folder == out / places[1] / "0"


def test_images_of_an_existing_project_are_found(tmp_path):
    out, images = tmp_path / "out", tmp_path / "pictures"
    write_result(out, [ESTIMATE])
    name = load_scene(out).cameras.names[0]
    assert load_scene(out).image_of(0) is None
    copied = out / "images" / name
    copied.parent.mkdir(parents=True)
    copied.touch()
    assert load_scene(out).image_of(0) == copied
    images.mkdir()
    (images / name).touch()
    record = json.loads((out / "result.json").read_text())
    (out / "result.json").write_text(json.dumps({**record, "project": {"images": str(images)}}))
    assert load_scene(out).image_of(0) == copied  # a stranger's result may name any folder
    assert load_scene(out, images=images).image_of(0) == images / name
    with pytest.raises(FormatError, match="no such folder of images"):
        load_scene(out, images=tmp_path / "none")


def test_what_cannot_be_shown_is_said(tmp_path, capsys):
    with pytest.raises(FormatError, match="no such folder"):
        load_scene(tmp_path / "nothing")
    with pytest.raises(FormatError, match="nor a COLMAP model"):
        load_scene(tmp_path)
    unfinished = tmp_path / "unfinished"
    write_result(unfinished, [ESTIMATE])
    (unfinished / "result.json").unlink()
    with pytest.raises(FormatError, match="not finished"):
        load_scene(unfinished)
    damaged = tmp_path / "damaged"
    write_result(damaged, [ESTIMATE])
    (damaged / "result.json").write_text('{"models": [{"index": 0}]}')
    with pytest.raises(FormatError, match="damaged"):
        load_scene(damaged)
    with pytest.raises(SystemExit) as stopped:
        main(["view", str(tmp_path / "nothing")])
    assert stopped.value.code == 2
    assert "no such folder" in capsys.readouterr().err


def test_a_result_without_a_model_shows_nothing(tmp_path):
    write_result(tmp_path, [ESTIMATE])
    (tmp_path / "result.json").write_text('{"models": []}')
    with pytest.raises(FormatError, match="holds no model to show"):
        load_scene(tmp_path)


def test_options_out_of_range_exit_2(subtests, capsys):
    for flags in (["--port", "70000"], ["--max-points", "0"]):
        with subtests.test(flags=flags):
            capsys.readouterr()
            with pytest.raises(SystemExit) as stopped:
                main(["view", "out", *flags])
            assert stopped.value.code == 2


def test_a_target_is_outside_its_tolerance_only_where_its_error_is(subtests):
    for error_pct, proved, words in (
        (1.0, True, "Within its"),
        (-3.0, False, "Outside its"),
        (1.0, False, "Not proved to be within its"),
    ):
        with subtests.test(error_pct=error_pct, proved=proved, words=words):
            facts = {"ci95_pct": (-5, 5), "tolerance_pct": 2.0, "distances": (), "corners": {}}
            assert words in tolerance_html(TargetFacts(spec="x", error_pct=error_pct, within_tolerance=proved, **facts))


def test_without_viser_the_extra_is_named(monkeypatch, out, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit) as stopped:
        main(["view", str(out[0])])
    assert stopped.value.code == MissingExtraError.exit_code == 2
    assert "extra `view`: pip install 'viser>=" in capsys.readouterr().err


def test_an_address_of_another_machine_is_an_error_and_a_taken_port_makes_way(out):
    from colmap_inertial.tools.view.server import Viewer

    scene = load_scene(out[0])
    with pytest.raises(OutputError, match=r"cannot listen at 192\.0\.2\.1"):
        Viewer(scene, host="192.0.2.1")
    first = Viewer(scene, port=0)
    try:
        port = urlsplit(first.url).port
        second = Viewer(scene, port=port)
        try:
            assert second.url != first.url
        finally:
            second.close()
    finally:
        first.close()


class Drawn(dict):
    """What would be drawn, by name, in place of viser's scene."""

    def __getattr__(self, kind):
        def add(name, *given, **named):
            self[name] = SimpleNamespace(kind=kind, given=given, visible=True, **named)
            return self[name]

        return add


def test_what_is_drawn_lies_where_the_scene_has_it(out):
    scene, drawn = load_scene(out[0]), Drawn()
    drawing = Drawing(scene, drawn)
    # the base of each camera is its image, so far in front of it as a camera is drawn
    edges = drawn["/cameras/edges"].given[0].reshape(len(scene.cameras), 8, 2, 3)
    for k, lines in enumerate(edges):
        turn = scene.cameras.world_from_cam_xyzw[k] * [-1, -1, -1, 1]
        in_cam = quat_rotate(turn, lines - scene.cameras.cam_in_world[k])
        assert in_cam[:4, 0] == pytest.approx(np.zeros((4, 3)), abs=1e-9)
        assert in_cam[:4, 1, 2] == pytest.approx(np.full(4, 0.05 * scene.reach))
        half = np.tan(scene.cameras.vertical_fov_rad[k] / 2) * np.array([scene.cameras.aspect[k], 1])
        at = in_cam[:4, 1, :2] / in_cam[:4, 1, 2:] / half
        assert at == pytest.approx(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
        assert in_cam[4:] == pytest.approx(np.stack([in_cam[:4, 1], np.roll(in_cam[:4, 1], -1, axis=0)], axis=1))
    bodies = drawn["/cameras/bodies"]
    corner = bodies.batched_scales[0] * bodies.given[0][2]
    assert quat_rotate(np.roll(bodies.batched_wxyzs[0], -1), corner) + bodies.batched_positions[0] == pytest.approx(
        edges[0, 1, 1], abs=1e-6
    )
    # squares of the ground's step, level, around what is seen
    ground, up = scene.ground, scene.up_in_world
    grid = drawn["/ground/grid"].given[0]
    assert len(grid) == 2 * (ground.cells + 1)
    assert np.linalg.norm(grid[:, 1] - grid[:, 0], axis=1) == pytest.approx(np.full(len(grid), ground.side_m))
    assert grid @ up == pytest.approx(np.full(grid.shape[:2], ground.origin @ up))
    assert grid.mean(axis=(0, 1)) == pytest.approx(ground.origin)
    assert np.linalg.norm(grid[1] - grid[0], axis=1) == pytest.approx([ground.side_m / ground.cells] * 2)
    bar, *ends = drawn["/ground/bar"].given[0]
    assert np.array_equal(bar, ground.bar)
    assert np.mean(ends, axis=1) == pytest.approx(bar) and (np.array(ends)[:, 1] - bar) @ (bar[1] - bar[0]) == (
        pytest.approx([0, 0], abs=1e-9)
    )
    assert drawn["/ground/bar_length"].given[0] == length_text(ground.bar_m)
    # gravity points down, to a corner of the ground
    (down,), (upwards,) = drawn["/gravity/down"].given[0], drawn["/gravity/up"].given[0]
    assert np.diff(down, axis=0)[0] == pytest.approx(-0.35 * scene.reach * up, abs=1e-9)
    assert np.diff(upwards, axis=0)[0] == pytest.approx(0.35 * scene.reach * up, abs=1e-9)
    assert np.linalg.norm(down[1] - ground.origin) == pytest.approx(ground.side_m / np.sqrt(2))
    assert np.array_equal(drawn["/gravity/name"].position, down[1])
    # points are smaller where there are many
    assert drawing.point_size() == pytest.approx(scene.reach / 150)
    many = dataclasses.replace(scene.cloud, xyz=np.zeros((90_000, 3)), rgb=np.zeros((90_000, 3), np.uint8))
    crowded = Drawing(dataclasses.replace(scene, cloud=many), Drawn())
    assert crowded.point_size() == pytest.approx(scene.reach * 0.75 / 300)


def test_clicks_choose_the_camera_that_is_drawn_there_and_measure(out):
    from colmap_inertial.tools.view.server import Viewer

    scene = load_scene(out[0])
    viewer = Viewer(scene, port=0)
    client = SimpleNamespace(camera=SimpleNamespace(aspect=1.5), atomic=contextlib.nullcontext)

    def click(place, away):
        away = 0.02 * scene.reach * away / np.linalg.norm(away)
        viewer._click(SimpleNamespace(ray_origin=tuple(place + away), ray_direction=tuple(-away), client=client))

    try:
        for k in range(len(scene.cameras)):
            axes = quat_rotate(scene.cameras.world_from_cam_xyzw[k], np.eye(3))
            # beside the pyramid's middle, from its side
            drawn = scene.cameras.cam_in_world[k] + 0.05 * scene.reach * axes[2]
            click(drawn, axes[0])
            assert np.array_equal(client.camera.position, scene.cameras.cam_in_world[k])
            ahead = client.camera.look_at - client.camera.position
            assert ahead / np.linalg.norm(ahead) == pytest.approx(axes[2])
            assert client.camera.up_direction == pytest.approx(-axes[1])
            assert scene.cameras.names[k] in viewer._about.content.replace("\\", "")
        # far beside all cameras there is none
        before, level = client.camera.position, scene.ground.along
        click(scene.centre + 3 * scene.reach * scene.up_in_world + 5 * scene.reach * level, level)
        assert client.camera.position is before
        viewer._measuring.value = True
        points, away = scene.pickable(), np.array([0.3, -0.5, 0.8])
        click(points[0], away)
        assert viewer._measured.content == "Click the second point."
        click(points[0] + 50 * scene.reach, away)
        assert "No point there" in viewer._measured.content
        click(points[5], away)
        told = measure_distance(points[0], points[5], "m", scene.scale.relative_ci95)
        assert viewer._measured.content == describe_distance(told)
        assert len(viewer._temporary["measure"]) == 3
        click(points[7], away)
        assert viewer._measured.content == "Click the second point." and len(viewer._temporary["measure"]) == 1
    finally:
        viewer.close()


def test_the_first_view_holds_all_that_must_be_seen_and_is_no_farther(subtests):
    for seed in range(4):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            up, side = np.array([0.0, 0.0, 1.0]), np.array([np.cos(0.4), 0.0, np.sin(0.4)])
            places = rng.uniform(-1, 1, (30, 3)) * [3, 3, 1]
            away = _distance(side, 2.0, up, places)
            scene = SimpleNamespace(centre=np.zeros(3), start=away * side, up_in_world=up)
            height = 1000.0
            x, y = np.array([on_screen(scene, place, LIMITS.aspect * height, height) for place in places]).T
            # of the half height, what is filled by angle
            filled = np.tan(0.5 * LIMITS.start_fov_rad * LIMITS.filled) / np.tan(0.5 * LIMITS.start_fov_rad)
            across = np.maximum(np.abs(2 * x / (LIMITS.aspect * height) - 1), np.abs(2 * y / height - 1))
            assert across.max() == pytest.approx(filled, rel=1e-6)
            assert _distance(side, 2.0, up, 1e-3 * places) == 3 and _distance(side, 2.0, up, 1e3 * places) == 12


def on_screen(scene, place, width, height):
    """The pixel at which the first view shows a place."""
    ahead = scene.centre - scene.start
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, scene.up_in_world)
    right /= np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(ahead, right), ahead]) @ (place - scene.start)
    focal = 0.5 * height / np.tan(0.5 * LIMITS.start_fov_rad)
    return 0.5 * width + focal * x / z, 0.5 * height + focal * y / z


@pytest.mark.slow
def test_a_real_browser_shows_it_measures_and_looks_through_a_camera(out, tmp_path):
    chromium_or_skip()
    scene = load_scene(out[0])
    command = [sys.executable, "-m", "colmap_inertial", "view", str(out[0]), "--port", "0"]
    # whoever runs the tests in the background lets their children ignore Ctrl-C
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    try:
        url = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+", server.stdout.readline())[0]
        page = Page(tmp_path / "profile", 900, 640)
        try:
            page.open(url)
            size = page.wait("(c => c && [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
            page.wait("document.body.innerText.includes('Scale trusted')")
            page.wait("document.body.innerText.includes('checkerboard:2x2:0.1')")
            # docking the panel makes the canvas narrower
            page.wait("document.querySelector('canvas').clientWidth < innerWidth - 100")
            size = page.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
            page.settle()
            page.click(*on_screen(scene, foremost_camera(scene), *size))
            page.wait(f"document.body.innerText.includes({json.dumps(scene.cameras.names[foremost(scene)])})")
            page.click(*page.middle_of("button", "Overview"))
            page.settle()
            page.click(*page.middle_of("input[type=checkbox]"))
            page.wait("document.body.innerText.includes('Click the first point')")
            # two points that nothing is in front of
            a, b = lonely_points(scene, *size)
            for place, answer in ((a, "Click the second point"), (b, "Errors of the two picked points")):
                page.click(*on_screen(scene, place, *size))
                page.wait(f"document.body.innerText.includes({json.dumps(answer)})")
            text = measure_distance(a, b, "m", scene.scale.relative_ci95).text
            assert text in page.evaluate("document.body.innerText")
            picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            drawn = picture[: size[1], : size[0]].reshape(-1, 3)
            assert len(np.unique(drawn, axis=0)) > 200  # coloured points, lines, labels
            assert page.errors == []
            here = (url, url.replace("http", "ws"), "data:", "blob:", "about:")
            assert [request for request in page.requests if not request.startswith(here)] == []
        finally:
            page.close()
        server.send_signal(signal.SIGINT)
        rest, errors = server.communicate(timeout=20)
        assert (server.returncode, rest, errors) == (0, "", "")
    finally:
        server.kill()
        server.communicate()


def foremost(scene):
    """The camera that is nearest to the first view."""
    return int(np.argmin(np.linalg.norm(scene.cameras.cam_in_world - scene.start, axis=1)))


def foremost_camera(scene):
    """The middle of the pyramid that is drawn for it."""
    i = foremost(scene)
    ahead = quat_rotate(scene.cameras.world_from_cam_xyzw[i], np.array([0.0, 0, 1]))
    return scene.cameras.cam_in_world[i] + 0.6 * 0.05 * scene.reach * ahead


def lonely_points(scene, width, height):
    """Two points well inside the first view that no other point is near to in it."""
    places = scene.pickable()
    px = np.array([on_screen(scene, place, width, height) for place in places])
    inside = (np.abs(px - [width / 2, height / 2]) < [0.4 * width, 0.4 * height]).all(axis=1)
    apart = np.linalg.norm(px[:, None] - px, axis=2) + 1e9 * np.eye(len(px))
    order = np.argsort(np.where(inside, -apart.min(axis=1), 0))
    return places[order[0]], places[order[1]]


def test_a_model_far_from_the_origin_is_drawn_about_a_point_in_its_middle(tmp_path):
    """Single precision holds such coordinates to half a metre."""
    far = np.array([432_100.25, 5_664_733.5, 120.0])
    model = build(offset=far)
    save(model, tmp_path / "p" / "sparse" / "0")
    scene = load_scene(tmp_path / "p")
    true = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(
        sorted((scene.cloud.xyz.astype(float) + scene.offset_in_world).tolist()), sorted(true.tolist()), atol=1e-5
    )
    assert scene.cloud.xyz.dtype == np.float32 and scene.reach < 10
    names = {image.name: image.projection_center() for image in model.images.values()}
    for i, name in enumerate(scene.cameras.names):
        np.testing.assert_allclose(scene.cameras.cam_in_world[i] + scene.offset_in_world, names[name], atol=1e-7)
    x, y, z = names[scene.cameras.names[0]]
    assert f"{x:.3f}, {y:.3f}, {z:.3f}" in camera_text(scene, 0)
