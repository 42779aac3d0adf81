"""What a capture holds beside the IMU, joined with its images by name or by time."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.types import FrameTiming
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frame_sources import ImageFolder, image_names
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.run.preparation.sensors import find_sensors
from tests.io.test_depth_maps import MAPS, PATH, T_NS, WRITERS

#: Where each export has its images, and how they are named.
IMAGES = {
    "Record3D": ("rgbd", [f"{k}.jpg" for k in range(6)]),
    "Polycam": ("keyframes/images", [f"{t // 1000}.jpg" for t in T_NS]),
    "nerfstudio": ("images", [f"{name}.png" for name in MAPS.names]),
}


def no_size():
    raise AssertionError("the export says which size its maps are of")


@pytest.mark.parametrize("app", IMAGES)
def test_an_export_without_an_imu_is_a_capture_with_its_own_sensors(app: str, tmp_path: Path):
    WRITERS[app](tmp_path / "export")
    folder, names = IMAGES[app]
    (tmp_path / "export" / folder).mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(tmp_path / "export" / folder / name), np.zeros((72, 96), np.uint8))
    capture = load_capture(tmp_path / "export")
    assert capture.imu is None and isinstance(capture.frames, ImageFolder)
    assert sorted(image_names(capture.frames)) == sorted(names)
    found = find_sensors(capture, names, no_size, timing=None)
    assert found.depth is not None and set(found.depth.names) == set(names)
    np.testing.assert_allclose(
        found.depth.read(names[2]).depth_m[:30], MAPS.read(MAPS.names[2]).depth_m[:30], atol=1e-3
    )
    assert len(found.files) > 0 and found.fixes is None and found.absent == ()
    if app == "nerfstudio":  # its poses may be of any unit
        assert found.device is None
        with pytest.raises(InertialError) as error:
            find_sensors(capture, names, no_size, timing=None, chosen=("device",))
        assert error.value.fact.code == "sensor-not-there"
        return
    assert found.device is not None and found.device.names == tuple(names)
    np.testing.assert_allclose(found.device.cam_in_world, PATH.cam_in_world, atol=1e-6)
    np.testing.assert_array_equal(found.up_in_device, (0, 1, 0))
    alone = find_sensors(capture, names, no_size, timing=None, chosen=("device",))
    assert alone.depth is None and alone.device is not None


def test_frames_of_a_recorder_are_met_by_time(tmp_path: Path):
    WRITERS["Stray Scanner"](tmp_path / "export")
    rows = [f"frame_{k}.png,{T_NS[k] + 1_000_000}" for k in (1, 2, 4)]
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames.csv").write_text("name,t_ns\n" + "\n".join(rows) + "\n")
    described = '[images]\nfolder = "frames"\ntimes = "frames.csv"\n[imu]\npath = "export"\n'
    (tmp_path / "capture.toml").write_text(described)
    capture = load_capture(tmp_path / "capture.toml")
    assert capture.poses is not None and capture.poses.path == tmp_path / "export"
    names = ("frame_1.png", "frame_2.png", "frame_4.png")
    timing = FrameTiming(names=names, t_s=np.array([1.001, 2.001, 4.001]), epoch_ns=5_000_000_000)
    found = find_sensors(capture, names, no_size, timing=timing)
    assert found.device is not None and found.depth is not None
    np.testing.assert_allclose(found.device.cam_in_world, PATH.cam_in_world[[1, 2, 4]], atol=1e-6)
    np.testing.assert_allclose(
        found.depth.read("frame_4.png").depth_m[:30], MAPS.read(MAPS.names[4]).depth_m[:30], atol=1e-3
    )
    # a name that happens to be one of the app's is not taken for it
    others = replace(timing, names=(MAPS.names[0], "b.png", "c.png"))
    found = find_sensors(capture, others.names, no_size, timing=others)
    assert found.device is not None
    np.testing.assert_allclose(found.device.cam_in_world[0], PATH.cam_in_world[1], atol=1e-6)


def write_depth(folder: Path, names, values: np.ndarray) -> None:
    folder.mkdir()
    for name in names:
        cv2.imwrite(str(folder / name), values)


def test_described_maps_have_the_stated_unit_and_their_confidence(tmp_path: Path):
    (tmp_path / "images").mkdir()
    values = np.full((36, 48), 2000, np.uint16)
    sure = np.full((36, 48), 255, np.uint8)
    sure[:9] = 100
    write_depth(tmp_path / "maps", ["a_depth.png", "b_depth.png"], values)
    write_depth(tmp_path / "sure", ["a_depth.png"], sure)
    for unit, metres in (('unit = "mm"', 2.0), ("metres_per_step = 0.0002", 0.4)):
        (tmp_path / "capture.toml").write_text(
            f'[images]\nfolder = "images"\n[depth]\nfolder = "maps"\npattern = "{{stem}}_depth.png"\n{unit}\n'
            'confidence = "sure"\n'
        )
        capture = load_capture(tmp_path / "capture.toml")
        found = find_sensors(capture, ["a.jpg", "b.jpg", "c.jpg"], lambda: (96, 72), timing=None)
        assert found.depth is not None and found.depth.names == ("a.jpg", "b.jpg")
        depth_m = found.depth.read("a.jpg").depth_m
        np.testing.assert_allclose(depth_m[9:], metres)
        assert np.isnan(depth_m[:9]).all() and not np.isnan(found.depth.read("b.jpg").depth_m).any()


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ("", "depth-without-unit"),
        ('unit = "mm"\nmetres_per_step = 0.001', "depth-without-unit"),
        ('unit = "mm"\npattern = "depth.png"', "depth-pattern-without-stem"),
        ('unit = "mm"\npattern = "../{stem}.png"', "depth-pattern-without-stem"),
    ],
)
def test_what_is_not_said_of_maps_is_asked_for(tmp_path: Path, table: str, code: str):
    (tmp_path / "capture.toml").write_text(f'[images]\nfolder = "images"\n[depth]\nfolder = "maps"\n{table}\n')
    with pytest.raises(FormatError) as error:
        load_capture(tmp_path / "capture.toml")
    assert error.value.fact.values["fault"].code == code


def test_a_path_in_tum_format_is_metric_and_has_the_stated_vertical(tmp_path: Path):
    write_tum(tmp_path / "path.tum", PATH)
    (tmp_path / "capture.toml").write_text('[images]\nfolder = "images"\n[poses]\npath = "path.tum"\nup = "z"\n')
    capture = load_capture(tmp_path / "capture.toml")
    timing = FrameTiming(names=tuple("abcdef"), t_s=PATH.t_s, epoch_ns=PATH.epoch_ns)
    found = find_sensors(capture, timing.names, no_size, timing=timing)
    assert found.device is not None and found.device.names == timing.names and found.device.length_unit == "m"
    np.testing.assert_array_equal(found.up_in_device, (0, 0, 1))
    (tmp_path / "path.tum").unlink()
    with pytest.raises(FormatError):
        find_sensors(capture, timing.names, no_size, timing=timing)
