"""A model whose numbers cannot be is refused by name, whatever would have read it."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import CameraModel
from colmap_inertial.model import colmap_camera, read_model
from colmap_inertial.tools.view import load_scene
from tests.helpers import model_project
from tests.helpers.cases import loop_over

BAD = [float("nan"), float("inf"), 1e300, -1e300]


@pytest.fixture(scope="module")
def model():
    return model_project.sparse_model(np.random.default_rng(4))


def saved(model, folder, suffix):
    folder.mkdir(parents=True)
    (model.write_text if suffix == ".txt" else model.write_binary)(str(folder))
    return folder


def refuses(reason, suffix, value):
    """COLMAP's own reader stops at a text that is no finite number; before 4.0.4 it is left to us."""
    own = suffix == ".txt" and not np.isfinite(value)
    return pytest.raises(FormatError, match=f"COLMAP cannot read this model|{reason}" if own else reason)


@loop_over("suffix", [".bin", ".txt"])
@loop_over("value", [*BAD, 0.0, -150.0])
@loop_over("index", [0, 1])
def test_focal_lengths_are_positive_numbers(tmp_path, model, suffix, value, index):
    copy = pycolmap.Reconstruction(model)
    params = np.array(copy.camera(1).params)
    params[index] = value
    copy.camera(1).params = params
    with refuses(
        r"cameras\.(bin|txt): camera 1 \(PINHOLE\) has impossible parameters: fx, fy, cx, cy = ", suffix, value
    ):
        read_model(saved(copy, tmp_path / "model", suffix))


@loop_over("suffix", [".bin", ".txt"])
@loop_over("value", BAD)
def test_poses_are_somewhere(tmp_path, model, suffix, value):
    copy = pycolmap.Reconstruction(model)
    pose = pycolmap.Rigid3d(copy.image(3).cam_from_world().rotation, np.array([0.0, value, 1.0]))
    copy.frame(copy.image(3).frame_id).rig_from_world = pose
    with refuses(r"images\.(bin|txt): the pose of '002.png' is impossible", suffix, value):
        read_model(saved(copy, tmp_path / "model", suffix))


@loop_over("suffix", [".bin", ".txt"])
@loop_over("value", BAD)
def test_points_are_somewhere(tmp_path, model, suffix, value):
    copy = pycolmap.Reconstruction(model)
    number = max(copy.point3D_ids())
    copy.points3D[number].xyz = np.array([0.0, 1.0, value])
    with refuses(rf"points3D\.(bin|txt): .*point {number} lies at 0, 1, ", suffix, value):
        read_model(saved(copy, tmp_path / "model", suffix))


def test_apply_and_view_say_so(tmp_path, model, capsys):
    copy = pycolmap.Reconstruction(model)
    copy.camera(1).params = [float("nan"), 150.0, 80, 60]
    folder = saved(copy, tmp_path / "project" / "sparse" / "0", ".bin")
    with pytest.raises(FormatError, match="camera 1"):
        load_scene(folder)
    with pytest.raises(SystemExit) as stopped:
        main(["apply", str(tmp_path / "project"), str(tmp_path / "out"), "--factor", "2"])
    assert stopped.value.code == 2 and "camera 1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


NAMES = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]


@loop_over("name", NAMES)
def test_every_camera_model_of_colmap_passes(tmp_path, name):
    count = len(pycolmap.Camera.create_from_model_name(1, name, 100.0, 160, 120).params)
    params = pycolmap.Camera.create_from_model_name(1, name, 100.0, 160, 120).params
    model = pycolmap.Reconstruction()
    camera = colmap_camera(CameraModel(model=name, width=160, height=120, params=tuple(map(float, params))))
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    assert len(read_model(saved(model, tmp_path / "model", ".bin")).camera(1).params) == count
