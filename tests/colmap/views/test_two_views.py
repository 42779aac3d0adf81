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

CAMERA = pycolmap.Camera(model="PINHOLE", width=752, height=480, params=[458, 458, 376, 240])
CAMERA.has_prior_focal_length = True
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


def see_room(rng):
    """Points of a floor and two walls."""
    floor = np.column_stack([rng.uniform(-3, 3, 4000), np.full(4000, 1.2), rng.uniform(0.5, 6, 4000)])
    back = np.column_stack([rng.uniform(-3, 3, 2000), rng.uniform(-2, 1.2, 2000), np.full(2000, 6)])
    left = np.column_stack([np.full(1500, -3), rng.uniform(-2, 1.2, 1500), rng.uniform(0.5, 6, 1500)])
    return np.concatenate([floor, back, left])


def see_wall(rng):
    """Points of a wall."""
    return np.column_stack([rng.uniform(-4, 4, 4000), rng.uniform(-3, 3, 4000), np.full(4000, 2.0)])


def match_views(path, world_from_cam, centre, pairs, noise_px=0.3, see=see_room, most=200):
    """A database of features with noise, and of matches, a twentieth of them wrong, as COLMAP verifies them."""
    rng = np.random.default_rng(4)
    points = see(rng)
    names = tuple(f"{k:04}.png" for k in range(len(centre)))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    seen = []
    with pycolmap.Database.open(str(path)) as database:
        camera = database.write_camera(CAMERA)
        images = [database.write_image(pycolmap.Image(name=name, camera_id=camera)) for name in names]
        for image, rotation, at in zip(images, world_from_cam, centre, strict=True):
            there = (points - at) @ rotation
            before = np.flatnonzero(there[:, 2] > 0.3)
            xy_px = CAMERA.img_from_cam(there[before])
            kept = ((xy_px > 0) & (xy_px < [CAMERA.width, CAMERA.height])).all(axis=1) & (rng.random(len(xy_px)) < 0.7)
            xy_px = xy_px[kept] + noise_px * rng.standard_normal((int(kept.sum()), 2))
            database.write_keypoints(image, xy_px.astype(np.float32))
            seen.append((before[kept], xy_px))
        for i, j in pairs:
            _, first, second = np.intersect1d(seen[i][0], seen[j][0], return_indices=True)
            some = rng.permutation(len(first))[:most]
            matches = np.column_stack([first, second])[some].astype(np.uint32)
            wrong = rng.random(len(matches)) < 0.05
            matches[wrong, 1] = rng.integers(0, len(seen[j][0]), int(wrong.sum()))
            views = pycolmap.estimate_calibrated_two_view_geometry(
                CAMERA, seen[i][1], CAMERA, seen[j][1], matches, options
            )
            database.write_two_view_geometry(images[i], images[j], views)
    return names


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
