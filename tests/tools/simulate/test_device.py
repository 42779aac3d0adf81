"""A device's path and depth maps have the errors that its options state, and no others."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.tools.simulate.device import (
    HIGH,
    LOW,
    MEDIUM,
    DeviceErrors,
    DeviceOptions,
    compute_path,
    draw_device_errors,
    measure_depth,
)
from colmap_inertial.tools.simulate.motion import MotionOptions, make_motion

NONE = DeviceErrors(path_log=0.0, depth_log=0.0)
STILL = DeviceOptions(path_scale_walk_rts=0.0, path_drift_m_rts=0.0, path_noise_m=0.0, path_turn_rad=0.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_depth_of_a_wall_is_off_by_the_scale_and_by_noise_that_neighbours_share():
    wall = np.full((192, 256), 2.0)
    depth_m, confidence = measure_depth(wall, DeviceOptions(), DeviceErrors(path_log=0.0, depth_log=0.03), rng())
    assert (confidence == HIGH).all()
    relative = depth_m / (2.0 * np.exp(0.03)) - 1
    assert abs(relative.mean()) < 3e-4
    assert relative.std() == pytest.approx(0.004, rel=0.1)
    near, far = (np.corrcoef(relative[:, :-by].ravel(), relative[:, by:].ravel())[0, 1] for by in (1, 30))
    assert near > 0.9 and abs(far) < 0.15


def test_pixels_at_an_edge_lie_between_both_surfaces_and_most_of_them_say_so():
    steps = np.where(np.arange(256) < 128, 1.0, 2.0) * np.ones((192, 1))
    depth_m, confidence = measure_depth(steps, DeviceOptions(depth_noise=0.0), NONE, rng())
    beside = np.s_[:, 127:129]
    assert depth_m[beside].min() >= 1.0 and depth_m[beside].max() <= 2.0
    assert 0.25 < np.mean((depth_m[beside] > 1.3) & (depth_m[beside] < 1.7)) < 0.55
    assert np.mean(confidence[beside] == MEDIUM) == pytest.approx(0.8, abs=0.08)
    np.testing.assert_array_equal(depth_m[:, :127], 1.0)
    np.testing.assert_array_equal(depth_m[:, 129:], 2.0)


def test_what_is_out_of_range_or_nowhere_reads_as_the_end_of_the_range_without_confidence():
    true_m = np.full((48, 64), 6.0)
    true_m[:, :20], true_m[:, 20:40] = np.nan, 0.1
    depth_m, confidence = measure_depth(true_m, DeviceOptions(depth_noise=0.0), NONE, rng())
    assert (confidence == LOW).all()
    assert (depth_m[:, :18] == 5.0).all() and (depth_m[:, 22:38] == 0.2).all()


def test_a_path_without_errors_is_the_motion_in_the_device_s_metres():
    motion, t_s = make_motion(MotionOptions(duration_s=5.0), rng()), np.linspace(0, 5, 51)
    xyzw, centres = compute_path(motion, t_s, STILL, DeviceErrors(path_log=-0.02, depth_log=0.0), rng())
    np.testing.assert_allclose(centres, np.exp(-0.02) * motion.cam_in_world_m(t_s), atol=1e-12)
    turned = np.abs(np.sum(xyzw * motion.world_from_cam_xyzw(t_s), axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-12)


def test_the_scale_of_a_path_walks_as_far_as_stated():
    t_s = np.linspace(0, 20, 201)
    motion = make_motion(MotionOptions(kind="constant_velocity", duration_s=20.0), rng())
    steps = np.diff(motion.cam_in_world_m(t_s), axis=0)
    walks = []
    for seed in range(60):
        _, centres = compute_path(motion, t_s, replace(STILL, path_scale_walk_rts=0.01), NONE, rng(seed))
        longer = np.linalg.norm(np.diff(centres, axis=0), axis=1) / np.linalg.norm(steps, axis=1)
        walks.append(np.log(longer[-1]))
    assert np.std(walks) == pytest.approx(0.01 * np.sqrt(20), rel=0.3)


def test_path_and_depth_share_what_one_filter_makes_and_the_path_has_the_accelerometer_s_gain():
    options = DeviceOptions(path_scale_sd=0.02, depth_scale_sd=0.01, fusion_sd=0.005)
    drawn = [draw_device_errors(options, 0.0, rng(seed)) for seed in range(3000)]
    cov = np.cov([[one.path_log for one in drawn], [one.depth_log for one in drawn]])
    np.testing.assert_allclose(cov, [[4.25e-4, 2.5e-5], [2.5e-5, 1.25e-4]], rtol=0.1, atol=1e-5)
    gained = draw_device_errors(options, 0.05, rng(7))
    assert gained.path_log - drawn[7].path_log == pytest.approx(0.05)
    assert gained.depth_log == drawn[7].depth_log
