"""A camera that slides past near things without turning: its blur is found by its pixels, and undone."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.geometry import quat_exp, quat_from_matrix, quat_multiply
from colmap_inertial.core.progress import silent
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.recording import Recording, prior_calibration
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import reduce_frames
from colmap_inertial.motion.lateral_flow import FollowedPair, follow_pairs
from colmap_inertial.run.commands.images_alone import deblur_capture
from colmap_inertial.run.preparation import plan as imaging, translation as looked_at
from colmap_inertial.run.preparation.plan import Treatments, plan_imaging
from colmap_inertial.tools.simulate.motion import MARGIN_S, Motion
from tests.helpers.corner_scene import CALIBRATED, LENS, PLANES, CornerScene
from tests.helpers.frame_readers import readers
from tests.helpers.turning_cameras import PINHOLE, turning

FRAMES, EXPOSURE_S = 18, 0.025
#: From the wall, and to and fro along it: a metre a second at the quickest.
AWAY_M, REACH_M, PERIOD_S = 1.2, 0.35, 2.0
#: The camera's axes in the world: right, down, and into the wall.
FACING_THE_WALL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def sliding(*, exposure_s=EXPOSURE_S, reach_m=REACH_M, frames=FRAMES):
    """The tests' corner, past whose far wall a camera slides to and fro; its turns blur by a fraction of a pixel."""
    room = CornerScene.make(exposure_s=exposure_s, readout_s=0.0, frames=frames)
    t_s = np.arange(-MARGIN_S, frames / 3 + MARGIN_S, 1 / 60)
    phase = 2 * np.pi * t_s / PERIOD_S
    wall_m = next(place for axis, place in PLANES if axis == 1)
    at = np.column_stack(
        [reach_m * np.sin(phase), wall_m - AWAY_M + 0.05 * np.sin(0.37 * phase), 0.3 + 0.1 * np.cos(0.6 * phase)]
    )
    tilt = 0.02 * np.sin(phase[:, None] * [0.7, 0.5, 0.9])
    facing = quat_multiply(np.broadcast_to(quat_from_matrix(FACING_THE_WALL), (len(tilt), 4)), quat_exp(tilt))
    motion = Motion(start_s=-MARGIN_S, step_s=1 / 60, cam_in_world_m=at, world_from_cam_xyzw=facing)
    return replace(room, motion=motion)


def planned(folder, scratch):
    capture = load_capture(folder)
    recording = Recording.of(
        capture, read_capture_imu(capture), read_frames(capture)[0], prior_calibration(capture, None)
    )
    return plan_imaging(recording, *readers(recording, scratch), RunContext(scratch=scratch), Treatments())


def psnr_db(folder, sharp):
    """Of each picture of a folder against the sharp ones, away from the border."""
    off = []
    for path, true in zip(sorted(folder.iterdir()), sharp, strict=True):
        difference = (cv2.imread(str(path))[:, :, ::-1] - true.astype(float))[12:-12, 12:-12]
        off.append(-10 * np.log10(np.mean(difference**2) / 255**2))
    return np.array(off)


def test_a_camera_that_slides_past_a_wall_is_found_and_its_frames_become_sharper(tmp_path):
    scene = sliding()
    capture = scene.write(tmp_path / "capture", extra=CALIBRATED)
    made = deblur_capture(capture, tmp_path / "out", progress=silent)
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    # of frames with less than 2 px of blur nobody asks
    assert stored["imaging"]["frames_with_translation"] >= FRAMES - 2
    sharp = [scene.picture(i, noise=0.0, sharp=True) for i in range(FRAMES)]
    predicted = np.array([frame["blur_px"] for frame in stored["frames"]])
    assert (predicted > 5).sum() > FRAMES / 3
    at = np.stack(np.meshgrid(np.linspace(20, 380, 9), np.linspace(20, 280, 7)), axis=-1).reshape(-1, 2)
    true = [np.percentile(np.linalg.norm(scene.true_blur(i, at), axis=1), 90) for i in range(FRAMES)]
    np.testing.assert_allclose(predicted, true, atol=0.3)
    gained = psnr_db(made.workspace.images, sharp) - psnr_db(capture / "frames", sharp)
    assert np.median(gained[predicted > 5]) > 1.4 and gained[predicted > 3].min() > 0


@pytest.mark.parametrize(
    ("exposure_s", "reach_m", "followed"),
    [(0.004, REACH_M, False), (EXPOSURE_S, 0.05, True)],
    ids=["in bright light", "hardly moving"],
)
def test_no_small_model_is_made_where_sliding_blurs_nothing(tmp_path, monkeypatch, exposure_s, reach_m, followed):
    seen = []

    def watched(frames, *rest):
        seen.append(rest)
        return follow_pairs(frames, *rest)

    def never(*_):
        raise AssertionError("a small model was made")

    monkeypatch.setattr(looked_at, "follow_pairs", watched)
    monkeypatch.setattr(imaging, "survey", never)
    capture = sliding(exposure_s=exposure_s, reach_m=reach_m, frames=8).write(tmp_path / "capture", extra=CALIBRATED)
    plan = planned(capture, tmp_path)
    assert not plan.parallaxes and plan.deblur_note.code == "blur-nowhere"
    assert bool(seen) == followed == plan.deblur_note.values["by_sliding"]


@pytest.mark.parametrize("rate_rad_s", [(0.0, 0.0, 0.0), (-0.1, 0.3, 0.2)], ids=["still", "turning"])
def test_what_the_gyroscope_felt_is_taken_out_of_how_points_move(rate_rad_s):
    motion, camera = turning(rate_rad_s), colmap_camera(PINHOLE)
    shutters = tuple(FrameShutter(width=640, height=480, t_s=t_s, exposure_s=0.02) for t_s in (1.0, 1.1))
    first = np.stack(np.meshgrid(np.arange(40.0, 600, 80), np.arange(40.0, 440, 80)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([np.asarray(camera.cam_from_img(first))[:, :2], np.ones(len(first))])
    turn = motion.start_from_cam(np.array([1.11]))[0].T @ motion.start_from_cam(np.array([1.01]))[0]
    # two metres away, at half a metre a second to the right
    seen = rays @ turn.T
    second = np.asarray(camera.img_from_cam(seen - seen[:, 2:] * [0.5 / 2 * 0.1, 0, 0]))
    second[0] += 200  # one that was followed wrongly
    pair = FollowedPair(name="a", shutters=shutters, points=np.stack([first, second]))
    expected = 0.5 / 2 * PINHOLE.params[0]
    assert pair.speed_px_s(camera, motion) == pytest.approx(expected, rel=1e-3)
    assert (pair.speed_px_s(camera) > 1.3 * expected) == any(rate_rad_s)
    late = tuple(replace(shutter, t_s=shutter.t_s + 1000) for shutter in shutters)
    assert np.isnan(replace(pair, shutters=late).speed_px_s(camera, motion))
    assert np.isnan(replace(pair, points=pair.points[:, :20]).speed_px_s(camera))


def test_points_are_followed_from_the_frames_that_are_named_to_the_ones_after_them():
    scene = sliding(exposure_s=0.004, frames=4)
    capture = [Frame(name=f"{i:04}.jpg", image=scene.picture(i), t_s=scene.shutter(i).t_s) for i in range(4)]
    timing = FrameTiming(
        names=tuple(frame.name for frame in capture), t_s=np.array([frame.t_s for frame in capture]),
        exposure_s=np.full(4, 0.004), readout_s=0.0,
    )  # fmt: skip
    found = list(follow_pairs(reduce_frames(capture), timing, {"0000.jpg", "0002.jpg"}))
    assert [pair.name for pair in found] == ["0000.jpg", "0002.jpg"]
    for i, pair in zip((0, 2), found, strict=True):
        true = np.linalg.norm(scene.centres()[i + 1] - scene.centres()[i]) * LENS.params[0] / AWAY_M * 3.2
        assert pair.speed_px_s(colmap_camera(LENS)) == pytest.approx(true, rel=0.15)
    # what lies between them was not decoded: nothing to follow
    assert not list(follow_pairs(reduce_frames([capture[0], capture[2]]), timing, {"0000.jpg"}))
