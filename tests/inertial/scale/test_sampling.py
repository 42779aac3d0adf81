"""Stamps that scatter and readings that repeat are named as such."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.inertial.scale._sampling import describe_sampling, measure_repeated_share, scatter_s
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15)), seed=5)


def test_the_scatter_of_stamps_is_measured(subtests):
    for jitter_s in (5e-4, 1e-3):
        with subtests.test(jitter_s=jitter_s):
            rng = np.random.default_rng(1)
            t_s = np.arange(0, 60, 0.01) + jitter_s * rng.standard_normal(6000)
            t_s = np.delete(t_s, np.s_[2000:2500])  # a pause is no scatter
            assert scatter_s(t_s) == pytest.approx(jitter_s, rel=0.05)


def test_clean_streams_and_keyframes_have_nothing_to_say(recording):
    assert describe_sampling(recording.trajectory, recording.imu) == ()
    rng = np.random.default_rng(2)
    some = np.sort(rng.choice(len(recording.trajectory), 40, replace=False))
    assert describe_sampling(recording.trajectory.select(some), recording.imu) == ()


def test_stamps_that_scatter_are_named(recording):
    rng, imu = np.random.default_rng(3), recording.imu
    order = np.sort(imu.gyro_t_s + 3e-3 * rng.standard_normal(len(imu.gyro_t_s)))
    scattered = replace(imu, gyro_t_s=order)
    estimate = estimate_scale(recording.trajectory, scattered)
    said = estimate.reasons if estimate.verdict == "refused" else estimate.notes
    assert any(one.code == "stamps-scatter" and one.values["sensor"] == "gyroscope" for one in said)


def test_readings_that_were_held_are_named(recording):
    imu = recording.imu
    held = imu.accel_m_s2[np.arange(len(imu.accel_m_s2)) // 2 * 2]
    assert measure_repeated_share(held) == pytest.approx(0.5, abs=0.01)
    estimate = estimate_scale(recording.trajectory, replace(imu, accel_m_s2=held))
    assert any("50 % of the accelerometer's readings repeat" in str(s) for s in (*estimate.reasons, *estimate.notes))
