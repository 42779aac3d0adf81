"""Calibrations of multi-aperture cameras, captures that hold them, and the frames made of them."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError, InertialError, OutputExistsError
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.core.options import ApertureOptions, FuseAperturesOptions, ReconstructOptions
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.capture_images import SubImages
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.rig_calibration import read_rig_calibration
from colmap_inertial.run.commands.images_alone import fuse_aperture_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.stages.apertures import ApertureStage
from colmap_inertial.tools.simulate import MotionOptions, SceneRecipe, ShutterCamera
from colmap_inertial.tools.simulate.aperture_array import write_aperture_capture
from tests.helpers.aperture_scenes import plane_views, psnr_db
from tests.helpers.cases import loop_over

ROTATION = so3_exp(np.array([0.02, -0.03, 0.01]))
SHIFT = np.array([-0.01, 0.001, 0.0005])
SMALL = ApertureOptions(threads=1, disparity_px=(0.0, 10.0))


def kalibr_text(**changes) -> str:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = ROTATION, SHIFT
    camera = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "distortion_coeffs": [0.1, -0.2, 0.001, 0.002],
        "intrinsics": [500.0, 501.0, 159.5, 119.5],
        "resolution": [320, 240],
    }
    return json.dumps({"cam0": camera, "cam1": {**camera, "T_cn_cnm1": pose.tolist(), **changes}})


def test_kalibr_s_camchain_is_read(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(kalibr_text())
    known = read_rig_calibration(path)
    camera = known.camera("cam1")
    assert known.length_unit == "m"
    assert camera.model == "OPENCV" and camera.size == (320, 240)
    assert camera.params == (500.0, 501.0, 160.0, 120.0, 0.1, -0.2, 0.001, 0.002)
    assert np.allclose(camera.cam_from_rig[:3, :3], ROTATION)
    assert np.allclose(camera.cam_from_rig[:3, 3], SHIFT)


def test_each_camera_of_kalibr_s_chain_hangs_on_the_one_before_it(tmp_path):
    chain = json.loads(kalibr_text())
    further = np.eye(4)
    further[:3, :3], further[:3, 3] = so3_exp(np.array([0.1, -0.2, 0.05])), [0.03, 0.0, 0.01]
    chain["cam2"] = {**chain["cam1"], "T_cn_cnm1": further.tolist()}
    (tmp_path / "camchain.yaml").write_text(json.dumps(chain))
    known = read_rig_calibration(tmp_path / "camchain.yaml")
    whole = further @ np.array(chain["cam1"]["T_cn_cnm1"])
    assert np.allclose(known.camera("cam2").cam_from_rig, whole)


def test_opencv_s_yaml_is_read_as_opencv_writes_it(tmp_path):
    path = tmp_path / "rig.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    matrix = np.array([[500.0, 0, 159.5], [0, 501.0, 119.5], [0, 0, 1]])
    for name, coefficients in (("left", np.zeros((1, 5))), ("right", np.array([[0.1, -0.2, 0.0, 0.0, 0.05]]))):
        storage.startWriteStruct(name, cv2.FileNode_MAP)
        storage.write("image_width", 320)
        storage.write("image_height", 240)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", coefficients)
        if name == "right":
            storage.write("R", ROTATION)
            storage.write("T", 1000 * SHIFT)
        storage.endWriteStruct()
    storage.release()
    known = read_rig_calibration(path, unit="mm")
    assert known.camera("left").model == "OPENCV"
    right = known.camera("right")
    assert right.model == "FULL_OPENCV"
    assert right.params[4:] == (0.1, -0.2, 0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
    assert np.allclose(right.cam_from_rig[:3, 3], SHIFT)
    # the same camera sees the same point in the same place
    points = np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.5]])
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array([0.1, -0.2, 0.0, 0.0, 0.05]))
    camera = pycolmap.Camera(model=right.model, width=320, height=240, params=right.params)
    assert np.allclose(camera.img_from_cam(points) - 0.5, wanted[:, 0])


def test_opencv_s_stereo_sample_is_read(tmp_path):
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in {
        "M1": np.eye(3) * 400,
        "D1": np.zeros((1, 5)),
        "M2": np.eye(3) * 410,
        "R": ROTATION,
        "T": SHIFT,
    }.items():
        storage.write(key, value)
    storage.release()
    known = read_rig_calibration(path)
    assert known.camera("2").params[0] == 410
    assert known.camera("2").size is None
    assert np.allclose(known.camera("2").cam_from_rig[:3, 3], SHIFT)


def test_colmap_s_rigs_are_read_as_colmap_writes_them(tmp_path):
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number, name in ((1, "PINHOLE"), (2, "OPENCV"), (3, "SIMPLE_RADIAL_FISHEYE")):
        camera = pycolmap.Camera.create_from_model_name(number, name, 500.0, 320, 240)
        model.add_camera(camera)
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(ROTATION), number * SHIFT))
    model.add_rig(rig)
    folder = tmp_path / "sparse"
    folder.mkdir()
    model.write_binary(str(folder))
    known = read_rig_calibration(folder)
    assert known.length_unit == "model"
    assert list(known.cameras) == ["1", "2", "3"]
    assert known.camera("2").model == "OPENCV"
    assert known.camera("3").size == (320, 240)
    assert np.allclose(known.camera("3").cam_from_rig[:3, 3], 3 * SHIFT)
    assert np.allclose(known.camera("3").cam_from_rig[:3, :3], ROTATION)
    assert read_rig_calibration(folder, unit="mm").length_unit == "m"

    cut = tmp_path / "cut"
    cut.mkdir()
    for name in ("rigs.bin", "cameras.bin"):
        (cut / name).write_bytes((folder / name).read_bytes()[:-9])
    with pytest.raises(FormatError, match="truncated"):
        read_rig_calibration(cut)


def test_colmap_s_rig_config_is_read_as_colmap_reads_it(tmp_path):
    path = tmp_path / "rig_config.json"
    turned = pycolmap.Rotation3d(ROTATION).quat  # x, y, z, w
    cameras = [
        {"image_prefix": "a/", "ref_sensor": True, "camera_model_name": "PINHOLE", "camera_params": [5, 5, 3, 2]},
        {
            "image_prefix": "b/",
            "camera_model_name": "PINHOLE",
            "camera_params": [5, 5, 3, 2],
            "cam_from_rig_rotation": np.roll(turned, 1).tolist(),
            "cam_from_rig_translation": SHIFT.tolist(),
        },
    ]
    path.write_text(json.dumps([{"cameras": cameras}]))
    known = read_rig_calibration(path)
    theirs = pycolmap.read_rig_config(path)[0].cameras[1]
    assert np.allclose(known.camera("b").cam_from_rig[:3], theirs.cam_from_rig.matrix())
    path.write_text(json.dumps([{"cameras": [{k: v for k, v in cameras[0].items() if k != "camera_params"}]}]))
    with pytest.raises(FormatError, match="camera_params are missing"):
        read_rig_calibration(path)


@loop_over(
    ("text", "reason"),
    [
        (kalibr_text(distortion_model="fov"), "distortion_model 'fov' is not supported"),
        (kalibr_text(intrinsics=[1, 2, 3]), "intrinsics must hold 4 numbers, found 3"),
        (kalibr_text(T_cn_cnm1=(2 * np.eye(4)).tolist()), "holds no rotation"),
        (kalibr_text(intrinsics=["a", 2, 3, 4]), "not a list of numbers"),
        (kalibr_text().replace("T_cn_cnm1", "T_x"), "T_cn_cnm1 .* is missing"),
        ("a: 1", "holds no calibration of several cameras"),
        (
            "a: {camera_matrix: [1, 0, 0, 0, 1, 0, 0, 0, 1], R: [1, 0, 0, 0, 1, 0, 0, 0, 1]}",
            "R and T must be given together",
        ),
        ("[1, 2]", "expected keys and values"),
        ("a: [", "not valid YAML"),
    ],
)
def test_what_is_wrong_with_a_calibration_is_said(tmp_path, text, reason):
    path = tmp_path / "camchain.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=reason):
        read_rig_calibration(path)


FIRST = {"image_prefix": "a/", "ref_sensor": True, "camera_model_name": "PINHOLE", "camera_params": [5, 5, 3, 2]}
SECOND = FIRST | {
    "image_prefix": "b/",
    "ref_sensor": False,
    "cam_from_rig_rotation": [1, 0, 0, 0],
    "cam_from_rig_translation": [1, 2, 3],
}


@loop_over(
    ("rigs", "reason"),
    [
        ([{"cameras": [FIRST, SECOND | {"cam_from_rig_rotation": [1, 0, 0, 0.1]}]}], "b: .*unit quaternion"),
        ([{"cameras": [FIRST, SECOND | {"cam_from_rig_rotation": [1, 0, 0]}]}], "must hold 4 numbers"),
        ([{"cameras": [FIRST, SECOND | {"camera_model_name": "LENS"}]}], "camera model 'LENS' is unknown"),
        ([{"cameras": [FIRST, SECOND | {"camera_params": [5, 3, 2]}]}], "must hold 4 numbers"),
        ([{"cameras": [FIRST | {"camera_model_name": None}]}], "camera_model_name and camera_params are missing"),
        ([{"cameras": [FIRST]}, {"cameras": [SECOND]}], "describes 2 rigs"),
        ({"cameras": [FIRST]}, "not a rig_config.json"),
        ([], "not a rig_config.json"),
    ],
)
def test_what_is_wrong_with_a_rig_config_is_said(tmp_path, rigs, reason):
    path = tmp_path / "rig_config.json"
    path.write_text(json.dumps([{"cameras": [FIRST, SECOND]}]))
    for unit, factor in ((None, 1), ("m", 1), ("mm", 1e-3)):
        known = read_rig_calibration(path, unit=unit)
        assert np.allclose(known.camera("b").cam_from_rig[:3, 3], factor * np.array([1, 2, 3]))
        assert known.length_unit == ("model" if unit is None else "m")
    path.write_text(json.dumps(rigs))
    with pytest.raises(FormatError, match=reason):
        read_rig_calibration(path)


def sensor(kind, number, pose=None):
    """A sensor of a rig, as COLMAP writes it, but for the first without a place."""
    known = b"" if pose is None else struct.pack("<B7d", 1, *pose)
    return struct.pack("<iI", kind, number) + known


STRAIGHT = (1, 0, 0, 0, 1, 2, 3)
CAMERAS = struct.pack("<Q", 2) + b"".join(struct.pack("<IiQQ4d", number, 1, 64, 48, 5, 5, 3, 2) for number in (1, 2))
RIG = struct.pack("<QII", 1, 1, 2) + sensor(0, 1) + sensor(0, 2, STRAIGHT)


@loop_over(
    ("cameras", "rigs", "reason"),
    [
        (None, RIG, "cameras.bin: is missing"),
        (CAMERAS, None, "rigs.bin: is missing"),
        (CAMERAS[:8] + struct.pack("<Ii", 1, 99) + CAMERAS[16:], RIG, "camera model 99 is unknown"),
        (CAMERAS, struct.pack("<QII", 1, 1, 2) + sensor(0, 1) + sensor(0, 2) + bytes(1), "camera 2 has no pose"),
        (CAMERAS, struct.pack("<QII", 1, 1, 1) + sensor(0, 1), "holds 0 rigs of several cameras"),
        (CAMERAS, struct.pack("<Q", 2) + 2 * RIG[8:], "holds 2 rigs of several cameras"),
        (
            CAMERAS,
            struct.pack("<QII", 1, 1, 2) + sensor(0, 1) + sensor(0, 7, STRAIGHT),
            "camera 7 of the rig is missing",
        ),
        (CAMERAS, RIG[:-1], "rigs.bin: truncated"),
        (CAMERAS[:-1], RIG, "cameras.bin: truncated"),
    ],
)
def test_what_is_wrong_with_a_model_s_rig_is_said(tmp_path, cameras, rigs, reason):
    for name, content in (("cameras.bin", CAMERAS), ("rigs.bin", RIG)):
        (tmp_path / name).write_bytes(content)
    known = read_rig_calibration(tmp_path, unit="mm")
    assert known.camera("2").params == (5, 5, 3, 2) and known.camera("2").size == (64, 48)
    assert np.allclose(known.camera("2").cam_from_rig[:3, 3], [1e-3, 2e-3, 3e-3])
    # an IMU is a sensor, too, and no camera
    imu = struct.pack("<QII", 1, 1, 3) + sensor(0, 1) + sensor(1, 9, STRAIGHT) + sensor(0, 2, STRAIGHT)
    (tmp_path / "rigs.bin").write_bytes(imu)
    assert list(read_rig_calibration(tmp_path).cameras) == ["1", "2"]
    for name, content in (("cameras.bin", cameras), ("rigs.bin", rigs)):
        (tmp_path / name).unlink()
        if content is not None:
            (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=reason):
        read_rig_calibration(tmp_path)


def test_a_calibration_of_no_known_format_is_refused(tmp_path):
    with pytest.raises(FormatError) as refused:
        read_rig_calibration(tmp_path / "x.txt")
    assert refused.value.code == "no-rig-calibration"
    with pytest.raises(FormatError, match=r"rigs.bin.*is missing"):
        read_rig_calibration(tmp_path)
    path = tmp_path / "camchain.yaml"
    path.write_text(kalibr_text())
    with pytest.raises(FormatError, match="no camera 'cam7'; it has cam0, cam1"):
        read_rig_calibration(path).camera("cam7")


# --- captures -------------------------------------------------------------------------------------------------------


def write_plane_capture(folder: Path, *, exposures: int = 2) -> list[np.ndarray]:
    """A capture of a plane, in one folder, calibrated as OpenCV writes it; returns the sub-images."""
    planes, _, rig = plane_views(160, 120, 5.0, (0.01, 0.0))
    (folder / "pictures").mkdir(parents=True)
    for e in range(exposures):
        for i, plane in enumerate(planes):
            cv2.imwrite(str(folder / "pictures" / f"shot{e}_{i}.png"), plane)
    entries = {}
    for i, aperture in enumerate(rig.apertures):
        fx, fy, cx, cy = aperture.camera.params
        entries[f"c{i}"] = {
            "camera_matrix": [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1],
            "image_width": 160,
            "image_height": 120,
            "R": np.eye(3).tolist(),
            "T": (-aperture.cam_in_rig).tolist(),
        }
    (folder / "rig.yaml").write_text(json.dumps(entries))
    lines = ["[images]", 'folder = "pictures"', 'pattern = "*_0.png"', "[apertures]", 'calibration = "rig.yaml"']
    for i, aperture in enumerate(rig.apertures):
        lines += [f"[apertures.{aperture.name}]", f'role = "{aperture.role}"', f'camera = "c{i}"']
        lines += [] if i == 0 else [f'rename = ["_0.", "_{i}."]']
    (folder / "capture.toml").write_text("\n".join(lines) + "\n")
    return planes


def changed(folder: Path, old: str, new: str) -> Path:
    path = folder / "capture.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def test_a_capture_s_apertures_are_its_camera(tmp_path):
    write_plane_capture(tmp_path)
    capture = load_capture(tmp_path)
    assert capture.apertures is not None
    assert capture.camera == capture.apertures.rig.reference.camera
    assert capture.camera.params[2:4] == (80.0, 60.0)
    assert capture.apertures.rig.names == ("green", "red", "blue", "luminance")
    names = [p.name for p in capture.apertures.files(["shot0_0.png"])]
    assert names == ["shot0_1.png", "shot0_2.png", "shot0_3.png"]


@loop_over(
    ("old", "new", "reason"),
    [
        ('camera = "c1"', 'camera = "c9"', "no camera 'c9'"),
        ('role = "red"', 'role = "rde"', "must be one of 'red'"),
        ('role = "red"', "", "role is missing"),
        ('calibration = "rig.yaml"', "", "calibration is missing"),
        ('calibration = "rig.yaml"', 'calibration = "no.yaml"', "no such file"),
        ('rename = ["_0.", "_1."]', "", "the same images as the reference"),
        ('rename = ["_0.", "_1."]', 'rename = "x"', "must be two strings"),
        ('camera = "c1"', 'camera = "c0"', "at the same place"),
        ('camera = "c0"', 'camera = "c0"\nfolder = "elsewhere"', "that of .images. for the reference"),
        (
            "[apertures]",
            '[camera]\nmodel = "PINHOLE"\nwidth = 160\nheight = 120\nparams = [1, 1, 1, 1]\n'
            'pixel_origin = "corner"\n[apertures]',
            "gives the camera by its calibration",
        ),
    ],
)
def test_what_is_wrong_with_the_apertures_is_said(tmp_path, old, new, reason):
    write_plane_capture(tmp_path)
    with pytest.raises(FormatError, match=reason):
        load_capture(changed(tmp_path, old, new))


def test_apertures_need_pictures_in_a_folder(tmp_path):
    write_plane_capture(tmp_path)
    path = tmp_path / "capture.toml"
    text = path.read_text()
    path.write_text(text[text.index("[apertures]") :])
    with pytest.raises(FormatError, match=r"needs \[images\]"):
        load_capture(path)


def test_names_are_replaced_at_their_end():
    source = SubImages(folder=Path("f"), rename=("_1.", "_2."))
    assert source.path("a_1.b_1.tif") == Path("f/a_1.b_2.tif")
    with pytest.raises(FormatError, match="does not occur"):
        source.path("a_3.tif")


def test_exposures_are_fused_to_pictures_of_the_reference_s_names(tmp_path):
    planes = write_plane_capture(tmp_path / "capture")
    out = tmp_path / "out"
    options = FuseAperturesOptions(fusion=replace(SMALL, depth=True), refocus=1.0)
    steps = []
    written = fuse_aperture_capture(tmp_path / "capture", out, options, progress=lambda *step: steps.append(step))
    assert [p.name for p in written] == ["shot0_0.png", "shot1_0.png"]
    assert steps[-1] == ("fusing", 2, 2)
    picture = cv2.imread(str(written[0]))
    assert psnr_db(picture[16:-16, 16:-16, 1], planes[0][16:-16, 16:-16]) > 40
    depth = np.load(out / "depth" / "shot0_0.png.npy")
    disparity = np.load(out / "disparity" / "shot0_0.png.npy")
    assert depth.shape == disparity.shape == (120, 160) and depth.dtype == np.float32
    assert np.nanmedian(depth * disparity) == pytest.approx(500 * 0.01, rel=1e-4)
    assert (out / "refocused" / "shot1_0.png").is_file()
    # started again there is nothing to do; without depths, those are taken away where that is asked for
    before = written[0].stat().st_mtime_ns
    assert fuse_aperture_capture(tmp_path / "capture", out, options) == written
    assert written[0].stat().st_mtime_ns == before
    with pytest.raises(OutputExistsError, match=r"fusion.depth = False \(was True\)"):
        fuse_aperture_capture(tmp_path / "capture", out, replace(options, fusion=SMALL))
    assert (out / "depth").is_dir()
    fuse_aperture_capture(tmp_path / "capture", out, replace(options, fusion=SMALL), overwrite=True)
    assert not (out / "depth").exists() and (out / "refocused").is_dir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputExistsError):
        fuse_aperture_capture(tmp_path / "capture", tmp_path / "other", options)


def test_a_stopped_fusion_is_gone_on_with(tmp_path):
    write_plane_capture(tmp_path / "capture", exposures=2)

    def stop(stage, done, total, /):
        raise KeyboardInterrupt

    options = FuseAperturesOptions(fusion=replace(SMALL, depth=True))
    with pytest.raises(KeyboardInterrupt):
        fuse_aperture_capture(tmp_path / "capture", tmp_path / "out", options, progress=stop)
    assert not (tmp_path / "out" / "images").exists()
    fuse_aperture_capture(tmp_path / "capture", tmp_path / "out", options)
    fuse_aperture_capture(tmp_path / "capture", tmp_path / "whole", options)
    for kind in ("images", "depth", "disparity"):
        one, two = ({p.name: p.read_bytes() for p in (tmp_path / o / kind).iterdir()} for o in ("out", "whole"))
        assert one == two and len(one) == 2
    assert not list((tmp_path / "out").glob("*.partial*"))


def test_sub_images_of_another_size_or_depth_are_named(tmp_path):
    write_plane_capture(tmp_path, exposures=1)
    small = tmp_path / "pictures" / "shot0_2.png"
    whole = cv2.imread(str(small), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(small), whole[:100])
    with pytest.raises(FormatError, match=r"shot0_2.png: is 160x100, but blue is calibrated for 160x120"):
        fuse_aperture_capture(tmp_path, tmp_path / "a", progress=lambda *_: None)
    cv2.imwrite(str(small), whole.astype(np.uint16))
    with pytest.raises(FormatError, match="write all with the same depth"):
        fuse_aperture_capture(tmp_path, tmp_path / "b", progress=lambda *_: None)
    small.unlink()
    with pytest.raises(FormatError, match=r"shot0_2.png: no such file"):
        fuse_aperture_capture(tmp_path, tmp_path / "c", progress=lambda *_: None)


def test_a_rig_without_a_colour_is_said_before_the_work(tmp_path):
    write_plane_capture(tmp_path, exposures=1)
    changed(tmp_path, 'role = "blue"', 'role = "other"')
    with pytest.raises(InertialError, match=r"blue is missing among green \(green\), red \(red\), blue \(other\)"):
        fuse_aperture_capture(tmp_path, tmp_path / "out", progress=lambda *_: None)


def test_a_simulated_capture_goes_through_the_stage(tmp_path):
    model = CameraModel(
        model="OPENCV", width=160, height=120, params=(300.0, 300.0, 80.0, 60.0, 0.05, -0.08, 5e-4, -3e-4)
    )
    recipe = SceneRecipe(
        format="png",
        camera=ShutterCamera(model=model, exposure_s=0.001),
        motion=MotionOptions(duration_s=2.0, radius_m=0.69, height_m=0.4, arc_deg=60.0, sweep_s=6.0),
        frame_rate_hz=1.0,
    )
    toml = write_aperture_capture(recipe, tmp_path / "capture")
    capture = load_capture(toml)
    assert capture.apertures is not None and vars(capture.camera) == vars(model)
    assert capture.imu is not None
    timing, frames = read_frames(capture)
    stage = ApertureStage(pictures=capture.apertures, options=ApertureOptions(threads=1), keep=tmp_path / "kept")
    fused = list(stage(frames))
    assert [frame.name for frame in fused] == list(timing.names)
    for frame in fused:
        wanted = cv2.imread(str(tmp_path / "capture" / "frames_rgb" / frame.name))[..., ::-1]
        folders = ("frames_red", "frames", "frames_blue")
        direct = np.stack([cv2.imread(str(tmp_path / "capture" / f / frame.name), 0) for f in folders], axis=-1)
        assert frame.camera is not None and frame.camera.params == model.params
        assert psnr_db(frame.image, wanted) > psnr_db(direct, wanted) + 8
        assert (tmp_path / "kept" / "depth" / f"{frame.name}.npy").is_file()


def test_reconstruct_fuses_before_it_looks_for_features_and_again_where_a_sub_image_changed(tmp_path):
    model = CameraModel(model="PINHOLE", width=160, height=120, params=(300.0, 300.0, 80.0, 60.0))
    recipe = SceneRecipe(
        format="png",
        camera=ShutterCamera(model=model, exposure_s=0.001),
        motion=MotionOptions(duration_s=2.0, radius_m=0.69, height_m=0.4, arc_deg=60.0, sweep_s=6.0),
        frame_rate_hz=3.0,
    )
    toml = write_aperture_capture(recipe, tmp_path / "capture")
    options = ReconstructOptions(apertures=ApertureOptions(threads=1, depth=True))

    def stop(stage, done, total, /):
        if stage == "features":
            raise KeyboardInterrupt

    out, alone = tmp_path / "out", tmp_path / "alone"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(toml, out, options, progress=stop)
    fuse_aperture_capture(toml, alone, FuseAperturesOptions(fusion=options.apertures), progress=lambda *_: None)
    names = sorted(path.name for path in (alone / "images").iterdir())
    assert len(names) == 6 and {f"{name}.npy" for name in names} == {
        p.name for p in (out / "apertures/depth").iterdir()
    }
    before = {name: (out / "colmap" / "images" / name).read_bytes() for name in names}
    assert before == {name: (alone / "images" / name).read_bytes() for name in names}
    red = tmp_path / "capture" / "frames_red" / names[2]
    cv2.imwrite(str(red), 255 - cv2.imread(str(red), cv2.IMREAD_UNCHANGED))
    with pytest.raises(KeyboardInterrupt):
        reconstruct(toml, out, options, progress=stop)
    assert [name for name in names if (out / "colmap" / "images" / name).read_bytes() != before[name]] == [names[2]]
