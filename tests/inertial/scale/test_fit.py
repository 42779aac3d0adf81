"""The joint fit: surprise of the gains, and excitation."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.inertial.core.parameters import ACCEL_GAIN, GYRO_GAIN, N_GLOBALS, Estimate, Prior
from colmap_inertial.inertial.scale._fit import _excitation_m_s2, _measure_gain_surprise


def test_gains_surprise_where_they_are_farther_off_than_chance_has_it():
    rng, sigma = np.random.default_rng(3), 0.005
    start = Estimate.at_start(np.eye(3)[None], np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    info = np.zeros((N_GLOBALS, N_GLOBALS))
    info[ACCEL_GAIN, ACCEL_GAIN] = info[GYRO_GAIN, GYRO_GAIN] = np.eye(9) / sigma**2
    prior = Prior(mean=start, info=info, gravity_m_s2=9.8, gravity_sigma_m_s2=0.02)

    def surprise(times, cov):
        gains = times * sigma * rng.standard_normal((400, 3, 3))
        return np.array([_measure_gain_surprise(prior, replace(start, accel_gain=gain), cov) for gain in gains])

    # all of the gains are known: nine squares are nine on average, and three standard deviations nine times as many
    known = np.zeros((N_GLOBALS, N_GLOBALS))
    usual = surprise(1.0, known)
    assert usual.min() == 1.0 and 0.1 < np.mean(usual > 1) < 0.2
    assert surprise(3.0, known).mean() == pytest.approx(81 / (9 + 18**0.5), rel=0.1)
    # none is: a little says more
    unknown = known.copy()
    unknown[ACCEL_GAIN, ACCEL_GAIN] = sigma**2 * np.eye(9)
    assert surprise(3.0, unknown).mean() > 3 * surprise(3.0, known).mean()


def test_the_excitation_is_the_acceleration_of_the_camera_and_not_of_its_imu():
    t_s, hz = np.arange(0, 20, 0.05), 0.5
    angle = 0.6 * np.sin(2 * np.pi * 0.8 * t_s)
    world_from_imu = Rotation.from_rotvec(angle[:, None] * [0, 0, 1.0]).as_matrix()
    camera = np.stack([0.3 * np.sin(2 * np.pi * hz * t_s), 2.0 * t_s, np.zeros_like(t_s)], axis=1)
    # half a metre in front of the IMU
    cam_from_imu, imu_in_cam = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([0.0, 0.0, -0.5])
    path = SimpleNamespace(
        imu_in_world_m=camera + world_from_imu @ cam_from_imu.T @ imu_in_cam,
        world_from_imu=world_from_imu, cam_from_imu=cam_from_imu, imu_in_cam_m=imu_in_cam,
    )  # fmt: skip
    found = _excitation_m_s2(SimpleNamespace(t_s=t_s), path)
    assert found == pytest.approx(0.3 * (2 * np.pi * hz) ** 2 / np.sqrt(2), rel=0.02)
