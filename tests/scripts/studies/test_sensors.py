"""The study of sensors: evidence of a few captures has the errors that it states, and outcomes are counted right."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from colmap_inertial.core.types.evidence import ScaleEvidence
from colmap_inertial.evidence.combine import combine
from scripts.studies import sensors as study

IMU = {"random_sigma": 0.004, "systematic": {"accel_gain": 0.005}}
DEPTH = {"random_sigma": 0.004, "systematic": {"depth_scale": 0.01}}


def capture(imu: float, depth: float) -> study.Capture:
    """Of a true scale of one; what two sensors say of it."""
    evidence = ({"sensor": "imu", "log_scale": imu, **IMU}, {"sensor": "depth", "log_scale": depth, **DEPTH})
    return study.Capture(seed=0, kind="orbit", log_scale=0.0, evidence=evidence, seconds=0.0)


@pytest.fixture(scope="module")
def drawn() -> list[study.Capture]:
    """Of one desk, to save time: even seeds."""
    return [study.draw_capture(seed) for seed in (0, 2, 4)]


def test_errors_of_each_sensor_and_of_all_are_as_stated(drawn: list[study.Capture]):
    for sensors in (*((sensor,) for sensor in study.SENSORS), *study.SETS.values()):
        z = []
        for one in drawn:
            found = combine(one.of(sensors))
            assert {said.sensor for said in found.evidence} == set(sensors)
            z.append((found.log_scale - one.log_scale) / found.sigma)
        assert np.sum(np.square(z)) < chi2.isf(1e-3, len(drawn))


def test_a_capture_s_seed_alone_reproduces_it(drawn: list[study.Capture]):
    assert study.draw_capture(2).evidence == drawn[1].evidence


def test_a_device_s_own_path_is_judged_by_its_sensors():
    one = study.draw_path(0)
    assert [said.sensor for said in one.of(study.SENSORS)] == ["imu", "depth", "device"]
    assert one.of(("device",))[0].log_scale == 0.0 and one.log_scale != 0.0
    for said in one.of(study.SENSORS):
        assert abs(said.log_scale - one.log_scale) < 4 * said.sigma


def test_what_is_held_trusted_outside_and_named_is_counted():
    sensors = ("imu", "depth")
    sound = study.judge([capture(0.001, -0.001)], sensors)
    assert (sound.count, sound.held, sound.trusted, sound.outside, sound.named) == (1, 1, 1, 0, 0)
    missed = study.judge([capture(0.025, 0.025)], sensors)
    assert (missed.held, missed.trusted, missed.outside) == (0, 1, 1)
    wrong = study.judge([capture(0.0, 0.0)], sensors, wrong="imu", by=0.1)
    assert wrong.count == 2 and wrong.trusted == 0 and wrong.outside == 0
    # both signs, and the sensors as they are elsewhere
    only = study.judge([capture(0.0, 0.0)], ("imu",), wrong="imu", by=0.1)
    assert (only.count, only.held, only.outside) == (2, 0, 1)


def test_rules_are_the_covariance_s_mean_and_the_hull_of_those_without_each():
    evidence = [
        ScaleEvidence(sensor="imu", log_scale=0.0, **IMU),
        ScaleEvidence(sensor="depth", log_scale=0.02, **DEPTH),
    ]
    alone = study.alone(evidence)
    assert (alone.log_scale, alone.sigma) == pytest.approx((0.0, math.hypot(0.004, 0.005)))
    both = study.as_if_sound(evidence)
    information = [1 / one.sigma**2 for one in evidence]
    assert both.log_scale == pytest.approx(0.02 * information[1] / sum(information))
    assert both.sigma == pytest.approx(sum(information) ** -0.5)
    hull = study.without_each(evidence)
    assert hull.ci95 == pytest.approx((evidence[0].ci95[0], evidence[1].ci95[1]))


def test_an_accelerometer_that_reads_too_long_is_told_of_by_each_amount():
    gains = study.draw_gain(0)
    assert [gain.by for gain in gains] == list(study.WRONG)
    assert all((gain.log_error is None) == (gain.verdict == "refused") for gain in gains)
    # gravity is as much too long
    assert all(abs(gain.log_error) < 0.5 * gain.by for gain in gains[1:] if gain.log_error is not None)
