"""Matches of two images."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.views.gyro_orientations import estimate_gyro_orientations
from colmap_inertial.colmap.views.two_views import compare, match_quickly, read_ray_pairs, read_rotations_rad
from colmap_inertial.core.geometry import matrix_from_quat, so3_exp, so3_log
from colmap_inertial.core.types import FrameTiming, ImuRecording
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.recording import Recording
from tests.helpers.matched_views import match_views, see_wall

CAM_FROM_IMU = so3_exp(np.array([0.3, -1.2, 0.8]))
BIAS_RAD_S, OFFSET_S = np.array([0.01, -0.02, 0.015]), 0.03
#: A camera is carried for so long, and then put down.
MOVING_S, ALL_S = 4.0, 5.0


def test_single_descriptors_are_no_matches():
    one, many = np.full((1, 128), 45, np.uint8), np.eye(128, dtype=np.uint8)[:40] * 255
    assert [len(match_quickly(*pair)[0]) for pair in ((one, many), (many, one), (many[:0], many))] == [0, 0, 0]


def carry(t_s):
    """Orientations ``world_from_cam`` and centres, metres, of a camera that is carried by hand and put down."""
    rng = np.random.default_rng(2)
    frequency, phase = rng.uniform(0.15, 0.9, (2, 3, 4)), rng.uniform(0, 2 * np.pi, (2, 3, 4))
    way = np.minimum(t_s, MOVING_S) - 0.5 * np.clip(t_s - (MOVING_S - 1), 0, 1) ** 2
    wave = np.sin(2 * np.pi * frequency[:, None] * way[None, :, None, None] + phase[:, None]) / frequency[:, None]
    turn, centre = 0.03 * wave[0].sum(axis=2), 0.05 * wave[1].sum(axis=2)
    return so3_exp(turn), centre


def measure_gyroscope(t_s):
    """What the gyroscope of the carried camera says, with white noise."""
    step_s = t_s[1] - t_s[0]
    world_from_cam = carry(np.append(t_s, t_s[-1] + step_s) - 0.5 * step_s)[0]
    rate = so3_log(np.swapaxes(world_from_cam[:-1], 1, 2) @ world_from_cam[1:]) / step_s
    noise = 0.002 * np.random.default_rng(1).standard_normal(rate.shape)
    return ImuRecording(
        gyro_t_s=t_s - OFFSET_S,
        gyro_rad_s=rate @ CAM_FROM_IMU + BIAS_RAD_S + noise,
        accel_t_s=t_s - OFFSET_S,
        accel_m_s2=np.tile([0.0, 0.0, 9.8], (len(t_s), 1)),
    )


@pytest.mark.parametrize("rate_hz", [20, 60])
def test_the_gyroscope_is_found_by_frames_in_close_succession(tmp_path, rate_hz):
    """Pairs of them pass as views of a plane, and many rotations that COLMAP gives them are wrong by degrees."""
    t_s = np.arange(round(ALL_S * rate_hz)) / rate_hz
    world_from_cam, centre = carry(t_s)
    pairs = [(i, i + step) for i in range(len(t_s)) for step in (1, 2, 4) if i + step < len(t_s)]
    names = match_views(tmp_path / "d.db", world_from_cam, centre, pairs)
    turn_rad = read_rotations_rad(tmp_path / "d.db", names, pairs)
    timing = FrameTiming(names=names, t_s=t_s)
    recording = Recording(
        capture=None,
        imu=measure_gyroscope(np.arange(-1, ALL_S + 1, 0.005)),
        timing=timing,
        prior=calibration_prior(Declared()),
        every=timing,
        max_offset_s=1.0,
    )
    rays = read_ray_pairs(tmp_path / "d.db", names, pairs)
    found = estimate_gyro_orientations(recording, turn_rad, rays, None).calibration
    assert abs(found.gyro_time_offset_s - OFFSET_S) < 4 * found.clock_sigma_s < 0.05
    off = so3_log(CAM_FROM_IMU.T @ matrix_from_quat(found.cam_from_imu_xyzw))
    assert np.linalg.norm(off) < 4 * np.sqrt(3) * found.rotation_sigma_rad < 0.3


@pytest.mark.parametrize(("metres", "usual_deg"), [(0.0, 0.1), (0.05, 0.3)])
def test_rotations_of_a_camera_that_turns_or_moves_a_little_are_right(tmp_path, metres, usual_deg):
    """One that only turns is known by the homography, one that moves by the essential matrix."""
    rng = np.random.default_rng(6)
    axis = rng.standard_normal((2, 40, 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    world_from_cam = np.tile(np.eye(3), (80, 1, 1))
    world_from_cam[1::2] = so3_exp(np.radians(4) * axis[0])
    centre = np.zeros((80, 3))
    centre[1::2] = metres * axis[1]
    pairs = [(i, i + 1) for i in range(0, 80, 2)]
    names = match_views(tmp_path / "d.db", world_from_cam, centre, pairs)
    found = compare(tmp_path / "d.db", [(names[i], names[j]) for i, j in pairs]).first_from_second
    off_deg = np.degrees(np.linalg.norm(so3_log(np.swapaxes(world_from_cam[1::2], 1, 2) @ found), axis=1))
    assert np.median(off_deg) < usual_deg and np.mean(off_deg > 1) < 0.1


@pytest.mark.parametrize("metres", [0.05, 0.3])
def test_of_both_poses_of_a_wall_the_one_with_the_wall_in_front_is_right(tmp_path, metres):
    """Both suit all matches alike."""
    rng = np.random.default_rng(7)
    axis = rng.standard_normal((2, 20, 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    world_from_cam = np.tile(np.eye(3), (40, 1, 1))
    world_from_cam[1::2] = so3_exp(np.radians(4) * axis[0])
    centre = np.zeros((40, 3))
    centre[1::2] = metres * axis[1] * [1, 1, 0.3]
    pairs = [(i, i + 1) for i in range(0, 40, 2)]
    names = match_views(tmp_path / "d.db", world_from_cam, centre, pairs, see=see_wall)
    found = compare(tmp_path / "d.db", [(names[i], names[j]) for i, j in pairs]).first_from_second
    off_deg = np.degrees(np.linalg.norm(so3_log(np.swapaxes(world_from_cam[1::2], 1, 2) @ found), axis=1))
    assert np.mean(off_deg > 1) < 0.2


def test_matrices_that_another_tool_left_out_are_no_pose(tmp_path):
    centre = np.array([[0.0, 0, 0], [0.2, 0, 0]])
    names = match_views(tmp_path / "d.db", np.tile(np.eye(3), (2, 1, 1)), centre, [(0, 1)])
    for kind, kept in (("PLANAR", "E"), ("PLANAR", ""), ("CALIBRATED", "")):
        with pycolmap.Database.open(str(tmp_path / "d.db")) as database:
            ids = [image.image_id for image in database.read_all_images()]
            views = database.read_two_view_geometry(*ids)
            views.config = getattr(pycolmap.TwoViewGeometryConfiguration, kind)
            views.H = np.zeros((3, 3))
            views.F = np.zeros((3, 3))
            views.E = views.E if kept else np.zeros((3, 3))
            database.update_two_view_geometry(*ids, views)
        found = compare(tmp_path / "d.db", [names]).first_from_second[0]
        assert np.linalg.norm(so3_log(found)) < np.radians(1) if kept else not np.isfinite(found).any()
