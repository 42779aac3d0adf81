"""Sensors together: draws from the very errors that evidence states, and sensors that are wrong on purpose."""

import math
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.evidence import AbsentSensor, ScaleEvidence, ScalePart
from colmap_inertial.evidence.combine import combine, covariance_of, judge_device, weigh
from colmap_inertial.evidence.inertial import evidence_of_device
from colmap_inertial.evidence.priors import FAULT_SIGMA, FAULTS

IMU = {"random_sigma": 0.006, "systematic": {"accel_gain": 0.005}}
DEPTH = {"random_sigma": 0.005, "systematic": {"depth_scale": 0.01, "device_fusion": 0.005}}
POSITIONS = {"random_sigma": 0.02, "systematic": {"receiver": 0.004}}


def evidence(sensor: str, log_scale: float, **errors) -> ScaleEvidence:
    return ScaleEvidence(sensor=sensor, log_scale=log_scale, **errors)


def draw(rng: np.random.Generator, true: float) -> list[ScaleEvidence]:
    """One recording: each cause is drawn once, whoever has it."""
    sensors = [
        evidence("imu", 0, **IMU),
        evidence("depth", 0, **DEPTH),
        evidence("positions", 0, **POSITIONS),
        evidence_of_device(),
    ]
    causes = {cause for one in sensors for cause in one.systematic}
    drawn = {cause: rng.normal() for cause in sorted(causes)}
    out = []
    for one in sensors:
        error = one.random_sigma * rng.normal() + sum(s * drawn[c] for c, s in one.systematic.items())
        out.append(evidence(one.sensor, true + error, random_sigma=one.random_sigma, systematic=one.systematic))
    return out


def test_intervals_hold_where_errors_are_as_stated_and_are_narrower_than_the_best_sensor_alone():
    rng = np.random.default_rng(0)
    inside, ratio = [], []
    for _ in range(300):
        true = rng.normal()
        sensors = draw(rng, true)
        both = combine(sensors)
        inside.append(abs(both.log_scale - true) < 1.96 * both.sigma)
        ratio.append(both.sigma / min(one.sigma for one in sensors))
    assert 0.93 < np.mean(inside) < 0.985
    assert np.median(ratio) < 1


@pytest.mark.parametrize("wrong", range(3))
@pytest.mark.parametrize("by", [0.02, 0.05, 0.1, -0.1])
def test_a_sensor_that_is_wrong_leaves_no_narrow_interval_beside_the_truth(wrong: int, by: float):
    rng = np.random.default_rng(1)
    count, trusted_outside, alone_outside, named = 150, 0, 0, 0
    for _ in range(count):
        sensors = draw(rng, 0.0)
        spoilt = sensors[wrong]
        sensors[wrong] = evidence(
            spoilt.sensor, spoilt.log_scale + by, random_sigma=spoilt.random_sigma, systematic=spoilt.systematic
        )
        both = combine(sensors)
        alone_outside += abs(sensors[wrong].log_scale) > 1.96 * sensors[wrong].sigma
        trusted_outside += both.verdict == "trusted" and abs(both.log_scale) > 1.96 * both.sigma
        named += any(r.code == "sensors-contradict" and r.values["culprit"] == spoilt.sensor for r in both.reasons)
    # by chance five in a hundred; what is within a sensor's own interval or little beyond nobody can see, but it
    # harms less than where the sensor is alone
    chance = (0.05 + 3 * math.sqrt(0.05 * 0.95 / count)) * count
    assert trusted_outside <= (chance if abs(by) >= 0.05 else max(chance, 0.5 * alone_outside))
    if abs(by) == 0.1:
        assert named > 0.5 * count


def test_one_sensor_alone_is_left_as_it_is():
    alone = evidence("depth", 0.3, **DEPTH)
    both = combine([alone])
    assert (both.log_scale, both.sigma) == pytest.approx((0.3, alone.sigma))
    assert both.p_value == 1


@pytest.mark.parametrize("others", [("device",), ("depth",), ("depth", "device"), ("depth", "positions", "device")])
def test_sensors_that_agree_give_no_wider_interval_than_the_surest_alone(others: tuple[str, ...]):
    known = {"depth": DEPTH, "positions": POSITIONS}
    agreeing = [evidence(s, 0.001, **known[s]) if s in known else evidence_of_device(0.001) for s in others]
    imu = evidence("imu", 0.0, **IMU)
    both = combine([imu, *agreeing])
    assert both.p_value > 0.5 and both.sigma <= imu.sigma


def test_faults_as_frequent_as_assumed_leave_the_interval_true():
    rng = np.random.default_rng(2)
    inside = []
    for _ in range(400):
        sensors = draw(rng, 0.0)
        wrong = [FAULT_SIGMA * rng.normal() * (rng.uniform() < FAULTS[one.sensor]) for one in sensors]
        both = combine([replace(one, log_scale=one.log_scale + by) for one, by in zip(sensors, wrong, strict=True)])
        inside.append(abs(both.log_scale) < 1.96 * both.sigma)
    assert 0.95 - 3 * math.sqrt(0.05 * 0.95 / 400) < np.mean(inside)


def test_an_error_that_all_share_is_never_averaged_out():
    sensors = [evidence(s, 0.0, random_sigma=1e-4, systematic={"lens": 0.01}) for s in ("imu", "depth", "target")]
    assert combine(sensors).sigma >= 0.01


def test_an_error_that_two_share_in_other_sizes_is_not_subtracted():
    cov = covariance_of(
        [
            evidence("imu", 0, random_sigma=1e-3, systematic={"accel_gain": 0.005}),
            evidence("device", 0, random_sigma=1e-3, systematic={"accel_gain": 0.02}),
        ]
    )
    weights = weigh(cov)
    np.testing.assert_allclose(weights, [1, 0])
    assert weights @ cov @ weights >= 0.005**2


def test_weights_without_shared_errors_are_inverse_variances():
    cov = np.diag([1.0, 4.0, 16.0])
    np.testing.assert_allclose(weigh(cov), np.array([16, 4, 1]) / 21)


def test_where_two_contradict_both_are_named_and_the_interval_reaches_to_both():
    both = combine([evidence("imu", 0.0, **IMU), evidence("depth", 0.1, **DEPTH)])
    reason = next(r for r in both.reasons if r.code == "sensors-contradict")
    assert {reason.values["first"], reason.values["second"]} == {"imu", "depth"}
    assert both.verdict == "weak"
    assert both.log_scale - 1.96 * both.sigma < 0 < 0.1 < both.log_scale + 1.96 * both.sigma


def test_no_interval_lies_between_two_that_are_far_apart_and_holds_neither():
    for apart in (0.2, 0.47, 2.3):
        both = combine([evidence("imu", 0.0, **IMU), evidence("depth", apart, **DEPTH)])
        assert both.log_scale - 1.96 * both.sigma < 0 < apart < both.log_scale + 1.96 * both.sigma
        assert "sensors-contradict" in [reason.code for reason in both.reasons]


def test_a_third_sensor_tells_which_of_two_is_wrong():
    sensors = [
        evidence("imu", 0.08, **IMU),
        evidence("depth", 0.0, **DEPTH),
        evidence("target", 0.002, random_sigma=0.003),
    ]
    both = combine(sensors)
    reason = next(r for r in both.reasons if r.code == "sensors-contradict")
    assert reason.values["culprit"] == "imu" and reason.values["probability"] > 0.9
    assert abs(both.log_scale) < 0.01


def test_a_sensor_s_own_doubts_keep_the_whole_from_being_trusted():
    doubtful = evidence("imu", 0.0, **IMU, reasons=(Fact("camera-still"),))
    both = combine([doubtful, evidence("depth", 0.0, **DEPTH)])
    assert both.verdict == "weak" and both.reasons[0].code == "sensor-in-doubt"


def test_no_evidence_is_an_error_that_says_why():
    with pytest.raises(NotObservableError) as error:
        combine([], [AbsentSensor(sensor="imu", reasons=(Fact("camera-still"),))])
    assert error.value.fact.code == "no-sensor-gives-scale"


def test_the_device_is_judged_by_the_others_and_by_parts():
    parts = tuple(ScalePart(begin_s=b, end_s=b + 5, log_scale=s, sigma=0.004) for b, s in ((0, 0.02), (5, 0.06)))
    sensors = [evidence("depth", 0.04, **DEPTH, parts=parts), evidence("imu", 0.04, **IMU), evidence_of_device()]
    t_s = np.linspace(0, 10, 101)
    path = CameraTrajectory(
        names=tuple(map(str, range(101))),
        t_s=t_s,
        cam_from_world_xyzw=np.tile([0, 0, 0, 1.0], (101, 1)),
        cam_in_world=np.stack([t_s, 0 * t_s, 0 * t_s], axis=1),
    )
    device = judge_device(combine(sensors), path)
    assert device is not None
    assert device.log_error == pytest.approx(-0.04, abs=1e-9)
    assert device.length_m == pytest.approx(10 * math.exp(0.04))
    assert device.error_m == pytest.approx(10 - 10 * math.exp(0.04))
    assert [part.log_scale for part in device.parts] == pytest.approx([-0.02, -0.06])
    assert judge_device(combine([evidence_of_device()]), path) is None
