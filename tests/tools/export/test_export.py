"""Exports as trainers read them.

The trainers' own readers are restated in ``trainer_readers.py`` (its docstring says which parts, and how). Pictures are
drawn for a known model: bright spots where its points are, through lenses that COLMAP knows. In the exported pictures
the spots must stand where each reader projects the points. Velocities are compared with those of a simulated hand that
filmed a room with a rolling shutter, through a whole run.
"""

import csv
import dataclasses
import json
import re
import shutil
import struct
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import get_args
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main, parse
from colmap_inertial.core.errors import (
    FormatError,
    MissingExtraError,
    NotObservableError,
    OutputError,
    OutputExistsError,
)
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import ExportProgram
from colmap_inertial.core.types import ScaleEstimate, Similarity
from colmap_inertial.io.ply import read_ply_header
from colmap_inertial.model import read_model, write_model
from colmap_inertial.model.nerf import EXPORT_FORMAT, NOT_METRES, transform_export
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import invert_similarity, plain_factor
from colmap_inertial.tools.export.formats import write_las
from colmap_inertial.tools.export.source import ExportSource, Picture, TreatedFrame, flat_names
from colmap_inertial.tools.export.targets import TARGETS
from colmap_inertial.tools.export.transforms import Exposure, add_velocities
from colmap_inertial.tools.export.undistort import Undistortion, list_needed_cameras, pinhole_model
from colmap_inertial.tools.export.whole import _is_plain, _notes_on, export_model
from colmap_inertial.tools.view.sources import ScaleFacts, ViewSource
from tests.helpers.trainer_readers import READERS, deblur_fork, inria, nerfstudio_data, ply

METRIC = Similarity(
    scale=1.0,
    rotation_xyzw=[0, 0, 0, 1],
    translation_m=[0, 0, 0],
    cov=np.diag([1e-4, 1e-6, 1e-6, 0, 0, 0, 0]),
    provenance="inertial scale, method joint, trusted",
)
#: Lenses with the principal point off the middle, and the names of their pictures.
CAMERAS = {
    1: ("OPENCV", 320, 240, [250.0, 255.0, 168.0, 113.0, -0.12, 0.03, 0.001, -0.002]),
    2: ("OPENCV_FISHEYE", 300, 260, [170.0, 171.0, 149.0, 131.5, 0.02, -0.01, 0.002, 0.0]),
    3: ("PINHOLE", 280, 220, [240.0, 240.0, 140.0, 110.0]),
}
NAMES = {1: ["left/a.0.JPG", "left/A.0.jpg"], 2: ["right/b c.png", "right/b_c.PNG"], 3: ["d.png", "é.png"]}
SIGMA_PX = 2.2


@dataclass
class Known:
    """A project in metres, and what it was drawn from."""

    out: Path
    model: pycolmap.Reconstruction


def spots(camera, xyz_in_cam):
    """A picture of Gaussian spots."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    picture = np.zeros(v.shape)
    for x, y in camera.img_from_cam(xyz_in_cam):
        picture += np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * SIGMA_PX**2))
    return np.round(230 * np.clip(picture, 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Known:
    """Cameras with three lenses around a grid of points; z is up."""
    out = tmp_path_factory.mktemp("known") / "out"
    grid = np.stack(np.meshgrid(*[np.linspace(-0.8, 0.8, 4)] * 2), -1).reshape(-1, 2)
    world = np.column_stack([0.1 * grid[:, 0] * grid[:, 1], grid])  # a bent wall in the y z plane
    model = pycolmap.Reconstruction()
    for number, (kind, width, height, params) in CAMERAS.items():
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=kind, width=width, height=height, params=params)
        )
    rng = np.random.default_rng(2)
    tracks = [pycolmap.Track() for _ in world]
    image_id = 0
    for number, names in NAMES.items():
        camera = model.camera(number)
        for name in names:
            image_id += 1
            centre = np.array([-2.0, 0.0, 0.3]) + 0.2 * rng.standard_normal(3)
            z = [0.0, 0.05, -0.05] - centre
            z /= np.linalg.norm(z)
            x = np.cross(z, [0.0, 0.02, 1.0])
            x /= np.linalg.norm(x)
            rotation = np.stack([x, np.cross(z, x), z])
            cam = (world - centre) @ rotation.T
            xy = camera.img_from_cam(cam)
            points = [pycolmap.Point2D(p) for p in (*xy, [5.0, 5.0])]  # the last one sees no point
            image = pycolmap.Image(name=name, camera_id=number, image_id=image_id, points2D=points)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
            model.add_image_with_trivial_frame(image, pose)
            for i, track in enumerate(tracks):
                track.add_element(image_id, i)
            picture = spots(camera, cam)
            path = out / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if number == 3:  # 16 bit, one channel
                cv2.imwrite(str(path), picture.astype(np.uint16) * 257)
            else:
                cv2.imwrite(str(path), np.stack([picture] * 3, -1), [cv2.IMWRITE_JPEG_QUALITY, 99])
    for i, track in enumerate(tracks):
        model.add_point3D(world[i], track, np.array([10 * i, 255 - i, 7], np.uint8))
    write_model(model, out / "sparse" / "0", METRIC)
    return Known(out=out, model=model)


@pytest.fixture(scope="module")
def exported(known, tmp_path_factory):
    """For all trainers."""
    folder = tmp_path_factory.mktemp("exported") / "all"
    return folder, export_model(known.out, folder)


def test_the_layout_is_the_one_that_all_trainers_take(known, exported):
    folder, made = exported
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    pictures = [f for f in files if f.startswith("images/")]
    model = {f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    assert set(files) - set(pictures) == model | {"sparse_pc.ply", "transforms.json", "export.json"}
    stems = [Path(f).name.partition(".") for f in pictures]
    assert len({stem.lower() for stem, _, _ in stems}) == 6
    assert {suffix for _, _, suffix in stems} == {"jpg", "png"}
    record = json.loads((folder / "export.json").read_text())
    assert sorted(record["names"].values()) == sorted(name for names in NAMES.values() for name in names)
    assert record["unit"] == made.unit == "m" and record["up_in_world"] == [0, 0, 1]
    assert record["scale"]["metres_per_unit"] == 1 and record["for"] is None and record["command"] == ""
    assert made.images == 6 and made.points == 16 and made.notes == ()


def test_readers_see_cameras_points_and_up_where_the_model_has_them(subtests, known, exported):
    for reader in READERS:
        with subtests.test(reader=reader):
            folder, _ = exported
            seen = reader(folder)
            names = json.loads((folder / "export.json").read_text())["names"]
            assert sorted(seen.names) == sorted(names)
            model = known.model
            for name, centre in seen.centres().items():
                image = model.find_image_with_name(names[name])
                np.testing.assert_allclose(centre, image.projection_center(), atol=1e-6)
                rotation = image.cam_from_world().rotation.matrix()
                np.testing.assert_allclose(seen.poses[name][:, :3], rotation, atol=1e-6)
                np.testing.assert_allclose(seen.poses[name][:, 2], rotation @ [0, 0, 1], atol=1e-6)  # up in the camera
                fx, fy, cx, cy = seen.intrinsics[name]
                np.testing.assert_allclose([fx, fy], model.camera(image.camera_id).params[:2], rtol=1e-12)
                assert (cx, cy) == (seen.sizes[name][0] / 2, seen.sizes[name][1] / 2)
                assert cv2.imread(str(folder / "images" / name)).shape[1::-1] == seen.sizes[name]
            order = np.lexsort(seen.points.T)
            points = np.array([p.xyz for p in model.points3D.values()])
            colours = np.array([p.color for p in model.points3D.values()])
            np.testing.assert_allclose(seen.points[order], points[np.lexsort(points.T)], atol=1e-6)
            np.testing.assert_array_equal(seen.colours[order], colours[np.lexsort(points.T)])


def centroid(picture, xy):
    """Where a spot is, found without knowing how the picture was made: the weighted mean around a guess."""
    left, top = np.maximum(np.floor(xy).astype(int) - 20, 0)  # far more than the weights reach
    picture = picture[top : top + 41, left : left + 41]
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5 + np.array([top, left])[:, None, None]
    for _ in range(6):
        near = picture * np.exp(-((u - xy[0]) ** 2 + (v - xy[1]) ** 2) / (2 * 3.0**2))
        xy = np.array([(near * u).sum(), (near * v).sum()]) / near.sum()
    return xy


def test_pictures_show_points_where_readers_project_them(subtests, known, exported):
    for reader in READERS:
        with subtests.test(reader=reader):
            folder, _ = exported
            seen = reader(folder)
            looked = 0
            for name in seen.names:
                picture = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE).astype(float)
                for xy in seen.project(name, seen.points):
                    inside = (xy > 12).all() and (xy < np.array(seen.sizes[name]) - 12).all()
                    if inside:
                        assert np.abs(centroid(picture, xy) - xy).max() < 0.1, name
                        looked += 1
            assert looked > 60


def test_keypoints_move_along_and_those_without_a_point_go(known, exported):
    model, made = known.model, read_model(exported[0] / "sparse" / "0")
    assert made.num_points3D() == model.num_points3D() and set(made.points3D) == set(model.points3D)
    assert made.compute_mean_reprojection_error() < 1e-6
    for image in made.images.values():
        assert image.num_points2D() == image.num_points3D > 8
        for point in image.points2D:
            xyz = made.points3D[point.point3D_id].xyz
            np.testing.assert_allclose(image.project_point(xyz), point.xy, atol=1e-3)


def test_a_pinhole_with_the_middle_in_the_middle_keeps_its_size_and_pixels(known, exported):
    folder, _ = exported
    seen = inria(folder)
    for name in ("d.png", "_.png"):
        assert seen.sizes[name] == (280, 220)
    before = cv2.imread(str(known.out / "images" / "d.png"), cv2.IMREAD_UNCHANGED) // 257
    after = cv2.imread(str(folder / "images" / "d.png"), cv2.IMREAD_UNCHANGED)
    assert after.dtype == np.uint8
    np.testing.assert_array_equal(after, np.repeat(before[:, :, None], 3, axis=2))


def test_the_box_of_instant_ngp_holds_cameras_and_points_and_leads_back(known, exported):
    meta = nerfstudio_data(exported[0]).extra["meta"]
    cameras = np.array([frame["transform_matrix"] for frame in meta["frames"]])[:, :3, 3]
    boxed = meta["scale"] * np.concatenate([cameras, nerfstudio_data(exported[0]).points]) + meta["offset"]
    half = meta["aabb_scale"] / 2
    assert meta["aabb_scale"] in (1, 2, 4, 8, 16, 32, 64, 128)
    assert (np.abs(boxed - 0.5) <= half).all(axis=1).mean() >= 0.98
    assert (np.abs(boxed[: len(cameras)] - 0.5) <= half).all()
    assert meta["up"] == [0, 0, 1]


def test_cameras_of_a_rig_stay_one(tmp_path):
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=60,
        camera_model_id=pycolmap.CameraModelId.OPENCV, camera_params=[1280, 1280, 500, 400, 0.05, 0.01, 0.001, 0.001],
    )  # fmt: skip
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    model.deregister_frame(min(model.reg_frame_ids()))
    images = [model.image(i) for i in model.reg_image_ids()]
    names = {image.name: f"{i}.png" for i, image in enumerate(images)}
    cameras = {i: Undistortion.of(model.camera(i), tmp_path) for i in list_needed_cameras(model)}
    assert set(cameras) == set(model.cameras)
    made = pinhole_model(model, cameras, names)
    made.write_binary(str(tmp_path))
    made = read_model(tmp_path)
    assert made.num_rigs() == 2 and made.num_reg_frames() == 5 and made.num_images() == 10
    for image in images:
        other = made.find_image_with_name(names[image.name])
        np.testing.assert_array_equal(other.cam_from_world().matrix(), image.cam_from_world().matrix())
    assert made.num_points3D() == model.num_points3D() and made.compute_mean_reprojection_error() < 1e-3
    tracks = {i: len(p.track.elements) for i, p in made.points3D.items()}
    assert sum(tracks.values()) == sum(image.num_points2D() for image in made.images.values()) > 100


def test_apply_scales_an_export_whole(subtests, exported, tmp_path_factory):
    for reader in READERS:
        with subtests.test(reader=reader):
            tmp_path = tmp_path_factory.mktemp("given")
            folder, _ = exported
            applied = apply_to_project(folder, tmp_path / "made", plain_factor(2.5))
            assert {change.path for change in applied.changes} == {
                "sparse/0",
                "sparse_pc.ply",
                "transforms.json",
                "export.json",
            }
            before, after = reader(folder), reader(tmp_path / "made")
            for name, centre in before.centres().items():
                np.testing.assert_allclose(after.centres()[name], 2.5 * centre, atol=1e-9)
            np.testing.assert_allclose(after.points, 2.5 * before.points, rtol=1e-6)


def test_what_an_export_says_of_itself_holds_after_apply_and_comes_back(exported, tmp_path):
    folder, _ = exported
    shutil.copytree(folder, tmp_path / "export")
    (tmp_path / "export" / "georeference.json").write_text("{}")
    said = json.loads((folder / "export.json").read_text())
    assert said["unit"] == "m"
    said |= {"up_in_world": [0.1, 0.0, 0.9], "gravity_in_world_m_s2": [1.0, 2.0, -9.5]}
    (tmp_path / "export" / "export.json").write_text(json.dumps(said))
    turn = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # about x: z becomes -y
    similarity = dataclasses.replace(plain_factor(2.5), rotation_xyzw=turn)
    applied = apply_to_project(tmp_path / "export", tmp_path / "made", similarity)
    assert any("1 georeference.json" in str(note) for note in applied.notes)
    moved = json.loads((tmp_path / "made" / "export.json").read_text())
    assert moved["unit"] == "0.4 m"  # a length of 1 there
    for name in ("up_in_world", "gravity_in_world_m_s2"):
        x, y, z = said[name]
        np.testing.assert_allclose(moved[name], [x, -z, y], atol=1e-9)
    undo_project(tmp_path / "made", tmp_path / "again")
    again = json.loads((tmp_path / "again" / "export.json").read_text())
    np.testing.assert_allclose(again.pop("up_in_world"), said.pop("up_in_world"), atol=1e-12)
    np.testing.assert_allclose(again.pop("gravity_in_world_m_s2"), said.pop("gravity_in_world_m_s2"), atol=1e-12)
    assert again == said


def test_an_export_without_a_scale_is_in_metres_once_one_was_applied(subtests, known, tmp_path_factory):
    for world, up in (("z-up", [0, 0, 1]), ("y-down", [0, -1, 0]), (None, None)):
        with subtests.test(world=world, up=up):
            tmp_path = tmp_path_factory.mktemp("given")
            out = tmp_path / "out"
            (out / "sparse" / "0").mkdir(parents=True)
            known.model.write_binary(str(out / "sparse" / "0"))
            export_model(out, tmp_path / "export", image_folder=known.out / "images", unscaled=True)
            said = json.loads((tmp_path / "export" / "export.json").read_text())
            assert len(said["notes"]) == 2
            estimate = ScaleEstimate(
                metres_per_unit=2.5, sigma_log=0.01, ci95=(2.45, 2.55), verdict="trusted", method="joint",
                gravity_in_world_m_s2=np.array([3.0, -9.0, 2.0]), cov=np.diag([1e-4, *[1e-3] * 6]),
            )  # fmt: skip
            given = (
                plain_factor(2.5)
                if world is None
                else Similarity.from_scale(estimate, world=world, provenance="by IMU")
            )
            apply_to_project(tmp_path / "export", tmp_path / "made", given)
            made = json.loads((tmp_path / "made" / "export.json").read_text())
            assert (made["unit"], made["up_in_world"], made["scale"]["metres_per_unit"]) == ("m", up, 2.5)
            # a factor says nothing of gravity
            assert made["notes"] == ([] if world else said["notes"][1:]) and "gravity" in said["notes"][1]
            if world:
                np.testing.assert_allclose(made["scale"]["relative_ci95"], [np.exp(-0.0196), np.exp(0.0196)], rtol=1e-4)
            undo_project(tmp_path / "made", tmp_path / "again")
            assert json.loads((tmp_path / "again" / "export.json").read_text()) == said


def test_of_two_similarities_undone_in_turn_the_first_one_made_an_export_metres(tmp_path):
    said = {"format": EXPORT_FORMAT, "unit": NOT_METRES, "up_in_world": None, "scale": {"verdict": "refused"}}
    first, second = plain_factor(2.0), plain_factor(2.5)
    (tmp_path / "0.json").write_text(json.dumps(said | {"notes": ["a"]}))
    units = []
    for i, one in enumerate(
        [first, second, invert_similarity(second), invert_similarity(first), invert_similarity(first)]
    ):
        transform_export(tmp_path / f"{i}.json", tmp_path / f"{i + 1}.json", one)
        units.append(json.loads((tmp_path / f"{i + 1}.json").read_text())["unit"])
    assert units == ["m", "0.4 m", "m", NOT_METRES, NOT_METRES]
    assert json.loads((tmp_path / "5.json").read_text()) == said | {"notes": ["a"]}


def test_an_export_that_was_changed_is_copied_or_refused(subtests, tmp_path_factory):
    for key, value in (("unit", "2m"), ("unit", "9e m"), ("up_in_world", "z")):
        with subtests.test(key=key, value=value):
            tmp_path = tmp_path_factory.mktemp("given")
            source, target = tmp_path / "export.json", tmp_path / "made.json"
            source.write_text(json.dumps({"format": EXPORT_FORMAT, "unit": "m", key: value}))
            if value == "2m":  # no unit of ours
                assert transform_export(source, target, plain_factor(2.0)) == ()
                assert json.loads(target.read_text())["unit"] == "2m"
            else:
                with pytest.raises(FormatError, match="--keep"):
                    transform_export(source, target, plain_factor(2.0))


# --- lenses ----------------------------------------------------------------------------------------------------------


def test_pinholes_see_nothing_that_the_lens_does_not_see(subtests):
    for kind, params in (
        ("SIMPLE_RADIAL", [500.0, 320, 240, -0.3]),
        ("SIMPLE_RADIAL", [500.0, 320, 240, 0.3]),
        ("RADIAL", [300.0, 350, 200, -0.25, 0.06]),
        ("OPENCV", [520.0, 500.0, 250, 300, 0.1, -0.2, 0.01, 0.01]),
        ("OPENCV_FISHEYE", [220.0, 220.0, 320, 240, 0.0, 0.0, 0.0, 0.0]),
        ("SIMPLE_RADIAL_FISHEYE", [180.0, 310, 250, 0.05]),
        ("FULL_OPENCV", [500.0, 500.0, 320, 240, -0.2, 0.1, 0, 0, 0.02, 0.01, 0, 0]),
        ("FOV", [400.0, 400.0, 320, 240, 0.9]),
        ("THIN_PRISM_FISHEYE", [250.0, 250.0, 320, 240, 0.01, 0, 0, 0, 0, 0, 0.001, 0.001]),
    ):
        with subtests.test(kind=kind, params=params):
            camera = pycolmap.Camera(camera_id=1, model=kind, width=640, height=480, params=params)
            made = Undistortion.of(camera, Path("model"))
            width, height = made.pinhole.width, made.pinhole.height
            assert 200 < width <= 1.6 * 640 and 150 < height <= 1.6 * 480
            assert made.pinhole.params[2:] == (width / 2, height / 2)
            edge = np.concatenate(
                [np.stack([np.linspace(0, width, 99), np.full(99, y)], -1) for y in (0, height)]
                + [np.stack([np.full(99, x), np.linspace(0, height, 99)], -1) for x in (0, width)]
            )
            source = made.source_px(edge)
            assert (source > -0.05).all() and (source < np.array([640, 480]) + 0.05).all()
            np.testing.assert_allclose(made.moved_px(source), edge, atol=1e-3)
            # resampling between nodes is as good as at every pixel
            v, u = np.mgrid[:480, :640].astype(np.float32)
            ramp = np.stack([u / 3, v / 3, (u + v) / 5], -1)
            x, y = 37, 51
            seen = made.resampled(np.round(ramp).astype(np.uint8))[y, x].astype(float)
            at = made.source_px(np.array([[x + 0.5, y + 0.5]]))[0] - 0.5
            assert np.abs(seen - [at[0] / 3, at[1] / 3, at.sum() / 5]).max() < 0.8


def test_a_camera_that_sees_all_around_is_refused():
    camera = pycolmap.Camera(camera_id=4, model="EQUIRECTANGULAR", width=640, height=320, params=[640, 320])
    with pytest.raises(FormatError) as refused:
        Undistortion.of(camera, Path("model"))
    assert refused.value.code == "sees-all-around" and refused.value.fact.values["camera"] == 4


# --- names -----------------------------------------------------------------------------------------------------------


def test_names_are_flat_without_dots_and_unique_without_regard_to_case():
    names = [
        "a/b.jpg",
        "a_b.JPEG",
        "A/B.png",
        "v1.2/x.tif",
        "p q.jpg",
        "p/Q.jpg",
        "ümlaut .png",
        "a" * 250 + ".jpg",
        "b" + "a" * 250 + ".jpg",
    ]
    found = flat_names(names)
    assert set(found) == set(names)
    assert found["a/b.jpg"] == "a_b_2.jpg" and found["v1.2/x.tif"] == "v1_2_x.png"
    assert found["p q.jpg"] == "p_q.jpg" and found["p/Q.jpg"] == "p_Q_2.jpg"
    assert len({name.partition(".")[0].lower() for name in found.values()}) == len(names)
    assert all(name.count(".") == 1 and "/" not in name and len(name) < 120 for name in found.values())


def test_many_names_of_one_stem_take_no_longer_each():
    names = ["\u00e9" * (1 + i % 50) + "/" * (i % 2) + "\u00e8" * (1 + i // 50) + ".jpg" for i in range(60_000)]
    found = flat_names(names)
    assert len(set(found.values())) == len(set(names)) > 50_000


# --- what is refused -------------------------------------------------------------------------------------------------


def test_the_folder_must_be_new_or_empty_and_apart_and_nothing_is_left_of_a_failure(known, tmp_path):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine.txt").write_text("x")
    with pytest.raises(OutputExistsError):
        export_model(known.out, taken)
    for folder in (known.out / "images" / "export", known.out, known.out.parent):
        with pytest.raises(OutputError):
            export_model(known.out, folder)
    bare = tmp_path / "bare"
    shutil.copytree(known.out / "sparse", bare / "sparse")
    with pytest.raises(FormatError) as refused:
        export_model(bare, tmp_path / "new")
    assert refused.value.code == "picture-missing"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bare", "taken"]
    empty = tmp_path / "empty"
    empty.mkdir()
    assert export_model(known.out, empty).images == 6


def test_a_model_without_a_scale_is_exported_with_unscaled_alone(known, tmp_path):
    out = tmp_path / "out"
    (out / "sparse" / "0").mkdir(parents=True)
    known.model.write_binary(str(out / "sparse" / "0"))
    with pytest.raises(NotObservableError, match="--unscaled"):
        export_model(out, tmp_path / "refused", image_folder=known.out / "images")
    made = export_model(out, tmp_path / "made", image_folder=known.out / "images", unscaled=True)
    record = json.loads((tmp_path / "made" / "export.json").read_text())
    assert made.unit == "model" and "not metres" in record["unit"] and record["up_in_world"] is None
    assert any("not metres" in note for note in record["notes"])
    assert not (tmp_path / "refused").exists()
    export_model(out, tmp_path / "survey", "metashape", image_folder=known.out / "images", unscaled=True)
    assert "metre" not in (tmp_path / "survey" / "cameras.xml").read_text()


def test_a_picture_of_another_size_is_refused(known, tmp_path):
    pictures = tmp_path / "pictures"
    for names in NAMES.values():
        for name in names:
            (pictures / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(pictures / name), np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(FormatError, match="20 x 20 pixels"):
        export_model(known.out, tmp_path / "new", image_folder=pictures)


def test_pictures_that_say_how_to_turn_them_are_written_anew(tmp_path):
    """A reader that heeds an orientation would turn what the model did not."""
    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 255, (8, 10, 3), np.uint8)
    turned = Image.Exif()
    turned[0x0112] = 6
    for name, exif, plain in (("a.png", None, True), ("b.png", turned, False), ("c.jpg", turned, False)):
        Image.fromarray(pixels).save(tmp_path / name, **({} if exif is None else {"exif": exif}))
        assert _is_plain(tmp_path / name, Path(name), pixels) is plain, name


def test_rectified_pictures_in_place_of_filmed_ones_are_told():
    pictures = {"a.png": Picture(path=Path("a.png"), rectified=True), "b.png": Picture(path=Path("b.png"))}
    (note,) = _notes_on(pictures, "original")
    assert note.code == "pictures-rectified" and note.values["count"] == 1
    assert _notes_on(pictures, "rectified") == []


def test_poses_for_deblurring_are_those_of_the_exported_middle_row():
    """Where the principal point is off the middle, the exported picture begins further down, and later."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    content = {"frames": [{"file_path": "images/a.png", "transform_matrix": matrix.tolist()}]}
    moved = Exposure(
        velocity_in_cam_m_s=np.array([2.0, 0.0, 0.0]),
        angular_velocity_in_cam_rad_s=np.array([0.0, 0.0, -10.0]),
        exposure_s=0.0,
        readout_s=0.02,
        late_s=0.001,
    )
    (frame,) = add_velocities(content, {"a.png": moved})["frames"]
    found = np.array(frame["transform_matrix"])
    np.testing.assert_allclose(found[:3, 3], [0, 0.002, 0], atol=1e-12)
    # -z of COLMAP's camera is z of OpenGL's
    np.testing.assert_allclose(found[:3, 0], [-np.sin(0.01), np.cos(0.01), 0], atol=1e-12)


def test_a_run_s_rectified_pictures_are_known_by_any_path(tmp_path, monkeypatch):
    images = tmp_path / "out" / "images"
    images.mkdir(parents=True)
    (images / "a.png").touch()
    monkeypatch.chdir(tmp_path)
    found = ViewSource(folder=Path("out/sparse/0"), index=0, others=(0,), scale=ScaleFacts(unit="m"), images=(images,))
    source = ExportSource(
        found=found, model=None, up_in_world=None, gravity_in_world_m_s2=None, motion=None,
        treated={"a.png": TreatedFrame(rectified=True)},
    )  # fmt: skip
    assert source.pictures(Path("out"), ["a.png"], "rectified")["a.png"].rectified


def test_instant_ngp_needs_no_velocities(known, tmp_path):
    """What ``apply`` wrote has none."""
    made = export_model(known.out, tmp_path / "made", "instant-ngp")
    meta = json.loads((tmp_path / "made" / "transforms.json").read_text())
    assert len(meta["frames"]) == made.images and "transform_matrix_start" not in meta["frames"][0]
    assert any("no velocities" in str(note) for note in made.notes)


def test_the_page_has_the_command_lines_that_are_printed():
    page = (Path(__file__).parents[3] / "docs" / "export.md").read_text()
    named = set(re.findall(r"`([\w-]+)`", "".join(re.findall(r"^\| (`.*?) \|", page, re.MULTILINE))))
    assert set(TARGETS) <= named and set(get_args(ExportProgram)) == set(TARGETS)
    lines = [program.command.format(folder="DIR") for program in TARGETS.values() if program.command]
    assert lines and [line for line in lines if f"`{line}`" not in page] == []


def test_the_command_prints_the_line_that_keeps_metres_and_up(known, tmp_path, capsys):
    folder = tmp_path / "to train"
    with pytest.raises(SystemExit) as stopped:
        main(["export", str(known.out), str(folder), "--for", "gsplat"])
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    line = json.loads((folder / "export.json").read_text())["command"]
    assert line in said and "--no-normalize-world-space" in line and f"'{folder}'" in line
    assert parse(["export", "a", "b"]).program is None
    with pytest.raises(SystemExit) as stopped:
        main(["export", str(known.out), str(tmp_path / "x"), "--for", "3dgs-deblur"])
    assert stopped.value.code == 3 and "kept no velocities" in capsys.readouterr().err


# --- a whole run -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rolling(tmp_path_factory):
    """A hand that films a room's corner with 30 ms of readout, through a whole run: (scene, out)."""
    from colmap_inertial.core.options import MappingOptions, ReconstructOptions
    from colmap_inertial.run.commands.reconstruct import reconstruct
    from tests.helpers.corner_scene import CALIBRATED, CornerScene

    root = tmp_path_factory.mktemp("rolling")
    scene = CornerScene.make(exposure_s=0.004, readout_s=0.03, frames=21)
    options = ReconstructOptions(
        mapping=MappingOptions(max_num_features=500, first_octave=0, pairing="sequential", overlap=4),
        deblur="off",
        deterministic=True,
    )
    reconstruct(scene.write(root / "capture", extra=CALIBRATED), root / "out", options)
    return scene, root / "out"


@pytest.fixture(scope="module")
def filmed(rolling, tmp_path_factory):
    """For the deblurring fork, with the pictures as they were filmed."""
    folder = tmp_path_factory.mktemp("filmed") / "deblur"
    return folder, export_model(rolling[1], folder, "3dgs-deblur", images="original")


def true_velocities(scene, names):
    """Of the simulated hand, in OpenGL camera axes."""
    t_s = np.array([scene.shutter(int(name[:4])).reference_s() for name in names])
    rotation = matrix_from_quat(scene.motion.world_from_cam_xyzw(t_s))
    flip = np.array([1, -1, -1])
    velocity = np.einsum("nji,nj->ni", rotation, scene.motion.at(t_s).velocity_in_world_m_s)
    return velocity * flip, scene.motion.rate_in_cam_rad_s(t_s) * flip


def test_velocities_for_deblurring_are_those_of_the_hand(rolling, filmed):
    seen = deblur_fork(filmed[0])
    assert len(seen.names) > 18
    for found, true, most in zip(
        ("linear", "angular"), true_velocities(rolling[0], seen.names), (0.03, 0.01), strict=True
    ):
        values = np.array([seen.extra[found][name] for name in seen.names])
        error = np.linalg.norm(values - true, axis=1) / np.linalg.norm(true, axis=1)
        assert np.median(error) < most, found
    assert seen.extra["exposure_s"] == pytest.approx(0.004)
    assert seen.extra["readout_s"] == pytest.approx(0.03, rel=0.01)
    assert any("rolling shutter" in str(note) for note in filmed[1].notes)


def test_rectified_pictures_have_no_readout_and_agree_with_the_model(rolling, tmp_path):
    export_model(rolling[1], tmp_path / "made", "3dgs-deblur")
    seen = deblur_fork(tmp_path / "made")
    assert seen.extra["readout_s"] == 0 and seen.extra["exposure_s"] == pytest.approx(0.004)
    record = json.loads((tmp_path / "made" / "export.json").read_text())
    assert record["notes"] == [] and record["scale"]["verdict"] == "trusted"
    assert record["gravity_in_world_m_s2"][2] == pytest.approx(-9.81, abs=0.05)
    np.testing.assert_allclose(record["up_in_world"], [0, 0, 1], atol=1e-6)


def test_what_was_deblurred_is_taken_out_of_the_capture_where_it_is_named(rolling, tmp_path):
    _, out = rolling
    copy = tmp_path / "out"
    shutil.copytree(out, copy)
    result = json.loads((copy / "result.json").read_text())
    for frame in result["frames"][:3]:
        frame |= {"action": "deblurred", "sharpened": True}
    (copy / "result.json").write_text(json.dumps(result))
    blurred = [frame["name"] for frame in result["frames"][:3]]
    for folder in copy.rglob("images"):
        for name in blurred:
            cv2.imwrite(str(folder / name), np.zeros((300, 400, 3), np.uint8))
    with pytest.raises(FormatError) as refused:
        export_model(copy, tmp_path / "kept", "3dgs-deblur", images="original")
    assert refused.value.code == "changed-since-its-run"
    for step in ("frames", "images"):
        (copy / ".stages" / f"{step}.json").unlink()
    made = export_model(copy, tmp_path / "kept", "3dgs-deblur", images="original")
    assert any("3 images are deblurred" in str(note) for note in made.notes)
    assert cv2.imread(str(tmp_path / "kept" / "images" / blurred[0])).max() == 0
    made = export_model(copy, tmp_path / "filmed", images="original", capture=out.parent / "capture")
    assert not any("deblurred" in str(note) for note in made.notes)
    # a pinhole camera, its principal point in the middle: only the recoding of the picture is left
    before, after = (
        cv2.imread(str(f / blurred[0])) for f in (out.parent / "capture/frames", tmp_path / "filmed/images")
    )
    assert np.abs(before.astype(int) - after).mean() < 3
    with pytest.raises(FormatError, match="is not the capture"):
        export_model(copy, tmp_path / "x", images="original", capture=Path(__file__).parents[3] / "example_scenes/desk")
    with pytest.raises(ValueError, match="original"):
        export_model(copy, tmp_path / "x", capture=out.parent / "capture")


def test_instant_ngp_s_poses_by_row_are_those_of_the_hand(rolling, tmp_path):
    scene, out = rolling
    export_model(out, tmp_path / "made", "instant-ngp", images="original")
    meta = json.loads((tmp_path / "made" / "transforms.json").read_text())
    shift, turn = [], []
    for frame in meta["frames"]:
        a, b, c, d = frame["rolling_shutter"]
        assert (a, b) == (0, 0) and c + d == pytest.approx(1)
        begin, end = (np.array(frame[f"transform_matrix_{which}"]) for which in ("start", "end"))
        shutter = scene.shutter(int(Path(frame["file_path"]).stem))
        t_s = np.array([shutter.t_s, shutter.t_s + shutter.readout_s + shutter.exposure_s])
        true = scene.motion.cam_in_world_m(t_s)
        moved, wanted = begin[:3, 3] - end[:3, 3], true[0] - true[1]
        shift.append(np.linalg.norm(moved) / np.linalg.norm(wanted) - 1)
        rotation = matrix_from_quat(scene.motion.world_from_cam_xyzw(t_s))
        true_turn, found_turn = rotation[0].T @ rotation[1], np.diag([1, -1, -1]) @ begin[:3, :3].T @ end[:3, :3]
        turn.append(np.abs(found_turn @ np.diag([1, -1, -1]) - true_turn).max())
        # row and exposure in the middle: the frame's own pose
        middle = a + 0.5 * c + 0.5 * d
        np.testing.assert_allclose(
            begin[:3, 3] + middle * (end - begin)[:3, 3], np.array(frame["transform_matrix"])[:3, 3], atol=1e-9
        )
    assert np.median(np.abs(shift)) < 0.03 and np.median(turn) < 1e-3


def test_the_sparse_points_of_a_run_are_in_the_ply(rolling, filmed):
    path = filmed[0] / "sparse_pc.ply"
    with open(path, "rb") as file:
        (vertices,) = read_ply_header(path, file).elements
    assert vertices.rows == filmed[1].points > 500


def test_instants_and_the_smoothed_path_go_into_csv_and_tum(rolling, tmp_path):
    scene, out = rolling
    assert export_model(out, tmp_path / "csv", "csv").images == 21
    rows = list(csv.DictReader((tmp_path / "csv" / "cameras.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == [f"{i:04}.jpg" for i in range(21)]
    model = read_model(out / "sparse" / "0")
    for row in rows:
        assert float(row["t_s"]) == pytest.approx(scene.shutter(int(row["name"][:4])).reference_s(), abs=1e-6)
        image = model.find_image_with_name(row["name"])
        np.testing.assert_allclose([float(row[k]) for k in "xyz"], image.projection_center(), atol=1e-9)
        q = np.array([float(row[f"q{k}"]) for k in "xyzw"])
        np.testing.assert_allclose(matrix_from_quat(q), image.cam_from_world().rotation.matrix().T, atol=1e-9)
    _, angular = true_velocities(scene, [row["name"] for row in rows])
    found = np.array([[float(row[f"w{k}_rad_s"]) for k in "xyz"] for row in rows]) * [1, -1, -1]
    assert np.median(np.linalg.norm(found - angular, axis=1) / np.linalg.norm(angular, axis=1)) < 0.01
    export_model(out, tmp_path / "tum", "tum")
    numbers = np.loadtxt(tmp_path / "tum" / "trajectory.tum")
    np.testing.assert_allclose(numbers, np.loadtxt(out / "trajectory.tum"), atol=1e-9)
    assert sorted(p.name for p in (tmp_path / "tum").iterdir()) == ["export.json", "trajectory.tum"]


def test_the_path_is_an_animation_in_gltf(rolling, tmp_path):
    pytest.importorskip("pygltflib")
    export_model(rolling[1], tmp_path / "made", "gltf")
    content, buffer = glb(tmp_path / "made" / "scene.glb")
    (animation,) = content["animations"]
    values = {c["target"]["path"]: animation["samplers"][c["sampler"]] for c in animation["channels"]}
    times = accessor(content, buffer, values["translation"]["input"])[:, 0]
    path = np.loadtxt(rolling[1] / "trajectory.tum")
    np.testing.assert_allclose(times, path[:, 0] - path[0, 0], atol=1e-5)
    np.testing.assert_allclose(accessor(content, buffer, values["translation"]["output"]), path[:, 1:4], atol=1e-5)
    turned = matrix_from_quat(accessor(content, buffer, values["rotation"]["output"]).astype(float))
    np.testing.assert_allclose(turned @ np.diag([1, -1, -1]), matrix_from_quat(path[:, 4:]), atol=1e-5)


# --- formats ---------------------------------------------------------------------------------------------------------


def glb(path):
    """JSON and buffer of a binary glTF (version 2.0 of the specification)."""
    data = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    content = json.loads(data[20 : 20 + json_length])
    size, kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert kind == b"BIN\0" and json_length % 4 == size % 4 == 0
    return content, data[28 + json_length : 28 + json_length + size]


def accessor(content, buffer, index):
    one = content["accessors"][index]
    view = content["bufferViews"][one["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[one["type"]]
    kind = {5123: "<u2", 5126: "<f4"}[one["componentType"]]
    assert view["byteOffset"] % 4 == 0
    values = np.frombuffer(buffer, kind, one["count"] * width, view["byteOffset"]).reshape(-1, width)
    assert values.nbytes == view["byteLength"]
    return values


def test_gltf_shows_cameras_and_points_with_y_up(known, tmp_path):
    pytest.importorskip("pygltflib")
    export_model(known.out, tmp_path / "made", "gltf")
    content, buffer = glb(tmp_path / "made" / "scene.glb")
    nodes = content["nodes"]
    root = nodes[content["scenes"][0]["nodes"][0]]
    up = matrix_from_quat(np.array(root["rotation"]))
    np.testing.assert_allclose(up @ [0, 0, 1], [0, 1, 0], atol=1e-9)
    by_name = {node["name"]: node for node in (nodes[i] for i in root["children"])}
    mesh = content["meshes"][by_name["points"]["mesh"]]["primitives"][0]
    assert mesh["mode"] == 0
    xyz = accessor(content, buffer, mesh["attributes"]["POSITION"])
    np.testing.assert_allclose(xyz, [p.xyz for _, p in sorted(known.model.points3D.items())], atol=1e-6)
    stated = content["accessors"][mesh["attributes"]["POSITION"]]
    np.testing.assert_allclose([stated["min"], stated["max"]], [xyz.min(axis=0), xyz.max(axis=0)])
    colours = accessor(content, buffer, mesh["attributes"]["COLOR_0"])
    shown = np.array([p.color for _, p in sorted(known.model.points3D.items())]) / 255
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # glTF 2.0, 3.9.2
    np.testing.assert_allclose(colours[:, :3] / 65535, linear, atol=1e-5)
    names = json.loads((tmp_path / "made" / "export.json").read_text())["names"]
    for new, old in names.items():
        node, image = by_name[new.partition(".")[0]], known.model.find_image_with_name(old)
        np.testing.assert_allclose(node["translation"], image.projection_center(), atol=1e-9)
        # a point ahead of the camera lies on -z of its node, and what is lower in the picture is lower
        point = image.cam_from_world().inverse() * np.array([0.1, 0.2, 2.0])
        there = matrix_from_quat(np.array(node["rotation"])).T @ (point - node["translation"])
        np.testing.assert_allclose(there, [0.1, -0.2, -2.0], atol=1e-9)
        lens = content["cameras"][node["camera"]]["perspective"]
        size = cv2.imread(str(known.out / "images" / old)).shape
        assert 0.2 < lens["yfov"] < 2.5 and abs(lens["aspectRatio"] - size[1] / size[0]) < 0.3


@pytest.mark.parametrize("name", ["ply", "las"])
def test_points_are_those_of_the_model(known, tmp_path, name):
    if name == "las":
        pytest.importorskip("laspy")
    export_model(known.out, tmp_path / "made", name)
    wanted = [p for _, p in sorted(known.model.points3D.items())]
    if name == "ply":
        xyz, rgb = ply(tmp_path / "made" / "points.ply")
    else:
        las = pytest.importorskip("laspy").read(tmp_path / "made" / "points.las")
        xyz, rgb = np.asarray(las.xyz), np.stack([las.red, las.green, las.blue], 1) // 257
    np.testing.assert_allclose(xyz, [p.xyz for p in wanted], atol=1e-6)
    np.testing.assert_array_equal(rgb, [p.color for p in wanted])


def test_far_points_fit_into_las(tmp_path):
    laspy = pytest.importorskip("laspy")
    xyz = np.array([[0.0, 0, 0], [9e5, -9e5, 1e4]])
    write_las(tmp_path / "far.las", xyz, np.zeros((2, 3), np.uint8))
    np.testing.assert_allclose(np.asarray(laspy.read(tmp_path / "far.las").xyz), xyz, atol=1e-3)


def assert_spots(folder, name, projected):
    """That a picture shows the points where they are projected."""
    picture = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE).astype(float)
    size = np.array(picture.shape[1::-1])
    inside = [xy for xy in projected if (xy > 12).all() and (xy < size - 12).all()]
    assert len(inside) > 8
    for xy in inside:
        assert np.abs(centroid(picture, xy) - xy).max() < 0.1, name


def test_metashape_projects_points_to_where_pictures_show_them(known, tmp_path):
    """By the camera model of its manual: u = w / 2 + cx + x f + x b1 + y b2, v = h / 2 + cy + y f."""
    export_model(known.out, tmp_path / "made", "metashape")
    chunk = ElementTree.parse(tmp_path / "made" / "cameras.xml").getroot().find("chunk")
    assert 'UNIT["metre",1' in chunk.find("reference").text
    transform = chunk.find("components/component/transform")
    assert transform.find("rotation").text.split() == [str(float(v)) for v in np.eye(3).ravel()]
    assert float(transform.find("scale").text) == 1
    sensors = {sensor.get("id"): sensor.find("calibration") for sensor in chunk.find("sensors")}
    files = {path.stem: path.name for path in (tmp_path / "made" / "images").iterdir()}
    world = np.array([p.xyz for p in known.model.points3D.values()])
    assert len(chunk.find("cameras")) == 6
    for camera in chunk.find("cameras"):
        calibration = sensors[camera.get("sensor_id")]
        value = {one.tag: float(one.text) for one in calibration if one.tag != "resolution"}
        width, height = (int(calibration.find("resolution").get(k)) for k in ("width", "height"))
        name = files[camera.get("label")]
        assert cv2.imread(str(tmp_path / "made" / "images" / name)).shape[:2] == (height, width)
        pose = np.array(camera.find("transform").text.split(), float).reshape(4, 4)
        x, y, z = (np.linalg.inv(pose) @ np.column_stack([world, np.ones(len(world))]).T)[:3]
        u = width / 2 + value["cx"] + x / z * (value["f"] + value["b1"])
        v = height / 2 + value["cy"] + y / z * value["f"]
        assert_spots(tmp_path / "made", name, np.stack([u, v], -1))


def test_bundler_projects_points_to_where_pictures_show_them(known, tmp_path):
    """By its manual: P = R X + t, p = -P / P.z, p' = f p, counted from the middle, upwards."""
    folder = tmp_path / "made"
    export_model(known.out, folder, "bundler")
    words = iter((folder / "bundle.out").read_text().partition("\n")[2].split())

    def numbers(count):
        return np.array([float(next(words)) for _ in range(count)])

    cameras, points = numbers(2).astype(int)
    listed = [line.split() for line in (folder / "list.txt").read_text().splitlines()]
    poses = [(numbers(3), numbers(9).reshape(3, 3), numbers(3)) for _ in range(cameras)]
    world, seen = [], [[] for _ in poses]
    for _ in range(points):
        world.append(numbers(3))
        numbers(3)
        for _ in range(int(numbers(1)[0])):
            camera, _, x, y = numbers(4)
            seen[int(camera)].append((len(world) - 1, x, y))
    world = np.array(world)
    assert next(words, None) is None
    for (lens, rotation, translation), (name, _, focal), observations in zip(poses, listed, seen, strict=True):
        assert lens[0] == float(focal) and (lens[1:] == 0).all()
        cam = world @ rotation.T + translation
        assert (cam[:, 2] < 0).all()
        xy = lens[0] * -cam[:, :2] / cam[:, 2:]
        for index, x, y in observations:
            np.testing.assert_allclose(xy[index], [x, y], atol=1e-2)
        size = np.array(cv2.imread(str(folder / name)).shape[1::-1])
        assert_spots(folder, Path(name).name, size / 2 + xy * [1, -1])


def test_formats_that_need_a_path_say_so(known, tmp_path):
    with pytest.raises(FormatError, match="has no smoothed path"):
        export_model(known.out, tmp_path / "made", "tum")
    export_model(known.out, tmp_path / "csv", "csv")
    rows = list(csv.DictReader((tmp_path / "csv" / "cameras.csv").read_text().splitlines()))
    assert {row["name"] for row in rows} == {name for names in NAMES.values() for name in names}
    assert all(row["t_s"] == row["vx_m_s"] == "" for row in rows)


def test_formats_without_their_package_name_the_extra(subtests, known, tmp_path_factory):
    for name, module in (("las", "laspy"), ("gltf", "pygltflib")):
        with subtests.test(name=name, module=module), pytest.MonkeyPatch.context() as monkeypatch:
            tmp_path = tmp_path_factory.mktemp("given")
            monkeypatch.setitem(sys.modules, module, None)
            with pytest.raises(MissingExtraError, match=rf"extra `{name}`: pip install '{module}"):
                export_model(known.out, tmp_path / "made", name)
            assert not (tmp_path / "made").exists()
