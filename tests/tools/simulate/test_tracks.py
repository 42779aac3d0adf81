"""Simulated observations of points are where the camera projects them at the instant of their line."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate.tracks import TrackOptions, _add_vibration, simulate_tracks

WALK = TrackOptions(points_per_m=60.0)
WALK = replace(WALK, motion=replace(WALK.motion, duration_s=8.0))


def seen_at(tracks, t_s):
    """(M, 2) pixels and (M,) depths of the observed points at instants (M,)."""
    state = tracks.motion.at(t_s)
    away = tracks.point_m[tracks.point] - state.cam_in_world_m
    in_cam = np.einsum("nji,nj->ni", matrix_from_quat(state.world_from_cam_xyzw), away)
    return np.asarray(colmap_camera(tracks.camera).img_from_cam(in_cam)), in_cam[:, 2]


def test_each_point_is_seen_where_it_projects_when_its_line_exposes(subtests):
    for readout_s in (0.0, 0.03):
        with subtests.test(readout_s=readout_s):
            tracks = simulate_tracks(replace(WALK, readout_s=readout_s, noise_px=0.0), seed=1)
            # the first of 960 lines exposes at the frame's time
            t_s = tracks.timing.t_s[tracks.frame] + readout_s * (tracks.xy_px[:, 1] - 0.5) / 960
            xy, depth = seen_at(tracks, t_s)
            assert np.abs(xy - tracks.xy_px).max() < 1e-3 and depth.min() > 0.5
            assert (tracks.xy_px > 5).all() and (tracks.xy_px < [1275, 955]).all()
            if readout_s:
                at_once, _ = seen_at(tracks, tracks.timing.pose_t_s()[tracks.frame])
                assert np.linalg.norm(at_once - tracks.xy_px, axis=1).max() > 3


def test_points_are_followed_for_a_while_through_three_frames_or_more():
    tracks = simulate_tracks(WALK, seed=2)
    assert np.array_equal(np.unique(tracks.point), np.arange(len(tracks.point_m))) and len(tracks.point_m) > 60
    assert np.bincount(tracks.point).min() >= 3
    assert (np.diff(tracks.point) >= 0).all() and (np.diff(tracks.frame)[np.diff(tracks.point) == 0] > 0).all()
    # of those that stayed for three frames, half a second and 1.5 s more
    first = tracks.timing.t_s[tracks.frame[np.searchsorted(tracks.point, np.arange(len(tracks.point_m)))]]
    last = tracks.timing.t_s[tracks.frame[np.searchsorted(tracks.point, np.arange(len(tracks.point_m)), "right") - 1]]
    assert 0.8 < (last - first).mean() < 2.2
    xy, _ = seen_at(tracks, tracks.timing.pose_t_s()[tracks.frame])
    off = tracks.xy_px - xy
    assert off.std(axis=0) == pytest.approx([0.5, 0.5], rel=0.05) and np.abs(off.mean(axis=0)).max() < 0.05
    # beside the way, at all heights that a hand passes
    path = tracks.motion.cam_in_world_m(np.linspace(0, 8, 400))
    away = np.linalg.norm(tracks.point_m[:, None] - path, axis=2).min(axis=1)
    assert away.max() < np.hypot(7.0, 1.6)


def test_the_model_and_the_database_hold_what_was_seen(tmp_path):
    tracks = simulate_tracks(WALK, seed=3)
    model = tracks.reconstruction()
    assert model.num_reg_images() == len(tracks.timing.names) and model.num_points3D() == len(tracks.point_m)
    assert model.compute_num_observations() == len(tracks.frame)
    for xyz, error in [(point.xyz, model.points3D[i].track.length()) for i, point in model.points3D.items()][:5]:
        assert error >= 3 and np.linalg.norm(tracks.point_m - xyz, axis=1).min() < 1e-9
    off = []
    for image in model.images.values():
        for seen in image.points2D:
            projected = image.project_point(model.points3D[seen.point3D_id].xyz)
            off.append(seen.xy - projected)
    assert np.std(off) == pytest.approx(0.5, rel=0.05)
    path = tmp_path / "database.db"
    tracks.write_database(path)
    seen_by = [set(tracks.point[tracks.frame == k].tolist()) for k in range(len(tracks.timing.names))]
    common = {
        (i + 1, j + 1): len(seen_by[i] & seen_by[j]) for i in range(len(seen_by)) for j in range(i + 1, len(seen_by))
    }
    with pycolmap.Database.open(str(path)) as opened:
        assert opened.num_images() == len(seen_by)
        assert opened.num_matched_image_pairs() == sum(count >= 15 for count in common.values()) > 20
        pair = max(common, key=common.get)
        matches = opened.read_matches(*pair)
        assert len(matches) == common[pair]
        first, second = (tracks.point[tracks.frame == number - 1] for number in pair)
        assert np.array_equal(first[matches[:, 0]], second[matches[:, 1]])
        keypoints = opened.read_keypoints(pair[0])
        assert np.abs(keypoints[:, :2] - tracks.xy_px[tracks.frame == pair[0] - 1]).max() < 1e-3


def test_vibration_shakes_the_accelerometer_alone_by_its_amplitude():
    still = simulate_tracks(WALK, seed=4).imu
    assert _add_vibration(still, 0.0, np.random.default_rng(0)) is still
    shaken = [_add_vibration(still, 2.0, np.random.default_rng(seed)) for seed in range(40)]
    added = np.array([one.accel_m_s2 - still.accel_m_s2 for one in shaken])
    assert all(np.array_equal(one.gyro_rad_s, still.gyro_rad_s) for one in shaken)
    # sines whose level swings by eight tenths, each along any direction
    expected = 2.0 * np.sqrt((1 + 0.8**2 / 2) / 4)
    assert np.sqrt((added**2).mean(axis=(0, 1))) == pytest.approx(np.full(3, expected), rel=0.1)
    assert np.abs(added.mean(axis=1)).max() < 0.1
    # and so in the recording
    assert simulate_tracks(replace(WALK, vibration_m_s2=2.0), seed=4).imu.accel_m_s2.std() > still.accel_m_s2.std()
