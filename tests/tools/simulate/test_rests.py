"""Simulated rests of a device."""

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_log, quat_multiply
from colmap_inertial.tools.simulate import ImuOptions
from colmap_inertial.tools.simulate.rests import RestOptions, _triangular, _Turn, simulate_rests


def test_a_hand_knocks_where_it_takes_and_leaves():
    rng = np.random.default_rng(4)
    options = RestOptions(hand_m_s2=0.0, knock_m_s2=5.0)
    turn = _Turn.draw(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), options, rng)
    since_s = np.linspace(0, turn.duration_s, 4000)
    felt = np.linalg.norm(turn.handled_m_s2(since_s, rng), axis=1)
    middle = np.abs(since_s - turn.duration_s / 2) < 0.2 * turn.duration_s
    assert np.sqrt(np.mean(felt[middle] ** 2)) == pytest.approx(0.3 * np.sqrt(3), rel=0.1)
    assert felt[:20].mean() > 5 and felt[-20:].mean() > 5


def test_a_turned_device_turns_as_its_gyroscope_says_from_one_rest_to_the_next(subtests):
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            up, up_next = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
            turn = _Turn.draw(up, up_next, RestOptions(tremor_rad=0.2), rng)
            assert 1.5 <= turn.duration_s <= 3.0
            ends = matrix_from_quat(turn.attitude(np.array([0.0, turn.duration_s])))
            assert ends[0] == pytest.approx(np.eye(3), abs=1e-9) and ends[1] @ up_next == pytest.approx(up, abs=1e-9)
            assert turn.rate_rad_s(np.array([0.0, turn.duration_s])) == pytest.approx(np.zeros((2, 3)), abs=1e-9)
            at_s, step_s = np.linspace(0.05, 0.95, 40) * turn.duration_s, 1e-4
            before, after = (turn.attitude(at_s + sign * step_s) for sign in (-1, 1))
            rate = quat_log(quat_multiply(quat_conjugate(before), after)) / (2 * step_s)
            assert np.abs(turn.rate_rad_s(at_s) - rate).max() < 1e-4 * np.abs(rate).max()


def test_readings_at_rest_become_gravity_by_the_true_calibration():
    quiet = {
        name: 0.0
        for name in (
            *("gyro_density_rad_s_rthz", "accel_density_m_s2_rthz", "gyro_walk_rad_s2_rthz", "accel_walk_m_s3_rthz"),
            *("gyro_resolution_rad_s", "accel_resolution_m_s2"),
        )
    }
    device = ImuOptions(gyro_scale_sd=0.02, accel_scale_sd=0.03, accel_misalignment_sd=0.02, **quiet)
    options = RestOptions(attitudes=5, rest_s=2.0, imu=device, gravity_m_s2=9.7)
    made = simulate_rests(options, seed=7)
    imu, begin_s = made.recording, 0.0
    assert len(made.up_in_imu) == 5
    accel = imu.accel_m_s2 @ (np.eye(3) + made.accel_gain).T - made.accel_bias_m_s2
    gyro = imu.gyro_rad_s @ (np.eye(3) + made.gyro_gain).T - made.gyro_bias_rad_s
    still = np.abs(gyro).max(axis=1) < 1e-9
    # each rest is the longest stretch of its attitude
    for k, up in enumerate(made.up_in_imu):
        here = np.linalg.norm(accel - 9.7 * up, axis=1) < 1e-9
        rest_s = imu.accel_t_s[here]
        assert 1.98 <= np.ptp(rest_s) <= 2.02 and rest_s[0] >= begin_s
        assert still[(imu.gyro_t_s > rest_s[0]) & (imu.gyro_t_s < rest_s[-1])].all()
        assert k == 0 or 1.4 < rest_s[0] - begin_s < 3.1
        begin_s = rest_s[-1]
    assert imu.accel_t_s[-1] == pytest.approx(begin_s) and imu.gyro_t_s[-1] == pytest.approx(begin_s, abs=0.02)


def test_a_hand_swings_and_shakes_by_its_acceleration():
    rng = np.random.default_rng(5)
    options = RestOptions(hand_m_s2=20.0, knock_m_s2=0.0, turn_s=(2.0, 2.0))
    turn = _Turn.draw(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), options, rng)
    since_s = np.linspace(0, 2.0, 4000, endpoint=False)
    felt = turn.handled_m_s2(since_s, rng)
    power = 2 * np.abs(np.fft.rfft(felt, axis=0) / 4000) ** 2
    # once in the turn, and 25 times a second
    assert power[1] == pytest.approx((20 * turn.hand_axes[0]) ** 2 / 2, rel=0.05, abs=0.05)
    assert power[50] == pytest.approx((6 * turn.hand_axes[1]) ** 2 / 2, rel=0.05, abs=0.05)
    rest = np.delete(power, [1, 50], axis=0)
    assert rest.max() < 0.01 and np.sqrt(rest.sum(axis=0)) == pytest.approx([0.3] * 3, rel=0.1)


def test_a_matrix_becomes_lower_triangular_by_a_rotation():
    matrix = np.eye(3) + 0.1 * np.random.default_rng(2).standard_normal((3, 3))
    turned, lower = _triangular(matrix)
    assert turned @ matrix == pytest.approx(lower) and turned @ turned.T == pytest.approx(np.eye(3))
    assert np.triu(lower, 1) == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    assert (np.diagonal(lower) > 0).all() and np.linalg.det(turned) == pytest.approx(1)
