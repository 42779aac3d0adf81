"""Names from outside never lead out of the folder that they belong to."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.progress import silent
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.io.capture_images import SubImages
from colmap_inertial.io.exif import stamps_of_exif
from colmap_inertial.io.files import check_names, path_in
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.model import read_model
from colmap_inertial.report.page import embed_images
from colmap_inertial.run.commands.dense_steps import _check_images
from colmap_inertial.run.preparation.frame_reading import GLANCED_AT, GreyFrames
from colmap_inertial.run.stages.frame_folder import FramePaths, write_frames, write_images
from colmap_inertial.tools.batch import read_manifest
from colmap_inertial.tools.view.sources import find_source
from colmap_inertial.validate.views import load_views
from tests.helpers import model_project
from tests.helpers.cases import loop_over

BAD = ["", ".", "/etc/passwd", "../a.png", "a/../../b.png", "a\\..\\b.png", "a\0.png", "x" * 256, "a/" + "\udfff" * 90]


@pytest.fixture(scope="module")
def model():
    return model_project.sparse_model(np.random.default_rng(4))


def written(model, folder, name, write="write_binary"):
    """The model, its first image under another name."""
    copy = pycolmap.Reconstruction(model)
    copy.image(1).name = name
    folder.mkdir(parents=True)
    getattr(copy, write)(str(folder))
    return folder


@loop_over("name", BAD)
def test_names_that_lead_away_are_refused_and_their_source_is_named(tmp_path, name):
    with pytest.raises(FormatError, match=r"images\.bin.*names the file"):
        check_names(["a.png", name], tmp_path / "images.bin")
    with pytest.raises(FormatError, match="names the file"):
        path_in(tmp_path, name)


@loop_over("name", ["a.png", "cam 0/Bild ü.png", "a..b/..c.png", "...x"])
def test_ordinary_names_pass_there_or_not(tmp_path, name):
    assert path_in(tmp_path, name) == tmp_path / name


def test_links_may_lead_to_the_folder_and_within_it_but_not_out_of_it(tmp_path):
    real = tmp_path / "real"
    (real / "cam0").mkdir(parents=True)
    (tmp_path / "link").symlink_to(real)
    (real / "cam1").symlink_to("cam0")
    (real / "out").symlink_to(tmp_path)
    (real / "gone.png").symlink_to(tmp_path / "nowhere.png")
    (real / "loop").symlink_to("loop")
    assert path_in(tmp_path / "link", "cam1/a.png") == tmp_path / "link" / "cam1" / "a.png"
    for name in ("out/a.png", "gone.png"):
        with pytest.raises(FormatError) as refused:
            path_in(tmp_path / "link", name, "model")
        assert refused.value.code == "link-leads-out"
    assert not path_in(real, "loop").is_file()


@loop_over("write", ["write_binary", "write_text"])
@loop_over("name", ["/abs.png", "../../up.png", "a/../../../x.png"])
def test_pictures_that_a_model_names_elsewhere_are_only_sought_in_their_folder(tmp_path, model, name, write):
    reconstruction = read_model(written(model, tmp_path / "model", name, write))
    assert name in {image.name for image in reconstruction.images.values()}
    images = tmp_path / "images"
    images.mkdir()
    for outside in (tmp_path / Path(name).name, tmp_path.parent / Path(name).name):
        outside.touch()
    assert picture_in(images, name) == images / Path(name).name


def test_readers_of_a_model_s_images_do_not_follow_links_out(tmp_path, model):
    folder = written(model, tmp_path / "model", "sub/000.png")
    pictures, secret = tmp_path / "images", tmp_path / "secret"
    for place in (pictures, secret):
        place.mkdir()
        for name in model_project.NAMES:
            blank = np.zeros((model_project.HEIGHT, model_project.WIDTH, 3), np.uint8)
            assert cv2.imwrite(str(place / name), blank)
    (pictures / "sub").symlink_to(secret)
    with pytest.raises(FormatError) as refused:
        _check_images(pictures, folder, read_model(folder))
    assert refused.value.code == "link-leads-out"
    with pytest.raises(FormatError) as refused:
        load_views(folder, pictures)
    assert refused.value.code == "link-leads-out"


def test_the_first_look_at_a_capture_does_not_follow_links_out(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for path in (folder / "0.png", tmp_path / "secret.png"):
        assert cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    (folder / "1.png").symlink_to(tmp_path / "secret.png")
    capture = SimpleNamespace(frames=ImageFolder(folder=folder), camera=None)
    timing = FrameTiming(names=("0.png", "1.png"), t_s=np.arange(2.0))
    frames = GreyFrames(capture, timing)
    assert next(frames.look(GLANCED_AT, ["0.png"])).name == "0.png"
    with pytest.raises(FormatError) as refused:
        list(frames.look(GLANCED_AT, ["1.png"]))
    assert refused.value.code == "link-leads-out"


def test_tables_and_captures_do_not_lead_out(tmp_path):
    with pytest.raises(FormatError, match=r'by "\.\."'):
        SubImages(folder=tmp_path, rename=("a_", "../b_")).path("a_1.png")
    with pytest.raises(FormatError, match=re.escape(str(tmp_path / "hostname"))):
        stamps_of_exif(tmp_path, ["/etc/hostname"])
    with pytest.raises(FormatError, match="names the file"):
        embed_images(tmp_path, ["../x.jpg"])


@pytest.mark.parametrize("name", ["../up.png", "out/up.png"])
def test_writers_stay_in_their_folder(tmp_path, name):
    target, source = tmp_path / "images", tmp_path / "source"
    source.mkdir()
    (tmp_path / "outside").mkdir()

    def linked(frames):
        (target / "out").symlink_to(tmp_path / "outside")
        yield from frames

    frames = iter([Frame(name=name, image=np.zeros((4, 4), np.uint8), t_s=0.0)])
    with pytest.raises(FormatError, match="names the file"):
        write_frames(frames, [name], [linked], FramePaths(source=None, images=target, records=tmp_path / "r"), silent)
    (source / "out").symlink_to(tmp_path / "outside")
    with pytest.raises(FormatError, match="names the file"):
        write_images([], [name], (), source, tmp_path / "rectified", silent)
    assert not list((tmp_path / "outside").iterdir())
    assert not (tmp_path / "up.png").exists()


def test_a_result_of_others_names_only_what_lies_in_its_folder(tmp_path, model):
    out = tmp_path / "out"
    (out / ".stages").mkdir(parents=True)
    written(model, tmp_path / "elsewhere", "000.png")
    record = {"index": 0, "registered_images": 6, "sparse": "../elsewhere", "sparse_metric": None, "verdict": "refused",
              "reasons": [], "metres_per_unit": None, "ci95": None, "gravity_in_world_m_s2": None}  # fmt: skip
    (out / "result.json").write_text(json.dumps({"models": [record]}))
    with pytest.raises(FormatError, match=r"result\.json.*names the file"):
        find_source(out)


@loop_over("name", ["..", "a/b", "/a", "x" * 300, "a\\u0000b"])
def test_a_batch_s_names_are_those_of_folders(tmp_path, name):
    manifest = tmp_path / "batch.toml"
    manifest.write_text(f'[[capture]]\npath = "a"\nname = "{name}"\n')
    with pytest.raises(FormatError, match="name"):
        read_manifest(manifest)
