"""Captures of two cameras that are fixed to each other: described, paired, mapped as COLMAP's rig, and refused."""

import json
import shutil

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.colmap.matching.rigs import find_rig_poses, write_rig
from colmap_inertial.core.errors import FormatError, InertialError, MappingError, TimingError
from colmap_inertial.core.geometry import quat_exp, quat_multiply, so3_exp
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.capture_rig import RigCamera, rig_files
from colmap_inertial.io.frame_sources import ImageFolder, Video
from colmap_inertial.io.frames import picture_folders, read_frames
from colmap_inertial.io.rig_frames import pair_rig_frames
from colmap_inertial.model import read_model
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.tools.simulate import MotionOptions
from tests.helpers.box_video import FOCAL, HEIGHT, WIDTH, film, film_beside

#: Second camera from the first, in metres.
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = so3_exp(np.array([0.0, 0.12, 0.04])), (-0.11, 0.004, 0.01)
BASELINE_M = float(np.linalg.norm(POSE[:3, 3]))
FRAMES_PER_S = 3
CAMERA = (
    f'model = "SIMPLE_PINHOLE"\nwidth = {WIDTH}\nheight = {HEIGHT}\n'
    f'params = [{FOCAL}, {WIDTH / 2}, {HEIGHT / 2}]\npixel_origin = "corner"\n'
)
SPARE = ReconstructOptions(
    deterministic=True,
    mapping=MappingOptions(max_num_features=350, first_octave=0, pairing="sequential", overlap=5),
)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Two videos of one motion, ``clip.mp4`` and ``clip_right.mp4``. Tests change nothing."""
    video = film(
        tmp_path_factory.mktemp("filmed") / "box",
        MotionOptions(kind="orbit", duration_s=8.0),
        frame_rate_hz=FRAMES_PER_S,
        exposure_s=0.002,
        seed=2,
    )
    film_beside(video, "right", POSE)
    return video


def capture_of(filmed, folder, rig):
    """A capture of the videos with this ``[rig]`` table."""
    shutil.copytree(filmed.folder, folder)
    toml = folder / "capture.toml"
    text = toml.read_text().replace("[video]", f"[video]\nframes_per_s = {FRAMES_PER_S}")
    toml.write_text(f"{text}{rig}")
    return toml


def right(pose="", camera=CAMERA):
    """The table of the second video."""
    return f'[rig.right]\nvideo = "clip_right.mp4"\n{pose}[rig.right.camera]\n{camera}'


KNOWN = right(f"cam_from_reference = {POSE.tolist()}\n")


@pytest.fixture(scope="module")
def known(filmed, tmp_path_factory):
    root = tmp_path_factory.mktemp("known")
    return reconstruct(capture_of(filmed, root / "capture", KNOWN), root / "out", SPARE)


def test_two_videos_become_one_metric_model(filmed, known):
    (model,) = known.models
    assert model.scale.verdict == "trusted", model.scale.reasons
    # with declared poses COLMAP's model is in metres already, which the IMU confirms
    assert abs(np.log(model.scale.metres_per_unit)) < 4e-3
    assert model.scale.ci95[0] < 1 < model.scale.ci95[1]
    names = {image.name for image in read_model(model.sparse_metric).images.values()}
    assert len(names) == 2 * len(filmed.t_s) and sum(name.startswith("right/") for name in names) == len(filmed.t_s)
    said = json.loads(known.workspace.result.read_text())
    assert said["matching"]["images"] == said["models"][0]["registered_images"] == len(names)


def test_declared_poses_are_kept_and_said_in_metres(known):
    (sensor,) = known.models[0].rig
    scale = known.models[0].scale.metres_per_unit
    np.testing.assert_allclose(sensor.translation_m, scale * POSE[:3, 3], rtol=1e-9)
    turned = quat_multiply(np.array(sensor.cam_from_reference_xyzw), quat_exp(np.array([0.0, -0.12, -0.04])))
    np.testing.assert_allclose(np.abs(turned), [0, 0, 0, 1], atol=1e-9)
    page = known.report.read_text().replace("\N{NO-BREAK SPACE}", " ")
    assert f"camera 2 is {1000 * sensor.baseline_m:.1f} mm from camera 1" in page


def test_database_and_model_have_the_same_rig(known):
    with pycolmap.Database.open(str(known.workspace.colmap_database)) as database:
        (rig,) = database.read_all_rigs()
        frames = database.read_all_frames()
    assert rig.num_sensors() == 2 and {len(list(frame.data_ids)) for frame in frames} == {2}
    model = read_model(known.models[0].sparse)
    assert {number: len(list(model.frame(number).data_ids)) for number in model.reg_frame_ids()} == {
        frame.frame_id: 2 for frame in frames
    }


def test_images_of_both_cameras_agree_with_the_model_byte_for_byte(known):
    seen, given = known.workspace.colmap_images, known.workspace.root / "images"
    for name in ("", "right"):
        files = sorted(path.name for path in (seen / name).glob("*.*"))
        assert len(files) == known.models[0].summary["registered_images"] // 2
        assert all((seen / name / file).read_bytes() == (given / name / file).read_bytes() for file in files)


def test_unknown_poses_are_found(filmed, tmp_path):
    made = reconstruct(capture_of(filmed, tmp_path / "capture", right()), tmp_path / "out", SPARE)
    (model,) = made.models
    assert model.scale.verdict == "trusted", model.scale.reasons
    (sensor,) = model.rig
    np.testing.assert_allclose(sensor.translation_m, POSE[:3, 3], atol=0.01 * BASELINE_M)
    turned = quat_multiply(np.array(sensor.cam_from_reference_xyzw), quat_exp(np.array([0.0, -0.12, -0.04])))
    np.testing.assert_allclose(np.abs(turned), [0, 0, 0, 1], atol=2e-3)


def test_what_is_not_done_with_a_rig_is_refused_before_anything(filmed, tmp_path, capsys):
    capture = capture_of(filmed, tmp_path / "capture", KNOWN)
    for options, words in (
        (ReconstructOptions(deblur="wiener"), "--deblur wiener"),
        (ReconstructOptions(rolling_shutter="rectify"), "--rolling-shutter rectify"),
        (ReconstructOptions(refine="inertial"), "--refine inertial"),
        (ReconstructOptions(mapping=MappingOptions(mapper="global")), "--mapping.mapper global"),
    ):
        with pytest.raises(InertialError, match=f"{words}: not supported for cameras of a rig"):
            reconstruct(capture, tmp_path / "out", options)
    for words in (
        ["deblur", str(capture), str(tmp_path / "out")],
        ["reconstruct", str(capture), str(tmp_path / "out")],
    ):
        more = ["--scale-from", "distance"] if words[0] == "reconstruct" else []
        with pytest.raises(SystemExit) as stop:
            main([*words, *more])
        assert stop.value.code != 0
    assert not (tmp_path / "out").exists()


def test_videos_that_are_not_synchronised_are_refused(filmed, tmp_path):
    times = "".join(f"{round(1e9 * (t + 0.04))}\n" for t in filmed.t_s)
    table = right('frame_times = "late.csv"\ntime_unit = "ns"\n')
    toml = capture_of(filmed, tmp_path / "capture", table)
    (toml.parent / "late.csv").write_text(times)
    with pytest.raises(TimingError, match=r"0 of the main camera's 24 frames .* 40 ms away .*triggered together"):
        reconstruct(toml, tmp_path / "out", SPARE)
    (toml.parent / "late.csv").write_text(times.partition("\n")[2])
    with pytest.raises(TimingError, match=r"has 23 times, the video .* has 24 frames"):
        reconstruct(toml, tmp_path / "out", SPARE)
    assert not (tmp_path / "out").exists()


# --- folders of pictures: described and paired ------------------------------------------------------------------------


@pytest.fixture
def folders(tmp_path):
    """Six pictures of each camera, the second one's named otherwise and one of them missing."""
    for folder in ("left", "other", "same"):
        (tmp_path / folder).mkdir()
    for k in range(6):
        picture = np.full((30, 40), 40 * k, np.uint8)
        cv2.imwrite(str(tmp_path / "left" / f"{k}.png"), picture)
        cv2.imwrite(str(tmp_path / "same" / f"{k}.png"), picture + 5)
        if k != 3:
            cv2.imwrite(str(tmp_path / "other" / f"b{k}.png"), picture + 9)
    (tmp_path / "left.csv").write_text("name,t_s\n" + "".join(f"{k}.png,{k / 10}\n" for k in range(6)))
    (tmp_path / "other.csv").write_text(
        "name,t_s\n" + "".join(f"b{k}.png,{k / 10 + 4e-4}\n" for k in range(6) if k != 3)
    )
    return tmp_path


def describe(folder, rig, more=""):
    path = folder / "capture.toml"
    path.write_text(f'[images]\nfolder = "left"\ntimes = "left.csv"\n{more}[imu]\npath = "imu.csv"\n{rig}')
    return path


def test_pictures_are_paired_by_times_or_by_names(folders):
    rig = '[rig.b]\nfolder = "other"\ntimes = "other.csv"\n[rig.c]\nfolder = "same"\n'
    capture = load_capture(describe(folders, rig))
    assert picture_folders(capture) == (folders / "left", folders / "other", folders / "same")
    timing, frames = read_frames(capture)
    pairs = pair_rig_frames(capture, timing)
    assert pairs.alone == ("3.png",)
    kept = [name for name in timing.names if name != "3.png"]
    keep = np.array([name in kept for name in timing.names])
    timing = type(timing)(names=tuple(kept), t_s=timing.t_s[keep], epoch_ns=timing.epoch_ns)
    assert pairs.originals(kept)["b/4.png"] == folders / "other" / "b4.png"
    frames = list(pairs.add_images(read_frames(capture, only=kept)[1], timing))
    assert [frame.name for frame in frames[:6]] == ["0.png", "b/0.png", "c/0.png", "1.png", "b/1.png", "c/1.png"]
    assert {frame.name for frame in frames} == {*kept, *pairs.names(kept)}
    for frame in frames:
        more = {"b": 9, "c": 5}.get(frame.name.partition("/")[0], 0)
        assert (frame.image == 40 * int(frame.name[-5]) + more).all() and frame.t_s == int(frame.name[-5]) / 10


def test_pairs_that_do_not_belong_together_are_refused(folders):
    def pair(rig):
        capture = load_capture(describe(folders, rig))
        return pair_rig_frames(capture, read_frames(capture)[0])

    with pytest.raises(TimingError, match=r"\[rig.b\]: 0 of the main camera's 6 frames .*under the same name in .*oth"):
        pair('[rig.b]\nfolder = "other"\n')
    (folders / "other.csv").write_text(
        "name,t_s\n" + "".join(f"b{k}.png,{k / 10 + 0.03}\n" for k in range(6) if k != 3)
    )
    with pytest.raises(TimingError, match="within 1 ms; of its 5 images the nearest one is 30 ms away"):
        pair('[rig.b]\nfolder = "other"\ntimes = "other.csv"\n')
    with pytest.raises(FormatError, match="no such folder"):
        pair('[rig.b]\nfolder = "nowhere"\n')
    for folder, first in (("begun", 0), ("ended", 3)):
        (folders / folder).mkdir()
        for k in range(first, first + 3):
            shutil.copy(folders / "same" / f"{k}.png", folders / folder)
    with pytest.raises(TimingError, match=r"\[rig\]: 0 of the main camera's 6 frames have an image of every camera"):
        pair('[rig.b]\nfolder = "begun"\n[rig.c]\nfolder = "ended"\n')


def test_a_change_of_a_camera_s_times_changes_the_inputs(folders):
    rig = '[rig.b]\nfolder = "other"\ntimes = "other.csv"\n'
    files = rig_files(load_capture(describe(folders, rig)).rig)
    assert folders / "other.csv" in files and folders / "other" / "b4.png" in files


KALIBR = """
cam0:
  camera_model: pinhole
  distortion_model: radtan
  intrinsics: [300.0, 300.0, 19.5, 14.5]
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [40, 30]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.2]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_model: radtan
  intrinsics: [310.0, 310.0, 19.5, 14.5]
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [40, 30]
"""


def test_a_calibration_of_all_cameras_gives_intrinsics_and_poses(folders):
    (folders / "camchain.yaml").write_text(KALIBR)
    rig = '[rig]\ncalibration = "camchain.yaml"\n{}[rig.b]\nfolder = "same"\ncamera = "{}"\n'
    capture = load_capture(describe(folders, rig.format("", "cam1")))
    assert capture.camera.params[0] == 300 and capture.rig[0].camera.params[0] == 310
    assert capture.camera.params[2] == 20  # COLMAP's origin
    np.testing.assert_allclose(capture.rig[0].cam_from_reference[:3, 3], [-0.2, 0, 0])
    capture = load_capture(describe(folders, rig.format('reference = "cam1"\n', "cam0")))
    assert capture.camera.params[0] == 310
    np.testing.assert_allclose(capture.rig[0].cam_from_reference[:3, 3], [0.2, 0, 0])
    with pytest.raises(FormatError, match="calibrates no camera 'cam7'; it has cam0, cam1"):
        load_capture(describe(folders, rig.format("", "cam7")))
    with pytest.raises(FormatError, match="'cam0' is the main camera in the calibration"):
        load_capture(describe(folders, rig.format("", "cam0")))
    with pytest.raises(FormatError, match=r"leave out \[camera\]"):
        load_capture(describe(folders, rig.format("", "cam1"), f"[camera]\n{CAMERA}"))


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        ("[rig]\n", r"needs a table \[rig.NAME\]"),
        ('[rig]\nreference = "cam0"\n[rig.b]\nfolder = "same"\n', "needs calibration"),
        ('[rig.b]\nfolder = "same"\nfolders = 1\n', 'did you mean "folder"'),
        ('[rig.b]\nvideo = "b.mp4"\nfolder = "same"\n', "unknown key"),
        ("[rig.b]\n", "folder is missing"),
        ('[rig."b c"]\nfolder = "same"\n', "becomes a folder"),
        ('[rig.b]\nfolder = "same"\ncam_from_reference = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n', "4x4"),
        ('[rig.b]\nfolder = "same"\ncamera = "cam1"\n', "must be a table"),
        ('[rig.b]\nfolder = "left"\ntimes = "left.csv"\n', "has the images of another camera"),
        ('[rig.b]\nfolder = "same"\n[rig.c]\nfolder = "same"\n', "has the images of another camera"),
        (
            f'[rig.b]\nfolder = "same"\ncam_from_reference = {POSE.tolist()}\n[rig.c]\nfolder = "same"\n',
            "of each camera, or of none",
        ),
    ],
)
def test_a_table_that_cannot_be_is_refused(folders, rig, words):
    with pytest.raises(FormatError, match=words):
        load_capture(describe(folders, rig))


def test_a_rig_is_not_also_an_array_of_apertures(folders):
    with pytest.raises(FormatError, match=r"not several of them"):
        load_capture(describe(folders, '[exposures]\nfolder = "other"\n[rig.b]\nfolder = "same"\n'))
    toml = folders / "capture.toml"
    toml.write_text('[imu]\npath = "imu.csv"\n[rig.b]\nfolder = "same"\n')
    with pytest.raises(FormatError, match="of the main camera, which is missing"):
        load_capture(toml)


# --- poses from a model without a rig ---------------------------------------------------------------------------------


def apart(turns, skip=()):
    """A model of two cameras without a rig: the second one turns against the first by a vector for each frame."""
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        params = [FOCAL, WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=params)
        model.add_camera_with_trivial_rig(camera)
    rng = np.random.default_rng(7)
    mounted = pycolmap.Rigid3d(POSE[:3])
    for k, turn in enumerate(turns):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=3)), rng.normal(size=3))
        other = pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(turn)), np.zeros(3)) * mounted * pose
        for number, name, its in ((1, f"{k}.png", pose), (2, f"right/{k}.png", other)):
            if name not in skip:
                image = pycolmap.Image(name=name, camera_id=number, image_id=2 * k + number)
                model.add_image_with_trivial_frame(image, its)
    return model


RIGHT = (RigCamera(name="right", frames=Video(file="right.mp4")),)


def test_poses_are_the_middle_of_all_frames():
    turns = np.random.default_rng(3).normal(0, 1e-3, (21, 3))
    turns[0] = [0.5, 0, 0]  # one that COLMAP placed wrong, and the first
    pose = find_rig_poses([apart(turns)], RIGHT)["right"]
    np.testing.assert_allclose(pose, POSE, atol=2e-3)


def test_cameras_that_are_not_fixed_or_never_together_are_refused():
    with pytest.raises(MappingError, match=r"rotates by .* deg against the main one from frame to frame"):
        find_rig_poses([apart(np.random.default_rng(3).normal(0, 0.02, (21, 3)))], RIGHT)
    few = apart(np.zeros((8, 3)), skip={f"right/{k}.png" for k in range(4)})
    with pytest.raises(MappingError, match=r"only 4 frames have its image .*too few .*give cam_from_reference"):
        find_rig_poses([few], RIGHT)


def test_images_of_a_camera_with_different_intrinsics_are_no_rig(tmp_path):
    with pycolmap.Database.open(str(tmp_path / "x.db")) as database:
        for number in (1, 2, 3):
            camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=4, height=3, params=[4, 2, 1.5])
            database.write_camera(camera, use_camera_id=True)
        for number, name, camera_id in ((1, "0.png", 1), (2, "right/0.png", 2), (3, "right/1.png", 3)):
            image = pycolmap.Image(name=name, camera_id=camera_id, image_id=number)
            database.write_image(image, use_image_id=True)
    rig = (RigCamera(name="right", frames=ImageFolder(folder=tmp_path)),)
    with pytest.raises(InertialError, match="images of right have 2 COLMAP cameras"):
        write_rig(tmp_path / "x.db", rig, {"right": POSE})
