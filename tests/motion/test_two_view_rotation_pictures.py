"""How a camera turned between pictures seconds apart; whether a gyroscope belongs to a folder of them."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.core.types import CameraModel, Frame, FrameTiming
from colmap_inertial.diagnose import Recorded, diagnose
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.motion.flow import reduce_frames
from colmap_inertial.motion.two_view_rotation import (
    _estimate_rotation,
    _Features,
    _match_descriptors,
    measure_two_view_rotations,
)
from colmap_inertial.tools.simulate.render import colmap_camera
from tests.diagnose.test_diagnose import imu_of, run
from tests.helpers.far_scene import FarScene

LENS = CameraModel(model="PINHOLE", width=320, height=240, params=(250.0, 250.0, 160.0, 120.0))
SECONDS, STEP_S = 12.0, 0.4


@pytest.fixture(scope="module")
def scene() -> FarScene:
    return FarScene.make(duration_s=SECONDS, vigour=0.6)


@pytest.fixture(scope="module")
def taken(scene: FarScene) -> tuple[list[Frame], FrameTiming]:
    """Pictures twice a second."""
    t_s = np.arange(0.3, SECONDS - 0.5, STEP_S)
    names = tuple(f"{i:03}.png" for i in range(len(t_s)))
    timing = FrameTiming(names=names, t_s=t_s, exposure_s=np.full(len(t_s), 0.001), readout_s=0.0)
    shutters = [FrameShutter.of(timing, i, width=LENS.width, height=LENS.height) for i in range(len(t_s))]
    return [
        Frame(name=name, image=scene.picture(LENS, shutter), t_s=shutter.t_s)
        for name, shutter in zip(names, shutters, strict=True)
    ], timing


def test_rotations_between_pictures_are_those_of_the_camera(
    scene: FarScene, taken: tuple[list[Frame], FrameTiming]
) -> None:
    frames, timing = taken
    found = measure_two_view_rotations(reduce_frames(frames, 320), colmap_camera(LENS), timing)
    poses = scene.wall_from_cam(timing.pose_t_s())
    true = np.stack([so3_log(a.T @ b) for a, b in itertools.pairwise(poses)])
    known = np.isfinite(found.turn_rad).all(axis=1)
    assert known.mean() > 0.8
    off = np.linalg.norm(found.turn_rad - true, axis=1)[known]
    assert np.median(off) < 0.005 and off.max() < 0.05
    assert np.median(np.linalg.norm(true, axis=1)) > 10 * np.median(off)


def test_the_camera_s_translation_does_not_count_as_rotation() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-2, 2, (400, 2)), rng.uniform(2, 6, 400)])
    turn, moved = so3_exp(np.array([0.03, -0.12, 0.05])), np.array([0.6, 0.1, 0.2])
    descriptors = rng.uniform(0, 255, (400, 128)).astype(np.float32)

    def seen(in_camera: np.ndarray) -> _Features:
        rays = in_camera[:, :2] / in_camera[:, 2:] + rng.normal(0, 2e-4, (400, 2))
        wrong = rng.permutation(400)[:60]
        rays[wrong] = rng.uniform(-0.7, 0.7, (60, 2))
        return _Features(rays, descriptors, 1e-3)

    # first_from_second: x_first = turn x_second + moved
    found = _estimate_rotation(seen(points), seen((points - moved) @ turn))
    assert found is not None
    assert np.linalg.norm(so3_log(found[0] @ turn.T)) < 0.01
    assert _estimate_rotation(seen(points), _Features(np.zeros((5, 2)), descriptors[:5], 1e-3)) is None


def test_a_folder_of_pictures_is_compared_with_the_gyroscope(
    scene: FarScene, taken: tuple[list[Frame], FrameTiming], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, timing = taken
    (tmp_path / "images").mkdir()
    for frame in frames:
        cv2.imwrite(str(tmp_path / "images" / frame.name), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    rows = zip(timing.names, timing.t_s.tolist(), strict=True)
    (tmp_path / "times.csv").write_text("\n".join(["name,t_s", *(f"{name},{t_s:.6f}" for name, t_s in rows)]))
    capture = (
        '[images]\nfolder = "images"\ntimes = "times.csv"\n[timing]\nreadout_s = 0\n[imu]\npath = "imu.csv"\n'
        '[camera]\nmodel = "PINHOLE"\nwidth = 320\nheight = 240\n'
        'params = [250, 250, 160, 120]\npixel_origin = "corner"\n'
    )
    (tmp_path / "capture.toml").write_text(capture)
    imu = imu_of(scene, seconds=SECONDS)
    table = np.column_stack([imu.gyro_t_s, np.radians(imu.gyro_rad_s), imu.accel_m_s2])[::4]
    header = "t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
    np.savetxt(tmp_path / "imu.csv", table, delimiter=",", header=header, comments="", fmt="%.7g")
    assert run("diagnose", tmp_path / "capture.toml", "--json", tmp_path / "found.json") == 1
    assert "not checked" not in capsys.readouterr().out
    told = json.loads((tmp_path / "found.json").read_text())
    assert "pictures far apart" in told["checked"]
    assert [f["code"] for f in told["findings"] if f["severity"] == "error"] == ["gyro-not-in-deg"]
    # the same pictures with the right numbers, and with those of another motion
    rotation = measure_two_view_rotations(reduce_frames(frames, 320), colmap_camera(LENS), timing)
    recorded = Recorded(imu=imu, rotation=rotation, timing=timing, camera=LENS, is_capture=True)
    assert diagnose(recorded).findings == ()
    other = replace(imu, gyro_rad_s=imu.gyro_rad_s[::-1])
    assert diagnose(replace(recorded, imu=other)).codes == {"imu-does-not-fit"}


def test_descriptors_are_matched_as_by_opencv():
    rng = np.random.default_rng(4)
    first = rng.integers(0, 180, (300, 128)).astype(np.float32)
    second = np.clip(first[rng.permutation(300)] + rng.integers(-90, 91, (300, 128)), 0, 255).astype(np.float32)
    second[:60] = first[:60]  # some have a second one that is as near, or nearly
    neighbours = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    wanted = [(best.queryIdx, best.trainIdx) for best, other in neighbours if best.distance < 0.8 * other.distance]
    assert 60 < len(wanted) < 300
    assert _match_descriptors(first, second).tolist() == [list(pair) for pair in wanted]
