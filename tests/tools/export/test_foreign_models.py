"""Exports of models that other programs made: wide lenses, places far away, alpha, masks, names that are only names."""

import json
import struct
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError, OutputExistsError
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.images import read_image
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.export.transforms import Exposure, View, view_matrices
from colmap_inertial.tools.export.undistort import Undistortion
from colmap_inertial.tools.export.whole import export_model
from tests.helpers.foreign_models import HEIGHT, WIDTH, build, ply_points, save, write_pictures

FOLDING = {
    "SIMPLE_RADIAL": [100, 80, 60, -0.25],
    "RADIAL": [90, 75, 66, 0.05, -0.2],
    "OPENCV": [100, 104, 84, 57, -0.3, 0.0, 0.002, -0.001],
    "FULL_OPENCV": [100, 100, 80, 60, -0.25, 0, 0, 0, 0, 0, 0, 0],
}


@pytest.mark.parametrize("kind", FOLDING)
def test_nothing_is_shown_from_beyond_where_a_lens_folds(tmp_path, kind):
    """The picture is red beyond the fold, as a reader of its own finds that: nothing red is in the new one."""
    camera = pycolmap.Camera(camera_id=1, model=kind, width=WIDTH, height=HEIGHT, params=FOLDING[kind])
    model = build(camera=camera)
    save(model, tmp_path / "p" / "sparse" / "0")
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    tangent = np.linspace(0, 4, 4000)
    reach = min(
        np.linalg.norm(camera.img_from_cam(np.stack([tangent * c, tangent * s, 1 + 0 * tangent], 1)) - middle, axis=1)[
            : np.argmin(
                np.diff(
                    np.linalg.norm(
                        camera.img_from_cam(np.stack([tangent * c, tangent * s, 1 + 0 * tangent], 1)) - middle, axis=1
                    )
                )
                > 0
            )
            + 1
        ].max()
        for c, s in ((np.cos(a), np.sin(a)) for a in np.arange(0, 2 * np.pi, 0.1))
    )
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    far = np.hypot(u - middle[0], v - middle[1]) > reach + 3
    assert far.any()
    picture = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    picture[far] = (0, 0, 255)
    for image in model.images.values():
        (tmp_path / "p" / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "p" / "images" / image.name), picture)
    export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    shown = cv2.imread(str(next((tmp_path / "out" / "images").iterdir())))
    assert shown.shape[0] > 40 and np.abs(shown.astype(int) - 120).max() <= 8
    undistortion = Undistortion.of(camera, tmp_path)
    width, height = undistortion.pinhole.width, undistortion.pinhole.height
    for end in ((0, 0), (width, 0), (0, height), (width, height)):
        line = np.linspace([width / 2, height / 2], end, 200)
        radius = np.linalg.norm(undistortion.source_px(line) - middle, axis=1)
        assert (np.diff(radius) > 0).all()
    ahead = np.array([[width / 2 + 5 * width, height / 2]])
    assert np.isnan(undistortion.source_px(ahead)).all()


def test_lenses_that_do_not_fold_keep_their_pictures(tmp_path):
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=160, height=120, params=[140, 80, 60, -0.05])
    pinhole = Undistortion.of(camera, tmp_path).pinhole
    assert pinhole.width >= 158 and pinhole.height >= 118


UTM = np.array([432_100.0, 5_664_733.0, 120.0])


@pytest.fixture
def far(tmp_path):
    model = build(offset=UTM)
    save(model, tmp_path / "p" / "sparse" / "0")
    write_pictures(model, tmp_path / "p" / "images")
    return tmp_path / "p", np.array([model.points3D[i].xyz for i in sorted(model.points3D)])


@pytest.mark.parametrize("program", ["gsplat", "3dgs", "nerfstudio", "instant-ngp", None])
def test_trainers_get_far_models_about_the_origin(far, tmp_path, program):
    project, xyz = far
    made = export_model(project, tmp_path / "out", program, unscaled=True)
    root = ElementTree.parse(tmp_path / "out" / "metadata.xml").getroot()
    offset = np.array([float(value) for value in root.find("SRSOrigin").text.split(",")])
    assert json.loads((tmp_path / "out" / "export.json").read_text())["offset_in_world"] == offset.tolist()
    assert any("SRSOrigin" in note for note in map(str, made.notes))
    got = ply_points(tmp_path / "out" / "sparse_pc.ply")
    np.testing.assert_allclose(got + offset, xyz, atol=1e-6)
    model = pycolmap.Reconstruction()
    model.read_binary(str(tmp_path / "out" / "sparse" / "0"))
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-5
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    for frame in frames:
        image = model.find_image_with_name(frame["file_path"].removeprefix("images/"))
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], image.projection_center(), atol=1e-8)


def test_far_points_keep_their_precision_in_files_of_points(far, tmp_path):
    project, xyz = far
    export_model(project, tmp_path / "ply", "ply", unscaled=True)
    np.testing.assert_array_equal(ply_points(tmp_path / "ply" / "points.ply"), xyz)
    pytest.importorskip("pygltflib")
    export_model(project, tmp_path / "gltf", "gltf", unscaled=True)
    data = (tmp_path / "gltf" / "scene.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    content, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
    root = content["nodes"][content["scenes"][0]["nodes"][0]]
    (place,) = (content["nodes"][i] for i in root["children"])
    points = next(content["nodes"][i] for i in place["children"] if content["nodes"][i].get("name") == "points")
    accessor = content["accessors"][content["meshes"][points["mesh"]]["primitives"][0]["attributes"]["POSITION"]]
    start = content["bufferViews"][accessor["bufferView"]]["byteOffset"]
    stored = np.frombuffer(buffer, "<f4", 3 * accessor["count"], start).reshape(-1, 3).astype(float)
    np.testing.assert_allclose(stored + place["translation"], xyz, atol=1e-6)


def test_near_exports_have_no_offset(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    write_pictures(model, tmp_path / "p" / "images")
    made = export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    assert not (tmp_path / "out" / "metadata.xml").exists()
    assert "offset_in_world" not in json.loads((tmp_path / "out" / "export.json").read_text())
    assert any("never scaled" in note for note in map(str, made.notes))
    assert not any("refused" in note for note in map(str, made.notes))


@pytest.mark.parametrize("lens", ["PINHOLE", "SIMPLE_RADIAL"])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_alpha_is_kept_whether_pictures_are_resampled_or_not(tmp_path, lens, ending):
    params = [140, 140, 80, 60] if lens == "PINHOLE" else [140, 80, 60, 0.02]
    camera = pycolmap.Camera(camera_id=1, model=lens, width=WIDTH, height=HEIGHT, params=params)
    model = build([f"{i}.{ending}" for i in range(8)], camera=camera)
    save(model, tmp_path / "p" / "sparse" / "0")
    picture = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    picture[..., 3] = np.where(np.arange(WIDTH) < WIDTH // 2, 0, 255)
    (tmp_path / "p" / "images").mkdir()
    for image in model.images.values():
        cv2.imwrite(str(tmp_path / "p" / "images" / image.name), picture)
    export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    for path in (tmp_path / "out" / "images").iterdir():
        shown = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert shown.shape[2] == 4
        middle = shown.shape[1] // 2
        assert (shown[:, : middle - 4, 3] == 0).all() and (shown[:, middle + 4 :, 3] == 255).all()


@pytest.mark.parametrize(
    "mask", ["masks/{}", "mask/{}.png", "images_masks/{}", "segmentation/{}", "mattes/{}", "images/{}.mask.png"]
)
def test_masks_are_named(tmp_path, mask):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    write_pictures(model, tmp_path / "p" / "images")
    for image in model.images.values():
        path = tmp_path / "p" / mask.format(image.name)
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 255, np.uint8))
    made = export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    (note,) = [note for note in map(str, made.notes) if "masks" in note]
    assert "not exported" in note and str(tmp_path / "p" / mask.partition("/")[0]) in note


def test_pictures_whose_names_say_mask_are_no_masks(tmp_path):
    model = build([f"mask_{i}.png" for i in range(8)])
    save(model, tmp_path / "p" / "sparse" / "0")
    write_pictures(model, tmp_path / "p" / "images")
    made = export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    assert not any("masks" in note for note in map(str, made.notes))


@pytest.mark.parametrize("kind", ["palette", "grey", "lossless", "lossy"])
def test_alpha_of_other_formats_is_kept(tmp_path, kind):
    """Colours of a palette of which one is transparent, grey with alpha, WebP."""
    from PIL import Image

    grey = np.full((HEIGHT, WIDTH), 90, np.uint8)
    seen = np.where(np.arange(WIDTH) < WIDTH // 2, 0, 255).astype(np.uint8) * np.ones((HEIGHT, 1), np.uint8)
    ending = "webp" if kind.startswith("loss") else "png"
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[140, 80, 60, 0.02])
    model = build([f"{i}.{ending}" for i in range(8)], camera=camera)
    save(model, tmp_path / "p" / "sparse" / "0")
    (tmp_path / "p" / "images").mkdir()
    if kind == "palette":
        picture = Image.fromarray((seen // 255).astype(np.uint8)).convert("P")
        picture.putpalette([255, 0, 0, 90, 90, 90] + [0] * 762)
        more = {"transparency": 0}
    elif kind == "grey":
        picture, more = Image.merge("LA", (Image.fromarray(grey), Image.fromarray(seen))), {}
    else:
        channels = [Image.fromarray(grey)] * 3
        picture, more = Image.merge("RGBA", [*channels, Image.fromarray(seen)]), {"lossless": kind == "lossless"}
    for image in model.images.values():
        picture.save(tmp_path / "p" / "images" / image.name, **more)
    export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    for path in (tmp_path / "out" / "images").iterdir():
        shown = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert shown.shape[2] == 4
        middle = shown.shape[1] // 2
        assert (shown[:, : middle - 4, 3] == 0).all() and (shown[:, middle + 4 :, 3] == 255).all()
        assert np.abs(shown[:, middle + 4 :, :3].astype(int) - 90).max() <= 3


@pytest.mark.parametrize("name", ["../images/{}", "/data/set/images/{}", "C:\\set\\images\\{}", "a/../{}", "{}"])
def test_pictures_are_found_whatever_their_names_lead_to(tmp_path, name):
    names = [f"{i:03}.png" for i in range(8)]
    model = build([name.format(n) for n in names])
    save(model, tmp_path / "p" / "sparse" / "0")
    (tmp_path / "p" / "images").mkdir()
    for n in names:
        cv2.imwrite(str(tmp_path / "p" / "images" / n), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    export_model(tmp_path / "p", tmp_path / "out", "gsplat", unscaled=True)
    assert len(list((tmp_path / "out" / "images").iterdir())) == len(names)


@pytest.mark.parametrize("ending", [".webp", ".jp2"])
def test_pictures_of_other_formats_are_read(tmp_path, ending):
    picture = np.full((64, 96, 3), 90, np.uint8)
    picture[:, 40:] = 200
    ok, data = cv2.imencode(ending, picture)
    if not ok:
        pytest.skip(f"OpenCV writes no {ending} here")
    (tmp_path / f"a{ending}").write_bytes(data.tobytes())
    image = read_image(tmp_path / f"a{ending}")
    assert image.shape == (64, 96, 3) and np.abs(image.astype(int) - picture).max() < 12


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"\0\0\0\x18ftypheic" + bytes(90), "is a HEIF or AVIF image"),
        (b"\xff\x0a" + bytes(range(90)), "is a JPEG XL image"),
        (b"GIF89a" + bytes(90), "is a GIF image"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        (b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        ", "is a macOS metadata file"),
        (bytes(4000), "holds only zeros"),
    ],
)
def test_pictures_that_are_none_are_called_what_they_are(tmp_path, data, match):
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(FormatError, match=match):
        read_image(tmp_path / "a.jpg")


def test_view_matrices_are_of_the_first_and_last_row():
    """A camera that moves to its right and turns about its axis of view, by a closed form."""
    view = View(
        name="a.png",
        camera=CameraModel(model="PINHOLE", width=100, height=50, params=(80.0, 80.0, 50.0, 25.0)),
        cam_from_world_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        cam_in_world=np.array([1.0, 2.0, 3.0]),
    )
    still = View(
        name="b.png", camera=view.camera, cam_from_world_xyzw=view.cam_from_world_xyzw, cam_in_world=np.zeros(3)
    )
    moved = Exposure(
        velocity_in_cam_m_s=np.array([0.5, 0.0, 0.0]),
        angular_velocity_in_cam_rad_s=np.array([0.0, 0.0, 2.0]),
        exposure_s=0.01,
        readout_s=0.02,
        late_s=0.001,
    )
    made = view_matrices([view, still], {"a.png": moved})["frames"]
    for name, t in (("viewmats", 0.001 - 0.01), ("viewmats_rs", 0.001 + 0.01)):
        angle = 2.0 * t
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        matrix = np.array(made[0][name])
        np.testing.assert_allclose(matrix[:3, :3], turn, atol=1e-12)
        np.testing.assert_allclose(-matrix[:3, :3].T @ matrix[:3, 3], [1 + 0.5 * t, 2, 3], atol=1e-12)
    assert made[1]["viewmats"] == made[1]["viewmats_rs"] and made[0]["readout_s"] == 0.02


def test_a_strangers_folder_is_left_alone(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "link").symlink_to(tmp_path)
    with pytest.raises(OutputExistsError, match="is not empty; choose another output folder"):
        Workspace(tmp_path / "theirs").prepare(tmp_path / "capture", "reconstruct")
