"""Clock offsets: the rotation and rate that fit best, and the gain of each offset."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.motion.align import _clock_search
from colmap_inertial.motion.align._clock_search import Intervals, _find_rotation, _fit_offsets, search_offsets


def turned_intervals(rng, noise_rad, count=240):
    """Intervals of a camera, what a gyroscope says at the right clock offset and at a wrong one, and its rotation."""
    end_s = np.cumsum(rng.uniform(0.2, 0.6, count))
    intervals = Intervals(begin_s=np.append(0, end_s[:-1]), end_s=end_s, turn_rad=np.zeros((count, 3)))
    cam_from_imu = Rotation.random(random_state=5).as_matrix()
    felt = 0.2 * rng.standard_normal((count, 3))
    turn = felt @ cam_from_imu.T + intervals.dt_s[:, None] * [0.03, -0.02, 0.01]
    turn += noise_rad * rng.standard_normal((count, 3))
    return replace(intervals, turn_rad=turn), np.stack([felt, rng.permutation(felt)]), cam_from_imu


def test_what_a_rotation_and_a_rate_leave_is_what_scipy_leaves():
    intervals, inertial, cam_from_imu = turned_intervals(np.random.default_rng(9), 0.02)
    inside = np.random.default_rng(10).random((2, len(intervals))) < 0.8
    energy, left, _ = _fit_offsets(intervals, inertial, inside, None, 1.0)
    held = _fit_offsets(intervals, inertial, inside, cam_from_imu, 1.0)[1]
    for k in range(2):
        dt_s, *turns = (x[inside[k]] for x in (intervals.dt_s, intervals.turn_rad, inertial[k]))
        # weighed by one over the time, the rate that leaves least is the mean over all of it
        visual, felt = (x - dt_s[:, None] * x.sum(axis=0) / dt_s.sum() for x in turns)
        assert energy[k] == pytest.approx(np.sum(visual**2 / dt_s[:, None]))
        _, root = Rotation.align_vectors(visual, felt, weights=1 / dt_s)
        assert left[k] == pytest.approx(root**2, rel=1e-6)
        assert held[k] == pytest.approx(np.sum((visual - felt @ cam_from_imu.T) ** 2 / dt_s[:, None]))


def test_intervals_that_are_wrong_leave_nothing_where_a_share_is_believed():
    rng, noise_rad = np.random.default_rng(12), 1e-3
    intervals, inertial, cam_from_imu = turned_intervals(rng, noise_rad)
    wrong = rng.random(len(intervals)) < 0.2
    turn = np.where(wrong[:, None], 0.5 * rng.standard_normal((len(wrong), 3)), intervals.turn_rad)
    intervals = replace(intervals, turn_rad=turn)
    inside = np.ones((2, len(wrong)), dtype=bool)
    for held in (None, cam_from_imu):
        energy, left, (cross, *_) = _fit_offsets(intervals, inertial, inside, held, 0.7)
        noise = noise_rad**2 * np.sum(3 / intervals.dt_s)
        assert 0.2 * noise < left[0] < 0.8 * noise < 0.01 * energy[0] and left[1] > 0.3 * energy[1]
        assert _find_rotation(cross)[0] == pytest.approx(cam_from_imu, abs=3e-3)


def test_gains_of_dense_frames_are_those_of_what_overlaps_about_its_mean():
    """By FFT for all offsets at once, and here by sums, one offset after the other."""
    rng, step_s, late = np.random.default_rng(2), _clock_search._GRID_S, 13
    rate = [0.5, -0.2, 0.3] + 0.4 * rng.standard_normal((160, 3))
    path = SimpleNamespace(t_s=step_s * np.arange(161), rate_rad_s=np.zeros((161, 3)))
    # trapezia between samples: the mean of neighbours is the rate of a cell
    for i, of_cell in enumerate(rate):
        path.rate_rad_s[i + 1] = 2 * of_cell - path.rate_rad_s[i]
    visual = rate[late : late + 120] + [0.1, 0.2, -0.1] + 0.1 * rng.standard_normal((120, 3))
    begin_s = step_s * np.arange(120)
    intervals = Intervals(begin_s=begin_s, end_s=begin_s + step_s, turn_rad=visual * step_s)
    offsets_s, gains, per_second = _clock_search._correlate_rates(intervals, path, (-1.0, 1.0), 0.5, np.eye(3))
    assert len(offsets_s) > 30 and offsets_s[np.argmax(gains)] == pytest.approx(-late * step_s)
    for offset_s, gain in zip(offsets_s, gains, strict=True):
        shift = -round(offset_s / step_s)
        cells = np.arange(max(0, -shift), min(120, 160 - shift))
        v, g = (x - x.mean(axis=0) for x in (visual[cells], rate[cells + shift]))
        left = max(np.sum((v - g) ** 2), 1e-3 * np.sum(v**2))
        assert gain == pytest.approx(0.5 * per_second * step_s * len(cells) * np.log(np.sum(v**2) / left), abs=1e-6)


def test_the_offset_of_sparse_frames_is_found_whichever_recording_begins_first(subtests):
    """Camera time is IMU time plus the offset; frames are half a second apart, attitudes are multiplied by SciPy."""
    rng, step_s, offset_s = np.random.default_rng(15), 0.01, 7.3
    t_s = step_s * np.arange(4001)
    waves = rng.uniform(0.2, 1.2, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    rate = np.sum(0.3 * np.sin(2 * np.pi * waves[0] * t_s[:, None, None] + waves[1]), axis=1)
    world_from_imu = [Rotation.identity()]
    for mean in 0.5 * (rate[1:] + rate[:-1]):
        world_from_imu.append(world_from_imu[-1] * Rotation.from_rotvec(step_s * mean))
    cam_from_imu = Rotation.random(random_state=5)
    for label, camera, gyroscope in (
        ("camera within the gyroscope", (10.0, 30.0), (0.0, 40.0)),
        ("gyroscope within the camera", (0.0, 40.0), (10.0, 30.0)),
        ("camera first", (0.0, 30.0), (8.0, 40.0)),
        ("gyroscope first", (8.0, 40.0), (0.0, 30.0)),
    ):
        with subtests.test(label):
            frames = np.flatnonzero((t_s >= camera[0]) & (t_s <= camera[1]))[::50]
            turns = [
                cam_from_imu * world_from_imu[i].inv() * world_from_imu[j] * cam_from_imu.inv()
                for i, j in pairwise(frames)
            ]
            intervals = Intervals(
                begin_s=t_s[frames[:-1]] + offset_s,
                end_s=t_s[frames[1:]] + offset_s,
                turn_rad=np.stack([turn.as_rotvec() for turn in turns]),
            )
            felt = (t_s >= gyroscope[0]) & (t_s <= gyroscope[1])
            path = GyroPath(t_s[felt], rate[felt], np.zeros(3))
            best = search_offsets(intervals, path, (-100.0, 100.0), min_overlap=0.5)[0]
            assert best.offset_s == pytest.approx(offset_s, abs=0.02) and best.explained > 0.99
            assert (Rotation.from_quat(best.cam_from_imu_xyzw) * cam_from_imu.inv()).magnitude() < 0.02
